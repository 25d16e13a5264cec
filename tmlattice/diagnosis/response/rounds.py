"""The rounds of a hierarchical fit: one damped Gauss-Newton of all parameters, in which the prior
scales of the families and the variance components of the readings are learnt.

>>> state = settle(bend(jump(allow(state, families))))
>>> state.outcome
<Outcome.CONVERGED: 'converged'>
"""

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tmlattice.diagnosis.response.linear import Linear, gathered, linear
from tmlattice.diagnosis.response.state import Outcome, State
from tmlattice.diagnosis.response.weights import (
    Spent,
    learnt,
    log_likelihood,
    patterns,
    weight,
)
from tmlattice.errors import TmlatticeError
from tmlattice.inference.common import common, times_precision
from tmlattice.inference.normal import Posterior, inverse_of_lower, solve
from tmlattice.inference.priors import Group

Array = NDArray[np.float64]

log = logging.getLogger(__name__)

ROUNDS = 40
"""Rounds of a fit at most."""
GAIN = 1e-4
"""Relative gain of a round below which a fit has converged: half a unit in 5000 readings. Prior
scales and weak directions converge last, and contribute some ten units."""
EACH = 4
"""Fisher steps of the prior scales in a round of the fit."""
RETRIES, SHORTER, LONGER, LONGEST = 6, 4.0, 2.0, 8.0
"""Repetitions of a step that raised the cost; factors by which the step bounds fall then and grow
otherwise, and their largest value."""
CORRECTED, CORRECTS = 6, 1e-3
"""Corrections of a round's step by the residuals at its end, with the derivatives of its start; and
the least gain for another one. Correlated numbers move along a narrow, bent valley, and a tangent
step leaves it."""
HELD = 4
"""Repetitions of the solution with numbers held at their bounds."""

Weights = tuple[Array, Array]


class Moved(NamedTuple):
    """A state after a round, the cost before and after, and each block's solution."""

    state: State
    before: float
    after: float
    found: Mapping[int, Posterior]


def one_round(state: State, blocks: Mapping[int, Linear], bold: float = 1.0) -> Moved:
    """Solve the readings of both blocks, and take the step.

    Args:
        state: the start.
        blocks: `linear` of each block that has families.
        bold: factor of every step bound: small after rounds that raised the cost.
    """
    found = {block: _within(there, bold) for block, there in blocks.items()}
    groups = {group.name: group for own in found.values() for group in own.groups}
    learnt_priors = replace(state, groups={**state.groups, **groups})
    weights = {block: _weights(state, block) for block in (0, 1)}

    def cost(at: State) -> float:
        total = 0.0
        for block, own in weights.items():
            left = np.where(own[0] > 0, state.data.pick(at.at.left, block), 0.0)
            total += float(np.sum(left * times_precision(*own, left)))
        for block, there in blocks.items():
            for name, rows in there.where.items():
                priors = [g for g in found[block].groups if g.basis[rows].any()]
                total += _penalty(priors, rows, at.values[name])
        return total

    best = Moved(learnt_priors, cost(state), np.inf, found)
    aims = {block: own.values for block, own in found.items()}
    for _ in range(CORRECTED + 1):
        values = dict(state.values)
        for block, there in blocks.items():
            values |= {
                name: np.maximum(aims[block][at], there.lowest[at])
                for name, at in there.where.items()
            }
        try:
            then = learnt_priors.moved(values)
            after = cost(then)
        except (TmlatticeError, np.linalg.LinAlgError):  # no beam is stored there
            break
        last = best.after
        if after <= last:
            best = best._replace(state=then, after=after)
        if not after <= (1 - CORRECTS) * last:
            break
        aims = {
            block: _corrected(then, block, there, found[block], weights[block], bold)
            for block, there in blocks.items()
        }
    return best


def _weights(state: State, block: int) -> Weights:
    """Weights of the readings, and their reduction by common modes."""
    own = weight(state, block)
    return own, common(own, patterns(state, block))[0]


def _corrected(
    then: State, block: int, there: Linear, found: Posterior, weights: Weights, bold: float
) -> Array:
    """Values by the residuals at the end of a step, with the derivatives of its start."""
    moved = np.zeros_like(there.start)
    for name, at in there.where.items():
        moved[at] = then.values[name] - there.start[at]
    data = then.data
    left = times_precision(*weights, data.pick(then.at.left, block))
    vector = gathered(there, data.plane_of(block), left) + there.normal.matrix @ moved
    bounds = bold * there.trust
    return found.solved(vector + there.normal.matrix @ there.start + there.start / bounds**2)


