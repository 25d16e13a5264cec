"""Writing MAD-X: a sequence of elements, the names those of their families.

AT's saver of this language leaves out tilts, gaps and matrices, so this is one of our own.
"""

import math
from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from tmlattice.errors import first_of
from tmlattice.lattice.parts import Part
from tmlattice.lattice.places import first_order
from tmlattice.lattice.plain import BENDS, STRAIGHT, definitions, part_of, second_order
from tmlattice.lattice.ring import PROTON_GEV, Element, Ring

KEYWORDS = (
    "beam", "drift", "quadrupole", "sextupole", "octupole", "multipole", "solenoid",
    "sbend", "rbend", "marker", "monitor", "hmonitor", "vmonitor", "instrument",
    "hkicker", "vkicker", "kicker", "rfcavity", "matrix", "line", "sequence", "ring", "use",
    "call", "return", "value", "option", "title", "const", "real",
)  # fmt: skip
"""Words that MAD-X has a meaning for, or that the file itself uses."""


SHIFTS = ("dx", "dy", "ds")
READING = {"monitor_offset_x": "MREX", "monitor_offset_y": "MREY", "monitor_gain_x": "MSCALX",
           "monitor_gain_y": "MSCALY"}  # fmt: skip
"""Effects on monitors that EALIGN has: what is read too much, m, and relative."""
ROUNDING = 1e-6
"""m; MAD-X takes overlaps of this size for the rounding of positions, but no element of negative
length."""


def holds(element: Element) -> tuple[str, ...]:
    """Errors for which MAD-X has a place: DX, DY, DS, and in bends K0 and DPSI."""
    cls = type(element.source).__name__
    if cls in BENDS:
        upright = element.length and element.angle and not element.tilt
        return (*SHIFTS, "kick_x", "kick_y") if upright else SHIFTS
    return SHIFTS if cls in STRAIGHT else ()


def write(ring: Ring, path: Path) -> tuple[str, ...]:
    """Write plain elements; what it lacks. See `made`."""
    text, lacks = made(ring)
    path.write_text(text, encoding="utf-8")
    return lacks


def made(ring: Ring, calibration: Iterable[Any] = ()) -> tuple[str, tuple[str, ...]]:
    """A sequence of plain elements, and what it lacks.

    Args:
        ring: of `plain`, with the errors that MAD-X `holds`.
        calibration: causes in monitors, as `Diagnosis.calibration` has them; their offsets and
            gains become reading errors of EALIGN, which act in MAD-X's CORRECT.
    """
    left_out: Counter[str] = Counter()
    elements = [e for e in ring.elements if not (e.kind == "drift" and e.length <= 0)]
    texts = [_definition(e, ring.map_energy, left_out) for e in elements]
    defined, line, names = definitions(elements, texts, KEYWORDS)
    back = [e.name for e in ring.elements if e.length < -ROUNDING]
    if back:
        left_out[f"MAD-X takes no sequence that goes back, as this one at {first_of(back)}"] += 1
    lacks = [f"{what} ({count} elements)" for what, count in left_out.items()]
    particle = "ELECTRON" if ring.radiates else "PROTON"
    if not ring.radiates and abs(ring.mass / PROTON_GEV - 1) > 1e-6:
        particle = f"ION, MASS={_number(ring.mass)}, CHARGE=1"
    content = [
        f"! {Path(ring.name).name}, by tmlattice",
        f"BEAM, PARTICLE={particle}, ENERGY={_number(ring.energy)};",
        *(f"{name}: {text};" for name, text in defined.items()),
        f"ring: SEQUENCE, L={_number(ring.length)}, REFER=ENTRY;",
        *(
            f"  {name}, AT={_number(element.s - element.length / 2)};"
            for name, element in zip(line, elements, strict=True)
        ),
        "ENDSEQUENCE;",
        "USE, SEQUENCE=ring;",
    ]
    seen: Counter[str] = Counter()
    places: dict[str, str] = {}
    for name, element in zip(line, elements, strict=True):
        seen[name] += 1
        places[element.name] = f"{name}[{seen[name]}]"
    read: dict[str, list[str]] = {}  # a second EALIGN of an element undoes the first
    for cause in calibration:
        if cause.effect in READING:
            given = f"{READING[cause.effect]}={_number(cause.amount)}"
            read.setdefault(places[cause.element], []).append(given)
        else:
            lacks.append(f"{cause.effect} of {cause.element} cannot be written")
    for place, errors in read.items():
        content += ["SELECT, FLAG=ERROR, CLEAR;", f"SELECT, FLAG=ERROR, RANGE={place};",
                    f"EALIGN, {', '.join(errors)};"]  # fmt: skip
    return "\n".join([*content, ""]), (*lacks, *names)


