"""Any problem among small errors everywhere: rows whitened once more by what those make of them.

Small errors are Gaussian and far too many to be found one by one; with signatures S (rms times
slope, in rows) the rows' covariance is C = 1 + S^T S. Divided by its Cholesky factor they are again
white, and a search knows nothing of it. The signatures hold about the likeliest small errors, which
stand in the model; the rows are shifted so that their prior still stands about zero.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Self

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cholesky
from scipy.linalg.lapack import dtrtri

from tmlattice.effects import Cause
from tmlattice.errors import UnstableRingError
from tmlattice.inference.metric import Hypothesis, Metric
from tmlattice.inference.newton import Fit, fit, settled
from tmlattice.inference.problem import NO_KICKS, Kicks, Point, Problem
from tmlattice.inference.sizes import Sizes, learn_sizes
from tmlattice.inference.whitening import Projection

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

ROUNDS = 2
"""Linearisations: about the design, and about the likeliest errors."""

ROWS = 1600
"""Rows from which sizes are learnt: 17 sizes to some per cent; the time goes as their cube."""

MOST = 14_000
"""Rows that can be whitened: a matrix of 1.6 GB, and a minute of work."""


@dataclass(frozen=True, kw_only=True)
class Among(Problem):
    """A problem whose rows small errors move too.

    Attributes:
        inner: with the likeliest small errors among its fixed causes.
        hypotheses, rms: of every small error.
        spread: rms times d reading / d amount, [error, *shape of `valid`].
        amounts_now: of the small errors in the model, [error].
        open: of which family each is, and the covariance of the logarithms of their sizes where
            those were learnt; or None.
    """

    inner: Problem = field(repr=False)
    hypotheses: tuple[Hypothesis, ...] = field(repr=False)
    rms: Array = field(repr=False)
    spread: Array = field(repr=False)
    amounts_now: Array = field(repr=False)
    open: tuple[NDArray[np.int64], Array] | None = field(default=None, repr=False)

    @cached_property
    def rows(self) -> Array:
        """The signatures in rows of the inner problem, [error, row]."""
        return self.inner.as_rows(self.spread)

    @cached_property
    def _factor(self) -> Array:
        """Inverse of the Cholesky factor of the rows' covariance."""
        covariance = self.rows.T @ self.rows
        covariance[np.diag_indices(len(covariance))] += 1.0
        factor = cholesky(covariance, lower=True, overwrite_a=True, check_finite=False)
        inverse, failed = dtrtri(factor, lower=1, overwrite_c=1)
        assert failed == 0
        return np.asarray(np.tril(inverse))

    def white(self, rows: Array) -> Array:
        """Rows [..., row] of the inner problem in the covariance of all."""
        return np.asarray(rows @ self._factor.T)

    # --- the model ------------------------------------------------------------------------------
    @property
    def first(self) -> Array:
        """Of the inner one."""
        return self.inner.first

    @property
    def free(self) -> int:
        """Of the inner one."""
        return self.inner.free

    @property
    def freedom(self) -> int:
        """Of the inner one."""
        return self.inner.freedom

    def sees(self, hypothesis: Hypothesis) -> bool:
        """As the inner one."""
        return self.inner.sees(hypothesis)

    def at(self, causes: Sequence[Cause], nuisances: Array, kicks: Kicks = NO_KICKS) -> Point:
        """`view` is the inner point."""
        point = self.inner.at(causes, nuisances, kicks)
        if point.projection is None:
            return replace(point, view=point)
        moved = self.amounts_now / self.rms @ self.rows
        return replace(
            point,
            residual=self.white(point.residual + moved),
            projection=Projection(self._factor[None] @ point.projection.matrix()[None]),
            view=point,
        )

    def slope(self, point: Point, cause: int) -> Array:
        """Whitened."""
        return self.white(self.inner.slope(point.view, cause))

    def moved(self, nuisances: Array, change: Array) -> Array:
        """As the inner one."""
        return self.inner.moved(nuisances, change)

    def metric(self, point: Point) -> Metric:
        """Signatures made and whitened."""
        return _AmongMetric(self, point)

    def certainty(self, point: Point, hypothesis: Hypothesis) -> float:
        """By how the variance along it changes with the sizes of small errors."""
        if self.open is None or point.projection is None:
            return np.inf
        family, covariance = self.open
        row = point.projection.out(self.metric(point).rows([hypothesis]))[0]
        squares = (self.rows @ (row @ self._factor)) ** 2
        slope = -2 * np.bincount(family, squares, len(covariance)) / max(float(row @ row), 1e-300)
        return 2 / max(float(slope @ covariance @ slope), 1e-9)

    def everywhere(self) -> "Among":
        """As the inner one."""
        return replace(self, inner=self.inner.everywhere())

    def neighbours(self, hypothesis: Hypothesis, among: Sequence[Hypothesis]) -> list[Hypothesis]:
        """As the inner one."""
        return self.inner.neighbours(hypothesis, among)

    @property
    def kick_places(self) -> Sequence[str]:
        """None: see `Together`."""
        return ()

    def kick_rows(self, point: Point, place: int) -> Array:
        """None."""
        raise NotImplementedError

    # --- readings -------------------------------------------------------------------------------
    @property
    def monitors(self) -> Sequence[str]:
        """Of the inner one."""
        return self.inner.monitors

    @property
    def valid(self) -> Flags:
        """Of the inner one."""
        return self.inner.valid

    def owner(self) -> NDArray[np.int64]:
        """Of the inner one."""
        return self.inner.owner()

    def as_rows(self, readings: Array) -> Array:
        """Whitened."""
        return self.white(self.inner.as_rows(readings))

    def left(self, point: Point) -> tuple[Array, Array]:
        """Among small errors single readings are not looked at: nothing is left of any."""
        return np.zeros(self.valid.shape), np.ones(self.valid.shape)

    def without(self, dropped: Flags) -> Self:
        """The covariance is worked out anew."""
        if not dropped.any():
            return self
        return replace(self, inner=self.inner.without(dropped))

    # --- the small errors -----------------------------------------------------------------------
    def estimate(self, clean: Array) -> Array:
        """The likeliest amounts of the small errors beside what leaves these rows, [error]."""
        return np.asarray(self.rms * (self.rows @ (clean @ self._factor)))


