"""Causes, free kicks and nuisances fitted together through the full nonlinear model.

Gauss-Newton on amounts; nuisances are eliminated by projection, and a step that raises the cost is
shortened. The evidence of a set of causes weighs its misfit against its prior.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum

import numpy as np

from tmlattice.arrays import TINY, Array
from tmlattice.effects import Cause, Hypothesis, find
from tmlattice.inference.problem import NO_KICKS, Kicks, Point, Problem
from tmlattice.inference.scan import free_scan
from tmlattice.inference.whitening import Projection

AGAIN, ROUNDS, ITERATIONS = 3, 8, 100
"""Largest number of repetitions of what settles in two (selections that are linearised again), of
Newton steps and linearisations, and of iterations that converge slowly."""
SETTLED = 1e-2
"""Change, in standard deviations or of a log variance, below which iterations end."""
STEP_SHARES = (1.0, 0.5, 0.25, 0.0625)
"""Shares of a step, tried in turn until the cost falls."""

MIN_INFORMATION = 1e-12
"""Information about an amount below which the readings do not determine it: an error of a million,
in any unit."""


class Outcome(StrEnum):
    """How a fit ended; every outcome but the first is reported."""

    CONVERGED = "converged"
    STEPS = "the fit ran out of steps while it still improved: allow more"
    STUCK = "no step along the slopes helped: the model is too curved here, or its slopes are wrong"
    GIVEN_UP = "given up: alternatives explain far more"
    SINGULAR = "these readings cannot distinguish the amounts"
    LOST = "the model has no solution there"


@dataclass(frozen=True)
class Slope:
    """d rows / d amount of one cause, [row], with the amount and the orbit where it was taken."""

    row: Array
    amount: float
    orbit: Array

    def valid_at(self, amount: float, orbit: Array, same: float) -> bool:
        """Whether amount and orbit are the same within a share."""
        if abs(amount - self.amount) > same * abs(amount):
            return False
        if orbit is self.orbit:
            return True
        return bool(np.linalg.norm(orbit - self.orbit) <= same * np.linalg.norm(orbit))


Slopes = Mapping[Hypothesis, Slope]
NO_SLOPES: Slopes = {}


@dataclass(frozen=True)
class Fit:
    """Causes with their best amounts, and the residual.

    Attributes:
        point: the model there.
        covariance: of the amounts, nuisances and kicks eliminated, [cause, cause]; zero for
            discrete ones.
        log_evidence: up to a constant of the data; -inf where the fit failed.
        outcome: how it ended.
        slopes: of the causes that are not discrete, by cause.
    """

    point: Point
    covariance: Array
    log_evidence: float
    outcome: Outcome
    slopes: Slopes = field(default_factory=dict, repr=False)

    @property
    def causes(self) -> tuple[Cause, ...]:
        """Causes with their amounts."""
        return self.point.causes

    @property
    def kicks(self) -> Kicks:
        """Free kicks, by place."""
        return self.point.kicks

    @property
    def nuisances(self) -> Array:
        """Fitted nuisances."""
        return self.point.nuisances

    @property
    def residual(self) -> Array:
        """Whitened rows."""
        return self.point.residual

    @property
    def projection(self) -> Projection:
        """Projection of the nuisances."""
        assert self.point.projection is not None, self.point.lost
        return self.point.projection

    @property
    def clean(self) -> Array:
        """Residual with nuisances projected out, [row]."""
        return self.projection.out(self.residual)

    @property
    def chi2(self) -> float:
        """Chi-square, the prior rows of the nuisances included."""
        return self.point.chi2

    @property
    def good(self) -> bool:
        """Whether amounts, errors and evidence are valid."""
        return self.outcome in (Outcome.CONVERGED, Outcome.STEPS, Outcome.STUCK)


def fit(
    problem: Problem,
    causes: Sequence[Cause],
    nuisances: Array,
    kicks: Kicks = NO_KICKS,
    *,
    steps: int = ROUNDS,
    tolerance: float = 0.02,
    hopeless: float = -np.inf,
    slopes: Slopes = NO_SLOPES,
) -> Fit:
    """Fit the amounts of causes, free kicks and nuisances.

    Args:
        problem: model and data.
        causes: with first guesses of their amounts; discrete ones stay.
        nuisances: first guess.
        kicks: free kicks by place, with first guesses.
        steps: at most.
        tolerance: of chi-square, below which the fit ends.
        hopeless: evidence; far below it the fit is given up after two steps.
        slopes: of an earlier fit of the same problem, reused where they are valid.
    """
    point = problem.at(causes, nuisances, kicks)
    if point.lost:  # the model has no solution at the first guess: start closer to zero
        small = [
            c if find(c.effect).discrete else replace(c, amount=0.1 * c.amount) for c in causes
        ]
        point = problem.at(small, nuisances, {k: 0.1 * v for k, v in kicks.items()})
    if point.lost:
        return Fit(point, np.zeros((len(causes),) * 2), -np.inf, Outcome.LOST)
    outcome = Outcome.STEPS
    slopes, rows = _with_slopes(problem, point, slopes)
    now = _cost(problem, point)
    for step in range(steps):
        change, moved, expected_fall = _step(problem, point, rows)
        best = _best_move(problem, point, change, moved, now)
        if best is None:
            outcome = Outcome.CONVERGED if expected_fall < max(0.1, tolerance) else Outcome.STUCK
            break
        fell, point = now - _cost(problem, best), best
        now -= fell
        if fell < tolerance and expected_fall < tolerance:
            outcome = Outcome.CONVERGED
            break
        slopes, rows = _with_slopes(problem, point, slopes)
        if step == 1 and -0.5 * now < hopeless - 100 - 0.5 * expected_fall:
            outcome = Outcome.GIVEN_UP
            break
    return _finished(problem, point, slopes, rows, outcome)


def fit_nuisances(problem: Problem, causes: Sequence[Cause], nuisances: Array) -> Point:
    """Return the point of fixed causes at the best nuisances.

    Args:
        problem: model and data.
        causes: with their amounts.
        nuisances: first guess.
    """
    point = problem.at(causes, nuisances)
    for _ in range(ITERATIONS):  # two or three, but where orbits are large in strong sextupoles
        if point.projection is None:
            break
        change = point.projection.coordinates(point.residual)
        there = _best_move(problem, point, np.zeros(0), change, point.chi2) if len(change) else None
        if there is None:
            break
        fell, point = point.chi2 - there.chi2, there
        if fell < SETTLED:
            break
    return point


def _cost(problem: Problem, point: Point) -> float:
    """Chi-square plus the prior's penalty, if it has one."""
    if point.lost:
        return np.inf
    if problem.amounts.tails is None:
        return point.chi2
    return point.chi2 - 2 * sum(problem.amounts.log_density(c) for c in point.causes)


