"""Readings of plain arrays x and y, for the records' `from_arrays`."""

from collections.abc import Iterable, Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from tmlattice.arrays import Array
from tmlattice.errors import MeasurementError

Unit = Literal["m", "mm", "um", "nm"]

METRES = {
    "m": 1.0, "mm": 1e-3, "um": 1e-6, "nm": 1e-9,
    "µm": 1e-6, "micron": 1e-6, "meter": 1.0, "metre": 1.0,
}  # fmt: skip
"""Units of a reading, by every name that files give them, in m."""


def metres(unit: str) -> float:
    """The length of a unit of readings, m; MeasurementError: another unit."""
    if unit not in METRES:
        raise MeasurementError(f"no unit '{unit}'; readings are in {', '.join(METRES)}")
    return METRES[unit]


def names_of(elements: Iterable[Any]) -> tuple[str, ...]:
    """Names of elements of a ring; names stay."""
    return tuple(getattr(element, "name", element) for element in elements)


def readings_of(
    x: ArrayLike | None,
    y: ArrayLike | None,
    monitors: Sequence[str],
    axes: Sequence[str],
    unit: str,
) -> Array:
    """Return x and y as one array [*axes, monitor, 2], m.

    Args:
        x, y: [*axes, monitor], of which the first axes may be absent; None: not read.

    Raises:
        MeasurementError: another shape, another number of monitors, or neither x nor y.
    """
    if x is None and y is None:
        raise MeasurementError("neither x nor y is given; give one at least")
    given = {}
    wanted = f"[{', '.join((*axes, f'{len(monitors)} BPMs'))}]"
    for name, values in (("x", x), ("y", y)):
        if values is None:
            continue
        try:
            array = np.asarray(values, dtype=float)
        except (TypeError, ValueError):
            raise MeasurementError(f"{name} does not hold numbers; give an array") from None
        absent = len(axes) + 1 - array.ndim
        if not 0 <= absent <= len(axes) or array.shape[-1] != len(monitors):
            raise MeasurementError(f"{name} has the shape {array.shape}; it should be {wanted}")
        given[name] = metres(unit) * array.reshape((1,) * absent + array.shape)
    if len(shapes := {array.shape for array in given.values()}) > 1:
        raise MeasurementError(f"x and y have the shapes {shapes}; they should be alike")
    missing = np.full_like(next(iter(given.values())), np.nan)
    return np.stack([given.get("x", missing), given.get("y", missing)], axis=-1)
