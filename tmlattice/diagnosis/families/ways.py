"""Where magnets stand: between which others, and ways on which an insertion device may hide.

>>> [way.name for way in straights(ring)]
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from tmlattice.lattice import Element, Ring
from tmlattice.lattice.slices import stem

STRAIGHT = 1.0
"""m; where so much way lies between two magnets an insertion device may stand."""


def between(ring: Ring, correctors: Sequence[str], planes: Sequence[str]) -> list[str]:
    """Of each corrector its plane and the families of the magnets before and behind it.

    Args:
        ring: where they stand.
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
    """Of every long way without a magnet the marker that is nearest to its middle, or the longest
    drift where no marker stands; wherever the lattice begins.

    A way beside a wiggler that the lattice has as bends to and fro has none: the wiggler's own
    focusing is a number already, and two beside it would pull against it.

    Args:
        ring: the ring.
        beside: ways beside such a wiggler too.
    """
    found, ways = list[Element](), list[Element]()
    within, bends = list[_Placed](), list[float]()
    begin = np.inf  # of the first way, which ends the last turn's
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
    s: float  # m, one turn further where the way to it goes through the lattice's first place


def _parts(element: Element) -> bool:
    """Whether the ways at its two ends are two."""
    return element.is_magnet and element.kind not in ("hcorrector", "vcorrector")


def _around(ring: Ring) -> list[_Placed]:
    """A turn from a magnet to itself, both of them in it: from one that is no bend, if one is, for
    bends to and fro are a wiggler."""
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
    """Ways among these bends, which no other magnet parts, but of a wiggler's."""
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
