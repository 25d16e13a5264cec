"""Problems with distributed errors: rows whitened by the covariance that such errors make.

Distributed errors are Gaussian, and too many to be found one by one. With signatures S (rms times
slope, in rows) the rows have the covariance C = 1 + S^T S. Its inverse root makes them white again,
so that a search works as before. Signatures are linearised at the most probable errors, which are
part of the model; a shift of the rows keeps the errors' prior centred at zero.

Posterior of distributed errors from sums over rows, without storing signatures. With signatures S
(rms times slope, errors x rows) and residual r, the most probable errors are (1 + S S^T)^-1 S r,
and their covariance is (1 + S S^T)^-1. S S^T and S r are summed some rows at a time: memory grows
as the square of the errors, whatever the number of readings. `DistributedProblem` keeps all
signatures, since its search whitens rows by them.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple, Self

import numpy as np
from scipy.linalg import cho_factor, cho_solve, eigh

from tmlattice.arrays import AT_ONCE, TINY, Array, Flags, Indices
from tmlattice.effects import Cause, Hypothesis, find
from tmlattice.errors import UnstableRingError
from tmlattice.inference.newton import ROUNDS, STEP_SHARES, Fit, fit, fit_nuisances
from tmlattice.inference.problem import NO_KICKS, Kicks, Metric, Point, Problem
from tmlattice.inference.variance_components import VarianceComponents, fit_variance_components
from tmlattice.inference.whitening import Projection, Root, inverse_root

LINEAR = 0.1
"""Of chi-square, to which the linear model has to predict that of the full one."""

ROWS = 1000
"""Rows for variance components: 17 of them to some per cent; the time goes as the cube."""


MAX_SHARE = 0.9999
"""Largest share of a variance that data may remove: linearisation leaves a hundredth of the rms."""

MIN_SHARE = 0.02
"""Smallest share of a direction's variance that the data must remove for it to be kept."""

MAX_ELEMENTS = 10**8
"""Rows times distributed errors: 0.8 GB each array, 8 GB for all of them."""


@dataclass(frozen=True)
class DistributedErrors:
    """Gaussian distribution of distributed errors.

    The covariance is rms (1 - sum_d share_d v_d v_d^T) rms, with the directions v that were
    measured.

    Attributes:
        hypotheses: every error.
        amounts: mean, [error].
        rms: prior standard deviations, [error].
        seen: measured directions, orthonormal, in units of the rms, [direction, error].
        share: share of each direction's variance that measurements removed, [direction].
        causes: further causes that are certain.
        scales: covariance of the logarithms of the rms by effect, see `families_of`; None: the
            prior one.
    """

    hypotheses: tuple[Hypothesis, ...]
    amounts: Array = field(repr=False)
    rms: Array = field(repr=False)
    seen: Array = field(repr=False)
    share: Array = field(repr=False)
    causes: tuple[Cause, ...] = ()
    scales: Array | None = field(default=None, repr=False)

    @classmethod
    def usual(
        cls, hypotheses: Sequence[Hypothesis], rms: Mapping[str, float]
    ) -> "DistributedErrors":
        """Return the prior with zero mean and one rms per effect."""
        scale = np.array([rms[name] for name, _ in hypotheses])
        return cls(
            tuple(hypotheses), np.zeros(len(scale)), scale, np.zeros((0, len(scale))), np.zeros(0)
        )

    def extended(self, hypotheses: Iterable[Hypothesis]) -> "DistributedErrors":
        """Return the distribution with errors of its effects at places that it lacks."""
        there, rms = set(self.hypotheses), sizes_of(self)
        more = [h for h in hypotheses if h[0] in rms and h not in there]
        new = DistributedErrors.usual(more, rms)
        return replace(
            self, hypotheses=(*self.hypotheses, *more),
            amounts=np.append(self.amounts, new.amounts), rms=np.append(self.rms, new.rms),
            seen=np.pad(self.seen, ((0, 0), (0, len(more)))),
        )  # fmt: skip

    def correlated(self, x: Array) -> Array:
        """Correlated errors in units of the rms, from independent ones of size 1, [error, ...]."""
        left = 1 - np.sqrt(1 - self.share)
        return np.asarray(x - self.seen.T @ (left[:, None] * (self.seen @ x.reshape(len(x), -1)))
                          .reshape(-1, *x.shape[1:])) if len(left) else x  # fmt: skip

    def amounts_at(self, x: Array) -> Array:
        """Amounts at independent errors of size 1 [error], within their bounds, [error]."""
        amounts = (self.amounts + self.rms * self.correlated(x)).tolist()
        own = zip(self.hypotheses, amounts, strict=True)
        return np.array([find(name).floored(amount) for (name, _), amount in own])

    def independent(self, change: Array) -> Array:
        """A change of the amounts in independent errors of size 1, [error]: `correlated` undone."""
        own = change / self.rms
        return np.asarray(own + ((1 - self.share) ** -0.5 - 1) * (self.seen @ own) @ self.seen)

    def square(self, amounts: Array) -> float:
        """Sum of squares of the independent errors: the prior's part of the cost."""
        own = self.independent(amounts - self.amounts)
        return float(own @ own)

    def updated(self, amounts: Array, share: Array, seen: Array) -> "DistributedErrors":
        """Return the distribution after more readings.

        Args:
            amounts: new mean, [error].
            share: share of each direction's remaining variance that they removed, [direction].
            seen: these directions in the coordinates of `correlated`, [direction, error].
        """
        if len(self.share):  # back to units of the prior rms
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
        """Standard deviations, [error]."""
        taken = self.share @ self.seen**2 if len(self.share) else 0.0
        return np.asarray(self.rms * np.sqrt(np.maximum(1 - taken, 0.0)))


