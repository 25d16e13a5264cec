"""Families of errors of fields in the ring: gradients, skew gradients, vertical focusing.

All pieces of a magnet share one number.
"""

from abc import abstractmethod
from collections.abc import Iterable, Sequence
from itertools import pairwise
from typing import ClassVar

import numpy as np

from tmlattice.arrays import Array
from tmlattice.diagnosis.families.family import TAILS, RingFamily
from tmlattice.effects import Hypothesis
from tmlattice.inference.priors import Group
from tmlattice.lattice import Element, Ring
from tmlattice.lattice.slices import stem
from tmlattice.lattice.supplies import magnets, supplied_alike
from tmlattice.observe.orbit_response import Predicted
from tmlattice.observe.response_data import ResponseData

USUAL, REPRODUCED = 1e-2, 1e-4
"""Prior rms of a change, or of an error that magnets share, relative or in 1/m; and the relative
reproducibility of a magnet, twice that of a supply, below which changes are ignored."""
LARGEST_GRADIENT = 0.02
"""Largest prior rms of one magnet, relative: larger errors are faults."""
FURTHEST = 0.05
"""Largest prior rms of the displacement of a corrector's field, m: beyond is another corrector."""


class _Magnets(RingFamily):
    @abstractmethod
    def shares(self, data: ResponseData) -> list[dict[str, float]]:
        """The pieces of each magnet, and the share of each piece in the magnet's number."""

    def places(self, data: ResponseData) -> list[str]:
        """The first piece of each magnet."""
        return [next(iter(pieces)) for pieces in self.shares(data)]

    def moves(self, data: ResponseData) -> list[dict[Hypothesis, float]]:
        """The cause of every piece; the same in each round."""
        return data.ring.remembered(
            ("moves", type(self), data.measured.correctors),
            lambda: [
                {(self.effects[0], place): share for place, share in pieces.items()}
                for pieces in self.shares(data)
            ],
        )


def _by_type(each: Iterable[dict[str, float]]) -> list[dict[str, float]]:
    """The pieces of each type of magnet, from those of each magnet."""
    types: dict[str, dict[str, float]] = {}
    for pieces in each:
        types.setdefault(stem(next(iter(pieces))), {}).update(pieces)
    return list(types.values())


class QuadrupoleGradient(_Magnets):
    """Gradients of single quadrupoles, relative to the design's."""

    name, effects = "quadrupole_gradient", ("quadrupole_gradient",)
    block, variable, trust = 0, "gradient", 0.01
    rms, tails, most = 3e-3, TAILS, LARGEST_GRADIENT

    def shares(self, data: ResponseData) -> list[dict[str, float]]:
        """Quadrupoles that have a gradient."""
        return [{e.name: 1.0 for e in own} for own in magnets(data.ring, ("quadrupole",), True)]

    def units(self, values: Array) -> Array:
        """Factors from changes relative to the estimated gradients to changes of the design's."""
        return np.asarray(1 / (1 + values))


class FamilyGradient(QuadrupoleGradient):
    """The common error of a family's quadrupoles, by their supply."""

    name, effects = "family_gradient", ("family_gradient",)

    def moves(self, data: ResponseData) -> list[dict[Hypothesis, float]]:
        """The gradients of single quadrupoles, whose numbers it shares."""
        return QuadrupoleGradient().moves(data)

    def count(self, data: ResponseData) -> int:
        """Number of families."""
        return len(supplied_alike(data.ring)[0])

    def groups(self, data: ResponseData) -> list[Group]:
        """The prior of families."""
        return [Group("quadrupole_gradient of families", supplied_alike(data.ring)[1], 0.01)]


class _Thin(_Magnets):
    """Integrated fields; each piece has its share of the magnet's length."""

    kinds: ClassVar[tuple[str, ...]]

    def _places(self, ring: Ring) -> list[tuple[Element, ...]]:
        return magnets(ring, self.kinds)

    def shares(self, data: ResponseData) -> list[dict[str, float]]:
        out = []
        for own in self._places(data.ring):
            whole = sum(e.length for e in own)
            out.append({e.name: e.length / whole if whole else 1 / len(own) for e in own})
        return out


