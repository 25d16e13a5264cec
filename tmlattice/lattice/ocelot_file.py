"""Reading a lattice from an OCELOT file.

A lattice file in Python is code, and loading it runs it: load only files that you trust.
"""

import copy
import importlib.util
import logging
import math
import re
import sys
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, redirect_stdout
from importlib.resources import files
from io import StringIO
from pathlib import Path
from types import ModuleType
from typing import Any

from tmlattice.errors import LatticeError, unknown_name
from tmlattice.lattice.ring import Element, Kind, Ring, number_names

log = logging.getLogger(__name__)

SEQUENCES = ("ring", "cell", "lattice")
"""Variables that may hold the sequence, in the order in which they are looked for."""

DEFAULT_ENERGY = 6.0
"""GeV; taken, with a warning, where a file states none. Maps feel it through 1 / gamma^2 only."""

_GENERATED = re.compile(r"ID_\d+_?")


def _builtin_folder() -> Path:
    return Path(str(files("tmlattice"))) / "lattices"


def builtin_lattices() -> list[str]:
    """Names of the lattices that come with the package."""
    return sorted(
        path.stem for path in _builtin_folder().glob("*.py") if not path.stem.startswith("match_")
    )


def load_ring(
    name_or_path: str | Path, sequence: str | None = None, energy: float | None = None
) -> Ring:
    """The ring of a built-in lattice or of an OCELOT lattice file.

    An element's name is its OCELOT id; where OCELOT generated that id, the lowest-sorting
    variable of the file that holds the element, else its kind. Names that stand more than once
    are numbered in beam order. Damaged things are mended where there is one meaning: a matrix
    element without a longitudinal block gets R55 = R66 = 1; nested sequences are flattened.
    What the maps cannot model is warned of (an octupole is a drift at second order).

    Args:
        name_or_path: "petra3", or a path to a `.py` file. The file is code, and is run.
        sequence: the variable that holds the elements; else `ring`, `cell` or `lattice`.
        energy: GeV; else what the file states (`energy`, or the E of a Twiss or Beam object).

    Raises:
        LatticeError: no such file, it fails to run, or it holds no sequence of elements.

    Source: the naming rule is the measurement format's, version 1 (docs: README, "Names").
    """
    path = _find(str(name_or_path))
    module = _run_as_module(path)
    variables = vars(module)
    chosen = _sequence(path, variables, sequence)
    places = list(_flatten(chosen))
    if not places:
        raise LatticeError(f"the sequence of '{path}' is empty; name another with sequence=")
    return Ring(
        name=str(name_or_path),
        elements=_name_places(places, variables),
        energy=_energy(path, variables, chosen) if energy is None else energy,
    )


def _find(name: str) -> Path:
    builtin = builtin_lattices()
    if name.casefold() in builtin:
        return _builtin_folder() / f"{name.casefold()}.py"
    path = Path(name)
    if path.suffix.lower() == ".py" and path.is_file():
        return path
    if path.is_file():
        raise LatticeError(
            f"'{name}' is not a Python file; give an OCELOT lattice file (.py) "
            f"or a built-in name ({', '.join(builtin)})"
        )
    if path.suffix:
        raise LatticeError(f"no lattice file '{name}'; check the path")
    raise unknown_name("lattice", name, builtin)


@contextmanager
def _import_path(folder: Path) -> Iterator[None]:
    """A lattice file may import its neighbours, as when it is run from its own folder."""
    sys.path.insert(0, str(folder))
    try:
        yield
    finally:
        if str(folder) in sys.path:
            sys.path.remove(str(folder))


