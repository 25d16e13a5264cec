"""Tables of readings: CSV rows in bulk; the line of an error is looked for when there is one."""

import csv
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from tmlattice.arrays import Array, Indices
from tmlattice.errors import MeasurementError, UnknownNameError
from tmlattice.input_files import check_regular
from tmlattice.measurement.monitors import LARGEST_READING, Names, merge_spellings

_MOST_CELLS = 50_000_000
"""Readings that an array may have without having a hundredth of them in the table: 0.8 GB."""

_CHUNK = 50_000  # rows: 20 MB of Python objects, whatever the size of the file
_WHOLE = frozenset({"shot", "turn", "step"})
_NAMES = frozenset({"monitor", "corrector", "quantity"})


@dataclass(frozen=True)
class Rows:
    """The columns of a table, one entry a row.

    Attributes:
        whole: columns of whole numbers by name, [row].
        names: columns of names: the names, each once, and their places, [row].
        xy: the other two columns: x, y in m, or a value and its error, [row, 2]; NaN where a
            field is empty.
    """

    path: Path
    whole: dict[str, Indices]
    names: dict[str, tuple[tuple[str, ...], Indices]]
    xy: Array

    def __len__(self) -> int:
        return len(self.xy)

    def error(self, row: int, text: str) -> MeasurementError:
        """The error for something wrong in a row, counted from 0."""
        return _error(self.path, row, text)

    def check(self, *keys: str, metres: bool = True) -> None:
        """No row stands twice, no turn is negative, no reading is in millimetres; MeasurementError:
        with the line."""
        for name, column in self.whole.items():
            if name == "turn" and column.min() < 0:
                row = int((column < 0).argmax())
                raise self.error(row, f"turn {column[row]} is negative; turns count from 0")
        large = np.abs(self.xy) > LARGEST_READING  # false for NaN
        if metres and large.any():
            row, plane = (int(i) for i in np.argwhere(large)[0])
            few = 4 * large.sum() < np.isfinite(self.xy).sum()
            raise self.error(
                row,
                f"{'xy'[plane]} = {self.xy[row, plane]:g} m is above {LARGEST_READING} m; "
                + (
                    "no beam reads that: leave the fields of missing readings empty"
                    if few
                    else "readings are in metres: divide millimetres by 1000"
                ),
            )
        columns = [self.names[k][1] if k in self.names else self.whole[k] for k in keys]
        order = np.lexsort(columns[::-1])  # stable: of two equal rows the first stays first
        same = np.ones(len(order) - 1, dtype=bool)
        for column in columns:
            same &= np.diff(column[order]) == 0
        if same.any():
            row = int(order[1:][same].min())
            what = ", ".join(
                f"{k} {self.names[k][0][c[row]] if k in self.names else c[row]}"
                for k, c in zip(keys, columns, strict=True)
            )
            raise self.error(row, f"{what} stands in the table already; keep one of the two rows")


def read_rows(path: Path, header: Sequence[str], optional: Sequence[str] | None = None) -> Rows:
    """Read a table with names in one or two columns, and two of numbers.

    Args:
        path: a CSV file in UTF-8.
        optional: where given, the columns may be in any order and case, those named here may be
            absent, and others are passed over.

    Raises:
        MeasurementError: no such file, empty, not UTF-8, another header, a row with another
            number of fields, or text where a number should be: with the line.
    """
    columns: dict[str, list[Any]] = defaultdict(list)
    index: dict[str, dict[str, int]] = {}
    done = 0
    empty = f"{path}, line 1: the file is empty; write its header first"
    if not check_regular(path, MeasurementError):  # nothing is waited for, as of /proc/kmsg
        raise MeasurementError(empty)
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            reader = csv.reader(file, skipinitialspace=True)
            found = next((row for row in reader if row), None)
            if found is None:
                raise MeasurementError(empty)
            place = _columns(path, reader.line_num, found, header, optional)
            index = {name: {} for name in place if name in _NAMES}
            while rows := [row for row in islice(reader, _CHUNK) if row]:
                try:
                    for name, part in _parse(rows, len(found), place, index).items():
                        columns[name].append(part)
                except (ValueError, OverflowError):
                    number, text = _first_wrong(rows, len(found), place)
                    raise _error(path, done + number, text) from None
                done += len(rows)
    except OSError as error:
        raise MeasurementError(f"cannot read '{path}': {error.strerror or error}") from error
    except UnicodeDecodeError:
        raise _encoding(path) from None
    except csv.Error as error:
        *_, line = _walk(path)  # it ends where the reader did
        raise not_csv(path, line, error) from None
    if not done:
        raise MeasurementError(f"{path}: no rows below the header; nothing was read")
    joined = {name: np.concatenate(parts) for name, parts in columns.items()}
    names = {}
    for name, spellings in index.items():
        merged, places = merge_spellings(list(spellings))
        names[name] = merged, places[joined[name]]
    return Rows(
        path=path,
        whole={name: joined[name] for name in place if name in _WHOLE},
        names=names,
        xy=np.stack([joined[name] for name in place if name not in _WHOLE | _NAMES], axis=1),
    )


def not_csv(path: Path | str, line: int, error: csv.Error) -> MeasurementError:
    """The error for a line that is no row of a CSV table."""
    return MeasurementError(
        f"{path}, line {line}: not CSV ({error}); is a quotation mark left open?"
    )


