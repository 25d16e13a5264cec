"""Tails of the chi-square distribution, without scipy.stats, whose import takes half a second."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import chdtrc, chdtri


def sf(statistic: ArrayLike, freedom: ArrayLike) -> Any:
    """Chance that a chi-square of so many degrees reaches this; NaN without a degree.

    Source: `scipy.stats.chi2.sf`, which calls the same function.
    """
    tail = chdtrc(freedom, np.maximum(statistic, 0.0))
    return np.where(np.asarray(freedom) > 0, tail, np.nan)[()]


def isf(rate: ArrayLike, freedom: ArrayLike) -> Any:
    """What a chi-square of so many degrees reaches at this rate; NaN without a degree."""
    return np.where(np.asarray(freedom) > 0, chdtri(freedom, rate), np.nan)[()]
