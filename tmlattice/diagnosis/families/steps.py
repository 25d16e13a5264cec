"""Families of errors of a hierarchical fit of an orbit response: each is one object.

To add one, write a class with its places, prior and derivatives, and with how its values enter the
errors and are reported as causes (`family.Family`; those of fields in the ring are in `fields`).
Add it to `STEPS`, which is the order of the trials.

Families with the same numbers (single gradients, and gradients of whole families) share a
`variable`: their priors add up.
"""

from abc import abstractmethod
from dataclasses import replace

import numpy as np

from tmlattice.arrays import Array
from tmlattice.diagnosis.families.dispersion import (
    HorizontalKicks,
    HorizontalOrbit,
    VerticalKicks,
    VerticalOrbit,
)
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
from tmlattice.effects import Cause, Hypothesis, Monitors, expected_spread, find
from tmlattice.inference.priors import Group
from tmlattice.lattice.slices import families
from tmlattice.observe.orbit_response import DELTA, Errors, Predicted
from tmlattice.observe.response_data import ResponseData

USUAL_OFFSET = 1e-3
"""Prior rms: an orbit of a millimetre where the dispersion is a metre."""
WIDENED, UNKNOWN_SPREAD = 2.0, 1.5e-3
"""Largest ratio of the energy spread to that of radiation (instabilities, wigglers without a field
in the lattice), as rms; and the usual spread without radiation."""


class _OfBeam(Family):
    """One number of the beam that acts on all columns."""

    block, per = 0, "ring"

    def size(self, data: ResponseData) -> int:
        return 1

    @abstractmethod
    def change(self, at: Predicted) -> Array:
        """Orbit changes of the beam at the stated kicks, m, [column, monitor, 2]."""

    def rows(self, at: Predicted, values: Array) -> Array:
        scale = (1 + at.errors.calibration)[:, None, None]
        return np.asarray((at.gain(0) * at.data.pick(self.change(at) * scale))[None])


class EnergyOffset(_OfBeam):
    """The beam's energy relative to that of the magnets' settings, by an RF frequency that does not
    match the circumference. It is nearly degenerate with gradients, kicks and orbits in sextupoles
    together, and would be biased by them while they are far from the ring."""

    name, effects = "energy_offset", ("energy_offset",)
    variable, trust, late = "energy", 1e-3, True

    def groups(self, data: ResponseData) -> list[Group]:
        """The usual prior."""
        return [Group(self.name, np.eye(1), USUAL_OFFSET, fixed=True)]

    def change(self, at: Predicted) -> Array:
        """The first derivative by the energy."""
        return at.chromatic

    def put(self, errors: Errors, values: Array, data: ResponseData) -> Errors:
        """The errors with this energy."""
        return replace(errors, energy=float(values[0]))

    def doubt(self, values: Array, data: ResponseData) -> str | None:
        """The message that so large an offset is implausible; None where it is plausible."""
        offset, most = float(values[0]), find(self.name).largest
        if abs(offset) <= most:
            return None
        return (
            f"the fitted energy offset of {100 * offset:.2g} % exceeds the plausible "
            f"{100 * most:.2g} %: the family is rejected"
        )

    def moves(self, data: ResponseData) -> list[dict[Hypothesis, float]]:
        """The effect's own unit."""
        return [{(self.name, None): 1.0}]