def _continuous(point: Point) -> list[int]:
    return [i for i, cause in enumerate(point.causes) if not find(cause.effect).discrete]


def _with_slopes(problem: Problem, point: Point, known: Slopes) -> tuple[Slopes, Array]:
    """Slopes at a point; and d rows / d parameters: amounts, then the kicks of each place."""
    rows = []
    slopes: dict[Hypothesis, Slope] = {}
    for i in _continuous(point):
        cause = point.causes[i]
        place = (cause.effect, cause.element)
        slope = known.get(place)
        if slope is None or not slope.valid_at(cause.amount, point.orbit, problem.judgement.same):
            slope = Slope(problem.slope(point, i), cause.amount, point.orbit)
        slopes[place] = slope
        rows.append(slope.row[None])
    rows += [problem.kick_rows(point, place) for place in point.kicks]
    return slopes, np.concatenate(rows) if rows else np.zeros((0, len(point.residual)))


def _prior_terms(problem: Problem, point: Point, count: int) -> tuple[Array, Array]:
    """Prior precision of each parameter, and its amount; zero for free kicks."""
    precision, amount = np.zeros((2, count))
    for row, i in enumerate(_continuous(point)):
        precision[row] = problem.amounts.precision(point.causes[i])
        amount[row] = point.causes[i].amount
    return precision, amount


