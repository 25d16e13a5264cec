"""The measurement folder, format version 1: `measurement.json` and a table of readings.

The shots, or the columns of an orbit response, stand in `measurement.json`; what was read stands
in `readings.csv`, or `response.csv`. Numbers are written so that they read back bit by bit.
"""

import csv
import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, TextIO

import numpy as np
from numpy.typing import NDArray

from tmlattice.errors import MeasurementError, UnknownNameError
from tmlattice.files import output_folder, write_json
from tmlattice.measurement.documents import located, read_document
from tmlattice.measurement.monitors import Names, noise_table
from tmlattice.measurement.orbit_response import OrbitResponse, RfStep
from tmlattice.measurement.rows import LARGEST_READING, dense, match_names, read_rows
from tmlattice.measurement.tables import read_table, read_turn_by_turn
from tmlattice.measurement.trajectory import (
    COORDINATES,
    UNKNOWN_LAUNCH,
    Measurement,
    Settings,
    check_settings,
)

Array = NDArray[np.float64]

FORMAT = "tmlattice-measurement"
READINGS = ("shot", "turn", "monitor", "x", "y")
RESPONSE = ("corrector", "monitor", "x", "y")
RF = "rf"


def read_measurement(
    path: str | Path, monitors: Sequence[str] | None = None, turn_by_turn: str | None = None
) -> Measurement | OrbitResponse:
    """Read a measurement folder, or a plain table of readings (`.csv`, see `read_table`).

    Args:
        path: the folder, its measurement.json, a CSV table, or a turn-by-turn file.
        monitors: the ring's names. Where given, a monitor that is not among them is an error,
            and the names and their order are the ring's; a monitor with no rows is left out
            (`in_order_of` puts it back as missing).
        turn_by_turn: the path is a turn-by-turn file of this kind, see `read_turn_by_turn`.

    Returns:
        A Measurement, or an OrbitResponse, by the folder's kind.

    Raises:
        MeasurementError: one sentence with the file, the line and what would mend it.
    """
    path = Path(path)
    if turn_by_turn is not None:
        return read_turn_by_turn(path, turn_by_turn, monitors=monitors)
    if path.suffix.casefold() == ".csv":
        return read_table(path, monitors=monitors)
    folder = path.parent if path.name == "measurement.json" else path
    if not folder.is_dir():
        raise MeasurementError(
            f"no measurement folder '{folder}'; name a folder that holds measurement.json, or a "
            "table .csv"
        )
    file = folder / "measurement.json"
    if not file.is_file():
        raise MeasurementError(f"no '{file}'; a measurement folder has one")
    document = read_document(file, "measurement", FORMAT)
    read = _trajectory if document["kind"] == "trajectory" else _orbit_response
    return read(file, document, monitors)


def _number(value: Any, missing: float) -> float:
    """A number of the document; null is what is not finite."""
    return missing if value is None else float(value)


def _trajectory(
    file: Path, document: dict[str, Any], monitors: Sequence[str] | None
) -> Measurement:
    with located(file):
        shots, launches, sigma, settings = _shots(document["shots"])
    index = {shot: i for i, shot in enumerate(shots)}
    rows = read_rows(file.with_name("readings.csv"), READINGS)
    rows.check("shot", "turn", "monitor")
    order = np.array([index.get(s, -1) for s in rows.whole["shot"].tolist()])
    if (order < 0).any():
        row = int((order < 0).argmax())
        raise rows.error(
            row, f"shot {rows.whole['shot'][row]} is not among the shots of measurement.json; "
            "add it there, or take the row out",
        )  # fmt: skip
    names, place = match_names(rows, "monitor", monitors)
    readings = dense(rows, order, len(shots), place, len(names))
    with located(file):
        return Measurement(
            launches=launches,
            readings=readings,
            monitors=names,
            noise=_read_noise(document.get("noise"), names, monitors),
            launch_sigma=sigma,
            settings=settings,
            shots=shots,
            lattice=document.get("lattice"),
            energy=document.get("energy_gev"),
        )


