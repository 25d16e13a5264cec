"""A measurement by its path, of any kind of file: for `diagnose(ring, "readings.csv")`."""

import logging
from collections.abc import Sequence
from os import PathLike
from pathlib import Path
from typing import Any

from tmlattice.by_name import by_name, is_frame
from tmlattice.errors import MeasurementError
from tmlattice.importers.bring_in import Options, bring_in
from tmlattice.importers.columns import CSV, HDF5, SDDS, label, read_columns
from tmlattice.importers.imported import Imported
from tmlattice.importers.readings import bring_readings, with_unit
from tmlattice.importers.tables import is_response_table
from tmlattice.lattice import Ring
from tmlattice.measurement import AnyMeasurement, folder
from tmlattice.measurement.arrays import Unit

log = logging.getLogger(__name__)


@by_name
def read_measurement(
    path: str | PathLike[str] | Any,
    monitors: Sequence[str] | None = None,
    turn_by_turn: str | None = None,
    unit: Unit | None = None,
    *,
    ring: Ring | None = None,
) -> AnyMeasurement:
    """Read a measurement: a folder, or any file that `diagnose` reads.

    What is assumed of a file (units, names, signs) is logged (logger `tmlattice.importers`, level
    info). Without `ring` and `monitors` the names are those of the file.

    Args:
        path: a measurement folder, its measurement.json, or a file that `bring_in` takes: a table
            (`.csv`, `.tsv`, `.txt`, `.h5`, `.sdds`), turns, a LOCO file; or a pandas DataFrame or
            an xarray Dataset.
        monitors: the ring's names. Of a folder, a monitor that is not among them is an error.
        turn_by_turn: the path is a turn-by-turn file of this kind, see `read_turn_by_turn`.
        unit: of the readings of a file that states none; else taken from their size.
        ring: the lattice, which knows the names of monitors and correctors.

    Raises:
        MeasurementError: nothing there, or nothing that is known; one sentence.
        UnknownNameError: a monitor that the ring does not have.
    """
    if is_frame(path):
        return _logged(bring_in([path], Options(ring=ring, unit=unit)), label(path))
    place = Path(path)
    if turn_by_turn is not None or not place.is_file() or place.name == "measurement.json":
        return folder.read_measurement(place, monitors, turn_by_turn, unit or "m")
    if monitors is not None and place.suffix.lower() in (*CSV, *HDF5, *SDDS):
        columns = read_columns(place)
        if place.suffix.lower() not in CSV or not is_response_table(columns):
            told = with_unit(None, unit, None)
            return _logged(bring_readings(str(place), columns, None, told, monitors), str(place))
    brought = bring_in([place], Options(ring=ring, unit=unit))
    return _logged(brought, str(place))


def _logged(brought: Imported, name: str) -> AnyMeasurement:
    for sentence in (*brought.assumed, *brought.doubts):
        log.info("%s: %s", name, sentence)
    return brought.measurement


def measured(path: str | PathLike[str] | Any, ring: Ring | None = None) -> Any:
    """The measurement of a path or a frame that was given where a measurement is taken.

    Raises:
        MeasurementError: a file of another program without the ring; see `read_measurement`.
    """
    if is_frame(path):
        return read_measurement(path, ring=ring)
    place = Path(path)
    if ring is None and place.is_file() and place.name != "measurement.json":
        raise MeasurementError(f"'{place}' is a file of another program: give the ring with it")
    return read_measurement(place, ring=ring)
