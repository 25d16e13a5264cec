"""Readings of a stored beam, predicted all at once.

A kind of measurement gives its readings of a ring with causes (`view`, `read`), their derivatives
(`signatures`), and its nuisances (`directions`). The rest of a `Problem` is here.
"""

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Self

import numpy as np

from tmlattice.arrays import Array, Flags
from tmlattice.effects import Cause, find
from tmlattice.effects.effect import MIN_STRENGTH
from tmlattice.errors import UnstableRingError
from tmlattice.inference.metric import Hypothesis, Metric
from tmlattice.inference.problem import NO_KICKS, Kicks, Point, Problem
from tmlattice.inference.whitening import Projection

NOTHING = np.zeros(0)
"""Nuisances of a kind without any."""


@dataclass(frozen=True, kw_only=True)
class Steady(Problem):
    """Readings of a stored beam.

    Attributes:
        used: fitted readings, of the kind's own shape.
        values, sigma: measured readings, and their noise, of compatible shapes.
    """

    used: Flags = field(repr=False)
    values: Array = field(repr=False)
    sigma: Array = field(repr=False)

    @abstractmethod
    def view(self, causes: Sequence[Cause]) -> Any:
        """Return the ring with these causes.

        Raises:
            UnstableRingError: no stored beam.
        """

    @abstractmethod
    def read(self, view: Any, nuisances: Array) -> Array:
        """Predicted readings, of the kind's shape."""

    @abstractmethod
    def signatures(self, view: Any, nuisances: Array, hypotheses: Sequence[Hypothesis]) -> Array:
        """d readings / d amount ** power of one cause more, [hypothesis, ...]; of a discrete effect
        its change, of an invisible one zero."""

    def directions(self, view: Any, nuisances: Array) -> Array:
        """d readings / d nuisance, [nuisance, ...]; here none."""
        return np.zeros((0, *self.used.shape))

    # --- the model ------------------------------------------------------------------------------
    @property
    def first(self) -> Array:
        """First guess of the nuisances; here none."""
        return NOTHING

    def at(self, causes: Sequence[Cause], nuisances: Array, kicks: Kicks = NO_KICKS) -> Point:
        """Return the model's point, lost without a stored beam."""
        count = int(self.used.sum())
        view, read, lost = None, np.zeros(self.used.shape), ""
        residual = np.full(count, np.nan)
        projection: Projection | None = None
        try:
            view = self.view((*self.fixed, *causes))
            read = self.read(view, nuisances)
            residual = self.as_rows(self.values - read)
            projection = Projection(self.as_rows(self.directions(view, nuisances)).T[None])
        except UnstableRingError:
            lost = "the ring has no closed orbit"
        return Point(tuple(causes), nuisances, dict(kicks), residual, projection, read, view, lost)

    def slope(self, point: Point, cause: int) -> Array:
        """Slope in closed form: the signature of the same effect on top of the present amount."""
        own = point.causes[cause]
        effect, amount = find(own.effect), own.amount
        if effect.multiplies and abs(1 + amount) < MIN_STRENGTH:
            return self._difference(point, cause, MIN_STRENGTH)
        (slope,) = self.signatures(point.view, point.nuisances, [(own.effect, own.element)])
        return self.as_rows(effect.chain(amount) * slope)

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
        """Return the nuisances after a change; they are linear."""
        return nuisances + change.reshape(nuisances.shape)

    def metric(self, point: Point) -> Metric:
        """Return products of closed-form signatures."""
        return SteadyMetric(self, point)

    def neighbours(self, hypothesis: Hypothesis, among: Sequence[Hypothesis]) -> list[Hypothesis]:
        """Return no neighbours: a stored beam is linear enough in all of them."""
        return []

    # --- readings -------------------------------------------------------------------------------
    @property
    def valid(self) -> Flags:
        """Fitted readings, of the kind's shape."""
        return self.used

    def as_rows(self, readings: Array) -> Array:
        """Rows of the fitted readings, in units of the noise."""
        scaled = readings / self.sigma
        if self.used.all():
            return np.asarray(scaled.reshape(*scaled.shape[: -self.used.ndim], self.used.size))
        return np.asarray(scaled[..., self.used])

    def left(self, point: Point) -> tuple[Array, Array]:
        """Residuals over noise and variances of 1: nuisances absorb a small share of a reading."""
        assert point.projection is not None
        rows = np.zeros(self.used.shape)
        rows[self.used] = point.projection.out(point.residual)
        return rows, np.ones(self.used.shape)

    def without(self, dropped: Flags) -> Self:
        """Return the problem without some readings."""
        return replace(self, used=self.used & ~dropped)


class SteadyMetric(Metric):
    """Products at one point, with the kind's signatures."""

    def __init__(self, problem: Steady, point: Point) -> None:
        assert point.projection is not None
        super().__init__(point.projection)
        self.problem, self.point = problem, point

    def rows(self, hypotheses: Sequence[Hypothesis]) -> Array:
        """See `Metric.rows`."""
        point = self.point
        return self.problem.as_rows(
            self.problem.signatures(point.view, point.nuisances, hypotheses)
        )

    def free_monitors(self, clean: Array) -> tuple[Array, Array]:
        """Information of all readings of each monitor, and product with data."""
        owner = self.problem.owner()[self.problem.used]
        count = len(self.problem.monitors)
        most = int(np.bincount(owner[owner >= 0], minlength=count).max(initial=1))
        gram, inner = np.zeros((count, 1, most, most)), np.zeros((count, 1, most))
        (Q,) = self.projection.Q
        for m in range(count):
            own = np.flatnonzero(owner == m)
            k = len(own)
            gram[m, 0, :k, :k] = np.eye(k) - Q[own] @ Q[own].T
            inner[m, 0, :k] = clean[own]
        return gram, inner
