"""The dense fit of an orbit response: families of errors, step by step, judged on held-out data.

>>> fit = fit_steps(data, split)
>>> [(step.effect, step.heldout_rms_in_plane) for step in fit.steps]

Gradients and skew gradients are fitted together, because skew ones move the tunes.
"""

import logging
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tmlattice.diagnosis.families.steps import STEPS, Trial
from tmlattice.diagnosis.response.first_guess import begun, strange
from tmlattice.diagnosis.response.jitter import Jitter, sought
from tmlattice.diagnosis.response.linear import Linear, linear
from tmlattice.diagnosis.response.outlier_readings import robust
from tmlattice.diagnosis.response.outlier_steps import beside, outlier_steps
from tmlattice.diagnosis.response.rf_by_others import rf_by_others
from tmlattice.diagnosis.response.rounds import Evidence, evidence_of, linear_evidence, settle
from tmlattice.diagnosis.response.set_aside import taken_back
from tmlattice.diagnosis.response.state import (
    State,
    allow,
    begin,
    bend,
    forbid,
    jump,
)
from tmlattice.diagnosis.response.validation import (
    WORTH,
    Chi2,
    Score,
    against,
    in_favour,
    inner,
    lost,
    score,
)
from tmlattice.errors import TmlatticeError
from tmlattice.inference.normal import Posterior
from tmlattice.observe.response_data import ResponseData
from tmlattice.observe.split import Split

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

log = logging.getLogger(__name__)

LEAST = 5.0
"""Log evidence that a step has to have."""
SPOILT, ENOUGH = 0.05, 3
"""By how much the judges' figures may rise with all families together, and judges that it takes to
say so: one of them alone may be near the design by chance."""
ASTRAY, NEAR = 1.2, 1e-3
"""So many times what the design leaves of the typical column's square no result may leave; or this
share of it, if that is more."""
SURE = 100.0
"""Log evidence, linear about the fit, of which nobody doubts that it is above the least."""
FIRST, ROUGH = 4, 0.03
"""Rounds of each block after a family came in, or went, and what one has to gain for another."""


@dataclass(frozen=True)
class Step:
    """The gap with what has been allowed so far.

    Attributes:
        effect: what was tried; the first is "design".
        parameters: how many it has.
        heldout_rms_in_plane, heldout_rms_coupling: m, over held-out correctors.
        heldout_rms_position: in-plane, with a position jump of each held-out corrector, m.
        heldout_rms_roll: coupling, with the roll of each held-out corrector from the monitors that
            gave its kick, m; NaN before rolls are fitted.
        heldout_chi2_per_dof: in-plane, by the readings' noise.
        dispersion_rms: of the RF's orbit in x on the half of the monitors not fitted, m.
        kept: whether it helped those who choose; the figures of one that was not are its own.
    """

    effect: str
    parameters: int
    heldout_rms_in_plane: float
    heldout_rms_coupling: float
    heldout_chi2_per_dof: float
    dispersion_rms: float
    heldout_rms_position: float = float("nan")
    heldout_rms_roll: float = float("nan")
    kept: bool = True

    @classmethod
    def scored(cls, effect: str, parameters: int, s: Score) -> "Step":
        """With what the judges say."""
        return cls(
            effect, parameters, s.in_plane, s.coupling, s.chi2_per_dof, s.dispersion, s.position,
            s.roll,
        )  # fmt: skip

    def as_json(self) -> dict[str, Any]:
        """As it stands in the diagnosis."""
        return {name: value for name, value in vars(self).items() if name != "kept"}


def fit_chi2(state: State) -> tuple[Chi2, Chi2, Chi2]:
    """Of the fitted readings, by their noise alone: in-plane, across, of the RF."""
    data = state.data
    out = []
    use = ~state.split.held
    for block in (0, 1):
        pull = data.pick(state.at.left, block) / data.noise_of(block)
        squares = (pull[:-1][use[:-1]][:, state.good]) ** 2
        out.append(Chi2(float(np.nansum(squares)), int(np.isfinite(squares).sum())))
        if block == 0:
            rf = pull[-1][state.split.half[-1] & state.good] ** 2
    out.append(Chi2(float(np.nansum(rf)), int(np.isfinite(rf).sum())))
    return out[0], out[1], out[2]


