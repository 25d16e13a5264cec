"""A sparse solution alone, or together with distributed errors: what the data determine.

Every machine has distributed errors. Where the noise exceeds them, a sparse solution alone explains
the readings; it is tried first, unless neighbouring BPMs disagree all along the ring. Where it
leaves more than noise, the variance components of the distributed errors are learnt, and the
marginal likelihood decides whether they are in the model. Every kind of measurement, and several
together, take the same steps.
"""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tmlattice.effects import Cause, LaunchEffect, find
from tmlattice.errors import MeasurementError, UnstableRingError
from tmlattice.inference import chi2
from tmlattice.inference.distributed import (
    MAX_ELEMENTS,
    DistributedErrors,
    FittedErrors,
    fit_distributed_errors,
)
from tmlattice.inference.newton import Fit, fit
from tmlattice.inference.problem import Hypothesis, Problem
from tmlattice.inference.search import Explanation, Search, explain, on_readings, revised

Array = NDArray[np.float64]

FEW = 3
"""Causes of a sparse solution before distributed errors are tried."""

CROWDED = 1.5
"""Median misfit between neighbouring BPMs, in units of the noise, above which faults are not
sparse."""

MOST_OF_IT = 0.5
"""Share of the gap of one cause from which on variance components are learnt without it."""

DOUBT = 8.0
"""Statistic of the most probable fault from which on it is compared, with prior scales learnt
without it."""

OUTLYING = 5.0
"""Ratio of an amount to the usual rms from which on an outlier of its family is compared as a
fault; one in a million of healthy machines has it."""

AMOUNT = 5.0
"""Log evidence that an unconstrained amount costs: log-uniform over four decades, of both signs,
known to some per cent."""

POOR = 0.01
"""Probability of so large a residual by noise below which distributed errors are compared."""

NEAR = 7.0
"""Log evidence by which an alternative may be behind while prior scales include the fault."""

SETTLED = 3
"""Most relinearisations of the distributed errors, until no alternative leads."""

CLEAR = 10.0
"""Log evidence above which distributed errors are in the model."""


@dataclass(frozen=True)
class Found:
    """An explanation, and the distributed errors together with it.

    Attributes:
        explanation: of the search.
        small: None: there are none.
    """

    explanation: Explanation
    small: FittedErrors | None = None


