"""Threading: steering a beam that is not stored, so that it comes round and closes.

The target is the trajectory of a beam that is launched on the axis, at the BPMs on two turns: a
trajectory that stays near the axis on both has come round, and has closed.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from tmlattice.beam.model import Model
from tmlattice.correction.targets import TARGETS, THREADING, Weighted
from tmlattice.lattice import Ring

Array = NDArray[np.float64]
Hypothesis = tuple[str, str | None]

TURNS = 2
LOST = 0.1
"""m: what a reading of a lost beam counts as. It is beyond any aperture, so that the first readings
outside of one still say where the beam went."""


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
        self._alive = np.cumsum(~(np.abs(beam) < LOST).all(axis=1)) == 0
        if not self._alive.all():  # behind, the maps have grown beyond all bounds
            behind = int(self._model.where[int(np.argmin(self._alive))]) + 1
            states, tangents = paths.states.copy(), paths.tangents.copy()
            states[:, behind:], tangents[:, behind:] = 0.0, np.eye(states.shape[-1])
            slopes = np.where(self._alive[:, None, None], paths.beam_launch, 0.0)
            paths = replace(paths, states=states, tangents=tangents, beam_launch=slopes)
        self._paths = paths
        self.values = np.where(self._alive[:, None], np.nan_to_num(beam), LOST)

    def moved(self, ring: Ring, frequency: float) -> "Trajectory":
        """Of a ring with other elements; an RF frequency has no part in it."""
        return Trajectory(ring)

    def by_frequency(self) -> Array:
        """Nothing, [1, reading, plane]."""
        return np.zeros((1, *self.values.shape))

    def derivatives(self, hypotheses: Sequence[Hypothesis]) -> Array:
        """Change per unit of effects on the ring, up to where the beam is lost, m."""
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

    def begin(self, ring: Ring, energy: float) -> Trajectory:
        """Of a ring; of the injected beam's energy nothing is known."""
        return Trajectory(ring)

    def errors(self, values: Array) -> dict[str, Array]:
        """By target, [reading, plane], m."""
        return {THREADING: values}

    def changes(self, derivatives: Array) -> dict[str, Array]:
        """The derivatives of `errors`."""
        return {THREADING: derivatives}
