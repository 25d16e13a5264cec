"""An orbit response as an inference sees it: few causes, each with its amount, and no nuisances.

>>> problem = Response(base=Predicted(data, Errors.none(data)).bend(), used=rows.used, places={})
>>> explain(Search(problem, hypotheses(data), unnamed=False), fit(problem, (), problem.first))

A held-out corrector is not among the rows; the kick of a fitted one is known, so that its
calibration is a cause like any other.
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
    """What may be wrong alone: effects that a response sees, at every place of the ring. It sees a
    kick too, by the orbit that this makes in the sextupoles.

    Args:
        data: monitors and correctors that were not measured are no places.
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
    """Measured orbit changes in a ring with what is known of it.

    Attributes:
        base: what is known, see `Predicted`.
        used: readings that are fitted, [column, monitor, 2].
    """

    base: Predicted = field(repr=False)

    @property
    def first(self) -> Array:
        """There are no nuisances."""
        return NOTHING

    @property
    def values(self) -> Array:
        """Orbit changes, m, [column, monitor, 2]."""
        return self.base.data.orbits

    @property
    def sigma(self) -> Array:
        """m, [monitor, 2]."""
        return self.base.data.noise

    def sees(self, hypothesis: Hypothesis) -> bool:
        """A closed orbit has no launch; of the beam it sees the energies."""
        effect = find(hypothesis[0])
        return effect.responds or not isinstance(effect, LaunchEffect)

    def view(self, causes: Sequence[Cause]) -> Predicted:
        """What monitors read with these."""
        return self.base.with_causes(causes)

    def read(self, view: Predicted, nuisances: Array) -> Array:
        """m, [column, monitor, 2]."""
        return view.read

    def signatures(
        self, view: Predicted, nuisances: Array, hypotheses: Sequence[Hypothesis]
    ) -> Array:
        """m, [hypothesis, column, monitor, 2]."""
        out = np.empty((len(hypotheses), *self.used.shape))
        for row, slope in zip(out, view.signatures(hypotheses), strict=True):
            row[:] = slope
        return out

    def metric(self, point: Point) -> Metric:
        """Through factors."""
        return ResponseMetric(self, point)

    @property
    def monitors(self) -> Sequence[str]:
        """Of the measurement."""
        return self.base.data.measured.monitors

    def owner(self) -> NDArray[np.int64]:
        """The monitor of each reading."""
        return np.broadcast_to(np.arange(self.used.shape[1])[:, None], self.used.shape)
