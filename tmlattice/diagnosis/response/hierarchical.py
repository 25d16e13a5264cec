"""The hierarchical fit of an orbit response: families of errors, validated on held-out readings.

>>> fit = fit_families(data, split)
>>> [(step.effect, step.heldout_rms_in_plane) for step in fit.steps]

Families are added, all are fitted together, and each is tested by the loss without it, with the fit
linearised.
"""

import logging
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from tmlattice.arrays import Array, Flags
from tmlattice.diagnosis.assessment import Block, combined_p_value
from tmlattice.diagnosis.families.steps import STEPS, Trial
from tmlattice.diagnosis.response.first_guess import begun, strange
from tmlattice.diagnosis.response.jitter import Jitter, sought
from tmlattice.diagnosis.response.labels import (
    Label,
    label_messages,
    outlier_steps,
    rejected,
    without_readings,
)
from tmlattice.diagnosis.response.linear import Linear, linear
from tmlattice.diagnosis.response.outlier_readings import gross, told_gross
from tmlattice.diagnosis.response.rounds import (
    GAIN,
    REQUIRED,
    bounded_step,
    evidence_of,
    linear_evidence,
    one_step,
    settle,
)
from tmlattice.diagnosis.response.state import (
    State,
    allow,
    begin,
    bend,
    forbid,
    jump,
)
from tmlattice.diagnosis.response.validation import Step, remainder, score
from tmlattice.diagnosis.response.weights import COUPLING, good_monitors, without_jitter
from tmlattice.effects import with_labels
from tmlattice.errors import UnstableRingError
from tmlattice.inference.judgement import GROSS
from tmlattice.observe.response_data import ResponseData, Split

log = logging.getLogger(__name__)

ASTRAY, NEAR = 1.2, 1e-3
"""Largest unexplained share of the typical column's mean square: as a ratio to the design's, or
itself if that is more. Above it the fit has diverged."""
FIRST, ROUGH = 4, 0.03
"""Largest number of steps of each block after families are added or removed, and the relative fall
of the cost by which a step is progress."""
OPTICS = 3
"""Number of first trials that are added one by one: of all, calibrations, gains, gradients."""
DIVERGED = 2.0
"""Ratio of the held-out rms to the design's above which one step has diverged."""


def fit_chi2(state: State) -> tuple[Block, ...]:
    """Return the fitted readings by their noise, given beam jitter: in-plane, coupling, RF."""
    data, fitted = state.data, ~state.split.held[:-1]
    left = [without_jitter(state, block, data.pick(state.at.left, block))[0] for block in (0, 1)]
    pulls = [own / data.noise_of(block) for block, own in enumerate(left)]
    own = [pull[:-1][fitted][:, state.good] for pull in pulls]
    own.append(pulls[0][-1][state.split.half[-1] & state.good])
    return tuple(
        Block(name, float(np.nansum(pull**2)), int(np.isfinite(pull).sum()))
        for name, pull in zip(("in-plane", "coupling", "RF"), own, strict=True)
    )


# --- the steps ------------------------------------------------------------------------------------
@dataclass(frozen=True, eq=False)
class HierarchicalFit:
    """A hierarchical fit: its scores and its state.

    Attributes:
        design, state: before and after.
        steps: the design's scores, and the result's; then those given faults.
        decisions: on each trial, with its log evidence; scores: see `reversed_decisions`.
        messages: about rejected readings, implausible families, beam jitter, and single faults.
        labels: of rejected steps.
    """

    design: State
    state: State
    steps: tuple[Step, ...]
    decisions: Mapping[Trial, Step] = field(default_factory=dict)
    messages: tuple[str, ...] = ()
    labels: tuple[Label, ...] = ()

    @property
    def families(self) -> tuple[Step, ...]:
        """The decisions."""
        return tuple(self.decisions.values())

    @cached_property
    def blocks(self) -> tuple[Block, ...]:
        """The residual, compared with its expected covariance."""
        return remainder(self.state)

    @property
    def p_value(self) -> float:
        """Of the residual, over its blocks."""
        return combined_p_value(self.blocks)


