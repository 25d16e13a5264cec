"""Turns of the stored beam after a kick."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tmlattice.errors import MeasurementError
from tmlattice.measurement.checks import (
    check_energy,
    check_values,
    checked_shots,
    keep,
    monitor_places,
    shot_places,
    spread,
)
from tmlattice.measurement.monitors import Names, noise_table
from tmlattice.measurement.shown import Shown
from tmlattice.measurement.trajectory import Settings

Array = NDArray[np.float64]

FEWEST, MOST = 16, 10_000
"""Turns: fewer have no line, more have lines that no decohering beam keeps."""


@dataclass(frozen=True, eq=False, repr=False)
class TurnByTurn(Shown):
    """Readings of a stored beam that was kicked before turn 0, on each of many turns.

    Attributes:
        readings: (x, y) in m, [shot, turn, monitor, 2]; NaN where missing, as behind a lost beam.
        monitors: names, in the order of the readings.
        noise: rms of one reading, m, [monitor, 2], NaN where not known; None: unknown. A pair
            (x, y), or a mapping of pairs by monitor, is taken too.
        settings: of each shot, see `Measurement`; () for the design's in every shot.
        shots: their ids; () for 0, 1, ...
        lattice, energy: what the data say of them (GeV); hints.

    Raises:
        MeasurementError: shapes that do not fit, numbers that cannot be, no reading at all, or
            less than 16 or more than 10,000 turns.
    """

    readings: Array
    monitors: tuple[str, ...]
    noise: Array | None = None
    settings: tuple[Settings, ...] = ()
    shots: tuple[int, ...] = ()
    lattice: str | None = None
    energy: float | None = None

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
        keep(
            self,
            readings=readings,
            monitors=monitors,
            noise=noise_table(self.noise, monitors),
            settings=settings,
            shots=shots,
        )

    def in_order_of(self, monitors: Sequence[str]) -> "TurnByTurn":
        """The same with other monitors, such as a ring's: NaN where one was not read.

        Raises:
            UnknownNameError: this measurement has a monitor that is not among them.
        """
        places, number = monitor_places(monitors, self.monitors), len(monitors)
        return replace(
            self,
            readings=spread(self.readings, places, number),
            monitors=tuple(monitors),
            noise=spread(self.noise, places, number),
        )

    def select(
        self, shots: Sequence[int] | None = None, monitors: Sequence[str] | None = None
    ) -> "TurnByTurn":
        """A part of the shots and monitors, in the order asked for; None: all.

        Raises:
            UnknownNameError: a monitor that is not there.
            MeasurementError: a shot that is not there, or nothing is left.
        """
        at = shot_places(self.shots, self.shots if shots is None else shots)
        here = monitor_places(self.monitors, self.monitors if monitors is None else monitors)
        return replace(
            self,
            readings=self.readings[at][:, :, here],
            monitors=tuple(self.monitors[i] for i in here),
            noise=None if self.noise is None else self.noise[here],
            settings=tuple(self.settings[i] for i in at) if self.settings else (),
            shots=tuple(self.shots[i] for i in at),
        )