class BendGradient(_Magnets):
    """Gradients of combined-function bends, relative to the design's: one number per type."""

    name, effects = "bend_gradient", ("bend_gradient",)
    block, variable, trust = 0, "bend_gradient", 0.01
    rms = 3e-3

    def shares(self, data: ResponseData) -> list[dict[str, float]]:
        """The bends of each type: single ones are degenerate with neighbouring quadrupoles."""
        bends = magnets(data.ring, ("bend",), powered=True)
        return _by_type({e.name: e.k1 for e in own} for own in bends)


class SkewGradient(_Thin):
    """Skew gradients of rolled quadrupoles, and of sextupoles: by windings, or a vertical orbit."""

    name, effects = "skew_gradient", ("skew_gradient",)
    block, variable, trust = 1, "skew", 1e-3  # 1/m: larger steps move the tunes
    kinds = ("quadrupole", "sextupole")

    def groups(self, data: ResponseData) -> list[Group]:
        """The priors of quadrupoles and sextupoles, each with its scale."""
        kinds = np.array([own[0].kind for own in self._places(data.ring)])
        each = np.eye(len(kinds))
        return [
            Group(f"{self.name} of {kind}s", each[:, kinds == kind], 3e-4, TAILS)
            for kind in dict.fromkeys(kinds.tolist())
        ]


class OtherGradient(_Thin):
    """Gradients outside quadrupoles: by the orbit in sextupoles, and of wigglers."""

    name, effects = "gradient_absolute", ("gradient_absolute",)
    block, variable, trust = 0, "other", 3e-3
    rms, tails = 1e-4, TAILS
    kinds = ("sextupole", "wiggler")


class VerticalFocusing(_Thin):
    """Gradients of insertion devices, in wigglers and in straights."""

    name, effects = "vertical_focusing", ("vertical_focusing",)
    block, variable, trust = 0, "device", 3e-3
    rms, tails = 1e-4, 1.0

    @property
    def title(self) -> str:
        """The name of its effect, and where: `EdgeFocusing` has the same effect."""
        return f"{self.name} in straights"

    def _places(self, ring: Ring) -> list[tuple[Element, ...]]:
        return self._devices(ring, straights(ring))

    def _devices(self, ring: Ring, ways: Sequence[Element]) -> list[tuple[Element, ...]]:
        devices = [*magnets(ring, ("wiggler",)), *((e,) for e in ways)]
        return sorted(devices, key=lambda own: own[0].s)

    def lowest(self, data: ResponseData) -> Array | float:
        """Zero in straights, because a device focuses; a wiggler of the design may focus less."""
        kinds = [data.ring[place].kind for place in self.places(data)]
        return np.where([kind == "wiggler" for kind in kinds], -np.inf, 0.0)


class FocusingChange(VerticalFocusing):
    """Changes of the focusing of devices, without lower bounds: an opened device focuses less. They
    include straights next to wigglers of bends, whose focusing has no other number."""

    def _places(self, ring: Ring) -> list[tuple[Element, ...]]:
        return self._devices(ring, straights(ring, next_to_wigglers=True))

    def lowest(self, data: ResponseData) -> Array | float:
        """No bounds."""
        return -np.inf


class EdgeFocusing(_Thin):
    """Vertical focusing of dipoles, by their edges and fringe fields: one number per type.

    Both edges of a rectangular magnet together focus by angle^2 / length, those of a sector magnet
    not at all. Errors are hardly larger than that, and negligible for small angles.
    """

    name, effects = "edge_focusing", ("vertical_focusing",)
    block, variable, trust, single = 0, "edge", 3e-3, False
    kinds = ("bend",)

    def shares(self, data: ResponseData) -> list[dict[str, float]]:
        """The bends of each type: single ones have no edge errors of their own."""
        return _by_type(super().shares(data))

    def groups(self, data: ResponseData) -> list[Group]:
        """The prior of types, relative to a rectangular magnet's edges."""
        ring = data.ring
        largest = []
        for pieces in self.shares(data):
            bends = [own for own in self._places(ring) if own[0].name in pieces]
            # magnet by magnet: the poles of a wiggler bend both ways
            squares = sum(sum(e.angle for e in own) ** 2 for own in bends)
            length = sum(e.length for own in bends for e in own)
            largest.append(squares / length if length else 0.0)
        return [Group(self.name, np.diag(largest), 0.1, most=1.0)]


