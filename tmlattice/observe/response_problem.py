"""An orbit response as an inference problem: a sparse set of causes, and no nuisances.

>>> problem = Response(base=Predicted(data, Errors.none(data)).bend(), used=rows.used, places={})
>>> explain(Search(problem, hypotheses(data), unnamed=False), fit(problem, (), problem.first))

A held-out corrector has no rows. The kick of a fitted one is known, so that its calibration is a
cause like any other.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from tmlattice.effects import Cause, LaunchEffect, RingEffect, find, modelled
from tmlattice.inference.metric import Hypothesis, Metric
from tmlattice.inference.problem import Point
from tmlattice.observe.orbit_response import Predicted
from tmlattice.observe.response_data import ResponseData
from tmlattice.observe.response_metric import ResponseMetric
from tmlattice.observe.steady import NOTHING, Steady

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]


def single_causes(data: ResponseData, effects: Sequence[str] | None = None) -> list[Hypothesis]:
    """Return hypotheses of single causes: effects on a response, at every place of the ring.

    A kick is one of them, by its orbit in the sextupoles.

    Args:
        data: monitors and correctors that were not measured are excluded.
        effects: names; None: all usual ones.

    Raises:
        UnknownNameError: an effect that does not exist.
    """
    m = data.measured
    measured = {data.ring[name].name for name in (*m.monitors, *m.correctors)}
    found: list[Hypothesis] = []
    for name in modelled(effects):
        effect = find(name)
        if effect.responds or isinstance(effect, RingEffect):
            found += [
                (name, place)
                for place in effect.places(data.ring)
                if effect.group not in ("monitors", "correctors") or place in measured
            ]
    return found


@dataclass(frozen=True, kw_only=True)
class Response(Steady):
    """Measured orbit changes in a ring with known errors.

    Attributes:
        base: prediction with the known errors, see `Predicted`.
        used: fitted readings, [column, monitor, 2].
    """

    base: Predicted = field(repr=False)

    @property
    def first(self) -> Array:
        """No nuisances."""
        return NOTHING

    @property
    def values(self) -> Array:
        """Orbit changes, m, [column, monitor, 2]."""
        return self.base.data.orbits

    @property
    def sigma(self) -> Array:
        """Noise, m, [monitor, 2]."""
        return self.base.data.noise

    def sees(self, hypothesis: Hypothesis) -> bool:
        """Whether a cause acts on a closed orbit; of the beam's, the energies do."""
        effect = find(hypothesis[0])
        return effect.responds or not isinstance(effect, LaunchEffect)

    def view(self, causes: Sequence[Cause]) -> Predicted:
        """Return the prediction with these causes."""
        return self.base.with_causes(causes)

    def read(self, view: Predicted, nuisances: Array) -> Array:
        """Predicted readings, m, [column, monitor, 2]."""
        return view.read

    def signatures(
        self, view: Predicted, nuisances: Array, hypotheses: Sequence[Hypothesis]
    ) -> Array:
        """Signatures, m, [hypothesis, column, monitor, 2]."""
        out = np.empty((len(hypotheses), *self.used.shape))
        for row, slope in zip(out, view.signatures(hypotheses), strict=True):
            row[:] = slope
        return out

    def metric(self, point: Point) -> Metric:
        """Return products from factors."""
        return ResponseMetric(self, point)

    @property
    def monitors(self) -> Sequence[str]:
        """Monitors of the measurement."""
        return self.base.data.measured.monitors

    def owner(self) -> NDArray[np.int64]:
        """Monitor of each reading."""
        return np.broadcast_to(np.arange(self.used.shape[1])[:, None], self.used.shape)
