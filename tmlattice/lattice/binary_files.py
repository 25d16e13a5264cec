"""Contents of MATLAB, HDF5, SDDS and turn-by-turn files as plain values, within bounds.

The libraries that read such files trust them: a damaged one ends the process, goes round without an
end, or asks for any amount of memory. So this file is run as a script, in a process of its own with
limits of memory and time (`tmlattice.lattice.mat_file.read_apart`), and hands over what it read.
It imports nothing of the package.

Before an HDF5 file is read, everything that it states of itself is looked at: data sets of numbers
and texts alone, inside the file, whose sizes together are in proportion to the file.
"""

import math
import os
import re
import resource
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

MEMORY = 512 << 20
"""Bytes that a reader may ask for, beyond what the libraries take."""
SMALL, RATIO, MOST = 4 << 20, 64, 256 << 20
"""Bytes of all data sets of a file: the first, or this many times the file's own size, up to the
last. Compressed readings with noise have a ratio below 10."""
DEEPEST = 30
"""Structures within structures; a file that loops ends here."""
MOST_REFERENCES = 300_000
"""Followed in a file of MATLAB 7.3: a ring of 10,000 elements of 30 fields."""
MOST_OBJECTS = 10_000
"""Groups and data sets of a file that is no lattice: each is looked at."""
MOST_ATTRIBUTE, MOST_ATTRIBUTES = 1 << 16, 1000
"""Bytes of an attribute, and attributes of one object."""


class RefusedError(Exception):
    """What is wrong, and where in the file."""


def matlab(path: str, variables: Sequence[str] | None = None) -> dict[str, Any]:
    """The variables of a MATLAB file: structures are dictionaries, cells and arrays of structures
    are lists, and dimensions of one are squeezed out.

    Args:
        path: a `.mat` file of any version (7.3 is HDF5).
        variables: names; None: all.
    """
    import warnings

    import scipy.io

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of a name that stands twice, and of function handles
        if scipy.io.matlab.matfile_version(path)[0] < 2:
            content = scipy.io.loadmat(
                path, squeeze_me=True, struct_as_record=False, variable_names=variables
            )
            return {k: _plain(v) for k, v in content.items() if not k.startswith("__")}
        with _opened(path) as budget:
            file = budget.file
            own = [name for name in file if not name.startswith("#")]
            wanted = [name for name in own if not variables or name in variables]
            return {name: _Cells(budget).plain(budget.child(file, name), name) for name in wanted}


def _plain(value: Any, depth: int = 0) -> Any:
    from scipy.io.matlab import MatlabFunction, MatlabOpaque, mat_struct

    if depth > DEEPEST:
        raise RefusedError(f"structures are {DEEPEST} deep")
    if isinstance(value, mat_struct):
        return {name: _plain(getattr(value, name), depth + 1) for name in value._fieldnames}
    if isinstance(value, MatlabFunction | MatlabOpaque):
        return None
    if isinstance(value, np.ndarray):
        if value.dtype == object:
            return [_plain(item, depth + 1) for item in value]
        if value.dtype.names:  # an object of an old class, such as inline(...)
            return {name: _plain(value[name].item(), depth + 1) for name in value.dtype.names}
        if value.dtype.kind in "US":
            return "" if value.size == 0 else [str(text).strip() for text in value.ravel()]
        return value
    return value.item() if isinstance(value, np.generic) else value


