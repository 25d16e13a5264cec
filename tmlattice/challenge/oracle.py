"""The oracle: the best possible answer from the data.

It has the exact noise and sizes of the distributed errors, and of several causes it seeks one at a
time, given all the others. It weighs every hypothesis by its fall of chi-square, the leading ones
refitted through the full model. Its class is every hypothesis within a chi-square of 9 of the best.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tmlattice.arrays import Array
from tmlattice.challenge.case import Case, Truth, ring_of
from tmlattice.challenge.kinds import CHANGES, problem_of_case
from tmlattice.effects import Cause, Hypothesis, find, modelled
from tmlattice.inference.alternatives import best_start
from tmlattice.inference.judgement import DEFAULT
from tmlattice.inference.newton import Fit, fit, fit_nuisances
from tmlattice.inference.problem import Problem
from tmlattice.inference.scan import Scan, scan

CLASS = 9.0
"""Chi-square within which the oracle does not distinguish hypotheses."""

REFINED = 60
"""Hypotheses that are refitted, at most."""

MAX_BEHIND = 60.0
"""Chi-square below the best of the scan at which a hypothesis is not refitted."""

LISTED = 400


@dataclass(frozen=True)
class Refitted:
    """Every hypothesis about one case.

    Attributes:
        statistic, amount: fall of chi-square within the largest fault, its amount, [hypothesis].
    """

    problem: Problem
    start: Fit
    seen: Scan
    statistic: Array
    amount: Array

    @property
    def left(self) -> float:
        """Chi-square of the best hypothesis."""
        return self.start.chi2 - float(self.statistic.max())


def evaluate(argument: tuple[Case, Truth]) -> dict[str, Any]:
    """Return the oracle's answer for a case, as JSON: {"oracles": one per cause, "residual"}.

    A case of an unknown, or of none, has one oracle and, of an unknown, the residual after the best
    member of the catalogue, in sigma.
    """
    case, truth = argument
    # a monitor without a signal is known as such
    asked = [cause for cause in truth.causes if find(cause.effect).modelled]
    several = len(truth.causes) > 1
    given = [[c for c in asked if c is not cause] for cause in asked] if several else [[]]
    left = None
    if truth.unknown is not None:
        clean = replace(case.fit, readings=truth.clean["fit"][:, None])
        quiet = refitted(replace(case, parts={**case.parts, "fit": clean}), truth)
        left = float(np.sqrt(max(quiet.left, 0.0)))
    found = [refitted(case, truth, others) for others in given]
    return {"oracles": [_as_answer(one) for one in found], "residual": left}


def refitted(case: Case, truth: Truth, given: Sequence[Cause] = ()) -> Refitted:
    """Return the hypotheses about a case, the leading ones refitted."""
    problem = problem_of_case(_without_dead(case, truth), truth.background, given)
    start = fit(problem, (), problem.first)
    hypotheses = hypotheses_of(case, problem)
    seen = scan(problem.metric(start.point), hypotheses, start.residual)
    reach = np.array([find(n).largest ** find(n).power for n, _ in hypotheses])
    one_sign = np.array([find(n).one_sign for n, _ in hypotheses])
    amount = np.clip(seen.amount, np.where(one_sign, 0.0, -reach), reach)
    discrete = np.array([find(n).discrete for n, _ in hypotheses])
    inner = seen.amount * seen.information
    amount = np.where(discrete & (seen.information > 0), 1.0, amount)
    statistic = 2 * amount * inner - amount**2 * seen.information
    power = np.array([find(n).power for n, _ in hypotheses])
    amount = np.sign(amount) * np.abs(amount) ** (1 / power)
    # the linear scan errs by a share of the statistic itself where an effect is strong
    behind = MAX_BEHIND + DEFAULT.drift * float(seen.statistic.max())
    order = np.argsort(-seen.statistic)[:REFINED]
    order = order[seen.statistic[order] > seen.statistic.max() - behind]
    everywhere = [h for h, (n, place) in enumerate(hypotheses) if place is None and find(n).curved]
    for h in dict.fromkeys((*order.tolist(), *everywhere)):
        name, place = hypotheses[h]
        whole = find(name).whole or h in everywhere
        if discrete[h] or not (amount[h] or whole):
            continue
        guess = Cause(name, place, float(amount[h]))
        if whole:
            guess = best_start(problem, start, hypotheses[h])
        again = fit(problem, [guess], start.nuisances)
        if not again.good:
            continue
        most = find(name).largest
        size = float(np.clip(again.causes[0].amount, 0.0 if one_sign[h] else -most, most))
        chi2 = again.chi2
        if size != again.causes[0].amount:  # at the largest fault
            chi2 = fit_nuisances(problem, [Cause(name, place, size)], again.nuisances).chi2
        if np.isfinite(chi2):
            statistic[h], amount[h] = start.chi2 - chi2, size
    return Refitted(problem, start, seen, statistic, amount)


def hypotheses_of(case: Case, problem: Problem) -> list[Hypothesis]:
    """Return every effect at every place that a case's diagnosis may name."""
    ring = ring_of(case.lattice)
    names = modelled(case.options.get("effects"), turns=bool(case.kinds))
    if case.before and "effects" not in case.options:
        names = list(dict.fromkeys([*names, *(name for some in CHANGES for name in some)]))
    return [
        (name, place) for name in names
        for place in find(name).places(ring) if problem.sees((name, place))
    ]  # fmt: skip


def dead_monitors(case: Case, truth: Truth) -> list[int]:
    """Return the monitors without a signal."""
    monitors = [monitor.name for monitor in ring_of(case.lattice).monitors]
    causes = [cause for cause in truth.causes if not find(cause.effect).modelled]
    return [monitors.index(str(cause.element)) for cause in causes]


def _without_dead(case: Case, truth: Truth) -> Case:
    dead = dead_monitors(case, truth)
    if not dead:
        return case
    readings = case.fit.readings.copy()
    readings[:, :, dead] = np.nan
    return replace(case, parts={**case.parts, "fit": replace(case.fit, readings=readings)})


def _as_answer(found: Refitted) -> dict[str, Any]:
    """The oracle's answer as JSON."""
    hypotheses, statistic = found.seen.hypotheses, found.statistic
    weight = statistic / 2 + np.array([found.problem.prior(h) for h in hypotheses])
    weight = np.exp(weight - weight.max())
    weight /= weight.sum()
    by_likelihood, by_weight = (np.argsort(-own)[:LISTED] for own in (statistic, weight))

    def listed(some: NDArray[np.intp]) -> list[Mapping[str, Any]]:
        return [
            {
                "effect": hypotheses[h][0],
                "element": hypotheses[h][1],
                "statistic": float(statistic[h]),
                "amount": float(found.amount[h]),
                "probability": float(weight[h]),
            }
            for h in some
        ]

    top = float(statistic.max())
    threshold = found.seen.threshold(DEFAULT.false_alarm)
    return {
        "statistic": top,
        "threshold": threshold,
        "detected": bool(top > threshold),
        "class_size": int((statistic > top - CLASS).sum()),
        "class": listed(by_likelihood[statistic[by_likelihood] > top - CLASS]),
        "posterior": listed(by_weight),
    }
