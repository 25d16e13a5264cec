"""Many small causes at once: the most probable amounts under a prior, more of them than readings.

Gauss and Newton in the space of the readings: with the slopes J and the prior's variances P the
amounts are P J^T (J P J^T + C)^-1 target. J is not needed itself, only its products, which the
problem knows (`Slopes`). Tails give each amount a variance of its own, found as the fit goes.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from tmlattice.errors import BeamLostError
from tmlattice.inference.priors import Student

Array = NDArray[np.float64]

INITIAL_NOISE = 30.0
"""The fit begins with a noise of the residual's rms over this, and ends with the readings' own: a
linear model is worth no more, and a fit that believes it exactly runs away."""

WIDEST, NARROWING = 1000.0, 1.78
"""Tails have many local maxima: they begin this much wider, near a Gaussian, and every time that
the variances are found anew they are narrower by the second figure."""

MAX_HALVINGS = 8
"""A step is halved so often at most, where the linear model does not reach."""

SCALE_ITERATIONS = 4
"""Iterations in which the scale of the prior follows the evidence."""

SCALES = np.logspace(-4, 3, 141)


class Slopes(Protocol):
    """d readings / d amounts about one point, as products."""

    def times(self, amounts: Array) -> Array:
        """J amounts, [row]."""

    def transposed(self, rows: Array) -> Array:
        """J^T rows, [amount]."""

    @property
    def matrix(self) -> Array:
        """J itself, [row, amount]: asked for where amounts are fewer than rows."""

    def kernel(self, variance: Array) -> Array:
        """J P J^T for variances P [amount], [row, row]."""


class AmountProblem(Protocol):
    """Readings as a function of many amounts."""

    @property
    def sigma(self) -> Array:
        """Noise of each reading, m, [row]."""

    @property
    def largest(self) -> float:
        """No amount is larger."""

    def residual(self, amounts: Array) -> Array:
        """Measured less model, m, [row]; BeamLostError where there is none."""

    def slopes(self, amounts: Array) -> Slopes:
        """About these amounts."""

    def nuisances(self, amounts: Array) -> Array:
        """Covariance of the readings by what else is not known, m^2, [row, row]."""


@dataclass(frozen=True)
class MostProbable:
    """Where a fit stands.

    Attributes:
        amounts: [amount].
        residual: measured less model, m, [row].
        prior: with the width as it is.
        chi2: of every step.
        settled: whether the last step was smaller than the noise.
    """

    amounts: Array
    residual: Array
    prior: Student
    chi2: tuple[float, ...]
    converged: bool = False


def most_probable(
    problem: AmountProblem,
    prior: Student,
    start: Array,
    *,
    choose: bool = False,
    wide: bool = True,
    iterations: int = 12,
) -> MostProbable:
    """The most probable amounts, from a noise far above the readings' own down to it.

    Args:
        problem: readings as a function of amounts.
        prior: of each amount.
        start: first guess, [amount].
        choose: the width of the prior follows the evidence.
        wide: tails begin wide; not where the start is a maximum of its own.
        iterations: at most, at each level of noise.
    """
    residual = problem.residual(start)
    now = MostProbable(start, residual, prior, (_chi2(problem, residual),))
    widening = WIDEST if wide and np.isfinite(prior.freedom) else 1.0
    added_noise = float(np.sqrt(np.mean(residual**2))) / INITIAL_NOISE
    least = float(problem.sigma.min())
    while True:
        added_noise = 0.0 if added_noise < least else added_noise
        for i in range(iterations):
            now, widening = _iterated(
                problem, now, added_noise, widening, choose and i < SCALE_ITERATIONS
            )
            if now.converged:
                break
        if added_noise == 0.0:
            return now
        added_noise /= 10


def cost(problem: AmountProblem, found: MostProbable) -> float:
    """- log of likelihood and prior, up to constants, with the readings' own noise."""
    half = cho_factor(_base(problem, found.amounts, 0.0))
    return _cost(half, found.residual, found.prior, found.amounts)


def posterior_base(problem: AmountProblem, found: MostProbable) -> Array:
    """Covariance of the readings without the amounts, m^2, [row, row]."""
    return _base(problem, found.amounts, 0.0)


