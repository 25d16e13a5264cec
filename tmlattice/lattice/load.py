"""One function for all lattices: files by their suffix, other packages' objects by their class."""

import os
import re
import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from importlib import import_module
from importlib.resources import files
from pathlib import Path
from typing import Any

from tmlattice.errors import LatticeError, unknown_name
from tmlattice.input_files import check_regular
from tmlattice.lattice import stored
from tmlattice.lattice.checks import check_ring, reading
from tmlattice.lattice.marked import marked
from tmlattice.lattice.ring import PARTICLES, Ring

TFS_SUFFIXES = (".tfs", ".twiss", ".dat", ".outx")
SUFFIXES = (".py", ".json", ".mat", ".m", ".repr", ".seq", ".madx", ".lte", *TFS_SUFFIXES)
"""Of lattice files."""


def _builtin_folder() -> Path:
    return Path(str(files("tmlattice"))) / "lattices"


def builtin_lattices() -> list[str]:
    """Names of the lattices that come with the package."""
    return sorted(
        path.stem for path in _builtin_folder().glob("*.py") if not path.stem.startswith("match_")
    )


def load_ring(
    lattice: str | os.PathLike[str] | Any,
    sequence: str | None = None,
    energy: float | None = None,
    monitors: str | Sequence[str] | None = None,
    correctors: str | Sequence[str] | None = None,
    particle: str | None = None,
) -> Ring:
    """Return the ring of a built-in lattice, a lattice file or an object of another package.

    Names that occur more than once are numbered in beam order. What the maps cannot model is
    warned of (an octupole is a drift at second order). Each reader states what it takes over:
    `read_ocelot`, `read_at`, `read_madx`, `read_xsuite`, `read_tfs`, `read_json`.

    Args:
        lattice: "petra3", or a path: OCELOT (`.py`; it is code, and is run), AT (`.mat`,
            `.m`, `.repr`, `.json`), MAD-X (`.seq`, `.madx`, or a TWISS table: `.tfs`, `.twiss`,
            `.dat`), elegant (`.lte`), Xsuite (`.json`) or the package's own JSON; an open file of
            these; an `at.Lattice`, `xtrack.Line`, `xtrack.Environment`, `cpymad.madx.Madx` with a
            used sequence, OCELOT `MagneticLattice` or list of OCELOT elements; or a `Ring`.
        sequence: which of the variables, keys, lines or sequences is the ring.
        energy: GeV; else what the lattice states.
        monitors, correctors: patterns of names, such as "BPM*", of elements that are monitors or
            correctors although the file does not state it: see `marked`.
        particle: "electron" or "proton"; else what the file states, an electron where it is silent.

    Raises:
        LatticeError: no such file or class of objects, it cannot be read, or it holds no ring.
    """
    ring = marked(_loaded(lattice, sequence, energy), monitors, correctors)
    if particle is None:
        return ring
    if particle not in PARTICLES:
        raise unknown_name("particle", particle, PARTICLES)
    return replace(ring, mass=PARTICLES[particle])


def contents(ring: Ring) -> tuple[object, ...]:
    """All that a ring is, but for its name: what results depend on."""
    elements = tuple(
        (e.name, e.kind, e.length, e.k1, e.k2, e.angle, e.tilt, e.errors) for e in ring.elements
    )
    return (ring.energy, ring.mass, elements)


def _loaded(lattice: Any, sequence: str | None, energy: float | None) -> Ring:
    if isinstance(lattice, Ring):
        return lattice if energy is None else replace(lattice, energy=energy)
    if not isinstance(lattice, str | os.PathLike):
        from tmlattice.lattice.objects import named_file, reader_of

        if hasattr(lattice, "read"):
            with named_file(lattice) as path:
                return _of_file(path, str(lattice.name), sequence, energy)
        name, read = reader_of(lattice)
        return _checked(Path(name), lambda: read(sequence, energy))[0]
    return _of_file(_find(os.fspath(lattice)), os.fspath(lattice), sequence, energy)


def _of_file(path: Path, name: str, sequence: str | None, energy: float | None) -> Ring:
    if not check_regular(path, LatticeError):  # nothing is waited for, as of /proc/kmsg
        raise LatticeError(f"'{name}' is empty; give a lattice file")
    key = stored.key_of(path, sequence, energy)
    kept = stored.load(key, name) if key else None
    if kept is not None:
        return kept
    ring, warned = _checked(path, lambda: _read(path, name, sequence, energy))
    if key and not warned:  # what is warned of is warned of every time
        stored.save(key, ring)
    return ring


