"""Which causes explain the data: one after another, each choice open to revision.

A step scans every hypothesis, stops where nothing is above the threshold, refits the leading
hypotheses through the nonlinear model, and takes the one with the largest evidence: an effect of
the catalogue, or something without a name at a place, or a monitor that is set aside. After each
step every earlier choice is held against its rivals again, with all the others in place.

>>> found = explain(Search(problem, hypotheses), fit(problem, (), launches))
"""

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from tmlattice.inference import chi2
from tmlattice.inference.alternatives import Alternative, Detection, alternatives, linear_evidence
from tmlattice.inference.newton import Fit, Outcome, fit
from tmlattice.inference.options import Option, Reading, outlier, unnamed
from tmlattice.inference.problem import Hypothesis, Problem
from tmlattice.inference.scan import (
    NO_SCAN,
    FreeScan,
    Scan,
    scan,
    scan_kicks,
    scan_monitors,
)

log = logging.getLogger(__name__)

Flags = NDArray[np.bool_]


@dataclass(frozen=True)
class Search:
    """What is searched, and by which rules.

    Attributes:
        problem: model and data, nothing left out.
        hypotheses: what may be the cause.
        most: findings at most.
        unnamed: whether free kicks, monitors set aside and single readings may explain something.
        by_evidence: evidence alone says whether a first cause is there, not the rate of false
            alarms: for a caller that asks for the likeliest explanation, whatever it is.
        names_first: what has a name goes before a free kick. Else that is tried where a free kick
            took what a name nearly explains, and the evidence decides.
        enough: chi-square at which nothing is left to be explained, and no further look is taken.
        granted: hypotheses of which it is decided already that something is there.
        keep: whether a cause may only give way to a better one, not to none.
        seed: of the threshold's simulation.
        progress: told what was found.
    """

    problem: Problem
    hypotheses: Sequence[Hypothesis]
    most: int = 8
    unnamed: bool = True
    by_marginal_likelihood: bool = False
    labelled_first: bool = False
    enough: float = -np.inf
    established: frozenset[Hypothesis] = frozenset()
    keep: bool = False
    seed: int = 0
    progress: Callable[[str], None] = lambda _: None


@dataclass(frozen=True)
class Identified:
    """A cause with a name: how it was seen, and what was held against it, itself the first."""

    detection: Detection
    alternatives: tuple[Alternative, ...]


@dataclass(frozen=True)
class State:
    """What is explained so far.

    Attributes:
        problem: without what was left out.
        fit: all named causes, free kicks and nuisances together.
        named: of each cause of the fit, in their order.
        kicks: how each free kick was seen, by place.
        monitors: those set aside because no named cause explains them.
        spikes: single readings left out.
        dropped: all readings left out, of the problem's shape.
        effective: number of independent hypotheses that pure noise sees; None: not known yet.
        passed_over: whether a free kick took what a name nearly explains.
    """

    problem: Problem
    fit: Fit
    dropped: Flags
    named: tuple[Identified, ...] = ()
    kicks: Mapping[int, Detection] = field(default_factory=dict)
    monitors: Mapping[int, Detection] = field(default_factory=dict)
    outliers: tuple[Reading, ...] = ()
    effective: float | None = None
    kick_preferred: bool = False

    @property
    def count(self) -> int:
        """Findings: causes with a name, free kicks, and monitors set aside."""
        return len(self.named) + len(self.kicks) + len(self.monitors)

    @property
    def names(self) -> frozenset[object]:
        """Of causes and places of kicks."""
        causes = ((c.effect, c.element) for c in self.fit.causes)
        return frozenset([*causes, *self.fit.kicks])

    @property
    def choices(self) -> object:
        """All of them, what was left out too."""
        return self.names, frozenset(self.monitors), frozenset(self.outliers)


AnyState = TypeVar("AnyState", bound=State)


@dataclass(frozen=True)
class Explanation(State):
    """What was found, and the scans that saw it.

    Attributes:
        before: the nuisances alone.
        first, first_kicks: the scans of the nuisances alone, which saw the first finding.
        scan, left: the last ones, of what is left.
        full: whether the search ended because no more findings were allowed.
        beyond: one cause more, refitted and not taken.
    """

    before: Fit = None  # type: ignore[assignment]
    first: Scan = None  # type: ignore[assignment]
    first_kicks: FreeScan = NO_SCAN
    scan: Scan = None  # type: ignore[assignment]
    left: FreeScan = NO_SCAN
    full: bool = False
    beyond: tuple[Alternative, ...] = ()


