"""Types of numpy arrays, their sizes, largest and smallest, and their root mean square."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
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


def pair(values: ArrayLike) -> tuple[float, float]:
    """Two values, such as of x and y, as numbers."""
    x, y = np.asarray(values, dtype=float).tolist()
    return x, y
