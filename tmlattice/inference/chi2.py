"""Tails of chi-square and Student's t, without scipy.stats, whose import takes half a second."""

import warnings
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import chdtrc, chdtri, stdtr, stdtrit


def sf(statistic: ArrayLike, freedom: ArrayLike) -> Any:
    """Probability that a chi-square with these degrees of freedom exceeds a value; NaN without any.

    Source: `scipy.stats.chi2.sf`, which calls the same function.
    """
    tail = chdtrc(freedom, np.maximum(statistic, 0.0))
    return np.where(np.asarray(freedom) > 0, tail, np.nan)[()]


def known(square: float, freedom: float) -> float:
    """Chi-square of one degree of freedom with the tail probability of a squared Student's t.

    Args:
        square: of an amount over its error, whose variance is itself an estimate.
        freedom: degrees of freedom of that estimate; infinite: the variance is known.
    """
    if not np.isfinite(freedom):
        return square
    return float(chdtri(1, max(2 * stdtr(freedom, -np.sqrt(square)), 1e-300)))


def estimated(square: float, freedom: float) -> float:
    """Squared Student's t with the tail probability of a chi-square of one degree: see `known`."""
    if not np.isfinite(freedom):
        return square
    return float(stdtrit(freedom, max(0.5 * chdtrc(1, square), 1e-300)) ** 2)


def isf(rate: ArrayLike, freedom: ArrayLike) -> Any:
    """Quantile of chi-square at an upper tail probability; NaN without a degree of freedom."""
    return np.where(np.asarray(freedom) > 0, chdtri(freedom, rate), np.nan)[()]


MAD = 1.4826
"""rms of a Gaussian over the median of its modulus."""


def typical(values: ArrayLike, axis: int | None = None) -> Any:
    """Robust rms about zero, by the median modulus, along an axis; NaN, without a warning, of none.

    Args:
        values: NaN where there is none.
        axis: that is reduced; None: all.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # no values
        return MAD * np.nanmedian(np.abs(values), axis=axis)


def median_per_freedom(freedom: ArrayLike) -> Any:
    """Median of chi-square over its degrees of freedom, by Wilson and Hilferty."""
    return (1 - 2 / (9 * np.asarray(freedom))) ** 3