def match_names(
    rows: Rows, column: str, known: Sequence[str] | None, all_of_them: bool = False
) -> tuple[tuple[str, ...], Indices]:
    """The names of a column and each row's place among them; the known ones' order if given.

    With `all_of_them`, known names without rows stay.

    Raises:
        MeasurementError: a name that is not among the known ones, with its line.
    """
    found, place = rows.names[column]
    if known is None:
        return found, place
    names = Names("BPM" if column == "monitor" else column, known)
    there = np.empty(len(found), dtype=np.int64)
    for i, name in enumerate(found):
        try:
            there[i] = names[name]
        except UnknownNameError as error:
            raise rows.error(int((place == i).argmax()), str(error)) from error
    kept = np.arange(len(names.names)) if all_of_them else np.unique(there)
    return tuple(names.names[i] for i in kept), np.searchsorted(kept, there)[place]


def dense(rows: Rows, shot: Indices, shots: int, monitor: Indices, monitors: int) -> Array:
    """Readings [shot, turn, monitor, 2] of rows, NaN where there is none; MeasurementError: a turn
    so late that the array would be all but empty."""
    turn = rows.whole.get("turn", np.zeros(len(rows), dtype=np.int64))
    turns = int(turn.max()) + 1
    if shots * turns * monitors > max(_MOST_CELLS, 100 * len(rows)):
        row = int(turn.argmax())
        raise rows.error(row, f"turn {turn[row]} is far behind the others; turns count from 0")
    readings = np.full((shots, turns, monitors, 2), np.nan)
    readings[shot, turn, monitor] = rows.xy
    return readings


def _columns(
    path: Path, line: int, found: list[str], header: Sequence[str], optional: Sequence[str] | None
) -> dict[str, int]:
    wanted = ",".join(header)
    if optional is None:
        if found != list(header):
            missing = [name for name in header if name not in found]
            what = f"no column '{missing[0]}'" if missing else "other columns, or another order"
            raise MeasurementError(f"{path}, line {line}: {what}; its first line is {wanted}")
        return {name: i for i, name in enumerate(header)}
    lower = [name.strip().casefold() for name in found]
    place = {name: lower.index(name) for name in header if name in lower}
    for name in header:
        if name not in place and name not in optional:
            raise MeasurementError(
                f"{path}, line {line}: no column '{name}'; its first line has {wanted}"
            )
        if lower.count(name) > 1:
            raise MeasurementError(f"{path}, line {line}: two columns '{name}'; keep one")
    return place


def _parse(
    rows: list[list[str]], width: int, place: dict[str, int], index: dict[str, dict[str, int]]
) -> dict[str, Any]:
    """Columns of a chunk; a ValueError where any field is wrong."""
    if any(len(row) != width for row in rows):
        raise ValueError("width")
    fields = list(zip(*rows, strict=True))
    parsed: dict[str, Any] = {}
    for name, i in place.items():
        column = fields[i]
        if name in _NAMES:
            known = index[name]
            for spelling in set(column) - known.keys():
                if not spelling.strip() or not spelling.isprintable():
                    raise ValueError(spelling)
            for spelling in column:
                known.setdefault(spelling, len(known))
            parsed[name] = np.fromiter((known[s] for s in column), np.int64, len(column))
        elif name in _WHOLE:
            parsed[name] = np.fromiter(map(int, column), np.int64, len(column))
        else:
            values = np.array([float(v) if v else np.nan for v in column])
            if np.count_nonzero(~np.isfinite(values)) != column.count(""):
                raise ValueError("not finite")
            parsed[name] = values
        if name not in _NAMES and "_" in "".join(column):  # Python reads 1_000, physics does not
            raise ValueError("_")
    return parsed


def _first_wrong(rows: list[list[str]], width: int, place: dict[str, int]) -> tuple[int, str]:
    """The first row of a chunk that is wrong, and what it should be."""
    for number, row in enumerate(rows):
        if len(row) != width:
            return number, f"{len(row)} fields where the header has {width}; correct the row"
        for name, i in place.items():
            try:
                _parse([[row[i]]], 1, {name: 0}, {name: {}})
            except (ValueError, OverflowError):
                if name in _NAMES:
                    return number, f"{row[i]!r} is no name of a {name}; name it"
                unit = " in m" if name in ("x", "y") else ""
                kind = "a whole number" if name in _WHOLE else f"a number{unit}, or empty"
                return number, f"{name} is {row[i]!r}; it should be {kind}"
    raise AssertionError("a chunk that cannot be read has a row that cannot")


def _walk(path: Path) -> Iterator[int]:
    """The lines on which the rows below the header begin."""
    with path.open(encoding="utf-8-sig", newline="", errors="replace") as file:
        reader = csv.reader(file, skipinitialspace=True)
        begin, header = 1, True
        try:
            for row in reader:
                if row and not header:
                    yield begin
                header = header and not row
                begin = reader.line_num + 1
        except csv.Error:
            yield begin


def _error(path: Path, row: int, text: str) -> MeasurementError:
    line = next(islice(_walk(path), row, None))
    return MeasurementError(f"{path}, line {line}: {text}")


def _encoding(path: Path) -> MeasurementError:
    with path.open("rb") as file:
        for number, line in enumerate(file, 1):
            try:
                line.decode("utf-8-sig" if number == 1 else "utf-8")
            except UnicodeDecodeError:
                return MeasurementError(f"{path}, line {number}: not UTF-8; save the file as UTF-8")
    return MeasurementError(f"{path}: not UTF-8; save the file as UTF-8")
