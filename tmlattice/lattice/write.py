"""Rings in the formats of other packages: files by their suffix, and objects.

>>> lacks = save_ring(ring, "estimated.at.json")       # what the file does not hold
>>> lattice = ring.to_at()                              # warns of what AT does not hold
"""

import warnings
from collections.abc import Iterable
from dataclasses import asdict
from importlib import import_module
from pathlib import Path
from typing import Any

from tmlattice.errors import LatticeError, MissingPackageError
from tmlattice.files import output_file
from tmlattice.lattice.json_file import save_json
from tmlattice.lattice.plain import plain
from tmlattice.lattice.ring import Ring

FORMATS = {
    ".at.json": "write_at", ".xsuite.json": "write_xsuite", ".madx": "write_madx",
    ".seq": "write_madx", ".py": "write_ocelot",
}  # fmt: skip
"""Modules by suffix. Each states the errors that its format `holds` of an element. Its `made` is
the package's object of a ring of plain elements, its `write` a file; both state what they leave
out."""

SUFFIXES = (
    ".json (the package's own), .at.json (AT), .xsuite.json (Xsuite), .madx or .seq (MAD-X), .py "
    "(OCELOT)"
)


def save_ring(ring: Ring, path: str | Path) -> tuple[str, ...]:
    """Write a ring in the format that the suffix names, whole or not at all.

    `.json` is the package's own file, and holds everything. `.at.json` is AT's (`at.load_lattice`),
    `.xsuite.json` is Xsuite's (`xtrack.Line.from_json`), `.madx` and `.seq` are MAD-X, `.py` is
    OCELOT, which is code. Those have no place for every error of a magnet: see `plain`.

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
    if name.endswith(".json") and not name.endswith((".at.json", ".xsuite.json")):
        save_json(ring, path)
        return ()
    module = _module(name)
    if module is None:
        raise LatticeError(f"'{path}' names no format; end it in {SUFFIXES}")
    bare, lacks = plain(ring, module.holds)
    with output_file(path) as temporary:
        return (*lacks, *module.write(bare, temporary))


def knows(path: str | Path) -> bool:
    """Whether the suffix names a format."""
    return Path(path).name.lower().endswith((".json", *FORMATS))


def _module(name: str) -> Any:
    """What writes a format; None: no suffix of one."""
    found = next((own for suffix, own in FORMATS.items() if name.endswith(suffix)), None)
    return found and import_module(f"tmlattice.lattice.{found}")


def to_at(ring: Ring) -> Any:
    """Return the ring as an `at.Lattice`, cavities switched off; its errors as AT has them (T1, T2,
    R1, R2, PolynomA, PolynomB). Elements are named for their families.

    Warns:
        Once, of all that AT does not hold.
    """
    return _object(ring, "AT", ".at.json")


def to_ocelot(ring: Ring) -> Any:
    """Return the ring as OCELOT's `MagneticLattice` of second-order maps, with elements of its own.
    It holds no energy: give it `ring.energy` where it asks (GeV).

    Warns:
        Once, of all that OCELOT does not hold.
    """
    return _object(ring, "OCELOT", ".py")


def to_xtrack(ring: Ring) -> Any:
    """Return the ring as an `xtrack.Line` with its reference particle; monitors and correctors are
    those of its steering.

    Raises:
        MissingPackageError: xtrack is not installed.

    Warns:
        Once, of all that Xsuite does not hold.
    """
    try:
        xtrack = import_module("xtrack")
    except ImportError as error:
        raise MissingPackageError(
            "to_xtrack needs the package 'xtrack', which is not installed: `pip install xsuite` "
            "brings it; save_ring(ring, 'ring.xsuite.json') does without"
        ) from error
    content = _object(ring, "Xsuite", ".xsuite.json")
    return xtrack.Line.from_dict(content, with_progress=False)


def to_madx(ring: Ring, calibration: Iterable[Any] = ()) -> str:
    """Return the text of a MAD-X file with the ring as its sequence `ring`, for `madx.input(...)`.

    Args:
        ring: with its errors.
        calibration: errors of monitors, `Diagnosis.calibration`: offsets and gains as EALIGN.

    Warns:
        Once, of all that MAD-X does not hold.
    """
    return str(_object(ring, "MAD-X", ".madx", calibration))


def to_dataframe(ring: Ring) -> Any:
    """Return a pandas DataFrame with a row for each element in beam order, by name.

    Columns: family, kind, s (of the middle) and length in m, k1 (1/m2), k2 (1/m3), angle and tilt
    (rad), and the errors beyond them, in the units of `Errors`: dx, dy, ds, roll, kick_x, kick_y,
    k1l, k1sl, entrance_k1l, loss.
    """
    pandas = import_module("pandas")

    columns = ("family", "kind", "s", "length", "k1", "k2", "angle", "tilt")
    rows = [
        {**{name: getattr(e, name) for name in columns},
         **{k: v for k, v in asdict(e.errors).items() if not isinstance(v, tuple)}}
        for e in ring.elements
    ]  # fmt: skip
    return pandas.DataFrame(rows, index=pandas.Index([e.name for e in ring.elements], name="name"))


def _object(ring: Ring, package: str, suffix: str, *more: Any) -> Any:
    module = _module(suffix)
    bare, lacks = plain(ring, module.holds)
    made, more_lacks = module.made(bare, *more)
    if lacks or more_lacks:
        text = "; ".join((*lacks, *more_lacks))
        warnings.warn(f"'{ring.name}' in {package}: {text}", stacklevel=3)
    return made
