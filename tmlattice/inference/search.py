"""Which causes explain the data: one after another, each choice open to revision.

A step scans every hypothesis, stops where nothing is above the threshold, refits the leading
hypotheses through the nonlinear model, and takes the one with the largest evidence: an effect of
the catalogue, or something without a name at a place, or a monitor that is set aside. After each
step every earlier choice is held against its rivals again, with all the others in place.
"""

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from tmlattice.beam.model import Hypothesis
from tmlattice.effects import Cause, find
from tmlattice.inference.metric import Metric, metric
from tmlattice.inference.newton import Fit, Problem, fit
from tmlattice.inference.scan import (
    FreeScan,
    Scan,
    free_threshold,
    look_elsewhere,
    scan,
    scan_kicks,
    scan_monitors,
)

Array = NDArray[np.float64]
log = logging.getLogger(__name__)

FALSE_ALARM = 0.005
"""Share of data sets of pure noise in which anything is found."""

SHARES = {"named": 0.6, "kick": 0.2, "monitor": 0.1, "reading": 0.1}
"""How the kinds of findings share the false alarms."""

RIVALS = 24
"""Hypotheses that are refitted through the nonlinear model at a step."""

NEARLY = 0.5
"""A free kick has a parameter a shot, and so takes up some of what another cause does: where one
with a name explains this share of it, the search is made once more with names first."""

STARTS = (-1.0, -0.5, -0.2, 0.2, 0.5, 1.0)
"""Shares of its largest fault from which a curved effect is refitted."""

SPIKES = 40
"""Single readings left out at most."""

SPIKE = -16.0
"""Log probability of one reading being wrong for once."""


@dataclass(frozen=True)
class Rival:
    """A hypothesis that was refitted with everything else in place."""

    hypothesis: Hypothesis
    fit: Fit = field(repr=False)

    @property
    def cause(self) -> Cause:
        """With its best amount: the last of the fit's causes."""
        return self.fit.causes[-1]


@dataclass(frozen=True)
class Detection:
    """How clearly something was seen when it was found: see the scan."""

    statistic: float
    threshold: float
    p_value: float


@dataclass(frozen=True)
class Named:
    """A cause with a name: how it was seen, and what was held against it, itself the first."""

    detection: Detection
    rivals: list[Rival]


@dataclass(frozen=True)
class Explanation:
    """What was found.

    Attributes:
        fit: all named causes, free kicks and launches together.
        before: launches alone.
        named: of each cause of the fit, in their order.
        kicks: how each free kick was seen, by layer.
        monitors: those set aside because no named cause explains them.
        spikes: readings left out, (shot, reading, plane).
        dropped: all readings left out, [shot, reading, 2].
        first, first_kicks: the scans of the launches alone, which saw the first finding.
        scan, left: the last ones, of what is left.
        full: whether the search ended because no more findings were allowed.
        problem: as the last fit was of it, without what was left out.
    """

    fit: Fit
    before: Fit
    named: list[Named]
    kicks: dict[int, Detection]
    monitors: dict[int, Detection]
    spikes: list[tuple[int, int, int]]
    dropped: NDArray[np.bool_]
    first: Scan
    first_kicks: FreeScan
    scan: Scan
    left: FreeScan
    full: bool
    problem: Problem

    @property
    def count(self) -> int:
        """Findings: causes with a name, free kicks, and monitors set aside."""
        return len(self.named) + len(self.kicks) + len(self.monitors)