def sought(
    search: Search,
    everywhere: Sequence[Hypothesis],
    sizes: Mapping[str, float],
    *,
    learn: bool,
    noisy: bool = False,
    known: DistributedErrors | None = None,
    earlier: Found | None = None,
) -> Found:
    """Return the explanation of the data.

    Args:
        search: what is searched.
        everywhere: the small errors that the machine may have.
        sizes: rms of them by effect; empty: there are none.
        learn: whether there are any, and how large they are, the data determine; `sizes` is where
            that starts.
        noisy: the noise is a guess, and learnt with them.
        known: of the small errors beforehand, instead of sizes.
        earlier: what explains the reference alone. The small errors start at those of the
            reference, and are as large: a fault is none of them.

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
        return Found(explain(search, start))
    few: Explanation | None = None
    begun = start
    if known is None and learn and (noisy or problem.disagreement(start.point) <= CROWDED):
        narrow = replace(search, most=min(FEW, search.most))
        kicks = bool(len(problem.kick_places))
        few = explain(replace(narrow, unnamed=search.unnamed and kicks), start)
        if search.unnamed and not kicks and not explained(few) and not _crowded(few):
            few = explain(narrow, start)
        more = few.full and few.count < search.most
        more = more and few.scan.chance < problem.judgement.false_alarm
        if explained(few) or len(start.residual) * len(seen) > MAX_ELEMENTS:
            return Found(explain(search, start, few) if more else few)
        begun = few.fit
    search.progress("small errors")
    first = DistributedErrors.usual(seen, sizes) if known is None else known
    learn = learn and known is None
    asides = dict.fromkeys(((), () if few is None else _outstanding(few)))
    amounts: Array | None = None
    if earlier is not None and earlier.small is not None:
        there = earlier.small.problem
        first, amounts = there.known, there.estimate(earlier.explanation.fit.clean)
        learn = False
    tried: list[FittedErrors] = []
    for causes in asides:
        with suppress(UnstableRingError):  # then they are not learnt
            tried.append(fit_distributed_errors(
                problem, first, begun.nuisances, causes, learn=learn, noisy=noisy,
                linearised_at=amounts,
            ))  # fmt: skip
    if not tried or (learn and max(small.log_evidence for small in tried) < CLEAR):
        if few is None:  # distributed errors: a sparse set of causes at most
            few = explain(replace(search, most=min(FEW, search.most), unnamed=False), start)
        elif few.full and few.count < search.most:
            few = explain(search, start, few)
        return Found(few)
    several: list[Found] = []
    for small in tried:
        several.append(Found(*_among(search, small, learn, noisy)))
        if several[-1].explanation.count and _left(several[-1].explanation) >= POOR:
            break
    among = several[-1]
    if len(several) > 1:
        among = max(several, key=lambda one: _log_marginal(one.explanation))
    return Found(few) if few is not None and _likelier(few, among.explanation) else among


MOST_COMMON = 8
"""Causes of a reference at most."""
ROUNDS = 3
"""Most findings of the measurement that may turn out to be in its reference too."""


def sought_since(
    search: Search,
    before: Search,
    everywhere: Sequence[Hypothesis],
    sizes: Mapping[str, float],
    *,
    learn: bool,
    noisy: bool = False,
) -> Found:
    """Return the explanation of a measurement that is not in its reference.

    A large error of both has to be in the model, or its change from launch to launch looks like a
    fault. So the reference is diagnosed alone first. An error that it shows too weakly is found in
    the measurement, and is in both if that makes the readings more probable.

    Args:
        search: of the measurement and its reference.
        before: of the reference alone.
        everywhere, sizes, learn, noisy: see `sought`.
    """
    search.progress("reference")
    before = replace(before, most=MOST_COMMON)
    alone = sought(before, everywhere, sizes, learn=learn, noisy=noisy)
    common = _of_ring(alone.explanation.fit.causes)
    for _ in range(ROUNDS):
        own = replace(search, problem=search.problem.with_fixed(common))
        found = sought(own, everywhere, sizes, learn=learn, noisy=noisy, earlier=alone)
        more = _of_ring(_in_both(found.explanation))
        if not more:
            break
        common = (*common, *more)
    return found


def _of_ring(causes: Sequence[Cause]) -> tuple[Cause, ...]:
    """Without the launches' own, which are fitted in each measurement anyway."""
    return tuple(c for c in causes if not isinstance(find(c.effect), LaunchEffect))


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


# --- together with distributed errors -----------------------------------------------------------
def _among(
    search: Search, small: FittedErrors, learn: bool, noisy: bool
) -> tuple[Explanation, FittedErrors]:
    """The distributed errors, linearised again at the findings where needed."""
    problem = search.problem
    unnamed = search.unnamed and bool(len(problem.kick_places))
    search = replace(search, unnamed=unnamed)
    few = min(2, search.most)  # two findings show already whether it has to be linearised again
    stale = learn  # the findings made the prior scales too large
    search.progress("scan")
    narrow = replace(search, most=few, labelled_first=True)
    explanation = explain(replace(narrow, problem=small.problem), small.before)
    for _ in range(problem.judgement.retaken):
        doubt = _given(explanation, small, learn)
        if doubt is None:
            break
        search.progress("small errors with what was found")
        beside, causes = doubt
        weigh = not explanation.count and beside is explanation.fit  # one of the distributed errors
        try:
            again, causes = _linearised(small, beside, causes, learn, noisy, weigh)
        except UnstableRingError:
            break  # no linearisation exists at the findings
        if again.outlier_evidence is not None and again.outlier_evidence > AMOUNT:
            narrow = replace(narrow, established=frozenset((c.effect, c.element) for c in causes))
        other = explain(replace(narrow, problem=again.problem), again.before)
        if not explanation.count and not other.count:
            break  # it is one of the distributed errors
        small, explanation, stale = again, other, False
    if explanation.full and search.most > few:
        whole = replace(search, problem=small.problem, established=narrow.established)
        explanation = explain(whole, small.before)
    narrow = replace(narrow, most=max(explanation.count, 1))
    learn = False
    for _ in range(SETTLED):
        if not explanation.fit.causes or explanation.fit.kicks:
            break
        names = explanation.names
        explanation, small = _settled(narrow, explanation, small, learn, noisy)
        learn, stale = stale and _undecided(explanation), False
        if explanation.names == names and not learn:
            break
    return explanation, small