def _chi2(problem: AmountProblem, residual: Array) -> float:
    return float(np.sum((residual / problem.sigma) ** 2))


def _base(problem: AmountProblem, amounts: Array, added_noise: float) -> Array:
    return problem.nuisances(amounts) + np.diag(problem.sigma**2 + added_noise**2)


def _cost(half: tuple[Array, bool], residual: Array, prior: Student, amounts: Array) -> float:
    return float(0.5 * residual @ cho_solve(half, residual) + prior.penalty(amounts).sum())


def _iterated(
    problem: AmountProblem, now: MostProbable, added_noise: float, widening: float, choose: bool
) -> tuple[MostProbable, float]:
    """One step with noise `trust` added; settled where it was smaller than the noise."""
    slopes, base = problem.slopes(now.amounts), _base(problem, now.amounts, added_noise)
    target = now.residual + slopes.times(now.amounts)
    if choose:
        unit = slopes.kernel(np.ones(len(now.amounts)))
        now = replace(now, prior=replace(now.prior, width=best_scale(unit, base, target)))
    wanted, half = now.amounts, cho_factor(base)
    best = _linear(slopes, base, half, target, len(wanted))
    for _ in range(MAX_HALVINGS if np.isfinite(now.prior.freedom) else 1):  # along one linear model
        wide = replace(now.prior, width=now.prior.width * widening)
        wanted = best(wide.precision(wanted))
        widening = max(1.0, widening / NARROWING)
    wide = replace(now.prior, width=now.prior.width * widening)
    step = np.clip(wanted, -problem.largest, problem.largest) - now.amounts
    before = _cost(half, now.residual, wide, now.amounts)
    for _ in range(MAX_HALVINGS):
        try:
            residual = problem.residual(now.amounts + step)
            if _cost(half, residual, wide, now.amounts + step) <= before:
                break
        except BeamLostError:
            pass
        step = step / 2
    else:
        chi2 = (*now.chi2, now.chi2[-1])
        return replace(now, chi2=chi2, converged=widening == 1.0), widening
    least = float(np.sqrt((problem.sigma**2).min() + added_noise**2))
    small = bool(np.abs(slopes.times(step)).max() < 0.1 * least)
    chi2 = (*now.chi2, _chi2(problem, residual))
    converged = small and widening == 1.0
    return MostProbable(now.amounts + step, residual, now.prior, chi2, converged), widening


def _linear(
    slopes: Slopes, base: Array, half: tuple[Array, bool], target: Array, amounts: int
) -> Callable[[Array], Array]:
    """The best amounts of a linear model as a function of the prior's precisions [amount], in the
    space of amounts or of readings, whichever is the smaller."""
    if amounts < len(target):
        J = slopes.matrix
        weighed = cho_solve(half, J)
        inner, gram = weighed.T @ target, J.T @ weighed

        def of_amounts(precision: Array) -> Array:
            size = np.sqrt(precision)
            scaled = gram / size / size[:, None] + np.eye(len(size))
            return np.asarray(cho_solve(cho_factor(scaled), inner / size) / size)

        return of_amounts

    def of_readings(precision: Array) -> Array:
        factor = cho_factor(slopes.kernel(1 / precision) + base)
        return slopes.transposed(cho_solve(factor, target)) / precision

    return of_readings


def best_scale(kernel: Array, base: Array, target: Array) -> float:
    """The factor s of greatest evidence, target ~ N(0, s^2 kernel + base)."""
    half = np.linalg.cholesky(base)
    inner = np.linalg.solve(half, np.linalg.solve(half, kernel).T)
    values, vectors = np.linalg.eigh(0.5 * (inner + inner.T))
    power = (vectors.T @ np.linalg.solve(half, target)) ** 2
    spread = SCALES[:, None] ** 2 * np.maximum(values, 0.0) + 1.0
    evidence = -0.5 * np.sum(power / spread + np.log(spread), axis=1)
    return float(SCALES[int(evidence.argmax())])


def best_of(problem: AmountProblem, found: Sequence[MostProbable]) -> MostProbable:
    """The one of least cost."""
    return min(found, key=lambda one: cost(problem, one))
