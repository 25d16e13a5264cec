"""Families of errors that a dense fit of an orbit response may have: each is one object.

To add one, write a class with its places, prior, rows, how its values are put among the errors and
how they are told as causes; and name it in `STEPS`, which says when it is tried.

Families that move the same numbers (single gradients, and gradients of whole families) share a
`variable`: their priors add up.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from tmlattice.diagnosis.magnets import families, magnets, straights
from tmlattice.effects import Cause
from tmlattice.inference.priors import Group
from tmlattice.lattice import Element, Ring
from tmlattice.observe.orbit_response import DELTA, Errors, Predicted, ResponseData

Array = NDArray[np.float64]
Told = tuple[Cause, float]
"""A cause and the posterior rms of its amount."""

TAILS = 4.0
"""Degree of freedom of priors with tails: one magnet in a hundred may be far off."""
LARGEST_GRADIENT = 0.02
"""Prior rms that one magnet may have at most, relative: a larger error is a broken magnet."""
LARGEST_SKEW = 5e-4  # 1/m: half a millimetre of orbit in a sextupole


class Family(ABC):
    """One kind of error, at all of its places.

    Attributes:
        name: in options and logs; its priors' names begin so.
        effects: of the catalogue, that it is told as.
        block: 0 in-plane, 1 coupling.
        per: whose numbers they are: "monitor", "column" or "ring".
        variable: the numbers that it moves; families that share one add up.
        trust: rms by which one round may move a number.
        gross: a column's number that is larger starts from what the column alone says: rounds
            would take long to go there, and the column meanwhile counts for nothing.
    """

    name: ClassVar[str]
    effects: ClassVar[tuple[str, ...]]
    block: ClassVar[int]
    per: ClassVar[str]
    variable: ClassVar[str]
    trust: ClassVar[float]
    gross: ClassVar[float] = np.inf

    @property
    def title(self) -> str:
        """Its effects, for people."""
        return ", ".join(self.effects)

    @abstractmethod
    def size(self, data: ResponseData) -> int:
        """How many numbers its variable has."""

    @abstractmethod
    def groups(self, data: ResponseData) -> list[Group]:
        """Its priors, over the variable's numbers."""

    @abstractmethod
    def rows(self, at: Predicted, values: Array) -> Array:
        """What readings of its block do, m: [number, column, monitor], or per column, or monitor,
        each reading's own number alone, [column, monitor]."""

    @abstractmethod
    def put(self, errors: Errors, values: Array, data: ResponseData) -> Errors:
        """Errors with these, instead of none."""

    @abstractmethod
    def told(self, errors: Errors, values: Array, sigma: Array, data: ResponseData) -> list[Told]:
        """As causes, with errors."""

    def count(self, data: ResponseData) -> int:
        """Parameters, for people."""
        return self.size(data)

    def bounded(self, values: Array) -> Array:
        """Values that can be."""
        return values


class _Monitors(Family):
    per = "monitor"

    def size(self, data: ResponseData) -> int:
        return 2 * len(data.at)

    def rows(self, at: Predicted, values: Array) -> Array:
        return at.data.pick(at.kicked)

    def _own(self, data: ResponseData) -> Group:
        return Group(self.name, np.eye(self.size(data)), 0.01, TAILS)


class MonitorGain(_Monitors):
    """Gains, x and y of each monitor: free but for a mean of each plane."""

    name, effects = "monitor_gain", ("monitor_gain_x", "monitor_gain_y")
    block, variable, trust = 0, "gain", 0.01

    def groups(self, data: ResponseData) -> list[Group]:
        """Each its own, and those of a plane alike."""
        alike = np.zeros((self.size(data), 2))
        alike[0::2, 0] = alike[1::2, 1] = 1
        return [self._own(data), Group(f"{self.name} of a plane", alike, 0.03, fixed=True)]

    def put(self, errors: Errors, values: Array, data: ResponseData) -> Errors:
        """On the diagonals."""
        monitors = errors.monitors.copy()
        monitors[:, [0, 1], [0, 1]] = 1 + values.reshape(-1, 2)
        return replace(errors, monitors=monitors)

    def told(self, errors: Errors, values: Array, sigma: Array, data: ResponseData) -> list[Told]:
        """All of x, then all of y."""
        names = data.measured.monitors
        return [
            (Cause(f"monitor_gain_{p}", name, float(values[2 * i + j])), float(sigma[2 * i + j]))
            for j, p in enumerate("xy")
            for i, name in enumerate(names)
        ]


