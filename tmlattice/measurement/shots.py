"""Shots as monitors read them; those of a stored beam are closed orbits and turns after a kick."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike

from tmlattice.arrays import Array
from tmlattice.errors import MeasurementError
from tmlattice.measurement.arrays import Unit, names_of, readings_of
from tmlattice.measurement.monitors import (
    Names,
    Settings,
    check_energy,
    check_values,
    checked_shots,
    noise_table,
    shot_places,
)
from tmlattice.measurement.shown import OfMonitors


class Shots(OfMonitors):
    """A record with shots, settings, monitors and noise; see `ClosedOrbit`.

    Its field `READ` holds what was read, [*`AXES`, monitor, 2]; the first axis is the shot. Its
    fields `OF_SHOTS`, if there are any, hold arrays [shot, ...] or None.
    """

    READ: ClassVar[str] = "readings"
    AXES: ClassVar[tuple[str, ...]] = ("shot", "turn")
    OF_SHOTS: ClassVar[tuple[str, ...]] = ()

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
        """Return the measurement of two arrays.

        Args:
            x, y: turns [shot, turn, monitor], closed orbits [shot, monitor], or without their first
                axes; NaN where missing; None: not read.
            monitors: names, or elements of a ring.

        Raises:
            MeasurementError: shapes that do not fit, or numbers that cannot be.
        """
        make: Any = cls
        names = names_of(monitors)
        read = readings_of(x, y, names, cls.AXES, unit)
        return make(  # type: ignore[no-any-return]
            read, names, noise, settings=tuple(settings), shots=tuple(shots)
        )

    def __post_init__(self) -> None:
        own: Any = self
        read, monitors = np.asarray(getattr(own, self.READ), dtype=float), tuple(own.monitors)
        Names("BPM", monitors)
        if read.ndim != len(self.AXES) + 2 or read.shape[-2:] != (len(monitors), 2):
            axes = ", ".join(f"{axis}s" for axis in self.AXES)
            raise MeasurementError(
                f"{self.READ}: the shape is {read.shape}; {self.AXES[-1]}s at {len(monitors)} "
                f"BPMs need [{axes}, {len(monitors)}, 2]"
            )
        check_values(read, "reading")
        check_energy(own.energy)
        shots, settings = checked_shots(own.shots, own.settings, len(read), self.READ)
        self._keep(
            **{self.READ: read},
            monitors=monitors,
            noise=noise_table(own.noise, monitors),
            settings=settings,
            shots=shots,
        )

    def read_with(self, change: Callable[[Array], Array]) -> dict[str, Any]:
        """Return the readings with a change, [..., monitor, 2]."""
        return {self.READ: change(getattr(self, self.READ))}

    def select(
        self, shots: Sequence[int] | None = None, monitors: Sequence[str] | None = None
    ) -> Self:
        """A part of the shots and monitors, in the order asked for; None: all.

        Raises:
            UnknownNameError: a monitor that is not there.
            MeasurementError: a shot that is not there, or nothing is left.
        """
        own: Any = self if monitors is None else self.at_monitors(monitors)
        if shots is None:
            return own  # type: ignore[no-any-return]
        at = shot_places(own.shots, shots)
        of_shots = {name: getattr(own, name) for name in (self.READ, *self.OF_SHOTS)}
        changed = {
            "settings": tuple(own.settings[i] for i in at) if own.settings else (),
            "shots": tuple(own.shots[i] for i in at),
            **{name: None if values is None else values[at] for name, values in of_shots.items()},
        }
        return replace(own, **changed)  # type: ignore[no-any-return]


@dataclass(frozen=True, eq=False, repr=False)
class ClosedOrbit(Shots):
    """Closed orbits, absolute: what the monitors read, offsets and all.

    Attributes:
        orbit: (x, y) in m, [shot, monitor, 2]; NaN where missing.
        noise: rms of one (averaged) reading, and the other attributes: see `Measurement`.

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


FEWEST, MOST = 16, 10_000
"""Turns: fewer have no line, more have lines that no decohering beam keeps."""


@dataclass(frozen=True, eq=False, repr=False)
class TurnByTurn(Shots):
    """Readings of a stored beam that was kicked before turn 0, on each of many turns.

    Attributes:
        readings: (x, y) in m, [shot, turn, monitor, 2]; NaN where missing, as behind a lost beam.
            The other attributes are those of `Measurement`.

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