def fit_families(
    data: ResponseData,
    split: Split,
    trials: Sequence[Trial] = STEPS,
    most: int = len(STEPS),
    progress: Callable[[str], Any] = lambda stage: None,
) -> HierarchicalFit:
    """Return the fit of all families that are needed, to all correctors except the held-out ones.

    Families need one another: BPM gains improve nothing without the gradients, for example. So all
    are fitted together, without outliers, and each is tested by the loss without it, linearised.

    Args:
        data, split: the data, and the validation split.
        trials: families.
        most: most accepted trials.
        progress: called with what is done.
    """
    design = begin(data, split)
    trials = readable(design, trials)
    late = [own for own in trials if any(family.late for family in own)]
    state = rough_fit(begun(design, trials), [own for own in trials if own not in late], progress)
    single, labels = _outliers(state)
    progress("all families without outliers")
    state = without_readings(state, single | rejected(state, labels))
    state, notes = _plausible(
        replace(state, independent=np.ones((2, 2))), trials,
        lambda start: taken_back(settle(bend(jump(start)), gain=ROUGH), ROUGH),
    )  # fmt: skip
    log.info("effective sample size per reading: %s", state.independent)
    more, later = _outliers(state)  # typical residuals are smaller now
    single, labels = single | more, [*labels, *later]
    odd = single | rejected(state, labels)
    design, state = (without_readings(own, odd) for own in (design, state))
    notes = [*told_gross(data, single, "the fit"), *label_messages(labels), *notes]
    before = score(design, "design")
    progress("beam jitter")
    state = allow(_with_jitter(state)[0], [family for own in late for family in own])
    state, doubts = _plausible(state, trials, settle)
    notes += doubts
    state, moving = _with_jitter(state)
    gone, evidence = _unneeded(state, trials, most, progress)
    progress("result")
    try:
        state, doubts = _plausible(_without(state, gone), trials, _result)
    except UnstableRingError:  # no beam is stored without them
        state, doubts = _plausible(state, trials, _result)
    notes += doubts
    kept = [own for own in trials if any(state.allows(family.name) for family in own)]
    then = replace(design, good=state.good)
    if not strange(state) <= max(ASTRAY * strange(then), NEAR):  # in one plane, often
        diverged = (
            "the fit diverged: the residual of its own readings is larger than the design's; the "
            "lattice may be too far from the ring, and no effect is reported"
        )
        return HierarchicalFit(
            design, design, (before,), decisions(data, trials, (), evidence),
            (*notes, diverged), tuple(labels),
        )  # fmt: skip
    notes += [] if moving is None else [moving.sentence]
    return HierarchicalFit(
        design, state, steps_of(before, state, kept), decisions(data, trials, kept, evidence),
        tuple(notes), tuple(labels),
    )  # fmt: skip


def _outliers(state: State) -> tuple[Flags, list[Label]]:
    """Single outlier readings, [column, monitor, 2], and the labels of outlier steps."""
    # if the lattice is far from the ring, a column may have started with a wrong calibration, and
    # with the third order of its kick
    state = bend(jump(state, beyond=1.0))
    single = gross(state.data, state.at.read)
    labels = outlier_steps(without_readings(state, single))
    return single & ~rejected(state, labels), labels


