"""Folders of each kind of measurement, see `measurement.folder`: a reader of its document and
table, and a writer of the table that completes the document.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TextIO

import numpy as np

from tmlattice.arrays import Array, Indices
from tmlattice.errors import MeasurementError, UnknownNameError
from tmlattice.measurement.dispersion import Dispersion
from tmlattice.measurement.documents import check_table, located
from tmlattice.measurement.header import header, number, read_noise
from tmlattice.measurement.monitors import Names, Settings, check_settings, check_size
from tmlattice.measurement.orbit_response import OrbitResponse, RfStep
from tmlattice.measurement.rows import Rows, dense, match_names, read_rows
from tmlattice.measurement.shots import ClosedOrbit, TurnByTurn
from tmlattice.measurement.trajectory import COORDINATES, UNKNOWN_LAUNCH, Measurement
from tmlattice.measurement.tune_reading import TuneReading

Document = dict[str, Any]
Known = Sequence[str] | None
"""The ring's monitors, where they are known."""

FEWEST, MOST_UNREAD = 100, 10
"""Shots that may be listed without a reading: so many, and so many times those that were read."""
RESPONSE = ("corrector", "monitor", "x", "y")
RF = "rf"
TURNS = ("shot", "turn", "monitor", "x", "y")
ORBITS = ("shot", "monitor", "x", "y")
STEPS = ("step", "monitor", "x", "y")
TUNES = ("shot", "quantity", "value", "error")
QUANTITIES = ("tune_x", "tune_y", "chromaticity_x", "chromaticity_y")


# --- reading --------------------------------------------------------------------------------------
def _rows(file: Path, document: Document) -> Rows:
    kind = KINDS[document["kind"]]
    rows = read_rows(file.with_name(kind.table), kind.columns)
    rows.check(*kind.columns[:-2], metres="x" in kind.columns)
    return rows


def _read(
    file: Path, document: Document, known: Sequence[int], monitors: Known
) -> tuple[tuple[str, ...], Array]:
    """Monitors and readings [shot or step, turn, monitor, 2] of the table of a document."""
    rows = _rows(file, document)
    at = places_of(rows, KINDS[document["kind"]].columns[0], known)
    names, place = match_names(rows, "monitor", monitors)
    read = len(np.unique(at))
    if len(known) > FEWEST + MOST_UNREAD * read:  # before anything is laid out for them
        raise MeasurementError(
            f"{file}: it lists {len(known)} shots, and {rows.path.name} has readings of {read}; "
            "take the others out"
        )
    readings = dense(rows, at, len(known), place, len(names))
    check_table(document, rows.path)  # what is wrong in a line is reported with the line
    return names, readings


def _of_shots(
    file: Path, document: Document, monitors: Known
) -> Measurement | TurnByTurn | ClosedOrbit:
    record = KINDS[document["kind"]].record
    shots, settings = _shots(file, document)
    own: dict[str, Any] = {"shots": shots, "settings": settings}
    if record is Measurement:
        with located(file):
            own["launches"], own["launch_sigma"] = _launches(document["shots"])
    names, readings = _read(file, document, shots, monitors)
    own[record.READ] = readings if "turn" in record.AXES else readings[:, 0]
    with located(file):
        made: Measurement | TurnByTurn | ClosedOrbit = record(
            monitors=names, **own, **_common(document, names, monitors)
        )
        return made


def _dispersion(file: Path, document: Document, monitors: Known) -> Dispersion:
    steps = document["steps"]
    names, orbits = _read(file, document, range(len(steps)), monitors)
    with located(file):
        made = tuple(_rf_step(s, own) for s, own in zip(steps, orbits[:, 0], strict=True))
        return Dispersion(made, names, **_common(document, names, monitors))


def _tunes(file: Path, document: Document, monitors: Known) -> TuneReading:
    shots, settings = _shots(file, document)
    rows = _rows(file, document)
    _, place = match_names(rows, "quantity", QUANTITIES, all_of_them=True)
    table = np.full((len(shots), len(QUANTITIES), 2), np.nan)
    table[places_of(rows, "shot", shots), place] = rows.xy
    check_table(document, rows.path)
    values, errors = table[..., 0], table[..., 1]
    measured = bool(np.isfinite(values[:, 2:]).any())
    with located(file):
        return TuneReading(
            tune=values[:, :2],
            tune_error=errors[:, :2],
            chromaticity=values[:, 2:] if measured else None,
            chromaticity_error=errors[:, 2:] if measured else None,
            settings=settings,
            shots=shots,
            lattice=document.get("lattice"),
            energy=document.get("energy_gev"),
        )


