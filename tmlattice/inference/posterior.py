"""What readings leave known of small errors, from sums over their rows: no signature is held whole.

With signatures S (rms times slope, errors x rows) and what is left r, the likeliest errors are
(1 + S S^T)^-1 S r, and their covariance is (1 + S S^T)^-1. Both need S S^T and S r alone, which
are added up some rows at a time: memory goes as the square of the errors, whatever the number of
readings. `among` holds all signatures, because a search among small errors whitens rows by them.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve, eigh

from tmlattice.effects import find
from tmlattice.inference.distributed import (
    LINEARISATIONS,
    MIN_SHARE,
    DistributedErrors,
    chain_factors,
    components_of_rows,
    families_of,
    linearise,
    sampled_rows,
)
from tmlattice.inference.problem import Point, Problem

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Posterior:
    """Small errors as these readings leave them.

    Attributes:
        before: what was known, with the sizes as learnt.
        amounts: the likeliest, [error].
        felt: which errors the readings feel.
        spread: S S^T of these, in the coordinates of `Known.mixed`, [felt, felt].
        errors: relative error of each size by effect, where they were learnt.
    """

    before: DistributedErrors = field(repr=False)
    amounts: Array = field(repr=False)
    visible: NDArray[np.int64] = field(repr=False)
    spread: Array = field(repr=False)
    errors: Mapping[str, float]

    @property
    def sizes(self) -> dict[str, float]:
        """rms by effect."""
        own = zip(self.before.hypotheses, self.before.rms.tolist(), strict=True)
        return {name: rms for (name, _), rms in own}

    @cached_property
    def known(self) -> DistributedErrors:
        """What is known now."""
        values, vectors = eigh(
            self.spread, subset_by_value=(MIN_SHARE / (1 - MIN_SHARE), np.inf), check_finite=False
        )
        seen = np.zeros((len(values), len(self.amounts)))
        seen[:, self.visible] = vectors.T
        return self.before.updated(self.amounts, values / (1 + values), seen)


@dataclass(frozen=True)
class Sums:
    """Of d rows / d amount over all rows, nuisances projected out.

    Attributes:
        gram: with one another, [error, error].
        inner: with what is left of the readings, [error].
        some: themselves in a few rows, nuisances not projected out, [error, row].
    """

    gram: Array
    inner: Array
    some: Array


def posterior(
    problem: Problem,
    known: DistributedErrors,
    *,
    learn: bool = True,
    linearised_at: Array | None = None,
) -> Posterior:
    """What is known of small errors since these readings, linear about the likeliest amounts.

    Args:
        problem: of the design.
        known: beforehand; where sizes are learnt they start there.
        learn: the sizes are learnt; else they are as known.
        about: amounts from which on it is linear at first, [error]; None: those that are known.

    Raises:
        UnstableRingError: the likeliest small errors leave no stored beam.
    """
    names, belongs = families_of(known)
    amounts = stored = known.amounts if linearised_at is None else linearised_at
    nuisances, errors = problem.first, dict[str, float]()
    for _ in range(LINEARISATIONS):
        inner, point, amounts = linearise(problem, known, amounts, stored, (), nuisances)
        assert point.projection is not None
        stored, nuisances = amounts, point.nuisances
        keep = sampled_rows(len(point.residual))
        sums = sums_at(inner, point, known, amounts, keep)
        beyond = amounts - known.amounts
        if learn:
            found = components_of_rows(
                point.residual[keep] + beyond @ sums.some, point.projection.matrix()[keep],
                known.correlated(known.rms[:, None] * sums.some), belongs,
            )  # fmt: skip
            errors = dict(zip(names, found.error.tolist(), strict=True))
            known = replace(known, rms=known.rms * found.scale[belongs])
        spread = known.correlated(known.correlated(known.rms[:, None] * sums.gram * known.rms).T)
        visible = np.flatnonzero(np.diag(spread) > 0)
        spread = spread[np.ix_(visible, visible)]
        pull = known.correlated(known.rms * (sums.inner + sums.gram @ beyond))
        likeliest = np.zeros(len(pull))
        factor = cho_factor(spread + np.eye(len(visible)), overwrite_a=True, check_finite=False)
        likeliest[visible] = cho_solve(factor, pull[visible], check_finite=False)
        own = zip(
            known.hypotheses, known.amounts + known.rms * known.correlated(likeliest), strict=True
        )
        amounts = np.array([find(name).some_left(amount) for (name, _), amount in own])
    return Posterior(known, amounts, visible, spread, errors)


def sums_at(
    problem: Problem,
    point: Point,
    known: DistributedErrors,
    amounts: Array,
    keep: NDArray[np.int64],
) -> Sums:
    """The sums about a point.

    Args:
        problem: with the small errors in it.
        point: of nuisances alone.
        known: which errors.
        amounts: of those that are in the problem, [error].
        keep: the few rows.
    """
    assert point.projection is not None
    clean = point.projection.out(point.residual)
    directions = np.linalg.qr(point.projection.matrix())[0]
    slope = chain_factors(known, amounts)
    count = len(slope)
    gram, inner = np.zeros((count, count)), np.zeros(count)
    along, some = np.zeros((count, directions.shape[1])), np.zeros((count, len(keep)))
    column = np.full(len(clean), -1)
    column[keep] = np.arange(len(keep))
    for rows, signatures in problem.everywhere().metric(point).pieces(known.hypotheses):
        visible = np.flatnonzero(signatures.any(axis=1))  # errors of other monitors are not
        own = slope[visible, None] * signatures[visible]
        gram[np.ix_(visible, visible)] += own @ own.T
        inner[visible] += own @ clean[rows]
        along[visible] += own @ directions[rows]
        here = column[rows]
        some[np.ix_(visible, here[here >= 0])] = own[:, here >= 0]
    gram -= along @ along.T
    return Sums(gram, inner, some)
