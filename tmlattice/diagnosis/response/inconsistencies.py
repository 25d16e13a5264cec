"""Inconsistency of the gradients from the RF's orbit and from the correctors' responses.

>>> found = inconsistencies(fit.state)
>>> found.missed, found.known, [(own.name, own.correctors, own.with_rf) for own in found.pulls]

Gradients are fitted to both. The estimate from the correctors alone predicts the RF's orbit, unless
kicks of the closed orbit contribute. Where the prediction fails, the common fit biases the
gradients. Hausman's test (Econometrica 46, 1978) finds which ones: the covariance of the difference
of two estimates, one of which is efficient, is the difference of their covariances. All of it is
linear about the fit, with its weights and without the kicks.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tmlattice.diagnosis.families.dispersion import HorizontalKicks
from tmlattice.diagnosis.families.fields import QuadrupoleGradient
from tmlattice.diagnosis.response.linear import linear
from tmlattice.diagnosis.response.rf_by_others import rf_fitted
from tmlattice.diagnosis.response.state import State
from tmlattice.inference import chi2
from tmlattice.inference.judgement import DEFAULT
from tmlattice.inference.normal import Normal, solve
from tmlattice.lattice.supplies import magnets, supplied_alike

Array = NDArray[np.float64]

CLEAR = 5.0
"""Standard deviations from which on gradients are reported."""
ROUNDING = 1e-6
"""Share of a variance below which a difference of two counts as zero."""


@dataclass(frozen=True)
class Pull:
    """An inconsistent gradient.

    Attributes:
        name: of a family of quadrupoles, or of one of them.
        correctors, correctors_sigma: estimate by the correctors' responses, relative to the design.
        with_rf, with_rf_sigma: estimate with the RF's orbit fitted, too.
        pull: the difference, in standard deviations of it.
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
        missed: by how much gradients by the correctors alone miss the RF's orbit, rms, m.
        known: by how much they would, rms, m: by their errors and the readings', as many of which
            the fit takes for independent.
        chi2, readings: of the RF's orbit, with the errors of that prediction.
        pulls: inconsistent gradients, the strongest first: of families, of magnets.
    """

    missed: float
    known: float
    chi2: float
    readings: int
    pulls: tuple[Pull, ...]

    def as_json(self) -> dict[str, Any]:
        """The entry in the file of the diagnosis."""
        return {**vars(self), "pulls": [dict(vars(own)) for own in self.pulls]}


def inconsistencies(state: State, false_alarm: float = DEFAULT.false_alarm) -> Inconsistency | None:
    """Return the inconsistency; None where the estimates agree, no gradients were fitted, or no
    RF's orbit was read.

    Args:
        state: of the fit.
        false_alarm: probability of a finding in consistent data.
    """
    single = QuadrupoleGradient()
    read, weights, left = rf_fitted(state)
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
        float(np.sqrt(np.mean(missed**2))),
        float(np.sqrt(np.mean(np.diag(covariance)))),
        total,
        len(read),
        _pulls(names, *answers[0], *answers[1], len(kinds)),
    )


def _pulls(
    names: list[str], alone: Array, wide: Array, both: Array, narrow: Array, families: int
) -> tuple[Pull, ...]:
    """Inconsistent families, then single magnets."""
    more = np.maximum(wide - narrow, ROUNDING * wide)  # the information of the RF's orbit
    pulls = np.where(more > 0, (both - alone) / np.sqrt(np.where(more > 0, more, 1.0)), 0.0)
    order = sorted(range(len(names)), key=lambda i: (i >= families, -abs(pulls[i])))
    return tuple(
        Pull(
            names[i], float(alone[i]), float(np.sqrt(wide[i])), float(both[i]),
            float(np.sqrt(narrow[i])), float(pulls[i]),
        )
        for i in order
        if abs(pulls[i]) >= CLEAR
    )  # fmt: skip
