"""What was worked out once, kept in the user's cache folder: safe to delete at any time.

An entry is bytes under a key that names everything they depend on. It is written under a temporary
name and moved, so that several processes may share the folder; it begins with a checksum of its key
and its bytes, and one that does not fit is made anew. Nothing in it is ever executed.

The folder is `tmlattice` below the one that `TMLATTICE_CACHE` names (`off`: none), else below
`XDG_CACHE_HOME` or `~/.cache`. It is used only if it belongs to this user and no one else can write
to it. Files that have no name of an entry are left alone.
"""

import contextlib
import hashlib
import logging
import os
import re
import secrets
import stat
import warnings
from collections.abc import Callable, Iterator
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any, TypeVar

log = logging.getLogger(__name__)

LIMIT = 200_000_000
"""Bytes that all entries together may take; beyond it the oldest go. A large ring takes 4 MB."""

_DIGEST = hashlib.sha256().digest_size
_NAME = re.compile(r"(\.new-)?[0-9a-f]{64}")
"""Of an entry, and of one that is being written."""

Value = TypeVar("Value")


def folder() -> Path | None:
    """Where entries lie; None where nothing is kept."""
    chosen = os.environ.get("TMLATTICE_CACHE")
    if chosen is not None and chosen.casefold() in ("", "0", "off"):
        return None
    place = os.path.expanduser(chosen or os.environ.get("XDG_CACHE_HOME") or "~/.cache")
    return None if place.startswith("~") else Path(place) / "tmlattice"  # no home is known


def is_private(state: os.stat_result) -> bool:
    """Whether a file or folder belongs to this user and no one else can write to it."""
    return state.st_uid == os.geteuid() and not state.st_mode & 0o022


def private_or_warn(place: Path, variable: str = "TMLATTICE_CACHE") -> bool:
    """`is_private`, of a folder that is there and no link; a warning where it is not."""
    state = os.lstat(place)
    if stat.S_ISDIR(state.st_mode) and is_private(state):
        return True
    _warn(
        f"the cache folder '{place}' is not used: it is a link or another user's, or others can "
        f"write to it; remove it, or name a folder of your own in {variable}"
    )
    return False


@cache
def _warn(text: str) -> None:
    warnings.warn(text, UserWarning, stacklevel=2)


def own_folder(name: str) -> Path | None:
    """A folder in the cache for what another package keeps, made if need be; None where there is
    no cache."""
    place = folder()
    try:
        if place is None:
            return None
        for own in (place, place / name):
            own.mkdir(0o700, parents=True, exist_ok=True)
            if not private_or_warn(own):
                return None
    except OSError as error:
        log.info("nothing is kept in %s: %s", place, error)
        return None
    return place / name


@contextlib.contextmanager
def _opened() -> Iterator[int | None]:
    """A descriptor of the folder, so that no one can replace it meanwhile; None where there is
    none, or others could have written to it."""
    place = folder()
    if place is None or not place.exists() or not private_or_warn(place):
        yield None
        return
    descriptor = os.open(place, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    try:
        yield descriptor if is_private(os.fstat(descriptor)) else None
    finally:
        os.close(descriptor)


@cache
def _makers() -> str:
    """Versions of what makes entries, and when this package's own files were last changed."""
    from tmlattice import __version__

    own = Path(__file__).parent
    files = [
        p for room in ("lattice", "maps", "effects") for p in sorted((own / room).glob("*.py"))
    ]
    changed = [(path.name, path.stat().st_mtime_ns, path.stat().st_size) for path in files]
    packages = [version(name) for name in ("ocelot-collab", "numpy", "accelerator-toolbox")]
    return repr((__version__, packages, changed))


def key(*parts: object) -> str:
    """The key of an entry that depends on these bytes and values, and on who made it."""
    digest = hashlib.sha256(_makers().encode())
    for part in parts:
        content = part if isinstance(part, bytes) else repr(part).encode()
        digest.update(b"%d:" % len(content) + content)
    return digest.hexdigest()


def load(name: str, read: Callable[[bytes], Value]) -> Value | None:
    """The entry of a key, as `read` makes it of its bytes: None where there is no entry, or a
    damaged one."""
    try:
        with _opened() as place:
            content = b"" if place is None else _content(name, place)
    except OSError:
        return None
    if not content:
        return None
    try:
        if content[:_DIGEST] != checksum(name, content[_DIGEST:]):
            raise ValueError("its checksum is wrong")
        return read(content[_DIGEST:])
    except Exception as error:  # whatever else it holds, it is no entry of this key
        log.info("the cache's entry %s is damaged (%s) and is made anew", name, error)
        return None


def check_form(array: Any, shape: tuple[int, ...], below: int | None = None) -> None:
    """Refuse an array of another form than an entry's: of floats, or of indices below a number;
    ValueError: it has another one."""
    right = array.shape == shape and array.dtype == ("float64" if below is None else "int64")
    if right and below is not None and array.size:
        right = 0 <= array.min() <= array.max() < below
    if not right:
        raise ValueError("an array has another form")


def _content(name: str, place: int) -> bytes:
    descriptor = os.open(name, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK, dir_fd=place)
    with os.fdopen(descriptor, "rb") as file:
        state = os.fstat(descriptor)
        usable = stat.S_ISREG(state.st_mode) and is_private(state) and state.st_size <= LIMIT
        return file.read() if usable else b""


def checksum(name: str, content: bytes) -> bytes:
    """What stands before the content of an entry."""
    return hashlib.sha256(name.encode() + content).digest()


def save(name: str, content: bytes) -> None:
    """Keep an entry. A folder that cannot be written is no error: the next call works as before."""
    try:
        if (chosen := folder()) is not None:
            chosen.mkdir(0o700, parents=True, exist_ok=True)
        with _opened() as place:
            if place is not None:
                _write(name, content, place)
                _shrink(place)
    except OSError as error:
        log.info("nothing is kept in %s: %s", folder(), error)


def _write(name: str, content: bytes, place: int) -> None:
    temporary = f".new-{secrets.token_hex(32)}"
    flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL
    try:
        with os.fdopen(os.open(temporary, flags, 0o600, dir_fd=place), "wb") as file:
            file.write(checksum(name, content) + content)
        os.replace(temporary, name, src_dir_fd=place, dst_dir_fd=place)
    finally:
        with contextlib.suppress(FileNotFoundError):
            os.unlink(temporary, dir_fd=place)


def _shrink(place: int) -> None:
    found = []
    for entry in os.scandir(place):
        with contextlib.suppress(FileNotFoundError):  # another process was here
            if _NAME.fullmatch(entry.name) and entry.is_file(follow_symlinks=False):
                state = entry.stat(follow_symlinks=False)
                found.append((state.st_mtime, state.st_size, entry.name))
    total = sum(size for _, size, _ in found)
    for _, size, name in sorted(found):
        if total <= LIMIT:
            return
        with contextlib.suppress(FileNotFoundError):
            os.unlink(name, dir_fd=place)
        total -= size
