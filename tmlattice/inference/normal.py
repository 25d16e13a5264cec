"""Linear least squares with Gaussian priors for one pair of planes of an orbit response.

A residual d [column, monitor] has three kinds of parameters: scales of a monitor's readings (gain,
or the other plane's share), scales of a column (corrector calibration, or roll), and errors of the
ring. Only the last make the normal equations dense. See `inference.priors.Group` for the priors.

Readings of a column with common modes: patterns, each with an unknown amount. Amounts are standard
Gaussians and are integrated out. A column with weights W and patterns P (at their typical size) has
the inverse covariance

    (W^-1 + P^T P)^-1 = W - L L^T,   L = W P^T R^-T,   R R^T = 1 + P W P^T.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import cho_solve
from scipy.linalg.blas import dsyrk, dtrmm
from scipy.linalg.lapack import dpotrf, dpotri, dtrtri
from scipy.sparse import csr_array

from tmlattice.arrays import ROUNDING, Array, Indices, Reals
from tmlattice.compiled import jit_sums
from tmlattice.inference.priors import Group

LEARNT = 0.02
"""Change of a log scale below which a round of EM is the last."""

AT_ONCE = 2048
"""Readings weighed at a time: enough for matrix products, within the cache."""
ERRORS_AT_ONCE = 8
"""Errors whose derivatives are in double precision at a time: within the cache, too."""


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


class Slopes(NamedTuple):
    """Derivatives by one family of errors.

    Single precision is enough for `rows`, of which a large ring has a gigabyte: normal equations
    and gradient have the same ones, so that a rounded derivative is that of a slightly other model.
    Sums over them are of double precision.

    Attributes:
        rows: d reading / d error as computed, [error, column, monitor].
        now: factor since then, [column, monitor]; None: 1.
    """

    rows: Reals
    now: Array | None = None

    def _doubles(self) -> Iterator[tuple[slice, Array]]:
        """Some rows at a time, in double precision."""
        for low in range(0, len(self.rows), ERRORS_AT_ONCE):
            some = slice(low, low + ERRORS_AT_ONCE)
            yield some, np.asarray(self.rows[some], dtype=float)

    def times(self, readings: Array) -> Array:
        """Readings [..., column, monitor] times the derivatives, summed, [error, ...]."""
        own = readings if self.now is None else self.now * readings
        flat = own.reshape(-1, math.prod(own.shape[-2:]))
        summed = np.empty((len(self.rows), len(flat)))
        for some, rows in self._doubles():
            summed[some] = rows.reshape(len(rows), -1) @ flat.T
        return summed.reshape(len(self.rows), *readings.shape[:-2])

    def readings(self, amounts: Array) -> Array:
        """Change of the readings by amounts of the errors, [column, monitor]."""
        own = np.zeros(self.rows.shape[1:])
        for some, rows in self._doubles():
            own += np.tensordot(amounts[some], rows, 1)
        return own if self.now is None else self.now * own

    def of(self, column: int | Indices, monitor: Indices) -> Array:
        """Derivatives of some readings, [error, reading]."""
        own = self.rows[:, column, monitor]
        return np.asarray(own if self.now is None else own * self.now[column, monitor])

    def through(self, patterns: Array) -> Array:
        """Derivatives times [column, monitor, pattern], summed over monitors, [error, column,
        pattern]."""
        own = patterns if self.now is None else self.now[:, :, None] * patterns
        out = np.empty((len(self.rows), *own.shape[::2]))
        for some, rows in self._doubles():
            out[some] = (rows.transpose(1, 0, 2) @ own).transpose(1, 0, 2)
        return out


# `reassoc`: the sum may follow the vector unit's order.
@jit_sums
def _weigh(rows, some, root, by_monitor, by_column, plane, weighed, monitors, columns):  # type: ignore[no-untyped-def]
    """Sum over the derivatives of one family in one pass; adds to `monitors`.

    Args:
        rows: [error, column, monitor].
        some: the columns of the sum, [some].
        root, by_monitor, by_column: factors of the derivatives, [column, monitor].
        plane: [column].
        weighed: result, root times rows, [error, some, monitor].
        monitors, columns: sums, [error, plane, monitor] and [error, column].
    """
    for i in range(rows.shape[0]):
        for j in range(some.shape[0]):
            c = some[j]
            own, into = rows[i, c], weighed[i, j]
            added, total = monitors[i, plane[c]], 0.0
            for m in range(rows.shape[2]):
                slope = own[m]
                into[m] = root[c, m] * slope
                added[m] += by_monitor[c, m] * slope
                total += by_column[c, m] * slope
            columns[i, c] = total


@dataclass(frozen=True)
class Normal:
    """Normal equations; parameters: monitor and plane, then column, then ring error.

    Attributes:
        matrix: J^T W J, [parameter, parameter].
        vector: J^T W residual, [parameter].
    """

    matrix: Array
    vector: Array


def normal_equations(
    residual: Array,
    weight: Array,
    plane: Indices,
    by_monitor: Array,
    by_column: Array,
    ring: Sequence[Slopes],
    taken: Array | None = None,
) -> Normal:
    """Return the normal equations from sums over all readings.

    Args:
        residual: measured less model, m, [column, monitor]; weight 0 where missing.
        weight: 1 / variance, 1/m^2, [column, monitor].
        plane: in which each column is read, 0 or 1, [column].
        by_monitor: d reading / d monitor's parameter, [column, monitor].
        by_column: d reading / d column's parameter, [column, monitor]; 0 where it has none.
        ring: derivatives by the errors of each family; may be empty. Memory beyond them is that of
            `AT_ONCE` readings.
        taken: L of `common`, the readings' common modes, [column, monitor, pattern]; None: no
            common modes.
    """
    columns, monitors = residual.shape
    y = np.where(weight > 0, residual, 0.0)
    m, end = 2 * monitors, 2 * monitors + columns
    ends = np.cumsum([0, *(len(own.rows) for own in ring)])
    errors = int(ends[-1])
    square = np.zeros((errors, errors), order="F")  # the upper triangle
    of_monitors, of_columns = np.zeros((errors, 2, monitors)), np.zeros((errors, columns))
    b = np.zeros(end + errors)
    wu, wv = weight * by_monitor, weight * by_column
    root = np.sqrt(weight)
    scales = [
        [np.ascontiguousarray(a if own.now is None else a * own.now) for a in (root, wu, wv)]
        for own in ring
    ]
    read = np.flatnonzero(weight.any(axis=1))  # not the held-out columns
    step = min(max(AT_ONCE // monitors, 1), columns)
    buffer = np.empty(errors * step * monitors)
    for low in range(0, len(read), step) if errors else ():
        some = read[low : low + step]
        weighed = buffer[: errors * len(some) * monitors].reshape(errors, len(some), monitors)
        for own, factors, begin, last in zip(ring, scales, ends, ends[1:], strict=False):
            mine = slice(begin, last)
            _weigh(own.rows, some, *factors, plane, weighed[mine], of_monitors[mine],
                   of_columns[mine])  # fmt: skip
        flat = weighed.reshape(errors, -1)
        square = dsyrk(1.0, flat.T, beta=1.0, c=square, trans=1, lower=0, overwrite_c=1)
        b[end:] += flat @ (root[some] * y[some]).ravel()
    A = np.zeros((len(b), len(b)))
    for p in (0, 1):
        at, rows = 2 * np.arange(monitors) + p, plane == p
        A[at, at] = (wu * by_monitor)[rows].sum(axis=0)
        A[np.ix_(at, m + np.flatnonzero(rows))] = (wu * by_column)[rows].T
        A[at, end:] = of_monitors[:, p].T
        b[at] = (wu * y)[rows].sum(axis=0)
    at = np.arange(m, end)
    A[at, at] = (wv * by_column).sum(axis=1)
    A[at, end:] = of_columns.T
    b[at] = (wv * y).sum(axis=1)
    A[end:, end:] = square
    if taken is not None:
        shared = shared_by(plane, by_monitor, by_column, ring, taken).reshape(len(A), -1)
        A -= shared @ shared.T
        b -= shared @ np.einsum("cm,cmk->ck", y, taken).ravel()
    return Normal(np.triu(A) + np.triu(A, 1).T, b)


def shared_by(
    plane: Indices,
    by_monitor: Array,
    by_column: Array,
    by_ring: Sequence[Slopes],
    taken: Array,
) -> Array:
    """J^T L of every column, [parameter, column, pattern]; see `normal_equations`."""
    columns, monitors, patterns = taken.shape
    m, own = 2 * monitors, np.arange(columns)
    end = m + columns
    out = np.zeros((end + sum(len(part.rows) for part in by_ring), columns, patterns))
    for p in (0, 1):
        rows = np.flatnonzero(plane == p)
        alone = by_monitor[rows, :, None] * taken[rows]
        out[np.ix_(2 * np.arange(monitors) + p, rows)] = alone.transpose(1, 0, 2)
    out[m + own, own] = np.einsum("cm,cmk->ck", by_column, taken)
    for part in by_ring:
        out[end : end + len(part.rows)] = part.through(taken)
        end += len(part.rows)
    return out


def in_basis(normal: Normal, basis: csr_array, start: Array) -> tuple[Array, Array]:
    """Matrix [p, p] and vector [p] of the normal equations for amounts of the columns of a basis
    [parameter, p], in place of changes from `start`."""
    # by rows, for `lower_factor`; the matrix is symmetric
    matrix = basis.T @ (basis.T @ normal.matrix).T
    return matrix, basis.T @ (normal.vector + normal.matrix @ start)


@dataclass(frozen=True)
class Posterior:
    """Posterior of a linear fit.

    Attributes:
        values: of the base parameters, [parameter].
        groups: with their estimated scales.
        basis: of all groups, [parameter, p].
        prior: prior rms of the groups' parameters, [p].
        factor: lower triangle L of the normal equations in units of the priors, L L^T, [p, p].
    """

    values: Array
    groups: tuple[Group, ...]
    basis: csr_array
    prior: Array
    factor: Array

    @property
    def occam(self) -> float:
        """Occam factor: log volume of the posterior over that of the prior, 0 without data."""
        return -float(np.log(np.diag(self.factor)).sum())

    @cached_property
    def spread(self) -> csr_array:
        """Basis times prior rms, [parameter, p]."""
        return csr_array(self.basis.multiply(self.prior))

    @property
    def before(self) -> Array:
        """Prior rms of the base parameters, [parameter]."""
        return np.asarray(np.sqrt(self.spread.power(2).sum(axis=1)))

    @cached_property
    def covariance(self) -> Array:
        """Covariance of the groups' parameters, in units of their priors, [p, p]."""
        return inverse_by_factor(self.factor)

    @property
    def whole(self) -> Array:
        """Covariance of the base parameters, [parameter, parameter]."""
        return np.asarray(self.spread @ self.covariance @ self.spread.T)

    @property
    def sigma(self) -> Array:
        """Posterior standard deviations of the base parameters, [parameter]."""
        square = self.spread.multiply(self.spread @ self.covariance).sum(axis=1)
        return np.asarray(np.sqrt(np.maximum(square, 0)))

    def solved(self, vector: Array) -> Array:
        """Values for another right-hand side of the normal equations, [parameter]."""
        right = self.prior * (self.basis.T @ vector)
        return np.asarray(self.basis @ (self.prior * cho_solve((self.factor, True), right)))


