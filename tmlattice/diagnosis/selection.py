"""One search for causes, with distributed errors in the null hypothesis where the data need them.

Every machine has distributed errors. Where they are below the noise, a sparse set of causes leaves
only noise. Otherwise the distributed errors enter the model: causes are selected given their
scales, and the scales are estimated by marginal likelihood given the causes, in turn, until the
causes stay the same. Every kind of measurement, and several together, take the same steps.
"""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from tmlattice.arrays import Array
from tmlattice.effects import Cause, Hypothesis, LaunchEffect, find
from tmlattice.errors import MeasurementError, UnstableRingError
from tmlattice.inference import chi2
from tmlattice.inference.alternatives import leading
from tmlattice.inference.combined import CombinedProblem
from tmlattice.inference.distributed import (
    MAX_ELEMENTS,
    DistributedErrors,
    FittedErrors,
    fit_distributed_errors,
    full_chi2,
    rescaled,
)
from tmlattice.inference.judgement import Judgement
from tmlattice.inference.newton import Fit, fit
from tmlattice.inference.problem import Problem
from tmlattice.inference.search import Explanation, Search, explain, revised
from tmlattice.observe.first_turns import FirstTurns

STEPS = 4
"""Linearisations of the distributed errors at new findings, at most; two are usual."""


@dataclass(frozen=True)
class Selection:
    """Selected causes.

    Attributes:
        explanation: of the search.
        distributed: errors in the model; None: there are none.
        common: causes in the measurement and in its reference.
    """

    explanation: Explanation
    distributed: FittedErrors | None = None
    common: tuple[Cause, ...] = ()


def select(
    search: Search,
    everywhere: Sequence[Hypothesis],
    sizes: Mapping[str, float],
    *,
    learn: bool,
    noisy: bool = False,
    known: DistributedErrors | None = None,
    reference: Selection | None = None,
) -> Selection:
    """Return the causes that explain the data.

    Args:
        search: model, data and hypotheses.
        everywhere: distributed errors that the machine may have.
        sizes: rms of them by effect; empty: there are none.
        learn: estimate from the data whether there are any, and their scales; `sizes` are the
            first guess.
        noisy: the noise is a guess, and is estimated with the scales.
        known: distribution of the errors before these data, instead of sizes.
        reference: selection for the reference alone. Its distributed errors are those of the
            measurement, with the same scales: a fault is none of them.

    Raises:
        MeasurementError: the design loses the beam.
    """
    problem = search.problem
    seen = [h for h in everywhere if problem.sees(h)]
    search.progress("scan")
    start = fit(problem, (), problem.first)
    if start.point.lost:
        raise MeasurementError(f"{start.point.lost} in the design: is it this machine's lattice?")
    if known is None and not sizes:
        return Selection(explain(search, start))
    learn = learn and known is None
    sparse: Explanation | None = None
    if learn and (noisy or problem.disagreement(start.point) <= problem.judgement.sparse):
        sparse = _sparse(search, start)
        if explained(sparse) or len(start.residual) * len(seen) > MAX_ELEMENTS:
            return Selection(sparse)
    search.progress("distributed errors")
    prior = DistributedErrors.usual(seen, sizes)
    if known is not None and len(known.rms):
        prior = known.extended(seen)
    amounts: Array | None = None
    if reference is not None and reference.distributed is not None:
        there = reference.distributed.problem
        prior, amounts = there.known, there.estimate(reference.explanation.fit.clean)
        learn = False
    begun = start if sparse is None else sparse.fit
    tried: list[tuple[float, FittedErrors]] = []
    # causes together with which the scales are estimated, and the log prior of their amounts: the
    # scales have several optima, since a strong fault is a cause, or makes them larger
    starts: list[tuple[tuple[Cause, ...], float]] = [((), 0.0)]
    if learn and sparse is not None and sparse.fit.causes and not sparse.fit.kicks:
        starts.append((sparse.fit.causes, _log_prior(sparse.fit)))
    for causes, weight in starts:
        with suppress(UnstableRingError):  # then they are not in the model
            small = fit_distributed_errors(
                problem, prior, begun.nuisances, causes, learn=learn, noisy=noisy,
                linearised_at=amounts,
            )  # fmt: skip
            tried.append((small.log_marginal + weight, small))
    best = max(tried, key=lambda one: one[0])[1] if tried else None
    if best is None or (learn and best.log_evidence < problem.judgement.log_odds):
        found = _sparse(search, start) if sparse is None else sparse
        return Selection(explain(search, start, found) if found.full else found)
    return _given_distributed(search, best, learn, noisy)