class _Cells:
    """MATLAB 7.3: a cell or a field of a structure array is a table of references, and arrays
    stand transposed."""

    def __init__(self, budget: "_Budget") -> None:
        self.budget = budget
        self.entered: set[Any] = set()

    def plain(self, item: Any, name: str, depth: int = 0) -> Any:
        """An object as `matlab` has it."""
        import h5py

        if depth > DEEPEST:
            raise RefusedError(f"structures are {DEEPEST} deep")
        if isinstance(item, h5py.Group):
            self._enter(item, name)
            return self._structure(item, name, depth)
        if not isinstance(item, h5py.Dataset):
            raise RefusedError(f"'{name}' is no variable")
        text = self.budget.attribute(item, "MATLAB_class") == "char"
        if self.budget.attribute(item, "MATLAB_empty"):
            return "" if text else np.empty(0)
        value = self.budget.read(item, name, references=True)
        if value.dtype == object:
            self._enter(item, name)
            return self._cells(np.atleast_1d(np.squeeze(value.T)), name, depth)
        if text:
            codes = np.ravel(value)
            if codes.dtype.kind != "u" or codes.dtype.itemsize > 2:
                raise RefusedError(f"'{name}' is stated as a text and holds {codes.dtype} numbers")
            return codes.astype("<u2").tobytes().decode("utf-16-le", "replace")
        value = np.squeeze(np.transpose(value))
        return value.item() if value.ndim == 0 else value

    def _structure(self, item: Any, name: str, depth: int) -> Any:
        members = {n: self.budget.child(item, n) for n in item}
        many = [n for n, m in members.items() if hasattr(m, "dtype") and m.dtype.kind == "O"
                and self.budget.attribute(m, "MATLAB_class") is None]  # fmt: skip
        fields = {n: self.plain(m, f"{name}.{n}", depth + 1) for n, m in members.items()}
        if not many or len(many) < len(fields):
            return fields
        counts = {len(fields[n]) for n in many}
        if len(counts) > 1:
            raise RefusedError(f"fields of '{name}' have {min(counts)} to {max(counts)} elements")
        return [{n: fields[n][i] for n in many} for i in range(counts.pop())]

    def _cells(self, references: Any, name: str, depth: int) -> list[Any]:
        found = []
        for reference in references:
            if isinstance(reference, np.ndarray):
                found.append(self._cells(reference, name, depth))
                continue
            self.budget.references += 1
            if self.budget.references > MOST_REFERENCES:
                raise RefusedError(f"more than {MOST_REFERENCES:,} references")
            found.append(self.plain(self.budget.file[reference], name, depth + 1))
        return found

    def _enter(self, item: Any, name: str) -> None:
        """Structures and cells are trees: one that is reached twice would be read without end."""
        if (key := _identity(item)) in self.entered:
            raise RefusedError(f"'{name}' refers to a structure or cell that is read already")
        self.entered.add(key)


def hdf5(path: str) -> tuple[dict[str, Any], dict[str, dict[str, Any]]]:
    """All data sets of an HDF5 file, by their paths, and the attributes of each ("": the file's).

    A data set is an array of numbers, a number, a text, or a list of texts.
    """
    arrays: dict[str, Any] = {}
    with _opened(path) as budget:
        attributes = {"": budget.attributes(budget.file)}
        for name, item in budget.data_sets():
            budget.checked(item, name)
        budget.total = 0
        for name, item in budget.data_sets():
            arrays[name] = budget.read(item, name)
            attributes[name] = budget.attributes(item)
    return arrays, attributes


@contextmanager
def _opened(path: str) -> Iterator["_Budget"]:
    import h5py

    with h5py.File(path, "r") as file:
        yield _Budget(file, Path(path).stat().st_size)


