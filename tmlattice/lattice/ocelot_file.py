"""Reading a lattice from an OCELOT file.

A lattice file in Python is code, and loading it runs it: load only files that you trust.
"""

import copy
import importlib.util
import re
import sys
import warnings
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, redirect_stdout
from io import StringIO
from pathlib import Path
from types import ModuleType
from typing import Any

from tmlattice.errors import LatticeError, unknown_name
from tmlattice.lattice.places import place_elements, source_kind
from tmlattice.lattice.ring import Element, Ring
from tmlattice.lattice.source import copied

SEQUENCES = ("ring", "cell", "lattice")
"""Variables that may hold the sequence, in the order in which they are looked for."""

DEFAULT_ENERGY = 6.0
"""GeV; taken, with a warning, where a file states none. Maps feel it through 1 / gamma^2 only."""

_GENERATED = re.compile(r"ID_\d+_?")


def read_ocelot(
    path: Path, name: str, sequence: str | None = None, energy: float | None = None
) -> Ring:
    """The ring of an OCELOT lattice file, which is code and is run.

    An element's name is its OCELOT id; where OCELOT generated that id, the lowest-sorting
    variable of the file that holds the element, else its kind. Damaged things are corrected where
    there is one meaning: a matrix element without a longitudinal block gets R55 = R66 = 1;
    nested sequences are flattened.

    Args:
        path: of the `.py` file.
        name: of the ring.
        sequence: the variable that holds the elements; else `ring`; else of `cell`, `lattice` and
            every MagneticLattice the one with the most elements.
        energy: GeV; else what the file states (`energy`, or the E of a Twiss or Beam object).

    Raises:
        LatticeError: the file fails to run, or holds no sequence of elements.

    Source: the naming rule is the measurement format's, version 1 (docs/coordinates.md, "Names").
    """
    variables = vars(_run_as_module(path))
    return ring_of_elements(_sequence(path, variables, sequence), path, name, energy, variables)


def ring_of_elements(
    sequence: Any,
    path: Path,
    name: str,
    energy: float | None = None,
    variables: Mapping[str, Any] = {},
) -> Ring:
    """The ring of a list of OCELOT elements or of a `MagneticLattice`; see `read_ocelot`.

    Args:
        sequence: elements, nested lists of them, or a MagneticLattice.
        path: of its file, or the object's name, for messages.
        name: of the ring.
        energy: GeV; else that of the variables.
        variables: of the file: names of elements and the energy.
    """
    places = list(_flatten(sequence))
    if not places:
        raise LatticeError(f"the sequence of '{path}' is empty; name another with sequence=")
    return Ring(
        name=name,
        elements=_name_places(places, variables),
        energy=_energy(path, variables) if energy is None else energy,
    )


@contextmanager
def _import_path(folder: Path) -> Iterator[None]:
    """A lattice file may import its neighbours; what is installed comes before them."""
    before = sys.path[:]
    sys.path.append(str(folder))
    try:
        yield
    finally:
        sys.path[:] = before


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
    """The variable that holds the ring: `ring`; else of `SEQUENCES` and all MagneticLattices the
    one with the most elements, for `cell` may be the ring or a cell of it."""
    if wanted or "ring" in variables:
        name = wanted or "ring"
        if name in variables:
            return variables[name]
        lists = [k for k, v in variables.items() if isinstance(v, list | tuple)]
        raise unknown_name(f"sequence in '{path}' named", name, lists)
    found = [variables[name] for name in SEQUENCES if name in variables]
    found += [v for v in variables.values() if type(v).__name__ == "MagneticLattice"]
    if not found:
        raise LatticeError(
            f"'{path}' has no sequence called ring, cell or lattice; name it with sequence="
        )
    return max(found, key=lambda sequence: sum(1 for _ in _flatten(sequence)))


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


def _modelled(source: Any, named: str) -> Any:
    """The element; a copy of a matrix element that was born without a longitudinal block, or of a
    displaced one without its offset; a thin bend in the place of a multipole that bends the design
    orbit. Messages call it `named`."""
    from tmlattice.lattice.combined import CombinedMultipole
    from tmlattice.lattice.ocelot import elements

    cls = type(source).__name__
    for name in _NOT_MODELLED:
        if getattr(source, name, 0.0):
            raise LatticeError(f"{name} of the {cls} '{named}' is not modelled; set it to 0")
    if cls == "TDCavity" and source.v:
        warnings.warn(f"'{named}': what the voltage does in a {cls} is left out", stacklevel=2)
    if _displaced(source):
        source = copied(source)
        source.dx = source.dy = 0.0

    if isinstance(source, elements.Matrix) and source.r[4, 4] == 0 and source.r[5, 5] == 0:
        source = copy.deepcopy(source)
        matrix = source.r.copy()
        matrix[4, 4] = matrix[5, 5] = 1.0
        source.r = matrix
    if isinstance(source, elements.Multipole) and source.kn[0]:  # it bends the design orbit
        angle, k1, k2, *higher = [*map(float, source.kn), 0.0, 0.0]
        if any(higher):
            warnings.warn(f"'{named}': fields above the sextupole are left out", stacklevel=2)
        source = CombinedMultipole(angle=angle, k1=k1, k2=k2, tilt=source.tilt, eid=source.id)
    return source


def _name_places(places: list[Any], variables: Mapping[str, Any]) -> tuple[Element, ...]:
    by_object: dict[int, str] = {}
    for variable in sorted(variables, reverse=True):  # so that the lowest-sorting one stays
        by_object[id(variables[variable])] = variable
    families = [
        by_object.get(id(source), source_kind(source, str(source.id)))
        if source.id is None or _GENERATED.fullmatch(str(source.id))
        else str(source.id)
        for source in places
    ]
    first = {id(source): (source, name) for name, source in zip(families, places, strict=True)}
    modelled = {key: _modelled(*own) for key, own in first.items()}
    elements = place_elements(families, [modelled[id(source)] for source in places])
    return tuple(
        e.with_errors(dx=float(source.dx), dy=float(source.dy)) if _displaced(source) else e
        for e, source in zip(elements, places, strict=True)
    )


def _displaced(source: Any) -> bool:
    """Whether an element has its field off the axis; in `Element` that is one of its errors."""
    return bool(source.dx or source.dy) and type(source).__name__ in _WITH_OFFSET


_NOT_MODELLED = (
    "dtilt", "delta_e", "vx_up", "vy_up", "vxx_up", "vxy_up", "vx_down", "vy_down", "vxx_down",
    "vxy_down",
)  # fmt: skip
"""Attributes that change the orbit or the optics: also coupler kicks of a cavity."""
_WITH_OFFSET = ("Quadrupole", "Sextupole", "Octupole", "SBend", "RBend", "Bend", "Solenoid")


def _energy(path: Path, variables: Mapping[str, Any]) -> float:
    for name in ("energy", "Energy", "ENERGY", "E0", "beam_energy"):
        if isinstance(variables.get(name), int | float):
            return float(variables[name])
    for value in variables.values():
        if type(value).__name__ in ("Twiss", "Beam") and getattr(value, "E", 0.0) > 0:
            return float(value.E)
    warnings.warn(
        f"'{path}' states no beam energy; {DEFAULT_ENERGY} GeV is taken (energy= changes it)",
        stacklevel=3,
    )
    return DEFAULT_ENERGY