def _step(problem: Problem, point: Point, rows: Array) -> tuple[Array, Array, float]:
    """Changes of parameters and nuisances, and the expected fall of the cost."""
    assert point.projection is not None
    clean = point.projection.out(point.residual)
    change = np.zeros(len(rows))
    expected_fall = point.chi2 - float(clean @ clean)
    if len(rows):
        own = point.projection.out(rows)
        precision, amount = _prior_terms(problem, point, len(rows))
        size = np.sqrt(np.einsum("kr,kr->k", own, own) + precision)
        scale = np.where(size > 0, size, 1.0)
        unit = own / scale[:, None]
        gram = unit @ unit.T + np.diag(precision / scale**2 + 1e-10)
        inner = unit @ clean - precision * amount / scale
        solved = np.linalg.solve(gram, inner)
        expected_fall += float(inner @ solved)
        change = solved / np.where(size > 0, size, np.inf)
    left = point.residual - change @ rows
    return change, point.projection.coordinates(left), expected_fall


def _best_move(
    problem: Problem, point: Point, change: Array, moved: Array, now: float
) -> Point | None:
    """Point after the largest share of a step that lowers the cost."""
    for shrink in STEP_SHARES:
        trial = _moved(problem, point, shrink * change, shrink * moved)
        cost = _cost(problem, trial)
        if cost < now or (shrink == 1.0 and cost <= now + 1e-6):
            return trial
    return None


def _moved(problem: Problem, point: Point, change: Array, moved: Array) -> Point:
    causes = list(point.causes)
    amounts = _continuous(point)
    for i, delta in zip(amounts, change, strict=False):  # none: they stay
        causes[i] = replace(causes[i], amount=causes[i].amount + float(delta))
    kicks, at = {}, len(amounts)
    for place, values in point.kicks.items():
        kicks[place] = values + change[at : at + len(values)]
        at += len(values)
    return problem.at(causes, problem.moved(point.nuisances, moved), kicks)


def _finished(problem: Problem, point: Point, slopes: Slopes, rows: Array, outcome: Outcome) -> Fit:
    """Add errors and evidence at the best amounts."""
    assert point.projection is not None
    named = _continuous(point)
    covariance = np.zeros((len(point.causes), len(point.causes)))
    log_evidence = -0.5 * point.chi2
    own = point.projection.out(rows)
    gram = own @ own.T
    log_evidence -= max(len(point.causes) - 1, 0) * np.log(problem.judgement.rarer)
    for cause in point.causes:
        log_evidence += problem.prior((cause.effect, cause.element))
        log_evidence += problem.amounts.log_density(cause)
    if named:
        full = gram + np.diag(_prior_terms(problem, point, len(rows))[0])
        if (np.diagonal(full)[: len(named)] < MIN_INFORMATION).any():
            return Fit(point, covariance, -np.inf, Outcome.SINGULAR, slopes)
        size = np.sqrt(np.maximum(np.diagonal(full), TINY))
        scaled = full / size[:, None] / size + 1e-10 * np.eye(len(full))
        inverse = np.linalg.inv(scaled) / size[:, None] / size
        covariance[np.ix_(named, named)] = inverse[: len(named), : len(named)]
        sign, determinant = np.linalg.slogdet(covariance[np.ix_(named, named)])
        if sign <= 0:
            return Fit(point, covariance, -np.inf, Outcome.SINGULAR, slopes)
        log_evidence += 0.5 * (determinant + len(named) * np.log(2 * np.pi))
    at = len(named)
    for values in point.kicks.values():
        part = slice(at, at + len(values))
        at += len(values)
        own_gram = gram[part, part]
        found = free_scan(own_gram[None, None], (own_gram @ values)[None, None])
        log_evidence += float(found.gain[0] - 0.5 * found.statistic[0])  # less that of the misfit
        log_evidence += problem.unknown_prior(len(problem.kick_places))
    return Fit(point, covariance, float(log_evidence), outcome, slopes)
