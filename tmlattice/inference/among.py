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

from tmlattice.effects import Cause, find
from tmlattice.errors import UnstableRingError
from tmlattice.inference.metric import Hypothesis, Metric
from tmlattice.inference.newton import Fit, fit, settled
from tmlattice.inference.problem import NO_KICKS, Kicks, Point, Problem
from tmlattice.inference.root import Root, inverse_root
from tmlattice.inference.sizes import Sizes, learn_sizes
from tmlattice.inference.whitening import Projection

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

ROUNDS = 2
"""Linearisations: about the design, and about the likeliest errors."""

ROWS = 1600
"""Rows from which sizes are learnt: 17 sizes to some per cent; the time goes as their cube."""

HALVES = 4
"""How often a step to the likeliest errors is halved where no beam is stored."""

BEST = 0.9999
"""Share that is known at most: what is linear about the likeliest errors is no better than a
hundredth of their size."""

LEAST = 0.02
"""Share of the variance of a direction that has to be known for it to be remembered."""

MOST = 10**8
"""Rows times small errors: 0.8 GB, of which some are held at a time (8 GB at most)."""

AT_ONCE = 256
"""Small errors whose rows are taken at a time."""


@dataclass(frozen=True)
class Known:
    """What is known of small errors beforehand: Gaussian, about some amounts.

    The covariance is rms (1 - sum_d share_d v_d v_d^T) rms: of the directions v something was
    measured already.

    Attributes:
        hypotheses: every small error.
        amounts: the likeliest, [error].
        rms: of each before anything was measured, [error].
        seen: orthonormal directions in units of the rms, [direction, error].
        share: of the variance of each that is known since, [direction].
        causes: what is there besides, for certain.
    """

    hypotheses: tuple[Hypothesis, ...]
    amounts: Array = field(repr=False)
    rms: Array = field(repr=False)
    seen: Array = field(repr=False)
    share: Array = field(repr=False)
    causes: tuple[Cause, ...] = ()

    @classmethod
    def usual(cls, hypotheses: Sequence[Hypothesis], rms: Mapping[str, float]) -> "Known":
        """About zero, of sizes by effect; nothing was measured."""
        scale = np.array([rms[name] for name, _ in hypotheses])
        return cls(
            tuple(hypotheses), np.zeros(len(scale)), scale, np.zeros((0, len(scale))), np.zeros(0)
        )

    def mixed(self, x: Array) -> Array:
        """Coordinates [error, ...] of independent errors of size 1 as shares of the rms."""
        left = 1 - np.sqrt(1 - self.share)
        return np.asarray(x - self.seen.T @ (left[:, None] * (self.seen @ x.reshape(len(x), -1)))
                          .reshape(-1, *x.shape[1:])) if len(left) else x  # fmt: skip

    @property
    def errors(self) -> Array:
        """Standard deviation of each, [error]."""
        taken = self.share @ self.seen**2 if len(self.share) else 0.0
        return np.asarray(self.rms * np.sqrt(np.maximum(1 - taken, 0.0)))


