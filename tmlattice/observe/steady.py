"""What a stored beam tells: readings that are predicted at once, whatever made them.

A kind of measurement says what it reads of a ring with causes (`view`, `read`), what one cause more
would do (`signatures`), and which nuisances it has (`directions`). The rest of a `Problem` is here.
"""

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from tmlattice.effects import Cause, find
from tmlattice.effects.effect import LEAST_LEFT
from tmlattice.errors import UnstableRingError
from tmlattice.inference.metric import Hypothesis, Metric
from tmlattice.inference.problem import NO_KICKS, Kicks, Point, Problem
from tmlattice.inference.whitening import Projection

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

NOTHING = np.zeros(0)
"""The nuisances of a kind that has none."""

ROOM = 2**24
"""Numbers of signatures at a time."""


@dataclass(frozen=True, kw_only=True)
class Steady(Problem):
    """Readings of a stored beam.

    Attributes:
        used: those that are fitted, of the kind's own shape.
    """

    used: Flags = field(repr=False)

    @property
    @abstractmethod
    def values(self) -> Array:
        """What was read, of the kind's shape."""

    @property
    @abstractmethod
    def sigma(self) -> Array:
        """Noise of each, of a shape that fits."""

    @abstractmethod
    def view(self, causes: Sequence[Cause]) -> Any:
        """The ring with these.

        Raises:
            UnstableRingError: no stored beam.
        """

    @abstractmethod
    def read(self, view: Any, nuisances: Array) -> Array:
        """What the monitors tell there, of the kind's shape."""

    @abstractmethod
    def signatures(self, view: Any, nuisances: Array, hypotheses: Sequence[Hypothesis]) -> Array:
        """d readings / d amount ** power of one cause more, [hypothesis, ...]; of what is discrete
        the whole change; zero of what the kind does not see."""

    def directions(self, view: Any, nuisances: Array) -> Array:
        """d readings / d nuisance, [nuisance, ...]; here there are none."""
        return np.zeros((0, *self.used.shape))

    # --- the model ------------------------------------------------------------------------------
    def at(self, causes: Sequence[Cause], nuisances: Array, kicks: Kicks = NO_KICKS) -> Point:
        """Without a stored beam the point is lost."""
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
        """In closed form: the signature is of the same effect on top of what is there."""
        own = point.causes[cause]
        effect, amount = find(own.effect), own.amount
        if effect.multiplies and abs(1 + amount) < LEAST_LEFT:
            return self._difference(point, cause, LEAST_LEFT)
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
        """They are linear."""
        return nuisances + change.reshape(nuisances.shape)

    def metric(self, point: Point) -> Metric:
        """Every signature in closed form."""
        return SteadyMetric(self, point)

    def neighbours(self, hypothesis: Hypothesis, among: Sequence[Hypothesis]) -> list[Hypothesis]:
        """A stored beam is linear enough in all of them."""
        return []

    # --- readings -------------------------------------------------------------------------------
    @property
    def valid(self) -> Flags:
        """Of the kind's shape."""
        return self.used

    def as_rows(self, readings: Array) -> Array:
        """In units of the noise, what is not used left out."""
        scaled = readings / self.sigma
        if self.used.all():
            return np.asarray(scaled.reshape(*scaled.shape[: -self.used.ndim], self.used.size))
        return np.asarray(scaled[..., self.used])

    def left(self, point: Point) -> tuple[Array, Array]:
        """What nuisances take is a small share of any reading."""
        assert point.projection is not None
        rows = np.zeros(self.used.shape)
        rows[self.used] = point.projection.out(point.residual)
        return rows, np.ones(self.used.shape)

    def without(self, dropped: Flags) -> Self:
        """The same with these missing."""
        return replace(self, used=self.used & ~dropped)


class SteadyMetric(Metric):
    """Products about one point, signatures as the kind gives them."""

    def __init__(self, problem: Steady, point: Point) -> None:
        assert point.projection is not None
        super().__init__(point.projection)
        self.problem, self.point = problem, point
        self.chunk = int(np.clip(ROOM // max(problem.used.size, 1), 1, 512))

    def rows(self, hypotheses: Sequence[Hypothesis]) -> Array:
        """See `Metric.rows`."""
        point = self.point
        return self.problem.as_rows(
            self.problem.signatures(point.view, point.nuisances, hypotheses)
        )

    def free_monitors(self, clean: Array) -> tuple[Array, Array]:
        """All readings of a monitor free: information, and product with data."""
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