@dataclass(frozen=True)
class Scans:
    """One look at what is left: all scans about a state."""

    named: Scan
    kicks: FreeScan
    monitors: FreeScan


def explain(search: Search, before: Fit, so_far: Explanation | None = None) -> Explanation:
    """Search for the causes of what the nuisances leave unexplained.

    Args:
        search: what is searched.
        before: the nuisances alone.
        so_far: a search for fewer that goes on; None: a new one.
    """
    found = _run(search, before, so_far)
    if not (found.kick_preferred and found.kicks):
        return found
    few = min(search.most, found.count + 1)
    other = _run(replace(search, labelled_first=True, most=few), before)
    return other if _weighed(search, other, found) > _weighed(search, found, other) else found


def _run(search: Search, before: Fit, so_far: Explanation | None = None) -> Explanation:
    first: Scans | None = None
    if so_far is None:
        state = State(search.problem, before, np.zeros(search.problem.valid.shape, dtype=bool))
    else:
        state = State(**{own.name: getattr(so_far, own.name) for own in fields(State)})
        first = Scans(so_far.first, so_far.first_kicks, NO_SCAN)
    seen: set[frozenset[object]] = set()
    visited: set[object] = set()
    pending = False  # choices were added or readings left out since all were held against rivals
    while True:
        state, scans = _scan_all(search, state)
        first = first or scans
        full = state.count >= search.most
        over = full or len(state.outliers) > state.problem.judgement.most_outliers
        options = [] if over else _options(search, state, scans)
        beyond = next((option.alternatives for option in options if option.kind == "named"), ())
        # the rate of false alarms says whether anything is there; evidence what more
        told = () if seen or search.by_marginal_likelihood else ("named",)
        options = [option for option in options if option.gain > 0 or option.kind in told]
        seen.add(state.names)
        visited.add(state.choices)
        if not options and not pending:
            break
        if not options:
            state, pending = revised(search, state), False
            continue
        best, state = _choice(search, state, options)
        log.info("%d findings, next %s, log evidence +%.1f", state.count, best.name, best.gain)
        search.progress(best.name)
        there, state = state, _taken(search, state, best, scans)
        if state.fit.point.lost:  # the model has no answer there
            state = there
            break
        pending = pending or state.count > 1
        if state.count > 1 and best.kind != "reading":
            state = revised(search, state, quick=True)
        if state.fit.chi2 <= search.enough:
            break
        if state.choices in visited or (best.kind in ("named", "kick") and state.names in seen):
            break  # what was added went again
    if pending:
        state = revised(search, state)
    return Explanation(
        **vars(state), before=before, first=first.named, first_kicks=first.kicks,
        scan=scans.named, left=scans.kicks, full=full, beyond=beyond,
    )  # fmt: skip


def _weighed(search: Search, one: State, other: State) -> float:
    """Log evidence of an explanation on the readings that both keep."""
    return on_readings(search.problem.without(one.dropped | other.dropped), one)[0]


def on_readings(problem: Problem, state: State) -> tuple[float, Fit]:
    """Log evidence of what is explained, refitted on the readings of a problem; and that fit.

    Args:
        problem: with the readings that two explanations are compared on.
        state: one of them.
    """
    refitted = fit(problem, state.fit.causes, state.fit.nuisances, state.fit.kicks)
    aside = problem.unknown_prior(len(problem.monitors)) * len(state.monitors)
    return refitted.log_evidence + aside + problem.judgement.outlier_prior * len(
        state.outliers
    ), refitted


# --- looking ----
def _scan(search: Search, state: State) -> Scan:
    return scan(
        state.problem.metric(state.fit.point),
        search.hypotheses,
        state.fit.residual,
        effective=state.effective,
        seed=search.seed,
    )


def _scan_all(search: Search, state: State) -> tuple[State, Scans]:
    problem, residual = state.problem, state.fit.residual
    about = problem.metric(state.fit.point)
    named = scan(about, search.hypotheses, residual, effective=state.effective, seed=search.seed)
    kicks = monitors = NO_SCAN
    if search.unnamed and len(problem.kick_places):
        kicks = scan_kicks(about, range(len(problem.kick_places)), residual)
    if search.unnamed:
        monitors = scan_monitors(about, residual)
    return replace(state, effective=named.effective), Scans(named, kicks, monitors)


