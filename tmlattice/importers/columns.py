"""Columns of a file as they stand: CSV of any separator, HDF5, SDDS. Their meaning is unknown.

>>> for column in read_columns(Path("orbits.csv")):
...     column.name, column.unit, column.values
"""

import csv
import re
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tmlattice.errors import MeasurementError
from tmlattice.input_files import content_of, decoded, number
from tmlattice.lattice.mat_file import read_apart
from tmlattice.measurement.rows import not_csv

CSV, HDF5, SDDS = (".csv", ".tsv", ".txt", ".dat"), (".h5", ".hdf5", ".hdf"), (".sdds",)

_BRACKETS = re.compile(r"^\s*(?P<name>.*?)\s*[\[(](?P<unit>[^\])]*)[\])]\s*$")
_TAIL = re.compile(r"^\s*(?P<name>.*?)[\s_/,]+(?P<unit>mm|um|µm|nm)\s*$", re.IGNORECASE)
_COMMENT = "#%!@$"
"""What lines begin with that hold no readings: of scripts, MATLAB, MAD-X and its tables."""
_DECIMAL = re.compile(r"^([+-]?\d*),(\d+)(?![\d.,])")
"""A number with a decimal comma."""
_UNITS = {"mm", "um", "µm", "nm", "m", "", "-"}

_POSITION = re.compile(r"(?:^|[^a-z])(?:x|y|hor\w*|ver\w*)(?:[^a-z]|$)", re.IGNORECASE)
"""Of names of readings: a plane as a word."""

SHEETS = (".xlsx", ".xlsm", ".xls", ".ods")
_ARCHIVE, _OLD_SHEET = b"PK\x03\x04", b"\xd0\xcf\x11\xe0"


def text_of(path: Path) -> str:
    """The text of a table: UTF-8, or as spreadsheets write it, UTF-16 and Latin-1.

    Raises:
        MeasurementError: it cannot be read, or is no text.
    """
    content = content_of(path, MeasurementError)
    if path.suffix.lower() in SHEETS or content.startswith((_ARCHIVE, _OLD_SHEET)):
        raise MeasurementError(f"'{path}' is a spreadsheet, which is not read; save it as CSV")
    text = decoded(content)
    if "\0" in text:
        raise MeasurementError(f"'{path}' is no text; save the table as CSV")
    return text


@dataclass(frozen=True)
class Column:
    """One column.

    Attributes:
        name: without its unit.
        unit: as it stands in the header; empty where there is none.
        values: texts, one a row; empty where nothing stands.
    """

    name: str
    unit: str
    values: list[str]


def read_columns(path: Path | Any) -> list[Column]:
    """All columns of a file, or of a frame (see `by_name.is_frame`), of the same length.

    Raises:
        MeasurementError: no such file, or no table in it.
    """
    if not isinstance(path, Path):
        found = _of_frame(path)
        if not found or not found[0].values:
            raise MeasurementError(f"{label(path)}: no rows; nothing was read")
        return found
    suffix = path.suffix.lower()
    if suffix in HDF5:
        found = _hdf5(path)
    elif is_sdds(path):
        try:
            arrays = read_apart("sdds", path, "SDDS", MeasurementError)
        except MeasurementError as error:
            raise MeasurementError(
                f"{error}; a turn-by-turn file is read by `tmlattice import --turns KIND`"
            ) from error
        found = _apart(path, arrays)
    else:
        found = _csv(path)
    if not found or not found[0].values:
        raise MeasurementError(f"{path}: no rows below the header; nothing was read")
    return found


def is_sdds(path: Path) -> bool:
    """Whether a file is one of SDDS by its name, or by what it begins with, as elegant's are."""
    return path.suffix.lower() in SDDS or content_of(path, MeasurementError).startswith(b"SDDS")


def label(source: Path | Any) -> str:
    """What messages call a file or a frame."""
    return str(source) if isinstance(source, Path) else f"the {type(source).__name__}"


