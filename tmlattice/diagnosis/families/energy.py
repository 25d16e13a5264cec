"""Families of errors of the beam's energy: its mean and its spread."""

from abc import abstractmethod
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from tmlattice.diagnosis.families.family import Family, StatedCause
from tmlattice.effects import Cause, expected_spread, find
from tmlattice.inference.priors import Group
from tmlattice.observe.orbit_response import DELTA, Errors, Hypothesis, Predicted
from tmlattice.observe.response_data import ResponseData

Array = NDArray[np.float64]

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
    match the circumference."""

    name, effects = "energy_offset", ("energy_offset",)
    variable, trust = "energy", 1e-3

    def groups(self, data: ResponseData) -> list[Group]:
        """The usual prior."""
        return [Group(self.name, np.eye(1), USUAL_OFFSET, fixed=True)]

    def change(self, at: Predicted) -> Array:
        """The first derivative by the energy."""
        return at.chromatic

    def put(self, errors: Errors, values: Array, data: ResponseData) -> Errors:
        """The errors with this energy."""
        return replace(errors, energy=float(values[0]))

    def causes_of(
        self, errors: Errors, values: Array, sigma: Array, data: ResponseData
    ) -> list[StatedCause]:
        """The energy offset as a cause."""
        return [(Cause(self.name, None, float(values[0])), float(sigma[0]))]

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
