"""The dense fit of an orbit response: families of errors, step by step, judged on held-out data.

>>> fit = fit_steps(data, split)
>>> [(step.effect, step.heldout_rms_in_plane) for step in fit.steps]

Gradients and skew gradients are fitted together, because skew ones move the tunes.
"""

import logging
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tmlattice.diagnosis.families import STEPS, Trial
from tmlattice.diagnosis.family import Told
from tmlattice.diagnosis.odd_readings import robust
from tmlattice.diagnosis.rounds import Linear, linear, linear_evidence, log_evidence, settle
from tmlattice.diagnosis.state import (
    State,
    allow,
    amplitudes,
    begin,
    bend,
    forbid,
    jump,
    rms_of,
)
from tmlattice.errors import TmlatticeError
from tmlattice.inference.normal import Posterior, solve
from tmlattice.observe.orbit_response import ResponseData, Split

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

log = logging.getLogger(__name__)

LEAST = 5.0
"""Log evidence that a step has to have."""
JUDGES, VETO = np.array([1.0, 1.0, 0.25]), 0.01
"""How the logarithms of rms count that held-out correctors leave (in-plane, coupling, RF: of some
25 readings), and by how much their sum may fall without a step that stays all the same: evidence
takes what the model lacks for noise, and gladly fits it."""
SPOILT = 0.05
"""By how much it may fall without any."""
SURE = 100.0
"""Log evidence, linear about the fit, of which nobody doubts that it is above the least."""
FIRST, ROUGH = 4, 0.03
"""Rounds of each block after a family came in, or went, and what one has to gain for another."""


class Chi2(NamedTuple):
    """A sum of squares in units of the noise, and of how many readings."""

    total: float
    readings: int

    @property
    def per_reading(self) -> float:
        """1 is noise."""
        return self.total / max(self.readings, 1)


@dataclass(frozen=True)
class Score:
    """What the judges say: rms in m; see `Step`. Chi-squares are in-plane, across, of the RF."""

    in_plane: float
    coupling: float
    chi2_per_dof: float
    dispersion: float
    position: float
    roll: float
    chi2: tuple[Chi2, Chi2, Chi2]


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


# --- the judges -----------------------------------------------------------------------------------
def score(state: State, judges: Flags, rf: Flags | None = None) -> Score:
    """What correctors that were not fitted say; each has its kick from its near monitors.

    Args:
        state: that is judged.
        judges: the correctors that judge, [column].
        rf: monitors that judge the RF's response; None: those that did not fit it.
    """
    data, at, half = state.data, state.at, state.split.half
    read = at.seen(at.beam)
    straight, across = data.pick(read), data.pick(read, 1)
    orbits, orbits_across = data.pick(data.orbits), data.pick(data.orbits, 1)
    jumps = data.pick(at.seen(at.jumps))
    turned = state.allows("corrector_roll")
    rolls = data.pick(at.seen(at.across), 1) if turned else np.zeros_like(straight)
    variance, variance_across = (data.noise_of(block) ** 2 for block in (0, 1))
    inside, jumped, outside, rolled, squares, spread = [], [], [], [], [], []
    cross = [np.zeros(0)]
    for c in np.flatnonzero(judges):
        seen = np.isfinite(orbits[c]) & state.good
        near, far = seen & half[c], seen & ~half[c]
        # all alike: what the model lacks is not the readings' noise
        kick, miss = amplitudes(straight[c][:, None], orbits[c], near, far)
        inside.append(miss)
        squares.append(miss**2 / variance[c, far])
        # the kick's own error stands beside the reading's
        spread.append(1 + straight[c, far] ** 2 / np.sum(straight[c, near] ** 2))
        jumped.append(amplitudes(np.stack([straight[c], jumps[c]], 1), orbits[c], near, far)[1])
        left = orbits_across[c] - kick[0] * across[c]
        there = np.isfinite(left)
        outside.append(left[far & there])
        cross.append(outside[-1] ** 2 / variance_across[c, far & there])
        if rolls[c].any():
            rolled.append(amplitudes(rolls[c][:, None], left, near & there, far & there)[1])
    judge = state.good & np.isfinite(orbits[-1]) & (~half[-1] if rf is None else rf)
    of_rf = (orbits[-1] - straight[-1])[judge]
    own, others = np.concatenate(squares), np.concatenate(cross)
    return Score(
        in_plane=rms_of(inside),
        coupling=rms_of(outside),
        chi2_per_dof=float(np.mean(own)),
        dispersion=rms_of([of_rf]),
        position=rms_of(jumped),
        roll=rms_of(rolled) if rolled else float("nan"),
        chi2=(
            Chi2(float(np.sum(own / np.concatenate(spread))), len(own)),
            Chi2(float(np.sum(others)), len(others)),
            Chi2(float(np.sum(of_rf**2 / variance[-1, judge])), len(of_rf)),
        ),
    )


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
class DenseFit:
    """Ordered steps, and where they end.

    Attributes:
        design, state: before and after.
        steps: those kept; the first is the design's, the last the result's.
        refused: those that did not help, or spoilt the RF's response.
        heldout: what held-out correctors say of the design and of the result.
    """

    design: State
    state: State
    steps: tuple[Step, ...]
    refused: tuple[Step, ...]
    heldout: tuple[Score, Score]


