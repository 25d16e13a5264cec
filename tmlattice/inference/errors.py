"""Errors of a fit, widened for what its posterior leaves out.

Cluster-robust errors of a fit whose readings share model discrepancy, by column or by monitor. A
posterior takes readings as independent. Model discrepancy of a corrector's column is often a wave
in all of its readings, and that at a monitor is the same in all columns. Each cluster of readings
(one column, or one monitor) is therefore taken out of the normal equations and compared with the
prediction of all others (a jackknife, exact for linear least squares: Bell and McCaffrey, Survey
Methodology 28 (2002) 169). Errors grow by the ratio of the observed to the expected mismatch.

Posterior moments when any member of a group may be the faulty one. A Gaussian prior at the scale of
sound members excludes a faulty member, whatever the data. Here each member's prior is a mixture of
Gaussians (`Group.mixture`), and the posterior's moments are found by expectation propagation
(Minka, UAI 2001; for sparse linear models Seeger, JMLR 9 (2008) 759): each prior is replaced by a
Gaussian whose product with the rest has the mean and variance of the exact product. If the data
cannot distinguish two members, both have large errors.

Uncertainty of numbers that comes from the uncertain scales of their priors. A family's prior scale
follows the evidence. With few members, or little data on them, the evidence is flat: a scale near
zero, which fixes the members, is as probable as one twenty times larger. The same holds for a
family that was rejected. Errors at one scale alone are then far too small. Scales are therefore
sampled from their posterior with the members integrated out, and the law of total variance gives
the additional variance of each number.
"""

from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Sequence
from copy import copy
from itertools import combinations
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse import csr_array

from tmlattice.arrays import ROUNDING, TINY, Array, Flags, Indices
from tmlattice.inference.newton import ITERATIONS, SETTLED
from tmlattice.inference.normal import (
    Normal,
    Slopes,
    in_basis,
    inverse_by_factor,
    inverse_of_lower,
    lower_factor,
    shared_by,
    times_precision,
)
from tmlattice.inference.priors import Group

MAX_LEVERAGE = 0.75
"""Leverage of a cluster above which the other readings know too little to test it. The mean
mismatch of the others is then used in its place."""

MAX_CLUSTERS = 64
"""Columns, and monitors, that are taken out at most, drawn at random."""


