"""Signal to noise: the finite change of all fit readings over their noise, launches projected out.

The noise is that of a reading, and of distributed errors if there are some: the change is then
measured in units of both (Mahalanobis), with a reference jointly with it.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from tmlattice.beam.model import Hypothesis, Model, Paths
from tmlattice.effects import Cause, Settings
from tmlattice.inference.whitening import Projection, Whitening
from tmlattice.lattice import Ring
from tmlattice.observe.data import Data

Array = NDArray[np.float64]

UNKNOWN_LAUNCH = (np.inf, np.inf, np.inf, np.inf, 0.0)


class Ruler:
    """Signal to noise of changes of readings.

    Args:
        ring: the design.
        launches: true ones, those of a reference first, [shot, 5].
        settings: of each shot.
        noise: rms of a reading, m.
        background: rms of distributed errors, by effect.
        reference: number of shots from before the fault.
    """

    def __init__(
        self,
        ring: Ring,
        launches: Array,
        settings: Sequence[Settings],
        noise: float,
        background: Mapping[str, float] | None = None,
        reference: int = 0,
    ) -> None:
        active = np.arange(len(launches)) >= reference
        self.model = Model(ring, settings, active=active)
        self.launches = launches
        paths = self.model.paths(launches)
        shape = paths.readings.shape
        spread = None
        if background:
            *_, spread = background_signatures(self.model, paths, launches, background)
        data = Data(
            np.zeros(shape),
            np.ones(shape, dtype=bool),
            np.full(shape, noise),
            launches,
            np.tile(UNKNOWN_LAUNCH, (len(launches), 1)),
            tuple(settings),
            1,
            active,
        )
        self._whitening = Whitening(data, spread)
        self._projection = Projection(self._whitening.launch(paths.launch))
        self._base = self.model.readings(launches)
        self._shape = shape
        self._reference = reference

    def size(self, change: Array) -> float:
        """Return that of a change of the readings after the fault, [shot, monitor, 2], m."""
        whole = np.zeros(self._shape)
        whole[self._reference :] = np.nan_to_num(change)
        rows = self._projection.out(self._whitening.signature(whole))
        return float(np.linalg.norm(rows))

    def of(self, causes: Sequence[Cause]) -> float:
        """Return that of causes by the model: fast, to find amounts."""
        change = self.model.readings(self.launches, causes) - self._base
        return self.size(change[self._reference :])


def background_signatures(
    model: Model, paths: Paths, launches: Array, rms: Mapping[str, float]
) -> tuple[list[Hypothesis], Array, Array]:
    """Return signatures of every distributed error along these trajectories.

    Args:
        model, paths, launches: the trajectories.
        rms: by effect.

    Returns:
        The errors; the rms of each, [error]; rms times signature, [error, shot, reading, 2], m.
    """
    hypotheses = model.hypotheses(list(rms))
    scale = np.array([rms[name] for name, _ in hypotheses])
    signatures = np.nan_to_num(model.signatures(paths, hypotheses, launches))
    return hypotheses, scale, scale[:, None, None, None] * signatures
