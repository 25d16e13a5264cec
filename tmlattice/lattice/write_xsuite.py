"""Xsuite's dictionary of a ring, as `xtrack.Line.from_dict` and `xtrack.Line.from_json` read it.

Monitors and correctors are those of the line's steering: `line.steering_monitors_x`, ...
"""

import json
import math
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tmlattice.files import write_json
from tmlattice.lattice.plain import BENDS, FIELDS, STRAIGHT, definitions, error_fields
from tmlattice.lattice.ring import Element, Ring
from tmlattice.lattice.stated import slip
from tmlattice.lattice.write_at import first_order, kicks, second_order

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


def write_xsuite(ring: Ring, path: Path) -> tuple[str, ...]:
    """Write plain elements as the JSON of a line; what it lacks. See `line_of`."""
    content, told = line_of(ring)
    write_json(path, content)
    return told


def line_of(ring: Ring) -> tuple[dict[str, Any], tuple[str, ...]]:
    """The dictionary of an `xtrack.Line` of plain elements, and what it lacks.

    Args:
        ring: of `plain`, with the errors that Xsuite `holds`.
    """
    left_out: Counter[str] = Counter()
    texts = [json.dumps(_element(element, ring, left_out)) for element in ring.elements]
    made, line, names = definitions(ring.elements, texts)
    steering: dict[str, list[str]] = {}
    for element, name in zip(ring.elements, line, strict=True):
        for key in STEERING.get(element.kind, ()):
            if name not in steering.setdefault(key, []):
                steering[key].append(name)
    content = {
        "__class__": "Line",
        "elements": {name: json.loads(text) for name, text in made.items()},
        "element_names": line,
        "particle_ref": {
            "mass0": 1e9 * ring.mass,
            "q0": -1.0 if ring.radiates else 1.0,
            "p0c": 1e9 * ring.energy * ring.beta,
        },
        "_extra_config": steering,
    }
    told = (f"{what} ({count} elements)" for what, count in left_out.items())
    return content, (*told, *names)


def _element(element: Element, ring: Ring, left_out: Counter[str]) -> dict[str, Any]:
    source, length = element.source, element.length
    if element.kind == "monitor":
        return _passive(length)
    own = type(source).__name__
    match own:
        case "Quadrupole" | "Sextupole":
            order = 1 if own == "Quadrupole" else 2
            knl = [0.0, 0.0, 0.0 if order == 2 else element.k2 * length]
            main: Any = {f"k{order}": element.k1 if order == 1 else element.k2}
            return _magnet(own, element, knl, length=length, **main)
        case "Octupole":
            return _magnet("Octupole", element, [], length=length, k3=float(source.k3))
        case "SBend" | "RBend" | "Bend":
            return _bend(element, left_out)
        case "Hcor" | "Vcor":
            x, y = kicks(element)
            thick = {"length": length, "isthick": True} if length else {}
            return {"__class__": "Multipole", "knl": [-x], "ksl": [y], **thick}
        case "CombinedMultipole":
            return _combined(element)
        case "Multipole" if not length:
            return _magnet("Multipole", element, [float(k) for k in source.kn])
        case "Cavity":
            return _cavity(element, ring)
        case "Solenoid":
            return {"__class__": "UniformSolenoid", "length": length, "ks": 2 * float(source.k)}
        case "Drift" | "Marker" | "Monitor":
            return _passive(length)
        case "Matrix":
            if second_order(source) and (np.any(source.t) or source.delta_e):
                left_out["what matrix elements do beyond their first order is left out"] += 1
        case _:
            left_out["elements that Xsuite has not are written as first-order matrices"] += 1
    turn = np.diag([1.0, 1.0, 1.0, 1.0, -ring.beta, 1 / ring.beta])  # zeta = -beta tau
    matrix = turn @ first_order(element, ring.map_energy) @ np.linalg.inv(turn)
    content = {"__class__": "FirstOrderTaylorMap", "length": length, "m1": matrix.tolist()}
    if own == "Matrix" and np.any(source.b):
        content["m0"] = (turn @ np.ravel(source.b)).tolist()
    return content


def _passive(length: float) -> dict[str, Any]:
    return {"__class__": "Drift", "length": length} if length else {"__class__": "Marker"}


def _magnet(
    cls: str, element: Element, normal: Sequence[float], skew: Sequence[float] = (), **values: Any
) -> dict[str, Any]:
    """An element of a class with its alignment and its integrated fields, those of its errors
    included."""
    fields = np.zeros(max(len(normal), 2), dtype=complex)
    fields[: len(normal)] += normal
    fields[: len(skew)] += 1j * np.asarray(skew, dtype=float)
    fields[:2] += error_fields(element)
    content: dict[str, Any] = {"__class__": cls, **values}
    for key, own in (("knl", fields.real), ("ksl", fields.imag)):
        if own.any() or (cls == "Multipole" and key == "knl"):
            content[key] = own.tolist()
    errors = element.errors
    moved = {"shift_x": errors.dx, "shift_y": errors.dy, "shift_s": errors.ds,
             "rot_s_rad": element.tilt}  # fmt: skip
    return {**content, **{key: value for key, value in moved.items() if value}}


def _combined(element: Element) -> dict[str, Any]:
    """A thin one with its bend, or a thick one of the class of its kind."""
    source, length = element.source, element.length
    normal, skew = ([float(getattr(source, f"k{n}{what}")) for n in range(3)] for what in ("", "s"))
    if not length:
        normal[0] += element.bending
        return _magnet("Multipole", element, normal, skew, hxl=element.bending,
                       length=float(source.lrad))  # fmt: skip
    order = 2 if element.kind == "sextupole" else 1
    main: Any = {f"k{order}": normal[order], f"k{order}s": skew[order]}
    normal, skew = ([0.0 if n == order else length * k for n, k in enumerate(own)]
                    for own in (normal, skew))  # fmt: skip
    cls = "Sextupole" if order == 2 else "Quadrupole"
    return _magnet(cls, element, normal, skew, length=length, **main)


def _bend(element: Element, left_out: Counter[str]) -> dict[str, Any]:
    source = element.source
    if source.h_pole1 or source.h_pole2:
        left_out["curvatures of pole faces are left out"] += 1
    edges: dict[str, Any] = {
        f"edge_{side}_{key}": float(value)
        for side, e, fint in (("entry", source.e1, source.fint), ("exit", source.e2, source.fintx))
        for key, value in (("angle", e), ("hgap", source.gap / 2), ("fint", fint))
        if value
    }
    if element.k1:  # else its gradient is in a few kicks
        edges["model"] = "mat-kick-mat"
    return _magnet("Bend", element, [], length=element.length, angle=element.angle,
                   k1=element.k1, k2=element.k2, **edges)  # fmt: skip


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
