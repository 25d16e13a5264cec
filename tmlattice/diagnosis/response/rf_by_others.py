"""Leave-one-out residuals of the RF's orbit.

The RF's orbit is read once, and a few held-out BPMs validate little of it. The prediction of one
reading by all others follows from the fit to all of them: for readings y with precision matrix Q
the residual is (Q y) / Q_ii. For a linear fit with priors, Q y is the weighted residual, and Q the
weights less the information that the fit takes. These residuals reveal families that fit each BPM
by itself and predict none.

>>> there = linear(state, 0); found = there.posterior
>>> rf_by_others(state, there, found)
"""

import numpy as np
from scipy.linalg import solve_triangular

from tmlattice.arrays import INVISIBLE, Array, Indices
from tmlattice.diagnosis.response.linear import Linear
from tmlattice.diagnosis.response.state import State
from tmlattice.diagnosis.response.weights import taken, weight
from tmlattice.inference.normal import Posterior


def rf_by_others(state: State, there: Linear | None, found: Posterior | None) -> Array:
    """Return the residual of each reading by a fit to all others, m, NaN if not fitted, [monitor].

    Args:
        state: of the fit.
        there: `linear` of it, in-plane; None: nothing is fitted.
        found: its solution; None: all numbers at zero.
    """
    column = len(state.data.plane) - 1
    read, weights, left = rf_fitted(state)
    precision = weights.diagonal().copy()
    if there is not None:
        rows = there.of_column(column, read, int(state.data.plane[column]))
        values = np.zeros_like(there.start) if found is None else found.values
        left = left - rows @ (values - there.start)
    if there is not None and found is not None:
        fitted = solve_triangular(found.factor, (weights @ rows @ found.spread).T, lower=True)
        precision -= (fitted**2).sum(axis=0)
    out = np.full(state.data.shape[1], np.nan)
    out[read] = weights @ left / np.maximum(precision, INVISIBLE * weights.diagonal())
    return out


def rf_fitted(state: State) -> tuple[Indices, Array, Array]:
    """Return the BPMs at which the RF's orbit is fitted, the inverse covariance of these readings,
    1/m2, and their residuals, m."""
    column = len(state.data.plane) - 1
    own = weight(state, 0)[column]
    read = np.flatnonzero(own > 0)
    weights = np.diag(own[read])
    shared = taken(state, 0)
    if shared is not None:
        weights -= shared[column, read] @ shared[column, read].T
    return read, weights, state.data.pick(state.at.left)[column, read]
