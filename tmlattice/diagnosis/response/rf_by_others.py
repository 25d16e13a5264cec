"""The RF's orbit at each monitor that is fitted, as all other readings predict it.

A few monitors that were kept apart tell little of an orbit that is read once. What all the others
predict of a reading follows from the fit to all of them: readings y with precision matrix Q miss
what the others say by (Q y) / Q_ii, and for a linear fit with priors Q y is the weighed residual, Q
the weights less what the fit takes of them. Families that follow every monitor by itself, and none
between, are seen by that.

>>> there = linear(state, 0); found = solve(there.normal, there.groups, there.start, rounds=0)
>>> rf_by_others(state, there, found)
"""

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from tmlattice.diagnosis.response.linear import Linear
from tmlattice.diagnosis.response.state import State
from tmlattice.diagnosis.response.weights import taken, weight
from tmlattice.inference.normal import Posterior

Array = NDArray[np.float64]

LEAST = 1e-9
"""Share of a reading's weight that a fit leaves, at least: above rounding."""


def rf_by_others(state: State, there: Linear | None, found: Posterior | None) -> Array:
    """What is left of each reading by a fit to all the others, m, [monitor]; NaN where none is.

    Args:
        state: where the fit stands.
        there: `linear` of it, in-plane; None where nothing is fitted.
        found: solved from that; None: without all that is fitted there.
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
    out[read] = weights @ left / np.maximum(precision, LEAST * weights.diagonal())
    return out


def rf_fitted(state: State) -> tuple[NDArray[np.int64], Array, Array]:
    """The monitors at which the RF's orbit is fitted, the inverse covariance of these readings,
    1/m2, and what is left of them, m."""
    column = len(state.data.plane) - 1
    own = weight(state, 0)[column]
    read = np.flatnonzero(own > 0)
    weights = np.diag(own[read])
    shared = taken(state, 0)
    if shared is not None:
        weights -= shared[column, read] @ shared[column, read].T
    return read, weights, state.data.pick(state.at.left)[column, read]
