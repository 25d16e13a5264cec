"""Single faults of an orbit response among distributed errors.

>>> apart, findings, messages = detected_faults(fit.state, hypotheses, options)

All usual distributed errors of a ring are the background model of a fault (`small_errors`): the
families of a hierarchical fit, and the closed orbit in sextupoles. All readings are fitted; of
held-out correctors the half of the BPMs that determines their kicks. Priors are Gaussian, and the
largest number of a family is omitted from its scale, because it may be the fault.

A cause that is one number of a family (a quadrupole's gradient, a gain, a roll), or a sum of some
(a supply), is in the normal equations already. Others (a misaligned sextupole, a device) are
compared by their signatures; the usual errors of their effect, of which the fit has no family,
reduce their statistics.

One cause after another is given a prior of its own. The scales are learnt without it, and
everything is fitted again, not linearised. A cause is detected at five standard deviations of its
family's scatter, and above the chance level of so many causes and families.
"""

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import NamedTuple

import numpy as np
from scipy.special import ndtri, stdtr

from tmlattice.arrays import REDUNDANT, Array
from tmlattice.diagnosis.assessment import MISSING
from tmlattice.diagnosis.families.dispersion import HorizontalOrbit, OrbitFamily, VerticalOrbit
from tmlattice.diagnosis.families.family import Family, RingFamily
from tmlattice.diagnosis.families.fields import (
    FamilyGradient,
    OtherGradient,
    QuadrupoleGradient,
    SkewGradient,
)
from tmlattice.diagnosis.families.steps import (
    STEPS,
    CorrectorCalibration,
    CorrectorRoll,
    MonitorGain,
    MonitorRoll,
)
from tmlattice.diagnosis.findings import finding_of
from tmlattice.diagnosis.options import Options
from tmlattice.diagnosis.recommended_actions import recommended_action
from tmlattice.diagnosis.response.hierarchical import ROUGH, HierarchicalFit, fit_chi2, readable
from tmlattice.diagnosis.response.linear import Linear, gathered, linear
from tmlattice.diagnosis.response.rounds import LEARN, evidence_of, settle
from tmlattice.diagnosis.response.state import Candidate, State, allow, begin, bend, jump
from tmlattice.diagnosis.response.stated import doubt
from tmlattice.diagnosis.response.validation import HELPS, score
from tmlattice.diagnosis.response.weights import weighed, weight
from tmlattice.diagnosis.result import Finding
from tmlattice.effects import Cause, Hypothesis, RingEffect, find, rare
from tmlattice.errors import TmlatticeError
from tmlattice.inference.alternatives import Detection, linear_evidence
from tmlattice.inference.common_factors import MIN_CHI2
from tmlattice.inference.judgement import BEYOND, SIGNIFICANT, Judgement
from tmlattice.inference.normal import solve
from tmlattice.inference.priors import SMALLEST, Group
from tmlattice.inference.scan import Scan
from tmlattice.inference.search import Search
from tmlattice.observe.orbit_response import Errors
from tmlattice.observe.response_data import ResponseData, Split
from tmlattice.observe.response_problem import Response

log = logging.getLogger(__name__)

USUAL: tuple[Family, ...] = (
    CorrectorCalibration(), FamilyGradient(), MonitorGain(), QuadrupoleGradient(), OtherGradient(),
    MonitorRoll(), CorrectorRoll(), SkewGradient(), HorizontalOrbit(), VerticalOrbit(),
)  # fmt: skip
"""Families of every ring."""
ANEW = 20_000
"""Most readings for a second fit, from the design, because the given one may be of a wrong ring;
and for several candidates per step."""
SHARED = {
    "vertical_focusing": "vertical_focusing",
    "quadrupole_gradient of families": "quadrupole_gradient",
    "corrector_calibration of families": "corrector_calibration",
}
"""Groups of few numbers, in which the usual scale counts as `COUNTS` further numbers."""
COUNTS = 4
AFFORDABLE = 4e9
"""Most products of signatures and derivatives; above it only numbers of families are compared."""
WORTH, HIDDEN = 15.0, 8.0
"""Least statistic of a candidate, with scales not yet learnt without it: for one number of a
family, and for other causes, which increase the scales of all patterns of an orbit."""
TRIES = 3
"""Most candidates per step; one in a response of many readings."""
LACKS, ROUGHLY = 2.0, 4.0
"""Largest chi-square per reading of a plane, given distributed errors, for a search in any case;
and after a rough fit, which leaves at most twice as much as the final one."""
MEMBERS = 16
"""Assumed number of orbit patterns, where there are none."""


