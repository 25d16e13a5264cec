"""The ring as named elements in beam order.

>>> ring = load_ring("petra3")                  # the built-in ring
>>> ring = load_ring("path/to/machine.py")      # any OCELOT lattice file (it is code: it is run)
>>> ring["qd::12"].k1
>>> weaker = ring.with_changed("qd::12", k1=0.8 * ring["qd::12"].k1)
"""

from tmlattice.lattice.default_magnet import middle_of_first_arc
from tmlattice.lattice.load import builtin_lattices, load_ring
from tmlattice.lattice.marked import marked
from tmlattice.lattice.ring import Element, Kind, Ring
from tmlattice.lattice.write import save_ring

__all__ = [
    "Element",
    "Kind",
    "Ring",
    "builtin_lattices",
    "load_ring",
    "marked",
    "middle_of_first_arc",
    "save_ring",
]
