"""Xsuite's dictionary of a ring, as `xtrack.Line.from_dict` and `xtrack.Line.from_json` read it.

Monitors and correctors are those of the line's steering: `line.steering_monitors_x`, ...
"""

import json
import math
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tmlattice.files import write_json
from tmlattice.lattice.parts import Part, fields
from tmlattice.lattice.places import MAIN_ORDER, first_order
from tmlattice.lattice.plain import (
    BENDS,
    FIELDS,
    STRAIGHT,
    definitions,
    error_fields,
    part_of,
)
from tmlattice.lattice.ring import Element, Ring
from tmlattice.lattice.stated import slip

STEERING = {
    "monitor": ("steering_monitors_x", "steering_monitors_y"),
    "hcorrector": ("steering_correctors_x",),
    "vcorrector": ("steering_correctors_y",),
}
"""Lists of names by which a line knows its monitors and correctors."""


def holds(element: Element) -> tuple[str, ...]:
    """Errors for which Xsuite has a place: shifts and integrated fields of every magnet."""
    cls = type(element.source).__name__
    return ("dx", "dy", "ds", *FIELDS) if cls in STRAIGHT | BENDS else ()


def write(ring: Ring, path: Path) -> tuple[str, ...]:
    """Write plain elements as the JSON of a line; what it lacks. See `made`."""
    content, lacks = made(ring)
    write_json(path, content)
    return lacks


def made(ring: Ring) -> tuple[dict[str, Any], tuple[str, ...]]:
    """The dictionary of an `xtrack.Line` of plain elements, and what it lacks.

    Args:
        ring: of `plain`, with the errors that Xsuite `holds`.
    """
    left_out: Counter[str] = Counter()
    texts = [json.dumps(_element(element, ring, left_out)) for element in ring.elements]
    defined, line, names = definitions(ring.elements, texts)
    steering: dict[str, list[str]] = {}
    for element, name in zip(ring.elements, line, strict=True):
        for key in STEERING.get(element.kind, ()):
            if name not in steering.setdefault(key, []):
                steering[key].append(name)
    content = {
        "__class__": "Line",
        "elements": {name: json.loads(text) for name, text in defined.items()},
        "element_names": line,
        "particle_ref": {
            "mass0": 1e9 * ring.mass,
            "q0": -1.0 if ring.radiates else 1.0,
            "p0c": 1e9 * ring.energy * ring.beta,
        },
        "_extra_config": steering,
    }
    lacks = (f"{what} ({count} elements)" for what, count in left_out.items())
    return content, (*lacks, *names)


def _element(element: Element, ring: Ring, left_out: Counter[str]) -> dict[str, Any]:
    part, length = part_of(element), element.length
    if part is None:
        return _matrix(element, ring, left_out)
    number = part.number
    match part.keyword:
        case "monitor" | "drift" | "marker":
            return {"__class__": "Drift", "length": length} if length else {"__class__": "Marker"}
        case "hkicker" | "vkicker" | "kicker":
            thick = {"length": length, "isthick": True} if length else {}
            kicks = {"knl": [-number("hkick")], "ksl": [number("vkick")]}
            return {"__class__": "Multipole", **kicks, **thick}
        case "rfcavity":
            return _cavity(element, ring)
        case "solenoid":
            return {"__class__": "UniformSolenoid", "length": length, "ks": number("ks")}
        case "sbend":
            if number("h1") or number("h2"):
                left_out["curvatures of pole faces are left out"] += 1
            values = {"length": length, "angle": element.angle, "k1": number("k1"),
                      "k2": number("k2"), **_edges(part)}  # fmt: skip
            return _magnet("Bend", element, np.zeros(2), values)
    own = fields(part)
    if not length:
        own[0] += number("angle")
        values = {"hxl": number("angle"), "length": number("lrad")}
        return _magnet("Multipole", element, own, {k: v for k, v in values.items() if v})
    main = MAIN_ORDER.get(part.keyword, 1)
    values = {"length": length, f"k{main}": own[main].real, f"k{main}s": own[main].imag}
    own[main] = 0.0
    cls = part.keyword if part.keyword in MAIN_ORDER else "quadrupole"
    return _magnet(cls.capitalize(), element, length * own, values)


def _magnet(
    cls: str, element: Element, integrated: NDArray[Any], values: Mapping[str, float]
) -> dict[str, Any]:
    """An element of a class with its alignment and its integrated fields, those of its errors
    included."""
    total = integrated.astype(complex)
    total[:2] += error_fields(element)
    content: dict[str, Any] = {"__class__": cls, **values}
    for key, own in (("knl", total.real), ("ksl", total.imag)):
        if own.any() or (cls == "Multipole" and key == "knl"):
            content[key] = own.tolist()
    errors = element.errors
    moved = {"shift_x": errors.dx, "shift_y": errors.dy, "shift_s": errors.ds,
             "rot_s_rad": element.tilt}  # fmt: skip
    return {**content, **{key: value for key, value in moved.items() if value}}


def _edges(part: Part) -> dict[str, Any]:
    """Faces of a bend; and how its gradient is tracked, as by default it is in a few kicks."""
    names = {"entry": ("e1", "hgap", "fint"), "exit": ("e2", "hgap", "fintx")}
    edges: dict[str, Any] = {
        f"edge_{side}_{key}": part.number(name)
        for side, own in names.items()
        for key, name in zip(("angle", "hgap", "fint"), own, strict=True) if part.number(name)
    }  # fmt: skip
    return {**edges, **({"model": "mat-kick-mat"} if part.number("k1") else {})}


def _matrix(element: Element, ring: Ring, left_out: Counter[str]) -> dict[str, Any]:
    source = element.source
    own = type(source).__name__ == "Matrix"
    if own and (np.any(source.t) or source.delta_e):
        left_out["what matrix elements do beyond their first order is left out"] += 1
    elif not own:
        left_out["elements that Xsuite has not are written as first-order matrices"] += 1
    turn = np.diag([1.0, 1.0, 1.0, 1.0, -ring.beta, 1 / ring.beta])  # zeta = -beta tau
    matrix = turn @ first_order(source, ring.map_energy) @ np.linalg.inv(turn)
    content = {"__class__": "FirstOrderTaylorMap", "length": element.length, "m1": matrix.tolist()}
    if own and np.any(source.b):
        content["m0"] = (turn @ np.ravel(source.b)).tolist()
    return content


def _cavity(element: Element, ring: Ring) -> dict[str, Any]:
    """At the phase where nothing is lost, of the side on which the motion is stable."""
    source = element.source
    voltage, frequency = 1e9 * float(source.v), float(source.freq)
    content = {"__class__": "Cavity", "voltage": voltage, "frequency": frequency}
    if element.length:
        content["length"] = element.length
    if voltage and slip(ring) > 0:  # Xsuite takes the charge without its sign
        content["lag"] = math.degrees(math.pi)
    return content
