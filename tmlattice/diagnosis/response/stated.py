"""The stated errors of a hierarchical fit's numbers.

>>> there = linear(state, 0)
>>> sigma = stated(state, 0, there, there.posterior).sigma
"""

from typing import NamedTuple

import numpy as np

from tmlattice.arrays import Array
from tmlattice.diagnosis.response.linear import Linear, linear
from tmlattice.diagnosis.response.state import Candidate, State, allow
from tmlattice.diagnosis.response.weights import taken, weight
from tmlattice.inference import errors
from tmlattice.inference.errors import MAX_MEMBERS, LinearFit, Rows, cluster_robust_errors, moments
from tmlattice.inference.normal import Posterior


class Stated(NamedTuple):
    """Stated errors of the numbers of one block, in the order of `linear`.

    Attributes:
        sigma: standard errors, [parameter].
        prior: rms of each number before the data, [parameter].
        covariance: of the posterior with possible single faults, [parameter, parameter].
    """

    sigma: Array
    prior: Array
    covariance: Array


def unwidened(posterior: Posterior) -> Stated:
    """Posterior errors without widening."""
    prior = np.sqrt(np.sum(posterior.spread**2, axis=1))
    return Stated(posterior.sigma, prior, posterior.whole)


def stated(state: State, block: int, there: Linear, posterior: Posterior) -> Stated:
    """Return posterior errors, widened by common-mode noise of the readings (`of_readings`), by
    unknown prior scales (`of_sizes`), and by possible single faults (`errors.moments`).

    Args:
        state: of the fit.
        block: 0 in-plane, 1 coupling.
        there: `linear` of that block.
        posterior: solved from it.
    """
    square = of_readings(state, block, there, posterior) ** 2
    square += np.sum(of_sizes(state, block, there) ** 2, axis=1)
    tails = moments(there.normal, there.groups, there.start)
    # mean square about the stated numbers, beyond the posterior's
    off = np.diag(tails.covariance) + (tails.mean - posterior.values) ** 2
    square += np.maximum(off - posterior.sigma**2, 0.0)
    prior = np.sqrt(np.sum(posterior.spread**2, axis=1))
    return Stated(np.sqrt(square), prior, tails.covariance)


def of_readings(state: State, block: int, there: Linear, posterior: Posterior) -> Array:
    """Return posterior errors, widened for columns or BPMs that contradict all others."""
    found = LinearFit.of(there.normal.matrix, posterior.whole)
    return _widened(state, block, there, posterior, found)


def of_sizes(state: State, block: int, there: Linear) -> Array:
    """Return a root F of the covariance F F^T by unknown prior scales, those of rejected families
    included, [parameter, direction]; see `stated`."""
    tried = [
        family
        for family in state.unneeded
        if family.block == block and family.per == "ring" and family.size(state.data) <= MAX_MEMBERS
    ]
    whole = linear(allow(state, tried), block) if tried else there
    gone = [group.name for family in tried for group in family.groups(state.data)]
    more = errors.scale_covariance(whole.normal, whole.groups, whole.start, gone)
    return more[: len(there.start)]  # without the rejected families


def doubt(state: State, one: Candidate, there: Linear, posterior: Posterior) -> float:
    """Return the factor by which the variance of a single fault's amount grows by columns or BPMs
    that contradict all others.

    Args:
        state, there, posterior: as in `stated`, for the block of the cause.
        one: the fault, with its own prior in them.
    """
    ends = np.cumsum([group.basis.shape[1] for group in posterior.groups])
    at = int(ends[[group.name for group in posterior.groups].index(one.name)]) - 1
    along = one.wide * posterior.spread @ posterior.covariance[:, [at]]
    variance = one.wide**2 * posterior.covariance[[at], at]
    found = LinearFit(there.normal.matrix, posterior.whole, along, variance)
    assert one.block is not None
    (sigma,) = _widened(state, one.block, there, posterior, found)
    return float(sigma**2 / variance[0])


def _widened(
    state: State, block: int, there: Linear, posterior: Posterior, found: LinearFit
) -> Array:
    data = state.data
    rows = Rows(data.plane_of(block), there.by_monitor, there.by_column, there.by_ring)
    weights = weight(state, block)
    # rounds end before full precision
    moved = there.readings(rows.plane, posterior.values - there.start)
    left = np.where(weights > 0, data.pick(state.at.left, block) - moved, 0.0)
    return cluster_robust_errors(rows, weights, left, found, taken(state, block))
