"""The closed orbit of the stored beam, as it is."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from tmlattice.measurement.checks import Settings
from tmlattice.measurement.shots import Shots

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False, repr=False)
class ClosedOrbit(Shots):
    """Closed orbits, absolute: what the monitors read, offsets and all.

    Attributes:
        orbit: (x, y) in m, [shot, monitor, 2]; NaN where missing.
        monitors: names, in the order of the readings.
        noise: rms of one (averaged) reading, m, [monitor, 2], NaN where unknown; None: all unknown.
            A pair (x, y), or a mapping of pairs by monitor, is taken too.
        settings: of each shot, see `Measurement`; () for the design's in every shot.
        shots: their ids; () for 0, 1, ...
        lattice, energy: what the data state about them (GeV); hints.

    Raises:
        MeasurementError: shapes that do not fit, numbers that cannot be, or no reading at all.
    """

    READ: ClassVar[str] = "orbit"
    AXES: ClassVar[tuple[str, ...]] = ("shot",)

    orbit: Array
    monitors: tuple[str, ...]
    noise: Array | None = None
    settings: tuple[Settings, ...] = ()
    shots: tuple[int, ...] = ()
    lattice: str | None = None
    energy: float | None = None