def _of_inner(name: str) -> Any:
    """A property or a method of the inner problem."""
    return property(lambda problem: getattr(problem.inner, name))


@dataclass(frozen=True, kw_only=True)
class MarginalProblem(Problem):
    """A problem with nuisance errors integrated out: Gaussian, of size 1.

    Attributes:
        inner: the problem given these errors.
        spread: d reading / d error, [error, *shape of `valid`].
        shift: offset of the readings, of the shape of `valid`; or 0.
    """

    inner: Problem = field(repr=False)
    spread: Array = field(repr=False)
    shift: Array | float = field(default=0.0, repr=False)

    @cached_property
    def rows(self) -> Array:
        """The errors' signatures in rows of the inner problem, [error, row]."""
        return self.inner.as_rows(self.spread)

    @cached_property
    def white_rows(self) -> Array:
        """The errors' signatures in whitened rows, [error, row]."""
        return self.white(self.rows)

    @cached_property
    def _shifted(self) -> Array | float:
        return self.inner.as_rows(self.shift) if isinstance(self.shift, np.ndarray) else self.shift

    @cached_property
    def _root(self) -> Root:
        return inverse_root(self.rows)

    @property
    def log_scale(self) -> float:
        """Log density of the rows beyond exp(-chi2 / 2): -1/2 log det of their covariance."""
        return self._root.log_scale

    def white(self, rows: Array) -> Array:
        """Rows [..., row] of the inner problem, whitened."""
        return self._root.white(rows)

    # --- as in the inner problem ----------------------------------------------------------------
    first = _of_inner("first")
    free = _of_inner("free")
    freedom = _of_inner("freedom")
    alone = _of_inner("alone")
    monitors = _of_inner("monitors")
    valid = _of_inner("valid")
    kick_places = _of_inner("kick_places")
    sees = _of_inner("sees")
    moved = _of_inner("moved")
    neighbours = _of_inner("neighbours")
    owner = _of_inner("owner")

    # --- the model ------------------------------------------------------------------------------
    def at(self, causes: Sequence[Cause], nuisances: Array, kicks: Kicks = NO_KICKS) -> Point:
        """Return the model's point; its `view` is the inner problem's."""
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
        """Return the whitened slope, [row]."""
        return self.white(self.inner.slope(point.view, cause))

    def metric(self, point: Point) -> Metric:
        """Return the kind's own products, or those of whitened signatures."""
        assert point.projection is not None
        every = slice(0, len(point.residual))
        fast = self.inner.metric_among(point.view, self._root, every, point.projection)
        return _MarginalMetric(self, point) if fast is None else fast

    def kick_rows(self, point: Point, place: int) -> Array:
        """Return the whitened rows, [parameter, row]."""
        return self.white(self.inner.kick_rows(point.view, place))

    def with_fixed(self, causes: Sequence[Cause]) -> Self:
        """Return the problem with further fixed causes and the same errors."""
        return self._around(self.inner.with_fixed(causes))

    def near(self, causes: Sequence[Cause]) -> Self:
        """Return the problem near these causes, and the same errors."""
        inner = self.inner.near(causes)
        return self if inner is self.inner else self._around(inner)

    def _around(self, inner: Problem) -> Self:
        other = replace(self, inner=inner)
        vars(other)["_root"] = self._root
        return other

    # --- readings -------------------------------------------------------------------------------
    def as_rows(self, readings: Array) -> Array:
        """Return whitened rows, [..., row]."""
        return self.white(self.inner.as_rows(readings))

    def left(self, point: Point) -> tuple[Array, Array]:
        """Residual of each reading given all others, over its error given these and the nuisances;
        and the share of its information that nuisances leave."""
        assert point.projection is not None
        alone, _ = self.inner.left(point.view)
        there = self.inner.as_rows(np.ones(self.valid.shape)) > 0
        (Q,) = point.projection.Q
        information = self._root.information
        left, share = np.zeros(self.valid.shape), np.ones(self.valid.shape)
        clean = self._root.back(point.projection.out(point.residual))
        left[self.valid] = (clean / np.sqrt(information))[there]
        taken = (self._root.back(Q.T) ** 2).sum(axis=0) / information
        share[self.valid] = 1 - taken[there]
        return np.where(alone == 0, 0.0, left), share

    def without(self, dropped: Flags) -> Self:
        """Return the problem without some readings; its covariance is computed anew."""
        if not dropped.any():
            return self
        return replace(self, inner=self.inner.without(dropped))


