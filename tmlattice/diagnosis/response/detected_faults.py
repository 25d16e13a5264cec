"""Single faults of an orbit response among distributed errors.

>>> apart, findings = detected_faults(data, split, fit.state, hypotheses, most, judgement)

One cause after another is given a prior of its own, together with all usual distributed errors
(`small_errors`). Their scales are learnt without it, and everything is fitted again, not
linearised. A cause is detected at five standard deviations of its family's scatter, and above the
chance level of so many causes and families.
"""

import logging
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.stats import t as student

from tmlattice.arrays import Array
from tmlattice.diagnosis.families.dispersion import OrbitFamily
from tmlattice.diagnosis.findings import finding_of
from tmlattice.diagnosis.recommended_actions import recommended_action
from tmlattice.diagnosis.response.linear import Linear, linear
from tmlattice.diagnosis.response.missing_effects import HELPS
from tmlattice.diagnosis.response.rounds import log_evidence, settle
from tmlattice.diagnosis.response.small_errors import ANEW, USUAL, sizes_in, small_errors
from tmlattice.diagnosis.response.state import Candidate, State, allow, bend
from tmlattice.diagnosis.response.stated import doubt
from tmlattice.diagnosis.response.stepwise import ROUGH, StepwiseFit, fit_chi2
from tmlattice.diagnosis.response.suspected import KINDS, Seen, Weighed, suspects_of, with_number
from tmlattice.diagnosis.response.validation import score
from tmlattice.diagnosis.result import Finding
from tmlattice.effects import Cause, find, rare
from tmlattice.errors import TmlatticeError
from tmlattice.inference.alternatives import Detection, linear_evidence
from tmlattice.inference.common_factors import MIN_CHI2
from tmlattice.inference.judgement import BEYOND, SIGNIFICANT, Judgement
from tmlattice.inference.normal import solve
from tmlattice.inference.priors import Group
from tmlattice.inference.scan import Scan
from tmlattice.observe.orbit_response import Errors, Hypothesis
from tmlattice.observe.response_data import ResponseData
from tmlattice.observe.response_problem import Response
from tmlattice.observe.split import Split

log = logging.getLogger(__name__)

FAULTS = 8
"""Most faults: more of them are distributed errors."""
WORTH, HIDDEN = 15.0, 8.0
"""Least statistic of a candidate, with scales not yet learnt without it: for one number of a
family, and for other causes, which increase the scales of all patterns of an orbit."""
TRIES = 3
"""Most candidates per step; one in a response of many readings."""
LACKS = 2.0
"""Largest chi-square per reading of a plane, given distributed errors, for a search in any case."""
MEMBERS = 16
"""Assumed number of orbit patterns, where there are none."""


def detected_faults(
    data: ResponseData,
    split: Split,
    fitted: State,
    hypotheses: Sequence[Hypothesis],
    most: int,
    judgement: Judgement,
    progress: Callable[[str], Any] = lambda stage: None,
) -> tuple[tuple[Candidate, ...], list[Finding]]:
    """Return the detected faults, one after another, each given those before it; and the findings.

    Args:
        data, split: the data, and the validation split.
        fitted: a hierarchical fit of the data.
        hypotheses: possible single faults.
        most: faults at most.
        judgement: thresholds.
        progress: called with the name of each stage.
    """
    progress("distributed errors")
    search = _Search(small_errors(data, split, fitted), hypotheses, judgement)
    progress("detected faults")
    seen_before: list[set[Hypothesis]] = []
    while not search.drowned() and len(search.state.apart) < min(most, FAULTS):
        state = search.next()
        if state is None:
            break
        search.state = state
        chosen = {one.cause for one in state.apart}
        log.info("detected: %s", chosen)
        if chosen in seen_before:
            break
        seen_before.append(chosen)
    seen = search.seen(search.state)
    return search.state.apart, [search.finding(seen, one) for one in search.state.apart]


