"""Magnets that stand in several pieces: many files cut them, and a magnet is repaired as one.

Pieces touch: nothing with a length lies between them (monitors, markers and thin correctors may).
Touching bends that bend the same way are one dipole. Touching quadrupoles, or sextupoles, are one
magnet where they have one family (or are the halves NAME and NAME_2 that `marked` makes). A piece
shorter than a fiftieth of its neighbour is an edge of it, whatever its field.
"""

import re
from collections.abc import Iterator, Sequence
from itertools import groupby
from typing import Protocol


class Piece(Protocol):
    """What is asked of an element."""

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