class _AmongMetric(Metric):
    chunk = 256

    def __init__(self, problem: Among, point: Point) -> None:
        assert point.projection is not None
        super().__init__(point.projection)
        self.problem, self.inner = problem, problem.inner.metric(point.view)

    def rows(self, hypotheses: Sequence[Hypothesis]) -> Array:
        return self.problem.white(self.inner.rows(hypotheses))

    def free_monitors(self, clean: Array) -> tuple[Array, Array]:
        """Monitors have errors of their own among the small ones: none is set aside here."""
        count = len(self.problem.monitors)
        return np.zeros((count, 1, 1)), np.zeros((count, 1))


@dataclass(frozen=True)
class Learnt:
    """Small errors as these data show them.

    Attributes:
        problem: among them.
        before: nuisances alone.
        sizes, errors: rms by effect; relative error of each.
        log_evidence: over no small errors.
    """

    problem: Among
    before: Fit
    sizes: Mapping[str, float]
    errors: Mapping[str, float]
    log_evidence: float


def small_errors_of(
    problem: Problem,
    hypotheses: Sequence[Hypothesis],
    rms: Mapping[str, float],
    nuisances: Array,
    causes: Sequence[Cause] = (),
    *,
    learn: bool = True,
) -> Learnt:
    """The background of a machine as these data show it, linear about its likeliest amounts.

    Args:
        problem: of the design.
        hypotheses: every small error.
        rms: their usual size by effect; what is learnt starts there.
        nuisances: first guess.
        causes: what was found already: small errors are taken beside it.
        learn: the sizes are learnt; else they are as given.
    """
    hypotheses = tuple(h for h in hypotheses if problem.sees(h))
    names = list(dict.fromkeys(name for name, _ in hypotheses))
    belongs = np.array([names.index(name) for name, _ in hypotheses])
    sizes = {name: rms[name] for name in names}
    amounts = np.zeros(len(hypotheses))
    evidence, errors, opened = 0.0, dict[str, float](), None
    for turn in range(ROUNDS):
        known = [Cause(*h, a) for h, a in zip(hypotheses, amounts.tolist(), strict=True) if a]
        inner = replace(problem, fixed=(*problem.fixed, *known))
        alone = settled(inner, causes, nuisances)
        if alone.projection is None:
            raise UnstableRingError(f"{alone.lost} with the small errors that the readings show")
        scale = np.array([sizes[name] for name, _ in hypotheses])
        spread = scale[:, None] * _signatures(inner, alone, hypotheses)
        if learn:
            rows = inner.as_rows(spread.reshape(-1, *inner.valid.shape))
            moved = alone.residual + amounts / scale @ rows
            found = _sizes(moved, alone.projection, rows, belongs, len(names))
            evidence = found.log_evidence if turn == 0 else evidence
            errors = dict(zip(names, found.error.tolist(), strict=True))
            opened = (belongs, found.covariance)
            factor = found.scale[belongs]
            scale, spread = factor * scale, factor[:, None] * spread
            sizes = {n: s * float(found.scale[i]) for i, (n, s) in enumerate(sizes.items())}
        among = Among(
            places=problem.places, fixed=(), amounts=problem.amounts, judgement=problem.judgement,
            inner=inner, hypotheses=hypotheses, rms=scale,
            spread=spread.reshape(-1, *inner.valid.shape), amounts_now=amounts, open=opened,
        )  # fmt: skip
        point = settled(among, causes, alone.nuisances)
        assert point.projection is not None
        nuisances = point.nuisances
        amounts = among.estimate(point.projection.out(point.residual))
    before = fit(among, (), nuisances)
    return Learnt(among, before, sizes, errors, evidence)


def _signatures(problem: Problem, point: Point, hypotheses: Sequence[Hypothesis]) -> Array:
    """d reading / d amount in units of the readings' noise, [error, flat]; 0 where there is none.

    Rows are what a kind gives; the readings' own noise is put back so that readings can be left
    out later: `as_rows` of ones says what that is.
    """
    unit = problem.as_rows(np.ones(problem.valid.shape))
    rows = problem.everywhere().metric(point).rows(hypotheses)
    out = np.zeros((len(hypotheses), problem.valid.size))
    out[:, problem.valid.ravel()] = (rows[:, unit > 0]) / unit[unit > 0]
    return out


def _sizes(
    residual: Array,
    projection: Projection,
    rows: Array,
    belongs: NDArray[np.int64],
    families: int,
) -> Sizes:
    """Sizes from as many rows as it takes, taken evenly, nuisances projected out."""
    directions = projection.matrix()
    keep = np.arange(len(residual))
    keep = keep[:: max(-(-len(keep) // ROWS), 1)]
    launch = directions[keep]
    launch = launch[:, np.abs(launch).max(axis=0) > 0]
    size = np.linalg.norm(launch, axis=0)
    basis = np.linalg.qr(launch / size)[0] if launch.shape[1] else np.zeros((len(keep), 0))
    return learn_sizes(
        residual[keep], basis, [rows[belongs == k][:, keep] for k in range(families)]
    )
