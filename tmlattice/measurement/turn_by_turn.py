"""Turns of the stored beam after a kick."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
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

FEWEST, MOST = 16, 10_000
"""Turns: fewer have no line, more have lines that no decohering beam keeps."""


@dataclass(frozen=True, eq=False, repr=False)
class TurnByTurn(Shots):
    """Readings of a stored beam that was kicked before turn 0, on each of many turns.

    Attributes:
        readings: (x, y) in m, [shot, turn, monitor, 2]; NaN where missing, as behind a lost beam.
        monitors: names, in the order of the readings.
        noise: rms of one reading, m, [monitor, 2], NaN where unknown; None: all unknown. A pair
            (x, y), or a mapping of pairs by monitor, is taken too.
        settings: of each shot, see `Measurement`; () for the design's in every shot.
        shots: their ids; () for 0, 1, ...
        lattice, energy: what the data state about them (GeV); hints.
        devices: names that the control system has for monitors and correctors, by the names here;
            empty: unknown.

    Raises:
        MeasurementError: shapes that do not fit, numbers that cannot be, no reading at all, or
            less than 16 or more than 10,000 turns.
    """

    READ: ClassVar[str] = "readings"

    readings: Array
    monitors: tuple[str, ...]
    noise: Array | None = None
    settings: tuple[Settings, ...] = ()
    shots: tuple[int, ...] = ()
    lattice: str | None = None
    energy: float | None = None
    devices: Mapping[str, str] = field(default_factory=dict)

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
        """Return the turns of a stored beam of two arrays.

        Args:
            x, y: [shot, turn, monitor] or [turn, monitor]; NaN where missing; None: not read.
            monitors: names, or elements of a ring.
            unit: of x and y.
            noise, settings, shots: see the attributes.

        Raises:
            MeasurementError: shapes that do not fit, or numbers that cannot be.
        """
        names = names_of(monitors)
        readings = readings_of(x, y, names, ("shot", "turn"), unit)
        return cls(readings, names, noise, tuple(settings), tuple(shots))

    def __post_init__(self) -> None:
        readings, monitors = np.asarray(self.readings, dtype=float), tuple(self.monitors)
        Names("monitor", monitors)
        if readings.ndim != 4 or readings.shape[2:] != (len(monitors), 2):
            raise MeasurementError(
                f"readings have the shape {readings.shape}; turns at {len(monitors)} monitors need "
                f"[shots, turns, {len(monitors)}, 2]"
            )
        turns = readings.shape[1]
        if not FEWEST <= turns <= MOST:
            raise MeasurementError(
                f"{turns} turns are no turn-by-turn measurement, which has {FEWEST} to {MOST}; "
                + ("give fewer" if turns > MOST else "first turns are of the kind 'trajectory'")
            )
        check_values(readings, "reading")
        check_energy(self.energy)
        shots, settings = checked_shots(self.shots, self.settings, len(readings), "readings")
        self._keep(
            readings=readings,
            monitors=monitors,
            noise=noise_table(self.noise, monitors),
            settings=settings,
            shots=shots,
        )