class MonitorRoll(_Monitors):
    """What each plane of a monitor reads of the other: roll and coupling."""

    name, effects = "monitor_roll", ("monitor_roll", "monitor_coupling")
    block, variable, trust = 1, "mixing", 0.02

    def groups(self, data: ResponseData) -> list[Group]:
        """Each its own."""
        return [self._own(data)]

    def put(self, errors: Errors, values: Array, data: ResponseData) -> Errors:
        """Beside the diagonals."""
        monitors = errors.monitors.copy()
        monitors[:, [0, 1], [1, 0]] = values.reshape(-1, 2)
        return replace(errors, monitors=monitors)

    def told(self, errors: Errors, values: Array, sigma: Array, data: ResponseData) -> list[Told]:
        """x reads (coupling + roll) y, y reads (coupling - roll) x."""
        gain = np.diagonal(errors.monitors, axis1=1, axis2=2)
        x, y = (values.reshape(-1, 2) / gain).T
        spread = np.hypot(*sigma.reshape(-1, 2).T) / 2
        return [
            (Cause(effect, name, float(amount[i])), float(spread[i]))
            for i, name in enumerate(data.measured.monitors)
            for effect, amount in zip(self.effects, ((x - y) / 2, (x + y) / 2), strict=True)
        ]


class _Columns(Family):
    per = "column"

    def size(self, data: ResponseData) -> int:
        return len(data.kicks)

    def count(self, data: ResponseData) -> int:
        return len(data.kicks) - 1  # the RF's step is known

    def _told(self, values: Array, sigma: Array, data: ResponseData) -> list[Told]:
        names = data.measured.correctors
        return [
            (Cause(self.name, name, float(v)), float(s))
            for name, v, s in zip(names, values, sigma, strict=False)
        ]


class CorrectorCalibration(_Columns):
    """Each its own, and what correctors of a family share."""

    name, effects = "corrector_calibration", ("corrector_calibration",)
    block, variable, trust, gross = 0, "calibration", 0.01, 0.3

    def groups(self, data: ResponseData) -> list[Group]:
        """Of each, and of families."""
        kinds = families([*data.measured.correctors, "\0"])[1]
        return [
            Group(self.name, np.eye(self.size(data)), 0.02, TAILS),
            Group(f"{self.name} of families", kinds, 0.05),
        ]

    def rows(self, at: Predicted, values: Array) -> Array:
        """The column itself."""
        out = at.gain(0) * at.data.pick(at.beam)
        out[-1] = 0
        return out

    def put(self, errors: Errors, values: Array, data: ResponseData) -> Errors:
        """As it stands."""
        return replace(errors, calibration=values)

    def told(self, errors: Errors, values: Array, sigma: Array, data: ResponseData) -> list[Told]:
        """As it stands."""
        return self._told(values, sigma, data)


class CorrectorRoll(_Columns):
    """Rolls of correctors."""

    name, effects = "corrector_roll", ("corrector_roll",)
    block, variable, trust, gross = 1, "roll", 0.02, 0.1

    def groups(self, data: ResponseData) -> list[Group]:
        """Of each."""
        return [Group(self.name, np.eye(self.size(data)), 0.01, TAILS)]

    def rows(self, at: Predicted, values: Array) -> Array:
        """The kick in the other plane."""
        return np.asarray(at.gain(1) * at.data.pick(at.across, 1))

    def put(self, errors: Errors, values: Array, data: ResponseData) -> Errors:
        """The kick in the other plane, as a share of what the corrector is told."""
        return replace(errors, roll=values)

    def told(self, errors: Errors, values: Array, sigma: Array, data: ResponseData) -> list[Told]:
        """As a share of what it kicks."""
        return self._told(values / (1 + errors.calibration), sigma, data)