def select_changes(
    search: Search,
    before: Search,
    everywhere: Sequence[Hypothesis],
    sizes: Mapping[str, float],
    *,
    learn: bool,
    noisy: bool = False,
) -> Selection:
    """Return the causes in a measurement that are not in its reference.

    A large error of both has to be in the model, or its change from launch to launch looks like a
    fault. So the reference is diagnosed alone first. An error that it shows too weakly is selected
    in the measurement, and is in both if that makes the readings more probable.

    Args:
        search: of the measurement and its reference.
        before: of the reference alone.
        everywhere, sizes, learn, noisy: see `select`.
    """
    search.progress("reference")
    before = replace(before, most=Search.most)
    alone = select(before, everywhere, sizes, learn=learn, noisy=noisy)
    assert isinstance(search.problem, CombinedProblem)
    launched = any(isinstance(part, FirstTurns) for part in search.problem.parts)
    common = _of_machine(alone.explanation.fit.causes, launched)
    for _ in range(Search.most):
        own = replace(search, problem=search.problem.with_fixed(common))
        found = select(own, everywhere, sizes, learn=learn, noisy=noisy, reference=alone)
        more = _of_machine(_in_both(found.explanation), launched)
        if not more:
            break
        common = (*common, *more)
    return replace(found, common=common)


def _of_machine(causes: Sequence[Cause], launched: bool) -> tuple[Cause, ...]:
    """Without those of launches, which differ from one measurement to the next."""
    return tuple(c for c in causes if not (launched and isinstance(find(c.effect), LaunchEffect)))


def _in_both(explanation: Explanation) -> tuple[Cause, ...]:
    """Findings of the measurement that are more probably in the reference too."""
    problem, result = explanation.problem, explanation.fit
    shared = []
    for i, cause in enumerate(result.causes):
        others = (*result.causes[:i], *result.causes[i + 1 :])
        there = fit(problem.with_fixed([cause]), others, result.nuisances)
        if there.good and there.chi2 < result.chi2:
            shared.append(cause)
    return tuple(shared)


# --- without distributed errors ------------------------------------------------------------------
def explained(found: Explanation) -> bool:
    """Whether the causes leave only noise."""
    more, _ = found.problem.judgement.noise
    return float(chi2.sf(found.fit.chi2, freedom(found.problem, found.fit))) >= more


def freedom(problem: Problem, result: Fit) -> int:
    """Degrees of freedom: readings and priors, less the fitted numbers."""
    amounts = sum(not find(cause.effect).discrete for cause in result.causes)
    kicks = sum(len(values) for values in result.kicks.values())
    return max(problem.freedom - amounts - kicks, 1)


def _sparse(search: Search, start: Fit) -> Explanation:
    """Search cause by cause, as long as the causes that may follow can leave only noise: each
    explains no more than the next one does now."""
    found = None
    more, _ = search.problem.judgement.noise
    for count in range(1, search.most + 1):
        found = explain(replace(search, most=count), start, found)
        noise = float(chi2.isf(more, freedom(found.problem, found.fit)))
        following = max(own.statistic.max(initial=0.0) for own in (found.scan, found.left))
        if not found.full or found.fit.chi2 - (search.most - count) * following > noise:
            break
    assert found is not None
    return found


def _log_prior(result: Fit) -> float:
    """Log prior probability of the causes with amounts within their errors."""
    return result.log_evidence + 0.5 * result.chi2