# --- the background model -------------------------------------------------------------------------
def small_errors(
    fitted: State, complete: bool = False,
    hopeless: Callable[[State, float], bool] = lambda state, most: False,
) -> State:  # fmt: skip
    """Return the fit of the distributed errors to all readings outside the validation set, of up to
    two starts the more probable one; a rough fit, or the given one, where all are hopeless.

    Args:
        fitted: a hierarchical fit of the data.
        complete: whether it has all families, so that a fit of further readings hardly changes its
            residual.
        hopeless: whether the residual of a fit, above a chi-square per reading, is too large for
            single faults to be sought.
    """
    data, split = fitted.data, fitted.split
    orbits, half = data.orbits.copy(), split.half.copy()
    orbits[:-1][split.held[:-1, None] & ~split.half[:-1]] = np.nan  # the validation readings
    for column in np.flatnonzero(split.held):
        half[column, np.flatnonzero(half[column])[::2]] = False  # half of the remaining ones
    data, none = replace(data, orbits=orbits), np.zeros_like(split.held)
    split = Split(none, half)
    names = [family.name for family in USUAL]
    known = [*USUAL, *(family for family in fitted.families if family.name not in names)]
    families = [f for f in known if fitted.reads(f.block) and f.size(data)]
    at = replace(fitted.at, data=data)
    continued = allow(replace(fitted, data=data, split=split, at=at), families)
    starts = [continued]
    if data.orbits.size <= ANEW:
        equal = None if fitted.independent is None else np.ones_like(fitted.independent)
        design = replace(begin(data, split), good=fitted.good, jitter=fitted.jitter,
                         independent=equal)  # fmt: skip
        starts.append(allow(design, families))
    given_up, found = list[State](), list[tuple[float, State]]()
    if complete and hopeless(fitted, LACKS):
        given_up.append(fitted)
        starts.remove(continued)
    for start in starts:
        try:
            state = settle(jump(start, beyond=1.0), gain=ROUGH)
            if hopeless(state, ROUGHLY):
                given_up.append(state)
                continue
            state = settle(bend(state))
        except (TmlatticeError, np.linalg.LinAlgError):  # diverged
            continue
        found.append((evidence_of(state, state.good, fitted.independent), state))
        log.info("distributed errors: evidence %.1f", found[-1][0])
        if all(own.ratio**2 < MISSING for own in fit_chi2(state)[:2]):
            break
    if found:
        return max(found, key=lambda one: one[0])[1]
    return (given_up or [continued])[0]


def sizes_in(there: Linear) -> tuple[Group, ...]:
    """Return the priors of a fit with scales from all numbers but each family's largest."""
    groups = [replace(group, each=None, freedom=np.inf) for group in there.groups]
    pull = there.normal.vector + there.normal.matrix @ there.start
    ends = np.cumsum([group.basis.shape[1] for group in groups])[:-1]
    for _ in range(LEARN):
        found = solve(there.normal, groups, there.start, rounds=0)
        scale = np.concatenate([group.scale for group in groups])
        amounts = found.covariance @ (found.spread.T @ pull)
        squares = (amounts**2 + np.diag(found.covariance)) * scale**2
        groups = [
            _sized(group, own) for group, own in zip(groups, np.split(squares, ends), strict=True)
        ]
    return tuple(groups)


