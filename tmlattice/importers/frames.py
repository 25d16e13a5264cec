"""A measurement of a pandas DataFrame or an xarray Dataset: for `ClosedOrbit.from_dataframe`.

Its columns are read as those of a file (`importers.columns`), so that long and wide tables, names
and units are treated alike; a frame of `to_dataframe` is read back as it was.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from tmlattice.errors import MeasurementError
from tmlattice.importers.bring_in import Options, bring_in
from tmlattice.importers.columns import Column, read_columns
from tmlattice.importers.readings import numbers_of
from tmlattice.lattice import Ring
from tmlattice.measurement import (
    ClosedOrbit,
    Dispersion,
    Measurement,
    OrbitResponse,
    TuneReading,
    TurnByTurn,
    in_words,
)
from tmlattice.measurement.arrays import Unit
from tmlattice.measurement.kinds import QUANTITIES


def from_frame(
    cls: type,
    frame: Any,
    *,
    ring: Ring | None = None,
    unit: Unit | None = None,
    noise: Any = None,
    step: float | Sequence[float] | None = None,
    frequency: float | None = None,
    harmonic: int | None = None,
) -> Any:
    """Return the measurement of a table.

    Long: a row a monitor (and shot, and turn), with columns `monitor`, `x`, `y`; of an orbit
    response also `corrector` and `kick`. Wide: a row a shot, a column a monitor and plane; of an
    orbit response `monitor`, `plane` and a column a corrector. Of tunes: a row a shot, columns
    `tune_x`, `tune_y`, and where measured `chromaticity_x`, `chromaticity_y`, and `tune_x_error`
    and so on. Units stand in the names (`x [mm]`) or in `attrs["units"]`.

    Args:
        cls: the kind.
        frame: a pandas DataFrame, an xarray Dataset or DataArray.
        ring: the lattice, which knows the names of monitors and the planes of correctors.
        unit: of readings that state none; None: from their size.
        noise: rms of a reading, m, see the kind's attribute; None: as the frame states.
        step, frequency, harmonic: of the RF, Hz, of a dispersion measurement.

    Raises:
        MeasurementError: a column that is missing, a field that is no number, or another kind.
        UnknownNameError: names that the ring does not have.
    """
    if cls is TuneReading and (read := _tunes(frame)) is not None:
        return read
    if cls is not Dispersion and (step, frequency, harmonic) != (None, None, None):
        raise MeasurementError("step, frequency and harmonic are of a dispersion measurement")
    found: Any = bring_in([frame], Options(ring=ring, unit=unit)).measurement
    if type(found) is not cls:
        found = _as(cls, found, (step, frequency, harmonic))
    return found if noise is None else replace(found, noise=noise)


def _as(cls: type, found: Any, rf: tuple[Any, ...]) -> Any:
    """Readings as those of another kind."""
    own: dict[str, Any] = {
        name: getattr(found, name) for name in ("monitors", "noise", "lattice", "energy")
    }
    if isinstance(found, Measurement | TurnByTurn):
        readings = found.readings
        if cls is TurnByTurn:
            return TurnByTurn(readings, **own, devices=found.devices)
        if cls is Measurement:
            made = Measurement.from_arrays(readings[..., 0], readings[..., 1], own["monitors"])
            return replace(made, **own, devices=found.devices)
        if readings.shape[1] == 1 and cls is ClosedOrbit:
            return ClosedOrbit(readings[:, 0], **own)
        if readings.shape[1] == 1 and cls is Dispersion:
            if None in rf:
                raise MeasurementError(
                    "a dispersion measurement needs the RF: give step=, frequency= and harmonic="
                )
            x, y = np.moveaxis(readings[:, 0], -1, 0)
            made_of = dict(zip(("step", "frequency", "harmonic"), rf, strict=True))
            return replace(Dispersion.from_arrays(x, y, own["monitors"], **made_of), **own)
    columns = {OrbitResponse: "corrector, monitor, x, y, kick", TuneReading: "tune_x, tune_y"}
    raise MeasurementError(
        f"the table holds {in_words(found)}, and not {in_words(cls)}: give columns "
        + columns.get(cls, "monitor, x, y")
    )


def _tunes(frame: Any) -> TuneReading | None:
    """Of columns such as `tune_x`, a row a shot; None where there is no such column."""
    columns = {column.name.lower(): column for column in read_columns(frame)}
    label = type(frame).__name__
    if "quantity" in columns:
        return None
    if "tune_x" not in columns and "tune_y" not in columns:
        missing = " and ".join(f"'{name}'" for name in QUANTITIES[:2])
        raise MeasurementError(f"{label}: no columns {missing}; add them")

    def pair(what: str, suffix: str = "") -> Any:
        names = [f"{what}_{plane}{suffix}" for plane in "xy"]
        if not any(name in columns for name in names):
            return None
        rows = len(next(iter(columns.values())).values)
        empty = Column("", "", [""] * rows)
        return np.transpose([numbers_of(label, columns.get(name, empty)) for name in names])

    return TuneReading(
        pair("tune"), pair("tune", "_error"), pair("chromaticity"), pair("chromaticity", "_error")
    )