def _within(there: Linear, bold: float) -> Posterior:
    """The step, with numbers that would exceed their bounds held there."""
    groups, trust = there.groups, bold * there.trust
    for _ in range(HELD):
        found = solve(there.normal, groups, there.start, trust, rounds=EACH)
        low = found.values < there.lowest
        if not low.any():
            break
        rest = ~low[:, None]
        groups = tuple(replace(group, basis=group.basis * rest) for group in groups)
    return found


def _penalty(groups: Sequence[Group], rows: slice, values: Array) -> float:
    """The prior's gradient for the values of one variable; its priors add up."""
    if not groups:  # the ring has no such numbers
        return 0.0
    each, shared = np.zeros(len(values)), []
    for group in groups:
        spread = group.basis[rows] * group.scale
        own = spread.any(axis=1)
        if _of_each(spread) and not each[own].any():
            each += np.abs(spread).sum(axis=1)
        else:
            shared.append(spread)
    free = each > 0  # held numbers are skipped
    if not free.any():
        spread = np.concatenate(shared, axis=1)
        return float(np.sum(np.linalg.lstsq(spread, values, rcond=1e-9)[0] ** 2))
    # after shared ones, each number's own prior has the rest
    rest, scale = values[free] / each[free], each[free, None]
    few = np.concatenate([np.zeros((len(rest), 0)), *(own[free] / scale for own in shared)], axis=1)
    asked = np.concatenate([rest, np.zeros(few.shape[1])])
    amounts = np.linalg.lstsq(np.concatenate([few, np.eye(few.shape[1])]), asked, rcond=None)[0]
    return float(np.sum((rest - few @ amounts) ** 2) + amounts @ amounts)


def _of_each(spread: Array) -> bool:
    """Whether a group has one parameter for each of its numbers."""
    there = spread != 0
    return bool((there.sum(axis=0) <= 1).all() and (there.sum(axis=1) <= 1).all())


def settle(
    state: State,
    most: int = ROUNDS,
    gain: float = GAIN,
    possible: Callable[[State], bool] = lambda state: True,
    alike: bool = False,
) -> State:
    """Repeat rounds until none gains; none of them raises the cost.

    As Levenberg and Marquardt have it, but that the bound of a step is a change of each number by
    itself: a round that raised the cost is taken back and repeated with shorter steps.

    Args:
        state: the start.
        most: rounds.
        gain: share of the cost that a round has to gain for another one.
        possible: whether a state is one that is sought; rounds end at one that is not.
        alike: all columns, and all monitors, have the same misfit, see `weights.learnt`.
    """
    bold, outcome = 1.0, Outcome.ROUNDS
    for turn in range(most):
        blocks = {block: linear(state, block) for block in (0, 1) if state.of_block(block)}
        kept = {name: own for there in blocks.values() for name, own in there.kept.items()}
        state = replace(state, kept={**state.kept, **kept})
        for _ in range(RETRIES):
            moved = one_round(state, blocks, bold)
            if moved.after <= moved.before:
                break
            bold /= SHORTER
        else:
            outcome = Outcome.STUCK
            break
        bold = min(LONGER * bold, LONGEST)
        gained = (moved.before - moved.after) / max(moved.after, 1e-300)
        spent = {block: _spent(state, block, there, moved.found[block])
                 for block, there in blocks.items()}  # fmt: skip
        state = learnt(moved.state, spent, alike)
        log.info("round %d gained %.3g of %.4g, misfit %s m", turn, gained, moved.after,
                 np.sqrt(np.median(state.noise.column, axis=1)))  # fmt: skip
        if gained < gain or not possible(state):
            outcome = Outcome.CONVERGED
            break
    return replace(state, outcome=outcome)


def _spent(state: State, block: int, there: Linear, found: Posterior) -> Spent:
    """Degrees of freedom of the parameters, and those of the RF's orbit."""
    half = inverse_of_lower(found.factor)
    total = len(found.prior) - float(np.sum(half**2))
    column = len(state.data.plane) - 1
    own = weight(state, block)[[column]]
    seen = np.flatnonzero(own[0])
    if not len(seen):
        return Spent(total, 0.0)
    rows = there.of_column(column, seen, int(state.data.plane_of(block)[column])) @ found.spread
    return Spent(total, float(np.sum((rows @ half.T) ** 2, axis=1) @ own[0, seen]))


def log_evidence(state: State) -> float:
    """The log evidence of the fitted readings (Laplace), up to a constant of the data.

    Args:
        state: converged; states that are compared use the same monitors.
    """
    total = 0.0
    for block in (0, 1):
        total += log_likelihood(state, block)
        if state.of_block(block):
            there = linear(state, block)
            found = solve(there.normal, there.groups, there.start, rounds=0)
            total += found.occam - 0.5 * sum(
                _penalty([g for g in there.groups if g.basis[rows].any()], rows, state.values[name])
                for name, rows in there.where.items()
            )
    return total
