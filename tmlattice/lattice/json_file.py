"""The package's own lattice file: data only, small, and the same maps bit for bit.

`definitions` holds each different element once: its kind, OCELOT class and those of its numbers
that are not the class's own defaults. `sequence` names them in beam order. Names are numbered on
reading, as everywhere. A matrix is stored by its nonzero entries (`"12"` is row 1, column 2).
"""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from tmlattice.errors import LatticeError
from tmlattice.files import output_file, write_json
from tmlattice.input_files import check_shape, json_of
from tmlattice.lattice.places import place_elements
from tmlattice.lattice.ring import ELECTRON_GEV, NO_ERRORS, Element, Errors, Ring, number_names
from tmlattice.lattice.source import blank, made

FORMAT, VERSION = "tmlattice-lattice", 1

CLASSES = (
    "Aperture", "Bend", "Cavity", "CombinedMultipole", "Drift", "Hcor", "Marker", "Matrix",
    "Monitor", "Multipole", "Octupole", "Quadrupole", "RBend", "SBend", "Sextupole", "Solenoid",
    "TDCavity", "TWCavity", "Undulator", "UnknownElement", "Vcor", "XYQuadrupole",
)  # fmt: skip
"""OCELOT's element classes that a file may name, and the package's own of them."""


def save_json(ring: Ring, path: str | Path) -> None:
    """Write a ring as the package's JSON (schema: `tmlattice/schemas/lattice.schema.json`).

    Args:
        ring: from any reader, with its changes.
        path: a `.json` file; written whole or not at all.

    Raises:
        LatticeError: an element that numbers do not describe (a field map), or names that are
            not the families numbered in beam order.
        OutputError: the file cannot be written.
    """
    from tmlattice import __version__

    families = [element.family for element in ring.elements]
    if number_names(families) != [element.name for element in ring.elements]:
        raise LatticeError(
            f"names of '{ring.name}' are not its families numbered in beam order; rename them"
        )
    definitions: dict[str, dict[str, Any]] = {}
    keys: dict[str, str] = {}  # what an element is, as text -> its key
    sequence = []
    for element in ring.elements:
        content = described(element)
        text = json.dumps([element.family, content], sort_keys=True)
        if text not in keys:
            key, k = element.family, 1
            while key in definitions:
                k += 1
                key = f"{element.family}#{k}"
            if key != element.family:
                content = {"family": element.family, **content}
            keys[text], definitions[key] = key, content
        sequence.append(keys[text])
    content = {
        "format": FORMAT,
        "version": VERSION,
        "package": __version__,
        "name": ring.name,
        "energy_gev": ring.energy,
        **({} if ring.mass == ELECTRON_GEV else {"mass_gev": ring.mass}),
        **({} if ring.model == "design" else {"model": ring.model}),
        "changes": {name: dict(change) for name, change in ring.changes.items()},
        **({"supplies": ring.supplies} if ring.supplies else {}),
        "definitions": definitions,
        "sequence": sequence,
    }
    with output_file(Path(path)) as temporary:
        write_json(temporary, content)


def package_of(path: Path) -> str:
    """Return whose lattice a JSON file holds: "tmlattice", "at" or "xsuite".

    Raises:
        LatticeError: it is no JSON, or holds no lattice.
    """
    content = _content(path)
    if not isinstance(content, dict):
        raise LatticeError(f"'{path}' holds no lattice; give the package's own JSON or AT's")
    if "format" in content:
        return "tmlattice"
    if "atjson" in content:
        return "at"
    ordered = {"element_names", "composer", "builder", "xtrack_version"} & content.keys()
    line = content.get("lines") or content.get("line")
    return (
        "xsuite" if isinstance(line, dict) or ("elements" in content and ordered) else "tmlattice"
    )


