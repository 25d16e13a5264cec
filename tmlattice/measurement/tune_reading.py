"""Tunes and chromaticities as a machine's own tune measurement states them."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from tmlattice.arrays import Array
from tmlattice.errors import MeasurementError
from tmlattice.measurement.monitors import Settings, check_energy, checked_shots
from tmlattice.measurement.shown import Shown


@dataclass(frozen=True, eq=False, repr=False)
class TuneReading(Shown):
    """Tunes, and chromaticities where they were measured, of one or more settings.

    A tune is the fraction of the full tune, in [0, 1): 37.87 is 0.87. A spectrum shows 0.13 for it:
    whoever writes the tune down states which of the two it is. (`harmonics.Tunes` are those of a
    signal; these were read.)

    Attributes:
        tune: (x, y), [shot, 2], NaN where not measured; of one shot [2] is taken too.
        tune_error: its rms, [shot, 2], NaN where unknown; None: all unknown.
        chromaticity: (x, y), dQ / d delta, not divided by the tune, [shot, 2], NaN where not
            measured; None: not measured. `chromaticity_error` is its rms.
        settings, shots, lattice, energy: see `Measurement`.

    Raises:
        MeasurementError: shapes that do not fit, numbers that cannot be, or nothing measured.
    """

    tune: Array
    tune_error: Array | None = None
    chromaticity: Array | None = None
    chromaticity_error: Array | None = None
    settings: tuple[Settings, ...] = ()
    shots: tuple[int, ...] = ()
    lattice: str | None = None
    energy: float | None = None

    def __post_init__(self) -> None:
        tune = np.atleast_2d(np.asarray(self.tune, dtype=float))
        if tune.ndim != 2 or tune.shape[1] != 2 or not len(tune):
            raise MeasurementError(f"tunes have the shape {tune.shape}; it should be [shots, 2]")
        off = ~((tune >= 0) & (tune < 1)) & ~np.isnan(tune)
        if off.any():
            raise MeasurementError(
                f"a tune of {tune[off][0]:g} is no fraction of the full tune: give it in [0, 1)"
            )
        chromaticity = _beside("chromaticities", self.chromaticity, tune)
        if chromaticity is not None and np.isinf(chromaticity).any():
            raise MeasurementError("a chromaticity is infinite; a missing one is NaN")
        given = [tune] if chromaticity is None else [tune, chromaticity]
        if not np.isfinite(given).any():
            raise MeasurementError("every tune is missing; nothing can be fitted")
        if chromaticity is None and self.chromaticity_error is not None:
            raise MeasurementError("errors of chromaticities need chromaticities; add them")
        check_energy(self.energy)
        shots, settings = checked_shots(self.shots, self.settings, len(tune), "tunes")
        self._keep(
            tune=tune,
            tune_error=_rms("tune", self.tune_error, tune),
            chromaticity=chromaticity,
            chromaticity_error=_rms("chromaticity", self.chromaticity_error, tune),
            settings=settings,
            shots=shots,
        )


def _beside(what: str, values: Any, tune: Array) -> Array | None:
    """Numbers in the shape of the tunes; None where there are none."""
    if values is None:
        return None
    array = np.atleast_2d(np.asarray(values, dtype=float))
    if array.shape != tune.shape:
        raise MeasurementError(
            f"{what} have the shape {array.shape}; it should be {list(tune.shape)}, as the tunes"
        )
    return None if np.isnan(array).all() else array


def _rms(of: str, values: Any, tune: Array) -> Array | None:
    error = _beside(f"errors of the {of}", values, tune)
    if error is None:
        return None
    wrong = ~(np.isnan(error) | ((error > 0) & np.isfinite(error)))
    if wrong.any():
        raise MeasurementError(
            f"an error of the {of} is {error[wrong][0]:g}; it is an rms: above zero, or absent "
            "where unknown"
        )
    return error
