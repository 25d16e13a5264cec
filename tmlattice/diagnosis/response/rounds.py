"""Damped Gauss-Newton steps of a hierarchical fit, and the log evidence of its result.

>>> state = settle(bend(jump(allow(state, families))))
"""

import logging
from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np

from tmlattice.arrays import TINY, Array, Flags
from tmlattice.diagnosis.response.linear import STILL, Linear, gathered, linear
from tmlattice.diagnosis.response.state import State
from tmlattice.diagnosis.response.weights import log_scale, look, weighed, weight
from tmlattice.errors import UnstableRingError
from tmlattice.inference.normal import Posterior, solve
from tmlattice.inference.priors import Group

log = logging.getLogger(__name__)

MOST_STEPS = 12
"""Largest number of steps of each block. Fits have converged by then, as far as the changing
weights allow."""
GAIN = 3e-3
"""Relative fall of the cost by which a step is progress."""
EACH = 4
"""Iterations of EM for the prior scales in a step."""
LEARN = 10
"""Iterations of EM for prior scales alone: those of absent errors fall slowly."""
TOGETHER, REPEATED = 2, 2
"""Steps of each block after which the cost has to be lower, and returns without progress."""
NARROWER, WIDER, WIDEST = 4.0, 2.0, 8.0
"""Divisor of the bounds of a step that raised the cost of its block, and of all at a return; their
growth, and its limit."""
REQUIRED = 5.0
"""Log evidence required for a family of errors, or for another effect."""
CROSSED = 4
"""Repetitions of a step that crosses lower bounds."""
CORRECTED, CORRECTS = 6, 1e-3
"""Corrections of a step by the residuals at its end, with the derivatives at its start; and the
relative fall of the cost required for another one. Correlated numbers follow a curved valley of the
cost, which its tangent leaves."""


def one_step(
    state: State, block: int, there: Linear, width: float = 1.0
) -> tuple[State, float, float]:
    """Solve the readings of one block, and move. Return the state, and the cost before and after.

    Args:
        state: the start.
        block: 0 in-plane, 1 coupling.
        there: `linear` of that block at the start.
        width: factor on the step bounds; small after diverged steps.
    """
    found = bounded_step(there, width)
    groups = {group.name: group for group in found.groups}
    learnt = replace(state, groups={**state.groups, **groups})

    def cost(at: State) -> float:
        penalty = sum(
            _penalty([g for g in found.groups if g.basis[rows].any()], rows, at.values[name])
            for name, rows in there.where.items()
        )
        return _misfit(state, at, block) + penalty

    best, last, aim = learnt, np.inf, found.values
    for turn in range(CORRECTED + 1):
        values = {name: np.maximum(aim[at], there.lowest[at]) for name, at in there.where.items()}
        then = learnt.moved({**state.values, **values})
        try:
            after = cost(then)
        except UnstableRingError:  # diverged: no closed orbit
            break
        gained = after <= (1 - CORRECTS) * last
        if after <= last:
            best, last = then, after
        if not gained or turn == CORRECTED:
            break
        # the score there, with the derivatives of the start
        moved = np.zeros_like(there.start)
        for name, at in there.where.items():
            moved[at] = values[name] - there.start[at]
        left = state.data.pick(then.at.left, block)
        score = gathered(there, state.data.plane_of(block), weighed(state, block, left))
        score += there.normal.matrix @ moved
        score += there.normal.matrix @ there.start + there.start / (width * there.trust) ** 2
        aim, before = found.solved(score), aim
        further = aim - before
        if further @ there.normal.matrix @ further < CORRECTS * after:
            break  # linear enough
    return best, cost(state), last


def _misfit(state: State, at: State, block: int) -> float:
    """Weighted sum of squares of a block's residuals at another state, with the state's weights."""
    left = np.where(weight(state, block) > 0, state.data.pick(at.at.left, block), 0.0)
    return float(np.sum(left * weighed(state, block, left)))


def bounded_step(there: Linear, width: float) -> Posterior:
    """The bounded step, with numbers fixed at their lower bounds where it would cross them."""
    groups, trust, rounds = there.groups, width * there.trust, EACH
    for _ in range(CROSSED):
        found = solve(there.normal, groups, there.start, trust, rounds)
        low = found.values < there.lowest
        if not low.any():
            break
        rest, rounds = ~low[:, None], 1  # the scales are learnt
        groups = tuple(replace(group, basis=group.basis * rest) for group in found.groups)
    return found