# --- the steps ------------------------------------------------------------------------------------
@dataclass(frozen=True, eq=False)
class StepwiseFit:
    """Ordered steps, and where they end.

    Attributes:
        design, state: before and after.
        steps: those kept; the first is the design's, the last the result's.
        refused: those that did not help, or spoilt the RF's response.
        heldout: what held-out correctors say of the design and of the result.
        said: sentences of steps that went wrong, and are left out.
    """

    design: State
    state: State
    steps: tuple[Step, ...]
    rejected_steps: tuple[Step, ...]
    heldout: tuple[Score, Score]
    messages: tuple[str, ...] = ()


def fit_steps(
    data: ResponseData,
    split: Split,
    trials: Sequence[Trial] = STEPS,
    most: int = len(STEPS),
    progress: Callable[[str], Any] = lambda stage: None,
) -> StepwiseFit:
    """All families together, those taken out again that nobody needs, the rest fitted to all
    correctors but the held-out ones.

    Families need one another: monitors' gains, say, help nobody before the gradients are there. So
    each is judged by what is lost without it, everything else settled anew: the same work with it
    and without it.

    Args:
        data, split: what was measured, and who judges.
        trials: families, in the order in which they come in.
        most: steps that are kept at most.
        progress: called with each step's name.
    """
    design = begin(data, split)
    stages, state = _in_turn(design, trials, progress)
    readings, steps_gone = outlier_steps(state)
    if readings.messages:  # the families went after them, and what that made of steps is not known
        stages, state = _in_turn(beside(design, readings.unread), trials, progress)
        more, steps_gone = outlier_steps(state)
        readings = readings.and_more(more)
    odd = readings.and_more(steps_gone)
    progress("all together")
    state, doubts = _together(beside(state, odd.unread), stages)
    log.info("independent readings: %s", state.independent)
    odd = odd.and_more(*outlier_steps(state))  # what is usual is less now
    state, design = beside(state, odd.unread), beside(design, odd.unread)
    state, moving = _beside_jitter(state, progress)
    split = state.split
    before = score(design, split.held)
    steps = {
        trial: Step.scored(
            _title(trial), sum(family.count(data) for family in trial.families),
            score(beside(own, odd.unread), split.held),
        )
        for trial, own in stages.items()
    }  # fmt: skip
    stages.clear()
    state, gone, others = _needed(state, steps, most, progress)
    rejected_steps, doubts = (
        [replace(steps.pop(own), kept=False) for own in gone],
        [*doubts, *others],
    )
    judged = inner(state)
    enough = int(np.sum(judged.columns[:, 0, 1] > 0)) >= ENOUGH
    spoilt = -lost(inner(replace(design, jitter=state.jitter)), judged)[0]
    nothing = StepwiseFit(
        design, design, (Step.scored("design", 0, before),),
        (*rejected_steps, *(replace(step, kept=False) for step in steps.values())),
        (before, before), (*odd.messages, *doubts),
    )  # fmt: skip
    if enough and spoilt > SPOILT:  # all together spoil what they should mend
        return nothing
    progress("result")
    # those that chose start at what they say: a column far off would weigh nothing, and stay there
    state = bend(jump(replace(state, exploring=False), beyond=1.0))
    if moving is not None:
        moving = sought(state, moving.planes) or moving
        state = replace(state, jitter=moving.orbits)
    state = taken_back(settle(robust(state)))
    for trial in [own for own in steps if _doubts(state, own)]:  # it has moved since it was asked
        doubts += _doubts(state, trial)
        state = _without(state, trial)
        rejected_steps.append(replace(steps.pop(trial), kept=False))
    then = replace(design, good=state.good, exploring=False)
    if not strange(state) <= max(ASTRAY * strange(then), NEAR):  # in one plane, often
        astray = (
            "the fit left more of the readings that it was fitted to than the design leaves: the "
            "lattice may be too far from the ring, and no effect is told"
        )
        return replace(nothing, messages=(*nothing.messages, astray))
    after = score(state, split.held)
    kept = [Step.scored("design", 0, before), *steps.values()]
    kept[-1] = Step.scored(kept[-1].effect, kept[-1].parameters, after)
    messages = (*odd.messages, *doubts, *(() if moving is None else (moving.sentence,)))
    return StepwiseFit(design, state, tuple(kept), tuple(rejected_steps), (before, after), messages)