def _options(search: Search, state: State, scans: Scans) -> list[Option]:
    """What could be done next."""
    problem = state.problem
    judge = problem.judgement
    options = []
    statistic = float(scans.named.statistic.max(initial=0.0))
    rate = judge.rate("named")
    detection = Detection(statistic, scans.named.threshold(rate), scans.named.p_value(statistic))
    top = scans.named.hypotheses[int(scans.named.statistic.argmax())] if statistic > 0 else None
    if top is not None and top not in search.established and detection.p_value < rate:
        freedom = problem.certainty(state.fit.point, top)
        detection = Detection(
            statistic,
            chi2.estimated(detection.threshold, freedom),
            scans.named.p_value(chi2.known(statistic, freedom)),
        )
    if detection.p_value < rate or (search.by_marginal_likelihood and statistic > 0):
        tried = alternatives(problem, state.fit, scans.named, search.hypotheses)
        if tried and (search.by_marginal_likelihood or tried[0].fit.chi2 < state.fit.chi2):
            gain = tried[0].fit.log_evidence - state.fit.log_evidence
            name = " ".join(str(word) for word in tried[0].hypothesis if word)
            options.append(Option("named", name, gain, detection, alternatives=tried))
    for kind, free, names, taken in (
        ("kick", scans.kicks, problem.kick_places, state.kicks),
        ("monitor", scans.monitors, problem.monitors, state.monitors),
    ):
        if len(free.places):
            options += unnamed(problem, kind, free, names, taken)
    if search.unnamed:
        options += outlier(problem, state.fit.point, len(state.outliers))
    if state.fit.outcome is Outcome.STUCK:
        options = [_refitted(search, state, option, scans) for option in options]
    return options


def _refitted(search: Search, state: State, option: Option, scans: Scans) -> Option:
    """With what it takes of chi-square in fact: about a fit that is stuck a scan says little."""
    if option.kind == "named":
        return option
    fell = state.fit.chi2 - _taken(search, state, option, scans).fit.chi2
    return replace(option, gain=option.gain + 0.5 * (fell - option.detection.statistic))


def _choice(search: Search, state: State, options: Sequence[Option]) -> tuple[Option, State]:
    """The one that explains most; or the cause with a name, where names come first."""
    best = max(options, key=lambda option: option.gain)
    named = [option for option in options if option.kind == "named"]
    if named and best.kind == "kick":
        if search.labelled_first:
            return named[0], state
        nearly = named[0].gain > state.problem.judgement.nearly * best.gain
        state = replace(state, kick_preferred=state.kick_preferred or nearly)
    return best, state


# --- taking ----
def _taken(search: Search, state: State, option: Option, scans: Scans) -> State:
    if option.kind == "named":
        named = (*state.named, Identified(option.detection, option.alternatives))
        return replace(state, fit=option.alternatives[0].fit, named=named)
    if option.kind == "kick":
        place = int(np.flatnonzero(scans.kicks.places == option.where)[0])
        kicks = {**state.fit.kicks, option.where: scans.kicks.amounts[place]}
        found = fit(state.problem, state.fit.causes, state.fit.nuisances, kicks)
        return replace(state, fit=found, kicks={**state.kicks, option.where: option.detection})
    dropped = state.dropped.copy()
    if option.kind == "reading":
        dropped[option.reading] = True
        return _without(
            search,
            replace(state, outliers=(*state.outliers, option.reading)),
            dropped,
        )
    dropped |= state.problem.owner() == option.where
    aside = {**state.monitors, option.where: option.detection}
    return _without(search, replace(state, monitors=aside), dropped)


def _without(search: Search, state: AnyState, dropped: Flags) -> AnyState:
    """The same causes on the readings that are left."""
    problem = search.problem.without(dropped)
    found = fit(problem, state.fit.causes, state.fit.nuisances, state.fit.kicks)
    return replace(state, problem=problem, fit=found, dropped=dropped)


