"""Rows that distributed errors correlate are made white, and nuisances are projected out of them.

Inverse root of a covariance 1 + S^T S, which whitens rows with distributed errors. The cheaper of
two roots is used: the Cholesky factor (rows x rows), or, if errors are fewer than rows, the
symmetric root in the space of the errors: with S S^T = U L U^T

    (1 + S^T S)^(-1/2) = 1 + V ((1 + L)^(-1/2) - 1) V^T,   V = S^T U L^(-1/2),

which costs errors^2 x rows once and errors x rows for each row that is whitened.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag, eigh

from tmlattice.arrays import TINY, Array
from tmlattice.inference.normal import inverse_of_lower, lower_factor

ROUNDING = 1e-13
"""Share of a direction below which it is rounding, given the directions before it."""
SMALLEST_SHARE = 1e-12
"""Share of the largest variance below which a variance is rounding."""


@dataclass(frozen=True)
class Triangle:
    """Matrix W with W^T W = (1 + S^T S)^-1: the inverse of the Cholesky factor.

    Attributes:
        matrix: W, [row, row].
    """

    matrix: Array

    def white(self, rows: Array) -> Array:
        """Rows [..., row] times W^T."""
        return np.asarray(rows @ self.matrix.T)

    def back(self, rows: Array) -> Array:
        """Rows [..., row] times W."""
        return np.asarray(rows @ self.matrix)

    @property
    def information(self) -> Array:
        """Diagonal of W^T W: inverse variance of each row given all others, [row]."""
        return np.asarray((self.matrix**2).sum(axis=0))

    @property
    def log_scale(self) -> float:
        """Logarithm of the determinant of W."""
        return float(np.log(np.diagonal(self.matrix)).sum())


@dataclass(frozen=True)
class Symmetric:
    """The same as `Triangle` by a symmetric W, which is not formed.

    Attributes:
        directions: orthonormal, [direction, row].
        size: factor of W along them, [direction].
    """

    directions: Array
    size: Array

    def white(self, rows: Array) -> Array:
        """Rows [..., row] times W^T."""
        along = (rows @ self.directions.T) * (self.size - 1)
        return np.asarray(rows + along @ self.directions)

    back = white

    @property
    def matrix(self) -> Array:
        """W, [row, row]."""
        return self.white(np.eye(self.directions.shape[1]))

    @property
    def information(self) -> Array:
        """Diagonal of W^T W, [row]."""
        return np.asarray(1 - (1 - self.size**2) @ self.directions**2)

    @property
    def log_scale(self) -> float:
        """Logarithm of the determinant of W."""
        return float(np.log(self.size).sum())


Root = Triangle | Symmetric


def inverse_root(spread: Array) -> Root:
    """Return the inverse root of the rows' covariance.

    Args:
        spread: S, [error, row], signatures of errors of size 1.
    """
    errors, rows = spread.shape
    if errors >= rows:
        covariance = spread.T @ spread
        covariance[np.diag_indices(rows)] += 1.0
        return Triangle(inverse_of_lower(lower_factor(covariance)))
    values, directions = directions_of(spread)
    return Symmetric(directions, 1 / np.sqrt(1 + values))


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
    kept = values > SMALLEST_SHARE * values.max(initial=TINY)
    values = values[kept]
    return values, (vectors[:, kept] / np.sqrt(values)).T @ spread


class Projection:
    """Directions of the launches among whitened rows, by blocks of rows.

    Args:
        directions: d rows / d launch coordinates by block, see `observe.data.Whitening.launch`.

    Attributes:
        Q: orthonormal directions, [block, row, direction].
    """

    def __init__(self, directions: Array) -> None:
        self.Q, R = np.linalg.qr(directions)
        seen = np.abs(np.diagonal(R, axis1=1, axis2=2))  # [block, column]
        size = np.linalg.norm(directions, axis=1)
        few = directions.shape[1] < directions.shape[2]
        if few or (seen <= ROUNDING * size).any():  # QR would give an arbitrary direction
            scale = np.where(size > 0, size, 1.0)[:, None]
            U, s, V = np.linalg.svd(directions / scale, full_matrices=False)
            kept = s > ROUNDING * max(directions.shape[1:])
            self.Q = U * kept[:, None]
            R = (s * kept)[..., None] * V * scale
        self._blocks = list(zip(self.Q, R, strict=True))

    @property
    def rows(self) -> int:
        """Number of rows."""
        return sum(len(Q) for Q, _ in self._blocks)

    def _split(self, rows: Array) -> Iterator[tuple[Array, Array, slice]]:
        """Rows [data, row] of each block with directions, these, and where they are."""
        end = 0
        for Q, _ in self._blocks:
            own = slice(end, end + len(Q))
            end = own.stop
            if Q.shape[1]:
                yield rows[:, own], Q, own

    def out(self, rows: Array) -> Array:
        """Return rows [..., row] less the part that launches explain."""
        kept = rows.reshape(-1, rows.shape[-1]).copy()
        for part, Q, own in self._split(kept):
            kept[:, own] = part - (part @ Q) @ Q.T
        return kept.reshape(rows.shape)

    def matrix(self) -> Array:
        """Directions of all blocks, [row, coordinate]."""
        return np.asarray(block_diag(*(Q @ R for Q, R in self._blocks)))

    def blocks(self, together: bool = False) -> Iterator[tuple[slice, Array]]:
        """Yield rows, and directions there [row, coordinate], of each block, or of all together."""
        end = 0
        for own in (self.matrix(),) if together else (Q @ R for Q, R in self._blocks):
            yield slice(end, end + len(own)), own
            end += len(own)

    def inside(self, rows: Array) -> Array:
        """Square of the part of rows [..., row] that launches explain, [...]."""
        total = np.zeros(rows.shape[:-1]).ravel()
        for part, Q, _ in self._split(rows.reshape(-1, rows.shape[-1])):
            along = part @ Q
            total += np.einsum("hq,hq->h", along, along)
        return total.reshape(rows.shape[:-1])

    def coordinates(self, rows: Array) -> Array:
        """Changes of the launch coordinates that explain rows [row] best, one after another."""
        blocks = np.split(rows, np.cumsum([len(Q) for Q, _ in self._blocks])[:-1])
        return np.concatenate([
            np.linalg.lstsq(R, Q.T @ own, rcond=None)[0]
            for (Q, R), own in zip(self._blocks, blocks, strict=True)
        ])  # fmt: skip


class Blocks(Projection):
    """Projection of each part's nuisances out of its own rows.

    Args:
        parts: the projections, one after another.
    """

    def __init__(self, parts: Sequence[Projection]) -> None:
        self._blocks = [block for part in parts for block in part._blocks]
        self.sizes = [part.rows for part in parts]

    def split(self, rows: Array) -> list[Array]:
        """Return the rows [..., row] of each part."""
        return np.split(rows, np.cumsum(self.sizes)[:-1], axis=-1)