def _shots(
    listed: list[dict[str, Any]],
) -> tuple[tuple[int, ...], Array, Array | None, tuple[Settings, ...]]:
    """Ids, launches, their sigma where one is stated, and settings of the document's shots."""
    shots: dict[int, Settings] = {}
    launches = np.zeros((len(listed), 5))
    sigma = np.tile(UNKNOWN_LAUNCH, (len(listed), 1))
    for i, shot in enumerate(listed):
        number = int(shot["id"])
        if number in shots:
            raise MeasurementError(f"shot {number} stands twice; give each shot an id of its own")
        for j, name in enumerate(COORDINATES):
            launches[i, j] = shot.get("launch", {}).get(name, 0.0)
            stated = (shot.get("launch_sigma") or {}).get(name, sigma[i, j])
            sigma[i, j] = _number(stated, np.inf)
            if not np.isfinite(launches[i, j]):
                raise MeasurementError(f"shots[{i}].launch.{name} is not finite; give a number")
        shots[number] = shot.get("settings") or {}
        with located(Path(f"shots[{i}].settings")):
            check_settings(number, shots[number])
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
            raise MeasurementError('"dispersion" is true but "rf" does not say the step; add it')

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
            noise=_read_noise(document.get("noise"), names, monitors),
            rf=rf and RfStep(
                frequency=float(rf["frequency_hz"]),
                harmonic=int(rf["harmonic"]),
                step=float(rf["step_hz"]),
                orbit=response[-1] if dispersion else None,
            ),
            lattice=document.get("lattice"),
            energy=document.get("energy_gev"),
        )  # fmt: skip


def _read_noise(noise: Any, read: Sequence[str], known: Sequence[str] | None) -> Array | None:
    """[monitor, 2] of a pair or a table by monitor. A monitor without rows is passed over."""
    if noise is None:
        return None
    if not any(isinstance(entry, dict) for entry in noise.values()):
        return noise_table(_pair(noise), read)
    table = Names("monitor", noise)
    if known is not None:
        every = Names("monitor", known)
        for name in table.names:
            every[name]  # an UnknownNameError where the ring has no such monitor
    names = Names("monitor", read)
    there = {name: _pair(entry) for name, entry in noise.items() if names.find(name) is not None}
    return noise_table(there, read)


def _pair(entry: Mapping[str, Any] | None) -> tuple[float, float]:
    entry = entry or {}
    return _number(entry.get("x"), np.nan), _number(entry.get("y"), np.nan)


def write_measurement(folder: str | Path, measurement: Measurement | OrbitResponse) -> None:
    """Write a measurement folder: whole, or not at all. What it reads back is bit-identical.

    Args:
        folder: made where it is not there; files of the same names are replaced.
        measurement: of either kind.

    Raises:
        OutputError: it cannot be written.
        MeasurementError: a reading that no reader would take (above 0.2 m).
    """
    if isinstance(measurement, OrbitResponse):
        _write_response(Path(folder), measurement)
        return
    m = measurement
    with measurement_writer(folder, m.monitors, m.noise, m.lattice, m.energy) as writer:
        for i, shot in enumerate(m.shots):
            writer.add(
                shot,
                m.launches[i],
                None if m.launch_sigma is None else m.launch_sigma[i],
                m.settings[i] if m.settings else {},
                m.readings[i],
            )


def _write_response(folder: Path, response: OrbitResponse) -> None:
    orbits = [(name, response.response[i]) for i, name in enumerate(response.correctors)]
    document = _header("orbit_response", response.monitors, response)
    document["columns"] = [
        {"corrector": name, "plane": plane, "kick": float(kick)}
        for name, plane, kick in zip(
            response.correctors, response.planes, response.kicks, strict=True
        )
    ]
    if response.rf is not None:
        document["rf"] = {
            "frequency_hz": float(response.rf.frequency),
            "harmonic": int(response.rf.harmonic),
            "step_hz": float(response.rf.step),
        }
        if response.rf.orbit is not None:
            document["dispersion"] = True
            orbits.append((RF, response.rf.orbit))
    with output_folder(folder) as temporary:
        write_json(temporary / "measurement.json", document)
        write_response_table(temporary / "response.csv", response.monitors, orbits)


