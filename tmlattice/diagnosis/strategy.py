"""Few causes alone, or a few among small errors everywhere: what the data speak for.

A machine has small errors everywhere, which is what nobody has to say. Where they are so small that
the noise hides them, few causes explain the readings alone; that is tried first, unless already
neighbouring monitors disagree all along the ring. Where it leaves more than noise, the sizes of the
small errors are learnt from what is left, and their evidence says whether they are there.
"""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tmlattice.diagnosis.background import SmallErrors, damped, small_errors
from tmlattice.diagnosis.prepare import Prepared
from tmlattice.effects import Cause, background_rms, find
from tmlattice.errors import BeamLostError
from tmlattice.inference import chi2
from tmlattice.inference.newton import Fit, fit
from tmlattice.inference.problem import Problem
from tmlattice.inference.search import Explanation, Search, explain, on_readings, revised
from tmlattice.lattice import Ring
from tmlattice.observe.data import Data
from tmlattice.observe.first_turns import turns_of
from tmlattice.observe.noise import local_misfit

Array = NDArray[np.float64]

FEW = 3
"""Causes that are sought alone before anybody asks for small errors."""

SPARSE = 0.05
"""Excess of the variance between neighbouring monitors, over that of all readings less the orbit
that a launch makes, below which faults are few: small errors that make up an orbit all along the
ring have at least 0.08 of it between neighbours, eight faults of the small ring 0.02."""

MEDIAN = 0.674
"""Of what neighbouring monitors leave of one another, in noise, where there is noise alone."""

ENOUGH = 20
"""Readings of which a median is taken at least."""

CROWDED = 1.5
"""Median of what neighbouring monitors leave of one another, in noise, above
which few causes are not tried: a few leave most gaps between monitors as the design has them."""

DOUBT = 8.0
"""Statistic of the likeliest fault from which on it is weighed with sizes learnt without it."""

OUTLYING = 5.0
"""Times its usual size from which a small error that outweighs its family is weighed as a fault:
of machines in good order one in a million has it."""

AMOUNT = 5.0
"""Log evidence that an amount costs which may be anything: even over four decades, of both signs,
known to some per cent."""

POOR = 0.01
"""Chance that noise leaves as much as an explanation, below which its small errors are doubted."""

NEAR = 7.0
"""Log evidence by which a rival is behind that sizes learnt with the fault among them may hide."""

SETTLED = 3
"""How often small errors are taken again along what was found, until no rival of it leads."""

CLEAR = 10.0
"""Log evidence above which small errors are there."""


@dataclass(frozen=True)
class Found:
    """An explanation, and the small errors beside it.

    Attributes:
        explanation: of the search.
        small: None: there are none.
    """

    explanation: Explanation
    small: SmallErrors | None = None


def sought(
    ring: Ring,
    ready: Prepared,
    search: Search,
    told: Mapping[str, float] | None,
    earlier: Found | None = None,
) -> Found:
    """What explains the data.

    Args:
        ring: the design.
        ready: the data.
        search: what is searched.
        told: rms of small errors by effect; empty: there are none; None: the data say.
        earlier: what explains a reference by itself. Where the small errors that all shots ask for
            lose the beam, for a fault is no small error, they start at the reference's.
    """
    if told is not None:
        if not told:
            search.progress("scan")
            return Found(explain(search, ready.before))
        search.progress("background")
        given = small_errors(ring, ready.problem, ready.known, told, ready.before.nuisances)
        return Found(*_among(ring, ready, search, given))
    few = None
    if not _crowded(ready):
        search.progress("scan")
        few = explain(replace(search, most=min(FEW, search.most)), ready.before)
        alone = explained(few)
        more = few.full and few.count < search.most
        more = more and few.scan.chance < few.problem.judgement.false_alarm
        if alone and not more:
            return Found(few)
        if more and (alone or _sparse(few)):
            few = explain(search, ready.before, few)
    search.progress("small errors")
    start = ready.before if few is None else few.fit
    about = [] if few is None or not few.named else [strongest(few)]
    usual = background_rms({"all": None})
    starts: list[tuple[Mapping[str, float], list[Cause]]] = [(usual, [])]
    if earlier is not None and earlier.small is not None:
        starts.append((earlier.small.sizes, _errors(earlier, earlier.small)))
    small: SmallErrors | None = None
    for sizes, errors in starts:
        with suppress(BeamLostError):  # then they are none that anybody learns
            small = small_errors(
                ring, ready.problem, ready.known, sizes, start.nuisances, about, errors,
                learn=True, noisy=ready.estimated,
            )  # fmt: skip
            break
    if small is None or (small.evidence is not None and small.evidence < CLEAR):
        if few is None:  # errors all along the ring: a few names at most, nothing without one
            few = explain(replace(search, most=min(FEW, search.most), unnamed=False), ready.before)
        elif few.full and few.count < search.most:
            few = explain(search, ready.before, few)
        return Found(few)
    among = Found(*_among(ring, ready, search, small))
    return Found(few) if few is not None and _likelier(few, among.explanation) else among