@dataclass(frozen=True, kw_only=True)
class DistributedProblem(MarginalProblem):
    """A problem with distributed errors.

    The inner problem has the linearisation's amounts among its fixed causes. The errors are the
    coordinates of `known.correlated`; the shift moves readings from these amounts to the mean.

    Attributes:
        known: distribution of the errors before these data.
        linearised_at: amounts in the model, [error].
        open: family of each error, and covariance of the log scales that were estimated; or None.
    """

    known: DistributedErrors = field(repr=False)
    linearised_at: Array = field(repr=False)
    open: tuple[Indices, Array] | None = field(default=None, repr=False)

    def certainty(self, point: Point, hypothesis: Hypothesis) -> float:
        """Degrees of freedom of the variance along a hypothesis, from the scales' covariance."""
        if self.open is None or point.projection is None:
            return np.inf
        family, covariance = self.open
        row = point.projection.out(self.metric(point).rows([hypothesis]))[0]
        squares = (self.rows @ self._root.back(row)) ** 2
        slope = -2 * np.bincount(family, squares, len(covariance)) / max(float(row @ row), TINY)
        return 2 / max(float(slope @ covariance @ slope), 1e-9)

    def coordinates(self, clean: Array) -> Array:
        """Most probable errors of size 1, given the rows that remain, [error]."""
        return self.rows @ self._root.back(clean)

    def estimate(self, clean: Array) -> Array:
        """Most probable amounts of the errors, given the rows that remain, [error]."""
        return self.known.amounts_at(self.coordinates(clean))

    def learnt(self, explained: Fit) -> DistributedErrors:
        """Distribution of the errors given an explanation."""
        seen = explained.projection.out(self.white_rows)
        share, directions = np.linalg.eigh(seen @ seen.T)
        big = share > MIN_SHARE
        return self.known.updated(self.estimate(explained.clean), share[big], directions[:, big].T)


