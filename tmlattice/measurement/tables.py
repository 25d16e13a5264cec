"""Readings from elsewhere: plain CSV tables, and the turn-by-turn files of many laboratories."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from tmlattice.errors import MeasurementError, OtherFormatError
from tmlattice.lattice.mat_file import read_apart
from tmlattice.measurement.arrays import Unit, metres
from tmlattice.measurement.documents import located
from tmlattice.measurement.kinds import TURNS
from tmlattice.measurement.monitors import LARGEST_READING, Names, merge_spellings
from tmlattice.measurement.rows import dense, match_names, read_rows
from tmlattice.measurement.trajectory import Measurement


def read_table(
    path: str | Path,
    *,
    launches: Any = None,
    noise: Any = None,
    launch_sigma: Any = None,
    monitors: Sequence[str] | None = None,
    unit: Unit = "m",
) -> Measurement:
    """Read a plain CSV table of readings: a row for each shot, turn and monitor.

    The first line names the columns, in any order and case: `monitor`, `x` and `y`, and where
    there is more than one, `shot` (a whole number, else 0) and `turn` (from 0, else 0). Other
    columns are passed over. An empty field is a missing reading. UTF-8, separated by commas.

    Args:
        launches: nominal (x, px, y, py[, delta]) of the shots in the order of their numbers,
            [shot, 4 or 5], m and rad; a table has none, and without them they are 0.
        noise: rms of a reading, see `Measurement`.
        launch_sigma: see `Measurement`.
        monitors: the ring's names, checked where given; the names are then the ring's.

    Raises:
        MeasurementError: one sentence with the file, the line and the correction.
    """
    rows = read_rows(Path(path), TURNS, optional=("shot", "turn"))
    rows = replace(rows, xy=rows.xy * metres(unit))
    rows.check(*(k for k in TURNS if k in rows.whole), "monitor")
    numbers = rows.whole.get("shot", np.zeros(len(rows), dtype=np.int64))
    shots, place = np.unique(numbers, return_inverse=True)
    names, monitor = match_names(rows, "monitor", monitors)
    readings = dense(rows, place, len(shots), monitor, len(names))
    with located(rows.path):
        return Measurement(
            launches=np.zeros((len(shots), 5)) if launches is None else launches,
            readings=readings,
            monitors=names,
            noise=noise,
            launch_sigma=launch_sigma,
            shots=tuple(shots.tolist()),
        )


KINDS = "lhc, sps, psb, doros, iota, ptc, trackone, ascii, madng, superkekb"
"""Of turn-by-turn files that the package `turn_by_turn` reads."""


def read_turn_by_turn(
    path: str | Path,
    datatype: str = "lhc",
    *,
    launches: Any = None,
    noise: Any = None,
    monitors: Sequence[str] | None = None,
    unit: Unit = "m",
) -> Measurement:
    """Read a turn-by-turn file through the package `turn_by_turn`; each bunch is a shot.

    Args:
        datatype: its kind, one of `KINDS` (SDDS, HDF5, TFS and text files of these machines and
            codes).
        launches: nominal (x, px, y, py[, delta]) of the bunches, [shot, 4 or 5]; else 0.
        noise: rms of a reading, see `Measurement`.
        monitors: the ring's names, checked where given; the names and their order are then the
            ring's.
        unit: of the file: the package hands numbers on as they stand, and control systems often
            write mm.

    Raises:
        OtherFormatError: the file cannot be read as that kind.
        MeasurementError: its readings cannot be metres.
    """
    path = Path(path)
    scale = metres(unit)
    if datatype not in KINDS.split(", "):
        raise OtherFormatError(f"no kind '{datatype}' of turn-by-turn files; there are {KINDS}")
    tables, bunches = read_apart(
        "turns", path, f"'{datatype}' (kinds: {KINDS})", OtherFormatError, datatype
    )
    spellings = list(dict.fromkeys(n for table in tables for names, _ in table for n in names))
    found, places = merge_spellings(spellings)
    place = dict(zip(spellings, places.tolist(), strict=True))
    # a file may state fewer turns than it has: the tables count
    turns = max((values.shape[1] for planes in tables for _, values in planes), default=0)
    readings = np.full((len(tables), turns, len(found), 2), np.nan)
    for shot, planes in enumerate(tables):
        for plane, (names, values) in enumerate(planes):
            index = [place[name] for name in names]
            if len(set(index)) < len(index):
                raise MeasurementError(f"{path}: a BPM stands twice; name each once")
            readings[shot, : values.shape[1], index, plane] = scale * values
    if (np.abs(readings) > LARGEST_READING).any():
        raise MeasurementError(
            f"{path}: readings up to {np.nanmax(np.abs(readings)):g} m are above "
            f"{LARGEST_READING} m; state the unit of the file (unit='mm')"
        )
    with located(path):
        if monitors is not None:
            names = Names("BPM", monitors)
            ring = np.array([names[name] for name in found])
            order = np.argsort(ring)
            readings = readings[:, :, order]
            found = tuple(names.names[i] for i in ring[order])
        return Measurement(
            launches=np.zeros((len(tables), 5)) if launches is None else launches,
            readings=readings,
            monitors=found,
            noise=noise,
            shots=tuple(bunches),
        )
