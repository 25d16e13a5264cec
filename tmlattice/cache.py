"""What was worked out once, kept in the user's cache folder: safe to delete at any time.

An entry is bytes under a key that names everything they depend on. It is written under a temporary
name and moved, so that several processes may share the folder; it begins with its own checksum, and
one that does not fit is made anew. Nothing in it is ever executed.

`TMLATTICE_CACHE` names another folder, or is `off`.
"""

import contextlib
import hashlib
import logging
import os
import tempfile
from functools import cache
from importlib.metadata import version
from pathlib import Path

log = logging.getLogger(__name__)

LIMIT = 200_000_000
"""Bytes that all entries together may take; beyond it the oldest go. A large ring takes 4 MB."""

_DIGEST = hashlib.sha256().digest_size


def folder() -> Path | None:
    """Where entries lie; None where nothing is kept."""
    chosen = os.environ.get("TMLATTICE_CACHE")
    if chosen is not None:
        return None if chosen.casefold() in ("", "0", "off") else Path(chosen)
    home = os.environ.get("XDG_CACHE_HOME")
    return (Path(home) if home else Path("~/.cache").expanduser()) / "tmlattice"


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


def load(name: str) -> bytes | None:
    """The entry of this key, or None where there is none, or a damaged one."""
    place = folder()
    if place is None:
        return None
    try:
        content = (place / name).read_bytes()
    except OSError:
        return None
    if hashlib.sha256(content[_DIGEST:]).digest() != content[:_DIGEST]:
        log.info("the cache's entry %s is damaged and is made anew", place / name)
        return None
    return content[_DIGEST:]


def save(name: str, content: bytes) -> None:
    """Keep an entry. A folder that cannot be written is no error: the next call works as before."""
    place = folder()
    if place is None:
        return
    try:
        place.mkdir(parents=True, exist_ok=True)
        handle, temporary = tempfile.mkstemp(prefix=".new-", dir=place)
        try:
            with os.fdopen(handle, "wb") as file:
                file.write(hashlib.sha256(content).digest() + content)
            os.replace(temporary, place / name)
        finally:
            with contextlib.suppress(FileNotFoundError):
                os.unlink(temporary)
        _shrink(place)
    except OSError as error:
        log.info("nothing is kept in %s: %s", place, error)


def _shrink(place: Path) -> None:
    found = []
    for path in place.iterdir():
        with contextlib.suppress(FileNotFoundError):  # another process was here
            found.append((path.stat().st_mtime, path.stat().st_size, path))
    total = sum(size for _, size, _ in found)
    for _, size, path in sorted(found):
        if total <= LIMIT:
            return
        path.unlink(missing_ok=True)
        total -= size
