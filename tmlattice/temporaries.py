"""Temporary files and folders beside what they become, and the exchange of two folders.

A temporary is locked by its process until it is moved or removed. A killed process holds no lock:
what it left is known by that, and removed by the next that makes a temporary in the same folder.
"""

import ctypes
import os
import shutil
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

PREFIX = ".tmlattice-"
YOUNG = 2.0
"""s; a temporary that has just been made may not be locked yet."""

_EXCHANGE = 2  # RENAME_EXCHANGE of renameat2
_AT_FDCWD = -100


@contextmanager
def temporary_file(folder: Path | None) -> Iterator[Path]:
    """An empty file in a folder (None: the system's), gone at the end unless it was moved."""
    if folder is not None:
        remove_stale(folder)
    descriptor, name = tempfile.mkstemp(prefix=PREFIX, dir=folder)
    _lock(descriptor)
    try:
        yield Path(name)
    finally:
        Path(name).unlink(missing_ok=True)
        os.close(descriptor)


@contextmanager
def temporary_folder(folder: Path) -> Iterator[Path]:
    """An empty folder in a folder, gone at the end unless it was moved."""
    remove_stale(folder)
    name = tempfile.mkdtemp(prefix=PREFIX, dir=folder)
    descriptor = None
    try:
        with suppress(OSError):  # a folder is no file that every system opens
            descriptor = os.open(name, os.O_RDONLY)
            _lock(descriptor)
        yield Path(name)
    finally:
        shutil.rmtree(name, ignore_errors=True)
        if descriptor is not None:
            os.close(descriptor)


def remove_stale(folder: Path) -> None:
    """Remove the temporaries in a folder that no process owns."""
    with suppress(OSError):
        for entry in list(os.scandir(folder)):
            if entry.name.startswith(PREFIX) and _is_stale(entry):
                if entry.is_dir(follow_symlinks=False):
                    shutil.rmtree(entry.path, ignore_errors=True)
                else:
                    with suppress(OSError):
                        os.unlink(entry.path)


def _is_stale(entry: "os.DirEntry[str]") -> bool:
    """Whether nobody holds its lock. Where locks are not known, nothing is taken for stale."""
    try:
        import fcntl

        if entry.is_symlink() or time.time() - entry.stat().st_mtime < YOUNG:
            return False
        descriptor = os.open(entry.path, os.O_RDONLY | os.O_NONBLOCK)
    except (ImportError, OSError):
        return False
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    finally:
        os.close(descriptor)
    return True


def _lock(descriptor: int) -> None:
    with suppress(ImportError, OSError):  # a file system without locks: nothing is stale there
        import fcntl

        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)


def exchange(new: Path, old: Path) -> bool:
    """Each of two folders gets the other's name, at once; False where the system cannot."""
    try:
        rename = ctypes.CDLL(None).renameat2
    except (AttributeError, OSError, TypeError):
        return False
    first, second = os.fsencode(new), os.fsencode(old)
    return bool(rename(_AT_FDCWD, first, _AT_FDCWD, second, _EXCHANGE) == 0)
