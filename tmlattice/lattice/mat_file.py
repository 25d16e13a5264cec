"""MATLAB, HDF5, SDDS and turn-by-turn files, read in a process of its own (`binary_files`)."""

import pickle
import signal
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from tmlattice.errors import LatticeError, TmlatticeError, plain
from tmlattice.input_files import check_regular
from tmlattice.lattice import binary_files

SECONDS = 3
"""Of the processor, for the libraries and any small file."""
BUSY = 30
"""Times as long by the clock, where others use the machine or the disk is slow."""
RATE = 2e5
"""Bytes that are read in a second at least, beyond that: structures of MATLAB at 3e5."""


def read_apart(
    kind: str, path: Path, what: str, error: type[TmlatticeError], *arguments: Any
) -> Any:
    """The content of a file, by one of `binary_files.READERS` in a child process.

    Args:
        kind: of the reader.
        path: the file.
        what: it should be, for the message.
        error: raised.
        *arguments: the reader's own.

    Raises:
        error: no such file; the reader refuses it, fails, dies, or takes more time or memory than
            such a file can take.
    """
    size = check_regular(path, error)
    if not size:  # nothing is waited for, as of /proc/kmsg
        raise error(f"'{path}' is empty; save it again")
    seconds = SECONDS + int(size / RATE)
    # absolute: the child reads a file, never an option; -P: nothing of the working directory
    command = [sys.executable, "-P", binary_files.__file__]
    given = pickle.dumps((kind, str(path.absolute()), seconds, arguments))
    late = error(f"'{path}' is not read within {seconds} s; save it again")
    try:
        child = subprocess.run(
            command, input=given, capture_output=True, timeout=BUSY * seconds, check=False
        )
    except subprocess.TimeoutExpired:
        raise late from None
    if -child.returncode == signal.SIGXCPU:
        raise late
    if child.returncode or not child.stdout:
        raise error(f"'{path}' cannot be read as {what} (its reader crashed); save it again")
    verdict, content = pickle.loads(child.stdout)
    if verdict == "refused":
        raise error(f"'{path}': {plain(content, 300)}")
    if verdict == "failed":
        reason = plain(content, 200)
        raise error(f"'{path}' cannot be read as {what} ({reason}); save it again")
    return content


def read_mat(path: Path, variables: Sequence[str] | None = None) -> dict[str, Any]:
    """The variables of a MATLAB file: structures are dictionaries, cells and arrays of structures
    are lists, and dimensions of one are squeezed out.

    Args:
        path: a `.mat` file of any version (7.3 is HDF5).
        variables: names; None: all. One that is not there is left out.

    Raises:
        LatticeError: it is not there, is no MATLAB file, or crashes its reader.
    """
    content: dict[str, Any] = read_apart("matlab", path, "a MATLAB file", LatticeError, variables)
    return content


def lattice_in(content: Mapping[str, Any], path: Path, sequence: str | None) -> str:
    """The name of the variable of a MATLAB file that is a lattice of AT.

    Args:
        content: of `read_mat`.
        path: of the file.
        sequence: the variable, where several are.

    Raises:
        LatticeError: none is one, or more than one are.
    """
    found = [
        name
        for name, value in content.items()
        if isinstance(value, list)
        and len(value) > 1
        and all(isinstance(e, Mapping) for e in value)
        and any("PassMethod" in e for e in value)
        and sequence in (None, name)
    ]
    if len(found) == 1:
        return found[0]
    which = ", ".join(found) if found else f"none of {', '.join(content) or 'its variables'}"
    raise LatticeError(
        f"'{path}' has no single lattice ({plain(which, 200)}); name its variable with sequence= "
        "(`sequence` in [lattice] of tmlattice.toml)"
    )
