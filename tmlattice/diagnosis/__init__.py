"""Where the gap between model and machine lies, which effect causes it, how far it shrinks.

>>> diagnosis = diagnose(ring, read_measurement("day_1"))
>>> diagnosis.verdict
'named'
>>> diagnosis.as_json()["findings"][0]["element"]
"""

from tmlattice.diagnosis.procedure import diagnose
from tmlattice.diagnosis.result import Diagnosis, Finding, Member

__all__ = ["Diagnosis", "Finding", "Member", "diagnose"]
