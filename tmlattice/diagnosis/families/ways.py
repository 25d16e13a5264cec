"""Neighbouring magnets of correctors, and straights for insertion devices.

>>> [way.name for way in straights(ring)]
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from tmlattice.lattice import Element, Ring
from tmlattice.lattice.slices import stem

STRAIGHT = 1.0
"""Length of a straight, m, in which an insertion device is possible."""


def between(ring: Ring, correctors: Sequence[str], planes: Sequence[str]) -> list[str]:
    """Return the plane of each corrector, with the families of the magnets before and behind it.

    Args:
        ring: with the magnets.
        correctors: names.
        planes: "x" or "y", of each.
    """
    others = [e for e in ring.magnets if e.kind not in ("hcorrector", "vcorrector")]
    places = np.array([e.s for e in others])
    behind = np.searchsorted(places, [ring[name].s for name in correctors]) % len(others)
    return [
        f"{plane} {stem(others[i - 1].name)} {stem(others[i].name)}"
        for plane, i in zip(planes, behind, strict=True)
    ]


def straights(ring: Ring, beside: bool = False) -> list[Element]:
    """Return the marker nearest to the middle of each long straight, else its longest drift.

    A straight next to a wiggler of alternating bends has none, because its focusing is degenerate
    with the wiggler's own.

    Args:
        ring: the ring.
        `beside`: whether straights next to such a wiggler are included.
    """
    found, ways = list[Element](), list[Element]()
    within, bends = list[_Placed](), list[float]()
    begin = np.inf  # the first straight ends at the first magnet of the turn
    for element, s in _around(ring):
        if not _parts(element):
            within.append(_Placed(element, s))
            continue
        end = s - element.length / 2
        if end - begin > STRAIGHT:
            ways += _middle(within, (begin + end) / 2)
        within, begin = [], s + element.length / 2
        if element.kind == "bend":
            bends.append(element.angle)
            continue
        found += ways if beside else _outside(ways, bends)
        ways, bends = [], []
    return found + (ways if beside else _outside(ways, bends))


class _Placed(NamedTuple):
    element: Element
    s: float  # m, one turn further behind the lattice's first element


def _parts(element: Element) -> bool:
    """Whether an element separates two straights."""
    return element.is_magnet and element.kind not in ("hcorrector", "vcorrector")


def _around(ring: Ring) -> list[_Placed]:
    """One turn from a magnet to itself, both included; it starts at no bend if possible, so that a
    wiggler of alternating bends is not split."""
    own = ring.elements
    magnets = sorted(
        (i for i, e in enumerate(own) if _parts(e)), key=lambda i: (own[i].kind == "bend", i)
    )
    if not magnets:
        return []
    first = magnets[0]
    return [
        *(_Placed(e, e.s) for e in own[first:]),
        *(_Placed(e, e.s + ring.length) for e in own[: first + 1]),
    ]


def _outside(ways: Sequence[Element], bends: Sequence[float]) -> list[Element]:
    """Straights among these bends, without other magnets, except those of a wiggler."""
    return [] if bends and min(bends) < 0 < max(bends) else list(ways)


def _middle(within: Sequence[_Placed], middle: float) -> list[Element]:
    markers = [own for own in within if own.element.kind == "marker"]
    drifts = [
        own.element
        for own in within
        if own.element.kind == "drift" and own.element.length >= STRAIGHT / 2
    ]
    if markers:
        return [min(markers, key=lambda own: abs(own.s - middle)).element]
    return [max(drifts, key=lambda e: e.length)] if drifts else []
