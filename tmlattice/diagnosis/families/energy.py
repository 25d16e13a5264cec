"""Families of errors of the beam's energies: their mean, and their spread."""

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
"""rms: a millimetre of orbit where the dispersion is a metre."""
WIDENED, UNKNOWN_SPREAD = 2.0, 1.5e-3
"""By how much a beam's energy spread may be more than radiation makes it (instabilities, wigglers
that the lattice has no field of), as rms; and what is usual where radiation says nothing."""


class _OfBeam(Family):
    """One number of the beam, that all columns have a part of."""

    block, per = 0, "ring"

    def size(self, data: ResponseData) -> int:
        return 1

    @abstractmethod
    def change(self, at: Predicted) -> Array:
        """Of the beam's orbit changes, correctors as they are told, m, [column, monitor, 2]."""

    def rows(self, at: Predicted, values: Array) -> Array:
        scale = (1 + at.errors.calibration)[:, None, None]
        return np.asarray((at.gain(0) * at.data.pick(self.change(at) * scale))[None])


class EnergyOffset(_OfBeam):
    """Of the beam from the energy that its magnets are set for: the RF's frequency does not fit to
    the way around the ring."""

    name, effects = "energy_offset", ("energy_offset",)
    variable, trust = "energy", 1e-3

    def groups(self, data: ResponseData) -> list[Group]:
        """As much as is usual."""
        return [Group(self.name, np.eye(1), USUAL_OFFSET, fixed=True)]

    def change(self, at: Predicted) -> Array:
        """The first derivative by the energy."""
        return at.chromatic

    def put(self, errors: Errors, values: Array, data: ResponseData) -> Errors:
        """As it stands."""
        return replace(errors, energy=float(values[0]))

    def causes_of(
        self, errors: Errors, values: Array, sigma: Array, data: ResponseData
    ) -> list[StatedCause]:
        """As it stands."""
        return [(Cause(self.name, None, float(values[0])), float(sigma[0]))]

    def doubt(self, values: Array, data: ResponseData) -> str | None:
        """No beam is stored so far off: it stands for something else."""
        offset, most = float(values[0]), find(self.name).largest
        if abs(offset) <= most:
            return None
        return (
            f"a beam {100 * offset:.2g} % off its energy would be asked for, where "
            f"{100 * most:.2g} % is much: it stands for something else, and is refused"
        )

    def moves(self, data: ResponseData) -> list[dict[Hypothesis, float]]:
        """Itself."""
        return [{(self.name, None): 1.0}]


class EnergySpread(_OfBeam):
    """Of the beam: mean square energy deviation, in units of `DELTA` squared."""

    name, effects = "energy_spread", ("energy_spread",)
    variable, trust = "spread", 10.0

    def groups(self, data: ResponseData) -> list[Group]:
        """As much as it can be."""
        return [Group(self.name, np.eye(1), (self._most(data) / DELTA) ** 2, fixed=True)]

    def _most(self, data: ResponseData) -> float:
        return WIDENED * (expected_spread(data.ring) or UNKNOWN_SPREAD)

    def change(self, at: Predicted) -> Array:
        """The second derivative by the energy."""
        return at.curved

    def lowest(self, data: ResponseData) -> Array | float:
        """A square is not negative."""
        return 0.0

    def put(self, errors: Errors, values: Array, data: ResponseData) -> Errors:
        """As it stands."""
        return replace(errors, spread=float(values[0]))

    def causes_of(
        self, errors: Errors, values: Array, sigma: Array, data: ResponseData
    ) -> list[StatedCause]:
        """The relative rms; nothing where it is zero."""
        if not values[0] > 0:
            return []
        amount = DELTA * float(np.sqrt(values[0]))
        return [(Cause("energy_spread", None, amount), DELTA**2 * float(sigma[0]) / (2 * amount))]

    def doubt(self, values: Array, data: ResponseData) -> str | None:
        """More than a beam has stands for something else of second order."""
        rms, most = DELTA * float(np.sqrt(values[0])), self._most(data)
        if not rms > most:
            return None
        usual = "radiation makes" if expected_spread(data.ring) else "a beam has usually"
        return (
            f"an energy spread of {100 * rms:.2g} % would be asked for, where {usual} "
            f"{100 * most / WIDENED:.2g} %: it stands for something else, and is refused"
        )

    def moves(self, data: ResponseData) -> list[dict[Hypothesis, float]]:
        """By the square of the amount."""
        return [{("energy_spread", None): DELTA**2}]