class _MarginalMetric(Metric):
    def __init__(self, problem: MarginalProblem, point: Point) -> None:
        assert point.projection is not None
        super().__init__(point.projection)
        self.problem, self.inner = problem, problem.inner.metric(point.view)

    def rows(self, hypotheses: Sequence[Hypothesis]) -> Array:
        return self.problem.white(self.inner.rows(hypotheses))

    def free_monitors(self, clean: Array) -> tuple[Array, Array]:
        """Return no information: monitor errors are part of the distributed ones."""
        count = len(self.problem.monitors)
        return np.zeros((count, 1, 1)), np.zeros((count, 1))


@dataclass(frozen=True)
class FittedErrors:
    """Distributed errors as estimated from data.

    Attributes:
        problem: with these errors.
        plain: without them, with the noise as estimated.
        before: fit of the nuisances alone.
        sizes, errors: rms by effect; relative error of each that was estimated.
        log_evidence: over no distributed errors.
        log_marginal: log marginal likelihood of the sampled rows.
        outlier_evidence: log evidence that the one cause is a fault rather than a member of its
            family of errors; None: not computed.
    """

    problem: DistributedProblem
    plain: Problem
    before: Fit
    sizes: Mapping[str, float]
    errors: Mapping[str, float] = field(default_factory=dict)
    log_evidence: float = 0.0
    log_marginal: float = 0.0
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
    """Return the distributed errors of a machine, linearised at their most probable amounts.

    Args:
        problem: of the design.
        known: distribution of the errors before these data, with initial scales.
        nuisances: first guess.
        causes: causes that are fitted together with the errors.
        learn: estimate the scales; else they stay.
        noisy: estimate the noise too.
        linearised_at: [error]; None: the mean of `known`, then the most probable amounts.
        weigh: compare the one cause with a member of its family (`outlier_evidence`).
        stored: amounts with a stored beam, towards which `linearised_at` is moved if needed.

    Raises:
        UnstableRingError: no beam is stored with the most probable errors.
    """

    def at(inner: Problem, point: Point, amounts: Array) -> DistributedProblem:
        slopes = slopes_of(inner, point, known, amounts)
        shift = ((amounts - known.amounts) @ slopes).reshape(inner.valid.shape)
        spread = known.correlated(known.rms[:, None] * slopes).reshape(-1, *inner.valid.shape)
        return DistributedProblem(
            places=problem.places, rare=problem.rare, fixed=(), amounts=problem.amounts,
            judgement=problem.judgement, inner=inner, known=known, linearised_at=amounts,
            spread=spread, shift=shift,
        )  # fmt: skip

    def solved(inner: Problem, point: Point, amounts: Array) -> Linear:
        among = at(inner, point, amounts)
        there = among.at(causes, point.nuisances)
        assert there.projection is not None
        clean = there.projection.out(there.residual)
        change = there.projection.coordinates(there.residual)
        moved = among.moved(point.nuisances, change) if len(change) else point.nuisances
        return Linear(among, point, among.estimate(clean), float(clean @ clean), moved)

    if linearised_at is None:
        made = most_probable(problem, known, known.amounts, causes, nuisances, solved)
        among, point = made.made, made.point
    else:
        stored = linearised_at if stored is None else stored
        inner, point, amounts = linearise(problem, known, linearised_at, stored, causes, nuisances)
        among = at(inner, point, amounts)
    if learn:
        return _scaled(among, problem, point, causes, noisy, weigh)
    return FittedErrors(among, problem, _without_causes(among, point), sizes_of(known))


def full_chi2(errors: FittedErrors, found: Fit, dropped: Flags) -> float:
    """Return chi-square of the full model and of the errors' prior, which the linear one predicts.

    Args:
        errors: distributed errors.
        found: causes in the linear model.
        dropped: rejected readings, of the problem's shape.
    """
    problem, known = errors.problem, errors.problem.known
    independent = problem.coordinates(found.clean)
    amounts = known.amounts_at(independent)
    plain = errors.plain.without(dropped)
    try:
        _, there, _ = linearise(plain, known, amounts, amounts, found.causes, found.nuisances)
    except UnstableRingError:
        return float(np.inf)
    return there.chi2 + float(independent @ independent)


