"""Several measurements of one machine as one problem: rows stacked, causes shared.

>>> both = CombinedProblem.of([first_turns, dispersion])
>>> explain(Search(both, hypotheses, unnamed=False), fit(both, (), both.first))

Each measurement keeps its nuisances and its noise. A cause without effect in one of them has zero
rows there.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from tmlattice.arrays import Array, Flags, Indices
from tmlattice.effects import Cause, Hypothesis
from tmlattice.inference.problem import (
    NO_KICKS,
    Kicks,
    Metric,
    Point,
    Problem,
    Products,
)
from tmlattice.inference.whitening import Blocks, Projection, Root


@dataclass(frozen=True, kw_only=True)
class CombinedProblem(Problem):
    """Measurements of one machine.

    Attributes:
        parts: their problems; priors, thresholds and fixed causes of these are not used.
        names: all monitors.
        starts: first guess of each part's nuisances.
        active: whether the causes sought act in a part; they do not in a reference. Fixed causes
            act in all.
    """

    parts: tuple[Problem, ...] = field(repr=False)
    names: tuple[str, ...] = field(repr=False)
    starts: tuple[Array, ...] = field(repr=False)
    active: tuple[bool, ...]

    @classmethod
    def of(cls, parts: Sequence[Problem], before: Sequence[Problem] = ()) -> "CombinedProblem":
        """Return the problem with the priors, judgement and fixed causes of the first part.

        Args:
            parts: measurements in which causes are sought.
            before: reference measurements.
        """
        active = (True,) * len(parts) + (False,) * len(before)
        parts = [*parts, *before]
        names = dict.fromkeys(name for part in parts for name in part.monitors)
        one = parts[0]
        return cls(
            places=one.places, rare=one.rare, fixed=one.fixed, amounts=one.amounts,
            judgement=one.judgement,
            parts=tuple(replace(part, fixed=()) for part in parts), names=tuple(names),
            starts=tuple(part.first for part in parts), active=active,
        )  # fmt: skip

    @property
    def alone(self) -> bool:
        """Whether no part is a reference."""
        return all(self.active)

    @property
    def reference(self) -> "CombinedProblem":
        """The problem of the reference measurements."""
        own = zip(self.parts, self.starts, self.active, strict=True)
        parts, starts = zip(*((p, s) for p, s, active in own if not active), strict=True)
        return replace(self, parts=parts, starts=starts, active=(True,) * len(parts))

    @property
    def _only(self) -> int | None:
        """The one part in which causes are sought, None: there are several."""
        first, *others = (i for i, active in enumerate(self.active) if active)
        return None if others else first

    @staticmethod
    def _rows(point: Point, part: int) -> slice:
        """Rows of a part."""
        begin = sum(len(own.residual) for own in point.view[:part])
        return slice(begin, begin + len(point.view[part].residual))

    # --- nuisances: one flat vector -------------------------------------------------------------
    @property
    def first(self) -> Array:
        """First guesses of the nuisances, part after part."""
        return np.concatenate([start.ravel() for start in self.starts])

    @property
    def free(self) -> int:
        """Sum over the parts."""
        return sum(part.free for part in self.parts)

    @property
    def freedom(self) -> int:
        """Sum over the parts."""
        return sum(part.freedom for part in self.parts)

    def of_parts(self, nuisances: Array) -> list[Array]:
        """Nuisances of each part, in its own shape."""
        flat = np.split(nuisances, _ends([start.size for start in self.starts]))
        return [own.reshape(start.shape) for own, start in zip(flat, self.starts, strict=True)]

    def moved(self, nuisances: Array, change: Array) -> Array:
        """Return the nuisances after a change of each part's."""
        changes = np.split(change, _ends([part.free for part in self.parts]))
        own = zip(self.parts, self.of_parts(nuisances), changes, strict=True)
        return np.concatenate([part.moved(n, c).ravel() for part, n, c in own])

    # --- the model ------------------------------------------------------------------------------
    def sees(self, hypothesis: Hypothesis) -> bool:
        """Whether the cause has an effect in any part."""
        return any(part.sees(hypothesis) for part in self.parts)

    def everywhere(self) -> "CombinedProblem":
        """Return the problem with causes that act in all parts."""
        other = replace(self, active=(True,) * len(self.parts))
        vars(other)["parts_with_fixed"] = self.parts_with_fixed  # whose models are made
        return other

    @cached_property
    def parts_with_fixed(self) -> tuple[Problem, ...]:
        """The parts, each with the fixed causes that act in it."""
        return tuple(
            part.with_fixed([c for c in self.fixed if part.sees((c.effect, c.element))])
            for part in self.parts
        )

    def near(self, causes: Sequence[Cause]) -> Self:
        """Return the problem of the parts near the causes that act in each."""
        parts = []
        for part, active in zip(self.parts, self.active, strict=True):
            there = (*self.fixed, *(causes if active else ()))
            parts.append(part.near([c for c in there if part.sees((c.effect, c.element))]))
        same = all(own is part for own, part in zip(parts, self.parts, strict=True))
        return self if same else replace(self, parts=tuple(parts))

    def at(self, causes: Sequence[Cause], nuisances: Array, kicks: Kicks = NO_KICKS) -> Point:
        """Return the model's point; its `view` are the points of the parts."""
        points = []
        for part, active, own in zip(
            self.parts_with_fixed, self.active, self.of_parts(nuisances), strict=True
        ):
            there = causes if active else ()
            seen = [c for c in there if part.sees((c.effect, c.element))]
            points.append(part.at(seen, own, kicks if active else NO_KICKS))
            if points[-1].lost:  # the other parts are not needed
                rest = np.full(1, np.nan)
                return Point(
                    tuple(causes), nuisances, dict(kicks), rest, None, rest, None, points[-1].lost
                )
        found = [point.projection for point in points]
        return Point(
            tuple(causes), nuisances, dict(kicks),
            np.concatenate([point.residual for point in points]),
            Blocks([projection for projection in found if projection is not None]),
            np.concatenate([point.orbit.ravel() for point in points]), tuple(points),
        )  # fmt: skip

    def slope(self, point: Point, cause: int) -> Array:
        """Return the slope, zero in parts without an effect, [row]."""
        own = point.causes[cause]
        rows = []
        for part, active, here in zip(self.parts_with_fixed, self.active, point.view, strict=True):
            if active and part.sees((own.effect, own.element)):
                rows.append(part.slope(here, here.causes.index(own)))
            else:
                rows.append(np.zeros(len(here.residual)))
        return np.concatenate(rows)

    def metric(self, point: Point) -> Metric:
        """Return the products summed over the parts."""
        if len(self.parts) == 1:
            return self.parts_with_fixed[0].metric(point.view[0])
        return _CombinedMetric(self, point)

    def metric_among(
        self, point: Point, root: Root, rows: slice, projection: Projection
    ) -> Metric | None:
        """Return the products of a single measurement, as its kind has them."""
        if self._only is None:
            return None
        part, here = self.parts_with_fixed[self._only], point.view[self._only]
        return part.metric_among(here, root, self._rows(point, self._only), projection)

    # --- free kicks: of a single measurement ----------------------------------------------------
    @property
    def kick_places(self) -> Sequence[str]:
        """Places of free kicks of a single measurement; several have no kick in common."""
        return () if self._only is None else self.parts[self._only].kick_places

    def kick_rows(self, point: Point, place: int) -> Array:
        """Return the rows of a single measurement, zero in its reference."""
        assert self._only is not None
        own = self.parts_with_fixed[self._only].kick_rows(point.view[self._only], place)
        rows = np.zeros((len(own), len(point.residual)))
        rows[:, self._rows(point, self._only)] = own
        return rows

    def neighbours(self, hypothesis: Hypothesis, among: Sequence[Hypothesis]) -> list[Hypothesis]:
        """Return the neighbours in any part."""
        found = [h for part in self.parts for h in part.neighbours(hypothesis, among)]
        return list(dict.fromkeys(found))

    @property
    def monitors(self) -> Sequence[str]:
        """All monitors of the parts."""
        return self.names

    # --- readings -------------------------------------------------------------------------------
    @property
    def valid(self) -> Flags:
        """Valid readings of all parts, flat."""
        return np.concatenate([part.valid.ravel() for part in self.parts])

    def owner(self) -> Indices:
        """Monitor of each reading, an index of `names`."""
        at = {name: i for i, name in enumerate(self.names)}
        found = []
        for part in self.parts:
            own = np.array([*(at[name] for name in part.monitors), -1])
            found.append(own[part.owner().ravel()])
        return np.concatenate(found)

    def way(self) -> Array:
        """Return the shares of the parts' ways."""
        return np.concatenate([part.way().ravel() for part in self.parts])

    def as_rows(self, readings: Array) -> Array:
        """Return the rows, part after part."""
        rows = [
            part.as_rows(own.reshape(*own.shape[:-1], *part.valid.shape))
            for part, own in zip(self.parts, self._split(readings), strict=True)
        ]
        return np.concatenate(rows, axis=-1)

    def noise_rows(self) -> list[Flags]:
        """Return the noise rows of a single measurement, with its reference; of several: none."""
        if self._only is None:
            return []
        own = [part.noise_rows() for part in self.parts]
        alike = len({len(rows) for rows in own}) == 1
        return [np.concatenate(rows) for rows in zip(*own, strict=True)] if alike else []

    def noisier(self, factors: Array) -> Self:
        """Return the problem with scaled noise, the same in all parts."""
        return replace(self, parts=tuple(part.noisier(factors) for part in self.parts))

    def disagreement(self, point: Point) -> float:
        """Return the disagreement of a single measurement; of several: 0."""
        only = self._only
        return 0.0 if only is None else self.parts[only].disagreement(point.view[only])

    def left(self, point: Point) -> tuple[Array, Array]:
        """Return the residuals and their variances, part after part."""
        found = [part.left(here) for part, here in zip(self.parts, point.view, strict=True)]
        rows, size = zip(*found, strict=True)
        return np.concatenate([r.ravel() for r in rows]), np.concatenate([s.ravel() for s in size])

    def without(self, dropped: Flags) -> Self:
        """Return the problem without some readings."""
        parts = [
            part.without(own.reshape(part.valid.shape))
            for part, own in zip(self.parts, self._split(dropped), strict=True)
        ]
        return replace(self, parts=tuple(parts))

    def _split(self, flat: NDArray[Any]) -> list[NDArray[Any]]:
        return np.split(flat, _ends([part.valid.size for part in self.parts]), axis=-1)


