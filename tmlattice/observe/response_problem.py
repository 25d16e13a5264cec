"""An orbit response as an inference problem: a sparse set of causes, and no nuisances.

>>> problem = Response(base=Predicted(data, Errors.none(data)).bend(), used=rows.used, places={})
>>> explain(Search(problem, hypotheses(data), unnamed=False), fit(problem, (), problem.first))

A held-out corrector has no rows. The kick of a fitted one is known, so that its calibration is a
cause like any other.

Products of an orbit response's signatures without forming them. An error of the ring changes a
response by a few numbers per column and per monitor (`beam.response_derivatives.Factors`). Its
products with data are those of these numbers with sums over the data. Its square is summed over
readings, each with its weight. An error of a monitor affects that monitor's readings alone.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Self

import numpy as np
from numpy.typing import NDArray

from tmlattice.arrays import AT_ONCE, Array, Indices
from tmlattice.beam.response_derivatives import Factors, ResponseSlopes
from tmlattice.compiled import jit_sums
from tmlattice.effects import (
    Cause,
    Hypothesis,
    LaunchEffect,
    ReadingEffect,
    RingEffect,
    find,
    modelled,
)
from tmlattice.errors import UnstableRingError
from tmlattice.inference.problem import (
    Metric,
    Point,
    Products,
    effects_on_readings,
    effects_on_ring,
)
from tmlattice.observe.orbit_response import Predicted
from tmlattice.observe.response_data import ResponseData
from tmlattice.observe.stored import Steady, SteadyMetric


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
        values, sigma: orbit changes, m, [column, monitor, 2], and noise, m, [monitor, 2].
        bends: the latest third order of the steps, by its causes, see `near`.
    """

    base: Predicted = field(repr=False)
    bends: dict[tuple[Cause, ...], Array | float] = field(
        default_factory=dict, repr=False, compare=False
    )
    values: Array = field(init=False, repr=False)
    sigma: Array = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "values", self.base.data.orbits)
        object.__setattr__(self, "sigma", self.base.data.noise)

    def sees(self, hypothesis: Hypothesis) -> bool:
        """Whether a cause acts on a closed orbit; of the beam's, the energies do."""
        effect = find(hypothesis[0])
        return effect.responds or not isinstance(effect, LaunchEffect)

    def near(self, causes: Sequence[Cause]) -> Self:
        """Return the problem with the third order of the steps at these causes, if the ring stores
        a beam with each step there."""
        there = (*self.fixed, *causes)
        if there not in self.bends:
            self.bends.clear()
            try:
                self.bends[there] = self.view(there).bend().bent
            except UnstableRingError:
                return self
        bent = self.bends[there]
        return replace(self, base=replace(self.base, bent=bent))

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

    def of_monitors(self, view: Predicted, nuisances: Array, effect: ReadingEffect) -> Array:
        """d reading / d amount of a further effect, for every monitor, m, [column, monitor, 2]."""
        return view.of_monitors(effect)

    def metric(self, point: Point) -> Metric:
        """Return products from factors."""
        return ResponseMetric(self, point)

    @property
    def monitors(self) -> Sequence[str]:
        """Monitors of the measurement, as the ring names them."""
        return self.base.monitors

    def owner(self) -> Indices:
        """Monitor of each reading."""
        return np.broadcast_to(np.arange(self.used.shape[1])[:, None], self.used.shape)


