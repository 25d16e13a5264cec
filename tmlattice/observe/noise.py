"""The noise of readings where nobody states it: from what neighbours leave unexplained.

Between two errors a trajectory is free: the reading of a monitor follows from those of the two
before it, in each plane. What is left of a reading has the noise of three, with known weights; the
median over all monitors does not see a few errors.
"""

import numpy as np
from numpy.typing import NDArray

from tmlattice.beam.model import Paths
from tmlattice.observe.data import Data

Array = NDArray[np.float64]

_MAD = 1.4826  # of a Gaussian


def local_misfit(data: Data, paths: Paths) -> Array:
    """Each reading's difference from the model less what its two predecessors make of it, divided
    by the norm of the weights, [shot, reading, 2]; NaN where it cannot be said."""
    difference = np.where(data.valid, data.readings - paths.readings, np.nan)
    result = np.full(difference.shape, np.nan)
    for plane, columns in ((0, (0, 1)), (1, (2, 3))):
        slope = paths.launch[:, :, plane][:, :, columns]  # [shot, reading, 2]
        first, second, third = slope[:, :-2], slope[:, 1:-1], slope[:, 2:]
        determinant = _cross(first, second)
        with np.errstate(divide="ignore", invalid="ignore"):
            a = _cross(third, second) / determinant
            b = _cross(first, third) / determinant
            size = np.sqrt(1 + a**2 + b**2)
            r = difference[:, :, plane]
            left = (r[:, 2:] - a * r[:, :-2] - b * r[:, 1:-1]) / size
        # where the weights are large, small model errors are too
        result[:, 2:, plane] = np.where(size < 10, left, np.nan)
    return result


def _cross(a: Array, b: Array) -> Array:
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])


def estimate(data: Data, paths: Paths) -> Array:
    """rms noise of one reading in x and y, m, [2]; NaN for a plane without enough readings."""
    misfit = local_misfit(data, paths)
    planes = [misfit[:, :, plane][np.isfinite(misfit[:, :, plane])] for plane in (0, 1)]
    return np.array([_MAD * np.median(np.abs(p)) if len(p) > 20 else np.nan for p in planes])
