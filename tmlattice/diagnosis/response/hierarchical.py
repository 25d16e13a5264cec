"""The hierarchical fit of an orbit response: all families of errors at once, with validation.

>>> fit = fit_families(data, split)
>>> fit.heldout[1].in_plane                        # m, over held-out correctors

Each family has a prior whose scale is learnt, so that an unnecessary family vanishes. First all
columns, and all BPMs, have one misfit, because outliers are unknown before convergence; then each
has its own. Families of second order, or of one orbit, are added with the latter. An inner
validation set of held-out correctors rejects families that increase its residuals.
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
"""Log evidence from which on orbit waves in each step are tried."""
LEADS, ROUGH = 5e-3, 0.03
"""Share of the cost that a round must gain for another one: of an intermediate fit, and of one that
is compared."""
ASTRAY, NEAR = 1.2, 1e-3
"""Largest ratio of the fit's to the design's share of the typical column's square; or its largest
value, if that is more."""
SPOILT, SURELY, ENOUGH = 0.05, 2.0, 3
"""Largest rise of the log validation scores by all families, with its least number of standard
errors, and the least number of inner correctors."""


@dataclass(frozen=True)
class Step:
    """Residuals of the design, of the fit, or with a single fault or a rejected family.

    Attributes:
        effect: what was fitted: "design", "all families", or a fault or a family by its effect.
        parameters: how many it has.
        heldout_rms_in_plane, heldout_rms_coupling: m, over held-out correctors.
        heldout_rms_position: in-plane, with a position jump of each held-out corrector, m.
        heldout_rms_roll: coupling, with the roll of each held-out corrector from the monitors that
            gave its kick, m; NaN before rolls are fitted.
        heldout_chi2_per_dof: in-plane, by the readings' noise.
        dispersion_rms: of the RF's orbit in x on the half of the monitors not fitted, m.
        kept: False of a rejected family; the residuals are those with it.
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
        """The step with the scores of the validation."""
        return cls(
            effect, parameters, s.in_plane, s.coupling, s.chi2_per_dof, s.dispersion, s.position,
            s.roll,
        )  # fmt: skip

    def as_json(self) -> dict[str, Any]:
        """The entry in the file of the diagnosis."""
        return {name: value for name, value in vars(self).items() if name != "kept"}


def fit_chi2(state: State) -> tuple[Chi2, Chi2, Chi2]:
    """Misfits of the fitted readings, by their noise alone: in-plane, coupling, RF."""
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
        rejected_steps: rejected families, with the residuals of the fit with them.
        heldout: scores of held-out correctors for the design and for the result.
        messages: messages of the fit.
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
    """Fit all families together to all correctors except the held-out ones.

    Args:
        data, split: the data, and the validation split.
        families: that may be fitted; those without places or readings are omitted.
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
    # the inner ones start at their own estimates: an outlier column would stay without weight
    state = settle(bend(jump(replace(state, exploring=False), beyond=1.0)))
    fewer = _undoubted(state, messages, rejected_steps)
    state = state if fewer is state else settle(fewer)
    state = replace(state, good=state.good & good_monitors(state))
    then = replace(design, good=state.good, exploring=False)
    if not strange(state) <= max(ASTRAY * strange(then), NEAR):  # in one plane, often
        astray = (
            "the residual of the fitted readings is larger than the design's: the "
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
    """A step with a rejected family."""
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
    """The state without a family, linearised; unchanged where no beam is stored without it."""
    there = linear(state, family.block)
    gone = {group.name for group in family.groups(state.data)}
    groups = [group for group in there.groups if group.name not in gone]
    values = solve(there.normal, groups, there.start, rounds=2).values
    try:
        return state.moved({**state.values, **{n: values[at] for n, at in there.where.items()}})
    except TmlatticeError:
        return state


def _undoubted(state: State, messages: list[str], rejected_steps: list[Step]) -> State:
    """The state without implausible families; the reasons are added to the messages."""
    doubts = {
        family: doubt
        for family in state.families
        if (doubt := family.doubt(state.values[family.variable], state.data)) is not None
    }
    messages += doubts.values()
    rejected_steps += [_rejected(state, family) for family in doubts]
    return forbid(state, list(doubts)) if doubts else state
