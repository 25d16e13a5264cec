"""Templates of the files that need no preparation: `tmlattice import --example`."""

import csv
import os
from pathlib import Path

import numpy as np

from tmlattice.files import output_folder
from tmlattice.importers.stated import machine_text
from tmlattice.lattice import Ring, builtin_lattices
from tmlattice.measurement import Measurement
from tmlattice.observe.calibration import calibrated_response

KICK = 1e-4
"""rad; of the correctors in the template of a response."""

FILES = {
    "readings_wide.csv": "a row a shot, a column a BPM and plane",
    "readings_long.csv": "a row a shot and BPM",
    "readings.h5": "x and y [shot, BPM], with the BPMs' names",
    "response.csv": "an orbit response: a row a corrector and BPM (here the design's)",
    "tmlattice.toml": "what the files do not state: lattice, unit, names, bad BPMs (--machine)",
}


def write_example(folder: Path, lattice: str, ring: Ring, measurement: Measurement) -> None:
    """Write every file of `FILES`.

    Args:
        folder: made where it is not there; files of these names are replaced.
        lattice: built-in name or path of the ring.
        ring: whose names they have.
        measurement: first turns to stand in them, in mm; the wide table has names such as a
            control room's, which the machine file explains.

    Raises:
        OutputError: the folder cannot be written.
    """
    import h5py

    monitors = measurement.monitors
    readings = 1e3 * measurement.readings[:, 0]
    channels = [f"SR:DI-BPM-{i:03d}" for i in range(1, len(monitors) + 1)]
    with output_folder(folder) as place:
        _write(
            place / "readings_wide.csv",
            ["shot", *(f"{name}:{plane}" for name in channels for plane in "XY")],
            [[str(shot), *map(_text, values.ravel())] for shot, values in enumerate(readings)],
        )
        _write(
            place / "readings_long.csv",
            ["shot", "monitor", "x [mm]", "y [mm]"],
            [
                [str(shot), name, *map(_text, xy)]
                for shot, values in enumerate(readings)
                for name, xy in zip(monitors, values, strict=True)
            ],
        )
        with h5py.File(place / "readings.h5", "w") as file:
            file["monitors"] = list(monitors)
            for i, plane in enumerate("xy"):
                file[plane] = readings[:, :, i]
                file[plane].attrs["unit"] = "mm"
        # one corrector in each plane where there are any
        found = {e.kind: e.name for e in ring.elements if e.is_corrector}
        columns, response = calibrated_response(ring, [], list(found.values()) or None)
        every = [monitor.name for monitor in ring.monitors]
        _write(
            place / "response.csv",
            ["corrector", "monitor", "x [mm]", "y [mm]", "kick [mrad]"],
            [
                [corrector, monitor, *map(_text, 1e3 * KICK * xy), f"{1e3 * KICK:g}"]
                for corrector, orbit in zip(columns.names, response, strict=True)
                for monitor, xy in zip(every, orbit, strict=True)
            ],
        )
        named = lattice.casefold() in builtin_lattices()
        text = machine_text(
            lattice if named else os.path.relpath(lattice, folder),
            {"unit": "mm", "noise": "20 um", "bad": [monitors[-1]]},
            {},
            dict(zip(channels, monitors, strict=True)),
            {"knob": "qd", "unit": "A", "present": 100.0, "curve": [[0, 0], [120, -0.6]]},
        )
        (place / "tmlattice.toml").write_text(text, encoding="utf-8")


def _text(value: float) -> str:
    return "" if np.isnan(value) else f"{value:.6g}"


def _write(path: Path, header: list[str], rows: list[list[str]]) -> None:
    with path.open("w", encoding="utf-8", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows([header, *rows])
