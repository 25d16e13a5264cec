"""Readings of a column with common modes: patterns, each with an unknown amount.

Amounts are standard Gaussians and are integrated out. A column with weights W and patterns P (at
their typical size) has the inverse covariance

    (W^-1 + P^T P)^-1 = W - L L^T,   L = W P^T R^-T,   R R^T = 1 + P W P^T.
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def _root(weight: Array, patterns: Array) -> tuple[Array, Array]:
    """P W [column, pattern, monitor], and R [column, pattern, pattern]."""
    weighted = patterns * weight[:, None]
    inside = weighted @ patterns.transpose(0, 2, 1) + np.eye(patterns.shape[1])
    return weighted, np.asarray(np.linalg.cholesky(inside))


def common(weight: Array, patterns: Array) -> tuple[Array, Array]:
    """Low-rank part of the inverse covariance of columns with common modes.

    Args:
        weight: 1 / variance of each reading's independent noise, [column, monitor].
        patterns: common modes at their typical size, [column, pattern, monitor].

    Returns:
        L, [column, monitor, pattern]: diag(weight) - L L^T is the inverse covariance of a column.
        Logarithm of the determinant of W^-1 + P^T P over that of W^-1, [column].
    """
    weighted, root = _root(weight, patterns)
    taken = np.linalg.solve(root, weighted).transpose(0, 2, 1)
    return np.asarray(taken), 2 * np.log(np.einsum("ckk->ck", root)).sum(axis=1)


def amounts(weight: Array, patterns: Array, residual: Array) -> tuple[Array, Array]:
    """Most probable amounts of common modes, [column, pattern], and their covariances.

    Args:
        weight, patterns: as in `common`.
        residual: [column, monitor]; ignored where the weight is 0.

    Returns:
        [column, pattern], and [column, pattern, pattern].
    """
    weighted, root = _root(weight, patterns)
    half = np.linalg.inv(root)
    covariance = half.transpose(0, 2, 1) @ half
    score = np.einsum("ckm,cm->ck", weighted, np.where(weight > 0, residual, 0.0))
    return np.einsum("ckl,cl->ck", covariance, score), covariance


def times_precision(weight: Array, taken: Array, residual: Array) -> Array:
    """Inverse covariance times a residual, [column, monitor].

    Args:
        weight: of each reading, 0 where missing, [column, monitor].
        taken: L of `common`, [column, monitor, pattern].
        residual: [column, monitor].
    """
    residual = np.where(weight > 0, residual, 0.0)
    shared = np.einsum("cmk,cm->ck", taken, residual)
    return np.asarray(weight * residual - np.einsum("cmk,ck->cm", taken, shared))
