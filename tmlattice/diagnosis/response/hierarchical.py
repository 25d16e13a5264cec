"""The hierarchical fit of an orbit response: all families of errors at once, validated on held-out
data.

>>> fit = fit_families(data, split)
>>> fit.heldout[1].in_plane                        # m, over held-out correctors

Each family has a prior whose scale is learnt, so that one that is not needed shrinks. First all
columns, and all monitors, have the same misfit, for who is wrong is unknown until the model has
settled; then each its own. What is of second order, or of one orbit, is opened with the latter.
Held-out correctors of the inner set, which are not fitted until that is decided, close what makes
their readings worse.
"""

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tmlattice.diagnosis.families.family import Family
from tmlattice.diagnosis.families.steps import FAMILIES, SECOND
from tmlattice.diagnosis.response.first_guess import begun, strange
from tmlattice.diagnosis.response.linear import linear
from tmlattice.diagnosis.response.outliers import good_monitors, outliers, without
from tmlattice.diagnosis.response.rounds import log_evidence, settle
from tmlattice.diagnosis.response.state import (
    Outcome,
    State,
    allow,
    begin,
    bend,
    forbid,
    jump,
)
from tmlattice.diagnosis.response.swaps import mislabelled, swaps
from tmlattice.diagnosis.response.validation import (
    CORRECTORS,
    Chi2,
    Score,
    against,
    inner,
    lost,
    score,
)
from tmlattice.diagnosis.response.weights import used, with_waves
from tmlattice.errors import TmlatticeError
from tmlattice.inference.normal import solve
from tmlattice.observe.response_data import ResponseData
from tmlattice.observe.split import Split

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

log = logging.getLogger(__name__)

WORTH = 10.0
"""Log evidence from which on waves of the orbit in each step are asked for."""
LEADS, ROUGH = 5e-3, 0.03
"""Share of the cost that a round has to gain for another one, of a fit that leads to the next one;
and of one that is compared."""
ASTRAY, NEAR = 1.2, 1e-3
"""So many times what the design leaves of the typical column's square no result may leave; or this
share of it, if that is more."""
SPOILT, SURELY, ENOUGH = 0.05, 2.0, 3
"""By how much the logarithms of the validation scores may rise with all families, if that is more
than so many of their standard errors, and inner correctors that it takes to say so."""


