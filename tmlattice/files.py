"""Files that are whole or not there: written under a temporary name, then moved."""

import json
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from tmlattice.errors import TmlatticeError


class OutputError(TmlatticeError):
    """A file or folder that cannot be written."""


def _refusal(path: Path, error: OSError) -> OutputError:
    return OutputError(f"cannot write to '{path}': {error.strerror or error}; choose another place")


@contextmanager
def output_folder(folder: Path) -> Iterator[Path]:
    """A temporary folder whose files move into `folder` when all went well.

    It is made at once, so that an unwritable place is known before the work and not after it.

    Raises:
        OutputError: the folder cannot be made or written.
    """
    folder = folder.absolute()
    try:
        if folder.exists() and not folder.is_dir():
            raise OutputError(f"'{folder}' is a file; name a folder")
        near = folder if folder.is_dir() else next(p for p in folder.parents if p.exists())
        temporary = Path(tempfile.mkdtemp(prefix=".tmlattice-", dir=near))
    except OSError as error:
        raise _refusal(folder, error) from error
    try:
        yield temporary
        folder.mkdir(parents=True, exist_ok=True)
        for path in sorted(temporary.iterdir()):
            os.replace(path, folder / path.name)
    except OSError as error:
        raise _refusal(folder, error) from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


@contextmanager
def output_file(path: Path) -> Iterator[Path]:
    """A temporary path in the file's folder, moved to `path` when all went well.

    What a link points to is replaced, not the link; a device or a pipe is written to.

    Raises:
        OutputError: the folder is not there or cannot be written.
    """
    path = path.resolve() if path.is_symlink() else path.absolute()
    try:
        if path.is_dir():
            raise OutputError(f"'{path}' is a folder; name a file")
        if path.exists() and not path.is_file():
            with tempfile.TemporaryDirectory(prefix="tmlattice-") as folder:
                yield Path(folder) / path.name
                with (Path(folder) / path.name).open("rb") as made, path.open("wb") as device:
                    shutil.copyfileobj(made, device)
            return
        descriptor, name = tempfile.mkstemp(prefix=".tmlattice-", dir=path.parent)
        os.close(descriptor)
    except OSError as error:
        raise _refusal(path, error) from error
    temporary = Path(name)
    try:
        yield temporary
        umask = os.umask(0)
        os.umask(umask)
        temporary.chmod(0o666 & ~umask)  # mkstemp's files are for the owner alone
        os.replace(temporary, path)
    except OSError as error:
        raise _refusal(path, error) from error
    finally:
        temporary.unlink(missing_ok=True)


def check_writable(path: Path) -> None:
    """Know before the work whether a file can be written there; nothing is left behind.

    Raises:
        OutputError: the folder is not there or cannot be written.
    """
    path = path.absolute()
    if path.is_dir():
        raise OutputError(f"'{path}' is a folder; name a file")
    try:
        tempfile.TemporaryFile(dir=path.parent).close()
    except OSError as error:
        raise _refusal(path, error) from error


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