def write_response_table(
    path: Path, monitors: Sequence[str], orbits: Sequence[tuple[str, Array]]
) -> None:
    """Write orbit changes as the table of an orbit response's folder.

    Args:
        path: the file.
        monitors: names.
        orbits: a corrector's name, or "rf", and its orbit change, m, [monitor, 2].

    Raises:
        MeasurementError: an orbit change that no reader would take (above 0.2 m).
    """
    with path.open("w", encoding="utf-8", newline="") as file:
        write = csv.writer(file, lineterminator="\n").writerow
        write(RESPONSE)
        for name, orbit in orbits:
            _check_size(orbit, monitors)
            for monitor, xy in zip(monitors, orbit.tolist(), strict=True):
                write((name, monitor, *_fields(xy)))


def _header(kind: str, monitors: Sequence[str], source: Any) -> dict[str, Any]:
    """What both kinds of document begin with; `source` has noise, lattice and energy."""
    from tmlattice import __version__

    header: dict[str, Any] = {
        "format": FORMAT,
        "version": 1,
        "package": __version__,
        "kind": kind,
        "lattice": source.lattice,
        "energy_gev": None if source.energy is None else float(source.energy),
        "noise": _write_noise(source.noise, monitors),
    }
    return {key: value for key, value in header.items() if value is not None}


def _write_noise(noise: Array | None, monitors: Sequence[str]) -> dict[str, Any] | None:
    if noise is None:
        return None

    def pair(row: Array) -> dict[str, float | None]:
        return {plane: _finite(v) for plane, v in zip("xy", row.tolist(), strict=True)}

    if np.array_equal(noise, np.tile(noise[0], (len(noise), 1)), equal_nan=True):
        return pair(noise[0])
    return {monitor: pair(row) for monitor, row in zip(monitors, noise, strict=True)}


def _finite(value: float) -> float | None:
    return value if np.isfinite(value) else None


def _fields(xy: Sequence[float]) -> list[str]:
    """repr is the shortest text that reads back as the same number; a missing one is empty."""
    return [repr(v) if v == v else "" for v in xy]  # noqa: PLR0124  (NaN)


def _check_size(readings: Array, monitors: Sequence[str]) -> None:
    large = ~(np.abs(readings) <= LARGEST_READING) & ~np.isnan(readings)
    if large.any():
        *_, monitor, plane = np.argwhere(large)[0]
        raise MeasurementError(
            f"monitor '{monitors[monitor]}' reads {readings[large][0]:g} m in {'xy'[plane]}, above "
            f"{LARGEST_READING} m, which no reader takes; readings are in metres"
        )