def _needed(
    state: State, trials: Collection[Trial], most: int, progress: Callable[[str], Any]
) -> tuple[State, list[Trial], list[str]]:
    """The state with families that are needed alone, `most` trials at most; those that are not; and
    why some cannot be what they stand for."""
    there = {family.name for family in state.families}
    needed = [own for own in trials if there & {family.name for family in own.families}]
    gone = [own for own in trials if own not in needed]
    doubts: list[str] = []
    worth, without = _worth(state, needed, progress)
    while worth and (min(worth.values()) <= 0 or len(worth) > most):
        least = min(worth, key=lambda trial: worth[trial])
        doubts += _doubts(state, least)
        state = without[least] if least in without else _without(state, least)
        gone.append(least)
        del worth[least]
        unsure = [trial for trial, own in worth.items() if own <= 0]
        without = {}
        if unsure:
            again, without = _worth(state, unsure, progress)
            worth |= again
    return state, gone, doubts


def _in_turn(
    design: State, trials: Sequence[Trial], progress: Callable[[str], Any]
) -> tuple[dict[Trial, State], State]:
    """The state with each trial's families, of those that there are, and the last of them."""
    stages: dict[Trial, State] = {}
    state = design
    for trial, state in one_by_one(begun(design, trials), trials, progress):
        stages[trial] = replace(state, kept={})
    return stages, state


def _together(state: State, trials: Iterable[Trial]) -> tuple[State, list[str]]:
    """All families settled, but those whose numbers cannot be what they stand for, which would draw
    the others along; and why. One after another, the last that came in first: one may have drawn
    another along."""
    state = replace(state, independent=np.ones((2, 2)))
    doubts: list[str] = []
    while True:
        settled = taken_back(settle(bend(jump(state))))
        doubted = [trial for trial in trials if _doubts(settled, trial)]
        if not doubted:
            return settled, doubts
        doubts += _doubts(settled, doubted[-1])
        state = forbid(state, doubted[-1].families)


def _beside_jitter(state: State, progress: Callable[[str], Any]) -> tuple[State, Jitter | None]:
    """With a jitter of the beam, where one stands out and those who choose do not object. It is
    looked for again beside the first, of which the ring's errors had taken some."""
    moving = sought(state)
    if moving is None:
        return state, None
    progress("jitter of the beam")
    with_it = settle(replace(state, jitter=moving.orbits))
    again = sought(with_it)
    if again is not None:
        moving, with_it = again, settle(replace(with_it, jitter=again.orbits))
    beside_it = replace(state, jitter=moving.orbits)
    messages = lost(inner(beside_it), inner(with_it))
    log.info("%s: judges %+.3f +- %.3f", moving.sentence, *messages)
    return (state, None) if against(messages, WORTH) else (with_it, moving)


def one_by_one(
    state: State, trials: Iterable[Trial], progress: Callable[[str], Any] = lambda stage: None
) -> Iterator[tuple[Trial, State]]:
    """The state with one trial's families after another, each fitted beside those before it;
    without those that the ring has no places of, or the measurement no readings."""
    for given in trials:
        told = tuple(
            family for family in given.families
            if state.reads(family.block) and family.size(state.data)
        )  # fmt: skip
        trial = replace(given, families=told)
        if not any(family.count(state.data) for family in trial.families):
            continue
        progress(_title(trial))
        state = bend(state) if trial.own else state
        state = settle(jump(allow(state, trial.families)), _blocks(trial), FIRST, ROUGH)
        yield trial, state


def _title(trial: Trial) -> str:
    return ", ".join(family.title for family in trial.families)


def _blocks(trial: Trial) -> list[int]:
    return [1] * (trial.across > 0) + [0] * (trial.own > 0)


