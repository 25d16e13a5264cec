"""First turns: trajectories from launches of limited accuracy.

>>> problem = FirstTurns(model=Model(ring, data.settings), data=data, places={})
>>> fit(problem, [Cause("quadrupole_gradient", "qd::12", -0.1)], data.launches)

Nuisances are the launches (x, px, y, py, delta), [shot, 5]. A free kick is (px, py) in every shot,
in the middle of a layer's magnet; its parameters are [shot * 2].
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from tmlattice.arrays import Array, Flags, Indices
from tmlattice.beam.model import Model
from tmlattice.effects import Cause, Hypothesis, ReadingEffect, RingEffect, find
from tmlattice.inference.judgement import ENOUGH
from tmlattice.inference.problem import NO_KICKS, Kicks, Point, Problem
from tmlattice.inference.whitening import Projection, Root
from tmlattice.observe.data import Data, Whitening, each_shot
from tmlattice.observe.metric import DenseMetric, IndependentMetric, TurnMetric
from tmlattice.observe.noise import local_misfit
from tmlattice.observe.sections import TWO
from tmlattice.observe.stored import MAX_CHANGES


@dataclass(frozen=True, kw_only=True)
class FirstTurns(Problem):
    """Shots of a measurement, a few turns each, in a ring with known causes.

    Attributes:
        model: the ring of these shots.
        data: readings.
    """

    model: Model = field(repr=False)
    data: Data = field(repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "data", _bounded(self.data, self.model))

    @cached_property
    def whitening(self) -> Whitening:
        """Whitening by the noise of the readings."""
        return Whitening(self.data)

    # --- the model ------------------------------------------------------------------------------
    @property
    def first(self) -> Array:
        """Nominal launches, moved by one sigma in a plane without readings.

        At y = 0 the readings in x do not depend on y to first order, so a fit never leaves it.
        """
        read = np.asarray(self.data.valid.any(axis=1))  # [shot, plane]
        unread = np.repeat(~read & read.any(axis=1, keepdims=True), 2, axis=1)
        launches = self.data.launches.copy()
        launches[:, :4] += np.where(unread, self.data.launch_sigma[:, :4], 0.0)
        return launches

    @property
    def free(self) -> int:
        """Number of free launch coordinates."""
        return self.data.shots * len(self.whitening.columns)

    def with_fixed(self, causes: Sequence[Cause]) -> "FirstTurns":
        """Return the problem with fixed causes; many are built into the model, which is faster."""
        rest, built = list[Cause](), list[Cause]()
        for cause in causes:
            of_model = isinstance(find(cause.effect), RingEffect | ReadingEffect)
            (built if of_model else rest).append(cause)
        if len(built) < MAX_CHANGES:
            return super().with_fixed(causes)
        return replace(self, model=self.model.knowing(built), fixed=(*self.fixed, *rest))

    def at(self, causes: Sequence[Cause], nuisances: Array, kicks: Kicks = NO_KICKS) -> Point:
        """Return trajectories and residual; `view` are the `Paths`."""
        paths = self.model.paths(nuisances, (*self.fixed, *causes), self._of_shots(kicks))
        difference = np.where(self.data.valid, self.data.readings - paths.readings, 0.0)
        residual = self.whitening.residual(difference, nuisances)
        projection, lost = None, ""
        if np.isfinite(residual).all():
            projection = Projection(self.whitening.launch(paths.launch))
        else:
            lost = "the beam is lost"
        return Point(
            tuple(causes), nuisances, dict(kicks), residual, projection, paths.beam, paths, lost
        )

    def slope(self, point: Point, cause: int) -> Array:
        """Slope by central differences of the readings, monitors' errors included."""
        causes = point.causes
        effect = find(causes[cause].effect)
        h = (1e-3 if effect.power == 1 else 1e-2) * effect.largest
        kicks = self._of_shots(point.kicks)
        ends = []
        for side in (h, -h):
            changed = replace(causes[cause], amount=causes[cause].amount + side)
            there = (*self.fixed, *causes[:cause], changed, *causes[cause + 1 :])
            ends.append(self.model.readings(point.nuisances, there, kicks))
        return self.whitening.signature(np.nan_to_num(ends[0] - ends[1]) / (2 * h))

    def moved(self, nuisances: Array, change: Array) -> Array:
        """Launches after a change of their free coordinates."""
        launches = nuisances.copy()
        launches[:, self.whitening.columns] += change.reshape(len(launches), -1)
        return launches

    def metric(self, point: Point) -> TurnMetric:
        """Return products of signatures along these trajectories."""
        assert point.projection is not None
        return self._metric(point, self.whitening, point.projection)

    def metric_among(
        self, point: Point, root: Root, rows: slice, projection: Projection
    ) -> TurnMetric:
        """Return products from sums over the readings behind each monitor, see `DenseMetric`."""
        return self._metric(point, self.whitening.correlated(root.matrix[:, rows]), projection)

    def _metric(self, point: Point, whitening: Whitening, projection: Projection) -> TurnMetric:
        """The quickest products for this noise."""
        model = self.model
        kind: type[TurnMetric] = DenseMetric if model.turns == 1 else TurnMetric
        kind = kind if whitening.dense else IndependentMetric
        return kind(model, point.view, point.nuisances, whitening, projection)

    def neighbours(self, hypothesis: Hypothesis, among: Sequence[Hypothesis]) -> list[Hypothesis]:
        """Return hypotheses between the same monitors as a magnet."""
        ring = self.model.ring
        if hypothesis[1] is None or not any(e.name == hypothesis[1] for e in ring.magnets):
            return []
        s = np.array([0.0, *(monitor.s for monitor in ring.monitors), ring.length])
        gap = int(np.searchsorted(s, ring[hypothesis[1]].s))
        low, high = s[max(gap - 1, 0)], s[min(gap, len(s) - 1)]
        elements = {element.name: element.s for element in ring.elements}
        return [
            (name, place)
            for name, place in among
            if place in elements and low <= elements[place] <= high
        ]

    # --- what has no name -----------------------------------------------------------------------
    @property
    def kick_places(self) -> Sequence[str]:
        """Names of the magnets."""
        return self.model.maps.layers

    def kick_rows(self, point: Point, place: int) -> Array:
        """Rows of (px, py) in the middle of a magnet, independent in each shot."""
        kicked = self.model.kick_signatures(point.view, np.array([place]))
        return self.whitening.signature(each_shot(kicked)).reshape(2 * self.data.shots, -1)

    @staticmethod
    def _of_shots(kicks: Kicks) -> dict[int, Array]:
        return {place: values.reshape(-1, 2) for place, values in kicks.items()}

    @property
    def monitors(self) -> Sequence[str]:
        """Monitors in the order of the readings."""
        return self.model.maps.monitors

    # --- readings -------------------------------------------------------------------------------
    @property
    def valid(self) -> Flags:
        """[shot, reading, 2]."""
        return self.data.valid

    def owner(self) -> Indices:
        """Monitor of each reading."""
        one = np.tile(np.arange(len(self.monitors)), self.data.turns)
        return np.broadcast_to(one[None, :, None], self.valid.shape)

    def way(self) -> Array:
        """Share of the way to the last BPM that read the beam."""
        read = np.flatnonzero(self.valid.any(axis=(0, 2)))
        share = (1.0 + np.arange(self.valid.shape[1])) / (read.max(initial=0) + 1)
        return np.broadcast_to(share[None, :, None], self.valid.shape)

    @property
    def freedom(self) -> int:
        """Degrees of freedom; prior knowledge of a launch counts as readings of it."""
        free = self.data.launch_sigma > 0
        priors = int((free & np.isfinite(self.data.launch_sigma)).sum())
        return int(self.valid.sum()) + priors - int(free.sum())

    def as_rows(self, readings: Array) -> Array:
        """Whitened rows of readings, with zeros for the launches' priors."""
        return self.whitening.signature(readings)

    def noise_rows(self) -> list[Flags]:
        """Return the rows of x, and of y, that have readings."""
        planes = np.zeros((2, *self.valid.shape))
        planes[0, ..., 0], planes[1, ..., 1] = self.valid[..., 0], self.valid[..., 1]
        return [own > 0 for own in self.whitening.signature(planes)]

    def noisier(self, factors: Array) -> "FirstTurns":
        """Return the problem with the noise of each plane scaled."""
        return replace(self, data=replace(self.data, sigma=self.data.sigma * factors))

    def disagreement(self, point: Point) -> float:
        """Median misfit of each reading with the prediction from the two monitors before it."""
        left = local_misfit(self.data, point.view) / self.data.sigma
        left = np.abs(left[np.isfinite(left)])
        return float(np.median(left)) if len(left) > ENOUGH else 0.0

    def left(self, point: Point) -> tuple[Array, Array]:
        """Residuals and their variances, reduced by the fitted launch."""
        assert point.projection is not None
        shots = self.data.shots
        clean = point.projection.out(point.residual).reshape(shots, -1)[:, :-5]
        Q = point.projection.Q[:, :-5]
        size = 1 - np.einsum("bri,bri->br", Q, Q)
        return clean.reshape(self.valid.shape), size.reshape(self.valid.shape)

    def without(self, dropped: Flags) -> "FirstTurns":
        """Return the problem without some readings; the noise is estimated anew."""
        if not dropped.any():
            return self
        return replace(self, data=self.data.without(dropped))


