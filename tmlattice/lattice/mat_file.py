"""A MATLAB file as plain dictionaries, lists, arrays, numbers and texts.

A damaged file can end the process that reads it (scipy's reader checks little), so a child reads
it first: what kills the child becomes a sentence.
"""

import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tmlattice.errors import LatticeError, TmlatticeError

SECONDS = 4
"""Of the processor; longer than any file of a ring takes to open."""
BUSY = 5
"""Times as long by the clock, on a machine that others use too."""
RATE = 2e6
"""Bytes that are read in a second at least, beyond that."""
DEEPEST = 30
"""Structures within structures; a file that loops ends here."""


def check_mat(path: Path) -> None:
    """Read a MATLAB file in a child process, so that one that crashes its reader is known.

    Raises:
        LatticeError: it is not there, is no MATLAB file, or its reader does not come back.
    """
    if not path.is_file():
        raise LatticeError(f"no MATLAB file '{path}'; check the path")
    read_in_a_child(path, "a MATLAB file", _CHILD, LatticeError)


def check_hdf5(path: Path, error: type[TmlatticeError]) -> None:
    """The same of an HDF5 file: damage makes its library go round without an end.

    Raises:
        error: its reader fails, or does not come back.
    """
    read_in_a_child(path, "HDF5", _HDF5, error)


def read_in_a_child(path: Path, what: str, code: str, error: type[TmlatticeError]) -> None:
    """Let a child process read a file, so that one that crashes or holds its reader is known.

    Args:
        path: the file, the child's argument.
        what: it should be.
        code: of the child, Python.
        error: raised.

    Raises:
        error: the child fails, dies, or takes longer than such a file can take.
    """
    seconds = SECONDS + (int(path.stat().st_size / RATE) if path.is_file() else 0)
    code = f"import resource as r\nr.setrlimit(r.RLIMIT_CPU, ({seconds}, {seconds + 1}))\n{code}"
    command = [sys.executable, "-P", "-c", code, str(path)]  # nothing of the working directory
    late = error(f"'{path}' is not read within {seconds} s; save it again")
    try:
        child = subprocess.run(
            command, capture_output=True, timeout=BUSY * seconds, check=False, text=True,
            errors="replace",
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        raise late from None
    if -child.returncode == signal.SIGXCPU:
        raise late
    if child.returncode:
        said = child.stderr.strip().splitlines()
        why = said[-1][:200] if said and child.returncode > 0 else "its reader crashed"
        raise error(f"'{path}' cannot be read as {what} ({why}); save it again")


_READ_ALL = """
def read_all(path):
    import h5py

    def read(name, item):
        if isinstance(item, h5py.Dataset):
            item[()]  # anything returned would end the visit

    with h5py.File(path) as file:
        file.visititems(read)
"""

_CHILD = (
    _READ_ALL
    + """
import sys, warnings
warnings.simplefilter("ignore")
import scipy.io
path = sys.argv[1]
try:
    if scipy.io.matlab.matfile_version(path)[0] < 2:
        scipy.io.loadmat(path, squeeze_me=True, struct_as_record=False)
    else:
        read_all(path)
except Exception as error:
    sys.exit(" ".join(f"{type(error).__name__}: {error}".split()) or "error")
"""
)

_HDF5 = (
    _READ_ALL
    + """
import sys
try:
    read_all(sys.argv[1])
except Exception as error:
    sys.exit(" ".join(f"{type(error).__name__}: {error}".split()) or "error")
"""
)


def read_mat(path: Path, variables: Sequence[str] | None = None) -> dict[str, Any]:
    """The variables of a MATLAB file: structures are dictionaries, cells and arrays of structures
    are lists, and dimensions of one are squeezed out.

    Args:
        path: a `.mat` file of any version (7.3 is HDF5).
        variables: names; None: all. One that is not there is left out.

    Raises:
        LatticeError: it is not there, is no MATLAB file, or crashes its reader.
    """
    import warnings

    import scipy.io

    check_mat(path)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of a name that stands twice, and of function handles
        try:
            if scipy.io.matlab.matfile_version(path)[0] < 2:
                content = scipy.io.loadmat(
                    path, squeeze_me=True, struct_as_record=False, variable_names=variables
                )
                return {k: _plain(v) for k, v in content.items() if not k.startswith("__")}
            return _read_hdf5(path, variables)
        except (LatticeError, OSError, KeyError, TypeError, ValueError, RuntimeError) as error:
            raise LatticeError(f"'{path}': {error}; save it again") from error


def _plain(value: Any, depth: int = 0) -> Any:
    from scipy.io.matlab import MatlabFunction, MatlabOpaque, mat_struct

    if depth > DEEPEST:
        raise LatticeError(f"structures are {DEEPEST} deep")
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


def _read_hdf5(path: Path, variables: Sequence[str] | None) -> dict[str, Any]:
    import h5py

    with h5py.File(path) as file:
        wanted = [n for n in file if not n.startswith("#") and (not variables or n in variables)]
        return {name: _plain_hdf5(file, file[name]) for name in wanted}


def _plain_hdf5(file: Any, item: Any, depth: int = 0) -> Any:
    """As `_plain`, of version 7.3: a cell or a field of a structure array is a table of
    references, and arrays stand transposed."""
    import h5py

    if depth > DEEPEST:
        raise LatticeError(f"structures are {DEEPEST} deep")
    if isinstance(item, h5py.Group):
        fields = {name: _plain_hdf5(file, item[name], depth + 1) for name in item}
        many = [n for n in item if isinstance(item[n], h5py.Dataset) and _references(item[n])
                and "MATLAB_class" not in item[n].attrs]  # fmt: skip
        if not many or len(many) < len(fields):
            return fields
        count = len(fields[many[0]])
        return [{name: fields[name][i] for name in many} for i in range(count)]
    if item.attrs.get("MATLAB_empty", 0):
        return "" if item.attrs.get("MATLAB_class") == b"char" else np.empty(0)
    value = item[()]
    if _references(item):
        return _cells(file, np.atleast_1d(np.squeeze(value.T)), depth)
    if item.attrs.get("MATLAB_class") == b"char":
        return "".join(chr(c) for c in np.ravel(value))
    value = np.squeeze(np.transpose(value))
    return value.item() if value.ndim == 0 else value


def _cells(file: Any, references: Any, depth: int) -> list[Any]:
    def cell(r: Any) -> Any:
        many = isinstance(r, np.ndarray)
        return _cells(file, r, depth) if many else _plain_hdf5(file, file[r], depth + 1)

    return [cell(r) for r in references]


def _references(item: Any) -> bool:
    return bool(item.dtype == object)
