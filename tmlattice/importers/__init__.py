"""Measurements as other programs left them: MATLAB LOCO and Middle Layer, HDF5, CSV, turns.

>>> brought = bring_in([Path("machine.loco.mat")])
>>> brought.measurement, brought.ring           # what was measured, and its model
>>> print("\\n".join(brought.assumed))          # units, signs, steps: what the files do not prove
"""

from tmlattice.importers.bring_in import Options, bring_in, import_data, read_measurement
from tmlattice.importers.imported import Imported, described, write_imported
from tmlattice.importers.stated import Stated

__all__ = [
    "Imported",
    "Options",
    "Stated",
    "bring_in",
    "described",
    "import_data",
    "read_measurement",
    "write_imported",
]
