"""Whether an RF orbit was measured or computed by a model.

A file of a response without a measured dispersion may contain the design's. In a ring of equal
cells that repeats from cell to cell to the last digit, whereas readings have noise.
"""

import numpy as np
from numpy.typing import NDArray

from tmlattice.measurement import OrbitResponse

Array = NDArray[np.float64]

SAME = 1e-9
"""Share of the largest reading within which two numbers are the same computed one."""
MAX_DISTINCT, MIN_DISTINCT = 0.5, 0.75
"""Share of distinct numbers: at most, in a computed orbit; at least, in the correctors' orbits,
which have the same number of digits."""
MAX_MISFIT = 0.05
"""rms misfit over noise that no measured orbit reaches."""
MIN_MONITORS = 6
"""Monitors for a decision, at least."""


def read(measured: OrbitResponse) -> bool:
    """Whether an orbit of an RF step was measured."""
    if measured.rf is None or measured.rf.orbit is None:
        return False
    in_x = [plane == "x" for plane in measured.planes]
    return not computed(measured.rf.orbit[:, 0], measured.response[in_x, :, 0])


def computed(orbit: Array, response: Array) -> bool:
    """Whether the numbers of an RF orbit repeat as no readings do.

    Args:
        orbit: in x, m, [monitor], NaN where missing.
        response: of the correctors that kick in x, m, [column, monitor].
    """
    columns = [_differ(own) for own in response]
    if np.isfinite(orbit).sum() < MIN_MONITORS or not columns:
        return False
    return _differ(orbit) <= MAX_DISTINCT and bool(np.median(columns) >= MIN_DISTINCT)


def of_design(orbit: Array, design: Array, noise: Array) -> bool:
    """Whether an RF orbit is the design's: nearer to it than readings are to the truth.

    Args:
        orbit: m, [monitor, 2], NaN where missing.
        design: orbit of the design, m, [monitor, 2].
        noise: of a reading, m, [monitor, 2].
    """
    apart = (orbit - design)[:, 0] / noise[:, 0]
    apart = apart[np.isfinite(apart)]
    return len(apart) >= MIN_MONITORS and bool(np.sqrt(np.mean(apart**2)) < MAX_MISFIT)


def _differ(read: Array) -> float:
    """Share of numbers that differ from all others."""
    there = np.sort(read[np.isfinite(read)])
    if not len(there):
        return 0.0
    apart = np.diff(there) > SAME * np.abs(there).max()
    return float(1 + apart.sum()) / len(there)
