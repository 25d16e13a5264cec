"""Closed orbit of a line that is tracked: Broyden's method from one Jacobian."""

from collections.abc import Callable, Sequence

import numpy as np

from tmlattice.arrays import Array
from tmlattice.beam.chain import NO_ORBIT
from tmlattice.errors import UnstableRingError

Turn = Callable[[Array], Array]
"""Moves states [6, shot] to the line's end, in place, and returns readings of the first of them."""

STEPS = np.array([3e-6, 3e-6, 3e-6, 3e-6, 1e-5, 1e-5])
"""Steps of the derivatives, m and 1: bends round x to 3e-14 m."""


def one_turn(turn: Turn, start: Array) -> Array:
    """Return the turn's matrix at a state [6], [6, 6], in AT's coordinates."""
    steps = np.diag(STEPS)
    beam = np.asfortranarray(np.vstack([start + steps, start - steps]).T)
    turn(beam)
    ends = beam.T
    return np.asarray((ends[:6] - ends[6:]).T / (2 * STEPS))


def closed(turn: Turn, start: Array, free: Sequence[int], late: float = 0.0) -> Array:
    """Find the state that returns to itself: free coordinates by Newton's method, others given.

    Args:
        start: near it, [6].
        free: free coordinates, which return: (0, 1, 2, 3) at a given energy, all six with the RF.
        late: excess of a turn over the RF's, m.
    """
    state, at = start.copy(), np.ix_(free, free)
    for _ in range(20):
        solve = np.zeros((6, 6))
        with np.errstate(invalid="ignore"):
            slopes = one_turn(turn, state)
        if not np.isfinite(slopes).all():
            break
        try:
            solve[at] = np.linalg.inv((np.eye(6) - slopes)[at])
        except np.linalg.LinAlgError:
            break
        beam = np.array(state[:, None], order="F")
        turn(beam)
        miss = beam[:, 0] - state
        miss[5] -= late
        change = solve @ miss
        if np.abs(change).max() < 1e-11:
            return state
        state += change
    raise UnstableRingError(NO_ORBIT)


def stored(turn: Turn) -> tuple[Array, Array]:
    """Return the unset ring's closed orbit [6] and its correction for a turn's mismatch, [6, 6]."""
    start = np.zeros(6)
    for _ in range(3):
        slopes = one_turn(turn, start)[:, :5]
        rows = [0, 1, 2, 3, 5]
        solve = np.zeros((6, 6))
        try:
            solve[:5, rows] = np.linalg.inv((np.eye(6)[:, :5] - slopes)[rows])
        except np.linalg.LinAlgError:
            raise UnstableRingError(NO_ORBIT) from None
        start = settle(turn, start, solve, 0.0, 1e-6)[0]
    return settle(turn, start, solve, 0.0)[0], solve


def settle(
    turn: Turn, start: Array, solve: Array, late: float, tolerance: float = 2e-12
) -> tuple[Array, Array]:
    """Return the closed state [6] and its readings [monitor, 2], by Broyden's method."""
    state, change, before = start.copy(), np.zeros(6), np.zeros(6)
    for step in range(60):
        beam = np.array(state[:, None], order="F")
        readings = turn(beam)
        miss = beam[:, 0] - state
        miss[5] -= late
        if not np.isfinite(readings).all() or not np.isfinite(miss).all():
            break
        if step:  # Broyden's update of the inverse Jacobian
            learned = solve @ (before - miss)
            weight = change @ solve
            below = weight @ (before - miss)
            if below:
                solve = solve + np.outer(change - learned, weight) / below
        change, before = solve @ miss, miss
        if np.abs(change).max() < tolerance:
            return state, readings
        state += change
    raise UnstableRingError(NO_ORBIT)
