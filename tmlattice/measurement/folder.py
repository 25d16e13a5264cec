"""The measurement folder, format version 1: `measurement.json` and a table of readings.

The shots, the columns of an orbit response, or the RF's steps stand in `measurement.json`; what was
read stands in `readings.csv`, `response.csv` or `tunes.csv`. Numbers are written so that they read
back bit by bit.
"""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tmlattice.errors import MeasurementError, UnknownNameError
from tmlattice.measurement.arrays import Unit
from tmlattice.measurement.assume import WORDS
from tmlattice.measurement.dispersion import Dispersion
from tmlattice.measurement.documents import check_table, located, read_document
from tmlattice.measurement.header import FORMAT, number, read_noise
from tmlattice.measurement.monitors import Names, Settings, check_settings
from tmlattice.measurement.orbit_response import OrbitResponse, RfStep
from tmlattice.measurement.rows import dense, match_names, read_rows
from tmlattice.measurement.shots import ClosedOrbit, TurnByTurn
from tmlattice.measurement.stored_files import KINDS, TURNS, places_of
from tmlattice.measurement.tables import read_table, read_turn_by_turn
from tmlattice.measurement.trajectory import COORDINATES, UNKNOWN_LAUNCH, Measurement
from tmlattice.measurement.tune_reading import TuneReading
from tmlattice.temporaries import locked

Array = NDArray[np.float64]

AnyMeasurement = Measurement | OrbitResponse | TurnByTurn | ClosedOrbit | Dispersion | TuneReading
RESPONSE = ("corrector", "monitor", "x", "y")
RF = "rf"
FEWEST, MOST_UNREAD = 100, 10
"""Shots that may be listed without a reading: so many, and so many times those that were read."""
SHORTEST = 4
"""Bytes of a row of a table at least."""


def in_words(measured: AnyMeasurement | type) -> str:
    """What a measurement, or a kind of it, is, for a sentence."""
    kind = measured if isinstance(measured, type) else type(measured)
    return WORDS.get(kind, kind.__name__)


def read_measurement(
    path: str | Path,
    monitors: Sequence[str] | None = None,
    turn_by_turn: str | None = None,
    unit: Unit = "m",
) -> AnyMeasurement:
    """Read a measurement folder, or a plain table of readings (`.csv`, see `read_table`).

    Args:
        path: the folder, its measurement.json, a CSV table, or a turn-by-turn file.
        monitors: the ring's names. Where given, a monitor that is not among them is an error,
            and the names and their order are the ring's; a monitor with no rows is left out
            (`in_order_of` puts it back as missing).
        turn_by_turn: the path is a turn-by-turn file of this kind, see `read_turn_by_turn`.
        unit: of the readings of a table or a turn-by-turn file; a folder's are in m.

    Returns:
        A record of the folder's kind.

    Raises:
        MeasurementError: one sentence with the file, the line and the correction.
    """
    path = Path(path)
    if turn_by_turn is not None:
        return read_turn_by_turn(path, turn_by_turn, monitors=monitors, unit=unit)
    if path.suffix.casefold() == ".csv":
        return read_table(path, monitors=monitors, unit=unit)
    folder = path.parent if path.name == "measurement.json" else path
    if not folder.is_dir():
        raise MeasurementError(
            f"no measurement folder '{folder}'; name a folder that holds measurement.json, or a "
            "table .csv"
        )
    file = folder / "measurement.json"
    if not file.is_file():
        raise MeasurementError(f"no '{file}'; a measurement folder has one")
    with locked(folder, shared=True):  # of one output, whoever writes there
        document = read_document(file, "measurement", FORMAT, first=partial(_check_number, file))
        kind = document["kind"]
        if kind in KINDS:
            measured: AnyMeasurement = KINDS[kind].read(file, document, monitors)
            check_table(document, file.with_name(KINDS[kind].table))
            return measured
        read = _trajectory if kind == "trajectory" else _orbit_response
        return read(file, document, monitors)


def _check_number(file: Path, document: dict[str, Any]) -> None:
    """Shots that so short a table cannot have readings of are not looked at one by one."""
    shots, table = document.get("shots"), file.with_name("readings.csv")
    if isinstance(shots, list) and table.is_file():
        rows = table.stat().st_size // SHORTEST
        if len(shots) > FEWEST + MOST_UNREAD * rows:
            raise MeasurementError(
                f"{file}: it lists {len(shots)} shots, and {table.name} has {rows} rows at most; "
                "take the others out"
            )


