"""The change of the closed orbit for steps of the RF frequency."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from tmlattice.arrays import Array
from tmlattice.errors import MeasurementError
from tmlattice.measurement.arrays import Unit, names_of, readings_of
from tmlattice.measurement.monitors import (
    Names,
    check_energy,
    check_values,
    noise_table,
)
from tmlattice.measurement.orbit_response import RfStep, check_rf
from tmlattice.measurement.shown import OfMonitors


@dataclass(frozen=True, eq=False, repr=False)
class Dispersion(OfMonitors):
    """Orbit changes for one or more steps of the RF.

    Attributes:
        steps: each with its orbit change, m (not m per relative energy), [monitor, 2], NaN where
            missing.
        noise: rms of one orbit change, and the other attributes: see `Measurement`.

    Raises:
        MeasurementError: shapes that do not fit, numbers that cannot be, a step of 0 Hz, or no
            orbit at all.
    """

    steps: tuple[RfStep, ...]
    monitors: tuple[str, ...]
    noise: Array | None = None
    lattice: str | None = None
    energy: float | None = None

    @classmethod
    def from_arrays(
        cls,
        x: ArrayLike | None,
        y: ArrayLike | None,
        monitors: Iterable[Any],
        *,
        step: float | Sequence[float],
        frequency: float,
        harmonic: int,
        unit: Unit = "m",
        noise: Any = None,
    ) -> Self:
        """Return the orbit changes for steps of the RF frequency.

        Args:
            x, y: orbit changes, [step, monitor] or [monitor]; NaN where missing; None: not read.
            monitors: names, or elements of a ring.
            step: of the frequency, Hz; one number, or one a step.
            frequency: of the RF, Hz.
            harmonic: number of RF periods in a turn.

        Raises:
            MeasurementError: shapes that do not fit, or numbers that cannot be.
        """
        names = names_of(monitors)
        orbits = readings_of(x, y, names, ("step",), unit)
        sizes = np.ravel(np.asarray(step, dtype=float)).tolist()
        if len(sizes) != len(orbits):
            raise MeasurementError(f"{len(sizes)} steps of the RF for {len(orbits)} orbit changes")
        steps = zip(sizes, orbits, strict=True)
        return cls(tuple(RfStep(frequency, harmonic, s, o) for s, o in steps), names, noise)

    def __post_init__(self) -> None:
        monitors = tuple(self.monitors)
        Names("BPM", monitors)
        steps = []
        for step in self.steps:
            check_rf(step)
            orbit = np.asarray(np.nan if step.orbit is None else step.orbit, dtype=float)
            if orbit.shape != (len(monitors), 2):
                raise MeasurementError(
                    f"an RF step's orbit has the shape {orbit.shape}, not [{len(monitors)}, 2]"
                )
            steps.append(replace(step, orbit=orbit))
        if not steps:
            raise MeasurementError("no step of the RF; dispersion is the orbit change for one")
        check_energy(self.energy)
        self._keep(
            steps=tuple(steps),
            monitors=monitors,
            noise=noise_table(self.noise, monitors),
        )
        check_values(self.orbits, "orbit change")

    @property
    def orbits(self) -> Array:
        """The orbit changes of all steps, m, [step, monitor, 2], NaN where missing."""
        return np.stack([np.asarray(step.orbit) for step in self.steps])

    def read_with(self, change: Callable[[Array], Array]) -> dict[str, Any]:
        """Return the steps with a change of their orbits, [..., monitor, 2]."""
        steps = (replace(step, orbit=change(np.asarray(step.orbit))) for step in self.steps)
        return {"steps": tuple(steps)}

    def select(self, monitors: Sequence[str]) -> "Dispersion":
        """A part of the monitors, see `at_monitors`."""
        return self.at_monitors(monitors)