def _number(value: float) -> str:
    return repr(float(value))


THICK = ("quadrupole", "sextupole", "octupole", "sbend")


def _text(keyword: str, values: Mapping[str, Any]) -> str:
    """A definition with those of its numbers that are not zero, and what it cannot be without."""
    needed = {"fintx", *(("l", "angle") if keyword in THICK else ())}
    items = [keyword.upper()]
    for name, value in values.items():
        if isinstance(value, list):
            items.append(f"{name.upper()}={{{', '.join(map(_number, value))}}}")
        elif value or name in needed:
            items.append(f"{name.upper()}={_number(value)}")
    return ", ".join(items)


def _definition(element: Element, energy: float, left_out: Counter[str]) -> str:
    part, source = part_of(element), element.source
    moved = {name: getattr(element.errors, name) for name in SHIFTS}
    if part is None:
        if type(source).__name__ != "Matrix":
            left_out["elements that MAD-X has not are written as first-order matrices"] += 1
        elif second_order(source):
            left_out["what matrix elements do beyond their matrix is left out"] += 1
        return _text("matrix", {"l": element.length, **_matrix(element, energy), **moved})
    keyword, values = part.keyword, dict(part.values)
    match keyword:
        case "hkicker" | "vkicker":  # of one plane
            values["kick"] = values.pop("hkick") + values.pop("vkick")
        case "multipole" if not element.length:
            keyword, values = _thin(part, left_out)
        case "quadrupole" | "sextupole" | "multipole":
            order = "2" if keyword == "sextupole" else "1"
            rest = [n for n in values if n[0] == "k" and n[1] != order]
            if any(values.pop(name) for name in rest):
                left_out["of thick magnets with several fields the main one is written"] += 1
            keyword = "sextupole" if order == "2" else "quadrupole"
        case "sbend":
            values |= _bend(element, left_out)
            if values["fintx"] == values["fint"]:
                values.pop("fintx")
    return _text(keyword, values | moved)


def _thin(part: Part, left_out: Counter[str]) -> tuple[str, dict[str, Any]]:
    """MAD-X bends its design orbit by KNL[0] and KSL[0]: what else kicks is a KICKER, alone."""
    normal, skew = (part.list(key).tolist() or [0.0] for key in ("knl", "ksl"))
    if normal[0] or skew[0]:
        if not any((part.number("angle"), *normal[1:], *skew[1:])):
            kicks = {"hkick": -normal[0], "vkick": skew[0], "tilt": part.number("tilt")}
            return "kicker", kicks
        left_out["of thin magnets with several fields the dipole field is left out"] += 1
    normal[0], skew[0] = part.number("angle"), 0.0
    own = {"lrad": part.number("lrad"), "tilt": part.number("tilt")}
    return "multipole", {**own, "knl": normal, "ksl": skew}


def _bend(element: Element, left_out: Counter[str]) -> dict[str, float]:
    """Errors of a bend's field as K0 and DPSI."""
    values: dict[str, float] = {}
    if element.tilt:
        left_out["tilts of bends turn their design plane"] += 1
    kick_x, kick_y = element.errors.kick_x, element.errors.kick_y
    if kick_y:  # K0S has no effect in MAD-X's TWISS
        values["dpsi"] = -kick_y / math.sin(element.angle)
        kick_x -= values["dpsi"] ** 2 * math.sin(element.angle) / 2
        left_out["vertical kicks of bends are written as their rolls"] += 1
    if kick_x:
        values["k0"] = (element.angle - kick_x) / element.length
    return values


def _matrix(element: Element, energy: float) -> dict[str, float]:
    """In MAD-X's coordinates: its time has the opposite sign."""
    sign = np.diag([1.0, 1.0, 1.0, 1.0, -1.0, 1.0])
    r = sign @ first_order(element.source, energy) @ sign
    return {f"rm{i + 1}{j + 1}": r[i, j] for i in range(6) for j in range(6) if r[i, j] != (i == j)}
