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
from tmlattice.inference.newton import Fit, fit, fit_nuisances
from tmlattice.inference.problem import NO_KICKS, Kicks, Point, Problem
from tmlattice.inference.root import Root, inverse_root
from tmlattice.inference.variance_components import VarianceComponents, fit_variance_components
from tmlattice.inference.whitening import Projection

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

LINEARISATIONS = 2
"""Linearisations: about the design, and about the likeliest errors."""

ROWS = 1000
"""Rows from which sizes are learnt: 17 sizes to some per cent; the time goes as their cube."""

MAX_HALVINGS = 4
"""How often a step to the likeliest errors is halved where no beam is stored."""

MAX_SHARE = 0.9999
"""Share that is known at most: what is linear about the likeliest errors is no better than a
hundredth of their size."""

MIN_SHARE = 0.02
"""Share of the variance of a direction that has to be known for it to be remembered."""

MAX_ELEMENTS = 10**8
"""Rows times small errors: 0.8 GB, of which some are held at a time (8 GB at most)."""

AT_ONCE = 2**24
"""Numbers of the rows of small errors that are taken at a time."""


@dataclass(frozen=True)
class DistributedErrors:
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
    def usual(
        cls, hypotheses: Sequence[Hypothesis], rms: Mapping[str, float]
    ) -> "DistributedErrors":
        """About zero, of sizes by effect; nothing was measured."""
        scale = np.array([rms[name] for name, _ in hypotheses])
        return cls(
            tuple(hypotheses), np.zeros(len(scale)), scale, np.zeros((0, len(scale))), np.zeros(0)
        )

    def correlated(self, x: Array) -> Array:
        """Coordinates [error, ...] of independent errors of size 1 as shares of the rms."""
        left = 1 - np.sqrt(1 - self.share)
        return np.asarray(x - self.seen.T @ (left[:, None] * (self.seen @ x.reshape(len(x), -1)))
                          .reshape(-1, *x.shape[1:])) if len(left) else x  # fmt: skip

    def updated(self, amounts: Array, share: Array, seen: Array) -> "DistributedErrors":
        """With more readings.

        Args:
            amounts: the likeliest now, [error].
            share: of the variance that was left, what is known now, [direction].
            seen: of which directions, in the coordinates of `mixed`, [direction, error].
        """
        if len(self.share):  # back to coordinates of the first rms
            left = np.eye(len(amounts)) - (seen.T * share) @ seen
            whole = self.correlated(self.correlated(left).T)
            share, directions = np.linalg.eigh(np.eye(len(amounts)) - whole)
            seen = directions.T
        big = share > MIN_SHARE
        return replace(
            self, amounts=amounts, seen=seen[big], share=np.minimum(share[big], MAX_SHARE)
        )

    @property
    def errors(self) -> Array:
        """Standard deviation of each, [error]."""
        taken = self.share @ self.seen**2 if len(self.share) else 0.0
        return np.asarray(self.rms * np.sqrt(np.maximum(1 - taken, 0.0)))


@dataclass(frozen=True, kw_only=True)
class MarginalProblem(Problem):
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
        """As the kind has it, or signatures made and whitened."""
        assert point.projection is not None
        fast = self.inner.metric_among(point.view, self._root, point.projection)
        return _MarginalMetric(self, point) if fast is None else fast

    @property
    def kick_places(self) -> Sequence[str]:
        """Of the inner one."""
        return self.inner.kick_places

    def kick_rows(self, point: Point, place: int) -> Array:
        """Whitened."""
        return self.white(self.inner.kick_rows(point.view, place))

    def everywhere(self) -> Self:
        """As the inner one."""
        return replace(self, inner=self.inner.everywhere())

    @property
    def alone(self) -> bool:
        """As the inner one."""
        return self.inner.alone

    def with_fixed(self, causes: Sequence[Cause]) -> Self:
        """The same errors of size 1 beside further fixed causes."""
        other = replace(self, inner=self.inner.with_fixed(causes))
        vars(other)["_root"] = self._root
        return other

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
        """What is left of each reading given those before it, where the kind has single ones."""
        assert point.projection is not None
        alone, size = self.inner.left(point.view)
        clean = point.projection.out(point.residual)
        clean = clean[self.inner.as_rows(np.ones(self.valid.shape)) > 0]
        left = np.zeros(self.valid.shape)
        left[self.valid] = clean
        return np.where(alone == 0, 0.0, left), np.ones_like(size)

    def without(self, dropped: Flags) -> Self:
        """The covariance is worked out anew."""
        if not dropped.any():
            return self
        return replace(self, inner=self.inner.without(dropped))


