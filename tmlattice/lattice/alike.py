"""Which elements are one magnet, and which magnets share a supply: by name, else by their design.

Quadrupoles that share no name with others (q1m1t1r, q1m2t1r, ... at BESSY II and MLS), and that the
design has as long and as strong, have one supply or one setting behind them.
"""

from collections.abc import Collection, Mapping, Sequence
from typing import Protocol

import numpy as np

from tmlattice.arrays import Array
from tmlattice.lattice.slices import Piece, stem

Supplies = Mapping[str, tuple[str, ...]]
"""Names of all magnets of each, their pieces too, by what identifies it."""


class Body(Piece, Protocol):
    """What more is asked of an element."""

    @property
    def name(self) -> str:
        """Unique in the ring."""

    @property
    def k1(self) -> float:
        """1/m2."""


def bodies(
    elements: Sequence[Body],
    whole: Mapping[int, tuple[int, ...]],
    kinds: Collection[str],
    powered: bool = False,
) -> list[tuple[int, ...]]:
    """Places of magnets of some kinds, with those of their pieces; pieces that are edges of other
    magnets are none.

    Args:
        elements: in beam order.
        whole: of each piece the places of all pieces of its magnet.
        kinds: of elements.
        powered: those alone that have a gradient.
    """

    def one(place: int) -> bool:
        element = elements[place]
        return element.kind in kinds and (element.k1 != 0 or not powered)

    found: dict[int, tuple[int, ...]] = {}
    for place in filter(one, range(len(elements))):
        pieces = whole.get(place, (place,))
        if elements[max(pieces, key=lambda i: elements[i].length)].kind in kinds:
            own = tuple(filter(one, pieces))
            found.setdefault(own[0], own)
    return list(found.values())


def families(names: Sequence[str]) -> tuple[list[str], Array]:
    """Stems that more than one has, and who belongs to them, [name, family] of 0 and 1."""
    stems = [stem(name) for name in names]
    kinds = [kind for kind in dict.fromkeys(stems) if stems.count(kind) > 1]
    return kinds, np.array([[float(own == kind) for kind in kinds] for own in stems]).reshape(
        len(names), len(kinds)
    )


def alike_by_design(
    elements: Sequence[Body], whole: Mapping[int, tuple[int, ...]]
) -> dict[str, tuple[str, ...]]:
    """Supplies of quadrupoles that share no name with others, see `bodies`."""
    own = bodies(elements, whole, ("quadrupole",), powered=True)
    alone = families([elements[pieces[0]].name for pieces in own])[1].sum(axis=1) == 0
    designs: dict[tuple[float, float], list[tuple[int, ...]]] = {}
    for m in np.flatnonzero(alone).tolist():
        length = sum(elements[i].length for i in own[m])
        key = (round(length, 5), round(elements[own[m][0]].k1, 6))
        designs.setdefault(key, []).append(own[m])
    found = {}
    for magnets in designs.values():
        if len(magnets) > 1:
            first, second = (elements[pieces[0]].name for pieces in magnets[:2])
            like = second if len(magnets) == 2 else f"{len(magnets) - 1} of its strength"
            found[f"{first} and {like}"] = tuple(elements[i].name for own in magnets for i in own)
    return found
