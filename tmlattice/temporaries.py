"""Temporary files and folders next to what they become.

A temporary is locked by its process until it is moved or removed. A killed process holds no lock:
what it left is known by that, and removed by the next that makes a temporary in the same folder.
"""

import os
import re
import secrets
import shutil
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

PREFIX = ".tmlattice-"
YOUNG = 2.0
"""s; a temporary that has just been made may not be locked yet."""
PATIENCE = 10.0
"""s that a folder's lock is waited for."""

WHOLE = "-whole"
"""End of the name of a folder of which every file has to be moved."""

_NAME = re.compile(re.escape(PREFIX) + "[0-9a-f]{16}")


def is_temporary(path: Path) -> bool:
    """Whether a path has the name of a temporary."""
    return _NAME.fullmatch(path.name) is not None


def _name() -> str:
    return PREFIX + secrets.token_hex(8)


@contextmanager
def temporary_file(folder: Path | None) -> Iterator[Path]:
    """An empty file in a folder (None: the system's, private), gone at the end unless moved."""
    if folder is None:
        descriptor, name = tempfile.mkstemp(prefix=PREFIX)
        path = Path(name)
    else:
        remove_stale(folder)
        path = folder / _name()  # its mode, group and access list are those of any new file there
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o666)
    lock(descriptor)
    try:
        yield path
    finally:
        path.unlink(missing_ok=True)
        os.close(descriptor)


@contextmanager
def temporary_folder(folder: Path) -> Iterator[Path]:
    """An empty folder in a folder, gone at the end unless it was moved."""
    remove_stale(folder)
    path = folder / _name()
    path.mkdir()
    with ExitStack() as stack:
        stack.callback(shutil.rmtree, path, ignore_errors=True)
        stack.enter_context(locked(path))
        yield path


@contextmanager
def locked(folder: Path, shared: bool = False) -> Iterator[None]:
    """Hold a folder's lock, or go on without it where it is not to be had for `PATIENCE`."""
    descriptor = None
    with suppress(OSError):  # a folder is no file that every system opens
        descriptor = os.open(folder, os.O_RDONLY)
    try:
        end = time.monotonic() + PATIENCE
        while not (mine := descriptor is not None and lock(descriptor, shared)):
            if descriptor is None or time.monotonic() > end:
                break
            time.sleep(0.002)
        if mine:
            _finish(folder)
        yield
    finally:
        if descriptor is not None:
            os.close(descriptor)


def _finish(folder: Path) -> None:
    """Move what outputs of this user that were killed meanwhile had still to move."""
    with suppress(OSError):
        for entry in list(os.scandir(folder)):
            own = entry.stat(follow_symlinks=False).st_uid == os.geteuid()
            name = entry.name.removesuffix(WHOLE)
            if own and name != entry.name and _NAME.fullmatch(name) and not entry.is_symlink():
                move_files(Path(entry.path), folder)
                os.rmdir(entry.path)


def move_files(source: Path, folder: Path) -> None:
    """Move every file of a folder into another one, over those of the same names."""
    for path in sorted(source.iterdir()):
        with suppress(FileNotFoundError):  # another process finishes the same
            os.replace(path, folder / path.name)


def lock(descriptor: int, shared: bool = False) -> bool:
    """Take a lock; False where somebody else has it."""
    try:
        import fcntl

        kind = fcntl.LOCK_SH if shared else fcntl.LOCK_EX
        fcntl.flock(descriptor, kind | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except (ImportError, OSError):  # a system without locks: nothing is stale there
        pass
    return True


def remove_stale(folder: Path) -> None:
    """Remove this user's temporaries in a folder that no process owns."""
    with suppress(OSError):
        for entry in list(os.scandir(folder)):
            if _NAME.fullmatch(entry.name) and _is_stale(entry):
                if entry.is_dir(follow_symlinks=False):
                    shutil.rmtree(entry.path, ignore_errors=True)
                else:
                    with suppress(OSError):
                        os.unlink(entry.path)


def _is_stale(entry: "os.DirEntry[str]") -> bool:
    """Whether no process holds its lock. Where locks are unavailable, nothing counts as stale."""
    try:
        import fcntl

        state = entry.stat(follow_symlinks=False)
        foreign = entry.is_symlink() or state.st_uid != os.geteuid()
        if foreign or time.time() - state.st_mtime < YOUNG:
            return False
        descriptor = os.open(entry.path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOFOLLOW)
    except (ImportError, OSError):
        return False
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    finally:
        os.close(descriptor)
    return True
