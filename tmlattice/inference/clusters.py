"""Cluster-robust errors of a fit whose readings share model discrepancy, by column or by monitor.

A posterior takes readings as independent. Model discrepancy of a corrector's column is often a wave
in all of its readings, and that at a monitor is the same in all columns. Each cluster of readings
(one column, or one monitor) is therefore taken out of the normal equations and compared with the
prediction of all others (a jackknife, exact for linear least squares: Bell and McCaffrey, Survey
Methodology 28 (2002) 169). Errors grow by the ratio of the observed to the expected mismatch.
"""

from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from tmlattice.inference.common import times_precision
from tmlattice.inference.normal import shared_by
from tmlattice.inference.slopes import Slopes

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

MAX_LEVERAGE = 0.75
"""Leverage of a cluster above which the other readings know too little to test it. The mean
mismatch of the others is then used in its place."""

MAX_CLUSTERS = 64
"""Columns, and monitors, that are taken out at most, drawn at random."""

MIN_SHARE = 1e-11
"""Smallest share of the information that the other readings have of a quantity."""


class Rows(NamedTuple):
    """Derivatives of readings, as in `normal.normal_equations`.

    Attributes:
        plane: in which each column is read, [column].
        by_monitor, by_column: [column, monitor].
        by_ring: [error, column, monitor].
    """

    plane: Indices
    by_monitor: Array
    by_column: Array
    by_ring: Array

    def times(self, column: Indices, monitor: Indices, other: Array) -> Array:
        """Return rows of some readings times [parameter, any], [reading, any]."""
        columns, monitors = self.by_monitor.shape
        ring = 2 * monitors + columns
        out = self.by_ring[:, column, monitor].T @ other[ring:]
        gain, own = self.by_monitor[column, monitor], self.by_column[column, monitor]
        out += gain[:, None] * other[2 * monitor + self.plane[column]]
        out += own[:, None] * other[2 * monitors + column]
        return np.asarray(out)


class LinearFit(NamedTuple):
    """A linear fit, and quantities that are linear in its parameters.

    Attributes:
        matrix: of the normal equations, without priors, [parameter, parameter].
        covariance: of the parameters, [parameter, parameter].
        along: covariance of parameters and quantities, [parameter, quantity].
        variance: of the quantities, [quantity].
    """

    matrix: Array
    covariance: Array
    along: Array
    variance: Array

    @classmethod
    def of(cls, matrix: Array, covariance: Array) -> "LinearFit":
        """Return the fit with its parameters as the quantities."""
        return cls(matrix, covariance, covariance, np.diag(covariance))


def cluster_robust_errors(
    rows: Rows, weight: Array, residual: Array, found: LinearFit, taken: Array | None = None
) -> Array:
    """Standard errors of a fit's quantities, larger where clusters of readings disagree.

    For independent readings they are the posterior's errors, up to a few per cent by chance.

    Args:
        rows: derivatives of all readings.
        weight: 1 / variance, 0 where missing, [column, monitor].
        residual: of the fit, [column, monitor].
        found: the fit.
        taken: L of `inference.common.common`, the readings' common modes, [column, monitor,
            pattern]; None: no common modes.

    Returns:
        Standard deviations, [quantity].
    """
    # the readings' part of the variance; the rest is the prior's
    noise_variance = (found.along * (found.matrix @ found.along)).sum(axis=0)
    more = np.zeros_like(noise_variance)
    for clusters in (_of_columns, _of_monitors):
        shares, mismatch = _mismatches(clusters(rows, weight, residual, taken), found)
        size = np.maximum(shares.sum(axis=0), 1e-300)
        more += np.maximum((shares * mismatch).sum(axis=0) / size - 1, 0)
    return np.asarray(np.sqrt(np.maximum(found.variance + noise_variance * more, 0)))


def _drawn(weight: Array, axis: int) -> Indices:
    """Clusters to take out, of those that have readings along an axis."""
    found = np.flatnonzero(weight.sum(axis))
    if len(found) <= MAX_CLUSTERS:
        return found
    return np.sort(np.random.default_rng(0).permutation(found)[:MAX_CLUSTERS])


