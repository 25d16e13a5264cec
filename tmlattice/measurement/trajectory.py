"""Trajectories as the monitors read them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tmlattice.errors import MeasurementError, unknown_name

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Measurement:
    """Readings of one or more shots.

    Attributes:
        launches: states at the start of the ring, [shot, n], in OCELOT's coordinates.
        readings: (x, y) in m, [shot, turn, monitor, 2]; NaN where a reading is missing.
        monitors: names, in the order of the readings.
        noise: rms of one reading in each plane, m, or None where it is not known.

    Raises:
        MeasurementError: shapes that do not fit, or no reading at all.
    """

    launches: Array
    readings: Array
    monitors: tuple[str, ...]
    noise: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        shots = len(self.launches)
        if self.readings.ndim != 4 or self.readings.shape[::2] != (shots, len(self.monitors)):
            raise MeasurementError(
                f"readings have the shape {self.readings.shape}; {shots} launches and "
                f"{len(self.monitors)} monitors need [{shots}, turns, {len(self.monitors)}, 2]"
            )
        if not np.isfinite(self.launches).all():
            raise MeasurementError("a launch is not finite; give x, px, y, py of every shot")
        if not np.isfinite(self.readings).any():
            raise MeasurementError("every reading is missing; nothing can be fitted")

    def in_order_of(self, monitors: Sequence[str]) -> Array:
        """Readings [shot, turn, monitor, 2] in another order of monitors, NaN where not read.

        Raises:
            UnknownNameError: this measurement has a monitor that is not among them.
        """
        place = {name.casefold(): i for i, name in enumerate(monitors)}
        result = np.full((*self.readings.shape[:2], len(monitors), 2), np.nan)
        for i, name in enumerate(self.monitors):
            if name.casefold() not in place:
                raise unknown_name("monitor", name, monitors)
            result[:, :, place[name.casefold()]] = self.readings[:, :, i]
        return result