def rescaled(
    errors: FittedErrors, causes: Sequence[Cause], nuisances: Array, noisy: bool
) -> FittedErrors:
    """Return the same linearisation with scales estimated together with causes.

    Args:
        errors: distributed errors, linearised at or near the causes.
        causes, nuisances, noisy: see `fit_distributed_errors`.
    """
    point = fit_nuisances(errors.problem.inner, causes, nuisances)
    return _scaled(errors.problem, errors.plain, point, causes, noisy)


def _scaled(
    problem: DistributedProblem, plain: Problem, point: Point, causes: Sequence[Cause],
    noisy: bool, weigh: bool = False,
) -> FittedErrors:  # fmt: skip
    """Estimate the scales, and the noise, at a point of the problem without distributed errors."""
    inner, known = problem.inner, problem.known
    assert point.projection is not None
    names, belongs = families_of(known)
    keep = sampled_rows(len(point.residual))
    moved = point.residual[keep] + inner.as_rows(np.asarray(problem.shift))[keep]
    rows = problem.rows[:, keep]
    noise = [part[keep] for part in inner.noise_rows()] if noisy else []
    directions = point.projection.matrix()[keep]
    found = components_of_rows(moved, directions, rows, belongs, noise)
    outlier_evidence = None
    if weigh:  # as a member of its family
        i = known.hypotheses.index((causes[0].effect, causes[0].element))
        amount = causes[0].amount
        rows[i] *= find(causes[0].effect).chain(amount)
        whole = moved + amount / known.rms[i] * rows[i]
        other = components_of_rows(whole, directions, rows, belongs, noise)
        outlier_evidence = found.log_marginal - other.log_marginal
    scale = found.scale[belongs]
    if noise:
        plain, inner = (own.noisier(found.noise) for own in (plain, inner))
    known = replace(known, rms=known.rms * scale)
    spread = problem.spread * scale.reshape(-1, *[1] * (problem.spread.ndim - 1))
    opened = (belongs, found.covariance)
    problem = replace(problem, inner=inner, known=known, spread=spread, open=opened)
    errors = dict(zip(names, found.error.tolist(), strict=True))
    return FittedErrors(
        problem, plain, _without_causes(problem, point), sizes_of(known), errors,
        found.log_evidence, found.log_marginal, outlier_evidence,
    )  # fmt: skip


def sizes_of(known: DistributedErrors) -> dict[str, float]:
    """Return the prior standard deviation of each effect."""
    return {name: rms for (name, _), rms in zip(known.hypotheses, known.rms.tolist(), strict=True)}


def _without_causes(problem: Problem, point: Point) -> Fit:
    """Fit the nuisances alone, from those of a point."""
    before = fit(problem, (), point.nuisances)
    if before.point.lost:
        raise UnstableRingError(f"{before.point.lost} with distributed errors, without the causes")
    return before


