"""Types of numpy arrays, their sizes, largest and smallest, and their root mean square."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
Reals = NDArray[np.floating[Any]]  # of any precision
ComplexArray = NDArray[np.complex128]
Flags = NDArray[np.bool_]
Indices = NDArray[np.int64]

AT_ONCE = 2**24
"""Numbers of an intermediate array in memory, 128 MB."""
TINY = 1e-100
"""In place of a divisor of zero; its square is a number, too."""
ROUNDING = 1e-11
"""Relative rounding error of a sum over all readings."""
INVISIBLE = 1e-9
"""Share of a square below which what is left of it may be rounding."""
REDUNDANT = 1e-6
"""Share of the information on a number below which the others determine it: what remains may be the
rounding of large sums."""


def rms(values: ArrayLike) -> float:
    """Root mean square of all values; NaN of none."""
    size = np.asarray(values)
    return float(np.sqrt(np.mean(size**2))) if size.size else float("nan")


def finite(
    values: ArrayLike, nan: float = 0.0, posinf: float | None = None, neginf: float | None = None
) -> Array:
    """Return `numpy.nan_to_num` of the values, which copies them and takes 50 µs; finite values
    are returned as they are."""
    given = np.asarray(values, dtype=float)
    if np.isfinite(given).all():
        return given
    return np.asarray(np.nan_to_num(given, nan=nan, posinf=posinf, neginf=neginf))


def pair(values: ArrayLike) -> tuple[float, float]:
    """Two values, such as of x and y, as numbers."""
    x, y = np.asarray(values, dtype=float).tolist()
    return x, y
