"""Whether an RF's orbit was read by monitors, or is what a model has for it.

A file of a response without a measured dispersion may carry the design's in its place: in a ring of
equal cells it repeats from cell to cell, to the last digit, where readings have noise.
"""

import numpy as np
from numpy.typing import NDArray

from tmlattice.measurement import OrbitResponse

Array = NDArray[np.float64]

SAME = 1e-9
"""Of the largest reading: what is nearer to another is the same number, computed twice."""
FEW, ENOUGH = 0.5, 0.75
"""Share of numbers that differ, at most, of what was computed; and at least of the correctors'
orbits, which are read with the same digits."""
NEARER = 0.05
"""Of the noise, rms: no reading is so near to a model."""
LEAST = 6
"""Monitors that it takes to say so."""


def read(measured: OrbitResponse) -> bool:
    """Whether monitors read an orbit of an RF step."""
    if measured.rf is None or measured.rf.orbit is None:
        return False
    in_x = [plane == "x" for plane in measured.planes]
    return not computed(measured.rf.orbit[:, 0], measured.response[in_x, :, 0])


def computed(orbit: Array, response: Array) -> bool:
    """Whether the numbers of an RF's orbit repeat as no readings do.

    Args:
        orbit: in x, m, [monitor], NaN where nothing was read.
        response: of the correctors that kick in x, m, [column, monitor].
    """
    columns = [_differ(own) for own in response]
    if np.isfinite(orbit).sum() < LEAST or not columns:
        return False
    return _differ(orbit) <= FEW and bool(np.median(columns) >= ENOUGH)


def of_design(orbit: Array, design: Array, noise: Array) -> bool:
    """Whether an RF's orbit is the design's own: nearer to it than readings are to the truth.

    Args:
        orbit: m, [monitor, 2], NaN where nothing was read.
        design: what the design makes of it, m, [monitor, 2].
        noise: of a reading, m, [monitor, 2].
    """
    apart = (orbit - design)[:, 0] / noise[:, 0]
    apart = apart[np.isfinite(apart)]
    return len(apart) >= LEAST and bool(np.sqrt(np.mean(apart**2)) < NEARER)


def _differ(read: Array) -> float:
    """Share of numbers that differ from all others."""
    there = np.sort(read[np.isfinite(read)])
    if not len(there):
        return 0.0
    apart = np.diff(there) > SAME * np.abs(there).max()
    return float(1 + apart.sum()) / len(there)