def _linearised(
    small: FittedErrors,
    found: Fit,
    causes: Sequence[Cause],
    learn: bool,
    noisy: bool,
    weigh: bool = False,
) -> tuple[FittedErrors, tuple[Cause, ...]]:
    """The small errors again, linearised at the most probable ones given what was found, and the
    causes with their share in them.

    Raises:
        UnstableRingError: no beam is stored there.
    """
    known = small.problem.known
    amounts = small.problem.estimate(found.clean)
    causes, amounts = _parted(causes, amounts, known, small.plain)
    again = fit_distributed_errors(
        small.plain, known, found.nuisances, causes, learn=learn, noisy=learn and noisy,
        linearised_at=amounts, stored=small.problem.linearised_at, weigh=weigh,
    )  # fmt: skip
    if not learn:
        again = replace(again, errors=small.errors, log_evidence=small.log_evidence)
    return again, causes


def _parted(
    causes: Sequence[Cause], amounts: Array, known: DistributedErrors, problem: Problem
) -> tuple[tuple[Cause, ...], Array]:
    """Causes, and distributed errors without a share in them: the causes have it all.

    Small errors are in a reference too, and causes are not: there both have their own.
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


def _settled(
    search: Search, explanation: Explanation, small: FittedErrors, learn: bool, noisy: bool
) -> tuple[Explanation, FittedErrors]:
    """Distributed errors linearised at all findings with their amounts, and the alternatives too.

    What they took up of a fault before it was found spoils the slopes at which its rivals were
    weighed: by ten in the log evidence, for a fault of 50 times the noise.
    """
    found = explanation.fit
    try:
        about, causes = _linearised(small, found, found.causes, learn, noisy)
    except UnstableRingError:
        return explanation, small
    problem = about.problem.without(explanation.dropped)
    again = fit(problem, causes, about.before.nuisances)
    if not again.good:
        return explanation, small
    settled = replace(explanation, problem=problem, fit=again, before=about.before)
    if _left(settled) < POOR:  # too large to be linear anywhere
        return settled, about
    return revised(replace(search, problem=about.problem, keep=True), settled), about


def _undecided(explanation: Explanation) -> bool:
    """Whether an alternative at another place explains nearly as much."""
    for named in explanation.named:
        best = named.alternatives[0]
        for other in named.alternatives[1:]:
            behind = best.fit.log_evidence - other.fit.log_evidence
            if behind < NEAR and other.hypothesis[1] != best.hypothesis[1]:
                return True
    return False


def _given(
    explanation: Explanation, small: FittedErrors, learn: bool
) -> tuple[Fit, tuple[Cause, ...]] | None:
    """The fit and the causes to linearise the distributed errors at; None where they stay.

    A strong fault's orbit makes small errors look like further faults, so the strongest finding is
    taken along. A monitor that was set aside has errors of its own that took up what they could: it
    starts anew. And sizes that were learnt with a fault among them are too large, so that it passes
    for a small error: where nothing was found the most probable fault has to be weighed without it.
    """
    if not explanation.count:
        if not learn:
            return None
        known = small.problem.known
        amounts = small.problem.estimate(explanation.fit.clean).tolist()
        estimate = [Cause(*h, a) for h, a in zip(known.hypotheses, amounts, strict=True)]
        cause = outlier(estimate, small.sizes)
        if cause is not None and small.plain.alone:  # else the reference has it too
            return explanation.fit, (
                replace(cause, amount=0.0),
            )  # so far it is all in the distributed errors
        cause = _most_probable(explanation)
        if cause is None:
            return None
        tried = fit(explanation.problem, [cause], explanation.fit.nuisances)
        return (tried, tried.causes) if tried.good else None
    found = explanation.fit
    doubtful = explanation.count > 1 or _left(explanation) < POOR
    if not (explanation.monitors or (found.causes and doubtful)):
        return None
    # the others may be distributed errors
    return found, (strongest(explanation),) if explanation.named else ()


# --- weighing ------------------------------------------------------------------------------------
def _likelier(few: Explanation, among: Explanation) -> bool:
    """Whether faults alone explain all, and better than fewer with distributed errors, on common
    readings."""
    dropped = few.dropped | among.dropped
    return explained(few) and _log_marginal(few, dropped) > CLEAR + _log_marginal(among, dropped)


def _log_marginal(found: Explanation, dropped: NDArray[np.bool_] | None = None) -> float:
    """Log evidence, nuisances and distributed errors integrated out, up to a constant."""
    problem = found.problem if dropped is None else found.problem.without(dropped)
    evidence, again = on_readings(problem, found)
    if not again.good:
        return -np.inf
    return evidence + problem.log_scale + again.projection.log_volume


def explained(found: Explanation) -> bool:
    """Whether a sparse solution leaves only noise."""
    more, _ = found.problem.judgement.noise
    return _left(found) >= more


def _left(found: Explanation) -> float:
    """Probability of so large a residual by noise."""
    return float(chi2.sf(found.fit.chi2, freedom(found.problem, found.fit)))


def freedom(problem: Problem, result: Fit) -> int:
    """Degrees of freedom: readings and priors, less the fitted numbers."""
    amounts = sum(not find(cause.effect).discrete for cause in result.causes)
    kicks = sum(len(values) for values in result.kicks.values())
    return max(problem.freedom - amounts - kicks, 1)


def _outstanding(few: Explanation) -> tuple[Cause, ...]:
    """A cause that alone explains most of the gap and would increase all prior scales."""
    if not few.named:
        return ()
    clear = max(named.detection.statistic for named in few.named)
    gap = few.before.chi2 - few.problem.freedom
    return (strongest(few),) if clear > MOST_OF_IT * gap else ()


def _crowded(found: Explanation) -> bool:
    """Whether most BPMs still disagree."""
    problem = found.problem
    left, _ = problem.left(found.fit.point)
    owner = problem.owner()[problem.valid]
    own, squares = owner[owner >= 0], left[problem.valid][owner >= 0] ** 2
    if not len(own):
        return False
    count = np.bincount(own, minlength=len(problem.monitors))
    mean = np.bincount(own, squares, len(problem.monitors)) / np.maximum(count, 1)
    return float(np.median(np.sqrt(mean[count > 0]))) > CROWDED


def strongest(explanation: Explanation) -> Cause:
    """The named cause with the largest statistic."""
    clear = [named.detection.statistic for named in explanation.named]
    return explanation.fit.causes[int(np.argmax(clear))]


def outlier(estimate: Sequence[Cause], sizes: Mapping[str, float]) -> Cause | None:
    """The outlier among the distributed errors: an amount far above its family's scale.

    A family of which the readings see few (four correctors that are set) takes its size from such a
    one, and so hides it.

    Args:
        estimate: the most probable small errors.
        sizes: rms of their families, as learnt: where all are large, so is what is usual.
    """
    usual = {name: find(name).background or np.inf for name in sizes}
    common = max(1.0, float(np.median([sizes[name] / usual[name] for name in sizes])))
    squares = dict.fromkeys(sizes, 0.0)
    for cause in estimate:
        squares[cause.effect] += cause.amount**2
    far = [c for c in estimate if 2 * c.amount**2 > squares[c.effect]]
    worst = max(far, key=lambda c: abs(c.amount) / usual[c.effect], default=None)
    if worst is None or abs(worst.amount) < OUTLYING * common * usual[worst.effect]:
        return None
    return worst


def _most_probable(explanation: Explanation) -> Cause | None:
    """The leading hypothesis of the scan, if it is doubtful."""
    scan = explanation.first
    top = int(np.argmax(scan.statistic)) if len(scan.statistic) else -1
    if top < 0 or scan.statistic[top] < DOUBT:
        return None
    name, place = scan.hypotheses[top]
    effect = find(name)
    if effect.discrete:
        return None
    root = min(abs(scan.amount[top]) ** (1 / effect.power), effect.largest)
    return Cause(name, place, float(np.copysign(root, scan.amount[top])))