class _Magnets(Family):
    per = "ring"
    effect: ClassVar[str]

    @abstractmethod
    def shares(self, data: ResponseData) -> list[dict[str, float]]:
        """Of each magnet: its pieces, and what each of them has of the magnet's number."""

    def places(self, data: ResponseData) -> list[str]:
        """Each magnet's first piece."""
        return [next(iter(pieces)) for pieces in self.shares(data)]

    def size(self, data: ResponseData) -> int:
        return len(self.shares(data))

    def rows(self, at: Predicted, values: Array) -> Array:
        shares = self.shares(at.data)
        pairs = [(self.effect, place) for pieces in shares for place in pieces]
        gain, slopes = at.gain(self.block), at.slopes(pairs)
        out = np.zeros((len(shares), *at.data.shape))
        for i, pieces in enumerate(shares):
            for share in pieces.values():
                out[i] += share * at.data.pick(next(slopes), self.block)
            out[i] *= gain
        return out

    def put(self, errors: Errors, values: Array, data: ResponseData) -> Errors:
        causes = tuple(
            Cause(self.effect, place, share * float(value))
            for pieces, value in zip(self.shares(data), values, strict=True)
            for place, share in pieces.items()
            if value
        )
        return replace(errors, ring=(*errors.ring, *causes))

    def told(self, errors: Errors, values: Array, sigma: Array, data: ResponseData) -> list[Told]:
        """Of every piece."""
        return [
            (Cause(self.effect, place, share * float(value)), share * float(error))
            for pieces, value, error in zip(self.shares(data), values, sigma, strict=True)
            for place, share in pieces.items()
        ]


class QuadrupoleGradient(_Magnets):
    """Gradients of single quadrupoles, relative to the design's."""

    name = effect = "quadrupole_gradient"
    effects: ClassVar[tuple[str, ...]] = ("quadrupole_gradient",)
    block, variable, trust = 0, "gradient", 0.01

    def shares(self, data: ResponseData) -> list[dict[str, float]]:
        """Those that have a gradient."""
        return [{e.name: 1.0 for e in own} for own in magnets(data.ring, ("quadrupole",), True)]

    def groups(self, data: ResponseData) -> list[Group]:
        """Of each."""
        eye = np.eye(self.size(data))
        return [Group(self.name, eye, 3e-3, TAILS, most=LARGEST_GRADIENT)]

    def rows(self, at: Predicted, values: Array) -> Array:
        """Relative to the design's strength, not to the one found."""
        return super().rows(at, values) / (1 + values)[:, None, None]


class FamilyGradient(QuadrupoleGradient):
    """What quadrupoles of a family share: their supply's error."""

    name = "family_gradient"
    effects: ClassVar[tuple[str, ...]] = ("family_gradient",)

    def count(self, data: ResponseData) -> int:
        """Families."""
        return len(families(self.places(data))[0])

    def groups(self, data: ResponseData) -> list[Group]:
        """Of families."""
        kinds = families(self.places(data))[1]
        return [Group("quadrupole_gradient of families", kinds, 0.01)]


class _Thin(_Magnets):
    """Integrated fields, each piece with its share of the magnet's length."""

    def _places(self, ring: Ring) -> list[tuple[Element, ...]]:
        return magnets(ring, ("quadrupole",))

    def shares(self, data: ResponseData) -> list[dict[str, float]]:
        out = []
        for own in self._places(data.ring):
            whole = sum(e.length for e in own)
            out.append({e.name: e.length / whole if whole else 1 / len(own) for e in own})
        return out


class SkewGradient(_Thin):
    """Skew gradients in quadrupoles."""

    name = effect = "skew_gradient"
    effects: ClassVar[tuple[str, ...]] = ("skew_gradient",)
    block, variable, trust = 1, "skew", 3e-4  # 1/m: larger steps move the tunes

    def groups(self, data: ResponseData) -> list[Group]:
        """Of each."""
        return [Group(self.name, np.eye(self.size(data)), 3e-4, TAILS, most=LARGEST_SKEW)]


