"""Oracle and simple methods for any kinds of measurement.

The oracle has the exact noise and sizes of the distributed errors, and assumes one cause. It weighs
every hypothesis by its fall of chi-square, the leading ones refitted through the full model. Simple
methods have the design, the noise and the nuisances; each returns three suspects.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tmlattice.challenge.baselines import SUSPECTS, Guesses, pursuits
from tmlattice.challenge.case import Case, Truth, ring_of
from tmlattice.challenge.kinds import CHANGES, problem_of
from tmlattice.challenge.oracle import REFINED, answer
from tmlattice.effects import Cause, find, modelled
from tmlattice.inference.alternatives import best_start
from tmlattice.inference.judgement import DEFAULT
from tmlattice.inference.newton import Fit, fit
from tmlattice.inference.problem import Hypothesis, Problem
from tmlattice.inference.scan import Scan, scan

Array = NDArray[np.float64]

MAX_BEHIND = 60.0
"""Chi-square below the best of the scan at which a hypothesis is not refitted."""

MOST_NUMBERS = 2**27
"""Numbers of all signatures: a gigabyte; simple methods are not run with more."""


@dataclass(frozen=True)
class Refitted:
    """Every hypothesis about one case.

    Attributes:
        problem: rows whitened by noise and distributed errors.
        start: fit of the nuisances alone.
        seen: the scan of its residual.
        statistic: fall of chi-square within the largest fault, [hypothesis].
        amount: of that fall, [hypothesis].
    """

    problem: Problem
    start: Fit
    seen: Scan
    statistic: Array
    amount: Array


def evaluate_kinds(argument: tuple[Case, Truth]) -> dict[str, Any]:
    """Return the oracle's answer for a case of kinds, as `oracle.evaluate` does."""
    case, truth = argument
    said = _as_answer(refitted(case, truth))
    return {"oracles": [said], "residual": None}


def refitted(case: Case, truth: Truth) -> Refitted:
    """Return the hypotheses about a case, the leading ones refitted."""
    ring = ring_of(case.lattice)
    problem = problem_of(ring, case.measured, case.before, truth.background)
    start = fit(problem, (), problem.first)
    hypotheses = _hypotheses(case, problem)
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
    order = np.argsort(-statistic)[:REFINED]
    order = order[statistic[order] > statistic.max() - MAX_BEHIND]
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
        least = 0.0 if one_sign[h] else -find(name).largest
        if again.good and least <= again.causes[0].amount <= find(name).largest:
            statistic[h] = start.chi2 - again.chi2
            amount[h] = again.causes[0].amount
    return Refitted(problem, start, seen, statistic, amount)


def _hypotheses(case: Case, problem: Problem) -> list[Hypothesis]:
    ring = ring_of(case.lattice)
    names = modelled(case.options.get("effects"), turns=True)
    if case.before and "effects" not in case.options:
        names = list(dict.fromkeys([*names, *(name for some in CHANGES for name in some)]))
    return [
        (name, place) for name in names
        for place in find(name).places(ring) if problem.sees((name, place))
    ]  # fmt: skip


def _as_answer(found: Refitted) -> dict[str, Any]:
    hypotheses = found.seen.hypotheses
    prior = np.array([found.problem.prior(h) for h in hypotheses])
    threshold = found.seen.threshold(DEFAULT.false_alarm)
    return answer(hypotheses, found.statistic, found.amount, prior, threshold)


def plain_kinds(case: Case) -> dict[str, Guesses]:
    """Return first guesses of a case of kinds by method, as `baselines` without the network."""
    problem = problem_of(ring_of(case.lattice), case.measured, case.before, {})
    start = fit(problem, (), problem.first)
    hypotheses = _hypotheses(case, problem)
    if len(hypotheses) * len(start.residual) > MOST_NUMBERS:
        return {}
    metric = problem.metric(start.point)
    rows = np.concatenate(
        [
            metric.projection.out(metric.rows(hypotheses[i : i + metric.chunk]))
            for i in range(0, len(hypotheses), metric.chunk)
        ]
    )
    clean = start.clean

    def guess(order: Sequence[int]) -> Guesses:
        return [dict(zip(("effect", "element"), hypotheses[i], strict=True)) for i in order]

    out: dict[str, Guesses] = {}
    gradients = [i for i, (name, _) in enumerate(hypotheses) if name == "quadrupole_gradient"]
    if gradients:
        solved = np.linalg.pinv(rows[gradients].T, rcond=1e-2) @ clean
        out["svd_gradients"] = guess([gradients[i] for i in np.argsort(-np.abs(solved))[:SUSPECTS]])
    for name, values in pursuits(rows, clean).items():
        order = np.argsort(-np.abs(values))[:SUSPECTS]
        out[name] = guess([int(i) for i in order if values[i] != 0])
    return out