def as_frame(table: Any) -> Any:
    """A pandas DataFrame of a frame or of an xarray Dataset or DataArray, its index as columns.

    Several levels of columns become one, joined by blanks; an index of texts without a name holds
    the monitors, one of times the shots.
    """
    if hasattr(table, "dims"):
        if not hasattr(table, "data_vars"):
            table = table.to_dataset(name=table.name or "value")
        units = {n: v.attrs["units"] for n, v in table.variables.items() if "units" in v.attrs}
        attributes = table.attrs | {"units": units}
        table = table.to_dataframe(dim_order=list(table.dims))
    else:
        attributes = table.attrs
    index = table.index
    if index.nlevels == 1 and index.name is None:
        name = {"O": "monitor", "M": "time"}.get(index.dtype.kind)
        table = table.rename_axis(name) if name else table
    levels = [name for name in table.index.names if name is not None and name not in table.columns]
    table = table.reset_index(level=levels) if levels else table.copy(deep=False)
    if table.columns.nlevels > 1:
        names = [" ".join(map(str, own)).strip() for own in table.columns]
        table = table.set_axis(names, axis=1)
    table.attrs = attributes
    return table


def _of_frame(table: Any) -> list[Column]:
    frame = as_frame(table)
    units = frame.attrs.get("units") or {}
    if not isinstance(units, dict):
        raise MeasurementError(
            f"{label(table)}: attrs['units'] is {units!r}; give the unit of each column, such as "
            "{'x': 'mm', 'y': 'mm'}"
        )
    found = []
    for place, text in enumerate(map(str, frame.columns)):
        name, unit = named(text)
        column = frame.iloc[:, place]
        texts = [
            "" if missing else repr(value) if isinstance(value, float) else str(value).strip()
            for value, missing in zip(column.tolist(), column.isna().tolist(), strict=True)
        ]
        found.append(Column(name, unit or str(units.get(text, "")), texts))
    return found


def named(text: str) -> tuple[str, str]:
    """Name and unit of a header: `x [mm]`, `x (mm)`, `bpm1_x_mm`, `x mm`, `x/mm`."""
    match = _BRACKETS.match(text) or _TAIL.match(text)
    return (match["name"].strip(), match["unit"].strip()) if match else (text.strip(), "")


def _csv(path: Path) -> list[Column]:
    """Comma, semicolon, tab or blanks; comments are passed over, but for the last one above the
    numbers where there is no other header, and lines before the table; a row of units may follow
    the header."""
    text = text_of(path)
    numbered = [(i, line) for i, line in enumerate(text.splitlines(), 1) if line.strip()]
    lines = [(i, line) for i, line in numbered if line.lstrip()[0] not in _COMMENT]
    if not lines:
        raise MeasurementError(f"{path}: the file is empty; write its header first")
    last = lines[-1][1]
    commas = [field for field in last.split() if "," in field]
    decimal = len(last.split()) > 1 and all(map(_DECIMAL.match, commas))
    separator = next((sign for sign in ";\t|" if sign in last), " " if decimal else ",")

    def cut(line: str, number: int) -> list[str]:
        if separator == " ":
            return re.sub(r"\s+([\[(])", r"\1", line.lstrip("* ")).split()
        try:
            fields = next(csv.reader([line], delimiter=separator, skipinitialspace=True))
        except csv.Error as error:
            raise not_csv(path, number, error) from error
        return [field.strip() for field in fields]

    rows = [(i, cut(line, i)) for i, line in lines]
    usual = Counter(len(row) for _, row in rows).most_common(1)[0][0]
    start = next(k for k, (_, row) in enumerate(rows) if len(row) == usual)
    if len(rows) > start + 1 and not any(map(_is_number, rows[start][1])):
        rows = rows[start:]  # below a title, or lines about the file
    first, header = rows.pop(0)
    above = [line.lstrip(f"{_COMMENT}* \t") for i, line in numbered if i < first]
    if above and any(_is_number(field) for field in header):
        rows.insert(0, (first, header))
        header = cut(above[-1], first - 1)
    elif rows and {field.strip("[]()").lower() for field in rows[0][1]} <= _UNITS:
        units = [field.strip("[]()-") for field in rows.pop(0)[1]]
        header = [f"{name} [{unit}]" if unit else name
                  for name, unit in zip(header, units, strict=False)]  # fmt: skip
    for line, row in rows:
        if len(row) != len(header):
            raise MeasurementError(
                f"{path}, line {line}: {len(row)} fields where the header has {len(header)}"
            )
    if separator != ",":
        rows = [(i, [_DECIMAL.sub(r"\1.\2", field) for field in row]) for i, row in rows]
    return [Column(*named(name), [row[i] for _, row in rows]) for i, name in enumerate(header)]


def _is_number(text: str) -> bool:
    try:
        number(text.replace(",", "."))
    except ValueError:
        return False
    return True


