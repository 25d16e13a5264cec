"""Posterior moments when any member of a group may be the faulty one.

A Gaussian prior at the scale of sound members excludes a faulty member, whatever the data. Here
each member's prior is a mixture of Gaussians (`Group.mixture`), and the posterior's moments are
found by expectation propagation (Minka, UAI 2001; for sparse linear models Seeger, JMLR 9 (2008)
759): each prior is replaced by a Gaussian whose product with the rest has the mean and variance of
the exact product. If the data cannot distinguish two members, both have large errors.
"""

from collections.abc import Sequence
from copy import copy
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from tmlattice.inference.normal import ROUNDING, Normal
from tmlattice.inference.priors import Group

Array = NDArray[np.float64]

SWEEPS = 100
"""Sweeps at most."""
DAMPING, LARGEST = 0.3, 0.5
"""Share of each update that is applied, and the largest change of a log precision: all members are
updated at once, and two that compensate each other would oscillate."""
DATA_ALONE = 1e3
"""Information over that of the narrowest prior component above which the prior is ignored."""
CONVERGED = 1e-2
"""Largest change in a sweep, of a mean in standard deviations or of a log variance, at the end."""


class Moments(NamedTuple):
    """Mean, [parameter], and covariance, [parameter, parameter], of the base parameters."""

    mean: Array
    covariance: Array


class _Mixtures:
    """Priors of all members, padded to one number of components, [member, component]."""

    def __init__(self, groups: Sequence[Group]) -> None:
        each = [group.mixture() for group in groups]
        width = max(len(chances) for chances, _ in each)
        size = [group.basis.shape[1] for group in groups]
        self.log_chance = np.full((sum(size), width), -np.inf)
        self.square = np.ones((sum(size), width))
        end = 0
        for own, (chances, scales) in zip(size, each, strict=True):
            begin, end = end, end + own
            self.log_chance[begin:end, : len(chances)] = np.log(chances)
            self.square[begin:end] = scales[0] ** 2
            self.square[begin:end, : len(chances)] = scales**2
        self.variance = np.sum(np.exp(self.log_chance) * self.square, axis=1)

    def some(self, members: NDArray[np.bool_]) -> "_Mixtures":
        """Return the priors of some members."""
        made = copy(self)
        made.log_chance, made.square = self.log_chance[members], self.square[members]
        return made

    def times(self, precision: Array, pull: Array) -> tuple[Array, Array]:
        """Mean and variance of each prior times exp(pull x - precision x^2 / 2)."""
        wider = 1 + precision[:, None] * self.square
        variance = self.square / wider
        mean = pull[:, None] * variance
        weight = self.log_chance - 0.5 * np.log(wider) + 0.5 * pull[:, None] * mean
        weight = np.exp(weight - weight.max(axis=1, keepdims=True))
        weight /= weight.sum(axis=1, keepdims=True)
        center = np.sum(weight * mean, axis=1)
        spread = np.sum(weight * (variance + (mean - center[:, None]) ** 2), axis=1)
        return center, spread


def moments(normal: Normal, groups: Sequence[Group], start: Array) -> Moments:
    """Mean and covariance of the base parameters under heavy-tailed priors.

    Args:
        normal: at `start`.
        groups: priors with their scales.
        start: base parameters of the residual, [parameter].
    """
    basis = np.concatenate([group.basis for group in groups], axis=1)
    priors = _Mixtures(groups)
    unit = np.sqrt(priors.variance)  # scales the matrix
    A = (basis * unit).T @ normal.matrix @ (basis * unit)
    A[np.diag_indices(len(A))] *= 1 + ROUNDING
    b = unit * (basis.T @ (normal.vector + normal.matrix @ start))
    priors.square /= priors.variance[:, None]
    precision, pull = np.ones(len(A)), np.zeros(len(A))
    rest = 1 / np.diag(_gaussian(A, b, precision, pull)[1]) - 1
    open_ = rest * priors.square.min(axis=1) < DATA_ALONE  # the prior matters for these alone
    if open_.any():
        follow = np.linalg.solve(
            A[np.ix_(~open_, ~open_)] + np.eye(int((~open_).sum())), A[np.ix_(~open_, open_)]
        )
        within = A[np.ix_(open_, open_)] - A[np.ix_(open_, ~open_)] @ follow
        precision[open_], pull[open_] = _sites(
            (within + within.T) / 2, b[open_] - follow.T @ b[~open_], priors.some(open_)
        )
    mean, covariance = _gaussian(A, b, precision, pull)
    scaled = basis * unit
    return Moments(scaled @ mean, scaled @ covariance @ scaled.T)


def _sites(A: Array, b: Array, priors: _Mixtures) -> tuple[Array, Array]:
    """Precisions and shifts of the Gaussians in place of the priors."""
    precision, pull = np.ones(len(A)), np.zeros(len(A))
    for _ in range(SWEEPS):
        mean, covariance = _gaussian(A, b, precision, pull)
        variance = np.diag(covariance)
        rest = np.maximum(1 / variance - precision, 0.0)
        others = mean / variance - pull
        center, spread = priors.times(rest, others)
        wanted = np.maximum(1 / spread - rest, 1.0)  # no wider than the prior
        drawn = center * (rest + wanted) - others
        changed = max(
            np.abs((center - mean) / np.sqrt(variance)).max(),
            np.abs(np.log((wanted + rest) * variance)).max(),
        )
        if changed < CONVERGED:
            break
        step = DAMPING * np.log(wanted / precision)
        precision = precision * np.exp(np.clip(step, -LARGEST, LARGEST))
        pull = pull + DAMPING * (drawn - pull)
    return precision, pull


def _gaussian(A: Array, b: Array, precision: Array, pull: Array) -> tuple[Array, Array]:
    """Mean and covariance with Gaussian priors of these precisions and shifts."""
    factor = cho_factor(A + np.diag(precision), lower=True, check_finite=False)
    covariance = cho_solve(factor, np.eye(len(A)), check_finite=False)
    return covariance @ (b + pull), (covariance + covariance.T) / 2
