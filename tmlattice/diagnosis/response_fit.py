"""Linear least squares with Gaussian priors for one pair of planes of an orbit response.

Three kinds of parameter meet in one residual d [column, monitor]: what scales all readings of a
monitor (gain, or the other plane's share), what scales a column (corrector calibration, or roll),
and what changes the ring. Their normal equations are dense only in the last.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Fit:
    """What the residual is explained by.

    Attributes:
        monitor: of the readings of each plane, [monitor, 2].
        column: of each column, [column].
        ring: of each error of the ring, [error].
        sigma: posterior errors of all, in this order, [parameter].
        scale: rms of the prior of the ring's errors, as the data have it.
        left: the residual that stays, m, [column, monitor].
    """

    monitor: Array
    column: Array
    ring: Array
    sigma: Array
    scale: float
    left: Array


def fit(
    residual: Array,
    weight: Array,
    plane: Array,
    by_monitor: Array,
    by_column: Array,
    by_ring: Array | Sequence[Array],
    monitor_rms: float,
    column_rms: float,
    ring_rms: float,
    start: Array | None = None,
    rounds: int = 20,
) -> Fit:
    """The most probable parameters; the scale of the ring's prior follows the evidence.

    MacKay's fixed point: scale^2 = sum of squares / number of well-determined parameters.

    Args:
        residual: measured less model, m, [column, monitor]; weight 0 where missing.
        weight: 1 / variance, 1/m^2, [column, monitor].
        plane: in which each column is read, 0 or 1, [column].
        by_monitor: d reading / d monitor's parameter, [column, monitor].
        by_column: d reading / d column's parameter, [column, monitor]; 0 where it has none.
        by_ring: d reading / d error, [error, column, monitor]; may be empty.
        monitor_rms, column_rms, ring_rms: of the priors; of the last only the start.
        start: what the parameters are where the residual was taken, in the order of `Fit.sigma`;
            None: zero. The priors are about zero, and the result is the whole of each parameter.
        rounds: of the fixed point.
    """
    columns, monitors = residual.shape
    J = np.asarray(by_ring, dtype=float).reshape(-1, columns, monitors)
    errors = len(J)
    m, c = 2 * monitors, columns
    size = m + c + errors
    A = np.zeros((size, size))
    b = np.zeros(size)
    y = np.where(weight > 0, residual, 0.0)
    place = np.arange(monitors)
    for p in (0, 1):
        rows = plane == p
        w, u = weight[rows], by_monitor[rows]
        at = 2 * place + p
        A[at, at] = (w * u * u).sum(axis=0)
        A[np.ix_(at, m + np.flatnonzero(rows))] = (w * u * by_column[rows]).T
        b[at] = (w * u * y[rows]).sum(axis=0)
        if errors:
            A[at, m + c :] = np.einsum("gcm,cm->mg", J[:, rows], w * u, optimize=True)
    own = m + np.arange(c)
    A[own, own] = (weight * by_column**2).sum(axis=1)
    b[own] = (weight * by_column * y).sum(axis=1)
    if errors:
        A[m : m + c, m + c :] = np.einsum("gcm,cm->cg", J, weight * by_column, optimize=True)
        flat = (J * np.sqrt(weight)).reshape(errors, -1)
        A[m + c :, m + c :] = flat @ flat.T
        b[m + c :] = flat @ (np.sqrt(weight) * y).ravel()
    A = np.triu(A) + np.triu(A, 1).T
    known = np.zeros(size) if start is None else start
    b += A @ known
    scale = ring_rms
    for _ in range(rounds if errors else 1):
        prior = np.concatenate(
            [np.full(m, monitor_rms), np.full(c, column_rms), np.full(errors, scale)]
        )
        # in units of the priors, so that the matrix is well scaled
        factor = cho_factor(A * np.outer(prior, prior) + np.eye(size), lower=True)
        found = prior * cho_solve(factor, prior * b)
        variance = np.diag(cho_solve(factor, np.eye(size)))
        if errors:
            determined = float((1 - variance[m + c :]).sum())
            scale = float(np.sqrt((found[m + c :] ** 2).sum() / max(determined, 1e-9)))
    step = found - known
    explained = step[:m].reshape(monitors, 2)[:, plane].T * by_monitor
    explained = explained + step[m : m + c, None] * by_column
    if errors:
        explained = explained + np.tensordot(step[m + c :], J, 1)
    return Fit(
        found[:m].reshape(monitors, 2), found[m : m + c], found[m + c :],
        prior * np.sqrt(variance), scale, residual - explained,
    )  # fmt: skip