def _hdf5(path: Path) -> list[Column]:
    """A column for each array [row]; `x`, `y` [row, monitor] with a list of names are taken apart
    into a column a monitor. The unit is an attribute `unit` or `units`, or stands in the name."""
    content, attributes = read_apart("hdf5", path, "HDF5", MeasurementError)
    units = {}
    for name, own in attributes.items():
        stated = [own[key] for key in ("units", "unit") if key in own]
        if not all(isinstance(unit, str) for unit in stated):
            raise MeasurementError(f"'{path}': the unit of '{name}' is no text")
        if len(set(stated)) > 1:
            raise MeasurementError(f"'{path}': '{name}' has the units {' and '.join(stated)}")
        units[name] = stated[0] if stated else ""
    return _apart(path, {name: (value, units[name]) for name, value in content.items()})


def of_matlab(path: Path, content: Mapping[str, Any]) -> list[Column]:
    """Columns of a MATLAB file's variables, its structures taken apart: see `_hdf5`."""
    arrays: dict[str, tuple[Any, str]] = {}

    def take(name: str, value: Any) -> None:
        if isinstance(value, list) and value and all(isinstance(v, dict) for v in value):
            value = {key: [own.get(key) for own in value] for key in value[0]}
        if isinstance(value, dict):
            for key, own in value.items():
                take(f"{name}/{key}" if name else key, own)
        elif isinstance(value, list | np.ndarray | float | int):
            arrays[name] = np.asarray(value), ""

    take("", dict(content))
    return _apart(path, arrays)


def _apart(path: Path, arrays: dict[str, tuple[Any, str]]) -> list[Column]:
    """Arrays of numbers and names as columns of one length."""
    texts = {name: _texts(value) for name, (value, _) in arrays.items() if _is_text(value)}
    for name in texts:
        if _POSITION.search(name.rsplit("/", 1)[-1]):
            raise MeasurementError(f"'{path}': '{name}' holds texts; readings are numbers")
    flat: list[tuple[str, str, Any]] = []  # texts of them would take ten times the memory
    for name, (value, unit) in arrays.items():
        if name in texts:
            continue
        array = np.asarray(value)
        if array.ndim == 0:  # about the file
            if name.rsplit("/", 1)[-1].lower() in ("x", "y"):
                raise MeasurementError(f"'{path}': '{name}' is one number; readings are a table")
            continue
        if array.dtype.kind not in "fiu" or array.ndim > 2:
            raise MeasurementError(
                f"'{path}': '{name}' is an array of {array.ndim} dimensions of {array.dtype}; "
                "readings are numbers [row] or [shot, BPM]"
            )
        short = name.rsplit("/", 1)[-1]
        if array.ndim == 1:
            plain, own = named(name)
            flat.append((plain, unit or own, array))
            continue
        counts = {len(list_) for list_ in texts.values()}
        if array.shape[1] not in counts and array.shape[0] in counts:
            array = array.T  # a row a monitor
        fits = [list_ for list_ in texts.values() if len(list_) == array.shape[1]]
        if not fits:
            raise MeasurementError(
                f"'{path}': '{name}' has {array.shape[1]} columns, and no list of names has as "
                f"many entries ({', '.join(f'{n} {len(t)}' for n, t in texts.items()) or 'none'})"
            )
        if any(own != fits[0] and sorted(own) == sorted(fits[0]) for own in fits):
            raise MeasurementError(
                f"'{path}': two lists have the names of '{name}' in different orders; keep one"
            )
        plain, own = named(short)
        flat += [
            (f"{monitor} {plain}", unit or own, array[:, i]) for i, monitor in enumerate(fits[0])
        ]
    lengths = [len(values) for _, _, values in flat]
    if not lengths:
        raise MeasurementError(
            f"'{path}' holds no readings: an array for each BPM and plane, or x and y [shot, "
            "monitor] with the BPMs' names"
        )
    most = max(set(lengths), key=lengths.count)
    for name, _, values in flat:
        if len(values) != most and _POSITION.search(name):
            raise MeasurementError(
                f"'{path}': '{name}' has {len(values)} rows, others {most}; turns of a machine's "
                "own kind are read by `tmlattice import --turns KIND`"
            )
    names = [Column(name, "", list_) for name, list_ in texts.items() if len(list_) == most]
    kept = [column for column in flat if len(column[2]) == most]
    return [*names, *(Column(name, unit, list(map(str, v.tolist()))) for name, unit, v in kept)]


def _is_text(value: Any) -> bool:
    array = np.asarray(value)
    return array.ndim == 1 and array.dtype.kind in "OSU"


def _texts(value: Iterable[Any]) -> list[str]:
    return [item.decode() if isinstance(item, bytes) else str(item) for item in value]
