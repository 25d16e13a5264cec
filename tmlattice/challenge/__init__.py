"""The blind challenge: the diagnosis tested on data whose cause is withheld.

>>> make("A", 300, 1, Path("blind"))
>>> run(Path("blind"))                       # reads no truth
>>> score(Path("blind"))
"""

from tmlattice.challenge.case import Case, Truth, read_case, read_truth
from tmlattice.challenge.make import make
from tmlattice.challenge.run import run
from tmlattice.challenge.score import score

__all__ = ["Case", "Truth", "make", "read_case", "read_truth", "run", "score"]
