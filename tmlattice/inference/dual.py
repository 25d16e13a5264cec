"""Most probable amounts of many errors under a prior, more amounts than readings.

Gauss-Newton in the space of the readings: with slopes J and prior variances P the amounts are
P J^T (J P J^T + C)^-1 target. Only products with J are needed (`Slopes`). Heavy tails give each
amount a variance of its own, which is updated during the fit.
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
"""The residual's rms over the first added noise, which falls to zero: a linear model that is
believed exactly far from the solution diverges."""

WIDEST, NARROWING = 1000.0, 1.78
"""Heavy tails have many local maxima: the prior starts wider by the first number, near a Gaussian,
and narrows by the second at every update of the variances."""

MAX_HALVINGS = 8
"""Halvings of a step, at most, beyond the linear range."""

SCALE_ITERATIONS = 4
"""Iterations in which the prior's scale follows the evidence."""

SCALES = np.logspace(-4, 3, 141)


class Slopes(Protocol):
    """d readings / d amounts at one point, as products."""

    def times(self, amounts: Array) -> Array:
        """J amounts, [row]."""

    def transposed(self, rows: Array) -> Array:
        """J^T rows, [amount]."""

    @property
    def matrix(self) -> Array:
        """J itself, [row, amount]: used if there are fewer amounts than rows."""

    def kernel(self, variance: Array) -> Array:
        """J P J^T for variances P [amount], [row, row]."""


class AmountProblem(Protocol):
    """Readings as a function of many amounts."""

    @property
    def sigma(self) -> Array:
        """Noise of each reading, m, [row]."""

    @property
    def largest(self) -> float:
        """Largest amount."""

    def residual(self, amounts: Array) -> Array:
        """Measured less model, m, [row]; raises BeamLostError without a beam."""

    def slopes(self, amounts: Array) -> Slopes:
        """Slopes at these amounts."""

    def nuisances(self, amounts: Array) -> Array:
        """Covariance of the readings by nuisances, m^2, [row, row]."""


@dataclass(frozen=True)
class MostProbable:
    """A fit: amounts, residual and history.

    Attributes:
        amounts: [amount].
        residual: measured less model, m, [row].
        prior: with its final width.
        chi2: of every step.
        converged: whether the last step was smaller than the noise.
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
    """Most probable amounts, with an added noise that falls to zero.

    Args:
        problem: readings as a function of amounts.
        prior: of each amount.
        start: first guess, [amount].
        choose: fit the width of the prior by the evidence.
        wide: start with wide tails; not where the start is a local maximum to keep.
        iterations: at most, at each level of added noise.
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
    """Negative log posterior, up to constants, with the readings' own noise."""
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
    """Return one step with added noise; converged if the step is smaller than the noise."""
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
    """Best amounts of a linear model as a function of the prior's precisions [amount], in the space
    of amounts or of readings, whichever is smaller."""
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
    """Factor s of the largest evidence, target ~ N(0, s^2 kernel + base)."""
    half = np.linalg.cholesky(base)
    inner = np.linalg.solve(half, np.linalg.solve(half, kernel).T)
    values, vectors = np.linalg.eigh(0.5 * (inner + inner.T))
    power = (vectors.T @ np.linalg.solve(half, target)) ** 2
    spread = SCALES[:, None] ** 2 * np.maximum(values, 0.0) + 1.0
    evidence = -0.5 * np.sum(power / spread + np.log(spread), axis=1)
    return float(SCALES[int(evidence.argmax())])


def best_of(problem: AmountProblem, found: Sequence[MostProbable]) -> MostProbable:
    """Return the fit of least cost."""
    return min(found, key=lambda one: cost(problem, one))
