"""The measurement folder, format version 1: `measurement.json` and a table of readings.

The shots, the columns of an orbit response, or the RF's steps stand in `measurement.json`; what was
read stands in `readings.csv`, `response.csv` or `tunes.csv`. Numbers are written so that they read
back bit by bit.
"""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

from tmlattice.errors import MeasurementError
from tmlattice.measurement.arrays import Unit
from tmlattice.measurement.assume import WORDS
from tmlattice.measurement.dispersion import Dispersion
from tmlattice.measurement.documents import read_document
from tmlattice.measurement.header import FORMAT
from tmlattice.measurement.kinds import FEWEST, KINDS, MOST_UNREAD
from tmlattice.measurement.orbit_response import OrbitResponse
from tmlattice.measurement.shots import ClosedOrbit, TurnByTurn
from tmlattice.measurement.tables import read_table, read_turn_by_turn
from tmlattice.measurement.trajectory import Measurement
from tmlattice.measurement.tune_reading import TuneReading
from tmlattice.temporaries import locked

AnyMeasurement = Measurement | OrbitResponse | TurnByTurn | ClosedOrbit | Dispersion | TuneReading
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
        measured: AnyMeasurement = KINDS[document["kind"]].read(file, document, monitors)
        return measured


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