def _bounded(data: Data, model: Model) -> Data:
    """Limit launches in planes without readings to the size of the orbit.

    In a plane with fewer readings than launch coordinates, the prior is as large as the shot's
    readings. Without it sextupoles would let the trajectory diverge to fit noise in the other
    plane.
    """
    count = data.valid.sum(axis=1)  # [shot, plane]
    few = np.repeat(count < TWO, 2, axis=1)
    if not (few & ~np.isfinite(data.launch_sigma[:, :4])).any():
        return data
    square = np.where(data.valid, data.readings**2, 0.0).sum(axis=(1, 2))
    read = count.sum(axis=1)
    usual = square.sum() / max(read.sum(), 1)
    size = np.sqrt(np.where(read > 0, square / np.maximum(read, 1), usual))
    launch = model.paths(data.launches, ()).launch  # [shot, reading, 2, 5]
    slopes = np.concatenate([launch[:, :, 0, 0:2], launch[:, :, 1, 2:4]], axis=2)
    with np.errstate(divide="ignore"):
        width = size[:, None] / np.sqrt(np.mean(np.nan_to_num(slopes) ** 2, axis=1))
    sigma = data.launch_sigma.copy()
    sigma[:, :4] = np.where(few, np.minimum(sigma[:, :4], width), sigma[:, :4])
    return replace(data, launch_sigma=sigma)