def _sized(group: Group, squares: Array) -> Group:
    """The mean square without the largest, corrected for that omission."""
    n = len(squares)
    if group.fixed or not n:
        return group
    if group.name in SHARED:
        usual = find(SHARED[group.name]).background or SMALLEST
        mean = (squares.sum() - squares.max() + COUNTS * usual**2) / (n - 1 + COUNTS)
    elif n < 3:
        mean = float(squares.mean())
    else:
        expected = float(ndtri(0.5 / n)) ** 2  # expectation of the largest of n
        without = (squares.sum() - squares.max()) / max(n - expected, 1.0)
        mean = min(float(squares.mean()), float(without))
    return replace(group, rms=max(float(np.sqrt(mean)), SMALLEST))


# --- causes as numbers of the fit -----------------------------------------------------------------
@dataclass(frozen=True, eq=False)
class Others(RingFamily):
    """Causes without a family, of one number each, in units of its effect's largest fault; their
    priors are those of single faults.

    Attributes:
        block: whose readings determine the amounts.
        causes: effect and place.
    """

    block: int  # type: ignore[misc]
    causes: tuple[Hypothesis, ...] = ()  # type: ignore[misc]

    trust, effects = 0.03, ()

    @property
    def variable(self) -> str:  # type: ignore[override]
        """One for each block."""
        return f"others {self.block}"

    @property
    def name(self) -> str:  # type: ignore[override]
        """That of its variable."""
        return self.variable

    def groups(self, data: ResponseData) -> list[Group]:
        """None: each number has the prior of its single fault."""
        return []

    def moves(self, data: ResponseData) -> list[dict[Hypothesis, float]]:
        """One cause for each number."""
        return [{cause: find(cause[0]).largest} for cause in self.causes]


OTHERS = ("", Others(0).variable, Others(1).variable)
"""Variables of causes without a family; the first one before they are numbers."""


def with_number(state: State, cause: Hypothesis, block: int) -> State:
    """The state with one more number, at zero."""
    name = Others(block).variable
    have = next((f.causes for f in state.families
                 if isinstance(f, Others) and f.block == block), ())  # fmt: skip
    if cause in have:
        return state
    apart = tuple(
        replace(one, members=np.append(one.members, 0.0)) if one.variable == name else one
        for one in state.apart
    )
    families = [f for f in state.families if f.variable != name]
    values = {**state.values, name: np.append(state.values.get(name, np.zeros(0)), 0.0)}
    families.append(Others(block, (*have, cause)))
    return replace(state, apart=apart, families=tuple(families), values=values)


def suspects_of(state: State, causes: Sequence[Hypothesis]) -> list[Candidate]:
    """Return the suspects of causes that the readings may determine."""
    numbers = _numbers(state)
    found, signed = [], []
    for cause in causes:
        if cause in numbers:
            family, shares = numbers[cause]
            members = np.zeros(len(state.values[family.variable]))
            members[list(shares)] = list(shares.values())
            found.append(Candidate(cause, family.block, family.variable, members))
        elif cause[1] is not None and isinstance(find(cause[0]), RingEffect):
            signed.append(Candidate(cause))
    size = sum(len(values) for values in state.values.values())
    if len(signed) * state.data.orbits.size * size <= AFFORDABLE:
        found += signed
    return found


def _numbers(state: State) -> dict[Hypothesis, tuple[Family, Mapping[int, float]]]:
    """Causes that are numbers of the fit, or sums of some: family, and numbers for a unit of the
    amount. A fault of one piece of a magnet is the magnet's."""
    data, ring = state.data, state.data.ring
    out: dict[Hypothesis, tuple[Family, Mapping[int, float]]] = {}
    for family in state.families:
        gradients = isinstance(family, QuadrupoleGradient)
        magnets = gradients or isinstance(family, SkewGradient)
        each, own = family.moves(data), dict[tuple[str, str], dict[int, float]]()
        for i, moves in enumerate(each):
            for (effect, place), share in moves.items():
                pattern = family.per == "ring" and len(moves) > 1 and not magnets
                if place is not None and not pattern:
                    shares = own.setdefault((effect, ring[place].name), {})
                    shares[i] = 1.0 if magnets else share
        for (effect, name), shares in own.items():
            i, unit = next(iter(shares)), 1 / sum(share**2 for share in shares.values())
            if isinstance(family, CorrectorRoll):  # its number is a share of the stated kick
                unit *= 1 + state.at.errors.calibration[i]
            out[effect, name] = family, {n: unit * share for n, share in shares.items()}
            strength = ring[name].k1 * ring[name].length
            if gradients:
                out["gradient_absolute", name] = family, {i: 1 / strength}
            elif magnets and strength and len(each[i]) == 1:
                out["quadrupole_roll", name] = family, {i: -2 * strength}
        supply = find("family_gradient")
        assert isinstance(supply, RingEffect)
        for place in supply.places(ring) if gradients else ():
            members = (("quadrupole_gradient", ring.elements[i].name)
                       for i in supply.members(ring, place))  # fmt: skip
            some = sorted({next(iter(own[one])) for one in members if one in own})
            if len(some) > 1:
                out[supply.name, place] = family, dict.fromkeys(some, 1.0)
    return out


