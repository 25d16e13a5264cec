"""A measurement by its path, whatever stands there: for `diagnose(ring, "readings.csv")`."""

import logging
from os import PathLike
from pathlib import Path
from typing import Any

from tmlattice.errors import MeasurementError
from tmlattice.importers.bring_in import Options, bring_in
from tmlattice.lattice import Ring
from tmlattice.measurement import read_measurement

log = logging.getLogger(__name__)


def measured(path: str | PathLike[str], ring: Ring | None = None) -> Any:
    """The measurement of a folder, or of a file of another program; what is assumed of a file is
    logged (logger `tmlattice.importers`, level info).

    Args:
        path: a measurement folder, or a file that `importers.bring_in` takes.
        ring: whose names a table has.

    Raises:
        MeasurementError: nothing there, or nothing that is known.
    """
    place = Path(path)
    if not place.is_file() or place.name == "measurement.json":
        return read_measurement(place)
    if ring is None:
        raise MeasurementError(f"'{place}' is a file of another program: give the ring with it")
    brought = bring_in([place], Options(ring=ring))
    for sentence in (*brought.assumed, *brought.doubts):
        log.info("%s: %s", place, sentence)
    return brought.measurement