# --- with distributed errors ---------------------------------------------------------------------
def _given_distributed(search: Search, small: FittedErrors, learn: bool, noisy: bool) -> Selection:
    """Search cause by cause; after each one the distributed errors are estimated again."""
    unnamed = search.unnamed and bool(len(search.problem.kick_places))
    search = replace(search, unnamed=unnamed, labelled_first=True)
    search.progress("scan")
    first = replace(search, problem=small.problem, most=1)
    found = explain(first, small.before)
    if learn and not found.count:
        found, small = _hidden(first, found, small, noisy)
    so_far: Explanation | None = None
    for _ in range(search.most):
        if found.fit.kicks or not found.count:
            break
        search.progress("distributed errors with the findings")
        try:
            there = _at_findings(small, found, so_far, learn, noisy)
        except UnstableRingError:
            break  # no linearisation exists at the findings
        if there is None:
            found = so_far or explain(replace(first, most=0), small.before)
            break
        (small, so_far), choices = there, found.choices
        # each was significant given errors that had absorbed a part of it: none is removed
        own = replace(search, problem=small.problem, most=min(found.count + 1, search.most))
        found = explain(own, small.before, revised(replace(own, keep=True), so_far))
        if found.choices == choices:
            break
    return Selection(found, small)


def _at_findings(
    small: FittedErrors,
    found: Explanation,
    so_far: Explanation | None,
    learn: bool,
    noisy: bool,
) -> tuple[FittedErrors, Explanation] | None:
    """Linearise the distributed errors at the findings until the amounts settle, and estimate the
    scales given these.

    Where orbits are millimetres off in strong sextupoles, the linear model may predict a gain that
    the full one has not: then None.

    Args:
        so_far: without the latest finding; None: there were none.

    Raises:
        UnstableRingError: no beam is stored there, or no fit exists.
    """
    earlier = small.before if so_far is None else so_far.fit
    without = full_chi2(small, earlier, found.dropped)
    for _ in range(STEPS):
        small, causes = _linearised(small, found.fit, found.fit.causes, learn=False)
        found = _refitted(small, found, causes)
        if not _moved(found.fit, causes):
            break
    gain = without - full_chi2(small, found.fit, found.dropped)
    if len(found.fit.causes) > len(earlier.causes) and gain < 2 * small.plain.judgement.log_odds:
        return None
    if not learn:
        return small, found
    small = rescaled(small, found.fit.causes, found.fit.nuisances, noisy)
    return small, _refitted(small, found, found.fit.causes)


def _refitted(small: FittedErrors, found: Explanation, causes: Sequence[Cause]) -> Explanation:
    problem = small.problem.without(found.dropped)
    again = fit(problem, causes, small.before.nuisances)
    if not again.good:
        raise UnstableRingError(f"the findings cannot be fitted: {again.outcome}")
    return replace(found, problem=problem, fit=again, before=small.before)


def _moved(found: Fit, causes: Sequence[Cause]) -> bool:
    """Whether an amount is more than its error from where the errors were linearised."""
    sigma = np.sqrt(np.maximum(np.diag(found.covariance), 0.0))
    return any(
        abs(cause.amount - there.amount) > error
        for cause, there, error in zip(found.causes, causes, sigma, strict=True)
    )


