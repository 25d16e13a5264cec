"""Inverse root of a covariance 1 + S^T S, which whitens rows with distributed errors.

The cheaper of two roots is used: the Cholesky factor (rows x rows), or, if errors are fewer than
rows, the symmetric root in the space of the errors: with S S^T = U L U^T

    (1 + S^T S)^(-1/2) = 1 + V ((1 + L)^(-1/2) - 1) V^T,   V = S^T U L^(-1/2),

which costs errors^2 x rows once and errors x rows for each row that is whitened.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cholesky, eigh
from scipy.linalg.lapack import dtrtri

Array = NDArray[np.float64]

ROUNDING = 1e-12
"""Share of the largest variance below which a variance is rounding."""


class Root(ABC):
    """Matrix W with W^T W = (1 + S^T S)^-1."""

    @abstractmethod
    def white(self, rows: Array) -> Array:
        """Rows [..., row] times W^T."""

    @abstractmethod
    def back(self, rows: Array) -> Array:
        """Rows [..., row] times W."""

    @property
    @abstractmethod
    def matrix(self) -> Array:
        """W itself, [row, row]."""

    @property
    @abstractmethod
    def log_scale(self) -> float:
        """Logarithm of the determinant of W."""


@dataclass(frozen=True)
class _Triangle(Root):
    inverse: Array  # of the Cholesky factor, [row, row]

    def white(self, rows: Array) -> Array:
        return np.asarray(rows @ self.inverse.T)

    def back(self, rows: Array) -> Array:
        return np.asarray(rows @ self.inverse)

    @property
    def matrix(self) -> Array:
        return self.inverse

    @property
    def log_scale(self) -> float:
        return float(np.log(np.diagonal(self.inverse)).sum())


@dataclass(frozen=True)
class _Symmetric(Root):
    directions: Array  # orthonormal, [direction, row]
    size: Array  # along them, [direction]

    def white(self, rows: Array) -> Array:
        along = (rows @ self.directions.T) * (self.size - 1)
        return np.asarray(rows + along @ self.directions)

    def back(self, rows: Array) -> Array:
        return self.white(rows)

    @property
    def matrix(self) -> Array:
        return self.white(np.eye(self.directions.shape[1]))

    @property
    def log_scale(self) -> float:
        return float(np.log(self.size).sum())


def inverse_root(spread: Array) -> Root:
    """Return the inverse root of the rows' covariance.

    Args:
        spread: S, [error, row], signatures of errors of size 1.
    """
    errors, rows = spread.shape
    if errors >= rows:
        covariance = spread.T @ spread
        covariance[np.diag_indices(rows)] += 1.0
        factor = cholesky(covariance, lower=True, overwrite_a=True, check_finite=False)
        inverse, failed = dtrtri(factor, lower=1, overwrite_c=1)
        assert failed == 0
        return _Triangle(np.tril(inverse))
    values, directions = directions_of(spread)
    return _Symmetric(directions, 1 / np.sqrt(1 + values))


def directions_of(spread: Array) -> tuple[Array, Array]:
    """Orthonormal directions of the rows that errors of size 1 move.

    Args:
        spread: S, [error, row].

    Returns:
        The variance along each, [direction]; and the directions, [direction, row].
    """
    errors, rows = spread.shape
    if errors >= rows:
        values, vectors = eigh(spread.T @ spread, overwrite_a=True, check_finite=False)
        return np.maximum(values, 0.0), vectors.T
    values, vectors = eigh(spread @ spread.T, overwrite_a=True, check_finite=False)
    kept = values > ROUNDING * values.max(initial=1e-300)
    values = values[kept]
    return values, (vectors[:, kept] / np.sqrt(values)).T @ spread