def _sparse(found: Explanation) -> bool:
    """Whether neighbouring monitors agree although the orbit all along the ring does not."""
    typical, count = _between(turns_of(found).data, found.fit)
    if count <= ENOUGH:
        return False
    excess = (typical / MEDIAN) ** 2 - 1
    error = 2.3 / count**0.5  # of the square of a median of noise
    everywhere = found.fit.chi2 / freedom(found.problem, found.fit) - 1
    return bool(excess - error < SPARSE * everywhere)


def _likelier(few: Explanation, among: Explanation) -> bool:
    """Whether faults alone explain all, and clearly better than fewer among small errors do, on
    the readings that both keep."""
    dropped = few.dropped | among.dropped
    return explained(few) and _log_marginal(few, dropped) > CLEAR + _log_marginal(among, dropped)


def _log_marginal(found: Explanation, dropped: NDArray[np.bool_]) -> float:
    """Log evidence, launches and small errors integrated out, up to a constant of the readings."""
    problem = turns_of(found).without(dropped)
    evidence, again = on_readings(problem, found)
    if not again.good:
        return -np.inf
    return evidence + problem.whitening.log_scale + again.projection.log_volume


def _errors(found: Found, small: SmallErrors) -> list[Cause]:
    """The likeliest small errors beside an explanation."""
    return small.estimate(found.explanation.fit, turns_of(found.explanation).whitening)


def _crowded(ready: Prepared) -> bool:
    """Whether neighbouring monitors disagree all along the ring; nobody knows without a noise."""
    data = ready.problem.data
    if ready.estimated:
        return False
    typical, count = _between(data, ready.before)
    return count > ENOUGH and typical > CROWDED


def _between(data: Data, found: Fit) -> tuple[float, int]:
    """Median of what neighbouring monitors leave of one another, in noise, and of how many."""
    left = local_misfit(data, found.point.view) / data.sigma
    left = np.abs(left[np.isfinite(left)])
    return float(np.median(left)) if len(left) else 0.0, len(left)


def explained(found: Explanation) -> bool:
    """Whether few causes leave nothing but noise."""
    more, _ = found.problem.judgement.noise
    return _left(found) >= more


def _left(found: Explanation) -> float:
    """Chance that noise leaves as much."""
    return float(chi2.sf(found.fit.chi2, freedom(found.problem, found.fit)))


def _among(
    ring: Ring, ready: Prepared, search: Search, small: SmallErrors
) -> tuple[Explanation, SmallErrors]:
    """The background, taken again along the orbit of what is found where that misleads."""
    few = min(2, search.most)  # two findings say already whether it has to be taken again
    learn = stale = small.evidence is not None  # stale: what is found made sizes too large
    search.progress("scan")
    narrow = replace(search, most=few, names_first=True)
    explanation = explain(replace(narrow, problem=small.problem), small.before)
    for _ in range(ready.problem.judgement.retaken):
        tried = _beside(explanation, small if learn else None)
        if tried is None:
            break
        search.progress("background with what was found")
        beside, causes = tried
        weigh = not explanation.count and beside is explanation.fit  # one of the small errors
        likeliest = small.estimate(beside, turns_of(explanation).whitening)
        errors, there = damped(
            ring, small, ready.known, likeliest, causes, beside.nuisances, explanation.dropped
        )
        causes, errors = _parted(causes, errors, small)
        try:
            again = small_errors(
                ring, small.plain, ready.known, small.sizes, there.nuisances, causes, errors,
                learn=learn, noisy=learn and ready.estimated, weigh=weigh,
            )  # fmt: skip
        except BeamLostError:
            break  # what was found is no place from which they can be taken again
        if again.apart is not None and again.apart > AMOUNT:
            narrow = replace(narrow, granted=frozenset((c.effect, c.element) for c in causes))
        other = explain(replace(narrow, problem=again.problem), again.before)
        if not explanation.count and not other.count:
            break  # it was a small error after all
        small, explanation, stale = again, other, False
    if explanation.full and search.most > few:
        whole = replace(search, problem=small.problem, granted=narrow.granted)
        explanation = explain(whole, small.before)
    narrow = replace(narrow, most=max(explanation.count, 1))
    learn = False
    for _ in range(SETTLED):
        if not explanation.fit.causes or explanation.fit.kicks:
            break
        names = explanation.names
        explanation, small = _settled(ring, ready, narrow, explanation, small, learn)
        learn, stale = stale and _undecided(explanation), False
        if explanation.names == names and not learn:
            break
    return explanation, small


def _undecided(explanation: Explanation) -> bool:
    """Whether something at another place does nearly as well as what was found."""
    for named in explanation.named:
        best = named.rivals[0]
        for other in named.rivals[1:]:
            behind = best.fit.log_evidence - other.fit.log_evidence
            if behind < NEAR and other.hypothesis[1] != best.hypothesis[1]:
                return True
    return False