class _Search:
    def __init__(
        self, state: State, hypotheses: Sequence[Hypothesis], judgement: Judgement
    ) -> None:
        self.state, self.hypotheses, self.judgement = state, list(hypotheses), judgement
        self.tries = TRIES if state.data.orbits.size <= ANEW else 1
        count = [name for name, _ in hypotheses]
        places = {name: count.count(name) for name in dict.fromkeys(count)}
        self.problem = Response(  # for the priors alone
            base=state.at, used=np.isfinite(state.data.orbits), places=places,
            rare=rare(state.data.ring, list(places)), judgement=judgement,
        )  # fmt: skip

    def drowned(self) -> bool:
        """Whether the residual far exceeds the noise, and no single cause explains most of it:
        model discrepancy could be detected as a fault."""
        planes = fit_chi2(self.state)[:2]
        worst = max((0, 1), key=lambda plane: planes[plane].ratio)
        own = planes[worst]
        if own.ratio**2 <= LACKS or self.state.apart:
            return False
        # by the noise alone: a large residual of a column reduces its weight
        left = [self.left_beside(*leader)[worst] for leader in self.leaders()]
        return min(left, default=np.inf) > (own.chi2 + own.freedom) / 2

    def left_beside(self, cause: Hypothesis, amount: float, information: Array) -> list[float]:
        """Chi-square of each plane with one more cause, all else unchanged; infinite without a
        closed orbit."""
        state, suspect = _as_number(self.state, cause, information)
        values = state.values[suspect.variable] + amount * suspect.members
        try:
            moved = fit_chi2(state.moved({**state.values, suspect.variable: values}))
        except TmlatticeError:
            return [np.inf, np.inf]
        return [own.chi2 for own in moved]

    def seen(self, state: State) -> Seen:
        """All suspects, linearised at the state."""
        return Seen(state, suspects_of(state, self.hypotheses))

    def evidence(self, seen: Seen, own: Weighed) -> Array:
        """Log evidence of each suspect, linear, [suspect]."""
        information = np.where(np.isfinite(own.sigma), own.sigma**-2.0, 0.0)
        causes = tuple(one.cause for one in seen.suspects)
        largest = np.array([find(name).largest for name, _ in causes])
        possible = np.abs(own.amount) < BEYOND * largest
        messages = linear_evidence(
            self.problem, Scan(causes, own.statistic, own.amount, information, 1.0)
        )
        return np.where(possible, messages, -np.inf)

    def next(self) -> State | None:
        """The state with the most probable further cause, if it is detected; else None."""
        # the distributed errors have outliers already, so the evidence need not grow with a fault;
        # a second optimum, where all readings are far less probable, is none
        least = log_evidence(self.state, self.state.good) - self.judgement.log_odds
        tried: list[tuple[float, State]] = []
        for cause, _, information in self.leaders():
            state = self.put(self.state, cause, information)
            found = -np.inf if state is None else log_evidence(state, state.good)
            if state is not None and found > least:
                tried.append((found + self.problem.prior(cause), state))
        for _, state in sorted(tried, key=lambda one: -one[0]):
            state = self.better(state, state.apart[-1])  # noqa: PLW2901
            if self.clear(self.seen(state), state.apart[-1]):
                return self.revised(state)
        return None

    def leaders(self) -> list[tuple[Hypothesis, float, Array]]:
        """Candidates: the most probable by the linear model, one of each action, with amount and
        information of each block."""
        ring = self.state.data.ring
        seen = self.seen(self.state)
        if not seen.suspects:
            return []
        own = seen.beside()
        evidence = self.evidence(seen, own)
        worth = [HIDDEN if one.block is None else WORTH for one in seen.suspects]
        evidence[own.statistic < worth] = -np.inf
        first = int(np.argmax(evidence))
        least = evidence[first] - self.judgement.window
        least -= self.judgement.drift * own.statistic[first]
        order = [int(h) for h in np.argsort(-evidence) if evidence[h] > max(least, -np.inf)]
        found: dict[str, tuple[Hypothesis, float, Array]] = {}
        have = [one.cause for one in self.state.apart]
        for h in order:
            cause = seen.suspects[h].cause
            same = recommended_action(ring, Cause(*cause, float(own.amount[h])))
            if cause not in have and len(found) < self.tries:
                found.setdefault(same, (cause, float(own.amount[h]), own.information[:, h]))
        return list(found.values())

    def put(self, state: State, cause: Hypothesis, information: Array) -> State | None:
        """The converged state with one more cause; None where no beam is stored.

        Args:
            state: without the cause.
            cause: effect and place.
            information: of each block on its amount, [2].
        """
        return _settled(_apart(_as_number(state, cause, information)[0], cause))

    def better(self, state: State, one: Candidate) -> State:
        """The state with an alternative instead of a cause, if that explains more."""
        seen = self.seen(state)
        own = seen.beside(one.name)
        evidence = self.evidence(seen, own)
        here = _place(seen, one)
        have = [other.cause for other in state.apart if other is not one]
        evidence[[h for h, s in enumerate(seen.suspects) if s.cause in have]] = -np.inf
        best = int(np.argmax(evidence))
        if not evidence[best] > evidence[here] + self.judgement.behind:
            return state
        other = self.put(_without(state, one), seen.suspects[best].cause, own.information[:, best])
        if other is None:
            return state
        prior = self.problem.prior
        gained = log_evidence(other, state.good) - log_evidence(state, state.good)
        gained += prior(other.apart[-1].cause) - prior(one.cause)
        return other if gained > 0 else state

    def revised(self, state: State) -> State:
        """The state with each cause compared with its alternatives, less redundant causes."""
        for one in state.apart[:-1]:
            state = self.better(state, one)
        while len(state.apart) > 1:
            seen = self.seen(state)
            worth = [_shown(seen, one)[0] for one in state.apart]
            if min(worth) > MIN_CHI2:
                break
            least = state.apart[int(np.argmin(worth))]
            fewer = _settled(_without(state, least))
            if fewer is None:
                break
            state = self.better(fewer, fewer.apart[-1])
        return state

    def members(self, state: State, one: Candidate) -> int:
        """Number of amounts that determine the statistic's scale, of the family or orbit
        patterns."""
        if one.variable not in (kind.variable for kind in KINDS):
            return max(len(one.members) - 1, 1)
        orbit = [len(state.values[f.variable]) for f in state.of_block(one.block or 0)
                 if isinstance(f, OrbitFamily)]  # fmt: skip
        return max(min(orbit, default=MEMBERS) - 1, 1)

    def p_value(self, seen: Seen, statistic: float, one: Candidate) -> float:
        """Probability that the largest of so many errors reaches this statistic by chance."""
        members = self.members(seen.state, one)
        own = 2 * float(student.sf(np.sqrt(max(statistic, 0.0)), members))
        return min(1.0, own * len(self.hypotheses))

    def clear(self, seen: Seen, one: Candidate) -> bool:
        """Whether the cause is detected."""
        statistic, cause, _ = _shown(seen, one)
        if not abs(cause.amount) < BEYOND * find(cause.effect).largest:
            return False
        return (
            statistic > MIN_CHI2 and self.p_value(seen, statistic, one) < self.judgement.false_alarm
        )

    def finding(self, seen: Seen, one: Candidate) -> Finding:
        """The fault with its amount, error and alternatives."""
        own = seen.beside(one.name)
        evidence = self.evidence(seen, own)
        statistic, cause, sigma = _shown(seen, one)
        cause, sigma = as_turned(cause, sigma, seen.state.at.errors, seen.state.data)
        known = {one.cause, (cause.effect, cause.element)}
        rivals = [int(h) for h in np.argsort(-evidence)[: self.judgement.alternatives]
                  if np.isfinite(evidence[h]) and seen.suspects[h].cause not in known]  # fmt: skip
        chance = np.exp(evidence[[_place(seen, one), *rivals]] - evidence.max())
        causes = (Cause(*seen.suspects[h].cause, float(own.amount[h])) for h in rivals)
        detection = Detection(statistic, MIN_CHI2, self.p_value(seen, statistic, one))
        return finding_of(
            seen.state.data.ring, (cause, *causes), chance / chance.sum(), sigma, detection,
            self.judgement.mass,
        )  # fmt: skip


