"""Families of errors of a hierarchical fit of an orbit response: each is one object.

To add one, write a class with its places, prior and derivatives, and with how its values enter the
errors and are reported as causes (`family.Family`; those of fields in the ring are in `fields`, of
the beam's energy in `energy`). Add it to `STEPS`, which is the order of the trials.

Families with the same numbers (single gradients, and gradients of whole families) share a
`variable`: their priors add up.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tmlattice.diagnosis.families.dispersion import HorizontalKicks, VerticalKicks
from tmlattice.diagnosis.families.energy import EnergyOffset, EnergySpread
from tmlattice.diagnosis.families.family import TAILS, Family, StatedCause
from tmlattice.diagnosis.families.fields import (
    BendGradient,
    CorrectorPosition,
    EdgeFocusing,
    FamilyGradient,
    FocusingChange,
    OtherGradient,
    QuadrupoleGradient,
    SkewGradient,
    VerticalFocusing,
)
from tmlattice.effects import Cause, Monitors
from tmlattice.inference.priors import Group
from tmlattice.lattice.alike import families
from tmlattice.observe.orbit_response import Errors, Hypothesis, Predicted
from tmlattice.observe.response_data import ResponseData

Array = NDArray[np.float64]


class _Monitors(Family):
    per = "monitor"

    def size(self, data: ResponseData) -> int:
        return 2 * len(data.at)

    def rows(self, at: Predicted, values: Array) -> Array:
        return at.data.pick(at.kicked)

    def _own(self, data: ResponseData) -> Group:
        return Group(self.name, np.eye(self.size(data)), 0.01, TAILS)


class MonitorGain(_Monitors):
    """Gains of BPMs, x and y of each, with a common mean in each plane."""

    name, effects = "monitor_gain", ("monitor_gain_x", "monitor_gain_y")
    block, variable, trust, gross = 0, "gain", 0.01, 0.5

    def groups(self, data: ResponseData) -> list[Group]:
        """Priors of single BPMs and of all BPMs of a plane."""
        alike = np.zeros((self.size(data), 2))
        alike[0::2, 0] = alike[1::2, 1] = 1
        return [self._own(data), Group(f"{self.name} of a plane", alike, 0.03, fixed=True)]

    def put(self, errors: Errors, values: Array, data: ResponseData) -> Errors:
        """The diagonals of the BPMs' matrices."""
        monitors = errors.monitors.copy()
        monitors[:, [0, 1], [0, 1]] = 1 + values.reshape(-1, 2)
        return replace(errors, monitors=monitors)

    def causes_of(
        self, errors: Errors, values: Array, sigma: Array, data: ResponseData
    ) -> list[StatedCause]:
        """Causes: all of x, then all of y."""
        names, gain = data.measured.monitors, Monitors.of(errors.monitors).gain
        return [
            (Cause(f"monitor_gain_{p}", name, float(gain[i, j])), float(sigma[2 * i + j]))
            for j, p in enumerate("xy")
            for i, name in enumerate(names)
        ]

    def moves(self, data: ResponseData) -> list[dict[Hypothesis, float]]:
        """One number per BPM and plane."""
        return [{(effect, name): 1.0} for name in data.measured.monitors for effect in self.effects]


LEAST_GAIN = 1e-3
"""Least gain in the errors of rolls."""


class MonitorRoll(_Monitors):
    """The cross-talk of a BPM's planes: roll and coupling."""

    name, effects = "monitor_roll", ("monitor_roll", "monitor_coupling")
    block, variable, trust = 1, "mixing", 0.02

    def groups(self, data: ResponseData) -> list[Group]:
        """One number per BPM and plane."""
        return [self._own(data)]

    def put(self, errors: Errors, values: Array, data: ResponseData) -> Errors:
        """The off-diagonals of the BPMs' matrices."""
        monitors = errors.monitors.copy()
        monitors[:, [0, 1], [1, 0]] = values.reshape(-1, 2)
        return replace(errors, monitors=monitors)

    def causes_of(
        self, errors: Errors, values: Array, sigma: Array, data: ResponseData
    ) -> list[StatedCause]:
        """Causes: for small values x reads (coupling + roll) y, and y reads (coupling - roll) x."""
        monitors = Monitors.of(errors.monitors)
        own = np.maximum(np.abs(1 + monitors.gain), LEAST_GAIN)
        spread = np.hypot(*(sigma.reshape(-1, 2) / own).T) / 2
        return [
            (Cause(effect, name, float(amount[i])), float(spread[i]))
            for i, name in enumerate(data.measured.monitors)
            for effect, amount in zip(self.effects, (monitors.roll, monitors.coupling), strict=True)
        ]

    def moves(self, data: ResponseData) -> list[dict[Hypothesis, float]]:
        """The share of y in x, then of x in y."""
        roll, coupling = self.effects
        return [
            {(roll, name): side / 2, (coupling, name): 0.5}
            for name in data.measured.monitors
            for side in (1, -1)
        ]


