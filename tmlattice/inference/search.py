"""Stepwise search for the causes that explain the data, with every choice revised.

A step scans every hypothesis, ends below the threshold, refits the leading hypotheses through the
nonlinear model, and takes the one with the largest evidence: an effect of the catalogue, a free
kick at a place, or a rejected BPM. After each step every earlier choice is compared with its
alternatives, together with all the others.

>>> found = explain(Search(problem, hypotheses), fit(problem, (), launches))
"""

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import TypeVar

import numpy as np

from tmlattice.arrays import Flags
from tmlattice.effects import Hypothesis
from tmlattice.inference import chi2
from tmlattice.inference.alternatives import Alternative, Detection, alternatives, linear_evidence
from tmlattice.inference.newton import AGAIN, Fit, Outcome, fit
from tmlattice.inference.problem import Metric, Point, Problem
from tmlattice.inference.scan import (
    NO_SCAN,
    FreeScan,
    Scan,
    free_threshold,
    look_elsewhere,
    scan,
    scan_kicks,
    scan_monitors,
)

log = logging.getLogger(__name__)


READINGS_PER_OUTLIER = 10
"""Readings per rejected one, at least: of a few readings, such as two tunes, none is rejected."""

Reading = tuple[int, ...]
"""Index among the problem's readings."""


@dataclass(frozen=True)
class Option:
    """Next step of a search: its gain in log evidence, and its significance."""

    kind: str
    name: str
    gain: float
    detection: Detection
    where: int = -1
    reading: Reading = ()
    alternatives: tuple[Alternative, ...] = ()


def unnamed(
    problem: Problem,
    kind: str,
    free: FreeScan,
    names: Sequence[str],
    taken: Mapping[int, Detection],
) -> list[Option]:
    """Free kick or rejected BPM that explains most, if significant.

    Args:
        problem: model and data.
        kind: "kick" or "monitor".
        free: the scan of all places.
        names: of the places.
        taken: places that have one.
    """
    rate = problem.judgement.rate(kind)
    where = int(free.gain.argmax())
    freedom = max(int(free.freedom[where]), 1)
    seen = _detection(float(free.statistic[where]), rate, freedom, len(names))
    if not seen.p_value < rate or where in taken:
        return []
    gain = float(free.gain[where]) + problem.unknown_prior(len(names))
    return [Option(kind, f"{kind} at {names[where]}", gain, seen, where=where)]


def _detection(statistic: float, rate: float, freedom: int, count: float) -> Detection:
    """Significance of the largest of a number of chi-squares."""
    threshold = free_threshold(rate, freedom, count)
    return Detection(statistic, threshold, look_elsewhere(statistic, freedom, count))


def outlier(problem: Problem, point: Point, already: int) -> list[Option]:
    """Rejection of the reading with the largest residual, if significant.

    Args:
        problem: model and data.
        point: the model of the fit.
        already: number of rejected readings.
    """
    thresholds = problem.judgement
    if int(problem.valid.sum()) < READINGS_PER_OUTLIER * (already + 1):
        return []
    clean, size = problem.left(point)
    statistic = np.where(size > 1e-3, clean**2 / np.maximum(size, 1e-3), 0.0)
    worst = tuple(int(i) for i in np.unravel_index(int(statistic.argmax()), statistic.shape))
    value, count = float(statistic[worst]), float(problem.valid.sum())
    rate = thresholds.rate("reading")
    seen = _detection(value, rate, 1, count)
    if not seen.p_value < rate:
        return []
    # a log-uniform amount, as for every other cause
    prior = thresholds.outlier_prior(problem.valid.size)
    gain = 0.5 * value - 0.5 * np.log(max(value, 1.0)) - np.log(4.0) + prior
    return [Option("reading", f"reading {worst}", float(gain), seen, reading=worst)]


