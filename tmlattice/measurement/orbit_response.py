"""The change of the stored beam's closed orbit for a step of one corrector at a time."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
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
    places_of,
)
from tmlattice.measurement.shown import OfMonitors


@dataclass(frozen=True, eq=False)
class RfStep:
    """A step of the RF frequency.

    Attributes:
        frequency: Hz.
        harmonic: number of RF periods in a turn.
        step: Hz.
        orbit: the orbit change for the step, m, [monitor, 2], NaN where missing; None where it
            was not measured.
    """

    frequency: float
    harmonic: int
    step: float
    orbit: Array | None = None


HIGHEST_RF = 1e12
"""Hz, and of its harmonic: no cavity is smaller."""
LARGEST_KICK = 1e6
"""rad: the data determine whether kicks are in microradians; a larger kick is rejected."""


def check_rf(rf: RfStep) -> None:
    """Raises a MeasurementError for a frequency, a harmonic or a step that cannot be."""
    there_is = 0 < rf.frequency < HIGHEST_RF and 0 < rf.harmonic < HIGHEST_RF
    if rf.step == 0 and rf.orbit is not None:
        raise MeasurementError("an RF step of 0 Hz shows no dispersion; give its size")
    if not (there_is and abs(rf.step) < rf.frequency):
        raise MeasurementError(
            f"an RF of {rf.frequency:g} Hz, harmonic {float(rf.harmonic):g}, step {rf.step:g} Hz "
            "cannot be; frequency and harmonic are above zero, the step is a small part of it"
        )


@dataclass(frozen=True, eq=False, repr=False)
class OrbitResponse(OfMonitors):
    """Measured orbit changes.

    The RF frequency is constant while a corrector is stepped, so a horizontal step also shifts
    the beam energy a little.

    Attributes:
        correctors, planes: names, one a column, and "x" or "y", the plane in which each kicks.
        kicks: the steps, rad, [column].
        response: the orbit change for that kick, m (not m/rad), [column, monitor, 2], NaN where
            missing.
        noise: rms of an orbit change, and the other attributes: see `Measurement`.
        rf: the RF's step, or None.

    Raises:
        MeasurementError: shapes that do not fit, or numbers that cannot be.
    """

    correctors: tuple[str, ...]
    planes: tuple[str, ...]
    kicks: Array
    monitors: tuple[str, ...]
    response: Array
    noise: Array | None = None
    rf: RfStep | None = None
    lattice: str | None = None
    energy: float | None = None
    devices: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def from_arrays(
        cls,
        x: ArrayLike | None,
        y: ArrayLike | None,
        monitors: Iterable[Any],
        correctors: Iterable[Any],
        kicks: float | Sequence[float],
        *,
        planes: str | Sequence[str] | None = None,
        unit: Unit = "m",
        noise: Any = None,
        rf: RfStep | None = None,
    ) -> Self:
        """Return the orbit response of two matrices.

        Args:
            x, y: orbit change for the kick, [corrector, monitor], m (not m/rad); None: not read.
            monitors, correctors: names, or elements of a ring.
            kicks: rad, one for all or one a corrector.
            planes: "x" or "y" for all, or one a corrector; None: as the elements' kinds state.

        Raises:
            MeasurementError: shapes that do not fit, or planes that are unknown.
        """
        steered, names = tuple(correctors), names_of(monitors)
        if planes is None:
            kinds = [getattr(element, "kind", None) for element in steered]
            if not set(kinds) <= {"hcorrector", "vcorrector"}:
                raise MeasurementError(
                    "the planes of the correctors are unknown: give planes=, or elements of the "
                    "ring as correctors"
                )
            planes = ["x" if kind == "hcorrector" else "y" for kind in kinds]
        number = len(steered)
        response = readings_of(x, y, names, ("corrector",), unit)
        sizes = np.full(number, kicks) if np.ndim(kicks) == 0 else np.asarray(kicks, dtype=float)
        by_column = (planes,) * number if isinstance(planes, str) else tuple(planes)
        return cls(names_of(steered), by_column, sizes, names, response, noise, rf)

    def __post_init__(self) -> None:
        kicks, response = (np.asarray(a, dtype=float) for a in (self.kicks, self.response))
        self._keep(
            correctors=tuple(self.correctors),
            planes=tuple(self.planes),
            monitors=tuple(self.monitors),
            kicks=kicks,
            response=response,
        )
        Names("corrector", self.correctors)
        Names("BPM", self.monitors)
        columns, monitors = len(self.correctors), len(self.monitors)
        if response.shape != (columns, monitors, 2):
            raise MeasurementError(
                f"the response has the shape {response.shape}; {columns} correctors and "
                f"{monitors} BPMs need [{columns}, {monitors}, 2]"
            )
        if len(self.planes) != columns or kicks.shape != (columns,):
            raise MeasurementError(f"{columns} correctors need as many planes and kicks")
        for name, plane, kick in zip(self.correctors, self.planes, kicks, strict=True):
            if name.casefold() == "rf":
                raise MeasurementError("no corrector is named 'rf': that name is the RF step's")
            if plane not in ("x", "y"):
                raise MeasurementError(f"corrector '{name}' kicks in '{plane}'; in x or y it can")
            if kick == 0 or not abs(kick) < LARGEST_KICK:
                raise MeasurementError(
                    f"corrector '{name}' has a step of {kick:g} rad; it is a small part of one "
                    "and not zero"
                )
        orbits = response
        if self.rf is not None:
            check_rf(self.rf)
            if self.rf.orbit is not None:
                orbit = np.asarray(self.rf.orbit, dtype=float)
                if orbit.shape != (monitors, 2):
                    raise MeasurementError(
                        f"the RF step's orbit has the shape {orbit.shape}, not [{monitors}, 2]"
                    )
                self._keep(rf=replace(self.rf, orbit=orbit))
                orbits = np.concatenate([response, orbit[None]])
        check_energy(self.energy)
        check_values(orbits, "orbit change")
        self._keep(noise=noise_table(self.noise, self.monitors))

    def read_with(self, change: Callable[[Array], Array]) -> dict[str, Any]:
        """Return response and RF step with a change of all orbits, [..., monitor, 2]."""
        rf = self.rf
        if rf is not None and rf.orbit is not None:
            rf = replace(rf, orbit=change(rf.orbit))
        return {"response": change(self.response), "rf": rf}

    def select(
        self, correctors: Sequence[str] | None = None, monitors: Sequence[str] | None = None
    ) -> "OrbitResponse":
        """A part of the columns and monitors, in the order asked for; None: all.

        Raises:
            UnknownNameError: one that is not there.
        """
        part = self
        if correctors is not None:
            column = places_of("corrector", self.correctors, correctors)
            part = replace(
                part,
                correctors=tuple(self.correctors[i] for i in column),
                planes=tuple(self.planes[i] for i in column),
                kicks=self.kicks[column],
                response=self.response[column],
            )
        return part if monitors is None else part.at_monitors(monitors)
