"""Several measurements of one machine as one problem: their rows stacked, their causes shared.

>>> both = Together.of([first_turns, dispersion])
>>> explain(Search(both, hypotheses, unnamed=False), fit(both, (), both.first))

Each measurement keeps its nuisances and its noise; a cause that one of them does not see has rows
of zeros there. Nothing here knows which kinds they are.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from tmlattice.effects import Cause
from tmlattice.inference.metric import Hypothesis, Metric, Products
from tmlattice.inference.problem import NO_KICKS, Kicks, Point, Problem
from tmlattice.inference.root import Root
from tmlattice.inference.whitening import Projection

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]


class Blocks(Projection):
    """Nuisances of each part, projected out of its own rows.

    Args:
        parts: the projections, one after another.
    """

    def __init__(self, parts: Sequence[Projection]) -> None:
        self.parts = tuple(parts)
        sizes = [len(part.Q) * part.Q.shape[1] for part in parts]
        self.ends = np.cumsum(sizes)[:-1]

    def split(self, rows: Array) -> list[Array]:
        """Rows [..., row] of each part."""
        return np.split(rows, self.ends, axis=-1)

    def out(self, rows: Array) -> Array:
        """Rows less what nuisances explain."""
        own = zip(self.parts, self.split(rows), strict=True)
        return np.concatenate([part.out(np.ascontiguousarray(mine)) for part, mine in own], axis=-1)

    @property
    def log_volume(self) -> float:
        """Of all parts."""
        return sum(part.log_volume for part in self.parts)

    def matrix(self) -> Array:
        """The directions of all parts, [row, coordinate]."""
        return np.asarray(block_diag(*(part.matrix() for part in self.parts)))

    def inside(self, rows: Array) -> Array:
        """The square of what nuisances explain, [...]."""
        own = zip(self.parts, self.split(rows), strict=True)
        return np.asarray(sum(part.inside(np.ascontiguousarray(mine)) for part, mine in own))

    def coordinates(self, rows: Array) -> Array:
        """Changes of the nuisances, part after part."""
        own = zip(self.parts, self.split(rows), strict=True)
        return np.concatenate([part.coordinates(mine) for part, mine in own])


@dataclass(frozen=True, kw_only=True)
class CombinedProblem(Problem):
    """Measurements of one machine.

    Attributes:
        parts: the problems; what they say of priors, thresholds and fixed causes is not asked.
        names: of all monitors that any of them reads.
        starts: a first guess of each part's nuisances.
        active: whether the causes that are looked for are there in each; they are not in a
            reference from before. What is fixed is there in all.
    """

    parts: tuple[Problem, ...] = field(repr=False)
    names: tuple[str, ...] = field(repr=False)
    starts: tuple[Array, ...] = field(repr=False)
    active: tuple[bool, ...]

    @classmethod
    def of(cls, parts: Sequence[Problem], before: Sequence[Problem] = ()) -> "CombinedProblem":
        """With the places, the judgement and the fixed causes of the first.

        Args:
            parts: measurements in which causes are looked for.
            before: those of a reference.
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
        """Whether no part is of a reference, nor has shots of one."""
        return all(self.active) and all(part.alone for part in self.parts)

    def reference(self, nuisances: Array) -> "tuple[CombinedProblem, Array]":
        """Return the measurements, or shots, of the reference alone, as those that are searched."""
        parts: list[tuple[Problem, Array]] = []
        for part, active, start in zip(
            self.parts, self.active, self.of_parts(nuisances), strict=True
        ):
            own, first = part.reference(start) if active else (part, start)
            parts += [] if own is None else [(own, first)]
        problems, starts = zip(*parts, strict=True)
        found = replace(self, parts=problems, starts=starts, active=(True,) * len(parts))
        return found, found.first

    # --- nuisances: one flat vector -------------------------------------------------------------
    @property
    def first(self) -> Array:
        """Each part's own guess, one after another."""
        return np.concatenate([start.ravel() for start in self.starts])

    @property
    def free(self) -> int:
        """Of all parts."""
        return sum(part.free for part in self.parts)

    @property
    def freedom(self) -> int:
        """Of all parts."""
        return sum(part.freedom for part in self.parts)

    def of_parts(self, nuisances: Array) -> list[Array]:
        """Of each part, in its own shape."""
        flat = np.split(nuisances, _ends([start.size for start in self.starts]))
        return [own.reshape(start.shape) for own, start in zip(flat, self.starts, strict=True)]

    def moved(self, nuisances: Array, change: Array) -> Array:
        """Each part moves its own."""
        changes = np.split(change, _ends([part.free for part in self.parts]))
        own = zip(self.parts, self.of_parts(nuisances), changes, strict=True)
        return np.concatenate([part.moved(n, c).ravel() for part, n, c in own])

    # --- the model ------------------------------------------------------------------------------
    def sees(self, hypothesis: Hypothesis) -> bool:
        """Whether any part does."""
        return any(part.sees(hypothesis) for part in self.parts)

    def everywhere(self) -> "CombinedProblem":
        """Active in all parts."""
        parts = tuple(part.everywhere() for part in self.parts)
        return replace(self, parts=parts, active=(True,) * len(parts))

    @cached_property
    def parts_with_fixed(self) -> tuple[Problem, ...]:
        """The parts, each with the fixed causes that it sees."""
        return tuple(
            part.with_fixed([c for c in self.fixed if part.sees((c.effect, c.element))])
            for part in self.parts
        )

    def at(self, causes: Sequence[Cause], nuisances: Array, kicks: Kicks = NO_KICKS) -> Point:
        """`view` are the points of the parts, each with the causes that it sees."""
        points = []
        for part, active, own in zip(
            self.parts_with_fixed, self.active, self.of_parts(nuisances), strict=True
        ):
            there = causes if active else ()
            seen = [c for c in there if part.sees((c.effect, c.element))]
            points.append(part.at(seen, own, kicks))
            if points[-1].lost:  # the others would not be asked any more
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
        """Of each part that sees it."""
        own = point.causes[cause]
        rows = []
        for part, active, here in zip(self.parts_with_fixed, self.active, point.view, strict=True):
            if active and part.sees((own.effect, own.element)):
                rows.append(part.slope(here, here.causes.index(own)))
            else:
                rows.append(np.zeros(len(here.residual)))
        return np.concatenate(rows)

    def metric(self, point: Point) -> Metric:
        """Of the parts, added up."""
        if len(self.parts) == 1:
            return self.parts_with_fixed[0].metric(point.view[0])
        return _CombinedMetric(self, point)

    def metric_among(self, point: Point, root: Root, projection: Projection) -> Metric | None:
        """Of a single measurement, as its kind has it."""
        if len(self.parts) > 1:
            return None
        return self.parts_with_fixed[0].metric_among(point.view[0], root, projection)

    # --- free kicks: of a single measurement ----------------------------------------------------
    @property
    def kick_places(self) -> Sequence[str]:
        """Several measurements have no kick in common."""
        return self.parts[0].kick_places if len(self.parts) == 1 else ()

    def kick_rows(self, point: Point, place: int) -> Array:
        """As its kind has it."""
        return self.parts_with_fixed[0].kick_rows(point.view[0], place)

    def neighbours(self, hypothesis: Hypothesis, among: Sequence[Hypothesis]) -> list[Hypothesis]:
        """Of any part."""
        found = [h for part in self.parts for h in part.neighbours(hypothesis, among)]
        return list(dict.fromkeys(found))

    @property
    def monitors(self) -> Sequence[str]:
        """Of all parts."""
        return self.names

    # --- readings -------------------------------------------------------------------------------
    @property
    def valid(self) -> Flags:
        """Of all parts, flat."""
        return np.concatenate([part.valid.ravel() for part in self.parts])

    def owner(self) -> NDArray[np.int64]:
        """By the names of all."""
        at = {name: i for i, name in enumerate(self.names)}
        found = []
        for part in self.parts:
            own = np.array([*(at[name] for name in part.monitors), -1])
            found.append(own[part.owner().ravel()])
        return np.concatenate(found)

    def as_rows(self, readings: Array) -> Array:
        """Each part's own."""
        rows = [
            part.as_rows(own.reshape(*own.shape[:-1], *part.valid.shape))
            for part, own in zip(self.parts, self._split(readings), strict=True)
        ]
        return np.concatenate(rows, axis=-1)

    def noise_rows(self) -> list[Flags]:
        """Of a single measurement, as its kind has it."""
        return self.parts[0].noise_rows() if len(self.parts) == 1 else []

    def noisier(self, factors: Array) -> Self:
        """Of a single measurement, as its kind has it."""
        return replace(self, parts=tuple(part.noisier(factors) for part in self.parts))

    def disagreement(self, point: Point) -> float:
        """Of a single measurement, as its kind has it."""
        return self.parts[0].disagreement(point.view[0]) if len(self.parts) == 1 else 0.0

    def left(self, point: Point) -> tuple[Array, Array]:
        """Of each part."""
        found = [part.left(here) for part, here in zip(self.parts, point.view, strict=True)]
        rows, size = zip(*found, strict=True)
        return np.concatenate([r.ravel() for r in rows]), np.concatenate([s.ravel() for s in size])

    def without(self, dropped: Flags) -> Self:
        """The same with these missing."""
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
        sizes = [len(part.Q) * part.Q.shape[1] for part in self.blocks.parts]
        problem = self.problem
        for part, active, metric, size in zip(
            problem.parts, problem.active, self.metrics, sizes, strict=True
        ):
            out = np.zeros((len(hypotheses), size))
            seen = [i for i, h in enumerate(hypotheses) if active and part.sees(h)]
            for start in range(0, len(seen), metric.chunk):
                some = seen[start : start + metric.chunk]
                out[some] = metric.rows([hypotheses[i] for i in some])
            parts.append(out)
        return np.concatenate(parts, axis=1)

    def free_monitors(self, clean: Array) -> tuple[Array, Array]:
        """Readings of one monitor in different measurements are blocks of their own."""
        problem = self.problem
        at = {name: i for i, name in enumerate(problem.names)}
        found = []
        for part, metric, mine in zip(
            problem.parts, self.metrics, self.blocks.split(clean), strict=True
        ):
            found.append(
                (*metric.free_monitors(np.ascontiguousarray(mine)), [at[m] for m in part.monitors])
            )
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
