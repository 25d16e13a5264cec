"""Families of errors of fields in the ring: gradients, skew gradients, vertical focusing.

All pieces of a magnet share one number.
"""

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from tmlattice.diagnosis.families.family import TAILS, Family, StatedCause
from tmlattice.diagnosis.families.ways import between, straights
from tmlattice.effects import Cause
from tmlattice.inference.priors import Group
from tmlattice.lattice import Element, Ring
from tmlattice.lattice.slices import stem
from tmlattice.lattice.supplies import magnets, supplied_alike
from tmlattice.observe.orbit_response import Errors, Hypothesis, Predicted
from tmlattice.observe.response_data import ResponseData

Array = NDArray[np.float64]

LARGEST_GRADIENT = 0.02
"""Largest prior rms of one magnet, relative: larger errors are faults."""
FURTHEST = 0.05
"""Largest prior rms of the displacement of a corrector's field, m: beyond is another corrector."""


class _Magnets(Family):
    per = "ring"
    effect: ClassVar[str]

    @abstractmethod
    def shares(self, data: ResponseData) -> list[dict[str, float]]:
        """The pieces of each magnet, and the share of each piece in the magnet's number."""

    def places(self, data: ResponseData) -> list[str]:
        """The first piece of each magnet."""
        return [next(iter(pieces)) for pieces in self.shares(data)]

    def size(self, data: ResponseData) -> int:
        return len(self.shares(data))

    def rows(self, at: Predicted, values: Array) -> Array:
        shares = self.shares(at.data)
        pairs = [(self.effect, place) for pieces in shares for place in pieces]
        gain, slopes = at.gain(self.block), at.slopes_of(self.block, pairs)
        out = np.empty((len(shares), *at.data.shape))
        for own, pieces, unit in zip(out, shares, self.units(values), strict=True):
            first, *others = pieces.values()
            np.multiply(next(slopes), first * unit * gain, out=own)
            for share in others:
                np.add(own, next(slopes) * (share * unit * gain), out=own)
        return out

    def units(self, values: Array) -> Array:
        """Derivative of each gradient error by its number."""
        return np.ones(len(values))

    def put(self, errors: Errors, values: Array, data: ResponseData) -> Errors:
        causes = tuple(
            Cause(self.effect, place, share * float(value))
            for pieces, value in zip(self.shares(data), values, strict=True)
            for place, share in pieces.items()
            if value
        )
        return replace(errors, ring=(*errors.ring, *causes))

    def causes_of(
        self, errors: Errors, values: Array, sigma: Array, data: ResponseData
    ) -> list[StatedCause]:
        """The amount of every piece."""
        return [
            (Cause(self.effect, place, share * float(value)), abs(share) * float(error))
            for pieces, value, error in zip(self.shares(data), values, sigma, strict=True)
            for place, share in pieces.items()
        ]

    def moves(self, data: ResponseData) -> list[dict[Hypothesis, float]]:
        """The cause of every piece."""
        return [
            {(self.effect, place): share for place, share in pieces.items()}
            for pieces in self.shares(data)
        ]


class QuadrupoleGradient(_Magnets):
    """Gradients of single quadrupoles, relative to the design's."""

    name = effect = "quadrupole_gradient"
    effects: ClassVar[tuple[str, ...]] = ("quadrupole_gradient",)
    block, variable, trust = 0, "gradient", 0.01

    def shares(self, data: ResponseData) -> list[dict[str, float]]:
        """Quadrupoles that have a gradient."""
        return [{e.name: 1.0 for e in own} for own in magnets(data.ring, ("quadrupole",), True)]

    def groups(self, data: ResponseData) -> list[Group]:
        """The prior of single quadrupoles."""
        eye = np.eye(self.size(data))
        return [Group(self.name, eye, 3e-3, TAILS, most=LARGEST_GRADIENT)]

    def units(self, values: Array) -> Array:
        """Factors from changes relative to the estimated gradients to changes of the design's."""
        return np.asarray(1 / (1 + values))


class FamilyGradient(QuadrupoleGradient):
    """The common error of a family's quadrupoles, by their supply."""

    name = "family_gradient"
    effects: ClassVar[tuple[str, ...]] = ("family_gradient",)

    def count(self, data: ResponseData) -> int:
        """Number of families."""
        return len(supplied_alike(data.ring)[0])

    def groups(self, data: ResponseData) -> list[Group]:
        """The prior of families."""
        return [Group("quadrupole_gradient of families", supplied_alike(data.ring)[1], 0.01)]


class _Thin(_Magnets):
    """Integrated fields; each piece has its share of the magnet's length."""

    def _places(self, ring: Ring) -> list[tuple[Element, ...]]:
        return magnets(ring, ("quadrupole",))

    def shares(self, data: ResponseData) -> list[dict[str, float]]:
        out = []
        for own in self._places(data.ring):
            whole = sum(e.length for e in own)
            out.append({e.name: e.length / whole if whole else 1 / len(own) for e in own})
        return out