@dataclass(frozen=True, kw_only=True)
class Blurred(Problem):
    """A problem whose rows errors move too that nobody asks for: Gaussian, of size 1.

    Attributes:
        inner: what is asked.
        spread: d reading / d error, [error, *shape of `valid`].
        shift: what is to be put back on the readings, of the shape of `valid`; or 0.
    """

    inner: Problem = field(repr=False)
    spread: Array = field(repr=False)
    shift: Array | float = field(default=0.0, repr=False)

    @cached_property
    def rows(self) -> Array:
        """The signatures in rows of the inner problem, [error, row]."""
        return self.inner.as_rows(self.spread)

    @cached_property
    def _shifted(self) -> Array | float:
        return self.inner.as_rows(self.shift) if isinstance(self.shift, np.ndarray) else self.shift

    @cached_property
    def _root(self) -> Root:
        return inverse_root(self.rows)

    @property
    def log_scale(self) -> float:
        """Of the rows' density beside the exponential of chi-square: -1/2 log det of their
        covariance, by which explanations among other small errors compare."""
        return self._root.log_scale

    def white(self, rows: Array) -> Array:
        """Rows [..., row] of the inner problem in the covariance of all."""
        return self._root.white(rows)

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
        return replace(
            point,
            residual=self.white(point.residual + self._shifted),
            projection=Projection(self.white(point.projection.matrix().T).T[None]),
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
        return _BlurredMetric(self, point)

    def everywhere(self) -> Self:
        """As the inner one."""
        return replace(self, inner=self.inner.everywhere())

    def neighbours(self, hypothesis: Hypothesis, among: Sequence[Hypothesis]) -> list[Hypothesis]:
        """As the inner one."""
        return self.inner.neighbours(hypothesis, among)

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


@dataclass(frozen=True, kw_only=True)
class Among(Blurred):
    """A problem among small errors.

    Its inner problem has the likeliest small errors among its fixed causes, its errors are the
    coordinates of `known.mixed`, and its shift is what the amounts in the model, beyond the
    likeliest beforehand, make of the readings.

    Attributes:
        known: of the small errors beforehand.
        open: of which family each is, and the covariance of the logarithms of their sizes where
            those were learnt; or None.
    """

    known: Known = field(repr=False)
    open: tuple[NDArray[np.int64], Array] | None = field(default=None, repr=False)

    def certainty(self, point: Point, hypothesis: Hypothesis) -> float:
        """By how the variance along it changes with the sizes of small errors."""
        if self.open is None or point.projection is None:
            return np.inf
        family, covariance = self.open
        row = point.projection.out(self.metric(point).rows([hypothesis]))[0]
        squares = (self.rows @ self._root.back(row)) ** 2
        slope = -2 * np.bincount(family, squares, len(covariance)) / max(float(row @ row), 1e-300)
        return 2 / max(float(slope @ covariance @ slope), 1e-9)

    def estimate(self, clean: Array) -> Array:
        """The likeliest amounts of the small errors beside what leaves these rows, [error]."""
        known = self.known
        amounts = known.amounts + known.rms * known.mixed(self.rows @ self._root.back(clean))
        own = zip(known.hypotheses, amounts.tolist(), strict=True)
        return np.array([find(name).some_left(amount) for (name, _), amount in own])

    def learnt(self, explained: Fit) -> Known:
        """What is known of the small errors since, beside an explanation."""
        seen = explained.projection.out(self.white(self.rows))
        values, vectors = np.linalg.eigh(seen @ seen.T)
        big = values > LEAST
        # back from the coordinates of what was known to those of the first rms
        left = np.eye(len(values)) - (vectors[:, big] * values[big]) @ vectors[:, big].T
        whole = self.known.mixed(self.known.mixed(left).T)
        share, directions = np.linalg.eigh(np.eye(len(values)) - whole)
        big = share > LEAST
        return replace(
            self.known, amounts=self.estimate(explained.clean), seen=directions[:, big].T,
            share=np.minimum(share[big], BEST),
        )  # fmt: skip


class _BlurredMetric(Metric):
    chunk = 256

    def __init__(self, problem: Blurred, point: Point) -> None:
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
    known: Known,
    nuisances: Array,
    causes: Sequence[Cause] = (),
    *,
    learn: bool = True,
    about: Array | None = None,
) -> Learnt:
    """The background of a machine as these data show it, linear about its likeliest amounts.

    Args:
        problem: of the design.
        known: of the small errors beforehand; where sizes are learnt they start there.
        nuisances: first guess.
        causes: what was found already: small errors are taken beside it.
        learn: the sizes are learnt; else they are as known.
        about: amounts from which on it is linear at first, [error]; None: those that are known.

    Raises:
        UnstableRingError: the likeliest small errors leave no stored beam, alone or beside the
            causes.
    """
    names = list(dict.fromkeys(name for name, _ in known.hypotheses))
    belongs = np.array([names.index(name) for name, _ in known.hypotheses])
    amounts = stored = known.amounts if about is None else about
    evidence, errors, opened = 0.0, dict[str, float](), None
    for turn in range(ROUNDS):
        for _ in range(HALVES):
            own = zip(known.hypotheses, amounts.tolist(), strict=True)
            there = [Cause(*h, a) for h, a in own if a]
            inner = replace(problem, fixed=(*problem.fixed, *there))
            alone = settled(inner, causes, nuisances)
            if alone.projection is not None or not turn:
                break
            amounts = (amounts + stored) / 2  # too far for what is linear
        if alone.projection is None:
            raise UnstableRingError(f"{alone.lost} with the small errors that the readings show")
        stored = amounts
        slopes = _signatures(inner, alone, known.hypotheses)
        on = [find(n).chain(a) for (n, _), a in zip(known.hypotheses, amounts, strict=True)]
        slopes *= np.array(on)[:, None]
        shift = (amounts - known.amounts) @ slopes
        spread = known.mixed(known.rms[:, None] * slopes)
        if learn:
            moved = alone.residual + inner.as_rows(shift.reshape(inner.valid.shape))
            found = _sizes(
                moved, alone.projection, inner.as_rows(spread.reshape(-1, *inner.valid.shape)),
                belongs, len(names),
            )  # fmt: skip
            evidence = found.log_evidence if turn == 0 else evidence
            errors = dict(zip(names, found.error.tolist(), strict=True))
            opened = (belongs, found.covariance)
            known = replace(known, rms=known.rms * found.scale[belongs])
            spread *= found.scale[belongs][:, None]
        among = Among(
            places=problem.places, rare=problem.rare, fixed=(), amounts=problem.amounts,
            judgement=problem.judgement, inner=inner, known=known,
            spread=spread.reshape(-1, *inner.valid.shape),
            shift=shift.reshape(inner.valid.shape), open=opened,
        )  # fmt: skip
        point = settled(among, causes, alone.nuisances)
        assert point.projection is not None
        nuisances = point.nuisances
        amounts = among.estimate(point.projection.out(point.residual))
    before = fit(among, (), nuisances)
    if before.point.lost:
        raise UnstableRingError(f"{before.point.lost} without what was found beside small errors")
    sizes = {name: float(known.rms[belongs == i][0]) for i, name in enumerate(names)}
    return Learnt(among, before, sizes, errors, evidence)


def _signatures(problem: Problem, point: Point, hypotheses: Sequence[Hypothesis]) -> Array:
    """d reading / d amount in units of the readings' noise, [error, flat]; 0 where there is none.

    Rows are what a kind gives; the readings' own noise is put back so that readings can be left
    out later: `as_rows` of ones says what that is.
    """
    unit = problem.as_rows(np.ones(problem.valid.shape))
    about, there = problem.everywhere().metric(point), unit > 0
    out = np.zeros((len(hypotheses), problem.valid.size))
    for start in range(0, len(hypotheses), AT_ONCE):
        some = slice(start, start + AT_ONCE)
        rows = about.rows(hypotheses[some])
        out[some, problem.valid.ravel()] = rows[:, there] / unit[there]
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
