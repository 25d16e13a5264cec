"""The stated errors of a hierarchical fit's numbers, and its causes with these errors.

>>> there = linear(state, 0)
>>> sigma = stated(state, 0, there, there.posterior).sigma
"""

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag

from tmlattice.arrays import TINY, Array
from tmlattice.diagnosis.families.family import Family, StatedCause
from tmlattice.diagnosis.response.linear import Linear, linear
from tmlattice.diagnosis.response.state import Candidate, State, allow
from tmlattice.diagnosis.response.weights import taken, weight
from tmlattice.diagnosis.support import (
    SHOWN,
    Correlation,
    Support,
    correlations_of,
    share_from_data,
)
from tmlattice.effects import Hypothesis
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
    return Stated(posterior.sigma, posterior.before, posterior.whole)


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
    return Stated(np.sqrt(square), posterior.before, tails.covariance)


def of_readings(state: State, block: int, there: Linear, posterior: Posterior) -> Array:
    """Return posterior errors, widened for columns or BPMs that contradict all others; made once
    for each state."""

    def widened() -> Array:
        found = LinearFit.of(there.normal.matrix, posterior.whole)
        return _widened(state, block, there, posterior, found)

    return state.once(("of readings", block), widened)


def of_sizes(state: State, block: int, there: Linear) -> Array:
    """Return a root F of the covariance F F^T by unknown prior scales, those of rejected families
    included, [parameter, direction]; see `stated`. It is sampled once for each state."""
    return state.once(("of sizes", block), lambda: _sampled(state, block, there))


def _sampled(state: State, block: int, there: Linear) -> Array:
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
    rows = Rows(data.plane_of(block), there.by_monitor, there.by_column, there.ring)
    weights = weight(state, block)
    # rounds end before full precision
    moved = there.readings(rows.plane, posterior.values - there.start)
    left = np.where(weights > 0, data.pick(state.at.left, block) - moved, 0.0)
    return cluster_robust_errors(rows, weights, left, found, taken(state, block))


AGAINST = 0.4
"""Posterior correlation above which numbers are degenerate."""


def fitted_causes(
    state: State,
) -> tuple[list[StatedCause], tuple[Support, ...], tuple[str, ...], tuple[Correlation, ...], Array]:
    """Return causes with stated errors; their support by the data; messages on degeneracies;
    strongly correlated amounts; and the covariance of the stated errors, [cause, cause], without
    correlations between planes."""
    found: list[StatedCause] = []
    supports: list[Support] = []
    messages: tuple[str, ...] = ()
    pairs: list[Correlation] = []
    blocks: list[Array] = []
    for block in (0, 1):
        families = {f.variable: f for f in state.of_block(block)}
        if not families:
            continue
        there = linear(state, block)
        posterior = there.posterior
        known = stated(state, block, there, posterior)
        own: list[StatedCause] = []
        for row, support in with_support(state, families.values(), there, known):
            if row[0].amount != 0 or row[1] != 0:
                own.append(row)
                supports.append(support)
        numbers = _numbers(state, families.values(), there)
        blocks.append(_covariance(own, numbers, known.covariance))
        found += own
        first = 2 * state.data.shape[1] + state.data.shape[0]
        ring = [i for i in numbers if i >= first]  # each is named by its first cause
        causes = [next(iter(numbers[i])) for i in ring]
        pairs += correlations_of(causes, known.covariance[np.ix_(ring, ring)])
        if block == 0:
            messages = _degenerate(state, there, posterior)
    return found, tuple(supports), messages, tuple(pairs), block_diag(*blocks)


def _covariance(rows: Sequence[StatedCause], numbers: "Hypotheses", covariance: Array) -> Array:
    """Correlations of a block's numbers, and the stated errors of its causes."""
    place = {(cause.effect, cause.element): i for i, (cause, _) in enumerate(rows)}
    slopes = np.zeros((len(rows), len(covariance)))
    for number, moves in numbers.items():
        for hypothesis, amount in moves.items():
            if hypothesis in place:
                slopes[place[hypothesis], number] = amount
    both = slopes @ covariance @ slopes.T
    width = np.sqrt(np.maximum(np.diag(both), TINY))
    correlation = both / width[:, None] / width
    np.fill_diagonal(correlation, 1.0)
    sigma = np.array([own for _, own in rows])
    return np.asarray(sigma[:, None] * correlation * sigma)


def with_support(
    state: State, families: Collection[Family], there: Linear, known: Stated
) -> Iterator[tuple[StatedCause, Support]]:
    """Yield the causes of some families of a block, and their support by the data.

    Args:
        state, there: the state, and `linear` of the block.
        families: with a variable each.
        known: stated errors of the block.
    """
    numbers = _numbers(state, families, there)
    for family in families:
        own, values = there.where[family.variable], state.values[family.variable]
        rows = family.causes_of(state.at.errors, values, known.sigma[own], state.data)
        # the errors before the data in the units of the causes
        before = family.causes_of(state.at.errors, values, known.prior[own], state.data)
        for row, (_, prior) in zip(rows, before, strict=True):
            yield row, _support(row, prior, own, known.covariance, numbers)


Hypotheses = Mapping[int, Mapping[Hypothesis, float]]


def _numbers(state: State, families: Iterable[Family], there: Linear) -> Hypotheses:
    """The catalogue's effects of each number of the fit, by its place in the fit."""
    numbers: dict[int, Mapping[Hypothesis, float]] = {}
    for family in families:
        first = there.where[family.variable].start
        numbers |= {first + i: own for i, own in enumerate(family.moves(state.data)) if own}
    return numbers


def _support(
    row: StatedCause, prior: float, own: slice, covariance: Array, numbers: Hypotheses
) -> Support:
    """One cause, with its error before the data; `own` are its family's numbers."""
    cause, sigma = row
    support = Support(share_from_data(sigma, prior))
    if support.determined:
        return support
    here = (cause.effect, cause.element)
    mine = [i for i in range(own.start, own.stop) if here in numbers.get(i, {})]
    width = np.sqrt(np.maximum(np.diag(covariance), TINY))
    near: dict[int, float] = {}
    for i in mine:
        correlation = covariance[i] / (width[i] * width)
        for j in np.argsort(-np.abs(correlation))[: SHOWN + len(mine)].tolist():
            if j not in mine and j in numbers and abs(correlation[j]) > AGAINST:
                near[j] = max(near.get(j, 0.0), float(correlation[j]), key=abs)
    order = sorted(near, key=lambda j: -abs(near[j]))[:SHOWN]
    return replace(
        support, degenerate_with=tuple((*next(iter(numbers[j])), near[j]) for j in order)
    )


def _degenerate(state: State, there: Linear, posterior: Posterior) -> tuple[str, ...]:
    """A message on the scale that gains and calibrations share."""
    messages = []
    columns, monitors = state.data.shape
    m = 2 * monitors
    spread = posterior.spread
    factor = np.linalg.cholesky(posterior.covariance + 1e-12 * np.eye(spread.shape[1]))
    draws = spread @ factor
    scale = draws[:m].mean(axis=0)
    kick = draws[m : m + columns - 1].mean(axis=0)
    if scale.any() and kick.any():  # both are fitted
        both = float(scale @ kick / np.sqrt((scale @ scale) * (kick @ kick)))
        messages.append(
            "mean BPM gain against mean corrector scale: known to "
            f"{100 * np.sqrt(scale @ scale):.2f} % by the RF step and the priors, correlation "
            f"{both:+.2f}"
        )
    return tuple(messages)
