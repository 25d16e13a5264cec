"""The share of a fitted number that comes from the data, and its degeneracies.

>>> support = diagnosis.support("quadrupole_gradient", "qd::12")
>>> support.share_from_data, support.determined, support.degenerate_with
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from tmlattice.arrays import Array
from tmlattice.diagnosis.records import of
from tmlattice.effects import Hypothesis, find
from tmlattice.inference.judgement import ENOUGH

SHOWN = 3
"""Alternatives, suspects of a kind, and elements of a message that are named."""
DETERMINED = 0.5
"""Share from the data below which a number is undetermined (1 - posterior variance / prior
variance)."""


@dataclass(frozen=True)
class Support:
    """The support of one fitted number by the data.

    Attributes:
        share_from_data: 1 - posterior variance / prior variance, from 0 to 1.
        degenerate_with: effect and element of other numbers with the largest posterior
            correlations, and these; only of what the data do not determine.
    """

    share_from_data: float
    degenerate_with: tuple[tuple[str, str | None, float], ...] = field(
        default=(), metadata=of("effect", "element", "correlation")
    )

    @property
    def determined(self) -> bool:
        """Whether the data determine the number."""
        return self.share_from_data >= DETERMINED


def share_from_data(sigma: float, prior: float) -> float:
    """Return 1 - posterior variance / prior variance, from 0 to 1, of two rms in one unit."""
    return min(max(1 - (sigma / prior) ** 2, 0.0), 1.0) if prior > 0 else 0.0


def share_of_fault(effect: str | None, sigma: float | None) -> float | None:
    """Return the share from the data of a fault, which before them may be as large as the largest
    of its effect; None for an amount without a standard error, in the effect's unit."""
    if effect is None or sigma is None:
        return None
    return share_from_data(sigma, find(effect).largest)


FREE = Support(1.0)
"""The support of an amount with a log-uniform prior."""


STRONG = 0.9
"""Correlation from which on a pair is reported: the error of each is 2.3 times the one given the
other."""


@dataclass(frozen=True)
class Correlation:
    """Two amounts that the data hardly separate.

    Attributes:
        first, second: effect and element of each; None: the beam.
        correlation: of their errors, between -1 and 1.
    """

    first: Hypothesis = field(metadata=of("effect", "element"))
    second: Hypothesis = field(metadata=of("effect", "element"))
    correlation: float


def correlations_of(amounts: Sequence[Hypothesis], covariance: Array) -> tuple[Correlation, ...]:
    """The pairs with the strongest correlations, from `STRONG` on, by the covariance of the errors,
    [amount, amount]."""
    sigma = np.sqrt(np.maximum(np.diagonal(covariance), 0.0))
    known = np.flatnonzero(sigma > 0)
    matrix = covariance[np.ix_(known, known)] / sigma[known, None] / sigma[known]
    matrix = np.clip(np.triu(matrix, 1), -1.0, 1.0)
    rows, columns = np.nonzero(np.abs(matrix) >= STRONG)
    order = np.argsort(-np.abs(matrix[rows, columns]), kind="stable")
    found: list[Correlation] = []
    for i, j in zip(known[rows[order]], known[columns[order]], strict=True):
        if amounts[i] != amounts[j] and len(found) < ENOUGH:
            value = float(covariance[i, j] / sigma[i] / sigma[j])
            found.append(Correlation(amounts[i], amounts[j], float(np.clip(value, -1, 1))))
    return tuple(found)
