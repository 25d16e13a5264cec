"""Measurements as other programs left them: MATLAB LOCO and Middle Layer, HDF5, CSV, turns.

>>> brought = bring_in([Path("machine.loco.mat")])
>>> brought.measurement, brought.ring           # what was measured, and the model beside it
>>> print("\\n".join(brought.assumed))          # units, signs, steps: what the files do not prove
"""

from tmlattice.importers.bring_in import Options, bring_in
from tmlattice.importers.imported import Imported, described, write_imported

__all__ = ["Imported", "Options", "bring_in", "described", "write_imported"]