class CorrectorPosition(_Magnets):
    """Positions of correctors' fields: one number for all correctors of a plane between the same
    two families of magnets, whose iron shifts their fields alike.

    A single corrector there has no number, because no other one could confirm it.
    """

    name, effects = "corrector_position", ("corrector_position",)
    block, variable, trust = 0, "position", 0.02
    rms, most = 5e-3, FURTHEST

    def shares(self, data: ResponseData) -> list[dict[str, float]]:
        """The correctors of each number."""
        measured = data.measured
        alike: dict[str, dict[str, float]] = {}
        where = between(data.ring, measured.correctors, measured.planes)
        for name, own in zip(measured.correctors, where, strict=True):
            alike.setdefault(own, {})[name] = 1.0
        return [correctors for correctors in alike.values() if len(correctors) > 1]

    def rows(self, at: Predicted, values: Array) -> Array:
        """The orbit jump in the corrector's own column."""
        data = at.data
        kicks = data.kicks * (1 + at.errors.calibration)
        jump = -at.gain(0) * data.pick(at.jumps) * kicks[:, None]
        column = {name: c for c, name in enumerate(data.measured.correctors)}
        shares = self.shares(data)
        out = np.zeros((len(shares), *data.shape))
        for row, correctors in zip(out, shares, strict=True):
            own = [column[name] for name in correctors]
            row[own] = jump[own]
        return out


STRAIGHT = 1.0
"""Length of a straight, m, in which an insertion device is possible."""


def between(ring: Ring, correctors: Sequence[str], planes: Sequence[str]) -> list[str]:
    """Return the plane of each corrector, with the families of the magnets before and behind it.

    Args:
        ring: with the magnets.
        correctors: names.
        planes: "x" or "y", of each.
    """
    others = [e for e in ring.elements if _parts(e)]
    places = np.array([e.s for e in others])
    behind = np.searchsorted(places, [ring[name].s for name in correctors]) % len(others)
    return [
        f"{plane} {stem(others[i - 1].name)} {stem(others[i].name)}"
        for plane, i in zip(planes, behind, strict=True)
    ]


def straights(ring: Ring, next_to_wigglers: bool = False) -> list[Element]:
    """Return the marker nearest to the middle of each long straight, else its longest drift.

    A straight next to a wiggler of alternating bends has none, because its focusing is degenerate
    with the wiggler's own.

    Args:
        ring: the ring.
        next_to_wigglers: whether straights next to such a wiggler are included.
    """
    own = ring.elements
    parting = [i for i, e in enumerate(own) if _parts(e)]
    if not parting:
        return []
    # one turn from a magnet to itself: from no bend if possible, so that no wiggler is split
    first = min(parting, key=lambda i: own[i].kind == "bend")
    turn = [(e, e.s) for e in own[first:]] + [(e, e.s + ring.length) for e in own[: first + 1]]
    found, ways, bends = list[Element](), list[Element](), list[float]()
    at = [i for i, (element, _) in enumerate(turn) if _parts(element)]
    for i, j in pairwise(at):
        (before, start), (behind, end) = turn[i], turn[j]
        start, end = start + before.length / 2, end - behind.length / 2
        if end - start > STRAIGHT:
            ways += _middle(turn[i + 1 : j], (start + end) / 2)
        if before.kind == "bend":
            bends.append(before.angle)
        if behind.kind == "bend" and j != at[-1]:
            continue
        if next_to_wigglers or not (bends and min(bends) < 0 < max(bends)):
            found += ways
        ways, bends = [], []
    return found


def _parts(element: Element) -> bool:
    """Whether an element separates two straights."""
    return element.is_magnet and not element.is_corrector


def _middle(within: Sequence[tuple[Element, float]], middle: float) -> list[Element]:
    """The place in a straight, of its elements and their s, m."""
    markers = [own for own in within if own[0].kind == "marker"]
    if markers:
        return [min(markers, key=lambda own: abs(own[1] - middle))[0]]
    drifts = [e for e, _ in within if e.kind == "drift" and e.length >= STRAIGHT / 2]
    return [max(drifts, key=lambda e: e.length)] if drifts else []
