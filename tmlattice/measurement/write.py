"""Writing the measurement folder, format version 1: see `measurement.folder`."""

import hashlib
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from tmlattice.arrays import Array
from tmlattice.errors import MeasurementError
from tmlattice.files import output_folder, write_json
from tmlattice.measurement.folder import AnyMeasurement
from tmlattice.measurement.header import finite, header
from tmlattice.measurement.kinds import KINDS, TURNS, plain_settings, quoted, reading_lines
from tmlattice.measurement.monitors import Names, Settings, check_settings, check_size, noise_table
from tmlattice.measurement.trajectory import COORDINATES, Measurement


def write_measurement(folder: str | Path, measurement: AnyMeasurement, force: bool = False) -> None:
    """Write a measurement folder: whole, or not at all. What it reads back is bit-identical.

    Args:
        folder: made where it is not there.
        force: a measurement that is there already is replaced.

    Raises:
        OutputError: it cannot be written.
        MeasurementError: a reading that no reader would take (above 0.2 m), or a folder that
            holds a measurement.
    """
    if not isinstance(measurement, Measurement):
        check_free(folder, force)
        (kind,) = (kind for kind in KINDS.values() if kind.record is type(measurement))
        with output_folder(Path(folder)) as temporary:
            table = temporary / kind.table
            assert kind.write is not None
            with table.open("w", encoding="utf-8", newline="") as file:
                document = kind.write(file, measurement)
            with table.open("rb") as written:
                digest = hashlib.file_digest(written, "sha256").hexdigest()
            write_json(temporary / "measurement.json", {**document, "table_sha256": digest})
        return
    m = measurement
    with measurement_writer(
        folder, m.monitors, m.noise, m.lattice, m.energy, force, m.devices
    ) as writer:
        for i, shot in enumerate(m.shots):
            writer.add(
                shot,
                m.launches[i],
                None if m.launch_sigma is None else m.launch_sigma[i],
                m.settings[i] if m.settings else {},
                m.readings[i],
            )


def check_free(folder: str | Path, force: bool = False) -> None:
    """Old data are kept: a folder is written to when it holds no measurement, or by force;
    MeasurementError: it holds one."""
    if force:
        return
    for name in ("measurement.json", "readings.csv", "response.csv", "tunes.csv"):
        if (Path(folder) / name).exists():
            raise MeasurementError(
                f"'{folder}' holds a measurement already ({name}); name another folder, or replace "
                "it with --force (in Python: force=True)"
            )


class MeasurementWriter:
    """Writes a trajectory's folder shot by shot; `measurement_writer` makes it.

    Attributes:
        monitors: names, in the order of the readings.
        noise, lattice, energy, devices: as in `Measurement`.
    """

    def __init__(
        self,
        monitors: Sequence[str],
        noise: Any,
        lattice: str | None,
        energy: float | None,
        document: TextIO,
        table: TextIO,
        devices: Mapping[str, str] | None = None,
    ) -> None:
        self.monitors = Names("BPM", monitors).names
        self.noise = noise_table(noise, self.monitors)
        self.lattice, self.energy, self.devices = lattice, energy, devices or {}
        self._shots: set[int] = set()
        self._some = False
        self._document, self._table = document, table
        start = json.dumps(
            header("trajectory", self),
            indent=2, ensure_ascii=False, allow_nan=False,
        )  # fmt: skip
        document.write(start.removesuffix("\n}") + ',\n  "shots": [')
        self._digest = hashlib.sha256()  # proves that table and document were written together
        self._write([",".join(TURNS) + "\n"])
        self._names = quoted(self.monitors)

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
            launch, launch_sigma: nominal x, px, y, py, delta, [5] (or [4]), and their rms; None:
                unknown.
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
        check_size(readings, self.monitors)
        entry: dict[str, Any] = {"id": int(shot), "launch": _coordinates(launch, "launch")}
        if None in entry["launch"].values():
            raise MeasurementError(f"the launch of shot {shot} is not finite")
        if launch_sigma is not None:
            if not (np.asarray(launch_sigma, dtype=float) >= 0).all():
                raise MeasurementError(f"a launch_sigma of shot {shot} is negative or NaN")
            entry["launch_sigma"] = _coordinates(launch_sigma, "launch_sigma")
        if settings:
            check_settings(shot, settings)
            entry["settings"] = plain_settings(settings)
        separator = ",\n    " if self._shots else "\n    "
        self._document.write(separator + json.dumps(entry, ensure_ascii=False, allow_nan=False))
        for turn, row in enumerate(readings.tolist()):
            self._write(reading_lines(f"{int(shot)},{turn},", self._names, row))
        self._shots.add(shot)
        self._some |= bool(np.isfinite(readings).any())

    def _write(self, lines: Iterable[str]) -> None:
        text = "".join(lines)
        self._digest.update(text.encode())
        self._table.write(text)

    def close(self) -> None:
        """End the document.

        Raises:
            MeasurementError: no shot, or no reading, was written.
        """
        if not self._some:
            raise MeasurementError("no reading was written; a measurement has one at least")
        self._document.write(f'\n  ],\n  "table_sha256": "{self._digest.hexdigest()}"\n}}\n')


def _coordinates(values: Any, what: str) -> dict[str, float | None]:
    array = np.asarray(values, dtype=float)
    if array.shape not in ((4,), (5,)):
        raise MeasurementError(f"a {what} is x, px, y, py and delta, not {array.shape} numbers")
    padded = np.pad(array, (0, 5 - len(array))).tolist()
    return {name: finite(v) for name, v in zip(COORDINATES, padded, strict=True)}


@contextmanager
def measurement_writer(
    folder: str | Path,
    monitors: Sequence[str],
    noise: Any = None,
    lattice: str | None = None,
    energy: float | None = None,
    force: bool = False,
    devices: Mapping[str, str] | None = None,
) -> Iterator[MeasurementWriter]:
    """A writer of a trajectory's folder, shot by shot, with memory flat in their number.

    The folder appears, whole, when the block ends; after an exception or Ctrl-C nothing is left.

    Args:
        monitors, noise, lattice, energy, devices: see `Measurement`.
        force: a measurement that is there already is replaced.

    Raises:
        OutputError: it cannot be written.
        MeasurementError: names or noise that cannot be; no reading written; a folder that holds
            a measurement.
    """
    check_free(folder, force)
    with ExitStack() as stack:
        temporary = stack.enter_context(output_folder(Path(folder)))
        with (
            (temporary / "measurement.json").open("w", encoding="utf-8") as document,
            (temporary / "readings.csv").open("w", encoding="utf-8", newline="") as table,
        ):
            writer = MeasurementWriter(monitors, noise, lattice, energy, document, table, devices)
            yield writer
            writer.close()