def _penalty(groups: Sequence[Group], rows: slice, values: Array) -> float:
    """Twice the negative log prior density of a variable, up to a constant; its priors add up."""
    if not groups:  # the ring has no such numbers
        return 0.0
    each, shared = np.zeros(len(values)), []
    for group in groups:
        spread = group.basis[rows] * group.scale
        there, own = spread != 0, spread.any(axis=1)
        single = (there.sum(axis=0) <= 1).all() and (there.sum(axis=1) <= 1).all()
        if single and not each[own].any():
            each += np.abs(spread).sum(axis=1)
        else:
            shared.append(spread)
    free = each > 0  # fixed numbers are skipped
    if not free.any():
        spread = np.concatenate(shared, axis=1)
        return float(np.sum(np.linalg.lstsq(spread, values, rcond=1e-9)[0] ** 2))
    # each number's own prior penalises the rest beyond the shared ones
    rest, scale = values[free] / each[free], each[free, None]
    few = np.concatenate([np.zeros((len(rest), 0)), *(own[free] / scale for own in shared)], axis=1)
    asked = np.concatenate([rest, np.zeros(few.shape[1])])
    amounts = np.linalg.lstsq(np.concatenate([few, np.eye(few.shape[1])]), asked, rcond=None)[0]
    return float(np.sum((rest - few @ amounts) ** 2) + amounts @ amounts)


def settle(
    state: State, most: int = MOST_STEPS, gain: float = GAIN, look_at_monitors: bool = True
) -> State:
    """Return the state of the lowest cost after damped Gauss-Newton steps.

    The blocks are stepped in turn, by the method of Levenberg and Marquardt with a step bound for
    each number. A step may increase the cost of the other block, which its derivatives omit,
    because the next steps may compensate. Where they do not, the fit returns to the lowest cost,
    and goes on from there with smaller bounds. Weights and bad BPMs are updated at a new lowest
    cost only, so that costs in between are comparable. The fit ends when a step of each block
    changes the cost by less than progress, either way, or after `REPEATED` further returns.

    Args:
        state: the start.
        most: largest number of steps of each block.
        gain: relative fall of the cost by which a step is progress.
        look_at_monitors: whether the bad BPMs are updated.
    """
    good = state.good

    def looked(state: State) -> State:
        for block in (0, 1):
            if state.of_block(block):
                state = look(state, block)
                state = state if look_at_monitors else replace(state, good=good)
        return state

    best, start = state, state
    blocks = [block for block in (0, 1) if state.of_block(block)]
    width = dict.fromkeys(blocks, 1.0)
    gained, away = 0.0, 0  # since the lowest cost
    still = failed = 0  # steps that change little, and repetitions without progress
    for turn, block in enumerate(blocks * most):
        moved, before, after = one_step(state, block, linear(state, block, STILL), width[block])
        away, change, cost = away + 1, before - after, max(before, TINY)
        if change < 0:
            width[block] /= NARROWER
        else:
            then, now = (
                sum(_misfit(state, at, own) for own in blocks if own != block)
                for at in (state, moved)
            )
            change, cost = change + then - now, max(after + now, TINY)
            state, gained = moved, gained + change
            log.info("step %d, block %d: cost %.3g less, model discrepancy %s m", turn, block,
                     gained / cost, np.median(best.lacking, axis=1))  # fmt: skip
            if gained > gain * cost:
                failed = 0
            if gained >= 0:
                best = state = looked(state)
                gained, away = 0.0, 0
                width[block] = min(WIDER * width[block], WIDEST)
        still = still + 1 if abs(change) <= gain * cost else 0
        if still == len(blocks):
            break
        if away == TOGETHER * len(blocks):
            state, gained, away, still = best, 0.0, 0, 0
            width = {own: bound / NARROWER for own, bound in width.items()}
            failed += 1
            if failed > REPEATED:
                break
    return looked(best) if best.values is start.values else best


def linear_evidence(there: Linear, gone: Collection[str] = ()) -> float:
    """Return the log evidence of one block, linearised at the fit, up to a constant.

    Args:
        there: `linear` of the fit.
        gone: names of priors that are omitted.
    """
    return relearnt(there, gone)[0]


def relearnt(there: Linear, gone: Collection[str] = ()) -> tuple[float, Posterior]:
    """Return that log evidence, and the posterior with prior scales learnt without those priors."""
    none = Group("none", np.zeros((len(there.start), 1)), 1.0, fixed=True)  # without any prior
    left = [group for group in there.groups if group.name not in gone] or [none]
    found = solve(there.normal, left, there.start, rounds=LEARN)
    moved = found.values - there.start
    total = float(there.normal.vector @ moved - 0.5 * moved @ there.normal.matrix @ moved)
    total += found.occam
    for rows in there.where.values():
        groups = [g for g in found.groups if g.basis[rows].any()]
        if groups:
            total -= 0.5 * _penalty(groups, rows, found.values[rows])
    return total, found


def evidence_of(state: State, good: Flags, shares: Array | None = None) -> float:
    """Return the evidence of a state by the readings of some BPMs, at the most probable model
    discrepancy and prior scales; up to a constant of the data.

    Args:
        state: to evaluate.
        good: the BPMs.
        shares: effective sample sizes, see `State.independent`; equal for states that are compared.
    """
    total = 0.0
    for block in (block for block in (1, 0) if state.reads(block)):
        state = replace(look(state, block), good=good, independent=shares)
        total += 0.5 * (log_scale(state, block) - _misfit(state, state, block))
        if state.of_block(block):
            total += linear_evidence(linear(state, block))
    return total