def _unneeded(
    state: State, trials: Collection[Trial], most: int, progress: Callable[[str], Any]
) -> tuple[list[Trial], dict[Trial, float]]:
    """The trials that the readings do not require, and the log evidence of each that was fitted.

    The least needed one is left out first, and the others are tested again, all linearised at the
    fit: separate fits agree only to a share of their cost. At most `most` are needed."""
    evidence: dict[Trial, float] = {}
    gone = [own for own in trials if not any(state.allows(family.name) for family in own)]
    for block in (0, 1):
        untested = [own for own in trials if own not in gone and own[0].block == block]
        if not untested:
            continue
        there, left = linear(state, block), set[str]()
        while untested:
            whole = linear_evidence(there, left)
            for own in untested:
                progress(with_labels(f"is {_title(own)} needed"))
                evidence[own] = whole - linear_evidence(there, left | _priors(own, state))
                log.info("%s: log evidence %+.1f", _title(own), evidence[own])
            # a trial that is needed given all others is needed without some of them
            untested = [own for own in untested if evidence[own] <= REQUIRED]
            if untested:
                least = min(untested, key=evidence.__getitem__)
                untested.remove(least)
                left |= _priors(least, state)
                gone.append(least)
    needed = sorted((own for own in evidence if own not in gone), key=evidence.__getitem__)
    return [*gone, *needed[: max(len(needed) - most, 0)]], evidence


def readable(state: State, trials: Iterable[Trial]) -> list[Trial]:
    """Return the trials with their families that have places in the ring, and readings."""
    own = [tuple(f for f in trial if state.reads(f.block) and f.size(state.data))
           for trial in trials]  # fmt: skip
    return [trial for trial in own if any(family.count(state.data) for family in trial)]


def steps_of(before: Step, state: State, trials: Sequence[Trial]) -> tuple[Step, ...]:
    """Return the scores before and with the fitted trials; those before alone without any."""
    if not trials:
        return (before,)
    count = sum(family.count(state.data) for trial in trials for family in trial)
    return before, score(state, _titles(trials), count)


def rough_fit(
    state: State, trials: Iterable[Trial], progress: Callable[[str], Any] = lambda stage: None
) -> State:
    """Return a rough fit of all families. Calibrations, gains and gradients are added one by one: a
    fit of all at once converges slowly from a design that is far from the ring (PETRA III). The
    others are added together."""
    trials = readable(state, trials)
    for some in filter(None, [*([own] for own in trials[:OPTICS]), trials[OPTICS:]]):
        progress(with_labels(_titles(some)))
        families = [family for trial in some for family in trial]
        state = settle(jump(allow(state, families)), FIRST, ROUGH)
    return state


def decisions(
    data: ResponseData,
    trials: Iterable[Trial],
    kept: Collection[Trial],
    evidence: Mapping[Trial, float],
) -> dict[Trial, Step]:
    """Return the decision on each trial, without scores."""
    return {
        own: Step(
            _title(own), sum(family.count(data) for family in own), kept=own in kept,
            log_evidence=evidence.get(own, np.nan),
        )
        for own in trials
    }  # fmt: skip


def reversed_decisions(
    fit: HierarchicalFit, progress: Callable[[str], Any] = lambda stage: None
) -> HierarchicalFit:
    """Return the fit with the scores that each decision would have if it were reversed, with the
    other families fitted again, linearised at the fit; none where that diverges."""
    rejected = [trial for trial, step in fit.decisions.items() if not step.kept]
    state = allow(fit.state, [family for trial in rejected for family in trial])
    there = {block: linear(state, block) for block in (0, 1) if state.of_block(block)}
    scored = {}
    for trial, step in fit.decisions.items():
        progress(step.reversed_decision)
        without = [own for own in rejected if own != trial] + [trial] * step.kept
        names = {name for own in without for name in _priors(own, state)}
        moved: dict[int, Array] = {}
        try:
            for block in there.keys() & _blocks(trial):
                own = _narrow(there[block], names)
                change = bounded_step(own, 1.0).values - own.start
                moved[block] = own.readings(state.data.plane_of(block), change)
        except np.linalg.LinAlgError:  # the others are not determined
            continue
        gone = {family.name for own in without for family in own}
        left = tuple(family for family in state.families if family.name not in gone)
        scores = score(replace(state, families=left), step.effect, moved=moved)
        if scores.heldout_rms_in_plane < DIVERGED * fit.steps[0].heldout_rms_in_plane:
            scored[trial] = replace(scores, parameters=step.parameters, kept=step.kept,
                                    log_evidence=step.log_evidence)  # fmt: skip
    return replace(fit, decisions={**fit.decisions, **scored})