def read_json(
    path: Path, name: str, sequence: str | None = None, energy: float | None = None
) -> Ring:
    """The ring of a file that `save_json` wrote.

    Args:
        path: of the file.
        name: of the ring.
        sequence: passed over; a file is one ring.
        energy: GeV; else the file's.

    Raises:
        LatticeError: another format or version, or what the schema does not allow.
    """
    content = _content(path)
    if content.get("format") != FORMAT:
        raise LatticeError(
            f"'{path}' has the format {content.get('format')!r}, which is no lattice; give a file "
            f"of save_json ('{FORMAT}') or an AT lattice (.json)"
        )
    if content.get("version") != VERSION:
        raise LatticeError(
            f"'{path}' has version {content.get('version')!r} of '{FORMAT}', and this package "
            f"reads version {VERSION}; save it again with save_json"
        )
    check_shape(path, content, "lattice", LatticeError)
    definitions = content["definitions"]
    sources = {key: made(path, key, value) for key, value in definitions.items()}
    for place, key in enumerate(content["sequence"]):
        if key not in definitions:
            raise LatticeError(
                f"'{path}': place {place} of the sequence is '{key}', which has no definition"
            )
    keys = content["sequence"]
    elements = place_elements(
        [definitions[key].get("family", key) for key in keys],
        [sources[key] for key in keys],
        [definitions[key]["kind"] for key in keys],
    )
    elements = tuple(
        _with_errors(path, e, definitions[key].get("errors"))
        for e, key in zip(elements, keys, strict=True)
    )
    energy = float(content["energy_gev"]) if energy is None else energy
    mass = float(content.get("mass_gev", ELECTRON_GEV))
    model = content.get("model", "design")
    changes, supplies = content.get("changes", {}), content.get("supplies")
    known = {element.name for element in elements}
    named = {f"the supply '{supply}'": names for supply, names in (supplies or {}).items()}
    for where, names in {"'changes'": changes, **named}.items():
        if strange := [name for name in names if name not in known]:
            raise LatticeError(
                f"'{path}': {where} has '{strange[0]}', which is no element; take it out"
            )
    if supplies is not None:
        supplies = {supply: tuple(names) for supply, names in supplies.items()}
    return Ring(name, elements, energy, changes, mass, supplies, model)


def _content(path: Path) -> Any:
    return json_of(path, LatticeError, finite=False)


def described(element: Element) -> dict[str, Any]:
    """An element as a definition of the file.

    Raises:
        LatticeError: numbers do not describe it.
    """
    source = element.source
    cls = type(source).__name__
    if cls not in CLASSES:
        raise LatticeError(f"'{element.name}' is of the class {cls}, which a file cannot hold")
    parameters: dict[str, Any] = {}
    values = vars(source.element)
    for key, default in blank(cls).items():
        value = values.get(key, default)
        if isinstance(value, np.ndarray):
            if not np.array_equal(value, default):
                parameters[key] = _entries(value) if cls == "Matrix" else value.tolist()
        elif isinstance(value, bool | int | float | np.number):
            if value != default:
                parameters[key] = value.item() if isinstance(value, np.number) else value
        elif callable(value) or (value is not None and type(value) is not type(default)):
            raise LatticeError(
                f"'{element.name}' has a {key} that is no number; a lattice file holds numbers"
            )
    described: dict[str, Any] = {"kind": element.kind, "class": cls, "parameters": parameters}
    nonzero = {k: v for k, v in vars(element.errors).items() if v != getattr(NO_ERRORS, k)}
    if nonzero:
        described["errors"] = nonzero
    return described


def _entries(array: Any) -> dict[str, float]:
    squeezed = array[:, 0] if array.shape == (6, 1) else array
    return {
        "".join(str(i + 1) for i in index): float(squeezed[tuple(index)])
        for index in np.argwhere(squeezed)
    }


def _with_errors(path: Path, element: Element, errors: dict[str, Any] | None) -> Element:
    if not errors:
        return element
    try:
        given: dict[str, Any] = {
            k: tuple(v) if isinstance(v, list) else v for k, v in errors.items()
        }
        return replace(element, errors=Errors(**given))
    except TypeError as error:
        raise LatticeError(
            f"'{path}': errors of '{element.name}' are unknown here ({error}); save the ring again"
        ) from error