def _settled(
    ring: Ring,
    ready: Prepared,
    search: Search,
    explanation: Explanation,
    small: SmallErrors,
    learn: bool,
) -> tuple[Explanation, SmallErrors]:
    """Small errors linear about all that was found, its amounts among them, and its rivals too.

    What they took up of a fault before it was found spoils the slopes about which its rivals were
    weighed: by ten in the log evidence, for a fault of 50 times the noise.
    """
    found = explanation.fit
    likeliest = small.estimate(found, turns_of(explanation).whitening)
    errors, there = damped(
        ring, small, ready.known, likeliest, found.causes, found.nuisances, explanation.dropped
    )
    causes, errors = _parted(there.causes, errors, small)
    try:
        about = small_errors(
            ring, small.plain, ready.known, small.sizes, there.nuisances, causes, errors,
            learn=learn, noisy=learn and ready.estimated,
        )  # fmt: skip
    except BeamLostError:
        return explanation, small
    problem = about.problem.without(explanation.dropped)
    again = fit(problem, causes, there.nuisances)
    if not again.good:
        return explanation, small
    settled = replace(explanation, problem=problem, fit=again, before=about.before)
    if _left(settled) < POOR:  # so large that they are linear nowhere: slopes as good as any
        return settled, replace(about, open=small.open, evidence=small.evidence)
    settled = revised(replace(search, problem=about.problem, keep=True), settled)
    known = about.open if learn else small.open
    return settled, replace(about, open=known, evidence=small.evidence)


def _parted(
    causes: Sequence[Cause], errors: list[Cause], small: SmallErrors
) -> tuple[tuple[Cause, ...], list[Cause]]:
    """Causes, and the small errors beside them, without a share in both: all is the cause's.

    Small errors are in a reference too, and causes are not: beside one both have their own.
    """
    if not small.plain.data.active.all():
        return tuple(causes), errors
    own = {(error.effect, error.element): error.amount for error in errors}
    whole = {}
    for cause in causes:
        where = (cause.effect, cause.element)
        amount = find(cause.effect).joined(cause.amount, own.get(where, 0.0))
        whole[where] = replace(cause, amount=amount)
    kept = [replace(e, amount=0.0) if (e.effect, e.element) in whole else e for e in errors]
    return tuple(whole.values()), kept


def strongest(explanation: Explanation) -> Cause:
    """The named cause that was seen most clearly."""
    clear = [named.detection.statistic for named in explanation.named]
    return explanation.fit.causes[int(np.argmax(clear))]


def _beside(
    explanation: Explanation, learnt: SmallErrors | None
) -> tuple[Fit, tuple[Cause, ...]] | None:
    """Beside which fit, and with which causes, small errors have to be taken again; None: they
    stand.

    A strong fault's orbit makes small errors look like further faults, so the strongest finding is
    taken along. A monitor that was set aside has errors of its own that took up what they could: it
    starts anew. And sizes that were learnt with a fault among them are too large, so that it passes
    for a small error: where nothing was found the likeliest fault has to be weighed without it.
    """
    if not explanation.count:
        if learnt is None:
            return None
        estimate = learnt.estimate(explanation.fit, turns_of(explanation).whitening)
        cause = outlier(estimate, learnt.sizes)
        if cause is not None and learnt.plain.data.active.all():  # else it is in the reference too
            return explanation.fit, (replace(cause, amount=0.0),)  # so far all is a small error's
        cause = _likeliest(explanation)
        if cause is None:
            return None
        tried = fit(explanation.problem, [cause], explanation.fit.nuisances)
        return (tried, tried.causes) if tried.good else None
    found = explanation.fit
    doubtful = explanation.count > 1 or _left(explanation) < POOR
    if not (explanation.monitors or (found.causes and doubtful)):
        return None
    # the others may be the background's
    return found, (strongest(explanation),) if explanation.named else ()


def outlier(estimate: Sequence[Cause], sizes: Mapping[str, float]) -> Cause | None:
    """The small error that no machine in good order has: it outweighs its family by far.

    A family of which the readings see few (four correctors that are set) takes its size from such a
    one, and so hides it.

    Args:
        estimate: the likeliest small errors.
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


def _likeliest(explanation: Explanation) -> Cause | None:
    """What the scan sees most of, if that is to be doubted."""
    scan = explanation.first
    top = int(np.argmax(scan.statistic)) if len(scan.statistic) else -1
    if top < 0 or scan.statistic[top] < DOUBT:
        return None
    name, place = scan.hypotheses[top]
    amount = np.copysign(abs(scan.amount[top]) ** (1 / find(name).power), scan.amount[top])
    return Cause(name, place, float(amount))


def freedom(problem: Problem, result: Fit) -> int:
    """Degrees of freedom: readings and priors, less what was fitted."""
    amounts = sum(not find(cause.effect).discrete for cause in result.causes)
    kicks = sum(len(values) for values in result.kicks.values())
    return max(problem.freedom - amounts - kicks, 1)
