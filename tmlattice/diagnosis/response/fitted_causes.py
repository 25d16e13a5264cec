"""Causes with errors from a hierarchical fit of an orbit response."""

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.linalg import block_diag

from tmlattice.arrays import TINY, Array
from tmlattice.diagnosis.families.family import Family, StatedCause
from tmlattice.diagnosis.response.linear import Linear, linear
from tmlattice.diagnosis.response.state import State
from tmlattice.diagnosis.response.stated import Stated, stated
from tmlattice.diagnosis.support import Correlation, Support, correlations_of, share_from_data
from tmlattice.inference.normal import Posterior
from tmlattice.inference.problem import Hypothesis

AGAINST, SHOWN = 0.4, 3
"""Posterior correlation above which numbers are degenerate, and how many of them are named."""


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
    factor = np.linalg.cholesky(posterior.covariance + 1e-12 * np.eye(len(spread.T)))
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