class ResponseMetric(SteadyMetric):
    """Products at one point of a `Response`, which has no nuisances."""

    def quick(self, hypotheses: Sequence[Hypothesis], data: Array, found: Products) -> Indices:
        """Put in products of errors of the ring and of monitors; return their indices."""
        done = super().quick(hypotheses, data, found)
        on_ring = effects_on_ring(hypotheses)
        if len(on_ring):
            sums, count = self.sums(data), self.slopes.at_once
            for part in np.split(on_ring, range(count, len(on_ring), count)):
                some = self.read([hypotheses[i] for i in part])
                found.put(part, self.squares(some), 0.0, some.products(sums))
        return np.concatenate([done, on_ring])

    def pieces(self, hypotheses: Sequence[Hypothesis]) -> Iterator[tuple[Indices, Array]]:
        """Yield signatures at some monitors at a time, from the factors of all ring errors."""
        view, on_ring = self.view, effects_on_ring(hypotheses)
        of_monitors = [
            (which, at, view.of_monitors(effect))
            for effect, which, at in effects_on_readings(hypotheses, self.problem.monitors)
        ]
        others = np.concatenate([on_ring, *(which for which, _, _ in of_monitors)])
        rest = np.setdiff1d(np.arange(len(hypotheses)), others)
        whole = self.rows([hypotheses[int(i)] for i in rest])
        some = self.read([hypotheses[int(i)] for i in on_ring]) if len(on_ring) else None
        used = self.problem.used
        row = np.zeros(used.shape, dtype=np.intp)
        row[used] = np.arange(np.count_nonzero(used))
        measured = np.flatnonzero(used.any(axis=(0, 2)))
        count = max(AT_ONCE // max(len(hypotheses) * used[:, 0].size, 1), 1)
        for start in range(0, len(measured), count):
            group = measured[start : start + count]
            out = []
            for at in group:
                there = used[:, at]
                own = np.zeros((len(hypotheses), np.count_nonzero(there)))
                if some is not None:
                    own[on_ring] = self.at(int(at), some)[:, there]
                for which, places, slope in of_monitors:
                    own[which[places == at]] = (slope[:, at] / self.problem.sigma[at])[there]
                own[rest] = whole[:, row[:, at][there]]
                out.append(own)
            rows = [row[:, at][used[:, at]] for at in group]
            yield np.concatenate(rows), np.concatenate(out, axis=1)

    # --- from factors, in units of the noise ----------------------------------------------------
    @property
    def view(self) -> Predicted:
        """The response at the point."""
        view: Predicted = self.point.view
        return view

    @property
    def slopes(self) -> ResponseSlopes:
        """Derivatives of the beam's orbit for a unit of each column."""
        return self.view.response_slopes

    @cached_property
    def scale(self) -> Array:
        """Step of each column, [column]."""
        return (1 + self.view.errors.calibration) * self.view.data.kicks

    @cached_property
    def first(self) -> NDArray[np.intp]:
        """First measured monitor behind each column's kick, [column]."""
        return np.searchsorted(self.view.data.at, self.slopes.first)

    def seen(self, slopes: Array) -> Array:
        """Readings over noise of orbit slopes at all monitors, [..., monitor, 2, n]."""
        own = self.view.errors.monitors / self.problem.sigma[:, :, None]
        return np.asarray(own @ slopes[..., self.view.data.at, :, :])

    @cached_property
    def readings(self) -> Array:
        """Readings over noise by launch, [monitor, 2, n]."""
        return self.seen(self.slopes.readings)

    def read(self, hypotheses: Sequence[Hypothesis]) -> Factors:
        """Return the factors of ring errors as readings over noise of the measured monitors."""
        change = self.slopes.factors(hypotheses)
        return change._replace(seen=self.seen(change.seen))

    def at(self, monitor: int, some: Factors) -> Array:
        """Signatures at one monitor, [error, column, 2]."""
        slopes, late = self.slopes, (monitor >= self.first)[:, None]
        launch = slopes.start + late * slopes.launch_kick
        orbit = some.seen[:, monitor] @ launch.T  # [error, 2, column]
        change = np.where(late, some.before + some.behind, some.before)
        moved = np.swapaxes(orbit, 1, 2) + change @ self.readings[monitor].T
        return np.asarray(moved * self.scale[:, None])

    def sums(self, data: Array) -> Factors:
        """Sums of data [data, row]."""
        n, columns = self.readings.shape[2], len(self.scale)
        G = self.readings.reshape(-1, n)
        behind = np.repeat(np.arange(len(self.readings)) >= self.first[:, None], 2, axis=1)
        seen = np.empty((len(data), len(G), n))
        before, added = np.empty((2, len(data), columns, n))
        whole = np.zeros(self.problem.used.shape)
        for d, row in enumerate(data):
            whole[self.problem.used] = row
            D = whole.reshape(columns, -1) * self.scale[:, None]
            late = np.where(behind, D, 0.0)
            seen[d] = D.T @ self.slopes.start + late.T @ self.slopes.launch_kick
            before[d], added[d] = D @ G, late @ G
        return Factors(seen, before, added)

    def squares(self, some: Factors) -> Array:
        """Squares of signatures, [error]."""
        slopes, n = self.slopes, self.readings.shape[2]
        used = self.problem.used.reshape(len(self.scale), -1)
        columns, read = (np.asarray(used.any(axis=axis)) for axis in (1, 0))
        return np.asarray(
            _squares(
                some.seen.reshape(len(some.seen), -1, n) * read[:, None],
                self.readings.reshape(-1, n) * read[:, None],
                np.stack([slopes.start, slopes.start + slopes.launch_kick]),
                np.stack([some.before, some.before + some.behind]),
                2 * self.first,
                columns * self.scale**2,
                np.argwhere(np.outer(columns, read) & ~used),
            )
        )


# `reassoc`: the sum may follow the vector unit's order.
@jit_sums
def _squares(seen, readings, start, change, first, weight, missing):  # type: ignore[no-untyped-def]
    """Weighted sum over all readings but the missing of (seen . start + readings . change)^2,
    [error], from sums of products up to each reading.

    Args:
        seen: change of the readings of a launch by an error, [error, reading, n].
        readings: readings of a launch, [reading, n].
        start: launches of the columns, for the readings before and behind each column's kick,
            [2, column, n].
        change: of these by an error, [2, error, column, n].
        first: the first reading behind each column's kick, [column].
        weight: of each column, [column].
        missing: columns and readings, [missing, 2].
    """
    errors, count, n = seen.shape
    squares = np.zeros((3, count + 1, n, n))  # of seen, of both, of readings
    for r in range(count):
        for i in range(n):
            for j in range(n):
                squares[2, r + 1, i, j] = squares[2, r, i, j] + readings[r, i] * readings[r, j]
    out = np.zeros(errors)
    for h in range(errors):
        for r in range(count):
            for i in range(n):
                for j in range(n):
                    squares[0, r + 1, i, j] = squares[0, r, i, j] + seen[h, r, i] * seen[h, r, j]
                    squares[1, r + 1, i, j] = squares[1, r, i, j] + seen[h, r, i] * readings[r, j]
        total = 0.0
        for c in range(len(first)):
            own = 0.0
            for side in range(2):
                low, high = (0, first[c]) if side == 0 else (first[c], count)
                for i in range(n):
                    u, a = start[side, c, i], change[side, h, c, i]
                    for j in range(n):
                        v, b = start[side, c, j], change[side, h, c, j]
                        own += u * v * (squares[0, high, i, j] - squares[0, low, i, j])
                        own += 2 * u * b * (squares[1, high, i, j] - squares[1, low, i, j])
                        own += a * b * (squares[2, high, i, j] - squares[2, low, i, j])
            total += weight[c] * own
        for c, r in missing:
            side, left = int(r >= first[c]), 0.0
            for i in range(n):
                left += seen[h, r, i] * start[side, c, i] + readings[r, i] * change[side, h, c, i]
            total -= weight[c] * left * left
        out[h] = max(total, 0.0)
    return out