def _worth(
    state: State, trials: Iterable[Trial], progress: Callable[[str], Any]
) -> tuple[dict[Trial, float], dict[Trial, State]]:
    """Log evidence of each trial's families beside all the others (0 or less: not needed), and the
    states without them.

    Correctors that were not fitted have the veto: evidence takes readings for independent, which
    what the model lacks is not. Where they want what the evidence linear about the fit wants too,
    that stands, for two fits that settled each by itself compare to a share of their cost alone.
    """
    worth, judged = _quickly(state, trials, progress)
    doubtful = [
        trial for trial, unwanted in judged.items()
        if worth[trial] > -np.inf and (unwanted or not worth[trial] > SURE)
    ]  # fmt: skip
    states: dict[Trial, State] = {}
    if not doubtful:
        return worth, states
    shares = state.independent
    whole = evidence_of(state, state.good, shares)
    unsure = ROUGH * np.count_nonzero(np.isfinite(state.data.orbits[state.fitted])) / 2
    for trial in doubtful:
        progress(f"without {_title(trial)}")
        try:
            without = states[trial] = _without(state, trial)
        except TmlatticeError:  # no closed orbit without it
            worth[trial] = np.inf
            continue
        good = state.good & without.good
        with_it = whole if (good == state.good).all() else evidence_of(state, good, shares)
        other = evidence_of(without, good, shares)
        gained = with_it.log - other.log - LEAST
        messages = lost(
            inner(replace(without, good=good), _of_rf(other)),
            inner(replace(state, good=good), _of_rf(with_it)),
        )
        log.info(
            "without %s: evidence %+.1f, judges %+.3f +- %.3f", _title(trial), -gained, *messages
        )
        if not _asked(trial):
            worth[trial] = gained
        elif against(messages):
            worth[trial] = min(gained, messages[0])
        elif not (in_favour(messages) and worth[trial] > gained > -unsure):
            worth[trial] = gained
    return worth, states


def _doubts(state: State, trial: Trial) -> list[str]:
    """Why what was found of a trial's families cannot be what they stand for."""
    own = [family for family in trial.families if state.allows(family.name)]
    doubts = (family.doubt(state.values[family.variable], state.data) for family in own)
    return [doubt for doubt in doubts if doubt is not None]


def _of_rf(own: Evidence) -> Array:
    """What the RF's fitted monitors leave, each predicted by all others."""
    return rf_by_others(own.state, own.in_plane, own.found)


def _priors(trial: Trial, state: State) -> set[str]:
    return {group.name for family in trial.families for group in family.groups(state.data)}


def _asked(trial: Trial) -> bool:
    """Whether correctors that were not fitted know of it: not of what fitted ones have of their
    own."""
    return any(family.per != "column" for family in trial.families)


def _quickly(
    state: State, trials: Iterable[Trial], progress: Callable[[str], Any]
) -> tuple[dict[Trial, float], dict[Trial, bool]]:
    """Log evidence of each trial, linear about where the fit stands, which is enough for what
    nobody doubts; and whether the judges would rather be without it."""
    worth: dict[Trial, float] = {}
    unwanted: dict[Trial, bool] = {}
    blocks: dict[int, tuple[Linear, tuple[float, dict[str, Array], Posterior | None]]] = {}
    for block in {trial.families[0].block for trial in trials} | {0}:
        if state.of_block(block):
            there = linear(state, block)
            blocks[block] = there, linear_evidence(there)
    in_plane = blocks.get(0)
    of_rf = rf_by_others(state, in_plane and in_plane[0], in_plane and in_plane[1][2])
    judged = inner(state, of_rf)
    for trial in trials:
        progress(f"is {_title(trial)} needed")
        if not any(state.values[family.variable].any() for family in trial.families):
            worth[trial], unwanted[trial] = -LEAST, False  # held at zero: nothing is lost without
            continue
        if _doubts(state, trial):
            worth[trial], unwanted[trial] = -np.inf, False
            continue
        block = trial.families[0].block
        there, (evidence, _, _) = blocks[block]
        other, values, found = linear_evidence(there, _priors(trial, state))
        worth[trial] = evidence - other - LEAST
        without_it = of_rf if block else rf_by_others(state, there, found)
        try:
            messages = lost(inner(state.moved({**state.values, **values}), without_it), judged)
        except TmlatticeError:  # no closed orbit without it
            messages = np.inf, 0.0
        unwanted[trial] = _asked(trial) and against(messages)
        log.info(
            "%s: linear evidence %+.1f, judges %+.3f +- %.3f",
            _title(trial),
            worth[trial],
            *messages,
        )
    return worth, unwanted


def _without(state: State, trial: Trial) -> State:
    """All the others settled anew; the other block does not feel it, to first order."""
    return settle(forbid(state, trial.families), _blocks(trial), FIRST, ROUGH)