def as_turned(
    cause: Cause, sigma: float, errors: Errors, data: ResponseData
) -> tuple[Cause, float]:
    """Return a cause with its error, reported as a roll if the corrector kicks significantly in the
    other plane: it has one number for each plane, and the kick that is missing in one is no
    calibration error. A corrector without any kick is not rolled."""
    if cause.effect != "corrector_calibration":
        return cause, sigma
    columns = [data.ring[own].name for own in data.measured.correctors]
    column = columns.index(data.ring[cause.element or ""].name)
    if not errors.turned[column] or abs(errors.roll[column]) < SIGNIFICANT * sigma:
        return cause, sigma
    roll = Cause("corrector_roll", cause.element, float(errors.angle[column]))
    return roll, sigma / float(errors.kick[column])


def _as_number(state: State, cause: Hypothesis, information: Array) -> tuple[State, Candidate]:
    """The state with a number for the cause, in the more sensitive block, and that number."""
    (suspect,) = suspects_of(state, [cause])
    if suspect.block is None:
        state = with_number(state, cause, int(np.argmax(information)))
        (suspect,) = suspects_of(state, [cause])
    return state, suspect


def _apart(state: State, cause: Hypothesis) -> State:
    """The state with a separate prior for a number of the fit."""
    return replace(state, apart=(*state.apart, *suspects_of(state, [cause])))