class _Budget:
    """What of a file may be read: where it is, what it is, and how much."""

    def __init__(self, file: Any, size: int) -> None:
        self.file = file
        self.size = size
        self.most = min(MOST, SMALL + RATIO * size)  # bytes of all data sets
        self.total = 0
        self.references = 0

    def child(self, group: Any, name: str) -> Any:
        """What a group holds under a name, inside the file.

        Raises:
            RefusedError: a link, or a name that is no text.
        """
        import h5py

        if not isinstance(name, str) or not name.isprintable():  # surrogates are not, either
            raise RefusedError(f"the name {name!r:.60} is not UTF-8, or not printable")
        if not isinstance(group.get(name, getlink=True), h5py.HardLink):
            raise RefusedError(f"'{name}' is a link to another place or file; store the data there")
        return group[name]

    def data_sets(self) -> Iterator[tuple[str, Any]]:
        """Of all groups.

        Raises:
            RefusedError: a link, or groups that stand in themselves.
        """
        import h5py

        entered: set[Any] = set()
        objects = 0
        waiting: list[tuple[str, Any]] = [("", self.file)]
        while waiting:
            path, item = waiting.pop()
            if isinstance(item, h5py.Dataset):
                yield path, item
            empty = not isinstance(item, h5py.Dataset) and not len(getattr(item, "keys", tuple)())
            if empty and path.rsplit("/", 1)[-1].lower() in ("x", "y"):
                raise RefusedError(f"'{path}' holds no data")
            if not isinstance(item, h5py.Group):
                continue
            if (key := _identity(item)) in entered or path.count("/") > DEEPEST:
                raise RefusedError(f"the group '{path}' stands in itself, or twice")
            entered.add(key)
            objects += len(item)
            if objects > MOST_OBJECTS:
                raise RefusedError(f"it has more than {MOST_OBJECTS:,} groups and data sets")
            members = [(f"{path}/{n}".lstrip("/"), self.child(item, n)) for n in item]
            waiting += reversed(members)

    def checked(self, item: Any, name: str, references: bool = False) -> None:
        """Whether a data set may be read, by what the file states of it.

        Raises:
            RefusedError: elements that are no numbers or texts, no elements at all, elements that
                stand elsewhere or were never written, or too many of them.
        """
        import h5py

        kind = item.dtype
        text = h5py.check_string_dtype(kind) is not None
        reference = references and h5py.check_ref_dtype(kind) is h5py.Reference
        names = kind.kind in "iu" and h5py.check_enum_dtype(kind) is not None
        if names or not (kind.kind in "fiub" or text or reference):
            raise RefusedError(f"'{name}' holds {_kind(kind)}; numbers or texts are read")
        if item.shape is None or 0 in item.shape:
            raise RefusedError(f"'{name}' is empty")
        if text and sum(n > 1 for n in item.shape) > 1:
            raise RefusedError(f"'{name}' is a table of texts, {item.shape}; write a list")
        if item.is_virtual or item.external:
            raise RefusedError(f"the data of '{name}' are in another file; store them in this one")
        self.total += math.prod(item.shape) * kind.itemsize
        chunk = math.prod(item.chunks or (1,)) * kind.itemsize
        if max(self.total, chunk) > self.most:
            raise RefusedError(
                f"its data sets state {max(self.total, chunk) / 1e6:.0f} MB in a file of "
                f"{self.size / 1e6:.3g} MB ('{name}' has the shape {item.shape}); at most "
                f"{self.most / 1e6:.0f} MB are read"
            )
        fill = item.fillvalue
        nan = isinstance(fill, np.floating) and np.isnan(fill)
        if (unwritten := _unwritten(item)) and not nan:
            raise RefusedError(
                f"{unwritten} of '{name}' was never written: such numbers would be read as "
                f"{fill}; save it whole, or with NaN as the fill value"
            )

    def read(self, item: Any, name: str, references: bool = False) -> Any:
        """A data set, `checked`."""
        import h5py

        self.checked(item, name, references)
        value = item[()]
        return _texts(value, name) if h5py.check_string_dtype(item.dtype) else value

    def attribute(self, item: Any, name: str) -> Any:
        """A number, a text or a list; None where there is none, or something else."""
        import h5py

        if name not in item.attrs:
            return None
        stated = item.attrs.get_id(name)
        kind = stated.dtype
        if not (kind.kind in "fiub" or h5py.check_string_dtype(kind)) or stated.shape is None:
            return None
        if math.prod(stated.shape) * kind.itemsize > MOST_ATTRIBUTE:
            raise RefusedError(f"the attribute '{name}' has the shape {stated.shape}")
        value = item.attrs[name]
        if isinstance(value, np.ndarray) and value.dtype.kind in "fiub":
            return value if value.size > 1 else value.ravel()[0] if value.size else None
        return _texts(value, name) if not isinstance(value, np.number | np.bool_) else value

    def attributes(self, item: Any) -> dict[str, Any]:
        """All attributes that are numbers or texts."""
        if len(item.attrs) > MOST_ATTRIBUTES:
            raise RefusedError(f"'{item.name}' has more than {MOST_ATTRIBUTES:,} attributes")
        found = {name: self.attribute(item, name) for name in item.attrs}
        return {name: value for name, value in found.items() if value is not None}


