"""Posterior of distributed errors from sums over rows, without storing signatures.

With signatures S (rms times slope, errors x rows) and residual r, the most probable errors are
(1 + S S^T)^-1 S r, and their covariance is (1 + S S^T)^-1. S S^T and S r are summed some rows at a
time: memory grows as the square of the errors, whatever the number of readings. `distributed` keeps
all signatures, since its search whitens rows by them.
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
    """Distributed errors given these readings.

    Attributes:
        before: the prior, with its estimated scales.
        amounts: most probable amounts, [error].
        visible: errors with a signature.
        spread: S S^T of these, in the coordinates of `correlated`, [visible, visible].
        errors: relative error of each estimated scale, by effect.
    """

    before: DistributedErrors = field(repr=False)
    amounts: Array = field(repr=False)
    visible: NDArray[np.int64] = field(repr=False)
    spread: Array = field(repr=False)
    errors: Mapping[str, float]

    @property
    def sizes(self) -> dict[str, float]:
        """Estimated rms by effect."""
        own = zip(self.before.hypotheses, self.before.rms.tolist(), strict=True)
        return {name: rms for (name, _), rms in own}

    @cached_property
    def known(self) -> DistributedErrors:
        """Posterior distribution."""
        values, vectors = eigh(
            self.spread, subset_by_value=(MIN_SHARE / (1 - MIN_SHARE), np.inf), check_finite=False
        )
        seen = np.zeros((len(values), len(self.amounts)))
        seen[:, self.visible] = vectors.T
        return self.before.updated(self.amounts, values / (1 + values), seen)


@dataclass(frozen=True)
class Sums:
    """Sums of d rows / d amount over all rows, nuisances projected out.

    Attributes:
        gram: with each other, [error, error].
        inner: with the residual, [error].
        some: slopes in a few rows, nuisances not projected out, [error, row].
    """

    gram: Array
    inner: Array
    some: Array


def posterior(
    problem: Problem,
    known: DistributedErrors,
    *,
    learn: bool = True,
    unsure: float = np.inf,
    linearised_at: Array | None = None,
) -> Posterior:
    """Return the posterior of distributed errors, linearised at the most probable amounts.

    Args:
        problem: of the design.
        known: prior, with initial scales.
        learn: estimate the scales; else they stay.
        unsure: relative error of an estimated scale from which it is not below its initial one.
        linearised_at: first point of linearisation, [error]; None: the prior's mean.

    Raises:
        UnstableRingError: no beam is stored with the most probable errors.
    """
    names, belongs = families_of(known)
    amounts = stored = known.amounts if linearised_at is None else linearised_at
    nuisances, errors, usual = problem.first, dict[str, float](), known.rms
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
            least = np.where(found.error[belongs] < unsure, 0.0, usual)
            known = replace(known, rms=np.maximum(known.rms * found.scale[belongs], least))
        spread = known.correlated(known.correlated(known.rms[:, None] * sums.gram * known.rms).T)
        visible = np.flatnonzero(np.diag(spread) > 0)
        spread = spread[np.ix_(visible, visible)]
        pull = known.correlated(known.rms * (sums.inner + sums.gram @ beyond))
        most_probable = np.zeros(len(pull))
        rounding = len(visible) * np.finfo(float).eps * np.diag(spread).max(initial=0.0)
        ridge = (1 + rounding) * np.eye(len(visible))
        factor = cho_factor(spread + ridge, overwrite_a=True, check_finite=False)
        most_probable[visible] = cho_solve(factor, pull[visible], check_finite=False)
        own = zip(
            known.hypotheses,
            known.amounts + known.rms * known.correlated(most_probable),
            strict=True,
        )
        amounts = np.array([find(name).floored(amount) for (name, _), amount in own])
    return Posterior(known, amounts, visible, spread, errors)


def sums_at(
    problem: Problem,
    point: Point,
    known: DistributedErrors,
    amounts: Array,
    keep: NDArray[np.int64],
) -> Sums:
    """Return the sums at a point.

    Args:
        problem: with the distributed errors in it.
        point: of nuisances alone.
        known: the errors.
        amounts: amounts of the errors in the problem, [error].
        keep: rows for `Sums.some`.
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
        visible = np.flatnonzero(signatures.any(axis=1))
        own = slope[visible, None] * signatures[visible]
        gram[np.ix_(visible, visible)] += own @ own.T
        inner[visible] += own @ clean[rows]
        along[visible] += own @ directions[rows]
        here = column[rows]
        some[np.ix_(visible, here[here >= 0])] = own[:, here >= 0]
    gram -= along @ along.T
    return Sums(gram, inner, some)