def _hidden(
    search: Search, found: Explanation, small: FittedErrors, noisy: bool
) -> tuple[Explanation, FittedErrors]:
    """Search again with scales estimated without the most probable fault.

    Scales that include a fault are too large, and hide it. Where they explain the readings nearly
    as well as the fault does, there is none: scales without a leading candidate are smaller, and
    make it look significant.
    """
    known = small.problem.known
    amounts = small.problem.estimate(found.fit.clean).tolist()
    estimate = [Cause(*h, a) for h, a in zip(known.hypotheses, amounts, strict=True)]
    result, established = found.fit, frozenset[Hypothesis]()
    cause = outlier(estimate, small.sizes, search.problem.judgement)
    weigh = cause is not None and small.plain.alone  # else the reference has it too
    if not weigh:
        some = search.problem.judgement.alternatives
        leaders = leading(found.problem, found.first, some)
        if not leaders:
            return found, small
        hypothesis, amount = next(iter(leaders.items()))
        result = fit(found.problem, [Cause(*hypothesis, amount)], result.nuisances)
        if not result.good:
            return found, small
        cause = result.causes[0]
    assert cause is not None
    search.progress("distributed errors with the findings")
    try:  # an outlier is all in the distributed errors so far
        own = replace(cause, amount=0.0) if weigh else cause
        again, _ = _linearised(small, result, [own], learn=True, noisy=noisy, weigh=weigh)
    except UnstableRingError:
        return found, small
    enough = search.problem.judgement.log_odds
    if not weigh and again.log_marginal + _log_prior(result) - small.log_marginal < enough:
        return found, small
    if (again.outlier_evidence or 0.0) > enough:
        established = frozenset({(cause.effect, cause.element)})
    other = explain(replace(search, problem=again.problem, established=established), again.before)
    return (other, again) if other.count else (found, small)


def _linearised(
    small: FittedErrors,
    found: Fit,
    causes: Sequence[Cause],
    *,
    learn: bool,
    noisy: bool = False,
    weigh: bool = False,
) -> tuple[FittedErrors, tuple[Cause, ...]]:
    """The distributed errors, linearised at the most probable ones given the findings, and the
    causes with their share in them.

    Raises:
        UnstableRingError: no beam is stored there.
    """
    known = small.problem.known
    amounts = small.problem.estimate(found.clean)
    causes, amounts = _separated(causes, amounts, known, small.plain)
    again = fit_distributed_errors(
        small.plain, known, found.nuisances, causes, learn=learn, noisy=noisy,
        linearised_at=amounts, stored=small.problem.linearised_at, weigh=weigh,
    )  # fmt: skip
    if not learn:
        again = replace(again, errors=small.errors, log_evidence=small.log_evidence)
    return again, causes


def _separated(
    causes: Sequence[Cause], amounts: Array, known: DistributedErrors, problem: Problem
) -> tuple[tuple[Cause, ...], Array]:
    """Causes, and distributed errors without a share in them: the causes have it all.

    Distributed errors are in a reference too, and causes are not: there both have their own.
    """
    if not problem.alone:
        return tuple(causes), amounts
    at = {hypothesis: i for i, hypothesis in enumerate(known.hypotheses)}
    amounts, whole = amounts.copy(), {(cause.effect, cause.element): cause for cause in causes}
    for own in whole.keys() & at.keys():
        i, cause = at[own], whole[own]
        beyond = float(amounts[i] - known.amounts[i])
        whole[own] = replace(cause, amount=find(cause.effect).joined(cause.amount, beyond))
        amounts[i] = known.amounts[i]
    return tuple(whole.values()), amounts


def outlier(
    estimate: Sequence[Cause], sizes: Mapping[str, float], judgement: Judgement
) -> Cause | None:
    """The outlier among the distributed errors: an amount far above its family's scale.

    The scale of a small family (four correctors that are set) includes such an outlier, and hides
    it.

    Args:
        estimate: the most probable distributed errors.
        sizes: rms of their families, as estimated: where all are large, so is what is usual.
        judgement: with the false-alarm rate, shared among all errors.
    """
    usual = {name: find(name).background or np.inf for name in sizes}
    common = max(1.0, float(np.median([sizes[name] / usual[name] for name in sizes])))
    squares = dict.fromkeys(sizes, 0.0)
    for cause in estimate:
        squares[cause.effect] += cause.amount**2
    far = [c for c in estimate if 2 * c.amount**2 > squares[c.effect]]
    worst = max(far, key=lambda c: abs(c.amount) / usual[c.effect], default=None)
    if worst is None:
        return None
    ratio = abs(worst.amount) / (common * usual[worst.effect])
    return worst if chi2.sf(ratio**2, 1) * len(estimate) < judgement.false_alarm else None