# --- products -------------------------------------------------------------------------------------
class _Block(NamedTuple):
    """One block of the fit, with the distributed errors' priors, and each suspect's products."""

    there: Linear
    sizes: tuple[Group, ...]  # without those of single faults
    across: Array  # J^T W S, [number, suspect]
    own: Array  # S^T W S, [suspect]
    left: Array  # S^T W r, [suspect]


class Weighed(NamedTuple):
    """The statistics of each suspect given distributed errors, [suspect]."""

    statistic: Array  # fall of chi-square, given the usual scatter of the amount
    amount: Array
    sigma: Array  # its error
    information: Array  # by block, [2, suspect]
    evidence: Array  # log, linear


class Seen:
    """The products of all suspects at a fit.

    Args:
        state: with distributed errors, and with the single faults so far.
        hypotheses: to be compared.
        problem: for their priors.
    """

    def __init__(self, state: State, hypotheses: Sequence[Hypothesis], problem: Response) -> None:
        self.state, self.problem = state, problem
        self.suspects = suspects_of(state, hypotheses)
        self.causes = tuple(one.cause for one in self.suspects)
        self.scatter = np.array([(find(one.cause[0]).background or 0.0) * (one.variable in OTHERS)
                                 for one in self.suspects])  # fmt: skip
        self.blocks = {block: self._block(block) for block in (0, 1) if state.of_block(block)}
        some = [h for h, one in enumerate(self.suspects) if one.block is None]
        weights = {block: weight(state, block) for block in self.blocks}
        signatures = state.at.signatures([self.causes[h] for h in some])
        for h, signature in zip(some, signatures, strict=True):
            for block, it in self.blocks.items():
                row = np.where(weights[block] > 0, state.data.pick(signature, block), 0.0)
                heavy = weighed(state, block, row)
                left = np.where(weights[block] > 0, state.data.pick(state.at.left, block), 0.0)
                it.own[h], it.left[h] = np.sum(heavy * row), np.sum(heavy * left)
                it.across[:, h] = gathered(it.there, state.data.plane_of(block), heavy)

    def _block(self, block: int) -> _Block:
        there = linear(self.state, block)
        across = np.zeros((len(there.normal.vector), len(self.suspects)))
        for h, one in enumerate(self.suspects):
            if one.block == block and one.variable in there.where:
                across[there.where[one.variable], h] = one.members
        left = there.normal.vector @ across
        spread = there.normal.matrix @ across
        return _Block(there, sizes_in(there), spread, np.einsum("nh,nh->h", across, spread), left)

    def place(self, one: Candidate) -> int:
        """The index of a fault."""
        return self.causes.index(one.cause)

    def beside(self, without: Candidate | None = None) -> Weighed:
        """Return the statistics of each suspect, given distributed errors and accepted faults.

        Args:
            without: an accepted fault that is replaced by its alternatives.
        """
        information, inner = np.zeros((2, 2, len(self.suspects)))
        for block, it in self.blocks.items():
            priors = [group for group in it.sizes if without is None or group.name != without.name]
            found = solve(it.there.normal, priors, it.there.start, rounds=0)
            along = found.spread.T @ it.across
            taken = np.einsum("ph,ph->h", along, found.covariance @ along)
            information[block] = np.maximum(it.own - taken, 0.0)
            information[block][information[block] < REDUNDANT * it.own] = 0.0
            inner[block] = it.left - (found.values - it.there.start) @ it.across
        inner[information == 0] = 0.0
        total, pull = information.sum(axis=0), inner.sum(axis=0)
        safe = np.where(total > 0, total, 1.0)
        amount = np.where(total > 0, pull / safe, 0.0)
        statistic = amount * pull / (1 + total * self.scatter**2)
        linear_ones = linear_evidence(
            self.problem, Scan(self.causes, statistic, amount, total, 1.0)
        )
        largest = np.array([find(name).largest for name, _ in self.causes])
        return Weighed(
            statistic, amount, np.where(total > 0, 1 / np.sqrt(safe), np.inf), information,
            np.where(np.abs(amount) < BEYOND * largest, linear_ones, -np.inf),
        )  # fmt: skip

    def shown(self, one: Candidate) -> tuple[float, Cause, float]:
        """Statistic, amount and error of a fault, widened for contradicting BPMs and columns."""
        own, here = self.beside(one), self.place(one)
        assert one.block is not None
        there, sizes, *_ = self.blocks[one.block]
        posterior = solve(there.normal, sizes, there.start, rounds=0)
        wider = doubt(self.state, one, there, posterior)
        amount, variance = float(own.amount[here]), float(own.sigma[here]) ** 2 * wider
        # a distributed error scales with the fault: it is three times as large for a kick three
        # times as strong
        share = max(abs(find(one.cause[0]).joined(amount, 1.0) - amount), 1.0)
        along = np.zeros(len(there.start))
        along[there.where[one.variable]] = one.unit
        scatter = sum(np.sum((along @ group.basis * group.scale) ** 2)
                      for group in sizes if group.name != one.name)  # fmt: skip
        variance += (share**2 - 1) * float(scatter)
        return float(own.statistic[here]) / wider, Cause(*one.cause, amount), float(variance**0.5)


