"""How many of a response's readings tell something of their own, by what a fit leaves of them.

What a model lacks is no white noise: it is a few betatron waves, alike in many columns and at many
monitors. Evidence, errors and the sizes of priors that took each reading for independent would be
too sure by far, and fit what is lacking with whatever comes near it.

White noise spreads over all singular vectors of [column, monitor], waves over few: the
participation ratio of their squares counts them, and what white noise would have is known. (Of
C x M Gaussian numbers the squared singular values s have E sum s = C M, and E sum s^2 =
C M (C + M + 1).)
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

CLIPPED = 3.0
"""Of a typical reading: one that went wrong is no pattern of all."""
LEAST = 4
"""Columns and monitors that it takes to say so."""


def independent(left: Array, noise: Array) -> float:
    """Share of the readings that are independent, 1 where noise alone is left.

    Args:
        left: what a fit leaves, m, NaN where nothing was read, [column, monitor].
        noise: rms of each reading, m, [column, monitor].
    """
    seen = np.isfinite(left)
    left, noise = np.where(seen, left, 0.0), np.where(seen, noise, 0.0)
    rows, columns = seen.any(axis=1), seen.any(axis=0)
    left, noise, seen = (own[rows][:, columns] for own in (left, noise, seen))
    C, M = left.shape
    if min(C, M) < LEAST or not left.any():
        return 1.0
    lacking = max(1 - float(np.sum(noise**2) / np.sum(left**2)), 0.0)
    # one column, or monitor, that is worse than the others is no pattern either
    for axis in (1, 0, 1):
        typical = np.sum(left**2, axis=axis, keepdims=True) / seen.sum(axis=axis, keepdims=True)
        left = left / np.sqrt(np.maximum(typical, 1e-300))
    squares = np.linalg.svd(np.clip(left, -CLIPPED, CLIPPED), compute_uv=False) ** 2
    white = C * M / (C + M + 1)
    share = min(float(squares.sum() ** 2 / np.sum(squares**2)) / white, 1.0)
    return float(1 / (1 + lacking * (1 / share - 1)))
