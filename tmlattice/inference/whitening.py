"""Readings in units of their noise, with the launches projected out.

Noise is independent, and, if asked for, correlated by distributed errors that are the same in all
shots: C = sigma^2 + sum_h tau_h^2 s_h s_h^T. Launches are nuisance parameters: their directions are
projected out of data and signatures. Prior knowledge of a launch adds rows: [shot, 2 readings + 5
coordinates], flattened.

Inverse root of a covariance 1 + S^T S, which whitens rows with distributed errors. The cheaper of
two roots is used: the Cholesky factor (rows x rows), or, if errors are fewer than rows, the
symmetric root in the space of the errors: with S S^T = U L U^T

    (1 + S^T S)^(-1/2) = 1 + V ((1 + L)^(-1/2) - 1) V^T,   V = S^T U L^(-1/2),

which costs errors^2 x rows once and errors x rows for each row that is whitened.
"""

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Sequence
from copy import copy
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from scipy.linalg import block_diag, eigh

from tmlattice.arrays import TINY, Array, Flags
from tmlattice.inference.normal import inverse_of_lower, lower_factor

EXACT = 1e-12
"""m, rad or relative: rms of a launch coordinate that is known exactly."""
ROUNDING = 1e-13
"""Share of a direction below which it is rounding, given the directions before it."""
SMALLEST_SHARE = 1e-12
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
    def information(self) -> Array:
        """Diagonal of W^T W: inverse variance of each row given all others, [row]."""

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
    def information(self) -> Array:
        return np.asarray((self.inverse**2).sum(axis=0))

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
    def information(self) -> Array:
        return np.asarray(1 - (1 - self.size**2) @ self.directions**2)

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
        return _Triangle(inverse_of_lower(lower_factor(covariance)))
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
    kept = values > SMALLEST_SHARE * values.max(initial=TINY)
    values = values[kept]
    return values, (vectors[:, kept] / np.sqrt(values)).T @ spread


class Readings(Protocol):
    """Data of a whitening, see `observe.data.Data`."""

    @property
    def valid(self) -> Flags:
        """Valid readings, [shot, reading, 2]."""

    @property
    def sigma(self) -> Array:
        """Noise of each reading, m, [shot, reading, 2]."""

    @property
    def launches(self) -> Array:
        """Nominal launches, [shot, 5]."""

    @property
    def launch_sigma(self) -> Array:
        """rms of the launches; inf: unknown, 0: exact, [shot, 5]."""