def slopes_of(problem: Problem, point: Point, known: DistributedErrors, amounts: Array) -> Array:
    """d reading / d amount at some amounts, [error, flat]; 0 where missing.

    The noise is put back, so that readings can be dropped later: `as_rows` of ones gives it.
    """
    hypotheses = known.hypotheses
    linearised_at = problem.everywhere().metric(point)
    out = np.zeros((len(hypotheses), problem.valid.size))
    count = max(AT_ONCE // len(point.residual), 1)
    for start in range(0, len(hypotheses), count):
        some = slice(start, start + count)
        out[some] = as_readings(problem, linearised_at.rows(hypotheses[some]))
    out *= chain_factors(known, amounts)[:, None]
    return out


def as_readings(problem: Problem, rows: Array) -> Array:
    """Readings [..., flat] of rows [..., row]; 0 where missing. Their noise is uncorrelated."""
    unit = problem.as_rows(np.ones(problem.valid.shape))
    there = unit > 0
    out = np.zeros((*rows.shape[:-1], problem.valid.size))
    out[..., problem.valid.ravel()] = rows[..., there] / unit[there]
    return out


def families_of(known: DistributedErrors) -> tuple[list[str], Indices]:
    """Effects in `known`, and the index of each error's effect, [error]."""
    names = list(dict.fromkeys(name for name, _ in known.hypotheses))
    return names, np.array([names.index(name) for name, _ in known.hypotheses])


class Linear(NamedTuple):
    """A linearisation at some amounts, and its most probable ones.

    Attributes:
        made: the linear problem, or its sums.
        point: of the causes, at the amounts.
        amounts: most probable, as far as a beam is stored, [error].
        cost: expected there: chi-square and `DistributedErrors.square`.
        nuisances: most probable.
    """

    made: Any
    point: Point
    amounts: Array
    cost: float
    nuisances: Array


def most_probable(
    problem: Problem,
    known: DistributedErrors,
    amounts: Array,
    causes: Sequence[Cause],
    nuisances: Array,
    solved: Callable[[Problem, Point, Array], Linear],
    partly: bool = False,
) -> Linear:
    """Return the linearisation at the most probable amounts.

    Where orbits are large in strong sextupoles, a beam's whole way is too nonlinear for steps from
    the design. The amounts are then those of its first half, quarter, ..., and a further part of
    the way follows, as a machine is threaded.

    Args:
        problem, known, causes, nuisances: see `fit_distributed_errors`.
        amounts: first ones, [error].
        solved: makes the linear problem, and solves it.
        partly: of as much of the way as the model explains, if it is not all.

    Raises:
        UnstableRingError: no beam is stored with the first amounts.
    """

    def settled(part: Problem, near: Array, begun: Array, whole: bool) -> tuple[Linear, bool]:
        """The linearisation of some readings, and whether it predicts the cost at its amounts.

        Steps may raise the cost: where noise is small, they leave a curved valley and come back.
        """
        inner, point, near = linearise(part, known, near, near, causes, begun)
        for _ in range(ROUNDS):
            found, last_near = solved(inner, point, near), near
            inner, point, near = linearise(
                part, known, found.amounts, near, causes, found.nuisances
            )
            cost = point.chi2 + known.square(near)
            if near is last_near or abs(cost - found.cost) < LINEAR * (1.0 if whole else cost):
                break  # no step stores a beam, or the errors are linear
        return found._replace(amounts=near), abs(cost - found.cost) < LINEAR * cost

    way, done, step = problem.way(), 0.0, 1.0
    smallest = 1 / len(np.unique(way))
    failed: Linear | UnstableRingError | None = None
    last: Linear | None = None
    while True:
        share = min(done + step, 1.0)
        part = problem.without(problem.valid & (way > share))
        found: Linear | UnstableRingError
        try:
            begun = nuisances if step == 1 or done else problem.first
            found, good = settled(part, amounts, begun, share == 1)
        except UnstableRingError as error:
            found, good = error, False
        if good:
            assert isinstance(found, Linear)
            if share == 1:
                return found
            last, done, step = found, share, 2 * step
            amounts, nuisances = found.amounts, found.nuisances
            continue
        failed = failed or found
        if step > smallest:
            step /= 2
        elif partly and last is not None:
            return last
        elif isinstance(failed, Linear):
            return failed
        else:
            raise failed


def linearise(
    problem: Problem,
    known: DistributedErrors,
    amounts: Array,
    stored: Array,
    causes: Sequence[Cause],
    nuisances: Array,
) -> tuple[Problem, Point, Array]:
    """Return the problem linearised as near to some amounts as a beam is stored.

    Args:
        problem, causes, nuisances, known: see `fit_distributed_errors`.
        amounts: wanted, [error].
        stored: amounts with a stored beam; the same object as `amounts`: unknown.

    Returns:
        The problem with these errors, the point of the causes, and the amounts.

    Raises:
        UnstableRingError: no amounts between the two store a beam.
    """
    for share in (1.0,) if amounts is stored else (*STEP_SHARES, 0.0):
        some = stored + share * (amounts - stored) if share else stored
        own = zip(known.hypotheses, some.tolist(), strict=True)
        there = [Cause(*h, a) for h, a in own if a]
        inner = problem.with_fixed(there)
        alone = fit_nuisances(inner, causes, nuisances)
        if alone.projection is not None:
            return inner, alone, some
    raise UnstableRingError(f"{alone.lost} with the most probable distributed errors")


def chain_factors(known: DistributedErrors, amounts: Array) -> Array:
    """Factors from signatures to d readings / d amount, [error]; see `Effect.chain`."""
    own = zip(known.hypotheses, amounts, strict=True)
    return np.array([find(name).chain(amount) for (name, _), amount in own])


def sampled_rows(count: int) -> Indices:
    """Return rows for variance components: a fixed random sample, as rows alternate in kind."""
    if count <= ROWS:
        return np.arange(count)
    return np.sort(np.random.default_rng(0).choice(count, ROWS, replace=False))


def components_of_rows(
    residual: Array,
    directions: Array,
    rows: Array,
    belongs: Indices,
    noise: Sequence[Flags] = (),
    prior: Array | None = None,
) -> VarianceComponents:
    """Return the variance components from a sample of rows.

    Args:
        residual: [row].
        directions: of the nuisances, [row, coordinate].
        rows: signatures of errors of size 1, [error, row].
        belongs: family of each error, [error].
        noise: parts of the rows whose noise is estimated too, [row] each.
        prior: covariance of the log scales before these rows.
    """
    launch = directions[:, np.abs(directions).max(axis=0) > 0]
    size = np.linalg.norm(launch, axis=0)
    basis = np.linalg.qr(launch / size)[0] if launch.shape[1] else np.zeros((len(residual), 0))
    there = basis.any(axis=1)  # the other rows have no reading, and no noise
    there = np.any(noise, axis=0) | there if noise else np.ones_like(there)
    families = [rows[belongs == k][:, there] for k in range(belongs.max() + 1)]
    return fit_variance_components(
        residual[there], basis[there], families, [part[there] for part in noise], prior
    )


@dataclass(frozen=True)
class Posterior:
    """Distributed errors given these readings.

    Attributes:
        before: the prior, with its estimated scales.
        amounts: most probable amounts, [error].
        visible: errors with a signature.
        spread: S S^T of these, in the coordinates of `correlated`, [visible, visible].
    """

    before: DistributedErrors = field(repr=False)
    amounts: Array = field(repr=False)
    visible: Indices = field(repr=False)
    spread: Array = field(repr=False)

    @property
    def sizes(self) -> dict[str, float]:
        """Estimated rms by effect."""
        return sizes_of(self.before)

    @cached_property
    def known(self) -> DistributedErrors:
        """Posterior distribution."""
        values, vectors = eigh(
            self.spread, subset_by_value=(MIN_SHARE / (1 - MIN_SHARE), np.inf), check_finite=False
        )
        seen = np.zeros((len(values), len(self.amounts)))
        seen[:, self.visible] = vectors.T
        return self.before.updated(self.amounts, values / (1 + values), seen)


@dataclass(frozen=True)
class Sums:
    """Sums of d rows / d amount over all rows, nuisances projected out.

    Attributes:
        gram: with each other, [error, error].
        inner: with the residual, [error].
        some: slopes in the rows of `sampled_rows`, nuisances not projected out, [error, row].
    """

    gram: Array
    inner: Array
    some: Array


def posterior(
    problem: Problem,
    known: DistributedErrors,
    *,
    learn: bool = True,
    unsure: float = np.inf,
    linearised_at: Array | None = None,
    partly: bool = False,
) -> Posterior:
    """Return the posterior of distributed errors, linearised at the most probable amounts.

    Args:
        problem: of the design.
        known: prior, with initial scales.
        learn: estimate the scales; else they stay.
        unsure: relative error of an estimated scale from which it is not below its initial one.
        linearised_at: first point of linearisation, [error]; None: the prior's mean.
        partly: see `most_probable`.

    Raises:
        UnstableRingError: no beam is stored with the most probable errors.
    """

    def solved(inner: Problem, point: Point, amounts: Array) -> Linear:
        sums = sums_at(inner, point, known, amounts)
        there = _posterior_at(known, amounts, sums).amounts
        change = there - amounts
        chi2 = point.chi2 - float(change @ (2 * sums.inner - sums.gram @ change))
        cost = chi2 + known.square(there)
        return Linear((inner, sums, amounts), point, there, cost, point.nuisances)

    start = known.amounts if linearised_at is None else linearised_at
    made = most_probable(problem, known, start, (), problem.first, solved, partly)
    (inner, sums, stored), point = made.made, made.point
    if not learn:
        return replace(_posterior_at(known, stored, sums), amounts=made.amounts)
    assert point.projection is not None
    _, belongs = families_of(known)
    keep = sampled_rows(len(point.residual))
    found = components_of_rows(
        point.residual[keep] + (stored - known.amounts) @ sums.some,
        point.projection.matrix()[keep],
        known.correlated(known.rms[:, None] * sums.some), belongs, prior=known.scales,
    )  # fmt: skip
    least = np.where(found.error[belongs] < unsure, 0.0, known.rms)
    rms = np.maximum(known.rms * found.scale[belongs], least)
    # the amounts follow their scales
    return posterior(
        problem.without(problem.valid & ~inner.valid), partly=partly, learn=False,
        known=replace(known, rms=rms, scales=found.covariance), linearised_at=made.amounts,
    )  # fmt: skip


def _posterior_at(known: DistributedErrors, at: Array, sums: Sums) -> Posterior:
    """The posterior of errors linearised at some amounts."""
    spread = known.correlated(known.correlated(known.rms[:, None] * sums.gram * known.rms).T)
    visible = np.flatnonzero(np.diag(spread) > 0)
    spread = spread[np.ix_(visible, visible)]
    pull = known.correlated(known.rms * (sums.inner + sums.gram @ (at - known.amounts)))
    most_probable = np.zeros(len(pull))
    rounding = len(visible) * np.finfo(float).eps * np.diag(spread).max(initial=0.0)
    ridge = (1 + rounding) * np.eye(len(visible))
    factor = cho_factor(spread + ridge, overwrite_a=True, check_finite=False)
    most_probable[visible] = cho_solve(factor, pull[visible], check_finite=False)
    return Posterior(known, known.amounts_at(most_probable), visible, spread)


def sums_at(
    problem: Problem,
    point: Point,
    known: DistributedErrors,
    amounts: Array,
) -> Sums:
    """Return the sums at a point.

    Args:
        problem: with the distributed errors in it.
        point: of nuisances alone.
        known: the errors.
        amounts: amounts of the errors in the problem, [error].
    """
    assert point.projection is not None
    clean = point.projection.out(point.residual)
    directions = np.linalg.qr(point.projection.matrix())[0]
    slope = chain_factors(known, amounts)
    keep, count = sampled_rows(len(clean)), len(slope)
    gram, inner = np.zeros((count, count)), np.zeros(count)
    along, some = np.zeros((count, directions.shape[1])), np.zeros((count, len(keep)))
    column = np.full(len(clean), -1)
    column[keep] = np.arange(len(keep))
    for rows, signatures in problem.everywhere().metric(point).pieces(known.hypotheses):
        visible = np.flatnonzero(signatures.any(axis=1))
        own = slope[visible, None] * signatures[visible]
        gram[np.ix_(visible, visible)] += own @ own.T
        inner[visible] += own @ clean[rows]
        along[visible] += own @ directions[rows]
        here = column[rows]
        some[np.ix_(visible, here[here >= 0])] = own[:, here >= 0]
    gram -= along @ along.T
    return Sums(gram, inner, some)
