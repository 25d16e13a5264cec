"""Which causes explain the data: one after another, each choice open to revision.

A step scans every hypothesis, stops where nothing is above the threshold, refits the leading
hypotheses through the nonlinear model, and takes the one with the largest evidence: an effect of
the catalogue, or something without a name at a place, or a monitor that is set aside. After each
step every earlier choice is held against its rivals again, with all the others in place.
"""

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from tmlattice.diagnosis.model import Hypothesis
from tmlattice.diagnosis.refine import Fit, Problem, fit, free_evidence
from tmlattice.diagnosis.scan import FreeScan, Scan, look_elsewhere, scan, scan_kicks, scan_monitors
from tmlattice.effects import Cause, find

Array = NDArray[np.float64]
log = logging.getLogger(__name__)

FALSE_ALARM = 0.005
"""Share of data sets of pure noise in which anything is found."""

SHARES = {"named": 0.6, "kick": 0.2, "monitor": 0.1, "reading": 0.1}
"""How the kinds of findings share the false alarms."""

RIVALS = 24
"""Hypotheses that are refitted through the nonlinear model at a step."""

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


@dataclass
class Explanation:
    """What was found.

    Attributes:
        fit: all named causes, free kicks and launches together.
        rivals: for each named cause the hypotheses that were held against it, itself included,
            by falling evidence.
        detections: of each named cause, each free kick (by layer) and each monitor set aside.
        monitors: those set aside, with the log evidence that it cost.
        spikes: readings left out, (shot, reading, plane).
        dropped: the same as flags, with the monitors', [shot, reading, 2].
        before: launches alone.
        scan: the last one, of what is left.
        full: whether the search ended because no more causes were allowed.
    """

    fit: Fit
    before: Fit
    rivals: list[list[Rival]]
    detections: list[Detection]
    kick_detections: dict[int, Detection]
    monitors: dict[int, tuple[float, Detection]]
    spikes: list[tuple[int, int, int]]
    dropped: NDArray[np.bool_]
    scan: Scan
    left: FreeScan
    full: bool


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
    ) -> None:
        self.problem = problem
        self.hypotheses = list(hypotheses)
        self.most = most
        self.rate = rate
        self.seed = seed
        self.remake = remake
        self.progress = progress
        self.effective: float | None = None
        self.dropped = np.zeros(problem.data.valid.shape, dtype=bool)
        self.monitors: dict[int, tuple[float, Detection]] = {}
        self.spikes: list[tuple[int, int, int]] = []
        self.layers = list(range(len(problem.model.maps.layers)))

    # --- one scan -------------------------------------------------------------------------------
    def scan(self, state: Fit) -> Scan:
        problem = self.problem
        result = scan(
            problem.model,
            state.paths,
            state.launches,
            self.hypotheses,
            problem.whitening,
            state.projection,
            state.residual,
            problem.data.active,
            effective=self.effective,
            seed=self.seed,
        )
        self.effective = result.effective
        return result

    def scan_kicks(self, state: Fit) -> FreeScan:
        problem = self.problem
        return scan_kicks(
            problem.model,
            state.paths,
            self.layers,
            problem.whitening,
            state.projection,
            state.residual,
            problem.data.active,
        )

    def scan_monitors(self, state: Fit) -> FreeScan:
        problem = self.problem
        return scan_monitors(
            len(problem.model.at),
            state.paths.readings.shape,
            problem.whitening,
            state.projection,
            state.residual,
            problem.data.active,
        )

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
            tried = fit(
                problem,
                (*others.causes, cause),
                others.launches,
                others.kicks,
                hopeless=best,
            )
            best = max(best, tried.log_evidence)
            chosen.append(Rival(hypothesis, tried))
        chosen.sort(key=lambda rival: -rival.fit.log_evidence)
        return chosen

    # --- the search -----------------------------------------------------------------------------
    def run(self, before: Fit) -> Explanation:
        state = before
        rivals: list[list[Rival]] = []
        detections: list[Detection] = []
        kicks: dict[int, Detection] = {}
        steps = 0
        while True:
            found = self.scan(state)
            kick_scan = self.scan_kicks(state)
            full = len(state.causes) + len(state.kicks) + len(self.monitors) >= self.most
            steps += 1
            if full or steps > 4 * self.most + 40:
                break
            options = self._options(state, found, kick_scan)
            if not options:
                break
            kind, gain, place, detection, list_of_rivals = max(options, key=lambda o: o[1])
            log.info("step %d: %s %s, evidence +%.1f", steps, kind, place, gain)
            self.progress(f"{kind} {place if isinstance(place, str) else ''}".strip())
            if kind == "reading":
                self.spikes.append(place)
                self.dropped[place] = True
                state = self._again(state)
            elif kind == "monitor":
                count = len(self.problem.model.at)
                self.monitors[place] = (gain, detection)
                self.dropped[:, place::count] = True
                state = self._again(state)
            elif kind == "kick":
                best = self._with_kick(state, kick_scan, place)
                state = best
                kicks[place] = detection
            else:
                assert list_of_rivals is not None
                state = list_of_rivals[0].fit
                rivals.append(list_of_rivals)
                detections.append(detection)
            if len(state.causes) + len(state.kicks) > 1:
                state, rivals, detections, kicks = self._revise(state, rivals, detections, kicks)
        return Explanation(
            state,
            before,
            rivals,
            detections,
            kicks,
            self.monitors,
            self.spikes,
            self.dropped,
            found,
            kick_scan,
            full,
        )

    def _options(self, state: Fit, found: Scan, kick_scan: FreeScan) -> list:  # type: ignore[type-arg]
        """What could be done next, each with the evidence that it gains."""
        problem = self.problem
        options = []
        best = int(found.statistic.argmax())
        detection = Detection(
            float(found.statistic[best]),
            found.threshold(self.rate * SHARES["named"]),
            found.p_value(float(found.statistic[best])),
        )
        if detection.p_value < self.rate * SHARES["named"]:
            rivals = self.rivals(state, found)
            rivals = [r for r in rivals if np.isfinite(r.fit.log_evidence)]
            if rivals and rivals[0].fit.chi2 < state.chi2:
                gain = rivals[0].fit.log_evidence - state.log_evidence
                options.append(("named", gain, rivals[0].hypothesis[0], detection, rivals))
        for kind, free, count in (
            ("kick", kick_scan, len(self.layers)),
            ("monitor", self.scan_monitors(state), len(problem.model.at)),
        ):
            place = int(free.gain.argmax())
            freedom = max(int(free.freedom[place]), 1)
            statistic = float(free.statistic[place])
            p_value = look_elsewhere(statistic, freedom, count)
            index = int(free.places[place])
            taken = index in state.kicks if kind == "kick" else index in self.monitors
            gain = float(free.gain[place]) + problem.unknown_prior(count)
            if p_value < self.rate * SHARES[kind] and not taken:
                options.append((kind, gain, index, Detection(statistic, np.nan, p_value), None))
        value, where, gain = self.spike(state)
        p_value = look_elsewhere(value, 1, float(problem.data.valid.sum()))
        if p_value < self.rate * SHARES["reading"]:
            options.append(("reading", gain, where, Detection(value, np.nan, p_value), None))
        return options

    def _again(self, state: Fit) -> Fit:
        """The same causes on the readings that are left."""
        self.problem = self.remake(self.dropped)
        return fit(self.problem, state.causes, state.launches, state.kicks)

    def _with_kick(self, state: Fit, kick_scan: FreeScan, layer: int) -> Fit:
        place = int(np.flatnonzero(kick_scan.places == layer)[0])
        shots = np.flatnonzero(self.problem.data.active)
        kick = np.zeros((self.problem.data.shots, 2))
        kick[shots] = kick_scan.amounts[place].reshape(-1, 2)
        return fit(self.problem, state.causes, state.launches, {**state.kicks, layer: kick})

    def _revise(self, state, rivals, detections, kicks):  # type: ignore[no-untyped-def]
        """Hold every choice against its rivals, all the others in place, until none changes."""
        for _ in range(3):
            changed = False
            for layer in list(state.kicks):
                others = {k: v for k, v in state.kicks.items() if k != layer}
                without = fit(self.problem, state.causes, state.launches, others)
                found = self.scan(without)
                options = self.rivals(without, found, 8)
                if without.log_evidence > state.log_evidence:
                    state = without
                    kicks = {k: v for k, v in kicks.items() if k != layer}
                    changed = True
                elif options and options[0].fit.log_evidence > state.log_evidence:
                    state = options[0].fit
                    rivals = [*rivals, options]
                    detections = [*detections, kicks[layer]]
                    kicks = {k: v for k, v in kicks.items() if k != layer}
                    changed = True
            for k in range(len(state.causes)):
                own = state.causes[k]
                rest = (*state.causes[:k], *state.causes[k + 1 :])
                without = fit(self.problem, rest, state.launches, state.kicks)
                if without.log_evidence > state.log_evidence:  # the others explain it
                    state = without
                    rivals = [*rivals[:k], *rivals[k + 1 :]]
                    detections = [*detections[:k], *detections[k + 1 :]]
                    changed = True
                    break
                options = self.rivals(without, self.scan(without), 12)
                if not options:
                    continue
                best = options[0]
                state_was = state.log_evidence
                if best.fit.log_evidence > state_was + 1e-3 or best.hypothesis == (
                    own.effect,
                    own.element,
                ):
                    state = best.fit
                    rivals = [*rivals[:k], *rivals[k + 1 :], options]
                    detections = [*detections[:k], *detections[k + 1 :], detections[k]]
                    if best.hypothesis != (own.effect, own.element):
                        changed = True
                    break_needed = k + 1 < len(state.causes)
                    if break_needed:
                        continue
            if not changed:
                break
        return state, rivals, detections, kicks


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
    """
    return _Search(problem, hypotheses, most, rate, seed, remake, progress).run(before)


replace, free_evidence  # noqa: B018