class Whitening:
    """Division by the noise, or by the Cholesky factor of its covariance.

    Args:
        data: readings and their noise, launches and their priors.

    Attributes:
        columns: free coordinates of the launch.
        rows: length of a whitened vector.
    """

    def __init__(self, data: Readings) -> None:
        self.weight = np.where(data.valid, 1.0 / data.sigma, 0.0)
        self.shots = len(data.valid)
        sigma = np.maximum(data.launch_sigma, EXACT)
        self.columns = np.flatnonzero((data.launch_sigma > 0).any(axis=0))
        self._prior = np.where(np.isfinite(sigma), 1.0 / sigma, 0.0)  # [shot, 5]
        self._prior[:, (data.launch_sigma == 0).all(axis=0)] = 0.0
        self._nominal = data.launches
        self.rows = self.shots * (self.weight[0].size + 5)
        self._inverse: Array | None = None  # of the Cholesky factor: faster than solving

    def correlated(self, root: Array) -> "Whitening":
        """Return the whitening of readings that distributed errors correlate.

        Args:
            root: W of `inference.root` over all rows, those of the launches too, [row, row].
        """
        other = copy(self)
        readings = np.arange(self.rows).reshape(self.shots, -1)[:, :-5].ravel()
        other.__dict__.pop("precision", None)
        other._inverse = root[np.ix_(readings, readings)]
        return other

    @property
    def dense(self) -> bool:
        """Whether readings of different shots are correlated."""
        return self._inverse is not None

    @cached_property
    def precision(self) -> Array:
        """Inverse covariance of readings in units of their own noise, all shots, [row, row]."""
        assert self._inverse is not None
        return np.asarray(self._inverse.T @ self._inverse)

    def projected_precision(self, projection: "Projection") -> Array:
        """The precision less what launches explain, in units of the readings' noise, [row, row]."""
        assert self._inverse is not None
        _, rows, width = projection.Q.shape
        Q = projection.Q[0].reshape(self.shots, rows // self.shots, width)[:, :-5]
        along = self._inverse.T @ Q.reshape(len(self._inverse), width)
        return np.asarray(self.precision - along @ along.T)

    def back(self, rows: Array) -> Array:
        """Adjoint of `signature`: whitened rows [..., shot, reading * 2] as [..., shot, reading,
        2], 1 / m."""
        flat = rows.reshape(*rows.shape[:-2], -1)
        if self._inverse is not None:
            flat = flat @ self._inverse
        return np.asarray(self.weight * flat.reshape(*rows.shape[:-2], *self.weight.shape))

    def _flat(self, x: Array) -> Array:
        rows = (self.weight * x).reshape(*x.shape[:-3], -1)
        if self._inverse is None:
            return np.asarray(rows)
        flat = rows.reshape(-1, rows.shape[-1])
        return np.asarray(flat @ self._inverse.T).reshape(rows.shape)

    def signature(self, x: Array) -> Array:
        """x [..., shot, reading, 2] in m as rows [..., row]; zero in the launch's rows."""
        flat = self._flat(x)
        out = np.zeros((*flat.shape[:-1], self.shots, self.weight[0].size + 5))
        out[..., :-5] = flat.reshape(*flat.shape[:-1], self.shots, -1)
        return out.reshape(*flat.shape[:-1], -1)

    def residual(self, difference: Array, launches: Array) -> Array:
        """Readings less model [shot, reading, 2], and nominal less fitted launches, as rows."""
        rows = self.signature(difference).reshape(self.shots, -1)
        rows[:, -5:] = self._prior * (self._nominal - launches)
        return rows.reshape(-1)

    def launch(self, slopes: Array) -> Array:
        """d rows / d free launch coordinates from d readings / d launch [shot, reading, 2, 5].

        Returns:
            [shot, row of the shot, column]; where shots are correlated, one block for all:
            [1, row, shot * column].
        """
        p = len(self.columns)
        if p == 0:  # every launch is known exactly
            blocks = 1 if self.dense else self.shots
            return np.zeros((blocks, self.rows // blocks, 0))
        moved = np.moveaxis(slopes[..., self.columns], -1, 0)  # [column, shot, reading, 2]
        if not self.dense:
            parts = self.signature(moved).reshape(p, self.shots, -1)
            for i, column in enumerate(self.columns):
                parts[i, :, -5 + column] = self._prior[:, column]
            return np.ascontiguousarray(np.moveaxis(parts, 0, 2))
        (alone,) = each_shot(moved[None], range(self.shots))
        rows = self.signature(alone).reshape(self.shots, p, self.shots, -1)
        for shot in range(self.shots):
            for i, column in enumerate(self.columns):
                rows[shot, i, shot, -5 + column] = self._prior[shot, column]
        return np.ascontiguousarray(rows.reshape(self.shots * p, -1).T)[None]


def each_shot(moved: Array, shots: Iterable[int]) -> Array:
    """Return changes [place, parameter, shot, ...] of a single shot each, zero in the others,
    [place, single shot, parameter, shot, ...].

    Args:
        moved: changes of all shots.
        shots: the single ones.
    """
    shots = list(shots)
    alone = np.zeros((len(moved), len(shots), *moved.shape[1:]))
    for i, shot in enumerate(shots):
        alone[:, i, :, shot] = moved[:, :, shot]
    return alone


class Projection:
    """Directions of the launches among whitened rows, by blocks of rows.

    Args:
        directions: d rows / d launch coordinates by block, see `Whitening.launch`.

    Attributes:
        Q: orthonormal directions, [block, row, direction].
    """

    def __init__(self, directions: Array) -> None:
        self.Q, R = np.linalg.qr(directions)
        seen = np.abs(np.diagonal(R, axis1=1, axis2=2))  # [block, column]
        size = np.linalg.norm(directions, axis=1)
        if (seen <= ROUNDING * size).any():  # QR would give an arbitrary direction
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
