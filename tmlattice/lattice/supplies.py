"""Which elements of a ring are one magnet, and which magnets share a supply.

>>> [own[0].name for own in magnets(ring, ("quadrupole",), powered=True)]
>>> kinds, members = supplied_alike(ring, magnets(ring, ("quadrupole",), powered=True))
"""

from collections.abc import Collection, Sequence

import numpy as np
from numpy.typing import NDArray

from tmlattice.lattice.ring import Element, Ring
from tmlattice.lattice.slices import stem

Array = NDArray[np.float64]

KEY = "alike by design"
"""Under which a ring remembers it."""


def magnets(ring: Ring, kinds: Collection[str], powered: bool = False) -> list[tuple[Element, ...]]:
    """Magnets of some kinds, each with its pieces; pieces that are edges of other magnets are none.

    Args:
        ring: where they stand.
        kinds: of elements.
        powered: those alone that have a gradient.
    """
    found: dict[str, tuple[Element, ...]] = {}
    for element in ring.elements:
        if element.kind in kinds and (element.k1 != 0 or not powered):
            pieces = [ring[name] for name in ring.pieces(element.name)]
            if max(pieces, key=lambda piece: piece.length).kind not in kinds:
                continue
            own = [e for e in pieces if e.kind in kinds and (e.k1 != 0 or not powered)]
            found.setdefault(own[0].name, tuple(own))
    return list(found.values())


def families(names: Sequence[str]) -> tuple[list[str], Array]:
    """Stems that more than one has, and who belongs to them, [name, family] of 0 and 1."""
    stems = [stem(name) for name in names]
    kinds = [kind for kind in dict.fromkeys(stems) if stems.count(kind) > 1]
    return kinds, np.array([[float(own == kind) for kind in kinds] for own in stems]).reshape(
        len(names), len(kinds)
    )


def supplied_alike(ring: Ring, own: Sequence[tuple[Element, ...]]) -> tuple[list[str], Array]:
    """Families of quadrupoles, and who belongs to them, [magnet, family] of 0 and 1: by name, and
    where each has a name of its own (BESSY II, MLS), by `alike_by_design`.

    Args:
        ring: where they stand.
        own: magnets, each with its pieces.
    """
    names = [pieces[0].name for pieces in own]
    kinds, members = families(names)
    more = {kind: np.isin(names, alike) for kind, alike in alike_by_design(ring).items()}
    more = {kind: alike for kind, alike in more.items() if alike.sum() > 1}
    columns = [alike.astype(float)[:, None] for alike in more.values()]
    return [*kinds, *more], np.hstack([members, *columns])


def alike_by_design(ring: Ring) -> dict[str, tuple[str, ...]]:
    """Quadrupoles that share no name with others, and are as long and as strong in the design: by
    what tells of them, names of them all and of their pieces. One supply or one setting is behind
    them, in a ring that was changed from the design, too.
    """
    if ring.design is not None:
        return alike_by_design(ring.design)
    if KEY not in ring.memory:
        ring.memory[KEY] = _alike(ring)
    found: dict[str, tuple[str, ...]] = ring.memory[KEY]
    return found


def _alike(ring: Ring) -> dict[str, tuple[str, ...]]:
    own = magnets(ring, ("quadrupole",), powered=True)
    alone = families([pieces[0].name for pieces in own])[1].sum(axis=1) == 0
    designs: dict[tuple[float, float], list[tuple[Element, ...]]] = {}
    for i in np.flatnonzero(alone).tolist():
        length = sum(e.length for e in own[i])
        designs.setdefault((round(length, 5), round(own[i][0].k1, 6)), []).append(own[i])
    found = {}
    for first, *others in designs.values():
        if others:
            like = f"{len(others)} of its strength" if len(others) > 1 else others[0][0].name
            found[f"{first[0].name} and {like}"] = tuple(
                e.name for pieces in (first, *others) for e in pieces
            )
    return found
