"""Files that are whole or not there: written under a temporary name, then moved.

A folder's files are exchanged together. What a killed run left is removed by the next one that
writes there: a temporary is locked as long as its process lives (`tmlattice.temporaries`).
"""

import errno
import json
import os
import shutil
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from tmlattice.errors import TmlatticeError
from tmlattice.temporaries import exchange, temporary_file, temporary_folder

MOST_OTHERS = 1000
"""Files of an output folder that are not of this output, up to which all are exchanged at once."""


class OutputError(TmlatticeError):
    """A file or folder that cannot be written."""


def _refusal(path: Path, error: OSError) -> OutputError:
    return OutputError(f"cannot write to '{path}': {error.strerror or error}; choose another place")


@contextmanager
def output_folder(folder: Path) -> Iterator[Path]:
    """A temporary folder whose files stand in `folder` when all went well: all of them, or none.

    It is made at once, so that an unwritable place is known before the work and not after it.
    Other files of the folder stay. Where it cannot be exchanged (it is mounted, or somebody's
    working directory, or holds folders), its files are replaced one by one.

    Raises:
        OutputError: the folder cannot be made or written.
    """
    try:
        folder = folder.resolve()
        if folder.exists() and not folder.is_dir():
            raise OutputError(f"'{folder}' is a file; name a folder")
        if folder.exists() and not os.access(folder, os.W_OK | os.X_OK):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
        place = next(p for p in folder.parents if p.exists())
        if folder.exists() and not _movable(folder):
            place = folder
        made = temporary_folder(place)
        temporary = made.__enter__()
    except (OSError, RuntimeError, ValueError) as error:
        raise _refusal(folder, _as_os_error(error)) from error
    try:
        yield temporary
        if not folder.is_dir():
            folder.parent.mkdir(parents=True, exist_ok=True)
            temporary.chmod(0o777 & ~_umask())  # mkdtemp's folders are for the owner alone
            os.rename(temporary, folder)
        elif place == folder or not _exchanged(temporary, folder):
            for path in sorted(temporary.iterdir()):
                os.replace(path, folder / path.name)
    except OSError as error:
        raise _refusal(folder, error) from error
    finally:
        made.__exit__(None, None, None)


def _movable(folder: Path) -> bool:
    """Whether a folder may be exchanged for another: nobody stands in it, or is mounted there."""
    here = Path.cwd()
    parent = folder.parent
    return (
        folder != here
        and folder not in here.parents
        and not folder.is_mount()
        and parent.stat().st_dev == folder.stat().st_dev
        and folder.stat().st_uid == getattr(os, "geteuid", lambda: 0)()
        and os.access(parent, os.W_OK | os.X_OK)
    )


def _exchanged(temporary: Path, folder: Path) -> bool:
    """Put a folder in the place of another, with the other's remaining files in it."""
    if not _carry_over(folder, temporary):
        return False
    shutil.copymode(folder, temporary)
    return exchange(temporary, folder)


def _carry_over(folder: Path, temporary: Path) -> bool:
    """Link the folder's other files into its successor; False where that cannot be done."""
    made = {path.name for path in temporary.iterdir()}
    others = [entry for entry in os.scandir(folder) if entry.name not in made]
    plain = all(e.is_file(follow_symlinks=False) or e.is_symlink() for e in others)
    if not plain or len(others) > MOST_OTHERS:
        return False
    linked: list[Path] = []
    try:
        for entry in others:
            os.link(entry.path, temporary / entry.name, follow_symlinks=False)
            linked.append(temporary / entry.name)
    except OSError:  # a file system without links
        for path in linked:
            path.unlink()
        return False
    return True


@contextmanager
def output_file(path: Path) -> Iterator[Path]:
    """A temporary path in the file's folder, moved to `path` when all went well.

    What a link points to is replaced, not the link; a device or a pipe is written to.

    Raises:
        OutputError: the folder is not there or cannot be written, or nobody reads the pipe.
    """
    try:
        special = path.exists() and not path.is_file() and not path.is_dir()
        path = path.absolute() if special else path.resolve()
        if path.is_dir():
            raise OutputError(f"'{path}' is a folder; name a file")
        # beside a device no file may be made: the system's folder for temporary files then
        made = temporary_file(None if special else path.parent)
        temporary = made.__enter__()
    except (OSError, RuntimeError, ValueError) as error:
        raise _refusal(path, _as_os_error(error)) from error
    try:
        yield temporary
        if special:
            _pour(temporary, path)
        else:
            temporary.chmod(0o666 & ~_umask())  # mkstemp's files are for the owner alone
            os.replace(temporary, path)
    except OSError as error:
        raise _refusal(path, error) from error
    finally:
        made.__exit__(None, None, None)


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
            raise OSError(errno.ENXIO, "nobody reads this pipe") from error
        raise
    os.set_blocking(descriptor, True)
    with made.open("rb") as source, os.fdopen(descriptor, "wb") as sink:
        shutil.copyfileobj(source, sink)


def check_writable(path: Path) -> None:
    """Know before the work whether a file can be written there; nothing is left behind.

    Raises:
        OutputError: the folder is not there or cannot be written.
    """
    try:
        if path.is_dir():
            raise OutputError(f"'{path}' is a folder; name a file")
        if not path.exists() or path.is_file():
            with temporary_file(path.resolve().parent):
                pass
    except (OSError, RuntimeError, ValueError) as error:
        raise _refusal(path, _as_os_error(error)) from error


def _as_os_error(error: Exception) -> OSError:
    """A path may hold a NUL byte (ValueError) or links in a circle (RuntimeError) as well."""
    return error if isinstance(error, OSError) else OSError(errno.EINVAL, str(error))


def _umask() -> int:
    umask = os.umask(0)
    os.umask(umask)
    return umask


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