@dataclass(frozen=True)
class Step:
    """The gap of the design, of the fit, or with a single fault or without a closed family.

    Attributes:
        effect: what was fitted: "design", "all families", or a fault or a family by its effect.
        parameters: how many it has.
        heldout_rms_in_plane, heldout_rms_coupling: m, over held-out correctors.
        heldout_rms_position: in-plane, with a position jump of each held-out corrector, m.
        heldout_rms_roll: coupling, with the roll of each held-out corrector from the monitors that
            gave its kick, m; NaN before rolls are fitted.
        heldout_chi2_per_dof: in-plane, by the readings' noise.
        dispersion_rms: of the RF's orbit in x on the half of the monitors not fitted, m.
        kept: False of a family that is closed; its figures are those with it.
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


@dataclass(frozen=True, eq=False)
class HierarchicalFit:
    """The design and the fit.

    Attributes:
        design, state: before and after.
        steps: the design, the fit, and single faults.
        rejected_steps: families that were closed, with the figures of the fit with them.
        heldout: what held-out correctors say of the design and of the result.
        messages: what is to be reported.
    """

    design: State
    state: State
    steps: tuple[Step, ...]
    rejected_steps: tuple[Step, ...]
    heldout: tuple[Score, Score]
    messages: tuple[str, ...] = ()


def fit_families(
    data: ResponseData,
    split: Split,
    families: Sequence[Family] = FAMILIES,
    progress: Callable[[str], Any] = lambda stage: None,
) -> HierarchicalFit:
    """All families together, fitted to all correctors but the held-out ones.

    Args:
        data, split: what was measured, and who validates.
        families: that may be open; those without places or readings are left out.
        progress: called with the name of each stage.
    """
    design = begin(data, split)
    there = [f for f in families if design.reads(f.block) and f.size(data) and f.count(data)]
    late = [f for f in there if f.name in SECOND]
    progress("all families")
    state = allow(begun(design, there), [f for f in there if f not in late])
    state = settle(bend(jump(state)), gain=LEADS, alike=True)
    progress("misfits of columns and BPMs")
    state = settle(bend(jump(allow(state, late))), gain=LEADS)
    swapped = {name for pair in swaps(state, mislabelled(state)) for name in pair}
    found_outliers = outliers(state, swapped)
    messages = list(found_outliers.messages)
    state, design = without(state, found_outliers.unread), without(design, found_outliers.unread)
    rejected_steps: list[Step] = []
    state = _undoubted(replace(state, good=good_monitors(state)), messages, rejected_steps)
    state = settle(state, gain=LEADS)
    split = state.split
    before = score(design, split.held)
    steps = [Step.scored("design", 0, before)]
    state = _validated(state, rejected_steps, progress)
    rise, unsure = lost(inner(replace(design, good=state.good)), inner(state))
    enough = int(split.inner.sum()) >= ENOUGH
    title = "all families"
    count = sum(family.count(data) for family in state.families)
    nothing = HierarchicalFit(
        design, design, tuple(steps),
        (*rejected_steps, replace(Step.scored(title, count, score(state, split.held)), kept=False)),
        (before, before), tuple(messages),
    )  # fmt: skip
    if enough and -rise > max(SPOILT, SURELY * unsure):
        return nothing
    progress("all correctors")
    # the inner ones begin at what they say: a column far off would weigh nothing, and stay there
    state = settle(bend(jump(replace(state, exploring=False), beyond=1.0)))
    fewer = _undoubted(state, messages, rejected_steps)
    state = state if fewer is state else settle(fewer)
    state = replace(state, good=state.good & good_monitors(state))
    then = replace(design, good=state.good, exploring=False)
    if not strange(state) <= max(ASTRAY * strange(then), NEAR):  # in one plane, often
        astray = (
            "the fit left more of the readings that it was fitted to than the design leaves: the "
            "lattice may be too far from the ring, and no effect is reported"
        )
        return replace(nothing, messages=(*messages, astray))
    if state.outcome in (Outcome.ROUNDS, Outcome.STUCK):
        messages.append(f"the fit has not converged: {state.outcome.value}")
    after = score(state, split.held)
    steps.append(Step.scored(title, count, after))
    return HierarchicalFit(
        design, state, tuple(steps), tuple(rejected_steps), (before, after), tuple(messages)
    )


def _rejected(state: State, family: Family) -> Step:
    """The figures of the fit with a family that is closed."""
    figures = score(state, state.split.held)
    return replace(Step.scored(family.title, family.count(state.data), figures), kept=False)


def _validated(state: State, rejected_steps: list[Step], progress: Callable[[str], Any]) -> State:
    """Return the state with orbit waves in each step, if the log evidence demands them and the
    validation correctors do not object; and without late families that these correctors reject."""
    progress("validation")
    if used(state, 1).any():
        more = settle(with_waves(state), gain=LEADS)
        rise = lost(inner(state), inner(more), CORRECTORS)
        gained = log_evidence(more) - log_evidence(state)
        log.info("waves: evidence %+.1f, validation %+.3f +- %.3f", gained, *rise)
        if gained > WORTH and not against(rise):
            state = more
    for family in [own for own in state.families if own.name in SECOND]:
        if not state.values[family.variable].any():
            continue
        rise = lost(inner(_closed(state, family)), inner(state))
        log.info("without %s: validation %+.3f +- %.3f", family.name, *rise)
        if against(rise):
            rejected_steps.append(_rejected(state, family))
            state = settle(forbid(state, [family]), gain=LEADS)
    return state


def _closed(state: State, family: Family) -> State:
    """The state without a family, linear where the fit stands; as it is where no beam is stored
    without it."""
    there = linear(state, family.block)
    gone = {group.name for group in family.groups(state.data)}
    groups = [group for group in there.groups if group.name not in gone]
    values = solve(there.normal, groups, there.start, rounds=2).values
    try:
        return state.moved({**state.values, **{n: values[at] for n, at in there.where.items()}})
    except TmlatticeError:
        return state


def _undoubted(state: State, messages: list[str], rejected_steps: list[Step]) -> State:
    """The state without families whose numbers cannot be what they stand for; why goes to the
    messages."""
    doubts = {
        family: doubt
        for family in state.families
        if (doubt := family.doubt(state.values[family.variable], state.data)) is not None
    }
    messages += doubts.values()
    rejected_steps += [_rejected(state, family) for family in doubts]
    return forbid(state, list(doubts)) if doubts else state
