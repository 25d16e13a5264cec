"""Files that are whole or not there: written under a temporary name, then moved.

A folder's files are moved together. What a killed run left is removed by the next one that
writes there: a temporary is locked as long as its process lives (`tmlattice.temporaries`).
"""

import errno
import json
import os
import shutil
import stat
from collections.abc import Collection, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from tmlattice.errors import TmlatticeError
from tmlattice.temporaries import (
    WHOLE,
    is_temporary,
    locked,
    move_files,
    temporary_file,
    temporary_folder,
)

OF_PATHS = OSError, RuntimeError, ValueError
"""Errors of the system, and of a path with links in a circle, or with a NUL byte."""


class OutputError(TmlatticeError):
    """A file or folder that cannot be written."""


@contextmanager
def _refused(path: Path, *errors: type[Exception]) -> Iterator[None]:
    """Turn these errors into an OutputError."""
    try:
        yield
    except errors as error:
        why = getattr(error, "strerror", None) or error
        raise OutputError(f"cannot write to '{path}': {why}; choose another place") from error


@contextmanager
def output_folder(folder: Path, replaced: Collection[str] = ()) -> Iterator[Path]:
    """A temporary folder whose files stand in `folder` when all went well: all of them, or none.

    It is made at once, so that an unwritable place is known before the work and not after it. A
    folder that is there stays: its owner, its access, its other files, whoever writes them
    meanwhile. The new files are moved into it under its lock, so that no two outputs mix. Older
    files with names of `replaced` that are not among the new ones are removed.

    Raises:
        OutputError: the folder cannot be made or written.
    """
    with ExitStack() as made:
        with _refused(folder, *OF_PATHS):
            folder = folder.resolve()
        with _refused(folder, *OF_PATHS):
            if folder.exists() and not folder.is_dir():
                raise OutputError(f"'{folder}' is a file; name a folder")
            place = next(p for p in (folder, *folder.parents) if p.exists())
            temporary = made.enter_context(temporary_folder(place))
        with _refused(folder, OSError):
            yield temporary
            with ThreadPoolExecutor(1) as other:  # Ctrl-C comes before the move or after it
                other.submit(_put, temporary, folder, replaced).result()


def _put(temporary: Path, folder: Path, replaced: Collection[str]) -> None:
    """Move a folder's files into another one; as a whole, where that is not there."""
    older = {*replaced} - {path.name for path in temporary.iterdir()}
    folder.parent.mkdir(parents=True, exist_ok=True)
    if not folder.exists():
        try:
            os.rename(temporary, folder)
            return
        except OSError:
            if not folder.is_dir():  # else somebody has made it meanwhile, and has written to it
                raise
    for path in temporary.iterdir():
        if (folder / path.name).is_dir():
            raise IsADirectoryError(errno.EISDIR, f"'{path.name}' is a folder there")
    if is_temporary(folder):
        move_files(temporary, folder)
        return
    with locked(folder):
        whole = folder / (temporary.name + WHOLE)  # from now on a killed run is finished by others
        os.rename(temporary, whole)
        try:
            move_files(whole, folder)
            for name in older:
                (folder / name).unlink(missing_ok=True)
        finally:
            shutil.rmtree(whole, ignore_errors=True)


@contextmanager
def output_file(path: Path) -> Iterator[Path]:
    """A temporary path in the file's folder, moved to `path` when all went well.

    What a link points to is replaced, not the link; a device or a pipe is written to.

    Raises:
        OutputError: the folder is missing or cannot be written, or no process reads the pipe.
    """
    with ExitStack() as made:
        with _refused(path, *OF_PATHS):
            special = path.exists() and not path.is_file() and not path.is_dir()
            path = path.absolute() if special else path.resolve()
        with _refused(path, *OF_PATHS):
            if path.is_dir():
                raise OutputError(f"'{path}' is a folder; name a file")
            # no file may be made next to a device: the system's folder for temporary files then
            temporary = made.enter_context(temporary_file(None if special else path.parent))
        with _refused(path, OSError):
            yield temporary
            if special:
                _pour(temporary, path)
            else:
                os.replace(temporary, path)


def _pour(made: Path, device: Path) -> None:
    """Write a file into a device, or into a pipe that somebody reads."""
    kind = device.stat().st_mode
    if stat.S_ISSOCK(kind):
        raise OSError(errno.EOPNOTSUPP, "it is a socket")
    waits = os.O_NONBLOCK if stat.S_ISFIFO(kind) else 0
    try:
        descriptor = os.open(device, os.O_WRONLY | waits)
    except OSError as error:
        if error.errno == errno.ENXIO and waits:
            raise OSError(errno.ENXIO, "no process reads this pipe") from error
        raise
    os.set_blocking(descriptor, True)
    with made.open("rb") as source, os.fdopen(descriptor, "wb") as sink:
        shutil.copyfileobj(source, sink)


def check_writable(path: Path) -> None:
    """Know before the work whether a file can be written there; nothing is left behind;
    OutputError: the folder is not there or cannot be written."""
    with _refused(path, *OF_PATHS):
        if path.is_dir():
            raise OutputError(f"'{path}' is a folder; name a file")
        if not path.exists() or path.is_file():
            with temporary_file(path.resolve().parent):
                pass


def write_json(path: Path, value: Any) -> None:
    """Write a value as JSON; numbers that are not finite become null."""
    text = json.dumps(_finite(value), indent=2, allow_nan=False)
    path.write_text(text + "\n", encoding="utf-8")


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    if isinstance(value, float) and not (abs(value) < float("inf")):
        return None
    return value