# --- revising ----
def revised(search: Search, state: AnyState, quick: bool = False) -> AnyState:
    """Every choice held against its rivals, all the others in place, until none changes.

    Args:
        search: what is searched; its problem has all readings.
        state: what is explained so far.
        doubted: once, only causes that a scan puts behind others, and kicks against few rivals:
            all of eight after each choice would take most of the time.
    """
    for _ in range(1 if quick else 3):
        names = state.names
        for monitor in list(state.monitors):
            state = _monitor_revised(search, state, monitor)
        for place in list(state.fit.kicks):
            state = _kick_revised(search, state, place, 3 if quick else 8)
        for cause in state.fit.causes:
            state = _cause_revised(search, state, (cause.effect, cause.element), quick)
        if names == state.names:
            break
    return state


def _monitor_revised(search: Search, state: AnyState, monitor: int) -> AnyState:
    """A monitor that was set aside comes back where a named cause, or none, does as well."""
    own = state.problem.owner() == monitor
    others = {m: seen for m, seen in state.monitors.items() if m != monitor}
    outliers = tuple(outlier for outlier in state.outliers if not own[outlier])
    back = replace(
        _without(search, state, state.dropped & ~own),
        monitors=others,
        outliers=outliers,
    )
    if back.fit.point.lost:
        return state
    about = back.problem.metric(back.fit.point)
    free = scan_monitors(about, back.fit.residual)
    alone = float(free.gain[monitor]) + back.problem.unknown_prior(len(free.gain))
    if back.fit.outcome is Outcome.STUCK:  # see `_refitted`
        alone += 0.5 * (back.fit.chi2 - state.fit.chi2 - float(free.statistic[monitor]))
    if alone <= 0:
        return back
    tried = alternatives(back.problem, back.fit, _scan(search, back), search.hypotheses, 8)
    if tried and tried[0].fit.log_evidence - back.fit.log_evidence > alone:
        named = (*back.named, Identified(state.monitors[monitor], tried))
        return replace(back, fit=tried[0].fit, named=named)
    return state


def _kick_revised(search: Search, state: AnyState, place: int, count: int) -> AnyState:
    """A free kick gives way to a named cause, or to none, where that explains more."""
    now = state.fit
    kicks = {k: v for k, v in now.kicks.items() if k != place}
    seen = {k: v for k, v in state.kicks.items() if k != place}
    alone = fit(state.problem, now.causes, now.nuisances, kicks, slopes=now.slopes)
    without = replace(state, fit=alone, kicks=seen)
    if alone.point.lost:
        return state
    if alone.log_evidence > now.log_evidence:
        return without
    tried = alternatives(state.problem, alone, _scan(search, without), search.hypotheses, count)
    if tried and tried[0].fit.log_evidence > now.log_evidence:
        named = (*state.named, Identified(state.kicks[place], tried))
        return replace(without, fit=tried[0].fit, named=named)
    return state


def _cause_revised(
    search: Search, state: AnyState, hypothesis: Hypothesis, quick: bool
) -> AnyState:
    """A named cause gives way to a better one, or to none; its rivals are weighed anew."""
    now = state.fit
    own = [i for i, c in enumerate(now.causes) if (c.effect, c.element) == hypothesis]
    if not own:
        return state
    k = own[0]
    rest = (*now.causes[:k], *now.causes[k + 1 :])
    named = (*state.named[:k], *state.named[k + 1 :])
    alone = fit(state.problem, rest, now.nuisances, now.kicks, slopes=now.slopes)
    without = replace(state, fit=alone, named=named)
    if alone.point.lost:
        return state
    if not search.keep and alone.log_evidence > now.log_evidence:
        return without
    about = _scan(search, without)
    if quick:
        leader = about.hypotheses[int(linear_evidence(state.problem, about).argmax())]
        if leader == hypothesis:
            return state
    tried = alternatives(state.problem, alone, about, search.hypotheses, 12)
    if hypothesis not in [rival.hypothesis for rival in tried]:
        order = (*rest, now.causes[k])
        kept = fit(state.problem, order, now.nuisances, now.kicks, slopes=now.slopes)
        found = [*tried, Alternative(hypothesis, kept)]
        tried = tuple(sorted(found, key=lambda rival: -rival.fit.log_evidence))
    named = (*named, Identified(state.named[k].detection, tried))
    return replace(without, fit=tried[0].fit, named=named)