@dataclass(frozen=True)
class Search:
    """What is searched, and the rules.

    Attributes:
        problem: model and all data.
        hypotheses: candidate causes.
        most: findings at most.
        unnamed: whether free kicks, rejected BPMs and rejected readings may explain something.
        by_marginal_likelihood: the marginal likelihood alone decides on a first cause, not the
            false-alarm rate: for the most probable explanation, significant or not.
        labelled_first: effects of the catalogue go before a free kick. Else that is tried if a free
            kick was preferred to a significant effect, and the evidence decides.
        enough: chi-square below which the search ends.
        established: hypotheses whose presence is known.
        keep: a cause may be replaced, not removed.
        seed: of the threshold's simulation.
        progress: called with the name of each finding.
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
    """Significance of a cause of the catalogue, and its alternatives, itself the first."""

    detection: Detection
    alternatives: tuple[Alternative, ...]


@dataclass(frozen=True)
class State:
    """Present explanation.

    Attributes:
        problem: without rejected readings.
        fit: all causes, free kicks and nuisances together.
        named: of each cause of the fit, in their order.
        kicks: significance of each free kick, by place.
        monitors: rejected BPMs, which no cause of the catalogue explains.
        outliers: rejected single readings.
        dropped: all rejected readings, of the problem's shape.
        effective: number of independent hypotheses in pure noise; None: not yet simulated.
        kick_preferred: whether a free kick was preferred to an effect of the catalogue.
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
        """Number of causes, free kicks and rejected BPMs."""
        return len(self.named) + len(self.kicks) + len(self.monitors)

    @property
    def names(self) -> frozenset[object]:
        """Causes and places of kicks."""
        causes = ((c.effect, c.element) for c in self.fit.causes)
        return frozenset([*causes, *self.fit.kicks])

    @property
    def choices(self) -> object:
        """Causes, kicks and rejected readings."""
        return self.names, frozenset(self.monitors), frozenset(self.outliers)


AnyState = TypeVar("AnyState", bound=State)


@dataclass(frozen=True, kw_only=True)
class Explanation(State):
    """Final explanation with its scans.

    Attributes:
        before: fit of the nuisances alone.
        first, first_kicks: scans of that fit.
        scan, left: scans of the final residual.
        full: whether the search ended at the largest number of findings.
        beyond: one cause more, refitted and not accepted.
    """

    before: Fit
    first: Scan
    first_kicks: FreeScan = NO_SCAN
    scan: Scan
    left: FreeScan = NO_SCAN
    full: bool = False
    beyond: tuple[Alternative, ...] = ()


@dataclass(frozen=True)
class Scans:
    """All scans of a state's residual."""

    named: Scan
    kicks: FreeScan
    monitors: FreeScan