def _run_as_module(path: Path) -> ModuleType:
    """The file as a module of its own: comprehensions over its names work, unlike with exec."""
    import tmlattice.lattice.ocelot  # noqa: F401  (OCELOT's greeting is silenced there)

    spec = importlib.util.spec_from_file_location(f"_tmlattice_lattice_{path.stem}", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    bytecode, sys.dont_write_bytecode = sys.dont_write_bytecode, True
    try:
        with _import_path(path.resolve().parent), redirect_stdout(StringIO()):
            spec.loader.exec_module(module)
    except (Exception, SystemExit) as error:
        raise LatticeError(
            f"'{path}' fails to run as an OCELOT lattice file: {type(error).__name__}: {error}"
        ) from error
    finally:
        sys.dont_write_bytecode = bytecode
    return module


def _sequence(path: Path, variables: dict[str, Any], wanted: str | None) -> Any:
    names = (wanted,) if wanted else SEQUENCES
    for name in names:
        if name in variables:
            return variables[name]
    if wanted:
        lists = [k for k, v in variables.items() if isinstance(v, list | tuple)]
        raise unknown_name(f"sequence in '{path}' named", wanted, lists)
    raise LatticeError(
        f"'{path}' has no sequence called ring, cell or lattice; name it with sequence="
    )


def _flatten(sequence: Any) -> Iterator[Any]:
    """The elements of a list, nested lists, or a MagneticLattice."""
    from tmlattice.lattice.ocelot import OpticElement

    if hasattr(sequence, "sequence"):
        sequence = sequence.sequence
    if not isinstance(sequence, Iterable) or isinstance(sequence, str):
        raise LatticeError(
            f"the sequence holds {sequence!r}, which is no element; a sequence is a list of "
            "OCELOT elements"
        )
    for item in sequence:
        if isinstance(item, OpticElement):
            yield item
        else:
            yield from _flatten(item)


def _mend(source: Any) -> Any:
    """The element with what is plainly missing put in (a copy), and its oddities warned of."""
    from tmlattice.lattice.ocelot import elements

    length = float(source.l)
    if not math.isfinite(length):
        raise LatticeError(f"'{source.id}' has the length {length}; mend it in the lattice file")
    if isinstance(source, elements.Matrix) and source.r[4, 4] == 0 and source.r[5, 5] == 0:
        source = copy.deepcopy(source)
        matrix = source.r.copy()
        matrix[4, 4] = matrix[5, 5] = 1.0
        source.r = matrix
    if isinstance(source, elements.Octupole) and source.k3 != 0:
        warnings.warn(
            f"octupole '{source.id}' is a drift in second-order maps: its field is not modelled",
            stacklevel=4,
        )
    if length < 0:
        level = logging.DEBUG if length > -1e-6 else logging.WARNING
        log.log(level, "element '%s' has the negative length %.3g m", source.id, length)
    return source


def _kind(source: Any) -> Kind:
    from tmlattice.lattice.ocelot import elements as e

    kinds: list[tuple[Any, Kind]] = [
        (e.Drift, "drift"),
        (e.Quadrupole, "quadrupole"),
        (e.XYQuadrupole, "quadrupole"),
        ((e.Bend, e.SBend, e.RBend), "bend"),
        (e.Hcor, "hcorrector"),
        (e.Vcor, "vcorrector"),
        (e.Sextupole, "sextupole"),
        (e.Octupole, "octupole"),
        (e.Multipole, "multipole"),
        (e.Solenoid, "solenoid"),
        (e.Undulator, "wiggler"),
        (e.Monitor, "monitor"),
        ((e.Cavity, e.TDCavity, e.TWCavity), "cavity"),
    ]
    for classes, kind in kinds:
        if isinstance(source, classes):
            return kind
    if isinstance(source, e.Matrix):  # OCELOT has no damping wiggler: the name tells
        return "wiggler" if "wig" in str(source.id).casefold() else "matrix"
    return "drift" if source.l else "marker"


def _name_places(places: list[Any], variables: dict[str, Any]) -> tuple[Element, ...]:
    by_object: dict[int, str] = {}
    for variable in sorted(variables, reverse=True):  # so that the lowest-sorting one stays
        by_object[id(variables[variable])] = variable
    kinds = {id(source): _kind(source) for source in places}
    mended = {id(source): source for source in places}
    mended = {key: _mend(source) for key, source in mended.items()}
    families = [
        by_object.get(id(source), kinds[id(source)])
        if source.id is None or _GENERATED.fullmatch(str(source.id))
        else str(source.id)
        for source in places
    ]
    placed = []
    start = 0.0
    for name, family, source in zip(number_names(families), families, places, strict=True):
        length = float(source.l)
        placed.append(
            Element(
                name=name,
                family=family,
                kind=kinds[id(source)],
                s=start + length / 2,
                length=length,
                k1=float(getattr(source, "k1", 0.0)),
                k2=float(getattr(source, "k2", 0.0)),
                angle=float(getattr(source, "angle", 0.0)),
                tilt=float(getattr(source, "tilt", 0.0)),
                source=mended[id(source)],
            )
        )
        start += length
    return tuple(placed)


def _energy(path: Path, variables: dict[str, Any], sequence: Any) -> float:
    for name in ("energy", "Energy", "ENERGY", "E0", "beam_energy"):
        if isinstance(variables.get(name), int | float):
            return float(variables[name])
    for value in variables.values():
        if type(value).__name__ in ("Twiss", "Beam") and getattr(value, "E", 0.0) > 0:
            return float(value.E)
    warnings.warn(
        f"'{path}' states no beam energy; {DEFAULT_ENERGY} GeV is taken (say energy= to change)",
        stacklevel=3,
    )
    return DEFAULT_ENERGY
