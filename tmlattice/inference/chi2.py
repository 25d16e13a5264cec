"""Tails of chi-square and Student's t, without scipy.stats, whose import takes half a second."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import chdtrc, chdtri, stdtr, stdtrit


def sf(statistic: ArrayLike, freedom: ArrayLike) -> Any:
    """Chance that a chi-square of so many degrees reaches this; NaN without a degree.

    Source: `scipy.stats.chi2.sf`, which calls the same function.
    """
    tail = chdtrc(freedom, np.maximum(statistic, 0.0))
    return np.where(np.asarray(freedom) > 0, tail, np.nan)[()]


def known(square: float, freedom: float) -> float:
    """The chi-square of one degree that is as rare as the square of Student's t.

    Args:
        square: of an amount over its error, whose variance is itself an estimate.
        freedom: degrees of that estimate; infinite: it is known.
    """
    if not np.isfinite(freedom):
        return square
    return float(chdtri(1, max(2 * stdtr(freedom, -np.sqrt(square)), 1e-300)))


def estimated(square: float, freedom: float) -> float:
    """The square of Student's t that is as rare as this chi-square of one degree: see `known`."""
    if not np.isfinite(freedom):
        return square
    return float(stdtrit(freedom, max(0.5 * chdtrc(1, square), 1e-300)) ** 2)


def isf(rate: ArrayLike, freedom: ArrayLike) -> Any:
    """What a chi-square of so many degrees reaches at this rate; NaN without a degree."""
    return np.where(np.asarray(freedom) > 0, chdtri(freedom, rate), np.nan)[()]
