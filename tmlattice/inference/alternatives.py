"""Hypotheses refitted through the full model together with a fit, by falling evidence."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from tmlattice.arrays import Array
from tmlattice.effects import Cause, Hypothesis, find
from tmlattice.inference import chi2
from tmlattice.inference.common_factors import MIN_CHI2
from tmlattice.inference.judgement import BEYOND
from tmlattice.inference.newton import Fit, Outcome, fit, fit_nuisances
from tmlattice.inference.problem import Problem
from tmlattice.inference.scan import Scan

MIN_FALL = 1.0
"""Chi-square that a parameter takes from noise: a smaller fall explains nothing."""


@dataclass(frozen=True)
class Alternative:
    """A hypothesis, refitted together with all other causes."""

    hypothesis: Hypothesis
    fit: Fit = field(repr=False)

    @property
    def cause(self) -> Cause:
        """The cause with its best amount, the last of the fit's causes."""
        return self.fit.causes[-1]


@dataclass(frozen=True)
class Detection:
    """Significance of a finding in its scan: statistic, threshold and p-value."""

    statistic: float
    threshold: float
    p_value: float

    @classmethod
    def among(cls, statistic: float, count: int) -> "Detection":
        """Return the significance of the largest of `count` chi-squares of one degree."""
        return cls(statistic, MIN_CHI2, min(1.0, count * float(chi2.sf(statistic, 1))))


def alternatives(
    problem: Problem,
    others: Fit,
    found: Scan,
    hypotheses: Sequence[Hypothesis],
    count: int | None = None,
) -> tuple[Alternative, ...]:
    """Return the leading hypotheses, each refitted together with a fit, by falling evidence.

    Args:
        problem: model and data.
        others: the fit without them.
        found: the scan of its residual.
        hypotheses: all candidates.
        count: refitted at most; None: `Judgement.alternatives`.
    """
    thresholds = problem.judgement
    linear = linear_evidence(problem, found)
    have = {(c.effect, c.element) for c in others.causes}
    order = np.argsort(-linear)[: thresholds.alternatives if count is None else count]
    # the linear scan errs by a share of the statistic itself where an effect is strong
    window = thresholds.window + thresholds.drift * float(found.statistic.max(initial=0.0))
    best = -np.inf
    chosen: list[Alternative] = []
    for index in order:
        if not linear[index] >= linear[order[0]] - window:
            break
        if find(found.hypotheses[index][0]).whole:
            cause: Cause | None = best_start(problem, others, found.hypotheses[index])
        else:
            cause = _first_guess(found, int(index))
        if cause is None or found.hypotheses[index] in have:
            continue
        tried = _with(problem, others, cause, best)
        if tried.outcome not in (Outcome.LOST, Outcome.SINGULAR):
            best = max(best, tried.log_evidence)
            chosen.append(Alternative(found.hypotheses[index], tried))
    if chosen:
        leader = max(chosen, key=lambda one: one.fit.log_evidence).hypothesis
        have |= {one.hypothesis for one in chosen}
        curved = [h for h in hypotheses if find(h[0]).curved and h not in have]
        for hypothesis in problem.neighbours(leader, curved):  # a linear scan misjudges them
            cause = best_start(problem, others, hypothesis)
            chosen.append(Alternative(hypothesis, _with(problem, others, cause, best)))
    chosen = [r for r in chosen if others.chi2 - r.fit.chi2 > MIN_FALL and _possible(r.cause)]
    return tuple(sorted(chosen, key=lambda one: -one.fit.log_evidence))


def _possible(cause: Cause) -> bool:
    """Whether the amount has the sign that a fault of its effect has."""
    effect = find(cause.effect)
    return cause.amount >= 0 or not effect.one_sign or effect.power == 2


def linear_evidence(problem: Problem, found: Scan) -> Array:
    """Log evidence of each hypothesis from a scan, up to a constant, [hypothesis].

    Hypotheses without a signature have -inf.

    Args:
        problem: for the priors.
        found: the scan.
    """
    occam = -0.5 * np.log(np.maximum(found.statistic, 1.0))
    prior = np.array([problem.prior(h) for h in found.hypotheses])
    power = np.array([find(h[0]).power for h in found.hypotheses])
    largest = np.array([find(h[0]).largest for h in found.hypotheses]) ** power
    over = np.maximum(np.abs(found.amount) / largest, 1.0)
    linear = 0.5 * found.statistic + occam + prior - np.minimum(8 * np.log(over), 1e6)
    return np.where(found.statistic > 0, linear, -np.inf)


def _first_guess(found: Scan, index: int) -> Cause | None:
    """The scan's amount as a cause; None where the amount has no root."""
    name, place = found.hypotheses[index]
    effect, amount = find(name), float(found.amount[index])
    if effect.discrete:
        return Cause(name, place, 1.0)
    if effect.power == 2:
        if amount <= 0:
            return None
        amount = float(np.sqrt(amount))
    elif effect.one_sign and amount <= 0:
        return None
    limit = BEYOND * effect.largest
    return Cause(name, place, float(np.clip(amount, -limit, limit)))


def _with(problem: Problem, others: Fit, cause: Cause, hopeless: float) -> Fit:
    """Fit with one cause more."""
    return fit(
        problem, (*others.causes, cause), others.nuisances, others.kicks,
        hopeless=hopeless, slopes=others.slopes,
    )  # fmt: skip


def best_start(problem: Problem, others: Fit, hypothesis: Hypothesis) -> Cause:
    """Return the starting amount with the smallest chi-square, nuisances fitted."""
    effect = find(hypothesis[0])
    starts = [share * effect.largest for share in problem.judgement.starts]
    starts = [amount for amount in starts if amount > 0 or not effect.one_sign]
    if effect.whole:
        starts = [float(n * side) for n in range(1, int(effect.largest) + 1) for side in (1, -1)]
    causes = [Cause(*hypothesis, amount) for amount in starts]
    left = []
    for cause in causes:
        there = (*others.causes, cause)
        if effect.whole:  # nonlinear: nuisances without it are no guide
            left.append(fit_nuisances(problem, there, others.nuisances).chi2)
            continue
        point = problem.at(there, others.nuisances, others.kicks)
        clean = np.full(1, np.inf) if point.lost else others.projection.out(point.residual)
        left.append(float(np.nan_to_num(clean @ clean, nan=np.inf)))
    return causes[int(np.argmin(left))]


def leading(problem: Problem, found: Scan, count: int) -> dict[Hypothesis, float]:
    """Most probable hypotheses of a scan, with its amounts.

    Args:
        problem: for the priors.
        found: the scan.
        count: number of hypotheses at most.
    """
    ranks = linear_evidence(problem, found)
    first = (
        (found.hypotheses[i], _first_guess(found, int(i)))
        for i in np.argsort(-ranks)[:count]
        if np.isfinite(ranks[i])
    )
    return {h: cause.amount for h, cause in first if cause is not None}