class _Search:
    def __init__(
        self,
        problem: Problem,
        hypotheses: Sequence[Hypothesis],
        most: int,
        rate: float,
        seed: int,
        remake: Callable[[NDArray[np.bool_]], Problem],
        progress: Callable[[str], None],
        names_first: bool = False,
    ) -> None:
        self.problem = problem
        self.hypotheses = list(hypotheses)
        self.most = most
        self.rate = rate
        self.seed = seed
        self.remake = remake
        self.progress = progress
        self.names_first = names_first
        self.passed_over = False
        self.effective: float | None = None
        self.dropped = np.zeros(problem.data.valid.shape, dtype=bool)
        self.monitors: dict[int, Detection] = {}
        self.spikes: list[tuple[int, int, int]] = []
        self.layers = list(range(len(problem.model.maps.layers)))

    # --- one scan -------------------------------------------------------------------------------
    def metric(self, state: Fit) -> Metric:
        problem = self.problem
        return metric(
            problem.model, state.paths, problem.whitening, state.projection, problem.data.active
        )

    def scan(self, state: Fit, about: Metric | None = None) -> Scan:
        result = scan(
            about or self.metric(state),
            state.launches,
            self.hypotheses,
            state.residual,
            effective=self.effective,
            seed=self.seed,
        )
        self.effective = result.effective
        return result

    def spike(self, state: Fit) -> tuple[float, tuple[int, int, int], float]:
        """The reading that is least explained: statistic, place, evidence gained by dropping it."""
        problem = self.problem
        clean = state.projection.out(state.residual).reshape(problem.data.shots, -1)[:, :-5]
        size = np.ones_like(clean)
        if not problem.whitening.dense:
            Q = state.projection.Q[:, :-5]
            size = 1 - np.einsum("bri,bri->br", Q, Q)
        statistic = np.where(size > 1e-3, clean**2 / np.maximum(size, 1e-3), 0.0)
        worst = int(statistic.argmax())
        value = float(statistic.ravel()[worst])
        shot, rest = divmod(worst, statistic.shape[1])
        # an amount even over its logarithm, as for every other cause
        gain = 0.5 * value - 0.5 * np.log(max(value, 1.0)) - np.log(4.0) + SPIKE
        return value, (shot, rest // 2, rest % 2), float(gain)

    # --- rivals ---------------------------------------------------------------------------------
    def rivals(self, others: Fit, found: Scan, count: int = RIVALS) -> list[Rival]:
        """The leading hypotheses added to what is there, refitted, by falling evidence."""
        problem = self.problem
        with np.errstate(divide="ignore"):
            occam = -0.5 * np.log(np.maximum(found.statistic, 1.0))
        prior = np.array([problem.prior(h) for h in found.hypotheses])
        size = np.abs(found.amount)
        power = np.array([find(h[0]).power for h in found.hypotheses])
        largest = np.array([find(h[0]).largest for h in found.hypotheses]) ** power
        beyond = np.where(size > largest, 8 * np.log(np.maximum(size / largest, 1e-300)), 0.0)
        linear = 0.5 * found.statistic + occam + prior - np.minimum(beyond, 1e6)
        linear[found.statistic <= 0] = -np.inf
        have = {(c.effect, c.element) for c in others.causes}
        order = np.argsort(-linear)
        best = -np.inf
        # the linear scan errs by a share of the statistic itself where an effect is strong
        window = 12 + 0.03 * float(found.statistic.max())
        top = float(linear[order[0]])
        chosen: list[Rival] = []
        for index in order[:count]:
            if not np.isfinite(linear[index]) or linear[index] < top - window:
                break
            hypothesis = found.hypotheses[index]
            if hypothesis in have:
                continue
            amount = float(found.amount[index])
            effect = find(hypothesis[0])
            if effect.discrete:
                amount = 1.0
            elif effect.power == 2:
                amount = float(np.sqrt(max(amount, 0.0)))
                if amount == 0:
                    continue
            limit = 1.5 * effect.largest
            cause = Cause(hypothesis[0], hypothesis[1], float(np.clip(amount, -limit, limit)))
            tried = self._tried(others, cause, best)
            best = max(best, tried.log_evidence)
            chosen.append(Rival(hypothesis, tried))
        if chosen:
            leader = max(chosen, key=lambda rival: rival.fit.log_evidence).hypothesis
            tried_already = {rival.hypothesis for rival in chosen} | have
            for hypothesis in self._curved_near(leader):
                if hypothesis not in tried_already:
                    start = self._best_start(others, hypothesis)
                    chosen.append(Rival(hypothesis, self._tried(others, start, best)))
        chosen.sort(key=lambda rival: -rival.fit.log_evidence)
        return chosen

    def _tried(self, others: Fit, cause: Cause, hopeless: float) -> Fit:
        """What is there, and one cause more."""
        return fit(
            self.problem,
            (*others.causes, cause),
            others.launches,
            others.kicks,
            hopeless=hopeless,
            slopes=others.slopes,
        )

    def _curved_near(self, leader: Hypothesis) -> list[Hypothesis]:
        """Hypotheses of curved effects between the same monitors: a linear scan misjudges them."""
        ring = self.problem.model.ring
        if leader[1] is None or not any(e.name == leader[1] for e in ring.magnets):
            return []
        s = np.array([0.0, *(monitor.s for monitor in ring.monitors), ring.length])
        gap = int(np.searchsorted(s, ring[leader[1]].s))
        low, high = s[max(gap - 1, 0)], s[min(gap, len(s) - 1)]
        return [
            (name, place)
            for name, place in self.hypotheses
            if find(name).curved and place is not None and low <= ring[place].s <= high
        ]

    def _best_start(self, others: Fit, hypothesis: Hypothesis) -> Cause:
        """The amount, out of a few, that leaves least when the launches follow."""
        problem = self.problem
        largest = find(hypothesis[0]).largest
        causes = [Cause(*hypothesis, share * largest) for share in STARTS]
        left = []
        for cause in causes:
            fixed = (*problem.fixed, *others.causes, cause)
            readings = problem.model.readings(others.launches, fixed, others.kicks)
            difference = np.where(problem.data.valid, problem.data.readings - readings, 0.0)
            rows = problem.whitening.residual(difference, others.launches)
            clean = others.projection.out(np.nan_to_num(rows, nan=1e3))
            left.append(float(clean @ clean))
        return causes[int(np.argmin(left))]

    # --- the search -----------------------------------------------------------------------------
    def run(self, before: Fit) -> Explanation:
        state = _State(before, [], {})
        seen: set[frozenset[object]] = set()
        steps = 0
        first: tuple[Scan, FreeScan] | None = None
        while True:
            about = self.metric(state.fit)
            found = self.scan(state.fit, about)
            kicks = scan_kicks(about, self.layers, state.fit.residual)
            first = first or (found, kicks)
            full = len(state.fit.causes) + len(state.fit.kicks) + len(self.monitors) >= self.most
            over = full or len(self.spikes) > SPIKES
            options = [] if over else self._options(state.fit, about, found, kicks)
            # the rate of false alarms says whether anything is there; evidence says what more
            options = [o for o in options if o.gain > 0 or (steps == 0 and o.kind == "named")]
            seen.add(_names(state.fit))
            if not options:
                break
            steps += 1
            best = self._choice(options)
            log.info("step %d: %s, log evidence +%.1f", steps, best.name, best.gain)
            self.progress(best.name)
            state = self._take(state, best, kicks)
            if len(state.fit.causes) + len(state.fit.kicks) > 1:
                state = self._revised(state)
            if best.kind in ("named", "kick") and _names(state.fit) in seen:
                break  # what was added went again
        return Explanation(
            fit=state.fit,
            before=before,
            named=state.named,
            kicks=state.kicks,
            monitors=self.monitors,
            spikes=self.spikes,
            dropped=self.dropped,
            first=first[0],
            first_kicks=first[1],
            scan=found,
            left=kicks,
            full=full,
            problem=self.problem,
        )

    def _choice(self, options: Sequence["_Option"]) -> "_Option":
        """The one that explains most; or the cause with a name, where names come first."""
        best = max(options, key=lambda option: option.gain)
        named = [option for option in options if option.kind == "named"]
        if named and best.kind == "kick":
            if self.names_first:
                return named[0]
            self.passed_over |= named[0].gain > NEARLY * best.gain
        return best

    def _options(self, state: Fit, about: Metric, found: Scan, kicks: FreeScan) -> list["_Option"]:
        """What could be done next."""
        problem = self.problem
        options = []
        statistic = float(found.statistic.max(initial=0.0))  # none may have a name
        rate = self.rate * SHARES["named"]
        detection = Detection(statistic, found.threshold(rate), found.p_value(statistic))
        if detection.p_value < rate:
            rivals = self.rivals(state, found)
            if rivals and rivals[0].fit.chi2 < state.chi2:
                gain = rivals[0].fit.log_evidence - state.log_evidence
                name = " ".join(str(word) for word in rivals[0].hypothesis if word)
                options.append(_Option("named", name, gain, detection, rivals=rivals))
        layers, monitors = problem.model.maps.layers, problem.model.maps.monitors
        for kind, free, names, taken in (
            ("kick", kicks, layers, state.kicks),
            ("monitor", scan_monitors(about, state.residual), monitors, self.monitors),
        ):
            place = int(free.gain.argmax())
            where = int(free.places[place])
            freedom = max(int(free.freedom[place]), 1)
            seen = Detection(
                float(free.statistic[place]),
                free_threshold(self.rate * SHARES[kind], freedom, len(names)),
                look_elsewhere(float(free.statistic[place]), freedom, len(names)),
            )
            gain = float(free.gain[place]) + problem.unknown_prior(len(names))
            if seen.p_value < self.rate * SHARES[kind] and where not in taken:
                options.append(_Option(kind, f"{kind} at {names[where]}", gain, seen, where=where))
        value, reading, gain = self.spike(state)
        count = float(problem.data.valid.sum())
        rate = self.rate * SHARES["reading"]
        seen = Detection(value, free_threshold(rate, 1, count), look_elsewhere(value, 1, count))
        if seen.p_value < rate:
            options.append(_Option("reading", f"reading {reading}", gain, seen, reading=reading))
        return options

    def _take(self, state: "_State", option: "_Option", kicks: FreeScan) -> "_State":
        if option.kind == "reading":
            self.spikes.append(option.reading)
            self.dropped[option.reading] = True
            return state.with_fit(self._again(state.fit))
        if option.kind == "monitor":
            self.monitors[option.where] = option.detection
            self.dropped[:, option.where :: len(self.problem.model.at)] = True
            return state.with_fit(self._again(state.fit))
        if option.kind == "kick":
            seen = {**state.kicks, option.where: option.detection}
            return _State(self._with_kick(state.fit, kicks, option.where), state.named, seen)
        named = [*state.named, Named(option.detection, option.rivals)]
        return _State(option.rivals[0].fit, named, state.kicks)

    def _again(self, state: Fit) -> Fit:
        """The same causes on the readings that are left."""
        self.problem = self.remake(self.dropped)
        return fit(self.problem, state.causes, state.launches, state.kicks)

    def _with_kick(self, state: Fit, found: FreeScan, layer: int) -> Fit:
        place = int(np.flatnonzero(found.places == layer)[0])
        shots = np.flatnonzero(self.problem.data.active)
        kick = np.zeros((self.problem.data.shots, 2))
        kick[shots] = found.amounts[place].reshape(-1, 2)
        return fit(self.problem, state.causes, state.launches, {**state.kicks, layer: kick})

    def _revised(self, state: "_State") -> "_State":
        """Every choice held against its rivals, all the others in place, until none changes."""
        for _ in range(3):
            names = _names(state.fit)
            for monitor in list(self.monitors):
                state = self._with_monitor(state, monitor)
            for layer in list(state.fit.kicks):
                state = self._without_kick(state, layer)
            for cause in state.fit.causes:
                state = self._rechosen(state, (cause.effect, cause.element))
            if names == _names(state.fit):
                break
        return state

    def _with_monitor(self, state: "_State", monitor: int) -> "_State":
        """A monitor that was set aside comes back where a named cause, or none, does as well."""
        own = slice(monitor, None, len(self.problem.model.at))
        aside, taken = self.dropped.copy(), self.problem
        self.dropped[:, own] = False
        back = self._again(state.fit)
        about = self.metric(back)
        free = scan_monitors(about, back.residual)
        count = len(free.gain)
        alone = float(free.gain[monitor]) + self.problem.unknown_prior(count)
        if alone <= 0:
            self._return(monitor)
            return state.with_fit(back)
        rivals = self.rivals(back, self.scan(back, about), 8)
        if rivals and rivals[0].fit.log_evidence - back.log_evidence > alone:
            named = [*state.named, Named(self._return(monitor), rivals)]
            return _State(rivals[0].fit, named, state.kicks)
        self.dropped, self.problem = aside, taken
        return state

    def _return(self, monitor: int) -> Detection:
        """Set aside no more, nor are single readings of it."""
        count = len(self.problem.model.at)
        self.spikes = [spike for spike in self.spikes if spike[1] % count != monitor]
        return self.monitors.pop(monitor)

    def _without_kick(self, state: "_State", layer: int) -> "_State":
        """A free kick gives way to a named cause, or to none, where that explains more."""
        others = {k: v for k, v in state.fit.kicks.items() if k != layer}
        seen = {k: v for k, v in state.kicks.items() if k != layer}
        without = fit(
            self.problem, state.fit.causes, state.fit.launches, others, slopes=state.fit.slopes
        )
        if without.log_evidence > state.fit.log_evidence:
            return _State(without, state.named, seen)
        rivals = self.rivals(without, self.scan(without), 8)
        if rivals and rivals[0].fit.log_evidence > state.fit.log_evidence:
            named = [*state.named, Named(state.kicks[layer], rivals)]
            return _State(rivals[0].fit, named, seen)
        return state

    def _rechosen(self, state: "_State", hypothesis: Hypothesis) -> "_State":
        """A named cause gives way to a better one, or to none; its rivals are weighed anew."""
        own = [i for i, c in enumerate(state.fit.causes) if (c.effect, c.element) == hypothesis]
        if not own:
            return state
        k = own[0]
        rest = (*state.fit.causes[:k], *state.fit.causes[k + 1 :])
        named = [*state.named[:k], *state.named[k + 1 :]]
        without = fit(
            self.problem, rest, state.fit.launches, state.fit.kicks, slopes=state.fit.slopes
        )
        if without.log_evidence > state.fit.log_evidence:
            return _State(without, named, state.kicks)
        rivals = self.rivals(without, self.scan(without), 12)
        if hypothesis not in [rival.hypothesis for rival in rivals]:
            kept = fit(
                self.problem,
                (*rest, state.fit.causes[k]),
                state.fit.launches,
                state.fit.kicks,
                slopes=state.fit.slopes,
            )
            rivals = sorted(
                [*rivals, Rival(hypothesis, kept)], key=lambda rival: -rival.fit.log_evidence
            )
        named.append(Named(state.named[k].detection, rivals))
        return _State(rivals[0].fit, named, state.kicks)


def _names(fit_: Fit) -> frozenset[object]:
    return frozenset([*((c.effect, c.element) for c in fit_.causes), *fit_.kicks])


@dataclass(frozen=True)
class _Option:
    kind: str
    name: str
    gain: float
    detection: Detection
    where: int = -1
    reading: tuple[int, int, int] = (-1, -1, -1)
    rivals: list[Rival] = field(default_factory=list)


@dataclass(frozen=True)
class _State:
    """A fit, and how its causes and kicks were found: `named` in the order of the fit's causes."""

    fit: Fit
    named: list[Named]
    kicks: dict[int, Detection]

    def with_fit(self, fit_: Fit) -> "_State":
        return _State(fit_, self.named, self.kicks)


def explain(
    problem: Problem,
    hypotheses: Sequence[Hypothesis],
    before: Fit,
    remake: Callable[[NDArray[np.bool_]], Problem],
    *,
    most: int = 8,
    rate: float = FALSE_ALARM,
    seed: int = 0,
    progress: Callable[[str], None] = lambda _: None,
    names_first: bool = False,
) -> Explanation:
    """Search for the causes of what the launches leave unexplained.

    Args:
        problem: model and data.
        hypotheses: what may be the cause.
        before: the launches alone.
        remake: the problem without some readings.
        most: findings at most.
        rate: of false alarms on a data set of pure noise, all kinds together.
        seed: of the threshold's simulation.
        progress: told what was found.
        names_first: what has a name goes before a free kick. Else that is tried where a free kick
            took what a name nearly explains, and the evidence decides.
    """
    arguments = (rate, seed, remake, progress)
    search = _Search(problem, hypotheses, most, *arguments, names_first=names_first)
    found = search.run(before)
    if not (search.passed_over and found.kicks):
        return found
    few = min(most, found.count + 1)
    again = _Search(problem, hypotheses, few, *arguments, names_first=True)
    other = again.run(before)
    return other if _weighed(other, found, remake) > _weighed(found, other, remake) else found


def _weighed(
    one: Explanation, other: Explanation, remake: Callable[[NDArray[np.bool_]], Problem]
) -> float:
    """Log evidence of an explanation on the readings that both keep."""
    problem = remake(one.dropped | other.dropped)
    refitted = fit(problem, one.fit.causes, one.fit.launches, one.fit.kicks)
    aside = problem.unknown_prior(len(problem.model.at)) * len(one.monitors)
    return refitted.log_evidence + aside + SPIKE * len(one.spikes)
