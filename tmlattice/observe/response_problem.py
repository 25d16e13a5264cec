"""An orbit response as an inference sees it: few causes, each with its amount, and no nuisances.

>>> problem = Response(base=Predicted(data, Errors.none(data)).bend(), used=rows.used, places={})
>>> explain(Search(problem, hypotheses(data), unnamed=False), fit(problem, (), NOTHING))

A held-out corrector is not among the rows; the kick of a fitted one is known, so that its
calibration is a cause like any other.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from tmlattice.effects import Cause, find, modelled
from tmlattice.errors import UnstableRingError
from tmlattice.inference.metric import Hypothesis, Metric
from tmlattice.inference.problem import NO_KICKS, Kicks, Point, Problem
from tmlattice.inference.whitening import Projection
from tmlattice.observe.orbit_response import Predicted, ResponseData

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

NOTHING = np.zeros(0)
"""The nuisances of an orbit response."""

LEAST = 0.01
"""A gain this near to zero has no signature on top of it."""

ROOM = 2**24
"""Numbers of signatures at a time."""


def single_causes(data: ResponseData, effects: Sequence[str] | None = None) -> list[Hypothesis]:
    """What may be wrong alone: effects that a response sees, at every place of the ring.

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
        if effect.responds:
            found += [
                (name, place)
                for place in effect.places(data.ring)
                if effect.group not in ("monitors", "correctors") or place in measured
            ]
    return found


@dataclass(frozen=True, kw_only=True)
class Response(Problem):
    """Measured orbit changes in a ring with what is known of it.

    Attributes:
        base: what is known, see `Predicted`.
        used: readings that are fitted, [column, monitor, 2].
    """

    base: Predicted = field(repr=False)
    used: Flags = field(repr=False)

    def whitened(self, readings: Array) -> Array:
        """[..., column, monitor, 2] in units of the noise, [..., row]."""
        return np.asarray((readings / self.base.data.noise)[..., self.used])

    # --- the model ------------------------------------------------------------------------------
    def at(self, causes: Sequence[Cause], nuisances: Array, kicks: Kicks = NO_KICKS) -> Point:
        """`view` is a `Predicted`."""
        there = self.base.with_causes((*self.fixed, *causes))
        projection: Projection | None = Projection(np.zeros((1, int(self.used.sum()), 0)))
        lost = ""
        try:
            read = there.read
            residual = self.whitened(self.base.data.orbits - read)
        except UnstableRingError:
            read, residual = np.zeros(self.used.shape), np.full(int(self.used.sum()), np.nan)
            projection, lost = None, "the ring has no closed orbit"
        return Point(tuple(causes), nuisances, dict(kicks), residual, projection, read, there, lost)

    def slope(self, point: Point, cause: int) -> Array:
        """In closed form: the signature is of the same effect on top of what is there."""
        own = point.causes[cause]
        effect, amount = find(own.effect), own.amount
        if effect.multiplies and abs(1 + amount) < LEAST:
            return self._difference(point, cause, LEAST)
        (slope,) = point.view.signatures([(own.effect, own.element)])
        chain = (
            1 / (1 + amount) if effect.multiplies else effect.power * amount ** (effect.power - 1)
        )
        return self.whitened(chain * slope)

    def _difference(self, point: Point, cause: int, h: float) -> Array:
        own = point.causes[cause]
        ends = [
            self.at(
                (*point.causes[:cause], replace(own, amount=own.amount + side),
                 *point.causes[cause + 1 :]), point.nuisances,
            ).residual
            for side in (h, -h)
        ]  # fmt: skip
        return np.asarray((ends[1] - ends[0]) / (2 * h))

    def moved(self, nuisances: Array, change: Array) -> Array:
        """There are none."""
        return nuisances

    def metric(self, point: Point) -> Metric:
        """Every signature in closed form."""
        return _ResponseMetric(self, point)

    def neighbours(self, hypothesis: Hypothesis, among: Sequence[Hypothesis]) -> list[Hypothesis]:
        """A response is linear enough in all of them."""
        return []

    # --- what has no name -----------------------------------------------------------------------
    @property
    def kick_places(self) -> Sequence[str]:
        """A closed orbit's change knows no free kick."""
        return ()

    def kick_rows(self, point: Point, place: int) -> Array:
        """None."""
        raise NotImplementedError

    @property
    def monitors(self) -> Sequence[str]:
        """Of the measurement."""
        return self.base.data.measured.monitors

    # --- readings -------------------------------------------------------------------------------
    @property
    def valid(self) -> Flags:
        """[column, monitor, 2]."""
        return self.used

    def owner(self) -> NDArray[np.int64]:
        """The monitor of each reading."""
        return np.broadcast_to(np.arange(self.used.shape[1])[:, None], self.used.shape)

    def left(self, point: Point) -> tuple[Array, Array]:
        """Nothing is taken out."""
        rows = np.zeros(self.used.shape)
        rows[self.used] = point.residual
        return rows, np.ones(self.used.shape)

    def without(self, dropped: Flags) -> "Response":
        """The same with these missing."""
        return replace(self, used=self.used & ~dropped)


class _ResponseMetric(Metric):
    def __init__(self, problem: Response, point: Point) -> None:
        assert point.projection is not None
        super().__init__(point.projection)
        self.problem, self.point = problem, point
        self.chunk = max(ROOM // max(len(point.residual), 1), 1)

    def rows(self, hypotheses: Sequence[Hypothesis]) -> Array:
        out = np.empty((len(hypotheses), len(self.point.residual)))
        for row, slope in zip(out, self.point.view.signatures(hypotheses), strict=True):
            row[:] = self.problem.whitened(slope)
        return out