def _place(seen: Seen, one: Candidate) -> int:
    return next(h for h, suspect in enumerate(seen.suspects) if suspect.cause == one.cause)


def _shown(seen: Seen, one: Candidate) -> tuple[float, Cause, float]:
    """Statistic, amount and error of a cause, widened for contradicting BPMs and columns."""
    own, here = seen.beside(one.name), _place(seen, one)
    assert one.block is not None
    it = seen.blocks[one.block]
    posterior = solve(it.there.normal, it.sizes, it.there.start, rounds=0)
    wider = doubt(seen.state, one, it.there, posterior)
    amount, variance = float(own.amount[here]), float(own.sigma[here]) ** 2 * wider
    # a distributed error scales with the fault: it is three times as large for a kick three times
    # as strong
    share = max(abs(find(one.cause[0]).joined(amount, 1.0) - amount), 1.0)
    variance += (share**2 - 1) * _scatter(it.there, it.sizes, one) ** 2
    return float(own.statistic[here]) / wider, Cause(*one.cause, amount), float(np.sqrt(variance))


def _scatter(there: Linear, sizes: Sequence[Group], one: Candidate) -> float:
    """rms of the amount by the distributed errors of its family."""
    along = np.zeros(len(there.start))
    along[there.where[one.variable]] = one.unit
    return float(np.sqrt(sum(np.sum((along @ group.basis * group.scale) ** 2)
                             for group in sizes if group.name != one.name)))  # fmt: skip


def _without(state: State, one: Candidate) -> State:
    """The state without a cause, not converged: the next step takes its number back."""
    return replace(state, apart=tuple(other for other in state.apart if other is not one))


def _settled(state: State) -> State | None:
    """The state after convergence from the linear estimate or from the present one. None where no
    beam is stored, or where an amount is implausible. Scales are learnt anew, because a scale that
    vanished would not grow again."""
    state = replace(state, groups={})
    for begin in (_stepped, replace):
        try:
            rough = settle(begin(state), gain=ROUGH, possible=_possible)
            return settle(bend(rough)) if _possible(rough) else None
        except (TmlatticeError, np.linalg.LinAlgError):
            continue
    return None


def _possible(state: State) -> bool:
    """Whether each amount, with its family's part, is a plausible fault."""
    return all(
        abs(float(state.values[one.variable] @ one.unit)) < BEYOND * one.wide for one in state.apart
    )


def _stepped(state: State) -> State:
    """The state after one bounded Gauss-Newton step, with scales learnt without the causes."""
    values, groups = dict(state.values), dict(state.groups)
    for block in (block for block in (0, 1) if state.of_block(block)):
        there = linear(state, block)
        sizes = sizes_in(there)
        found = solve(there.normal, sizes, there.start, rounds=0)
        values |= {name: found.values[at] for name, at in there.where.items()}
        groups |= {group.name: group for group in sizes}
    return replace(state, groups=groups).moved(values)


# --- report ---------------------------------------------------------------------------------------
def given_faults(fit: StepwiseFit, apart: Sequence[Candidate]) -> StepwiseFit:
    """Return the hierarchical fit with the faults' numbers free of their families, as a further
    step; unchanged where held-out residuals grow."""
    state = fit.state
    for one in apart:
        if one.variable in (kind.variable for kind in KINDS):
            state = with_number(state, one.cause, one.block or 0)
        elif one.variable not in state.values:
            state = allow(state, [f for f in USUAL if f.variable == one.variable])
    own = {one.cause: one for one in apart}
    for cause in own:
        state = _apart(state, cause)
    settled = _settled(state)
    if settled is None:
        return fit
    title = ", ".join(f"{effect} {place}" for effect, place in own)
    before, after = fit.steps[-1], score(settled, title, len(own))
    if (
        HELPS * after.heldout_rms_in_plane > before.heldout_rms_in_plane
        or HELPS * after.heldout_rms_coupling > before.heldout_rms_coupling
    ):
        return fit
    return replace(fit, state=settled, steps=(*fit.steps, after))