def _trajectory(
    file: Path, document: dict[str, Any], monitors: Sequence[str] | None
) -> Measurement:
    with located(file):
        shots, launches, sigma, settings = _shots(document["shots"])
    rows = read_rows(file.with_name("readings.csv"), TURNS)
    rows.check("shot", "turn", "monitor")
    order = places_of(rows, "shot", shots)
    names, place = match_names(rows, "monitor", monitors)
    read = len(np.unique(order))
    if len(shots) > FEWEST + MOST_UNREAD * read:  # before anything is laid out for them
        raise MeasurementError(
            f"{file}: it lists {len(shots)} shots, and {rows.path.name} has readings of {read}; "
            "take the others out"
        )
    readings = dense(rows, order, len(shots), place, len(names))
    check_table(document, rows.path)  # what is wrong in a line is told with the line
    with located(file):
        return Measurement(
            launches=launches,
            readings=readings,
            monitors=names,
            noise=read_noise(document.get("noise"), names, monitors),
            launch_sigma=sigma,
            settings=settings,
            shots=shots,
            lattice=document.get("lattice"),
            energy=document.get("energy_gev"),
            devices=document.get("devices") or {},
        )


def _shots(
    listed: list[dict[str, Any]],
) -> tuple[tuple[int, ...], Array, Array | None, tuple[Settings, ...]]:
    """Ids, launches, their sigma where one is stated, and settings of the document's shots."""
    shots: dict[int, Settings] = {}
    launches = np.zeros((len(listed), 5))
    sigma = np.tile(UNKNOWN_LAUNCH, (len(listed), 1))
    for i, shot in enumerate(listed):
        own = int(shot["id"])
        if own in shots:
            raise MeasurementError(f"shot {own} stands twice; give each shot an id of its own")
        for j, name in enumerate(COORDINATES):
            launches[i, j] = shot.get("launch", {}).get(name, 0.0)
            stated = (shot.get("launch_sigma") or {}).get(name, sigma[i, j])
            sigma[i, j] = number(stated, np.inf)
            if not np.isfinite(launches[i, j]):
                raise MeasurementError(f"shots[{i}].launch.{name} is not finite; give a number")
        shots[own] = shot.get("settings") or {}
        with located(Path(f"shots[{i}].settings")):
            check_settings(own, shots[own])
    stated = any(shot.get("launch_sigma") is not None for shot in listed)
    return tuple(shots), launches, sigma if stated else None, tuple(shots.values())


def _orbit_response(
    file: Path, document: dict[str, Any], monitors: Sequence[str] | None
) -> OrbitResponse:
    columns = document["columns"]
    rf, dispersion = document.get("rf"), bool(document.get("dispersion"))
    with located(file):
        correctors = Names("corrector", [column["corrector"] for column in columns])
        if dispersion and rf is None:
            raise MeasurementError('"dispersion" is true but "rf" does not state the step; add it')

    rows = read_rows(file.with_name("response.csv"), RESPONSE)
    rows.check("corrector", "monitor")
    stepped, of_row = rows.names["corrector"]
    column_of = np.empty(len(stepped), dtype=np.int64)
    for i, name in enumerate(stepped):
        row = int((of_row == i).argmax())
        if name.casefold() == RF:
            if not dispersion:
                raise rows.error(
                    row, 'a row of the RF step, but measurement.json has no "dispersion": true; '
                    "add it and its step there, or take the rows out",
                )  # fmt: skip
            column_of[i] = len(columns)
            continue
        try:
            column_of[i] = correctors[name]
        except UnknownNameError as error:
            raise rows.error(row, f"{error}; the columns of measurement.json name all") from error
    names, place = match_names(rows, "monitor", monitors)
    response = np.full((len(columns) + 1, len(names), 2), np.nan)
    response[column_of[of_row], place] = rows.xy
    check_table(document, rows.path)
    with located(file):
        if dispersion and len(columns) not in column_of:
            raise MeasurementError(
                '"dispersion" is true but response.csv has no row of "rf"; set it to false'
            )
        return OrbitResponse(
            correctors=correctors.names,
            planes=tuple(column["plane"] for column in columns),
            kicks=np.array([column["kick"] for column in columns], dtype=float),
            monitors=names,
            response=response[:-1],
            noise=read_noise(document.get("noise"), names, monitors),
            rf=rf and RfStep(
                frequency=float(rf["frequency_hz"]),
                harmonic=int(rf["harmonic"]),
                step=float(rf["step_hz"]),
                orbit=response[-1] if dispersion else None,
            ),
            lattice=document.get("lattice"),
            energy=document.get("energy_gev"),
            devices=document.get("devices") or {},
        )  # fmt: skip
