"""What numbers are unknown by because the sizes of their priors are.

A family's size follows the evidence. Where it has few members, or the data say little of them, the
evidence is flat: a size near zero, which holds its members there as if they were known, is as
likely as one twenty times as large, with which they, and all that makes up for them, are elsewhere.
So it is with a family that was tried and left out. Errors at one size alone are then far too small.
Sizes are therefore drawn as likely as they are, their members integrated out, and what that adds to
the variance of each number is told (the law of total variance).
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
"""Of so many members that the data know the size is known to 30 %."""
MAX_MEMBERS = 128
"""Members from which on a size is not looked at: each draw costs the third power."""
FACTORS = np.log(np.geomspace(1 / 32, 32, 11))
"""Logarithms of sizes over the present ones that are drawn from."""
DRAWS, BURN_IN = 420, 20
"""Of all sizes in turn; and of them those before the chain is at home."""


def scale_covariance(
    normal: Normal, groups: Sequence[Group], start: Array, gone: Collection[str] = ()
) -> Array:
    """What the base parameters' covariance has beside that of the posterior: F, of F F^T,
    [parameter, direction].

    It is about the values that the groups' present sizes give.

    Args:
        normal: at `start`.
        groups: the priors, as they are.
        start: the base parameters where the residual was taken.
        gone: names of groups whose members, `MANY` at most, are taken for zero, as they may be: as
            likely as that they are not. Their sizes are first guesses.
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
    # the others with their priors taken out: by how much they follow, and what is left to say
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
    """Sizes of some groups, and their members' amounts in units of the present sizes.

    Args:
        information, score: of the members, all others taken out.
        group: of each member.
        groups: with their hyperpriors.
        absent: whether a group's members are taken for zero, [group].
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
        """Prior rms of the members, and the root of what is known of them in these units."""
        scale = np.exp(sizes)[self.group]
        inside = scale[:, None] * self.information * scale
        inside[np.diag_indices(len(inside))] += 1
        return scale, np.asarray(np.linalg.cholesky(inside))

    def log_evidence(self, sizes: Array) -> float:
        """Of the readings, with all members integrated out."""
        scale, root = self._root(sizes)
        pull = solve_triangular(root, scale * self.score, lower=True, check_finite=False)
        return float(0.5 * pull @ pull - np.log(np.diag(root)).sum())

    def _chance(self, sizes: Array) -> float:
        """Log probability of sizes, -inf where one is none of its choices."""
        chance = 0.0
        for size, choices, chances in zip(sizes, self.choices, self.chances, strict=True):
            (at,) = np.nonzero(choices == size)
            if not len(at):
                return -np.inf
            chance += float(chances[at[0]])
        return chance + self.log_evidence(sizes)

    def amounts(self, sizes: Array) -> tuple[Array, Array]:
        """The likeliest, and their covariance."""
        scale, root = self._root(sizes)
        half = solve_triangular(root, np.diag(scale), lower=True, check_finite=False)
        covariance = half.T @ half
        return covariance @ self.score, covariance

    def more(self) -> Array:
        """Covariance of the amounts about those at the present sizes, less what it is there,
        [member, member]: by Gibbs' sampling of the sizes."""
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
            for a, b in self.pairs:  # one may stand for the other, both not likely
                other = here.copy()
                other[[a, b]] = here[[b, a]]
                both = self._chance(other) - self._chance(here)
                if np.log(random.random()) < both:
                    here = other
            if draw >= BURN_IN:
                then, spread = self.amounts(here)
                total += spread + np.outer(then - mean, then - mean)
        return np.asarray(total / (DRAWS - BURN_IN) - stated)
