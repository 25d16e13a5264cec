"""Measurements as tables of pandas and xarray, and back.

The table is that of the measurement folder (`measurement.folder`), in m; `attrs["units"]` states
the units, and `attrs["measurement"]` what measurement.json holds: launches, settings, noise. Both
directions take the folder's own writer and reader, so that what is read back is bit-identical.
"""

import csv
import json
from io import StringIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from tmlattice.errors import MeasurementError
from tmlattice.measurement.folder import AnyMeasurement, read_measurement
from tmlattice.measurement.kinds import KINDS
from tmlattice.measurement.orbit_response import OrbitResponse
from tmlattice.measurement.rows import read_rows
from tmlattice.measurement.write import write_measurement

ATTRIBUTE = "measurement"


def to_dataframe(measured: AnyMeasurement) -> Any:
    """Return the readings as a pandas DataFrame: a row a reading.

    Columns: shot, turn, monitor, x, y (m) of first turns and turn by turn; shot, monitor, x, y of
    a closed orbit; step, monitor, x, y of a dispersion measurement; corrector, monitor, x, y, kick
    (rad; Hz of the rows of "rf"), plane of an orbit response; shot, quantity, value, error of
    tunes. The rest stands in `attrs`: `from_dataframe` reads an equal measurement back.
    """
    import pandas as pd

    with TemporaryDirectory() as folder:
        write_measurement(folder, measured)
        document = json.loads((Path(folder) / "measurement.json").read_text(encoding="utf-8"))
        kind = KINDS[document["kind"]]
        rows = read_rows(Path(folder) / kind.table, kind.columns)
    texts = {name: np.array(own, dtype=object)[at] for name, (own, at) in rows.names.items()}
    numbers = dict(zip(kind.columns[-2:], rows.xy.T, strict=True))
    frame = pd.DataFrame({name: (rows.whole | texts | numbers)[name] for name in kind.columns})
    del document["table_sha256"]
    units = {"x": "m", "y": "m"} if "x" in frame.columns else {}
    if isinstance(measured, OrbitResponse):
        units["kick"] = "rad"
        kicks = dict(zip(measured.correctors, measured.kicks.tolist(), strict=True))
        planes = dict(zip(measured.correctors, measured.planes, strict=True))
        if measured.rf is not None:
            kicks["rf"], planes["rf"] = measured.rf.step, ""
        frame["kick"] = frame["corrector"].map(kicks)
        frame["plane"] = frame["corrector"].map(planes)
    frame.attrs = {"units": units, ATTRIBUTE: document}
    return frame


def to_xarray(measured: AnyMeasurement) -> Any:
    """Return the readings as an xarray Dataset: x and y in m along shots, turns and monitors.

    The axes are the first columns of `to_dataframe`; `attrs["measurement"]` is its attribute, as
    JSON text, so that the Dataset can be written to a file.

    Raises:
        MeasurementError: a reading above 0.2 m, or xarray is not installed.
    """
    frame = to_dataframe(measured)
    axes = list(KINDS[frame.attrs[ATTRIBUTE]["kind"]].columns[:-2])
    of_columns = [frame.pop(name) for name in ("kick", "plane") if name in frame.columns]
    try:
        data = frame.set_index(axes).to_xarray()
    except ImportError as error:
        raise MeasurementError("to_xarray needs the package xarray: pip install xarray") from error
    data = data.sel({axis: frame[axis].unique() for axis in axes})  # in the order of the readings
    for values in of_columns:
        first = values[~frame["corrector"].duplicated()].tolist()
        data = data.assign_coords({values.name: ("corrector", first)})
    data.attrs = {ATTRIBUTE: json.dumps(frame.attrs[ATTRIBUTE], ensure_ascii=False)}
    for name, unit in frame.attrs["units"].items():
        data[name].attrs["units"] = unit
    return data


def of_document(frame: Any) -> AnyMeasurement | None:
    """The measurement of a frame of `to_dataframe`; None: it states none, or is no such table;
    MeasurementError: rows that cannot be read."""
    document = frame.attrs.get(ATTRIBUTE)
    if isinstance(document, str):
        try:
            document = json.loads(document)
        except ValueError as error:
            raise MeasurementError(f"attrs['{ATTRIBUTE}'] is no JSON ({error})") from error
    if not isinstance(document, dict) or document.get("kind") not in KINDS:
        return None
    kind = KINDS[document["kind"]]
    columns = list(kind.columns)
    if not set(columns) <= set(frame.columns):
        return None
    with TemporaryDirectory() as folder:
        place = Path(folder)
        (place / "measurement.json").write_text(json.dumps(document), encoding="utf-8")
        table = StringIO()
        frame[columns].to_csv(table, index=False, quoting=csv.QUOTE_MINIMAL, lineterminator="\n")
        (place / kind.table).write_text(table.getvalue(), encoding="utf-8")
        try:
            return read_measurement(place)
        except MeasurementError as error:
            raise MeasurementError(str(error).replace(folder, type(frame).__name__)) from error