# --- the search -----------------------------------------------------------------------------------
def detected_faults(
    fitted: State, hypotheses: Sequence[Hypothesis], options: Options
) -> tuple[tuple[Candidate, ...], list[Finding], list[str]]:
    """Return the detected faults, one after another, each given those before it; the findings; and
    a message if the residual is too large for a search.

    Args:
        fitted: a hierarchical fit of the data.
        hypotheses: possible single faults.
        options: of the diagnosis.
    """
    most = options.max_effects
    options.progress("distributed errors")
    search_in = cache(lambda state: _Search(state, hypotheses, options.judgement))
    tried = {family.name for family in (*fitted.families, *fitted.unneeded)}
    usual = {family.name for own in readable(fitted, STEPS) for family in own}
    state = small_errors(
        fitted, most >= len(STEPS) and tried >= usual,
        lambda state, most: search_in(state).discrepancy_message(most) is not None,
    )  # fmt: skip
    search = search_in(state)
    search_in.cache_clear()  # the others have products of their own
    message = search.discrepancy_message()
    if message is not None:
        return (), [], [message]
    options.progress("detected faults")
    seen_before: list[set[Hypothesis]] = []
    while len(search.state.apart) < min(most, Search.most):
        further = search.next()
        if further is None:
            break
        search.state = further
        chosen = {one.cause for one in further.apart}
        log.info("detected: %s", chosen)
        if chosen in seen_before:
            break
        seen_before.append(chosen)
    apart = search.state.apart
    return apart, [search.finding(search.seen(search.state), one) for one in apart], []


