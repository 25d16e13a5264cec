"""Uncertainty of numbers that comes from the uncertain scales of their priors.

A family's prior scale follows the evidence. With few members, or little data on them, the evidence
is flat: a scale near zero, which fixes the members, is as probable as one twenty times larger. The
same holds for a family that was rejected. Errors at one scale alone are then far too small. Scales
are therefore sampled from their posterior with the members integrated out, and the law of total
variance gives the additional variance of each number.
"""

from collections.abc import Collection, Sequence
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from tmlattice.inference.normal import ROUNDING, Normal
from tmlattice.inference.priors import Group

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

KNOWN_MEMBERS = 6.0
"""Members determined by the data above which the scale is known to 30 %."""
MAX_MEMBERS = 128
"""Members above which a scale is not sampled: each draw costs the third power."""
FACTORS = np.log(np.geomspace(1 / 32, 32, 11))
"""Log factors of the present scales, the support of the samples."""
DRAWS, BURN_IN = 420, 20
"""Gibbs samples, and those of them that are discarded as burn-in."""


def scale_covariance(
    normal: Normal, groups: Sequence[Group], start: Array, gone: Collection[str] = ()
) -> Array:
    """Root F of the covariance F F^T that uncertain scales add, [parameter, direction].

    It is relative to the values at the present scales.

    Args:
        normal: at `start`.
        groups: the priors.
        start: base parameters of the residual.
        gone: groups of at most `MAX_MEMBERS` members that are taken as zero: as probable as not.
            Their scales are first guesses.
    """
    groups = [group for group in groups if group.basis.any()]
    if not groups:
        return np.zeros((len(start), 0))
    basis = np.concatenate([group.basis * group.scale for group in groups], axis=1)
    own = np.repeat(np.arange(len(groups)), [group.basis.shape[1] for group in groups])
    absent = np.array([group.name in gone for group in groups])
    A = basis.T @ normal.matrix @ basis
    A[np.diag_indices(len(A))] *= 1 + ROUNDING
    b = basis.T @ (normal.vector + normal.matrix @ start)
    known = np.where(absent[own], 0.0, 1 - np.diag(np.linalg.inv(A + np.eye(len(A)))))
    unsure = np.array([
        absent[i]
        or (not group.fixed and (own == i).sum() <= MAX_MEMBERS
            and 0 < known[own == i].sum() < KNOWN_MEMBERS)
        for i, group in enumerate(groups)
    ])  # fmt: skip
    if not unsure.any():
        return np.zeros((len(start), 0))
    U = unsure[own]
    # the other groups with their priors integrated out
    follow = np.linalg.solve(A[np.ix_(~U, ~U)] + np.eye(int((~U).sum())), A[np.ix_(~U, U)])
    sizes = _Scales(
        A[np.ix_(U, U)] - A[np.ix_(U, ~U)] @ follow,
        b[U] - follow.T @ b[~U],
        (np.cumsum(unsure) - 1)[own[U]],
        [group for group, here in zip(groups, unsure, strict=True) if here],
        absent[unsure],
    )
    moved = basis[:, U] - basis[:, ~U] @ follow
    variance, directions = np.linalg.eigh(sizes.more())
    return np.asarray(moved @ (directions * np.sqrt(np.maximum(variance, 0))))


class _Scales:
    """Scales of some groups, and their members' amounts in units of the present scales.

    Args:
        information, score: of the members, all others integrated out.
        group: of each member.
        groups: with their hyperpriors.
        absent: whether a group's members are taken as zero, [group].
    """

    def __init__(
        self, information: Array, score: Array, group: Indices, groups: Sequence[Group],
        absent: NDArray[np.bool_],
    ) -> None:  # fmt: skip
        self.information, self.score, self.group = information, score, group
        self.now = np.where(absent, -np.inf, 0.0)
        self.choices, self.chances = [], []
        self.pairs = list(combinations(np.flatnonzero(absent).tolist(), 2))
        for own, gone in zip(groups, absent, strict=True):
            largest = own.scale.max()
            factors = FACTORS[(FACTORS <= 0) | (largest * np.exp(FACTORS) <= own.most)]
            factors = np.zeros(1) if own.fixed else factors
            size = np.log(own.rms / own.guess) + factors
            chances = np.exp(-0.5 * (size / own.guessed) ** 2)
            chances /= chances.sum()
            if gone:
                factors, chances = np.append(-np.inf, factors), np.append(1.0, chances)
            self.choices.append(factors)
            self.chances.append(np.log(chances))

    def _root(self, sizes: Array) -> tuple[Array, Array]:
        """Prior rms of the members, and the root of their posterior precision in these units."""
        scale = np.exp(sizes)[self.group]
        inside = scale[:, None] * self.information * scale
        inside[np.diag_indices(len(inside))] += 1
        return scale, np.asarray(np.linalg.cholesky(inside))

    def log_evidence(self, sizes: Array) -> float:
        """Log marginal likelihood with all members integrated out."""
        scale, root = self._root(sizes)
        pull = solve_triangular(root, scale * self.score, lower=True, check_finite=False)
        return float(0.5 * pull @ pull - np.log(np.diag(root)).sum())

    def _chance(self, sizes: Array) -> float:
        """Log probability of scales; -inf outside their support."""
        chance = 0.0
        for size, choices, chances in zip(sizes, self.choices, self.chances, strict=True):
            (at,) = np.nonzero(choices == size)
            if not len(at):
                return -np.inf
            chance += float(chances[at[0]])
        return chance + self.log_evidence(sizes)

    def amounts(self, sizes: Array) -> tuple[Array, Array]:
        """Most probable amounts, and their covariance."""
        scale, root = self._root(sizes)
        half = solve_triangular(root, np.diag(scale), lower=True, check_finite=False)
        covariance = half.T @ half
        return covariance @ self.score, covariance

    def more(self) -> Array:
        """Covariance that sampled scales add to that at the present ones, [member, member], by
        Gibbs sampling."""
        random = np.random.default_rng(0)
        here = np.where(np.isinf(self.now), 0.0, self.now)
        mean, stated = self.amounts(self.now)
        total = np.zeros_like(stated)
        for draw in range(DRAWS):
            for i, (choices, chances) in enumerate(zip(self.choices, self.chances, strict=True)):
                tried = np.repeat(here[None], len(choices), axis=0)
                tried[:, i] = choices
                values = chances + [self.log_evidence(one) for one in tried]
                weights = np.exp(values - values.max())
                here = tried[random.choice(len(tried), p=weights / weights.sum())]
            for a, b in self.pairs:  # swap two groups that compensate each other
                other = here.copy()
                other[[a, b]] = here[[b, a]]
                both = self._chance(other) - self._chance(here)
                if np.log(random.random()) < both:
                    here = other
            if draw >= BURN_IN:
                then, spread = self.amounts(here)
                total += spread + np.outer(then - mean, then - mean)
        return np.asarray(total / (DRAWS - BURN_IN) - stated)