def solve(
    normal: Normal,
    groups: Sequence[Group],
    start: Array | None = None,
    step_bound: Array | None = None,
    rounds: int = 2,
) -> Posterior:
    """Return the posterior after one Gauss-Newton step, and the groups' scales.

    Args:
        normal: at `start`.
        groups: zero-mean priors; every free base parameter is in one of them.
        start: base parameters of the residual; None: zero.
        step_bound: rms of the step of each; None: unbounded. It does not change the fixed point.
        rounds: largest number of rounds of EM; 0: the priors stay.
    """
    known = np.zeros(len(normal.vector)) if start is None else start
    groups = tuple(groups)
    basis = csr_array(np.concatenate([g.basis for g in groups], axis=1))  # sparse
    edges = np.cumsum([g.basis.shape[1] for g in groups])[:-1]
    base = normal.matrix if step_bound is None else normal.matrix + np.diag(step_bound**-2)
    A, b = in_basis(Normal(base, normal.vector), basis, known)
    for turn in range(max(rounds, 1)):
        prior = np.concatenate([g.scale for g in groups])
        # in units of the priors: well scaled
        scaled = A * prior
        scaled *= prior[:, None]
        # damping above the rounding of sums over all readings
        scaled[np.diag_indices(len(A))] += 1 + ROUNDING * np.diag(scaled)
        factor = lower_factor(scaled)
        found = prior * cho_solve((factor, True), prior * b)
        if turn < rounds:
            half = inverse_of_lower(factor)
            left = np.einsum("ij,ij->j", half, half)  # diagonal of the covariance
            parts = np.split(found**2, edges), np.split(left, edges)
            groups = tuple(g.learn(own, left) for g, own, left in zip(groups, *parts, strict=True))
            now = np.concatenate([g.scale for g in groups])
            if np.abs(np.log(now / prior)).max(initial=0.0) < LEARNT:
                break
    return Posterior(basis @ found, groups, basis, prior, factor)


# --- triangular factors by LAPACK, without copies and checks, which dominate for small matrices ---
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


def inverse_by_factor(factor: Array) -> Array:
    """(L L^T)^-1, [n, n], of a lower triangle L."""
    lower = dpotri(factor, lower=1)[0]  # one half
    return np.asarray(np.tril(lower) + np.tril(lower, -1).T)


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
