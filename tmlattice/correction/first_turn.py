"""Threading: steering an injected beam until it closes on itself.

The target is the trajectory of a beam that is launched on the axis, at the BPMs on two turns: if it
stays near the axis on both, it is closed.
"""

from collections.abc import Sequence
from copy import copy

import numpy as np
from numpy.typing import NDArray

from tmlattice.beam.model import Model
from tmlattice.correction.targets import TARGETS, THREADING, Weighted
from tmlattice.lattice import Ring

Array = NDArray[np.float64]
Hypothesis = tuple[str, str | None]

TURNS = 2
LOST = 0.1
"""m; reading of a lost beam. It is beyond any aperture, so that the first readings outside of one
still show the beam's direction."""


class Trajectory:
    """A beam that is launched on the axis of a ring.

    Attributes:
        values: at the BPMs on `TURNS` turns, m, [1, reading, plane]; `LOST` where it is lost.
        per_energy: 0: no RF acts on it.
    """

    per_energy = 0.0

    def __init__(self, ring: Ring) -> None:
        self._model = Model(ring, [{}], TURNS)
        paths = self._model.paths(np.zeros((1, 5)))
        beam = paths.beam[0]
        there = paths.states[0, self._model.where][:, [0, 2]]  # by maps that always have a value
        beam = np.where(np.isfinite(beam), beam, there)
        self._alive = np.cumsum(~(np.abs(beam) < LOST).all(axis=1)) == 0
        self._paths = paths
        self.values = np.where(self._alive[:, None], np.nan_to_num(beam), LOST)

    def moved(self, ring: Ring, frequency: float) -> "Trajectory":
        """Return that of a ring with other elements; the RF frequency has no effect."""
        return Trajectory(ring)

    def by_frequency(self) -> Array:
        """Return zeros, [1, reading, plane]."""
        return np.zeros((1, *self.values.shape))

    def derivatives(self, hypotheses: Sequence[Hypothesis]) -> Array:
        """Return the change per unit of effects on the ring, up to a loss of the beam, m."""
        found = self._model.signatures(self._paths, list(hypotheses), np.zeros((1, 5)))[:, 0]
        return np.where(self._alive[:, None], np.nan_to_num(found), 0.0)


class Threading(Weighted):
    """The trajectory of a beam that is launched on the axis, as the one target.

    Args:
        goal: for its BPMs.
        tolerance: rms, m; None: the usual one.
    """

    def __init__(self, goal: Ring, tolerance: float | None = None) -> None:
        self.names = (THREADING,)
        self.tolerance = {THREADING: tolerance or TARGETS[THREADING].tolerance}
        places = np.array([monitor.s for monitor in goal.monitors])
        self.s = np.concatenate([places + turn * goal.length for turn in range(TURNS)])

    def determined(self, undetermined: Array) -> "Threading":
        """Return the target whose readings count the less, the less the data determine them.

        Args:
            undetermined: standard deviation of each, m, [reading, plane].
        """
        found = copy(self)
        found.undetermined = undetermined
        return found

    def begin(self, ring: Ring, energy: float) -> Trajectory:
        """Return the trajectory of a ring; the injected beam's energy is the nominal one."""
        return Trajectory(ring)

    def errors(self, values: Array) -> dict[str, Array]:
        """Return errors by target, [reading, plane], m."""
        return {THREADING: values}

    def changes(self, derivatives: Array) -> dict[str, Array]:
        """Return the derivatives of `errors`."""
        return {THREADING: derivatives}
