"""The closed orbit of a line that can be tracked: Broyden's method from one Jacobian."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from tmlattice.errors import UnstableRingError

Array = NDArray[np.float64]
Turn = Callable[[Array], Array]
"""Takes states [6, shot] to the line's end, in place, and returns readings of the first of them."""

_NO_ORBIT = (
    "no closed orbit: the search does not settle; the ring is at an integer resonance, or its "
    "kicks are too large"
)


def stored(turn: Turn) -> tuple[Array, Array]:
    """The unset ring's closed orbit [6] and what makes good a miss of the turn, [6, 6]."""
    steps = np.diag([3e-6, 3e-6, 3e-6, 3e-6, 1e-5, 1.0])[:5]  # bends round x to 3e-14 m
    start = np.zeros(6)
    for _ in range(3):
        beam = np.asfortranarray(np.vstack([start + steps, start - steps]).T)
        turn(beam)
        ends = beam.T
        slopes = (ends[:5] - ends[5:]).T / (2 * steps[range(5), range(5)])
        rows = [0, 1, 2, 3, 5]
        solve = np.zeros((6, 6))
        try:
            solve[:5, rows] = np.linalg.inv((np.eye(6)[:, :5] - slopes)[rows])
        except np.linalg.LinAlgError:
            raise UnstableRingError(_NO_ORBIT) from None
        start = settle(turn, start, solve, 0.0, 1e-6)[0]
    return settle(turn, start, solve, 0.0)[0], solve


def settle(
    turn: Turn, start: Array, solve: Array, late: float, tolerance: float = 2e-12
) -> tuple[Array, Array]:
    """Broyden's method from a given Jacobian: the state [6] and its readings [monitor, 2]."""
    state, change, before = start.copy(), np.zeros(6), np.zeros(6)
    for step in range(60):
        beam = np.array(state[:, None], order="F")
        readings = turn(beam)
        miss = beam[:, 0] - state
        miss[5] -= late
        if not np.isfinite(readings).all() or not np.isfinite(miss).all():
            break
        if step:  # Broyden: the Jacobian's inverse learns from what the last change did
            learned = solve @ (before - miss)
            weight = change @ solve
            below = weight @ (before - miss)
            if below:
                solve = solve + np.outer(change - learned, weight) / below
        change, before = solve @ miss, miss
        if np.abs(change).max() < tolerance:
            return state, readings
        state += change
    raise UnstableRingError(_NO_ORBIT)