def _ends(sizes: Sequence[int]) -> list[int]:
    return [int(end) for end in np.cumsum(sizes)[:-1]]


class _CombinedMetric(Metric):
    def __init__(self, problem: CombinedProblem, point: Point) -> None:
        assert isinstance(point.projection, Blocks)
        super().__init__(point.projection)
        self.problem, self.blocks = problem, point.projection
        pairs = zip(problem.parts_with_fixed, point.view, strict=True)
        self.metrics = [part.metric(here) for part, here in pairs]

    def products(self, hypotheses: Sequence[Hypothesis], data: Array) -> Products:
        total = Products.empty(len(hypotheses), len(data))
        own = zip(
            self.problem.parts, self.problem.active, self.metrics, self.blocks.split(data),
            strict=True,
        )  # fmt: skip
        for part, active, metric, mine in own:
            if not active:
                continue
            seen = np.array([i for i, h in enumerate(hypotheses) if part.sees(h)], dtype=np.intp)
            if len(seen):
                some = metric.products([hypotheses[i] for i in seen], np.ascontiguousarray(mine))
                total.whole[seen] += some.whole
                total.inside[seen] += some.inside
                total.inner[seen] += some.inner
        return total

    def rows(self, hypotheses: Sequence[Hypothesis]) -> Array:
        parts = []
        problem = self.problem
        for part, active, metric, size in zip(
            problem.parts, problem.active, self.metrics, self.blocks.sizes, strict=True
        ):
            out = np.zeros((len(hypotheses), size))
            seen = [i for i, h in enumerate(hypotheses) if active and part.sees(h)]
            if seen:
                out[seen] = metric.rows([hypotheses[i] for i in seen])
            parts.append(out)
        return np.concatenate(parts, axis=1)

    def free_kicks(self, places: Indices, clean: Array) -> tuple[Array, Array]:
        """Return the information of the one measurement in which causes are sought."""
        only = self.problem._only
        assert only is not None
        mine = np.ascontiguousarray(self.blocks.split(clean)[only])
        return self.metrics[only].free_kicks(places, mine)

    def free_monitors(self, clean: Array) -> tuple[Array, Array]:
        """Return the information; a monitor's readings in each measurement are a block. In a
        reference they are not free: what is sought is not there."""
        problem = self.problem
        at = {name: i for i, name in enumerate(problem.names)}
        found = []
        for part, active, metric, mine in zip(
            problem.parts, problem.active, self.metrics, self.blocks.split(clean), strict=True
        ):
            if active:
                own = metric.free_monitors(np.ascontiguousarray(mine))
                found.append((*own, [at[m] for m in part.monitors]))
        size = max(gram.shape[-1] for gram, _, _ in found)
        blocks = sum(gram.shape[1] for gram, _, _ in found)
        grams = np.zeros((len(at), blocks, size, size))
        inners = np.zeros((len(at), blocks, size))
        block = 0
        for gram, inner, where in found:
            count, p = gram.shape[1], gram.shape[-1]
            grams[where, block : block + count, :p, :p] = gram
            inners[where, block : block + count, :p] = inner
            block += count
        return grams, inners
