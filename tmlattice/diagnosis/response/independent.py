"""Effective sample size of the residuals of an orbit response.

Model discrepancy is not white: it is a few betatron oscillations, common to many columns and BPMs.
If each residual counted as independent, evidence and errors would be overconfident, and the
discrepancy would be fitted by unrelated parameters.

White noise spreads over all singular vectors of the residual [column, monitor], betatron
oscillations over few. The participation ratio of the squared singular values counts them, relative
to its expectation for white noise. (For C x M Gaussian numbers the squared singular values s have E
sum s = C M and E sum s^2 = C M (C + M + 1).)
"""

import numpy as np

from tmlattice.arrays import TINY, Array
from tmlattice.inference.judgement import FEW

CLIPPED = 3.0
"""Limit of a residual, in units of the typical one: an outlier is no common pattern."""


def independent(left: Array, noise: Array) -> float:
    """Return the effective sample size as a share of the readings; 1 if the residual is noise.

    Args:
        left: residuals of a fit, m, NaN where nothing was read, [column, monitor].
        noise: rms noise of each reading, m, [column, monitor].
    """
    seen = np.isfinite(left)
    left, noise = np.where(seen, left, 0.0), np.where(seen, noise, 0.0)
    rows, columns = seen.any(axis=1), seen.any(axis=0)
    left, noise, seen = (own[rows][:, columns] for own in (left, noise, seen))
    C, M = left.shape
    if min(C, M) < FEW or not left.any():
        return 1.0
    lacking = max(1 - float(np.sum(noise**2) / np.sum(left**2)), 0.0)
    # a column or BPM with large residuals is no common pattern either
    for axis in (1, 0, 1):
        typical = np.sum(left**2, axis=axis, keepdims=True) / seen.sum(axis=axis, keepdims=True)
        left = left / np.sqrt(np.maximum(typical, TINY))
    squares = np.linalg.svd(np.clip(left, -CLIPPED, CLIPPED), compute_uv=False) ** 2
    white = C * M / (C + M + 1)
    share = min(float(squares.sum() ** 2 / np.sum(squares**2)) / white, 1.0)
    return float(1 / (1 + lacking * (1 / share - 1)))