class BendGradient(_Magnets):
    """Gradients of combined-function bends, relative to the design's: one number per type."""

    name = effect = "bend_gradient"
    effects: ClassVar[tuple[str, ...]] = ("bend_gradient",)
    block, variable, trust = 0, "bend_gradient", 0.01

    def shares(self, data: ResponseData) -> list[dict[str, float]]:
        """The bends of each type: single ones are degenerate with neighbouring quadrupoles."""
        types: dict[str, dict[str, float]] = {}
        for own in magnets(data.ring, ("bend",), powered=True):
            types.setdefault(stem(own[0].name), {}).update({e.name: e.k1 for e in own})
        return list(types.values())

    def groups(self, data: ResponseData) -> list[Group]:
        """The prior of types."""
        return [Group(self.name, np.eye(self.size(data)), 3e-3)]


class SkewGradient(_Thin):
    """Skew gradients of rolled quadrupoles, and of sextupoles: by windings, or a vertical orbit."""

    name = effect = "skew_gradient"
    effects: ClassVar[tuple[str, ...]] = ("skew_gradient",)
    block, variable, trust = 1, "skew", 1e-3  # 1/m: larger steps move the tunes

    def _places(self, ring: Ring) -> list[tuple[Element, ...]]:
        return magnets(ring, ("quadrupole", "sextupole"))

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

    name = effect = "gradient_absolute"
    effects: ClassVar[tuple[str, ...]] = ("gradient_absolute",)
    block, variable, trust = 0, "other", 3e-3

    def _places(self, ring: Ring) -> list[tuple[Element, ...]]:
        return magnets(ring, ("sextupole", "wiggler"))

    def groups(self, data: ResponseData) -> list[Group]:
        """The prior of sextupoles."""
        return [Group(self.name, np.eye(self.size(data)), 1e-4, TAILS)]


class VerticalFocusing(_Thin):
    """Gradients of insertion devices, in wigglers and in straights."""

    name = effect = "vertical_focusing"
    effects: ClassVar[tuple[str, ...]] = ("vertical_focusing",)
    block, variable, trust = 0, "device", 3e-3

    @property
    def title(self) -> str:
        """The name of its effect, and where: `EdgeFocusing` has the same effect."""
        return f"{self.effect} in straights"

    def _places(self, ring: Ring) -> list[tuple[Element, ...]]:
        return self._devices(ring, straights(ring))

    def _devices(self, ring: Ring, ways: Sequence[Element]) -> list[tuple[Element, ...]]:
        devices = [*magnets(ring, ("wiggler",)), *((e,) for e in ways)]
        return sorted(devices, key=lambda own: own[0].s)

    def groups(self, data: ResponseData) -> list[Group]:
        """The prior of each device."""
        return [Group(self.name, np.eye(self.size(data)), 1e-4, 1.0)]

    def lowest(self, data: ResponseData) -> Array | float:
        """Zero in straights, because a device focuses; a wiggler of the design may focus less."""
        kinds = [data.ring[place].kind for place in self.places(data)]
        return np.where([kind == "wiggler" for kind in kinds], -np.inf, 0.0)


class FocusingChange(VerticalFocusing):
    """Changes of the focusing of devices, without lower bounds: an opened device focuses less. They
    include straights next to wigglers of bends, whose focusing has no other number."""

    def _places(self, ring: Ring) -> list[tuple[Element, ...]]:
        return self._devices(ring, straights(ring, beside=True))

    def lowest(self, data: ResponseData) -> Array | float:
        """No bounds."""
        return -np.inf


class EdgeFocusing(_Thin):
    """Vertical focusing of dipoles, by their edges and fringe fields: one number per type.

    Both edges of a rectangular magnet together focus by angle^2 / length, those of a sector magnet
    not at all. Errors are hardly larger than that, and negligible for small angles.
    """

    name, effect = "edge_focusing", "vertical_focusing"
    effects: ClassVar[tuple[str, ...]] = ("vertical_focusing",)
    block, variable, trust = 0, "edge", 3e-3

    @property
    def largest(self) -> float:
        """Zero: bends of a type have the same edges, none can be faulty alone."""
        return 0.0

    def _places(self, ring: Ring) -> list[tuple[Element, ...]]:
        return magnets(ring, ("bend",))

    def shares(self, data: ResponseData) -> list[dict[str, float]]:
        """The bends of each type: single ones have no edge errors of their own."""
        types: dict[str, dict[str, float]] = {}
        for pieces in super().shares(data):
            types.setdefault(stem(next(iter(pieces))), {}).update(pieces)
        return list(types.values())

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

    name = effect = "corrector_position"
    effects: ClassVar[tuple[str, ...]] = ("corrector_position",)
    block, variable, trust = 0, "position", 0.02

    def shares(self, data: ResponseData) -> list[dict[str, float]]:
        """The correctors of each number."""
        measured = data.measured
        alike: dict[str, dict[str, float]] = {}
        where = between(data.ring, measured.correctors, measured.planes)
        for name, own in zip(measured.correctors, where, strict=True):
            alike.setdefault(own, {})[name] = 1.0
        return [correctors for correctors in alike.values() if len(correctors) > 1]

    def groups(self, data: ResponseData) -> list[Group]:
        """The prior of each number."""
        return [Group(self.name, np.eye(self.size(data)), 5e-3, most=FURTHEST)]

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
