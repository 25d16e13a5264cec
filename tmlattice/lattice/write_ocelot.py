"""OCELOT's elements of a ring, and a Python file of them, the numbers bit for bit.

OCELOT's own writer renames elements and states no energy, so this is one of our own.
"""

import json
import re
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

from tmlattice.lattice.json_file import described
from tmlattice.lattice.places import source_kind
from tmlattice.lattice.plain import BENDS
from tmlattice.lattice.ring import NO_ERRORS, Element, Ring
from tmlattice.lattice.source import copied


def holds(element: Element) -> tuple[str, ...]:
    """Errors for which OCELOT has a place. Of tilted elements its maps turn all but the offset."""
    cls = type(element.source).__name__
    upright = not (element.tilt or element.errors.roll)
    known = cls in BENDS | {"Quadrupole", "Sextupole", "Octupole"}
    return ("dx", "dy") if known and upright else ()


def displaced(ring: Ring) -> Ring:
    """The ring with the offsets of its elements in their sources."""
    moved = {
        k: replace(e.changed(dx=e.errors.dx, dy=e.errors.dy), errors=NO_ERRORS)
        for k, e in enumerate(ring.elements)
        if e.errors != NO_ERRORS
    }
    return ring.with_elements(moved)


def made(ring: Ring) -> tuple[Any, tuple[str, ...]]:
    """OCELOT's `MagneticLattice` with elements of its own, and what it lacks.

    Args:
        ring: of `plain`, with the errors that OCELOT `holds`.
    """
    from tmlattice.lattice.ocelot import SecondTM, elements

    lattices = import_module("ocelot.cpbd.magnetic_lattice")  # after OCELOT, without its greeting
    sequence = []
    off = 0
    for element in displaced(ring).elements:
        source = copied(element.source)
        if element.kind == "cavity":  # it would accelerate the reference; a thin one has no map
            off += bool(getattr(source, "v", 0.0))
            source = elements.Drift(l=element.length) if element.length else elements.Marker()
        source.id = element.family
        sequence.append(source)
    lacks = (f"{off} cavities are off, as drifts or markers",) if off else ()
    lattice = lattices.MagneticLattice(tuple(sequence), method={"global": SecondTM})
    return lattice, (*_lacks(ring), *lacks)


def _lacks(ring: Ring) -> tuple[str, ...]:
    lacks = []
    if not ring.radiates:
        lacks.append(
            f"the energy of its maps is that of an electron as fast: {ring.map_energy:.9g} GeV"
        )
    if any(type(e.source).__name__ == "CombinedMultipole" for e in ring.elements):
        lacks.append("magnets of several fields are tmlattice's own, which is imported for them")
    # by the name that the element has there: a source that comes from the cache has none
    other = sum(e.kind != source_kind(e.source, e.family) for e in ring.elements)
    if other:
        lacks.append(f"OCELOT's classes do not state the kind of {other} elements")
    return tuple(lacks)


def write(ring: Ring, path: Path) -> tuple[str, ...]:
    """Write plain elements as code; what it lacks.

    Args:
        ring: of `plain`, with the errors that OCELOT `holds`.
        path: to write to.

    Raises:
        LatticeError: an element that numbers do not describe (a field map).
    """
    variables: dict[str, str] = {}  # what an element is, as text -> its variable
    used: dict[str, int] = {}
    code, sequence = [], []
    for element in displaced(ring).elements:
        content = described(element)
        key = json.dumps([element.family, content["class"], content["parameters"]], sort_keys=True)
        if key not in variables:
            stem = "e_" + re.sub(r"\W", "_", element.family.casefold())
            used[stem] = used.get(stem, 0) + 1
            variable = stem if used[stem] == 1 else f"{stem}__{used[stem]}"
            variables[key] = variable
            code += _lines(variable, element.family, content)
        sequence.append(variables[key])
    combined = any("CombinedMultipole" in line for line in code)
    rows = [", ".join(sequence[i : i + 8]) for i in range(0, len(sequence), 8)]
    text = [
        f'"""{Path(ring.name).name}, by tmlattice."""',
        "",
        "import numpy as np",
        "from ocelot.cpbd.elements import *",
        "",
        *(["from tmlattice.lattice.combined import CombinedMultipole", ""] if combined else []),
        f"energy = {ring.map_energy!r}",
        "",
        *code,
        "",
        "ring = [",
        *(f"    {row}," for row in rows),
        "]",
        "",
    ]
    path.write_text("\n".join(text), encoding="utf-8")
    return _lacks(ring)


def _lines(variable: str, family: str, content: dict[str, Any]) -> list[str]:
    """An element, then its numbers that are not the class's own."""
    lines = [f"{variable} = {content['class']}(eid={family!r})"]
    entries = []
    for name, value in content["parameters"].items():
        own = f"{variable}.{name}"
        if isinstance(value, dict):  # the entries of a matrix, from nothing on
            entries.append(f"{own} = np.zeros_like({own})")
            for index, entry in value.items():
                at = ", ".join(str(int(digit) - 1) for digit in index)
                at += ", 0" if len(index) == 1 else ""  # a column
                entries.append(f"{own}[{at}] = {entry!r}")
        elif isinstance(value, list):
            lines.append(f"{own} = np.array({value!r})")
        else:
            lines.append(f"{own} = {value!r}")
    return lines + entries
