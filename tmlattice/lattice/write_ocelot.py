"""Writing OCELOT: a Python file with its elements and their sequence, the numbers bit for bit.

OCELOT's own writer renames elements and states no energy, so this is one of our own.
"""

import json
import re
from pathlib import Path
from typing import Any

from tmlattice.lattice.json_file import described
from tmlattice.lattice.places import source_kind
from tmlattice.lattice.ring import Ring


def write_ocelot(ring: Ring, path: Path) -> tuple[str, ...]:
    """Write plain elements as code; it lacks nothing.

    Args:
        ring: of `plain`.
        path: to write to.

    Raises:
        LatticeError: an element that numbers do not describe (a field map).
    """
    variables: dict[str, str] = {}  # what an element is, as text -> its variable
    used: dict[str, int] = {}
    code, sequence = [], []
    for element in ring.elements:
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
    told = []
    if not ring.radiates:
        told.append("the energy is that of an electron as fast as the ring's particles")
    if combined:
        told.append("magnets of several fields are tmlattice's own, which the file imports")
    # by the name that the file has: a source that comes from the cache has none
    other = sum(e.kind != source_kind(e.source, e.family) for e in ring.elements)
    if other:
        told.append(f"OCELOT's classes do not tell the kind of {other} elements")
    return tuple(told)


def _lines(variable: str, family: str, content: dict[str, Any]) -> list[str]:
    """An element, then its numbers that are not the class's own."""
    lines = [f"{variable} = {content['class']}(eid={family!r})"]
    entries = []
    for name, value in content["parameters"].items():
        if isinstance(value, dict):
            entries += _entries(variable, name, value)
        elif isinstance(value, list):
            lines.append(f"{variable}.{name} = np.array({value!r})")
        else:
            lines.append(f"{variable}.{name} = {value!r}")
    return lines + entries


def _entries(variable: str, name: str, value: dict[str, float]) -> list[str]:
    """The entries of a matrix, from nothing on."""
    lines = [f"{variable}.{name} = np.zeros_like({variable}.{name})"]
    for index, entry in value.items():
        at = ", ".join(str(int(digit) - 1) for digit in index)
        at += ", 0" if len(index) == 1 else ""  # a column
        lines.append(f"{variable}.{name}[{at}] = {entry!r}")
    return lines