class MeasurementWriter:
    """Writes a trajectory's folder shot by shot; `measurement_writer` makes it.

    Attributes:
        monitors: names, in the order of the readings.
        noise, lattice, energy: as in `Measurement`.
    """

    def __init__(
        self,
        monitors: Sequence[str],
        noise: Any,
        lattice: str | None,
        energy: float | None,
        document: TextIO,
        table: TextIO,
    ) -> None:
        self.monitors = Names("monitor", monitors).names
        self.noise = noise_table(noise, self.monitors)
        self.lattice, self.energy = lattice, energy
        self._shots: set[int] = set()
        self._some = False
        self._document, self._table = document, table
        header = json.dumps(
            _header("trajectory", self.monitors, self),
            indent=2, ensure_ascii=False, allow_nan=False,
        )  # fmt: skip
        document.write(header.removesuffix("\n}") + ',\n  "shots": [')
        table.write(",".join(READINGS) + "\n")
        # a name with a comma or a quote is quoted as CSV has it
        self._names = [_quoted(name) for name in self.monitors]

    def add(
        self,
        shot: int,
        launch: Array | Sequence[float],
        launch_sigma: Array | Sequence[float] | None,
        settings: Settings | None,
        readings: Array,
    ) -> None:
        """Write one shot; nothing of it is kept but its id.

        Args:
            shot: its id.
            launch: nominal x, px, y, py, delta, [5] (or [4], delta 0).
            launch_sigma: their rms, [5] (or [4], delta exact); None: unknown.
            settings: see `Measurement`; None or {} for the design's.
            readings: m, [turn, monitor, 2], NaN where missing.

        Raises:
            MeasurementError: shapes or numbers that no reader would take, or a shot once more.
        """
        if shot in self._shots:
            raise MeasurementError(f"shot {shot} is written already; give each an id of its own")
        readings = np.asarray(readings, dtype=float)
        if readings.ndim != 3 or readings.shape[1:] != (len(self.monitors), 2):
            raise MeasurementError(
                f"shot {shot} has readings of the shape {readings.shape}; it should be "
                f"[turns, {len(self.monitors)}, 2]"
            )
        _check_size(readings, self.monitors)
        entry: dict[str, Any] = {"id": int(shot), "launch": _coordinates(launch, "launch")}
        if None in entry["launch"].values():
            raise MeasurementError(f"the launch of shot {shot} is not finite")
        if launch_sigma is not None:
            if not (np.asarray(launch_sigma, dtype=float) >= 0).all():
                raise MeasurementError(f"a launch_sigma of shot {shot} is negative or NaN")
            entry["launch_sigma"] = _coordinates(launch_sigma, "launch_sigma")
        if settings:
            check_settings(shot, settings)
            entry["settings"] = {
                name: {key: float(amount) for key, amount in changed.items()}
                for name, changed in settings.items()
            }
        separator = ",\n    " if self._shots else "\n    "
        self._document.write(separator + json.dumps(entry, ensure_ascii=False, allow_nan=False))
        for turn, row in enumerate(readings.tolist()):
            start = f"{int(shot)},{turn},"
            self._table.writelines(
                f"{start}{name},{repr(x) if x == x else ''},{repr(y) if y == y else ''}\n"  # noqa: PLR0124
                for name, (x, y) in zip(self._names, row, strict=True)
            )
        self._shots.add(shot)
        self._some |= bool(np.isfinite(readings).any())

    def close(self) -> None:
        """End the document.

        Raises:
            MeasurementError: no shot, or no reading, was written.
        """
        if not self._some:
            raise MeasurementError("no reading was written; a measurement has one at least")
        self._document.write("\n  ]\n}\n")


def _quoted(name: str) -> str:
    return '"' + name.replace('"', '""') + '"' if set(name) & {",", '"'} else name


def _coordinates(values: Any, what: str) -> dict[str, float | None]:
    array = np.asarray(values, dtype=float)
    if array.shape not in ((4,), (5,)):
        raise MeasurementError(f"a {what} is x, px, y, py and delta, not {array.shape} numbers")
    padded = np.pad(array, (0, 5 - len(array))).tolist()
    return {name: _finite(v) for name, v in zip(COORDINATES, padded, strict=True)}


@contextmanager
def measurement_writer(
    folder: str | Path,
    monitors: Sequence[str],
    noise: Any = None,
    lattice: str | None = None,
    energy: float | None = None,
) -> Iterator[MeasurementWriter]:
    """A writer of a trajectory's folder, shot by shot, with memory flat in their number.

    The folder appears, whole, when the block ends; after an exception or Ctrl-C nothing is left.

    Args:
        folder: made where it is not there; files of the same names are replaced.
        monitors: names, in the order of the readings.
        noise: rms of a reading, m: a pair (x, y), [monitor, 2], a mapping by monitor, or None.
        lattice: name or path, a hint for the reader.
        energy: GeV.

    Raises:
        OutputError: it cannot be written.
        MeasurementError: names or noise that cannot be; no reading written.
    """
    with ExitStack() as stack:
        temporary = stack.enter_context(output_folder(Path(folder)))
        with (
            (temporary / "measurement.json").open("w", encoding="utf-8") as document,
            (temporary / "readings.csv").open("w", encoding="utf-8", newline="") as table,
        ):
            writer = MeasurementWriter(monitors, noise, lattice, energy, document, table)
            yield writer
            writer.close()