LEAST_KICK = 1e-3
"""Least kick, relative to the stated one, in the errors of rolls."""


class _Columns(Family):
    per = "column"

    def size(self, data: ResponseData) -> int:
        return len(data.kicks)

    def count(self, data: ResponseData) -> int:
        return len(data.kicks) - 1  # the RF step is exact

    def moves(self, data: ResponseData) -> list[dict[Hypothesis, float]]:
        """One number per corrector; none of the RF."""
        own: list[dict[Hypothesis, float]] = [
            {(self.name, name): 1.0} for name in data.measured.correctors
        ]
        return [*own, {}]

    def _causes_of(self, values: Array, sigma: Array, data: ResponseData) -> list[StatedCause]:
        names = data.measured.correctors
        return [
            (Cause(self.name, name, float(v)), float(s))
            for name, v, s in zip(names, values, sigma, strict=False)
        ]


class CorrectorCalibration(_Columns):
    """Calibrations of correctors, with priors of single ones and of families."""

    name, effects = "corrector_calibration", ("corrector_calibration",)
    block, variable, trust, gross = 0, "calibration", 0.01, 0.3

    def groups(self, data: ResponseData) -> list[Group]:
        """The priors of single correctors and of families."""
        kinds = families([*data.measured.correctors, "\0"])[1]
        return [
            Group(self.name, np.eye(self.size(data)), 0.02, TAILS),
            Group(f"{self.name} of families", kinds, 0.05),
        ]

    def rows(self, at: Predicted, values: Array) -> Array:
        """The column itself; 0 for the RF."""
        out = at.gain(0) * at.data.pick(at.beam)
        out[-1] = 0
        return out

    def put(self, errors: Errors, values: Array, data: ResponseData) -> Errors:
        """The errors with these calibrations."""
        return replace(errors, calibration=values)

    def causes_of(
        self, errors: Errors, values: Array, sigma: Array, data: ResponseData
    ) -> list[StatedCause]:
        """The calibration of the whole kick; a rolled corrector has a part in the other plane."""
        return self._causes_of(errors.kick - 1, sigma, data)


class CorrectorRoll(_Columns):
    """Rolls of correctors."""

    name, effects = "corrector_roll", ("corrector_roll",)
    block, variable, trust, gross = 1, "roll", 0.02, 0.1

    def groups(self, data: ResponseData) -> list[Group]:
        """One number per corrector."""
        return [Group(self.name, np.eye(self.size(data)), 0.01, TAILS)]

    def rows(self, at: Predicted, values: Array) -> Array:
        """The kick in the other plane."""
        return np.asarray(at.gain(1) * at.data.pick(at.across, 1))

    def put(self, errors: Errors, values: Array, data: ResponseData) -> Errors:
        """The errors with these kicks in the other plane, as a share of the stated kick."""
        return replace(errors, roll=values)

    def causes_of(
        self, errors: Errors, values: Array, sigma: Array, data: ResponseData
    ) -> list[StatedCause]:
        """The angle of the kick to the corrector's plane, up to 90 degrees."""
        return self._causes_of(
            errors.angle, sigma / np.maximum(np.abs(errors.kick), LEAST_KICK), data
        )


@dataclass(frozen=True)
class Trial:
    """Families that are tried together.

    Attributes:
        families: the block of the first one determines which readings validate them.
        own, across: rounds in-plane, and rounds of coupling before them.
    """

    families: tuple[Family, ...]
    own: int
    across: int


STEPS = (
    Trial((CorrectorCalibration(), FamilyGradient()), 3, 0),
    Trial((MonitorGain(),), 2, 0),
    Trial((QuadrupoleGradient(),), 4, 0),
    Trial((BendGradient(),), 2, 0),
    Trial((VerticalFocusing(),), 2, 0),
    Trial((EdgeFocusing(),), 2, 0),
    Trial((CorrectorPosition(),), 2, 0),
    Trial((EnergySpread(),), 2, 0),
    Trial((MonitorRoll(),), 0, 1),
    Trial((CorrectorRoll(),), 0, 1),
    Trial((SkewGradient(),), 2, 2),
    Trial((HorizontalKicks(),), 2, 0),
    Trial((EnergyOffset(),), 2, 0),
    Trial((VerticalKicks(),), 0, 2),
)
"""The trials, in order. Skew gradients move the tunes to second order, which the gradients correct.
The energy offset changes the dispersion, and comes after the kicks that do so, too."""

CHANGES = (
    Trial((CorrectorCalibration(),), 3, 0),
    Trial((MonitorGain(),), 2, 0),
    Trial((FamilyGradient(), QuadrupoleGradient(), OtherGradient(), FocusingChange()), 4, 0),
    Trial((MonitorRoll(),), 0, 1),
    Trial((CorrectorRoll(),), 0, 1),
    Trial((SkewGradient(),), 2, 2),
)
"""Families that may change between two measurements of one ring."""
