"""Which elements of a ring are one magnet, and which magnets share a supply.

>>> [own[0].name for own in magnets(ring, ("quadrupole",), powered=True)]
>>> kinds, members = supplied_alike(ring)
"""

from collections.abc import Collection

import numpy as np

from tmlattice.arrays import Array
from tmlattice.lattice.ring import Element, Ring
from tmlattice.lattice.slices import bodies, families


def magnets(ring: Ring, kinds: Collection[str], powered: bool = False) -> list[tuple[Element, ...]]:
    """Magnets of some kinds, each with its pieces; pieces that are edges of other magnets are none.

    Args:
        ring: where they stand.
        kinds: of elements.
        powered: those alone that have a gradient.
    """
    return [
        tuple(ring.elements[i] for i in own)
        for own in bodies(ring.elements, ring.whole, kinds, powered)
    ]


def supplied_alike(ring: Ring) -> tuple[list[str], Array]:
    """Families of powered quadrupoles, and who of these `magnets` belongs to them, [magnet, family]
    of 0 and 1: by name, and where a magnet has a name of its own (BESSY II, MLS), by
    `Ring.supplies`."""
    names = [pieces[0].name for pieces in magnets(ring, ("quadrupole",), powered=True)]
    kinds, members = families(names)
    more = {kind: np.isin(names, alike) for kind, alike in ring.supplies.items()}
    more = {kind: alike for kind, alike in more.items() if alike.sum() > 1}
    columns = [alike.astype(float)[:, None] for alike in more.values()]
    return [*kinds, *more], np.hstack([members, *columns])
