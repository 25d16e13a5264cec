"""Folders of a stored beam's turns, closed orbits, dispersion and tunes: see `measurement.folder`.

Each kind has a reader of its document and table, and a writer of the table that completes
the document.
"""

import csv
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TextIO

import numpy as np
from numpy.typing import NDArray

from tmlattice.errors import MeasurementError
from tmlattice.measurement.dispersion import Dispersion
from tmlattice.measurement.documents import located
from tmlattice.measurement.header import header, read_noise
from tmlattice.measurement.monitors import Settings, check_settings, check_size
from tmlattice.measurement.orbit_response import RfStep
from tmlattice.measurement.rows import Rows, dense, match_names, read_rows
from tmlattice.measurement.shots import ClosedOrbit, TurnByTurn
from tmlattice.measurement.tune_reading import TuneReading

Array = NDArray[np.float64]
Document = dict[str, Any]
Known = Sequence[str] | None
"""The ring's monitors, where they are known."""

TURNS = ("shot", "turn", "monitor", "x", "y")
ORBITS = ("shot", "monitor", "x", "y")
STEPS = ("step", "monitor", "x", "y")
TUNES = ("shot", "quantity", "value", "error")
QUANTITIES = ("tune_x", "tune_y", "chromaticity_x", "chromaticity_y")


# --- reading --------------------------------------------------------------------------------------
def _read(
    file: Path, columns: Sequence[str], known: Sequence[int], monitors: Known
) -> tuple[tuple[str, ...], Array]:
    """Monitors and readings [shot or step, turn, monitor, 2] of the table of a document."""
    rows = read_rows(file.with_name("readings.csv"), columns)
    rows.check(*columns[:-2])
    names, place = match_names(rows, "monitor", monitors)
    at = places_of(rows, columns[0], known)
    return names, dense(rows, at, len(known), place, len(names))


def _turn_by_turn(file: Path, document: Document, monitors: Known) -> TurnByTurn:
    shots, settings = _shots(file, document)
    names, readings = _read(file, TURNS, shots, monitors)
    with located(file):
        common = _common(document, names, monitors)
        devices = document.get("devices") or {}
        return TurnByTurn(
            readings, names, settings=settings, shots=shots, devices=devices, **common
        )


def _closed_orbit(file: Path, document: Document, monitors: Known) -> ClosedOrbit:
    shots, settings = _shots(file, document)
    names, orbit = _read(file, ORBITS, shots, monitors)
    with located(file):
        common = _common(document, names, monitors)
        return ClosedOrbit(orbit[:, 0], names, settings=settings, shots=shots, **common)


def _dispersion(file: Path, document: Document, monitors: Known) -> Dispersion:
    steps = document["steps"]
    names, orbits = _read(file, STEPS, range(len(steps)), monitors)
    with located(file):
        made = tuple(
            RfStep(float(s["frequency_hz"]), int(s["harmonic"]), float(s["step_hz"]), orbit)
            for s, orbit in zip(steps, orbits[:, 0], strict=True)
        )
        return Dispersion(made, names, **_common(document, names, monitors))


def _tunes(file: Path, document: Document, monitors: Known) -> TuneReading:
    shots, settings = _shots(file, document)
    rows = read_rows(file.with_name("tunes.csv"), TUNES)
    rows.check("shot", "quantity", metres=False)
    _, place = match_names(rows, "quantity", QUANTITIES, all_of_them=True)
    table = np.full((len(shots), len(QUANTITIES), 2), np.nan)
    table[places_of(rows, "shot", shots), place] = rows.xy
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


def _common(document: Document, read: Sequence[str], known: Known) -> dict[str, Any]:
    return {
        "noise": read_noise(document.get("noise"), read, known),
        "lattice": document.get("lattice"),
        "energy": document.get("energy_gev"),
    }


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


def places_of(rows: Rows, column: str, known: Sequence[int]) -> NDArray[np.int64]:
    """Each row's place among the shots, or steps, of the document.

    Raises:
        MeasurementError: one that is not among them, with its line.
    """
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
def _write_turns(table: TextIO, m: TurnByTurn) -> Document:
    table.write(",".join(TURNS) + "\n")
    names = quoted(m.monitors)
    for shot, turns in zip(m.shots, m.readings, strict=True):
        for turn, row in enumerate(turns.tolist()):
            table.writelines(reading_lines(f"{shot},{turn},", names, row))
    return header("turn_by_turn", m) | _written_shots(m)


def _write_orbits(table: TextIO, m: ClosedOrbit) -> Document:
    table.write(",".join(ORBITS) + "\n")
    for shot, row in zip(m.shots, m.orbit.tolist(), strict=True):
        table.writelines(reading_lines(f"{shot},", quoted(m.monitors), row))
    return header("closed_orbit", m) | _written_shots(m)


def _write_dispersion(table: TextIO, m: Dispersion) -> Document:
    table.write(",".join(STEPS) + "\n")
    for step, row in enumerate(m.orbits.tolist()):
        table.writelines(reading_lines(f"{step},", quoted(m.monitors), row))
    steps = [
        {"frequency_hz": float(s.frequency), "harmonic": int(s.harmonic), "step_hz": float(s.step)}
        for s in m.steps
    ]
    return header("dispersion", m) | {"steps": steps}


def _write_tunes(table: TextIO, m: TuneReading) -> Document:
    nothing = np.full_like(m.tune, np.nan)
    values, errors = (
        np.concatenate([nothing if part is None else part for part in parts], axis=1)
        for parts in ((m.tune, m.chromaticity), (m.tune_error, m.chromaticity_error))
    )
    write = csv.writer(table, lineterminator="\n").writerow
    write(TUNES)
    for shot, own, sigma in zip(m.shots, values.tolist(), errors.tolist(), strict=True):
        for name, pair in zip(QUANTITIES, zip(own, sigma, strict=True), strict=True):
            if not np.isnan(pair).all():
                write((shot, name, *fields(pair)))
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


def fields(pair: Sequence[float]) -> list[str]:
    """repr is the shortest text that reads back as the same number; a missing one is empty."""
    return [repr(v) if v == v else "" for v in pair]  # noqa: PLR0124  (NaN)


def reading_lines(
    start: str, names: Sequence[str], readings: Sequence[Sequence[float]]
) -> Iterator[str]:
    """Rows of readings [monitor, 2] that begin with the same columns; names are `quoted`."""
    for name, (x, y) in zip(names, readings, strict=True):
        yield f"{start}{name},{repr(x) if x == x else ''},{repr(y) if y == y else ''}\n"  # noqa: PLR0124


class Kind(NamedTuple):
    """One kind of measurement of a stored beam: its record, and how a folder of it is handled."""

    record: type
    table: str
    read: Callable[[Path, Document, Known], Any]
    write: Callable[[TextIO, Any], Document]


KINDS = {
    "turn_by_turn": Kind(TurnByTurn, "readings.csv", _turn_by_turn, _write_turns),
    "closed_orbit": Kind(ClosedOrbit, "readings.csv", _closed_orbit, _write_orbits),
    "dispersion": Kind(Dispersion, "readings.csv", _dispersion, _write_dispersion),
    "tunes": Kind(TuneReading, "tunes.csv", _tunes, _write_tunes),
}


def check_readable(measured: TurnByTurn | ClosedOrbit | Dispersion | TuneReading) -> None:
    """Raises a MeasurementError for a reading that no reader would take (above 0.2 m)."""
    if isinstance(measured, Dispersion):
        check_size(measured.orbits, measured.monitors)
    elif not isinstance(measured, TuneReading):
        check_size(getattr(measured, measured.READ), measured.monitors)