def _identity(item: Any) -> Any:
    import h5py

    info = h5py.h5o.get_info(item.id)
    return info.fileno, info.addr


def _unwritten(item: Any) -> str:
    """What of a data set the file does not hold; empty where it holds all of it."""
    if item.chunks is None:
        return "" if item.id.get_storage_size() else "all"
    chunks = math.prod(-(-n // m) for n, m in zip(item.shape, item.chunks, strict=True))
    there = item.id.get_num_chunks()
    return "" if there >= chunks else f"{chunks - there:,} of {chunks:,} parts"


def _kind(kind: Any) -> str:
    """What a type of elements is called."""
    if kind.kind in "iu":
        return "names of an enumeration"
    if kind.kind == "c":
        return "complex numbers"
    if kind.names:
        return "compound elements"
    if kind.subdtype:
        return "arrays of elements"
    return {"O": "references or lists", "V": "raw bytes"}.get(kind.kind, f"elements of {kind}")


def _texts(value: Any, name: str) -> Any:
    """A text, or a list of them."""
    if isinstance(value, bytes | str):
        return _text(value, name)
    return [_text(item, name) for item in np.ravel(value).tolist()]


def _text(value: Any, name: str) -> str:
    try:
        return value.decode() if isinstance(value, bytes) else str(value).encode().decode()
    except UnicodeError:
        raise RefusedError(f"a text of '{name}' is not UTF-8") from None


def sdds(path: str) -> dict[str, tuple[Any, str]]:
    """Columns, arrays and parameters of an SDDS file with their units; by the package `sdds`."""
    import sdds as package

    head = Path(path).read_bytes().partition(b"&data")[0].decode("latin-1")
    if column := re.search(r'&column\b[^&]*?\bname\s*=\s*"?([^,\s"]+)', head):
        raise RefusedError(
            f"columns such as '{column[1]}' of SDDS are not read; write them as CSV "
            "(sddsprintout FILE OUT.csv -columns -spreadsheet=csv)"
        )
    content = package.read(path)
    if unread := [name for name in content.definitions if content.values.get(name) is None]:
        raise RefusedError(f"'{unread[0]}' has no values")
    return {
        name: (content.values[name], str(getattr(definition, "units", None) or ""))
        for name, definition in content.definitions.items()
    }


Table = tuple[list[str], Any]
"""Monitors, and their readings [monitor, turn]."""


def turns(path: str, kind: str) -> tuple[list[tuple[Table, Table]], list[int]]:
    """Tables of x and y of each bunch, and the bunches' numbers; by the package `turn_by_turn`."""
    import turn_by_turn

    with open(path, "rb") as file:
        is_hdf5 = file.read(8) == b"\x89HDF\r\n\x1a\n"
    if is_hdf5:
        with _opened(path) as budget:
            for name, item in budget.data_sets():
                budget.checked(item, name)
    if kind in _WHOLE:
        _WHOLE[kind](Path(path).read_text())
    data = turn_by_turn.read(path, datatype=kind)
    tables = [
        tuple(([str(n) for n in t.index], t.to_numpy(dtype=float)) for t in (bunch.X, bunch.Y))
        for bunch in data.matrices
    ]
    return tables, [int(i) for i in data.bunch_ids]  # type: ignore[return-value]


def _brackets(text: str) -> None:
    """SuperKEKB's lists close, and each monitor has its x, y and third list."""
    from turn_by_turn.superkekb import VALUES_PATTERN

    bare = re.sub(r"[\s\\]", "", text)
    stated, whole = bare.count("->{{"), len(re.findall(VALUES_PATTERN, bare))
    if any(bare.count(a) != bare.count(b) for a, b in ("{}", "()")) or stated != whole:
        raise RefusedError(f"it is cut off: {whole} BPMs of {stated} are whole; copy it anew")


def _last_line(text: str) -> None:
    """A table of MAD-NG ends with a whole line, of as many fields as there are columns."""
    rows = [line.split() for line in text.splitlines() if line[:1] not in "@*$#"]
    columns = next((line.split()[1:] for line in text.splitlines() if line[:1] == "*"), [])
    if not text.endswith("\n") or (rows and len(rows[-1]) != len(columns)):
        raise RefusedError("its last line is cut off; copy it anew")


def _rows(text: str) -> None:
    """MAD-X's and PTC's `trackone` has a row for every particle, turn and monitor that it states:
    their reader takes a missing one for zero, or for whatever was in memory."""
    monitors: set[str] = set()
    name, rows, turns, particles = "start", 0, 0, 0
    for line in text.splitlines():
        parts = line.split()
        if not parts or parts[0][0] in "@*$":
            continue
        if parts[0] == "#segment":
            name = parts[-1].lower()
            if not monitors and not turns:
                turns, particles = int(parts[2]) - 1, int(parts[3])
        elif "start" not in name and "end" not in name:
            monitors.add(name)
            rows += 1
            particles = 1 if parts[0] == "-1" else particles
    stated = len(monitors) * turns * particles
    if rows != stated:
        raise RefusedError(
            f"it has {rows} rows of {len(monitors)} BPMs, {turns} turns and {particles} "
            f"particles, which are {stated}: it is cut off, or particles are lost"
        )


_WHOLE = {"superkekb": _brackets, "madng": _last_line, "ptc": _rows, "trackone": _rows}
"""What shows that a file is whole, where its reader does not look."""
READERS: dict[str, Callable[..., Any]] = {
    "matlab": matlab,
    "hdf5": hdf5,
    "sdds": sdds,
    "turns": turns,
}
_NEEDS = {"matlab": "scipy.io", "hdf5": "h5py", "sdds": "sdds", "turns": "turn_by_turn"}


def limit(seconds: float) -> None:
    """Bound the memory and the processor's time of this process from now on."""
    spent = math.ceil(time.process_time() + seconds)
    resource.setrlimit(resource.RLIMIT_CPU, (spent, spent + 1))
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[0])
    except (OSError, ValueError):
        return  # a system that does not state what is taken does not limit it either
    bytes_ = pages * os.sysconf("SC_PAGE_SIZE") + MEMORY
    resource.setrlimit(resource.RLIMIT_AS, (bytes_, resource.getrlimit(resource.RLIMIT_AS)[1]))


def main() -> None:
    """Read a file: KIND, PATH, SECONDS and the reader's own arguments from standard input; its
    content, or what is wrong with it, to standard output."""
    import importlib
    import pickle

    sink = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what a library prints is no content
    kind, path, seconds, arguments = pickle.load(sys.stdin.buffer)
    try:
        importlib.import_module(_NEEDS[kind])
        limit(seconds)
        result: tuple[str, Any] = ("read", READERS[kind](path, *arguments))
        answer = pickle.dumps(result, protocol=5)
    except MemoryError:
        answer = pickle.dumps(("refused", f"it asks for more than {MEMORY >> 20} MB of memory"))
    except RefusedError as error:
        answer = pickle.dumps(("refused", str(error)))
    except Exception as error:  # whatever a reader meets in a file that is damaged
        text = " ".join(f"{type(error).__name__}: {error}".split())
        answer = pickle.dumps(("failed", text.encode("utf-8", "backslashreplace").decode()))
    sink.write(answer)
    sink.flush()


if __name__ == "__main__":
    main()