def _orbit_response(file: Path, document: Document, monitors: Known) -> OrbitResponse:
    columns = document["columns"]
    rf, dispersion = document.get("rf"), bool(document.get("dispersion"))
    with located(file):
        correctors = Names("corrector", [column["corrector"] for column in columns])
        if dispersion and rf is None:
            raise MeasurementError('"dispersion" is true but "rf" does not state the step; add it')
    rows = _rows(file, document)
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
            correctors.names, tuple(column["plane"] for column in columns),
            np.array([column["kick"] for column in columns], dtype=float), names, response[:-1],
            rf=rf and _rf_step(rf, response[-1] if dispersion else None),
            **_common(document, names, monitors),
        )  # fmt: skip


def _rf_step(rf: Document, orbit: Array | None) -> RfStep:
    return RfStep(float(rf["frequency_hz"]), int(rf["harmonic"]), float(rf["step_hz"]), orbit)


def _written_rf(rf: RfStep) -> Document:
    return {
        "frequency_hz": float(rf.frequency),
        "harmonic": int(rf.harmonic),
        "step_hz": float(rf.step),
    }


def _common(document: Document, read: Sequence[str], known: Known) -> dict[str, Any]:
    """Fields of all records, and those of some."""
    common = {
        "noise": read_noise(document.get("noise"), read, known),
        "lattice": document.get("lattice"),
        "energy": document.get("energy_gev"),
    }
    if "devices" in KINDS[document["kind"]].record.__dataclass_fields__:
        common["devices"] = document.get("devices") or {}
    return common


def _shots(file: Path, document: Document) -> tuple[tuple[int, ...], tuple[Settings, ...]]:
    """Ids and settings of the document's shots."""
    shots: dict[int, Settings] = {}
    with located(file):
        for i, shot in enumerate(document["shots"]):
            own = int(shot["id"])
            if own in shots:
                raise MeasurementError(f"shot {own} stands twice; give each shot an id of its own")
            shots[own] = shot.get("settings") or {}
            with located(Path(f"shots[{i}].settings")):
                check_settings(own, shots[own])
    return tuple(shots), tuple(shots.values())


def _launches(listed: list[Document]) -> tuple[Array, Array | None]:
    """Launches of the document's shots, and their sigma where one is stated, [shot, 5] each."""
    launches = np.zeros((len(listed), 5))
    sigma = np.tile(UNKNOWN_LAUNCH, (len(listed), 1))
    for i, shot in enumerate(listed):
        stated = shot.get("launch_sigma") or {}
        for j, name in enumerate(COORDINATES):
            launches[i, j] = shot.get("launch", {}).get(name, 0.0)
            sigma[i, j] = number(stated.get(name, sigma[i, j]), np.inf)
            if not np.isfinite(launches[i, j]):
                raise MeasurementError(f"shots[{i}].launch.{name} is not finite; give a number")
    known = any(shot.get("launch_sigma") is not None for shot in listed)
    return launches, sigma if known else None


def places_of(rows: Rows, column: str, known: Sequence[int]) -> Indices:
    """Each row's place among the shots, or steps, of the document; MeasurementError: one that is
    not among them, with its line."""
    index = {own: i for i, own in enumerate(known)}
    found, of_row = np.unique(rows.whole[column], return_inverse=True)
    place = np.array([index.get(own, -1) for own in found.tolist()], dtype=np.int64)[of_row]
    if (place < 0).any():
        row = int((place < 0).argmax())
        raise rows.error(
            row, f"{column} {rows.whole[column][row]} is not among the {column}s of "
            "measurement.json; add it there, or take the row out",
        )  # fmt: skip
    return place


# --- writing --------------------------------------------------------------------------------------
def _write_rows(
    table: TextIO,
    columns: Sequence[str],
    monitors: Sequence[str],
    rows: Iterable[tuple[str, Array]],
) -> None:
    """Write the header and rows of readings: what they begin with, and [monitor, 2], m."""
    table.write(",".join(columns) + "\n")
    names = quoted(monitors)
    for start, readings in rows:
        check_size(readings, monitors)
        table.writelines(reading_lines(f"{start},", names, readings.tolist()))


def _write_turns(table: TextIO, m: TurnByTurn) -> Document:
    shots = zip(m.shots, m.readings, strict=True)
    rows = ((f"{shot},{turn}", own) for shot, turns in shots for turn, own in enumerate(turns))
    _write_rows(table, TURNS, m.monitors, rows)
    return header("turn_by_turn", m) | _written_shots(m)


def _write_orbits(table: TextIO, m: ClosedOrbit) -> Document:
    _write_rows(table, ORBITS, m.monitors, zip(map(str, m.shots), m.orbit, strict=True))
    return header("closed_orbit", m) | _written_shots(m)


