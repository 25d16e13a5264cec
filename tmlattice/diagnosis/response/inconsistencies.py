"""Inconsistency of the gradients by the RF's orbit and by the correctors' responses.

>>> found = inconsistencies(fit.state)
>>> found.missed, found.known, [(own.name, own.correctors, own.with_rf) for own in found.pulls]

Gradients are fitted to both. Those by the correctors alone predict the RF's orbit, unless kicks of
the closed orbit contribute to it. Where the prediction fails, the common fit biases the gradients.
Hausman's test (Econometrica 46, 1978) finds which ones: if one of two estimates is efficient, the
covariance of their difference is the difference of their covariances. All is linearised at the fit,
with its weights and without the kicks.
"""

from dataclasses import dataclass

import numpy as np

from tmlattice.arrays import REDUNDANT, Array, Indices, rms
from tmlattice.diagnosis.families.dispersion import HorizontalKicks
from tmlattice.diagnosis.families.fields import QuadrupoleGradient
from tmlattice.diagnosis.response.linear import linear
from tmlattice.diagnosis.response.state import State
from tmlattice.diagnosis.response.weights import taken, weight
from tmlattice.inference import chi2
from tmlattice.inference.judgement import DEFAULT, SIGNIFICANT
from tmlattice.inference.normal import Normal, solve
from tmlattice.lattice.supplies import magnets, supplied_alike


@dataclass(frozen=True)
class Pull:
    """An inconsistent gradient.

    Attributes:
        name: of a family of quadrupoles, or of one of them.
        correctors, correctors_sigma: estimate by the correctors' responses, relative to the design.
        with_rf, with_rf_sigma: estimate by these and the RF's orbit.
        pull: the difference, in its standard deviations.
    """

    name: str
    correctors: float
    correctors_sigma: float
    with_rf: float
    with_rf_sigma: float
    pull: float


@dataclass(frozen=True)
class Inconsistency:
    """The inconsistency of the two estimates.

    Attributes:
        missed: rms residual of the RF's orbit with gradients by the correctors alone, m.
        known: its expected rms, m, by the errors of these gradients and the effective noise.
        chi2, readings: of the RF's orbit, with the covariance of that prediction.
        pulls: inconsistent gradients, of families, then of magnets, the strongest first.
    """

    missed: float
    known: float
    chi2: float
    readings: int
    pulls: tuple[Pull, ...]


def inconsistencies(state: State, false_alarm: float = DEFAULT.false_alarm) -> Inconsistency | None:
    """Return the inconsistency; None if there is none, or without gradients or an RF's orbit.

    Args:
        state: of the fit.
        false_alarm: probability of a finding in consistent data.
    """
    single = QuadrupoleGradient()
    read, weights, left = _rf_fitted(state)
    if single.variable not in state.values or not read.size:
        return None
    there, column = linear(state, 0), len(state.data.plane) - 1
    rows = there.of_column(column, read, int(state.data.plane[column]))
    kicks = {group.name for group in HorizontalKicks().groups(state.data)}
    groups = [group for group in there.groups if group.name not in kicks]
    normal = there.normal
    without = Normal(
        normal.matrix - rows.T @ weights @ rows, normal.vector - rows.T @ weights @ left
    )
    alone, both = (solve(own, groups, there.start, rounds=0) for own in (without, normal))
    missed = left - rows @ (alone.values - there.start)
    spread = rows @ alone.spread
    covariance = np.linalg.inv(weights) + spread @ alone.covariance @ spread.T
    total = float(missed @ np.linalg.solve(covariance, missed))
    if chi2.sf(total, read.size) > false_alarm:
        return None
    own = magnets(state.data.ring, ("quadrupole",), powered=True)
    kinds, members = supplied_alike(state.data.ring)
    mean = np.vstack([(members / members.sum(axis=0)).T, np.eye(len(own))])
    names = [*kinds, *(pieces[0].name for pieces in own)]
    at, answers = there.where[single.variable], []
    for found in (alone, both):
        spread = mean @ found.spread[at]
        answers.append(
            (mean @ found.values[at], np.sum(spread @ found.covariance * spread, axis=1))
        )
    return Inconsistency(
        rms(missed),
        float(np.sqrt(np.mean(np.diag(covariance)))),
        total,
        len(read),
        _pulls(names, *answers[0], *answers[1], len(kinds)),
    )


def _rf_fitted(state: State) -> tuple[Indices, Array, Array]:
    """The BPMs at which the RF's orbit is fitted, the inverse covariance of these readings, 1/m2,
    and their residuals, m."""
    own = weight(state, 0)[-1]
    read = np.flatnonzero(own > 0)
    weights = np.diag(own[read])
    shared = taken(state, 0)
    if shared is not None:
        weights -= shared[-1, read] @ shared[-1, read].T
    return read, weights, state.data.pick(state.at.left)[-1, read]


def _pulls(
    names: list[str], alone: Array, wide: Array, both: Array, narrow: Array, families: int
) -> tuple[Pull, ...]:
    """Inconsistent families, then single magnets."""
    more = np.maximum(wide - narrow, REDUNDANT * wide)  # the information of the RF's orbit
    pulls = np.where(more > 0, (both - alone) / np.sqrt(np.where(more > 0, more, 1.0)), 0.0)
    order = sorted(range(len(names)), key=lambda i: (i >= families, -abs(pulls[i])))
    return tuple(
        Pull(
            names[i], float(alone[i]), float(np.sqrt(wide[i])), float(both[i]),
            float(np.sqrt(narrow[i])), float(pulls[i]),
        )
        for i in order
        if abs(pulls[i]) >= SIGNIFICANT
    )  # fmt: skip