class Rows(NamedTuple):
    """Derivatives of readings, as in `normal.normal_equations`.

    Attributes:
        plane: in which each column is read, [column].
        by_monitor, by_column: [column, monitor].
        by_ring: of each family of errors.
    """

    plane: Indices
    by_monitor: Array
    by_column: Array
    by_ring: Sequence[Slopes]

    def times(self, column: Indices, monitor: Indices, other: Array) -> Array:
        """Return rows of some readings times [parameter, any], [reading, any]."""
        columns, monitors = self.by_monitor.shape
        ring = 2 * monitors + columns
        out = np.zeros((len(column), other.shape[1]))
        for own in self.by_ring:
            out += own.of(column, monitor).T @ other[ring : ring + len(own.rows)]
            ring += len(own.rows)
        gain, scale = self.by_monitor[column, monitor], self.by_column[column, monitor]
        out += gain[:, None] * other[2 * monitor + self.plane[column]]
        out += scale[:, None] * other[2 * monitors + column]
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
        taken: L of `inference.normal.common`, the readings' common modes, [column, monitor,
            pattern]; None: no common modes.

    Returns:
        Standard deviations, [quantity].
    """
    # the readings' part of the variance; the rest is the prior's
    noise_variance = (found.along * (found.matrix @ found.along)).sum(axis=0)
    more = np.zeros_like(noise_variance)
    for clusters in (_of_columns, _of_monitors):
        shares, mismatch = _mismatches(clusters(rows, weight, residual, taken), found)
        size = np.maximum(shares.sum(axis=0), TINY)
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
    shared = None if taken is None else (taken, shared_by(*rows, taken))
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
        grown = np.maximum((Y * solved[:, :-1]).sum(axis=0), TINY)  # of the variance without it
        whole = np.where(known, found.variance + grown, 1.0)
        share = np.where(known, grown / whole, 0.0)
        own = moved**2 / grown
        leverage = np.where(share < MAX_LEVERAGE, share, 0.0)
        elsewhere = float(leverage @ own) / max(float(leverage.sum()), TINY)
        shares.append(share)
        mismatch.append(np.where(share < MAX_LEVERAGE, own, elsewhere))
    return np.array(shares), np.array(mismatch)


def _apart(inside: Array, right: Array) -> Array:
    """(1 - inside)^-1 right, with eigenvalues of at least `ROUNDING`."""
    matrix = (1 + ROUNDING) * np.eye(len(inside)) - inside
    try:
        return np.asarray(cho_solve(cho_factor(matrix), right))
    except np.linalg.LinAlgError:  # by rounding: readings far above their noise
        size, vectors = np.linalg.eigh(matrix)
        return np.asarray(vectors @ ((vectors.T @ right) / np.maximum(size, ROUNDING)[:, None]))


DAMPING, LARGEST = 0.3, 0.5
"""Share of each update that is applied, and the largest change of a log precision: all members are
updated at once, and two that compensate each other would oscillate."""
DATA_ALONE = 1e3
"""Information over that of the narrowest prior component above which the prior is ignored."""


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

    def some(self, members: Flags) -> "_Mixtures":
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
    priors = _Mixtures(groups)
    unit = np.sqrt(priors.variance)  # scales the matrix
    basis = csr_array(np.concatenate([group.basis for group in groups], axis=1) * unit)
    A, b = in_basis(normal, basis, start)
    A[np.diag_indices(len(A))] *= 1 + ROUNDING
    priors.square /= priors.variance[:, None]
    precision, pull = np.ones(len(A)), np.zeros(len(A))
    rest = 1 / _marginals(A, b)[1] - 1
    open_ = rest * priors.square.min(axis=1) < DATA_ALONE  # the prior matters for these alone
    if open_.any():
        within, score, _ = _integrated(A, b, open_)
        precision[open_], pull[open_] = _sites(within, score, priors.some(open_))
    covariance = inverse_by_factor(lower_factor(A + np.diag(precision)))
    return Moments(basis @ (covariance @ (b + pull)), (basis @ covariance) @ basis.T)


def _integrated(A: Array, b: Array, kept: Flags) -> tuple[Array, Array, Array]:
    """Information and score of some members, the others integrated out with priors of size 1; and
    how far these follow each of them, [other, kept]."""
    rest = ~kept
    across = A[np.ix_(rest, kept)]
    follow = np.asarray(np.linalg.solve(A[np.ix_(rest, rest)] + np.eye(len(across)), across))
    within = A[np.ix_(kept, kept)] - across.T @ follow
    return (within + within.T) / 2, b[kept] - follow.T @ b[rest], follow


def _sites(A: Array, b: Array, priors: _Mixtures) -> tuple[Array, Array]:
    """Precisions and shifts of the Gaussians in place of the priors."""
    precision, pull = np.ones(len(A)), np.zeros(len(A))
    for _ in range(ITERATIONS):
        mean, variance = _marginals(A, b, precision, pull)
        rest = np.maximum(1 / variance - precision, 0.0)
        others = mean / variance - pull
        center, spread = priors.times(rest, others)
        wanted = np.maximum(1 / spread - rest, 1.0)  # no wider than the prior
        drawn = center * (rest + wanted) - others
        changed = max(
            np.abs((center - mean) / np.sqrt(variance)).max(),
            np.abs(np.log((wanted + rest) * variance)).max(),
        )
        if changed < SETTLED:
            break
        step = DAMPING * np.log(wanted / precision)
        precision = precision * np.exp(np.clip(step, -LARGEST, LARGEST))
        pull = pull + DAMPING * (drawn - pull)
    return precision, pull


def _marginals(
    A: Array, b: Array, precision: Array | float = 1.0, pull: Array | float = 0.0
) -> tuple[Array, Array]:
    """Mean and variance of each member with Gaussian priors of these precisions and shifts."""
    half = inverse_of_lower(lower_factor(A + precision * np.eye(len(A))))
    return half.T @ (half @ (b + pull)), np.einsum("ij,ij->j", half, half)


KNOWN_MEMBERS = 6.0
"""Members determined by the data above which the scale is known to 30 %."""
MAX_MEMBERS = 128
"""Members above which a scale is not sampled: each draw costs the third power."""
FACTORS = np.log(2) * np.arange(-5, 6)
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
    basis = csr_array(np.concatenate([group.basis * group.scale for group in groups], axis=1))
    own = np.repeat(np.arange(len(groups)), [group.basis.shape[1] for group in groups])
    absent = np.array([group.name in gone for group in groups])
    A, b = in_basis(normal, basis, start)
    A[np.diag_indices(len(A))] *= 1 + ROUNDING
    known = np.where(absent[own], 0.0, 1 - _marginals(A, b)[1])
    unsure = np.array([
        absent[i]
        or (not group.fixed and (own == i).sum() <= MAX_MEMBERS
            and 0 < known[own == i].sum() < KNOWN_MEMBERS)
        for i, group in enumerate(groups)
    ])  # fmt: skip
    if not unsure.any():
        return np.zeros((len(start), 0))
    U = unsure[own]
    information, score, follow = _integrated(A, b, U)
    sizes = _Scales(
        information,
        score,
        (np.cumsum(unsure) - 1)[own[U]],
        [group for group, here in zip(groups, unsure, strict=True) if here],
        absent[unsure],
    )
    moved = basis[:, U] - basis[:, ~U] @ follow
    variance, directions = np.linalg.eigh(sizes.more())
    return np.asarray(moved @ (directions * np.sqrt(np.maximum(variance, 0))))


Chosen = tuple[int, ...]
"""Which of its scales each group has."""


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
        absent: Flags,
    ) -> None:  # fmt: skip
        self.information, self.score, self.group = information, score, group
        self.known: dict[Chosen, float] = {}
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

    def _inside(self, scales: Array) -> tuple[Array, Array]:
        """Prior rms of the members, and their posterior precision in these units."""
        scale = np.exp(scales)[..., self.group]
        inside = scale[..., :, None] * self.information * scale[..., None, :]
        return scale, inside + np.eye(len(self.group))

    def scales(self, chosen: Chosen) -> Array:
        """Log factors of the present scales, [group]."""
        return np.array([own[k] for own, k in zip(self.choices, chosen, strict=True)])

    def log_posterior(self, several: Sequence[Chosen]) -> Array:
        """Log posterior densities of several choices, all members integrated out; a chain returns
        to the same ones, which are computed once."""
        new = [chosen for chosen in several if chosen not in self.known]
        if new:
            scale, inside = self._inside(np.array([self.scales(chosen) for chosen in new]))
            root = np.linalg.cholesky(inside)
            pull = np.linalg.solve(root, (scale * self.score)[..., None])
            log_volume = np.log(np.diagonal(root, axis1=-2, axis2=-1)).sum(axis=-1)
            found = 0.5 * np.sum(pull**2, axis=(-2, -1)) - log_volume
            for chosen, evidence in zip(new, found.tolist(), strict=True):
                own = zip(self.chances, chosen, strict=True)
                self.known[chosen] = evidence + sum(chances[k] for chances, k in own)
        return np.array([self.known[chosen] for chosen in several])

    def _swapped(self, chosen: Chosen, a: int, b: int) -> Chosen | None:
        """The choice with the scales of two groups swapped; None outside their support."""
        found = list(chosen)
        for to, of in ((a, b), (b, a)):
            there = np.flatnonzero(self.choices[to] == self.choices[of][chosen[of]])
            if not len(there):
                return None
            found[to] = int(there[0])
        return tuple(found)

    def amounts(self, scales: Array) -> tuple[Array, Array]:
        """Most probable amounts, and their covariance."""
        scale, inside = self._inside(scales)
        covariance = scale[:, None] * np.linalg.inv(inside) * scale
        return covariance @ self.score, covariance

    def more(self) -> Array:
        """Covariance that sampled scales add to that at the present ones, [member, member], by
        Gibbs sampling."""
        random = np.random.default_rng(0)
        mean, stated = self.amounts(self.now)
        here: Chosen = tuple(int(np.flatnonzero(own == 0)[0]) for own in self.choices)
        visits: Counter[Chosen] = Counter()
        for draw in range(DRAWS):
            for i, choices in enumerate(self.choices):
                tried = [(*here[:i], k, *here[i + 1 :]) for k in range(len(choices))]
                values = self.log_posterior(tried)
                weights = np.exp(values - values.max())
                here = tried[random.choice(len(tried), p=weights / weights.sum())]
            for a, b in self.pairs:  # two groups that compensate each other
                limit = np.log(random.random())
                if other := self._swapped(here, a, b):
                    there, now = self.log_posterior([other, here])
                    here = other if limit < there - now else here
            if draw >= BURN_IN:
                visits[here] += 1
        total = np.zeros_like(stated)
        for chosen, times in visits.items():
            then, spread = self.amounts(self.scales(chosen))
            total += times * (spread + np.outer(then - mean, then - mean))
        return np.asarray(total / (DRAWS - BURN_IN) - stated)