def _plausible(
    state: State, trials: Iterable[Trial], fitted: Callable[[State], State]
) -> tuple[State, list[str]]:
    """The fitted state without implausible families, which would bias others, and messages about
    these. They are removed one by one, the last first: one may bias another."""
    doubts: list[str] = []
    while True:
        settled = fitted(state)
        doubted = [trial for trial in trials if _doubts(settled, trial)]
        if not doubted:
            return settled, doubts
        doubts += _doubts(settled, doubted[-1])
        state = forbid(state, doubted[-1])


def _result(state: State) -> State:
    """The last fit, in which outliers have less weight."""
    return taken_back(settle(replace(bend(state), robust=True)))


def taken_back(state: State, gain: float = GAIN) -> State:
    """Return the state, converged to `gain`, with the rejected neighbours that agree with the fit.

    Sound BPMs next to a magnet with a large error contradict all others, and without them the error
    cannot be found. A broken BPM has no rejected neighbours.
    """
    aside = ~state.good & good_monitors(state, bad=GROSS)
    together = aside & (np.roll(aside, 1) | np.roll(aside, -1))
    if not together.any():
        return state
    good = state.good | together
    trial = settle(replace(state, good=good), gain=gain, look_at_monitors=False)
    sound = good_monitors(trial) & good_monitors(trial, 1)
    back = together & sound
    log.info("rejected neighbours: %s, sound: %s", *map(np.flatnonzero, (together, back)))
    if not back.any() or (state.good & ~sound).any():
        return state
    before, after = (evidence_of(own, state.good, state.independent) for own in (state, trial))
    orbits = state.data.pick(state.data.orbits)[state.fitted]
    readings = int(np.isfinite(orbits[:, back]).sum())
    log.info("evidence of the other BPMs falls by %.1f", before - after)
    if before - after > readings / 2:  # each regained reading may cost a standard error
        return state
    return settle(replace(trial, good=state.good | back), gain=gain)


def _with_jitter(state: State) -> tuple[State, Jitter | None]:
    """The state with the beam jitter of its residual."""
    moving = sought(state)
    return replace(state, jitter=None if moving is None else moving.orbits), moving


def _title(trial: Trial) -> str:
    return ", ".join(family.title for family in trial)


def _titles(trials: Sequence[Trial]) -> str:
    return _title(trials[0]) if len(trials) == 1 else f"{len(trials)} families of errors"


def _blocks(trial: Trial) -> list[int]:
    """Blocks that are fitted: skew gradients move the tunes to second order."""
    return [1, 0] if any(own.name == COUPLING for own in trial) else [trial[0].block]


def _doubts(state: State, trial: Trial) -> list[str]:
    """Messages about implausible values of a trial's families."""
    own = [family for family in trial if state.allows(family.name)]
    doubts = (family.doubt(state.values[family.variable], state.data) for family in own)
    return [doubt for doubt in doubts if doubt is not None]


def _priors(trial: Trial, state: State) -> set[str]:
    return {group.name for family in trial for group in family.groups(state.data)}


def _narrow(there: Linear, names: Collection[str]) -> Linear:
    """The linearisation in which some priors are so narrow that their numbers are zero."""
    groups = tuple(
        replace(group, basis=0 * group.basis) if group.name in names else group
        for group in there.groups
    )
    return there._replace(groups=groups)


def _without(state: State, trials: Sequence[Trial]) -> State:
    """The state without the families of some trials, after one step of the others; these unchanged
    if no beam is stored there."""
    families = [f for own in trials for f in own if state.allows(f.name)]
    names = {name for own in trials for name in _priors(own, state)}
    moved = state
    for block in sorted({family.block for family in families}):
        try:
            other, _, after = one_step(moved, block, _narrow(linear(moved, block), names))
        except np.linalg.LinAlgError:  # the others are not determined
            continue
        moved = other if np.isfinite(after) else moved
    return forbid(moved, families)
