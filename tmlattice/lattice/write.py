"""One door to all lattice files that are written: the suffix says which format it is.

>>> told = write_ring(ring, "as_found.at.json")         # what the file does not hold
"""

from collections.abc import Callable
from pathlib import Path

from tmlattice.errors import LatticeError
from tmlattice.files import output_file
from tmlattice.lattice.json_file import save_ring
from tmlattice.lattice.plain import plain
from tmlattice.lattice.ring import Ring

Writer = Callable[[Ring, Path], tuple[str, ...]]

SUFFIXES = ".json (the package's own), .at.json (AT), .madx or .seq (MAD-X), .py (OCELOT)"


def write_ring(ring: Ring, path: str | Path) -> tuple[str, ...]:
    """Write a ring in the format that the suffix names, whole or not at all.

    `.json` is the package's own file, and holds everything. `.at.json` is AT's (`at.load_lattice`),
    `.madx` and `.seq` are MAD-X, `.py` is OCELOT, which is code. Those have no place for every
    error of a magnet: see `plain`.

    Args:
        ring: from any reader, with its changes and errors.
        path: to write to.

    Returns:
        What the file does not hold, or holds otherwise, a sentence each.

    Raises:
        LatticeError: another suffix, or an element that the format cannot hold.
        OutputError: the file cannot be written.
    """
    path = Path(path)
    name = path.name.lower()
    if name.endswith(".json") and not name.endswith(".at.json"):
        save_ring(ring, path)
        return ()
    write = _writer(path)
    bare, told = plain(ring)
    with output_file(path) as temporary:
        return (*told, *write(bare, temporary))


def knows(path: str | Path) -> bool:
    """Whether the suffix names a format."""
    return Path(path).name.lower().endswith((".json", ".madx", ".seq", ".py"))


def _writer(path: Path) -> Writer:
    name = path.name.lower()
    if name.endswith(".at.json"):
        from tmlattice.lattice.write_at import write_at

        return write_at
    if name.endswith((".madx", ".seq")):
        from tmlattice.lattice.write_madx import write_madx

        return write_madx
    if name.endswith(".py"):
        from tmlattice.lattice.write_ocelot import write_ocelot

        return write_ocelot
    raise LatticeError(f"'{path}' names no format; end it in {SUFFIXES}")