@dataclass(frozen=True, kw_only=True)
class DistributedProblem(MarginalProblem):
    """A problem among small errors.

    Its inner problem has the likeliest small errors among its fixed causes, its errors are the
    coordinates of `known.mixed`, and its shift is what the amounts in the model, beyond the
    likeliest beforehand, make of the readings.

    Attributes:
        known: of the small errors beforehand.
        about: their amounts in the model, [error].
        open: of which family each is, and the covariance of the logarithms of their sizes where
            those were learnt; or None.
    """

    known: DistributedErrors = field(repr=False)
    linearised_at: Array = field(repr=False)
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
        amounts = known.amounts + known.rms * known.correlated(self.rows @ self._root.back(clean))
        own = zip(known.hypotheses, amounts.tolist(), strict=True)
        return np.array([find(name).some_left(amount) for (name, _), amount in own])

    def learnt(self, explained: Fit) -> DistributedErrors:
        """What is known of the small errors since, beside an explanation."""
        seen = explained.projection.out(self.white(self.rows))
        share, directions = np.linalg.eigh(seen @ seen.T)
        big = share > MIN_SHARE
        return self.known.updated(self.estimate(explained.clean), share[big], directions[:, big].T)


class _MarginalMetric(Metric):
    chunk = 256

    def __init__(self, problem: MarginalProblem, point: Point) -> None:
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
class FittedErrors:
    """Small errors as these data show them.

    Attributes:
        problem: among them.
        plain: without them, with the noise as learnt.
        before: nuisances alone.
        sizes, errors: rms by effect; relative error of each.
        log_evidence: over no small errors.
        apart: log evidence that the cause given which they were taken is none of them, however
            large its family may be; None: not asked.
    """

    problem: DistributedProblem
    plain: Problem
    before: Fit
    sizes: Mapping[str, float]
    errors: Mapping[str, float]
    log_evidence: float
    outlier_evidence: float | None = None


def fit_distributed_errors(
    problem: Problem,
    known: DistributedErrors,
    nuisances: Array,
    causes: Sequence[Cause] = (),
    *,
    learn: bool = True,
    noisy: bool = False,
    linearised_at: Array | None = None,
    stored: Array | None = None,
    weigh: bool = False,
) -> FittedErrors:
    """The background of a machine as these data show it, linear about its likeliest amounts.

    Args:
        problem: of the design.
        known: of the small errors beforehand; where sizes are learnt they start there.
        nuisances: first guess.
        causes: what was found already: small errors are taken beside it.
        learn: the sizes are learnt; else they are as known.
        noisy: so is the noise, which is a guess.
        about: amounts that it is linearised at, [error]; None: at those that are known, and then at
            the most probable ones.
        weigh: whether the one cause is a small error itself is weighed too.
        stored: amounts at which a beam is stored: `about` goes so far towards them as it has to.

    Raises:
        UnstableRingError: the likeliest small errors leave no stored beam, alone or beside the
            causes.
    """
    names, belongs = families_of(known)
    amounts = known.amounts if linearised_at is None else linearised_at
    stored = amounts if stored is None else stored
    evidence, errors, opened, outlier_evidence = 0.0, dict[str, float](), None, None
    for turn in range(LINEARISATIONS if linearised_at is None else 1):
        inner, alone, amounts = linearise(problem, known, amounts, stored, causes, nuisances)
        assert alone.projection is not None
        stored = amounts
        slopes = signatures_of(inner, alone, known.hypotheses)
        slopes *= chain_factors(known, amounts)[:, None]
        shift = (amounts - known.amounts) @ slopes
        spread = known.correlated(known.rms[:, None] * slopes)
        if learn:
            moved = alone.residual + inner.as_rows(shift.reshape(inner.valid.shape))
            keep = sampled_rows(len(moved))
            rows = inner.as_rows(spread.reshape(-1, *inner.valid.shape))
            noise = [part[keep] for part in inner.noise_rows()] if noisy else []
            directions = alone.projection.matrix()[keep]
            found = components_of_rows(moved[keep], directions, rows[:, keep], belongs, noise)
            if weigh:  # as one of them
                i = known.hypotheses.index((causes[0].effect, causes[0].element))
                some, amount = rows[:, keep], causes[0].amount
                some[i] *= find(causes[0].effect).chain(amount)
                whole = moved[keep] + amount / known.rms[i] * some[i]
                other = components_of_rows(whole, directions, some, belongs, noise)
                outlier_evidence = found.log_marginal - other.log_marginal
            if noise:
                problem, inner = (own.noisier(found.noise) for own in (problem, inner))
            evidence = found.log_evidence if turn == 0 else evidence
            errors = dict(zip(names, found.error.tolist(), strict=True))
            opened = (belongs, found.covariance)
            known = replace(known, rms=known.rms * found.scale[belongs])
            spread *= found.scale[belongs][:, None]
        among = DistributedProblem(
            places=problem.places, rare=problem.rare, fixed=(), amounts=problem.amounts,
            judgement=problem.judgement, inner=inner, known=known, linearised_at=amounts,
            spread=spread.reshape(-1, *inner.valid.shape),
            shift=shift.reshape(inner.valid.shape), open=opened,
        )  # fmt: skip
        point = fit_nuisances(among, causes, alone.nuisances)
        assert point.projection is not None
        nuisances = point.nuisances
        amounts = among.estimate(point.projection.out(point.residual))
    before = fit(among, (), nuisances)
    if before.point.lost:
        raise UnstableRingError(f"{before.point.lost} without what was found beside small errors")
    sizes = {name: float(known.rms[belongs == i][0]) for i, name in enumerate(names)}
    return FittedErrors(among, problem, before, sizes, errors, evidence, outlier_evidence)


