"""Which elements are one magnet, and which magnets share a supply.

Many files cut magnets into pieces, and a magnet is repaired as one. Pieces touch: nothing with a
length lies between them (monitors, markers and thin correctors may). Touching bends that bend the
same way are one dipole. Touching quadrupoles, or sextupoles, are one magnet where they have one
family (or are the halves NAME and NAME_2 that `marked` makes). A piece shorter than a fiftieth of
its neighbour is an edge of it, whatever its field.

Magnets share a supply by name, else by their design: quadrupoles that share no name with others
(q1m1t1r, q1m2t1r, ... at BESSY II and MLS), and that the design has as long and as strong, have one
supply or one setting behind them.
"""

import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from itertools import groupby
from typing import Protocol

import numpy as np

from tmlattice.arrays import Array

Supplies = Mapping[str, tuple[str, ...]]
"""Names of all magnets of each, their pieces too, by what identifies it."""


class Piece(Protocol):
    """What is asked of an element."""

    @property
    def name(self) -> str:
        """Unique in the ring."""

    @property
    def k1(self) -> float:
        """1/m2."""

    @property
    def family(self) -> str:
        """Name without its number."""

    @property
    def kind(self) -> str:
        """As in `lattice.ring.Kind`."""

    @property
    def length(self) -> float:
        """m."""

    @property
    def angle(self) -> float:
        """rad."""

    @property
    def tilt(self) -> float:
        """rad."""


BODIES = frozenset({"quadrupole", "bend", "sextupole", "octupole", "multipole"})
THIN = 1e-6
"""m; what is shorter neither parts two pieces nor is one."""
EDGE = 0.02
"""Of the length of the magnet that a piece belongs to."""


def slices_of(elements: Sequence[Piece]) -> dict[int, tuple[int, ...]]:
    """For every magnet in pieces: the place of the longest, and those of all, in beam order."""
    found = {}
    for run in _touching(elements):
        longest = max(elements[i].length for i in run)
        bodies = [i for i in run if elements[i].length > EDGE * longest]
        magnets: list[list[int]] = []
        for i in bodies:
            if magnets and _same(elements[magnets[-1][-1]], elements[i]):
                magnets[-1].append(i)
            else:
                magnets.append([i])
        for i in run:
            if i not in bodies:  # the edge of the magnet before it, or of the first
                before = [m for m in magnets if m[0] < i]
                (before[-1] if before else magnets[0]).append(i)
        for magnet in magnets:
            if len(magnet) > 1:
                main = max(magnet, key=lambda i: elements[i].length)
                found[main] = tuple(sorted(magnet))
    return found


def _touching(elements: Sequence[Piece]) -> Iterator[list[int]]:
    thick = [i for i, element in enumerate(elements) if abs(element.length) >= THIN]
    for are_bodies, run in groupby(thick, lambda i: elements[i].kind in BODIES):
        if are_bodies:
            yield list(run)


def _same(a: Piece, b: Piece) -> bool:
    if a.kind == b.kind == "bend":
        return a.angle * b.angle > 0 and a.tilt == b.tilt
    families = a.family.casefold(), b.family.casefold()
    return a.kind == b.kind and families[1] in (families[0], f"{families[0]}_2")


def stem(name: str) -> str:
    """What the names of magnets of one supply begin with: up to the first underscore, dot or
    `::`."""
    return re.split(r"_|\.|::", name, maxsplit=1)[0].casefold()


def bodies(
    elements: Sequence[Piece],
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
    elements: Sequence[Piece], whole: Mapping[int, tuple[int, ...]]
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
