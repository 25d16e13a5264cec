"""Where the beam is at the monitors, turn after turn, for stacked weights of any making."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from tmlattice.beam import sweeps
from tmlattice.beam.sweeps import curved

Array = NDArray[np.float64]

APERTURE = 0.05
"""m; a beam that is further from the axis at a magnet's exit is lost."""


def positions(
    launches: Array,
    turns: int,
    weights: Sequence[Array],
    readouts: Sequence[Array],
    at: NDArray[np.int64],
    aperture: float = APERTURE,
) -> Array:
    """(x, y) at every monitor on every turn, [shot, turn, monitor, 2], m; NaN once lost.

    Args:
        launches: [shot, n].
        turns: at least 1.
        weights: W0, W1, W2 of the whole turn, the way to the ring's end included.
        readouts: R0, R1, R2 of the monitors.
        at: the exit that each monitor hangs on, rising.
        aperture: m.
    """
    n = launches.shape[1]
    size = sweeps.size_of(n, len(launches))
    lanes = len(size[1])
    states = np.empty((-(-len(launches) // lanes), len(weights[0]) + 1, n, lanes))
    states[:, 0] = sweeps.pack(launches, lanes)
    readings = np.empty((len(states), len(at), 2, lanes))
    beam = np.empty((len(launches), turns, len(at), 2))
    bends, bent = curved(weights[2]), curved(readouts[2])
    alive = np.ones(len(launches), dtype=bool)
    for turn in range(turns):
        sweeps.run(sweeps.forward, len(states), size, *weights, bends, states)
        sweeps.run(sweeps.read, len(states), size, *readouts, bent, at, states, readings)
        beam[:, turn] = sweeps.unpack(readings, len(launches))
        inside = np.abs(states[:, :, 0:3:2]).max(axis=2) < aperture  # [block, exit, lane]
        inside = sweeps.unpack(np.logical_and.accumulate(inside, axis=1), len(launches))
        beam[:, turn][~(inside[:, at] & alive[:, None])] = np.nan
        alive &= inside[:, -1]
        states[:, 0] = states[:, -1]
    return beam