def signatures_of(problem: Problem, point: Point, hypotheses: Sequence[Hypothesis]) -> Array:
    """d reading / d amount in units of the readings' noise, [error, flat]; 0 where there is none.

    Rows are what a kind gives; the readings' own noise is put back so that readings can be left
    out later: `as_rows` of ones says what that is.
    """
    unit = problem.as_rows(np.ones(problem.valid.shape))
    linearised_at, there = problem.everywhere().metric(point), unit > 0
    out = np.zeros((len(hypotheses), problem.valid.size))
    count = max(AT_ONCE // len(unit), 1)
    for start in range(0, len(hypotheses), count):
        some = slice(start, start + count)
        rows = linearised_at.rows(hypotheses[some])
        out[some, problem.valid.ravel()] = rows[:, there] / unit[there]
    return out


def families_of(known: DistributedErrors) -> tuple[list[str], NDArray[np.int64]]:
    """Effects that have a size, and of which each error is, [error]."""
    names = list(dict.fromkeys(name for name, _ in known.hypotheses))
    return names, np.array([names.index(name) for name, _ in known.hypotheses])


def linearise(
    problem: Problem,
    known: DistributedErrors,
    amounts: Array,
    stored: Array,
    causes: Sequence[Cause],
    nuisances: Array,
) -> tuple[Problem, Point, Array]:
    """The problem with small errors in it as near to some amounts as a beam is stored, the point
    of the causes there, and those amounts.

    Args:
        problem, causes, nuisances, known: see `small_errors_of`.
        amounts: wanted, [error].
        stored: amounts at which there is a beam; the same ones: that is not known.

    Raises:
        UnstableRingError: there is none near enough.
    """
    first = amounts is stored
    for turn in range(MAX_HALVINGS):
        own = zip(known.hypotheses, amounts.tolist(), strict=True)
        there = [Cause(*h, a) for h, a in own if a]
        inner = replace(problem, fixed=(*problem.fixed, *there))
        alone = fit_nuisances(inner, causes, nuisances)
        if alone.projection is not None:
            return inner, alone, amounts
        if first:
            break
        # too far for what is linear
        amounts = stored if turn == MAX_HALVINGS - 2 else (amounts + stored) / 2
    raise UnstableRingError(f"{alone.lost} with the small errors that the readings show")


def chain_factors(known: DistributedErrors, amounts: Array) -> Array:
    """d readings / d amount over signatures, of each, see `Effect.chain`."""
    own = zip(known.hypotheses, amounts, strict=True)
    return np.array([find(name).chain(amount) for (name, _), amount in own])


def sampled_rows(count: int) -> NDArray[np.int64]:
    """Rows from which sizes are learnt: drawn once and for all, so that planes and monitors, which
    come in turns, all have their share."""
    if count <= ROWS:
        return np.arange(count)
    return np.sort(np.random.default_rng(0).choice(count, ROWS, replace=False))


def components_of_rows(
    residual: Array,
    directions: Array,
    rows: Array,
    belongs: NDArray[np.int64],
    noise: Sequence[Flags] = (),
) -> VarianceComponents:
    """Sizes from some rows.

    Args:
        residual: what is left, [row].
        directions: of the nuisances, [row, coordinate].
        rows: what errors of size 1 make, [error, row].
        belongs: family of each error, [error].
        noise: parts of the rows whose noise is learnt too, [row] each.
    """
    launch = directions[:, np.abs(directions).max(axis=0) > 0]
    size = np.linalg.norm(launch, axis=0)
    basis = np.linalg.qr(launch / size)[0] if launch.shape[1] else np.zeros((len(residual), 0))
    there = basis.any(axis=1)  # nobody read the others, which have no noise
    there = np.any(noise, axis=0) | there if noise else np.ones_like(there)
    families = [rows[belongs == k][:, there] for k in range(belongs.max() + 1)]
    return fit_variance_components(
        residual[there], basis[there], families, [part[there] for part in noise]
    )