def _write_dispersion(table: TextIO, m: Dispersion) -> Document:
    rows = ((str(i), orbit) for i, orbit in enumerate(m.orbits))
    _write_rows(table, STEPS, m.monitors, rows)
    return header("dispersion", m) | {"steps": [_written_rf(step) for step in m.steps]}


def _write_response(table: TextIO, m: OrbitResponse) -> Document:
    orbits = list(zip(m.correctors, m.response, strict=True))
    document = header("orbit_response", m)
    document["columns"] = [
        {"corrector": name, "plane": plane, "kick": float(kick)}
        for name, plane, kick in zip(m.correctors, m.planes, m.kicks, strict=True)
    ]
    if m.rf is not None:
        document["rf"] = _written_rf(m.rf)
        if m.rf.orbit is not None:
            document["dispersion"] = True
            orbits.append((RF, m.rf.orbit))
    write_response_table(table, m.monitors, orbits)
    return document


def write_response_table(
    table: TextIO, monitors: Sequence[str], orbits: Sequence[tuple[str, Array]]
) -> None:
    """Write orbit changes as the table of an orbit response's folder (orbits: a corrector's name,
    or "rf", and its orbit change, m, [monitor, 2])."""
    starts = quoted([name for name, _ in orbits])
    rows = ((start, orbit) for start, (_, orbit) in zip(starts, orbits, strict=True))
    _write_rows(table, RESPONSE, monitors, rows)


def _write_tunes(table: TextIO, m: TuneReading) -> Document:
    nothing = np.full_like(m.tune, np.nan)
    values, errors = (
        np.concatenate([nothing if part is None else part for part in parts], axis=1)
        for parts in ((m.tune, m.chromaticity), (m.tune_error, m.chromaticity_error))
    )
    table.write(",".join(TUNES) + "\n")
    for shot, pairs in zip(m.shots, np.stack([values, errors], axis=2), strict=True):
        measured = np.flatnonzero(~np.isnan(pairs).all(axis=1))
        names = [QUANTITIES[k] for k in measured]
        table.writelines(reading_lines(f"{shot},", names, pairs[measured].tolist()))
    return header("tunes", m) | _written_shots(m)


def _written_shots(m: TurnByTurn | ClosedOrbit | TuneReading) -> Document:
    shots: list[Document] = []
    for i, shot in enumerate(m.shots):
        shots.append({"id": int(shot)})
        if m.settings and m.settings[i]:
            shots[-1]["settings"] = plain_settings(m.settings[i])
    return {"shots": shots}


def plain_settings(settings: Settings) -> dict[str, dict[str, float]]:
    """A shot's settings as a document has them."""
    return {
        name: {key: float(amount) for key, amount in changed.items()}
        for name, changed in settings.items()
    }


def quoted(names: Sequence[str]) -> list[str]:
    """Names as CSV has them: one with a comma or a quote is quoted."""
    return [
        '"' + name.replace('"', '""') + '"' if set(name) & {",", '"'} else name for name in names
    ]


def reading_lines(
    start: str, names: Sequence[str], readings: Sequence[Sequence[float]]
) -> Iterator[str]:
    """Rows of readings [monitor, 2] that begin with the same columns; names are `quoted`.

    repr is the shortest text that reads back as the same number; a missing one is empty.
    """
    for name, (x, y) in zip(names, readings, strict=True):
        yield f"{start}{name},{repr(x) if x == x else ''},{repr(y) if y == y else ''}\n"  # noqa: PLR0124


class Kind(NamedTuple):
    """One kind of measurement: its record, and how a folder of it is handled."""

    record: Any
    table: str
    columns: tuple[str, ...]
    read: Callable[[Path, Document, Known], Any]
    write: Callable[[TextIO, Any], Document] | None
    """None: shot by shot, see `measurement_writer`."""


STORED = {
    "turn_by_turn": Kind(TurnByTurn, "readings.csv", TURNS, _of_shots, _write_turns),
    "closed_orbit": Kind(ClosedOrbit, "readings.csv", ORBITS, _of_shots, _write_orbits),
    "dispersion": Kind(Dispersion, "readings.csv", STEPS, _dispersion, _write_dispersion),
    "tunes": Kind(TuneReading, "tunes.csv", TUNES, _tunes, _write_tunes),
}
KINDS = {
    "trajectory": Kind(Measurement, "readings.csv", TURNS, _of_shots, None),
    "orbit_response": Kind(
        OrbitResponse, "response.csv", RESPONSE, _orbit_response, _write_response
    ),
    **STORED,
}