def _checked(where: Path, read: Callable[[], Ring]) -> tuple[Ring, bool]:
    """A ring that was read and checked, and whether there were warnings."""
    with warnings.catch_warnings(record=True) as caught, reading(where):
        warnings.simplefilter("always")
        try:
            ring = read()
        except LatticeError as error:
            raise _foreign(where) or error from error
        check_ring(ring)
    # others are of code that is loaded meanwhile, and of the speed of OCELOT's
    own = [w for w in caught if issubclass(w.category, UserWarning | RuntimeWarning)]
    for w in own:
        warnings.warn_explicit(w.message, w.category, w.filename, w.lineno)
    return ring, bool(own)


_READERS = {
    ".py": "ocelot_file.read_ocelot", ".lte": "elegant_file.read_elegant",
    ".seq": "madx_file.read_madx", ".madx": "madx_file.read_madx",
    **dict.fromkeys(TFS_SUFFIXES, "tfs_file.read_tfs"),
    "tmlattice": "json_file.read_json", "xsuite": "xsuite_file.read_xsuite",
}  # fmt: skip
"""Modules and functions by suffix, or by the package that wrote a JSON file; others are AT's."""


def _read(path: Path, name: str, sequence: str | None, energy: float | None) -> Ring:
    kind = path.suffix.lower()
    if kind == ".json":
        from tmlattice.lattice.json_file import package_of

        kind = package_of(path)
    module, _, function = _READERS.get(kind, "at_file.read_at").partition(".")
    read = getattr(import_module(f"tmlattice.lattice.{module}"), function)
    ring: Ring = read(path, name, sequence, energy)
    return ring


_FOREIGN = {
    "a command file of elegant: give the lattice (.lte) that it names":
        r"^\s*&(run_setup|run_control|twiss_output)\b",
    "a table of SDDS and no lattice: give the lattice (.lte)": r"\ASDDS\d",
    "a lattice of Bmad": r"^\s*(parameter|beginning|particle_start)\s*\[",
    "a lattice of SAD": r"^\s*FFS\b|^\s*(DRIFT|BEND|QUAD|SEXT|MARK|LINE)\s+\w+\s*=\s*\(",
    "a lattice of MAD-NG": r"^\s*local\b.*(\bin\s+MAD\b|\brequire\b.*\bmadl?\b)",
    "a lattice of PALS": r"^\s*\{?\s*\"?PALS\"?\s*:",
    "a lattice of Tracy": r"^\s*define\s+lattice\b",
    "a lattice of OPA": r"\A\s*\{[^}]*\.opa\}|:\s*bending\b",
    "a lattice of MAD-8 (no ';' ends its statements)":
        r"\A(?=[^;]*^\s*(beam|title|twiss|option|survey)\b)"
        r"[^;]*:\s*(line|quadrupole|sbend|rbend)\b[^;]*\Z",
}  # fmt: skip
"""Formats that are not read, by what their files hold."""


def _foreign(path: Path) -> LatticeError | None:
    """The error that names the format of a file that is not read; None: it is none of these."""
    if not path.is_file():
        return None
    with path.open("rb") as file:
        text = re.sub(r"!.*", "", file.read(100_000).decode("latin-1"))
    for what, pattern in _FOREIGN.items():
        if re.search(pattern, text, re.IGNORECASE | re.MULTILINE):
            advice = "" if ": give" in what else ", which is not read: convert it to MAD-X or AT"
            return LatticeError(f"'{path}' is {what}{advice}")
    return None


def _find(name: str) -> Path:
    builtin = builtin_lattices()
    if name.casefold() in builtin:
        return _builtin_folder() / f"{name.casefold()}.py"
    path = Path(name)
    if path.suffix.lower() in SUFFIXES and path.is_file():
        return path
    if path.is_file():
        raise _foreign(path) or LatticeError(
            f"'{name}' is no lattice file that can be read; give OCELOT code (.py), AT (.mat, .m, "
            f".repr, .json), MAD-X (.seq, .madx; a TWISS table: .tfs), elegant (.lte), Xsuite "
            f"(.json), the package's own JSON or a built-in name ({', '.join(builtin)})"
        )
    if path.is_dir():
        raise LatticeError(f"'{name}' is a folder and no lattice; give the lattice first")
    if path.suffix:
        raise LatticeError(f"no lattice file '{name}'; check the path")
    raise unknown_name("lattice", name, builtin)
