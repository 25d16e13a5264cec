"""Pairs of strongly correlated amounts, by the posterior correlation of their errors."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tmlattice.inference.problem import Hypothesis

STRONG = 0.9
"""Correlation from which on a pair is reported: the error of each is 2.3 times the one given the
other."""
MOST = 8
"""Pairs that are reported."""


@dataclass(frozen=True)
class Correlation:
    """Two amounts that the data hardly separate.

    Attributes:
        first, second: effect and element of each; None: the beam.
        correlation: of their errors, between -1 and 1.
    """

    first: Hypothesis
    second: Hypothesis
    correlation: float

    def as_json(self) -> dict[str, Any]:
        """The entry in the file of the diagnosis."""
        one, other = (
            {"effect": effect, "element": element} for effect, element in (self.first, self.second)
        )
        return {"first": one, "second": other, "correlation": self.correlation}


def correlations_of(
    amounts: Sequence[Hypothesis], covariance: NDArray[np.float64]
) -> tuple[Correlation, ...]:
    """The pairs with the strongest correlations, from `STRONG` on.

    Args:
        amounts: effect and element of each.
        covariance: of their errors, [amount, amount].
    """
    sigma = np.sqrt(np.maximum(np.diagonal(covariance), 0.0))
    known = np.flatnonzero(sigma > 0)
    matrix = covariance[np.ix_(known, known)] / sigma[known, None] / sigma[known]
    matrix = np.clip(np.triu(matrix, 1), -1.0, 1.0)
    rows, columns = np.nonzero(np.abs(matrix) >= STRONG)
    order = np.argsort(-np.abs(matrix[rows, columns]), kind="stable")
    found: list[Correlation] = []
    for i, j in zip(known[rows[order]], known[columns[order]], strict=True):
        if amounts[i] != amounts[j] and len(found) < MOST:
            value = float(covariance[i, j] / sigma[i] / sigma[j])
            found.append(Correlation(amounts[i], amounts[j], float(np.clip(value, -1, 1))))
    return tuple(found)