def fit_steps(
    data: ResponseData,
    split: Split,
    trials: Sequence[Trial] = STEPS,
    most: int = len(STEPS),
    progress: Callable[[str], Any] = lambda stage: None,
) -> DenseFit:
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
    before = score(design, split.held)
    steps: dict[Trial, Step] = {}
    for trial, state in one_by_one(design, trials, progress):
        count = sum(family.count(data) for family in trial.families)
        steps[trial] = Step.scored(_title(trial), count, score(state, split.held))
    progress("all together")
    state = settle(bend(jump(state)))
    refused: list[Step] = []
    worth, without = _worth(state, steps, progress)
    while worth and (min(worth.values()) <= 0 or len(worth) > most):
        least = min(worth, key=lambda trial: worth[trial])
        state = without[least] if least in without else _without(state, least)
        refused.append(replace(steps.pop(least), kept=False))
        doubted = [trial for trial in steps if worth[trial] <= 0]
        del worth[least]
        without = {}
        if doubted:
            again, without = _worth(state, doubted, progress)
            worth |= again
    if _lost(_inner(design), _inner(state)) < -SPOILT:  # all together spoil what they should mend
        refused += [replace(step, kept=False) for step in steps.values()]
        return DenseFit(design, design, (Step.scored("design", 0, before),), tuple(refused),
                        (before, before))  # fmt: skip
    progress("result")
    # those that chose start at what they say: a column far off would weigh nothing, and stay there
    state = bend(jump(replace(state, exploring=False), beyond=1.0))
    state = settle(robust(state))
    after = score(state, split.held)
    kept = [Step.scored("design", 0, before), *steps.values()]
    kept[-1] = Step.scored(kept[-1].effect, kept[-1].parameters, after)
    return DenseFit(design, state, tuple(kept), tuple(refused), (before, after))


def one_by_one(
    state: State, trials: Iterable[Trial], progress: Callable[[str], Any] = lambda stage: None
) -> Iterator[tuple[Trial, State]]:
    """The state with one trial's families after another, each fitted beside those before it;
    without those that the ring has no places of, or the measurement no readings."""
    for given in trials:
        told = tuple(family for family in given.families if state.reads(family.block))
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


def _inner(state: State) -> Array:
    """What chooses: in-plane, coupling and dispersion rms of correctors held out for it; each half
    of their monitors gives the kick once."""
    other = replace(state, split=replace(state.split, half=~state.split.half))
    said = [score(one, state.split.inner, state.split.inner_rf) for one in (state, other)]
    rms = [[one.in_plane, one.coupling, one.dispersion] for one in said]
    return np.asarray(np.sqrt(np.mean(np.square(rms), axis=0)))


def _lost(without: Array, inner: Array) -> float:
    """By how much the judges' figures rise; those that nobody read (no RF step) say nothing."""
    return float(np.nansum(JUDGES * np.log(without / np.maximum(inner, 1e-300))))