class _Cluster(NamedTuple):
    """Readings that are taken out together, white given all others.

    Attributes:
        rows, column, monitor: of the readings.
        root: whitens them, [reading] or [reading, reading].
        others: prediction from the other readings of their columns, [reading, parameter]; or None.
        left: whitened residual, [reading].
    """

    rows: Rows
    column: Indices
    monitor: Indices
    root: Array
    others: Array | None
    left: Array

    def times(self, other: Array) -> Array:
        """White rows times [parameter, any], [reading, any]."""
        own = self.rows.times(self.column, self.monitor, other)
        white = self.root[:, None] * own if self.root.ndim == 1 else self.root @ own
        return np.asarray(white if self.others is None else white - self.others @ other)


def _of_columns(
    rows: Rows, weight: Array, residual: Array, taken: Array | None
) -> Iterator[_Cluster]:
    """Clusters of one column each; columns are independent."""
    for own in _drawn(weight, axis=1):
        monitor = np.flatnonzero(weight[own])
        column = np.full(len(monitor), own)
        root, left = np.sqrt(weight[own, monitor]), residual[own, monitor]
        if taken is None:
            yield _Cluster(rows, column, monitor, root, None, root * left)
        else:
            shared = taken[own, monitor]
            root = np.linalg.cholesky(np.diag(root**2) - shared @ shared.T).T
            yield _Cluster(rows, column, monitor, root, None, root @ left)


def _of_monitors(
    rows: Rows, weight: Array, residual: Array, taken: Array | None
) -> Iterator[_Cluster]:
    """Clusters of one monitor each: one reading per column, given the column's other readings."""
    weighted = weight * residual if taken is None else times_precision(weight, taken, residual)
    shared = (
        None if taken is None else (taken, shared_by(*rows[:3], (Slopes(rows.by_ring),), taken))
    )
    for own in _drawn(weight, axis=0):
        column = np.flatnonzero(weight[:, own])
        monitor, alone, others = np.full(len(column), own), weight[column, own], None
        root = np.sqrt(alone)
        if shared is not None:
            here, noise_variance = shared[0][column, own], shared[1][:, column]
            root = np.sqrt(alone - np.sum(here**2, axis=1))
            others = np.einsum("ck,pck->cp", here / root[:, None], noise_variance)
        left = weighted[column, own] / root
        yield _Cluster(rows, column, monitor, alone / root, others, left)


def _mismatches(clusters: Iterable[_Cluster], found: LinearFit) -> tuple[Array, Array]:
    """Leverage of each cluster, and its squared mismatch over the expected one, [cluster,
    quantity]."""
    known = found.variance > 0
    shares, mismatch = [], []
    for cluster in clusters:
        Y = along = cluster.times(found.covariance)
        if found.along is not found.covariance:
            Y = cluster.times(found.along)
        inside = cluster.times(along.T)
        solved = _apart((inside + inside.T) / 2, np.column_stack([Y, cluster.left]))
        moved = Y.T @ solved[:, -1]
        grown = np.maximum((Y * solved[:, :-1]).sum(axis=0), 1e-300)  # of the variance without it
        whole = np.where(known, found.variance + grown, 1.0)
        share = np.where(known, grown / whole, 0.0)
        own = moved**2 / grown
        leverage = np.where(share < MAX_LEVERAGE, share, 0.0)
        elsewhere = float(leverage @ own) / max(float(leverage.sum()), 1e-300)
        shares.append(share)
        mismatch.append(np.where(share < MAX_LEVERAGE, own, elsewhere))
    return np.array(shares), np.array(mismatch)


def _apart(inside: Array, right: Array) -> Array:
    """(1 - inside)^-1 right, with eigenvalues of at least `MIN_SHARE`."""
    matrix = (1 + MIN_SHARE) * np.eye(len(inside)) - inside
    try:
        return np.asarray(cho_solve(cho_factor(matrix), right))
    except np.linalg.LinAlgError:  # by rounding: readings far above their noise
        size, vectors = np.linalg.eigh(matrix)
        return np.asarray(vectors @ ((vectors.T @ right) / np.maximum(size, MIN_SHARE)[:, None]))
