"""Turns of the stored beam after a kick."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from tmlattice.errors import MeasurementError
from tmlattice.measurement.checks import Settings
from tmlattice.measurement.shots import Shots

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

    readings: Array
    monitors: tuple[str, ...]
    noise: Array | None = None
    settings: tuple[Settings, ...] = ()
    shots: tuple[int, ...] = ()
    lattice: str | None = None
    energy: float | None = None
    devices: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        super().__post_init__()
        turns = self.readings.shape[1]
        if not FEWEST <= turns <= MOST:
            raise MeasurementError(
                f"{turns} turns are no turn-by-turn measurement, which has {FEWEST} to {MOST}; "
                + ("give fewer" if turns > MOST else "first turns are of the kind 'trajectory'")
            )