class EnergySpread(_OfBeam):
    """The mean square energy deviation of the beam, in units of `DELTA` squared."""

    name, effects = "energy_spread", ("energy_spread",)
    variable, trust = "spread", 10.0

    def groups(self, data: ResponseData) -> list[Group]:
        """The largest plausible spread as prior."""
        return [Group(self.name, np.eye(1), (self._most(data) / DELTA) ** 2, fixed=True)]

    def _most(self, data: ResponseData) -> float:
        return WIDENED * (expected_spread(data.ring) or UNKNOWN_SPREAD)

    def change(self, at: Predicted) -> Array:
        """The second derivative by the energy."""
        return at.curved

    def lowest(self, data: ResponseData) -> Array | float:
        """Zero: a square is not negative."""
        return 0.0

    def put(self, errors: Errors, values: Array, data: ResponseData) -> Errors:
        """The errors with this spread."""
        return replace(errors, spread=float(values[0]))

    def causes_of(
        self, errors: Errors, values: Array, sigma: Array, data: ResponseData
    ) -> list[StatedCause]:
        """The relative rms as a cause; none where it is zero."""
        if not values[0] > 0:
            return []
        amount = DELTA * float(np.sqrt(values[0]))
        return [(Cause("energy_spread", None, amount), DELTA**2 * float(sigma[0]) / (2 * amount))]

    def doubt(self, values: Array, data: ResponseData) -> str | None:
        """The message that so large a spread is implausible; None where it is plausible."""
        rms, most = DELTA * float(np.sqrt(values[0])), self._most(data)
        if not rms > most:
            return None
        usual = "radiation makes" if expected_spread(data.ring) else "a beam has usually"
        return (
            f"the fitted energy spread is {100 * rms:.2g} %, where {usual} "
            f"{100 * most / WIDENED:.2g} %: the family is rejected"
        )

    def moves(self, data: ResponseData) -> list[dict[Hypothesis, float]]:
        """The square of the amount."""
        return [{("energy_spread", None): DELTA**2}]


class _Monitors(Family):
    per, rms, tails = "monitor", 0.01, TAILS

    def size(self, data: ResponseData) -> int:
        return 2 * len(data.at)

    def rows(self, at: Predicted, values: Array) -> Array:
        return at.data.pick(at.kicked)


class MonitorGain(_Monitors):
    """Gains of BPMs, x and y of each, with a common mean in each plane."""

    name, effects = "monitor_gain", ("monitor_gain_x", "monitor_gain_y")
    block, variable, trust, gross = 0, "gain", 0.01, 0.5

    def groups(self, data: ResponseData) -> list[Group]:
        """Priors of single BPMs and of all BPMs of a plane."""
        alike = np.zeros((self.size(data), 2))
        alike[0::2, 0] = alike[1::2, 1] = 1
        return [*super().groups(data), Group(f"{self.name} of a plane", alike, 0.03, fixed=True)]

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


class MonitorRoll(_Monitors):
    """The cross-talk of a BPM's planes: roll and coupling."""

    name, effects = "monitor_roll", ("monitor_roll", "monitor_coupling")
    block, variable, trust = 1, "mixing", 0.02

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
        own = np.maximum(np.abs(1 + monitors.gain), LEAST_KICK)
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
    per, tails = "column", TAILS

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
    block, variable, trust, gross, rms = 0, "calibration", 0.01, 0.3, 0.02

    def groups(self, data: ResponseData) -> list[Group]:
        """The priors of single correctors and of families."""
        kinds = families([*data.measured.correctors, "\0"])[1]
        return [*super().groups(data), Group(f"{self.name} of families", kinds, 0.05)]

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
    block, variable, trust, gross, rms = 1, "roll", 0.02, 0.1, 0.01

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


Trial = tuple[Family, ...]
"""Families that are tried together; the block of the first one determines by which readings."""

STEPS: tuple[Trial, ...] = (
    (CorrectorCalibration(), FamilyGradient()), (MonitorGain(),), (QuadrupoleGradient(),),
    (BendGradient(),), (VerticalFocusing(),), (EdgeFocusing(),), (CorrectorPosition(),),
    (EnergySpread(),), (MonitorRoll(),), (CorrectorRoll(),), (SkewGradient(),),
    (HorizontalOrbit(),), (VerticalOrbit(),), (HorizontalKicks(),), (EnergyOffset(),),
    (VerticalKicks(),),
)  # fmt: skip
"""The trials. The first ones determine the optics. Implausible ones are rejected last first."""

CHANGES: tuple[Trial, ...] = (
    (CorrectorCalibration(),), (MonitorGain(),),
    (FamilyGradient(), QuadrupoleGradient(), OtherGradient(), FocusingChange()),
    (MonitorRoll(),), (CorrectorRoll(),), (SkewGradient(),),
)  # fmt: skip
"""Families that may change between two measurements of one ring."""