class _Search:
    def __init__(
        self, state: State, hypotheses: Sequence[Hypothesis], judgement: Judgement
    ) -> None:
        self.state, self.hypotheses, self.judgement = state, list(hypotheses), judgement
        self.latest: Seen | None = None
        self.tries = TRIES if state.data.orbits.size <= ANEW else 1
        count = [name for name, _ in hypotheses]
        places = {name: count.count(name) for name in dict.fromkeys(count)}
        self.problem = Response(  # for the priors alone
            base=state.at, used=np.isfinite(state.data.orbits), places=places,
            rare=rare(state.data.ring, list(places)), judgement=judgement,
        )  # fmt: skip

    def seen(self, state: State) -> Seen:
        """All suspects, linearised at the state."""
        if self.latest is None or self.latest.state is not state:
            self.latest = Seen(state, self.hypotheses, self.problem)
        return self.latest

    def discrepancy_message(self, most: float = LACKS) -> str | None:
        """The message that the residual far exceeds the noise, and no single cause explains most of
        it: model discrepancy could be detected as a fault. None otherwise.

        Args:
            most: largest chi-square per reading of a plane for a search in any case.
        """
        planes = fit_chi2(self.state)[:2]
        worst = max((0, 1), key=lambda plane: planes[plane].ratio)
        own = planes[worst]
        if own.ratio**2 <= most:
            return None
        # by the noise alone: a large residual of a column reduces its weight
        left = [self.left_beside(*leader)[worst] for leader in self.leaders()]
        if min(left, default=np.inf) <= (own.chi2 + own.freedom) / 2:
            return None
        return (
            "single faults among the distributed errors were not sought: chi-square per reading is "
            f"{own.ratio**2:.2g} {('in plane', 'across')[worst]} given all of them, and no single "
            "cause explains half of the excess: run with --missing"
        )

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

    def next(self) -> State | None:
        """The state with the most probable further cause, if it is detected; else None."""
        begun = [_with_cause(self.state, cause, informed) for cause, _, informed in self.leaders()]
        clear = [
            state for state in begun  # by the linear model
            if self.clear(Seen(state, [state.apart[-1].cause], self.problem), state.apart[-1])
        ]  # fmt: skip
        if not clear:
            return None
        # the distributed errors have outliers already, so the evidence need not grow with a fault;
        # a second optimum, where all readings are far less probable, is none
        sizes = self.state.independent
        least = evidence_of(self.state, self.state.good, sizes) - self.judgement.log_odds
        tried: list[tuple[float, State]] = []
        for state in filter(None, map(_settled, clear)):
            found = evidence_of(state, state.good, sizes)
            if found > least:
                tried.append((found + self.problem.prior(state.apart[-1].cause), state))
        for _, state in sorted(tried, key=lambda one: -one[0]):
            state = self.better(state, state.apart[-1])  # noqa: PLW2901
            if self.clear(self.seen(state), state.apart[-1]):
                return self.revised(state)
        return None

    def leaders(self) -> list[tuple[Hypothesis, float, Array]]:
        """Candidates: the most probable by the linear model, one of each action, with amount and
        information of each block."""
        seen = self.seen(self.state)
        if not seen.suspects:
            return []
        own = seen.beside()
        worth = [HIDDEN if one.block is None else WORTH for one in seen.suspects]
        evidence = np.where(own.statistic < worth, -np.inf, own.evidence)
        first = int(np.argmax(evidence))
        least = evidence[first] - self.judgement.window
        least -= self.judgement.drift * own.statistic[first]
        order = [int(h) for h in np.argsort(-evidence) if evidence[h] > max(least, -np.inf)]
        found: dict[str, tuple[Hypothesis, float, Array]] = {}
        have = [one.cause for one in self.state.apart]
        for h in order:
            cause, amount = seen.causes[h], float(own.amount[h])
            same = recommended_action(self.state.data.ring, Cause(*cause, amount))
            if cause not in have and len(found) < self.tries:
                found.setdefault(same, (cause, amount, own.information[:, h]))
        return list(found.values())

    def better(self, state: State, one: Candidate) -> State:
        """The state with an alternative instead of a cause, if that explains more."""
        seen = self.seen(state)
        own = seen.beside(one)
        have = [other.cause for other in state.apart if other is not one]
        evidence = np.where([cause in have for cause in seen.causes], -np.inf, own.evidence)
        best = int(np.argmax(evidence))
        if not evidence[best] > evidence[seen.place(one)] + self.judgement.behind:
            return state
        other = _settled(
            _with_cause(_without(state, one), seen.causes[best], own.information[:, best])
        )
        if other is None:
            return state
        prior = self.problem.prior
        before, after = (evidence_of(one, state.good, state.independent) for one in (state, other))
        gained = after - before
        gained += prior(other.apart[-1].cause) - prior(one.cause)
        return other if gained > 0 else state

    def revised(self, state: State) -> State:
        """The state with each cause compared with its alternatives, less redundant causes."""
        for one in state.apart[:-1]:
            state = self.better(state, one)
        while len(state.apart) > 1:
            seen = self.seen(state)
            worth = [seen.shown(one)[0] for one in state.apart]
            if min(worth) > MIN_CHI2:
                break
            least = state.apart[int(np.argmin(worth))]
            fewer = _settled(_without(state, least))
            if fewer is None:
                break
            state = self.better(fewer, fewer.apart[-1])
        return state

    def p_value(self, state: State, statistic: float, one: Candidate) -> float:
        """Probability that the largest of so many errors reaches this statistic by chance; its
        scale is that of the amounts of the family, or of the orbit patterns."""
        members = len(one.members)
        if one.variable in OTHERS:
            members = min((len(state.values[f.variable]) for f in state.of_block(one.block or 0)
                           if isinstance(f, OrbitFamily)), default=MEMBERS)  # fmt: skip
        own = 2 * float(stdtr(max(members - 1, 1), -np.sqrt(max(statistic, 0.0))))
        return min(1.0, own * len(self.hypotheses))

    def clear(self, seen: Seen, one: Candidate) -> bool:
        """Whether the cause is detected."""
        statistic, cause, _ = seen.shown(one)
        chance = self.p_value(seen.state, statistic, one)
        plausible = abs(cause.amount) < BEYOND * one.wide
        return plausible and statistic > MIN_CHI2 and chance < self.judgement.false_alarm

    def finding(self, seen: Seen, one: Candidate) -> Finding:
        """The fault with its amount, error and alternatives."""
        own = seen.beside(one)
        statistic, cause, sigma = seen.shown(one)
        cause, sigma = as_turned(cause, sigma, seen.state.at.errors, seen.state.data)
        known = {one.cause, (cause.effect, cause.element)}
        rivals = [int(h) for h in np.argsort(-own.evidence)[: self.judgement.alternatives]
                  if np.isfinite(own.evidence[h]) and seen.causes[h] not in known]  # fmt: skip
        chance = np.exp(own.evidence[[seen.place(one), *rivals]] - own.evidence.max())
        causes = (Cause(*seen.causes[h], float(own.amount[h])) for h in rivals)
        detection = Detection(statistic, MIN_CHI2, self.p_value(seen.state, statistic, one))
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


def _with_cause(state: State, cause: Hypothesis, information: Array) -> State:
    """The state with one more cause, not converged; `information` of each block on its amount."""
    return _apart(_as_number(state, cause, information)[0], cause)


def _apart(state: State, cause: Hypothesis) -> State:
    """The state with a separate prior for a number of the fit, and scales to be learnt anew."""
    return replace(state, apart=(*state.apart, *suspects_of(state, [cause])), groups={})


def _without(state: State, one: Candidate) -> State:
    """The state without a cause, not converged: the next step takes its number back, and scales are
    learnt anew, because one that vanished would not grow again."""
    left = tuple(other for other in state.apart if other is not one)
    return replace(state, apart=left, groups={})


def _settled(state: State) -> State | None:
    """The state after convergence from the linear estimate or from the present one. None where no
    beam is stored, or where an amount is implausible."""
    for first in (_stepped, replace):
        try:
            rough = settle(first(state), gain=ROUGH)
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


def given_faults(fit: HierarchicalFit, apart: Sequence[Candidate]) -> HierarchicalFit:
    """Return the hierarchical fit with the faults' numbers free of their families, as a further
    step; unchanged where held-out residuals grow."""
    state = fit.state
    for one in apart:
        if one.variable in OTHERS:
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