class OtherGradient(_Thin):
    """Gradients beside the quadrupoles: of the orbit in sextupoles, of wigglers."""

    name = effect = "gradient_absolute"
    effects: ClassVar[tuple[str, ...]] = ("gradient_absolute",)
    block, variable, trust = 0, "other", 3e-3

    def _places(self, ring: Ring) -> list[tuple[Element, ...]]:
        return magnets(ring, ("sextupole", "wiggler"))

    def groups(self, data: ResponseData) -> list[Group]:
        """Of each."""
        return [Group(self.name, np.eye(self.size(data)), 1e-4, TAILS)]


class VerticalFocusing(_Thin):
    """Of insertion devices, in wigglers and in straights."""

    name = effect = "vertical_focusing"
    effects: ClassVar[tuple[str, ...]] = ("vertical_focusing",)
    block, variable, trust = 0, "device", 3e-3

    def _places(self, ring: Ring) -> list[tuple[Element, ...]]:
        devices = [*magnets(ring, ("wiggler",)), *((e,) for e in straights(ring))]
        return sorted(devices, key=lambda own: own[0].s)

    def groups(self, data: ResponseData) -> list[Group]:
        """Of each."""
        return [Group(self.name, np.eye(self.size(data)), 1e-4, 1.0)]


class EnergySpread(Family):
    """Of the beam: mean square energy deviation, in units of `DELTA` squared."""

    name, effects = "energy_spread", ("energy_spread",)
    block, per, variable, trust = 0, "ring", "spread", 10.0

    def size(self, data: ResponseData) -> int:
        """One."""
        return 1

    def groups(self, data: ResponseData) -> list[Group]:
        """Wide."""
        return [Group(self.name, np.eye(1), 10.0, fixed=True)]

    def rows(self, at: Predicted, values: Array) -> Array:
        """The second derivative by the energy."""
        scale = (1 + at.errors.calibration)[:, None, None]
        return np.asarray((at.gain(0) * at.data.pick(at.curved * scale))[None])

    def bounded(self, values: Array) -> Array:
        """A square is not negative."""
        return np.maximum(values, 0.0)

    def put(self, errors: Errors, values: Array, data: ResponseData) -> Errors:
        """As it stands."""
        return replace(errors, spread=float(values[0]))

    def told(self, errors: Errors, values: Array, sigma: Array, data: ResponseData) -> list[Told]:
        """The relative rms; nothing where it is zero."""
        if not values[0] > 0:
            return []
        amount = DELTA * float(np.sqrt(values[0]))
        return [(Cause("energy_spread", None, amount), DELTA**2 * float(sigma[0]) / (2 * amount))]


@dataclass(frozen=True)
class Trial:
    """Families that are tried together.

    Attributes:
        families: the first one's block says who judges.
        own, across: rounds in-plane, and before them rounds of the other plane.
    """

    families: tuple[Family, ...]
    own: int
    across: int


STEPS = (
    Trial((CorrectorCalibration(), FamilyGradient()), 3, 0),
    Trial((MonitorGain(),), 2, 0),
    Trial((QuadrupoleGradient(),), 4, 0),
    Trial((EnergySpread(),), 2, 0),
    Trial((MonitorRoll(),), 0, 1),
    Trial((CorrectorRoll(),), 0, 1),
    Trial((SkewGradient(),), 2, 2),
)
"""What is tried, one after another. Skew gradients move the tunes to second order, which the
gradients then take back."""

CHANGES = (
    Trial((CorrectorCalibration(),), 3, 0),
    Trial((MonitorGain(),), 2, 0),
    Trial((FamilyGradient(), QuadrupoleGradient(), OtherGradient(), VerticalFocusing()), 4, 0),
    Trial((MonitorRoll(),), 0, 1),
    Trial((CorrectorRoll(),), 0, 1),
    Trial((SkewGradient(),), 2, 2),
)
"""What may have changed between two measurements of one ring."""