def _worth(
    state: State, trials: Iterable[Trial], progress: Callable[[str], Any]
) -> tuple[dict[Trial, float], dict[Trial, State]]:
    """Log evidence of each trial's families beside all the others (0 or less: not needed), and the
    states without them.

    Correctors that were not fitted have the veto: evidence takes readings for independent, which
    what the model lacks is not.
    """
    worth, judged = _quickly(state, trials, progress)
    doubtful = [trial for trial in judged if judged[trial] or not worth[trial] > SURE]
    states: dict[Trial, State] = {}
    if not doubtful:
        return worth, states
    inner, evidence = _inner(state), log_evidence(state, state.good)
    for trial in doubtful:
        progress(f"without {_title(trial)}")
        without = states[trial] = _without(state, trial)
        good = state.good & without.good
        with_it = evidence if (good == state.good).all() else log_evidence(state, good)
        gained = with_it - log_evidence(without, good) - LEAST
        lost = _lost(_inner(without), inner)
        log.info("without %s: evidence %+.1f, judges %+.3f", _title(trial), -gained, lost)
        worth[trial] = min(gained, lost) if _asked(trial) and lost < -VETO else gained
    return worth, states


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
    against: dict[Trial, bool] = {}
    inner = _inner(state)
    blocks: dict[int, tuple[Linear, float]] = {}
    for trial in trials:
        progress(f"is {_title(trial)} needed")
        if not any(state.values[family.variable].any() for family in trial.families):
            worth[trial], against[trial] = -LEAST, False  # held at zero: nothing is lost without
            continue
        block = trial.families[0].block
        if block not in blocks:
            there = linear(state, block)
            blocks[block] = there, linear_evidence(there)[0]
        there, evidence = blocks[block]
        other, values = linear_evidence(there, _priors(trial, state))
        worth[trial] = evidence - other - LEAST
        try:
            lost = _lost(_inner(state.moved({**state.values, **values})), inner)
        except TmlatticeError:  # no closed orbit without it
            lost = np.inf
        against[trial] = _asked(trial) and lost < -VETO
        log.info("%s: linear evidence %+.1f, judges %+.3f", _title(trial), worth[trial], lost)
    return worth, against


def _without(state: State, trial: Trial) -> State:
    """All the others settled anew; the other block does not feel it, to first order."""
    return settle(forbid(state, trial.families), _blocks(trial), FIRST, ROUGH)


# --- what was found -------------------------------------------------------------------------------
def told(state: State) -> tuple[list[Told], tuple[str, ...]]:
    """The errors as causes, with posterior rms; and what the data alone do not settle, in words."""
    found: list[Told] = []
    said: tuple[str, ...] = ()
    for block in (0, 1):
        families = {f.variable: f for f in state.of_block(block)}
        if not families:
            continue
        there = linear(state, block)
        posterior = solve(there.normal, there.groups, there.start, rounds=0)
        for name, family in families.items():
            sigma = posterior.sigma[there.where[name]]
            found += family.told(state.at.errors, state.values[name], sigma, state.data)
        if block == 0:
            said = _degenerate(state, there, posterior)
    return [row for row in found if row[0].amount != 0 or row[1] != 0], said


def _degenerate(state: State, there: Linear, posterior: Posterior) -> tuple[str, ...]:
    """Directions that the prior holds and not the data."""
    said = []
    columns, monitors = state.data.shape
    m = 2 * monitors
    spread = posterior.spread
    factor = np.linalg.cholesky(posterior.covariance + 1e-12 * np.eye(len(spread.T)))
    draws = spread @ factor
    scale = draws[:m].mean(axis=0)
    kick = draws[m : m + columns - 1].mean(axis=0)
    if scale.any() and kick.any():  # both are fitted
        both = float(scale @ kick / np.sqrt((scale @ scale) * (kick @ kick)))
        said.append(
            f"mean monitor gain against mean corrector scale: known to "
            f"{100 * np.sqrt(scale @ scale):.2f} % by the RF step and the priors, correlation "
            f"{both:+.2f}"
        )
    for family in state.families:
        own = [g for g in there.groups if g.name == family.name]
        if family.per != "ring" or family.block or not own or len(own[0].scale) < 2:
            continue
        loose = np.flatnonzero(posterior.sigma[there.where[family.variable]] > 0.5 * own[0].scale)
        causes = family.told(state.at.errors, state.values[family.variable],
                             np.zeros(family.size(state.data)), state.data)  # fmt: skip
        names = [causes[i][0].element or "" for i in loose]
        if names:
            said.append(
                f"{len(names)} gradients that the prior holds more than the data: "
                + ", ".join(names[:12]) + (", ..." if len(names) > 12 else "")
            )  # fmt: skip
    return tuple(said)
