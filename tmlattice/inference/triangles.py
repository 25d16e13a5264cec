"""Triangular factors by LAPACK without copies and checks, which dominate for small matrices.

>>> factor = lower_factor(matrix)
>>> covariances = np.einsum("ij,ij->j", half := inverse_of_lower(factor), half)  # the diagonal
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.blas import dtrmm
from scipy.linalg.lapack import dpotrf, dtrtri

Array = NDArray[np.float64]

MAX_LAPACK = 96
"""Largest number of rows for which LAPACK's inversion is as fast as products of blocks."""


def lower_factor(matrix: Array) -> Array:
    """L of L L^T, [n, n]; the symmetric matrix is overwritten.

    Raises:
        LinAlgError: the matrix is not positive definite.
    """
    factor, wrong = dpotrf(matrix.T, lower=1, overwrite_a=1)
    if wrong:
        raise np.linalg.LinAlgError("a matrix of normal equations is not positive definite")
    return np.asarray(factor)


def inverse_of_lower(factor: Array) -> Array:
    """L^-1, [n, n], mostly by products of blocks, twice as fast as LAPACK's inversion."""
    n = len(factor)
    if n <= MAX_LAPACK:
        return np.asarray(dtrtri(factor, lower=1)[0])
    half = n // 2
    first, second = inverse_of_lower(factor[:half, :half]), inverse_of_lower(factor[half:, half:])
    between: Any = dtrmm(1.0, first, factor[half:, :half], side=1, lower=1)
    out = np.zeros_like(factor, order="F")
    out[:half, :half], out[half:, half:] = first, second
    out[half:, :half] = dtrmm(-1.0, second, between, lower=1)
    return out