def explain(search: Search, before: Fit, so_far: Explanation | None = None) -> Explanation:
    """Search for the causes of the residual of a fit.

    Args:
        search: what is searched.
        before: fit of the nuisances alone.
        so_far: a search for fewer findings, to be continued; None: a new one.
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
        search = replace(search, problem=search.problem.near(state.fit.causes))
        first = Scans(so_far.first, so_far.first_kicks, NO_SCAN)
    seen: set[frozenset[object]] = set()
    visited: set[object] = set()
    pending = False  # choices changed since all were compared with their alternatives
    while True:
        state, scans = _scan_all(search, state)
        first = first or scans
        full = state.count >= search.most
        over = full or len(state.outliers) >= state.problem.judgement.most_outliers
        options = [] if over else _options(search, state, scans)
        beyond = next((option.alternatives for option in options if option.kind == "named"), ())
        # the false-alarm rate decides on a first finding, the evidence on further ones
        accepted = () if seen or so_far or search.by_marginal_likelihood else ("named",)
        options = [option for option in options if option.gain > 0 or option.kind in accepted]
        seen.add(state.names)
        visited.add(state.choices)
        if not options and not pending:
            break
        if not options:
            names, pending = state.names, False
            state = revised(search, state)
            if state.names != names:
                search, state = _near(search, state)
            continue
        best, state = _choice(search, state, options)
        log.info("%d findings, next %s, log evidence +%.1f", state.count, best.name, best.gain)
        search.progress(best.name)
        there, state = state, _taken(search, state, best, scans)
        if state.fit.point.lost:  # the model has no solution there
            state = there
            break
        if best.kind == "named":
            search, state = _near(search, state)
        pending = pending or state.count > 1
        if state.count > 1 and best.kind != "reading":
            state = revised(search, state, quick=True)
        if state.fit.chi2 <= search.enough:
            break
        if state.choices in visited or (best.kind in ("named", "kick") and state.names in seen):
            break  # the last choice was reverted
    if pending:
        state = revised(search, state)
    return Explanation(
        **vars(state), before=before, first=first.named, first_kicks=first.kicks,
        scan=scans.named, left=scans.kicks, full=full, beyond=beyond,
    )  # fmt: skip


def _near(search: Search, state: AnyState) -> tuple[Search, AnyState]:
    """The search and its state with the model near the present causes."""
    search = replace(search, problem=search.problem.near(state.fit.causes))
    return search, _without(search, state, state.dropped)


def _weighed(search: Search, one: State, other: State) -> float:
    """Log evidence of an explanation refitted on the readings that neither rejects."""
    problem = search.problem.without(one.dropped | other.dropped)
    refitted = fit(problem, one.fit.causes, one.fit.nuisances, one.fit.kicks)
    monitors = problem.unknown_prior(len(problem.monitors)) * len(one.monitors)
    outliers = problem.judgement.outlier_prior(problem.valid.size) * len(one.outliers)
    return refitted.log_evidence + monitors + outliers


# --- looking ----
def _scan(search: Search, state: State, about: Metric) -> Scan:
    return scan(
        about, search.hypotheses, state.fit.residual, effective=state.effective, seed=search.seed
    )


def _scan_all(search: Search, state: State) -> tuple[State, Scans]:
    problem, residual = state.problem, state.fit.residual
    about = problem.metric(state.fit.point)
    named = _scan(search, state, about)
    kicks = monitors = NO_SCAN
    if search.unnamed and len(problem.kick_places):
        kicks = scan_kicks(about, range(len(problem.kick_places)), residual)
    if search.unnamed:
        monitors = scan_monitors(about, residual)
    return replace(state, effective=named.effective), Scans(named, kicks, monitors)


def _options(search: Search, state: State, scans: Scans) -> list[Option]:
    """Possible next steps."""
    problem = state.problem
    thresholds = problem.judgement
    options = []
    statistic = float(scans.named.statistic.max(initial=0.0))
    rate = thresholds.rate("named")
    detection = _detection(statistic, rate, 1, scans.named.effective)
    top = scans.named.hypotheses[int(scans.named.statistic.argmax())] if statistic > 0 else None
    if top is not None and top not in search.established and detection.p_value < rate:
        freedom = problem.certainty(state.fit.point, top)
        known = chi2.known(statistic, freedom)
        threshold = chi2.estimated(detection.threshold, freedom)
        detection = Detection(statistic, threshold, scans.named.p_value(known))
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
        if len(free.gain):
            options += unnamed(problem, kind, free, names, taken)
    if search.unnamed:
        options += outlier(problem, state.fit.point, len(state.outliers))
    if state.fit.outcome is Outcome.STUCK:
        options = [_refitted(search, state, option, scans) for option in options]
    return options


def _refitted(search: Search, state: State, option: Option, scans: Scans) -> Option:
    """Correct the gain by the actual fall of chi-square: a scan of a stuck fit is unreliable."""
    if option.kind == "named":
        return option
    fell = state.fit.chi2 - _taken(search, state, option, scans).fit.chi2
    return replace(option, gain=option.gain + 0.5 * (fell - option.detection.statistic))


def _choice(search: Search, state: State, options: Sequence[Option]) -> tuple[Option, State]:
    """Take the step that explains most; or the cause of the catalogue, where these go first."""
    best = max(options, key=lambda option: option.gain)
    named = [option for option in options if option.kind == "named"]
    if named and best.kind == "kick":
        if search.labelled_first:
            return named[0], state
        state = replace(state, kick_preferred=True)
    return best, state


# --- taking ----
def _taken(search: Search, state: State, option: Option, scans: Scans) -> State:
    if option.kind == "named":
        named = (*state.named, Identified(option.detection, option.alternatives))
        return replace(state, fit=option.alternatives[0].fit, named=named)
    if option.kind == "kick":
        kicks = {**state.fit.kicks, option.where: scans.kicks.amounts[option.where]}
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
    """Fit the same causes without some readings."""
    problem = search.problem.without(dropped)
    found = fit(problem, state.fit.causes, state.fit.nuisances, state.fit.kicks)
    return replace(state, problem=problem, fit=found, dropped=dropped)


# --- revising ----
def revised(search: Search, state: AnyState, quick: bool = False) -> AnyState:
    """Compare every choice with its alternatives, given all others, until none changes.

    Args:
        search: what is searched; its problem has all readings.
        state: present explanation.
        quick: once, and only causes that are not the leader of a scan, and kicks against three
            alternatives: all of eight after each choice would take most of the time.
    """
    for _ in range(1 if quick else AGAIN):
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
    """Restore a rejected BPM if a cause of the catalogue, or none, explains it as well."""
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
    evidence = back.fit.log_evidence + alone
    return _better(search, state, back, evidence, state.monitors[monitor], 8)


def _kick_revised(search: Search, state: AnyState, place: int, count: int) -> AnyState:
    """Replace a free kick by a cause of the catalogue, or by none, if that explains more."""
    now = state.fit
    kicks = {k: v for k, v in now.kicks.items() if k != place}
    seen = {k: v for k, v in state.kicks.items() if k != place}
    alone = fit(state.problem, now.causes, now.nuisances, kicks, slopes=now.slopes)
    without = replace(state, fit=alone, kicks=seen)
    if alone.point.lost:
        return state
    return _better(search, state, without, now.log_evidence, state.kicks[place], count)


def _better(
    search: Search, state: AnyState, without: AnyState, evidence: float, seen: Detection, count: int
) -> AnyState:
    """Return a state without an unnamed choice, or with a cause of the catalogue in its place, if
    that explains as much as the choice.

    Args:
        search: what is searched.
        state, without: with the choice, and without it.
        evidence: log evidence with the choice.
        seen: significance of the choice.
        count: causes that are tried.
    """
    alone = without.fit
    if alone.log_evidence >= evidence:
        return without
    scanned = _scan(search, without, without.problem.metric(alone.point))
    tried = alternatives(without.problem, alone, scanned, search.hypotheses, count)
    if tried and tried[0].fit.log_evidence > evidence:
        named = (*without.named, Identified(seen, tried))
        return replace(without, fit=tried[0].fit, named=named)
    return state


def _cause_revised(
    search: Search, state: AnyState, hypothesis: Hypothesis, quick: bool
) -> AnyState:
    """Replace a cause by a better one, or by none; its alternatives are refitted."""
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
    scanned = _scan(search, without, state.problem.metric(alone.point))
    if quick:
        leader = scanned.hypotheses[int(linear_evidence(state.problem, scanned).argmax())]
        if leader == hypothesis:
            return state
    tried = alternatives(state.problem, alone, scanned, search.hypotheses, 12)
    if hypothesis not in [one.hypothesis for one in tried]:
        order = (*rest, now.causes[k])
        kept = fit(state.problem, order, now.nuisances, now.kicks, slopes=now.slopes)
        found = [*tried, Alternative(hypothesis, kept)]
        tried = tuple(sorted(found, key=lambda one: -one.fit.log_evidence))
    named = (*named, Identified(state.named[k].detection, tried))
    return replace(without, fit=tried[0].fit, named=named)
