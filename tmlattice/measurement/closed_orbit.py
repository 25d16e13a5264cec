"""The closed orbit of the stored beam, as it is."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tmlattice.errors import MeasurementError
from tmlattice.measurement.arrays import Unit, names_of, readings_of
from tmlattice.measurement.checks import (
    check_energy,
    check_values,
    checked_shots,
)
from tmlattice.measurement.monitors import Names, noise_table
from tmlattice.measurement.shots import Shots
from tmlattice.measurement.trajectory import Settings

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

    orbit: Array
    monitors: tuple[str, ...]
    noise: Array | None = None
    settings: tuple[Settings, ...] = ()
    shots: tuple[int, ...] = ()
    lattice: str | None = None
    energy: float | None = None

    @classmethod
    def from_arrays(
        cls,
        x: ArrayLike | None,
        y: ArrayLike | None,
        monitors: Iterable[Any],
        *,
        unit: Unit = "m",
        noise: Any = None,
        settings: Sequence[Settings] = (),
        shots: Sequence[int] = (),
    ) -> Self:
        """Return the closed orbits of two arrays.

        Args:
            x, y: [shot, monitor] or [monitor]; NaN where missing; None: not read.
            monitors: names, or elements of a ring.
            unit: of x and y.
            noise, settings, shots: see the attributes.

        Raises:
            MeasurementError: shapes that do not fit, or numbers that cannot be.
        """
        names = names_of(monitors)
        orbit = readings_of(x, y, names, ("shot",), unit)
        return cls(orbit, names, noise, tuple(settings), tuple(shots))

    def __post_init__(self) -> None:
        orbit, monitors = np.asarray(self.orbit, dtype=float), tuple(self.monitors)
        Names("monitor", monitors)
        if orbit.ndim != 3 or orbit.shape[1:] != (len(monitors), 2):
            raise MeasurementError(
                f"the closed orbit has the shape {orbit.shape}; {len(monitors)} monitors need "
                f"[shots, {len(monitors)}, 2]"
            )
        check_values(orbit, "reading")
        check_energy(self.energy)
        shots, settings = checked_shots(self.shots, self.settings, len(orbit), "orbits")
        self._keep(
            orbit=orbit,
            monitors=monitors,
            noise=noise_table(self.noise, monitors),
            settings=settings,
            shots=shots,
        )
