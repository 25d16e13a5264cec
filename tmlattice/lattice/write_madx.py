"""Writing MAD-X: a sequence of elements, the names those of their families.

AT's saver of this language leaves out tilts, gaps and matrices, so this is one of our own.
"""

import math
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from tmlattice.errors import first_of
from tmlattice.lattice.plain import BENDS, STRAIGHT, definitions
from tmlattice.lattice.ring import PROTON_GEV, Element, Ring
from tmlattice.lattice.write_at import first_order, kicks, second_order

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


def write_madx(ring: Ring, path: Path) -> tuple[str, ...]:
    """Write plain elements; what it lacks. See `madx_text`."""
    text, told = madx_text(ring)
    path.write_text(text, encoding="utf-8")
    return told


def madx_text(ring: Ring, calibration: Iterable[Any] = ()) -> tuple[str, tuple[str, ...]]:
    """A sequence of plain elements, and what it lacks.

    Args:
        ring: of `plain`, with the errors that MAD-X `holds`.
        calibration: causes in monitors, as `Diagnosis.calibration` has them; their offsets and
            gains become reading errors of EALIGN, which act in MAD-X's CORRECT.
    """
    left_out: Counter[str] = Counter()
    elements = [e for e in ring.elements if not (e.kind == "drift" and e.length <= 0)]
    texts = [_definition(e, ring.map_energy, left_out) + _misaligned(e) for e in elements]
    made, line, names = definitions(elements, texts, KEYWORDS)
    back = [e.name for e in ring.elements if e.length < -ROUNDING]
    if back:
        left_out[f"MAD-X takes no sequence that goes back, as this one at {first_of(back)}"] += 1
    told = [f"{what} ({count} elements)" for what, count in left_out.items()]
    particle = "ELECTRON" if ring.radiates else "PROTON"
    if not ring.radiates and abs(ring.mass / PROTON_GEV - 1) > 1e-6:
        particle = f"ION, MASS={_number(ring.mass)}, CHARGE=1"
    content = [
        f"! {Path(ring.name).name}, by tmlattice",
        f"BEAM, PARTICLE={particle}, ENERGY={_number(ring.energy)};",
        *(f"{name}: {text};" for name, text in made.items()),
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
            told.append(f"{cause.effect} of {cause.element} cannot be written")
    for place, errors in read.items():
        content += ["SELECT, FLAG=ERROR, CLEAR;", f"SELECT, FLAG=ERROR, RANGE={place};",
                    f"EALIGN, {', '.join(errors)};"]  # fmt: skip
    return "\n".join([*content, ""]), (*told, *names)


def _misaligned(element: Element) -> str:
    given = ((name, getattr(element.errors, name)) for name in SHIFTS)
    return "".join(f", {name.upper()}={_number(amount)}" for name, amount in given if amount)


def _number(value: float) -> str:
    return repr(float(value))


THICK = ("QUADRUPOLE", "SEXTUPOLE", "OCTUPOLE", "SBEND")


def _with(keyword: str, **values: float) -> str:
    """A definition with those of its numbers that are not zero, and what it cannot be without."""
    needed = {"l", "angle"} if keyword in THICK else set()
    told = (f"{name.upper()}={_number(v)}" for name, v in values.items() if v or name in needed)
    return ", ".join([keyword, *told])


def _definition(element: Element, energy: float, left_out: Counter[str]) -> str:
    source, l, tilt = element.source, element.length, element.tilt  # noqa: E741
    if element.kind == "monitor":
        return _with("MONITOR", l=l)
    match type(source).__name__:
        case "Quadrupole":
            if element.k2:
                left_out["sextupole fields of quadrupoles are left out"] += 1
            return _with("QUADRUPOLE", l=l, k1=element.k1, tilt=tilt)
        case "Sextupole":
            return _with("SEXTUPOLE", l=l, k2=element.k2, tilt=tilt)
        case "Octupole":
            return _with("OCTUPOLE", l=l, k3=float(source.k3), tilt=tilt)
        case "SBend" | "RBend" | "Bend":
            return _bend(element, left_out)
        case "Hcor" | "Vcor":
            x, y = kicks(element)
            vertical = element.kind == "vcorrector"
            if x if vertical else y:
                return _with("KICKER", l=l, hkick=x, vkick=y)
            return _with("VKICKER" if vertical else "HKICKER", l=l, kick=y if vertical else x)
        case "CombinedMultipole":
            return _combined(element, left_out)
        case "Multipole" if not l:
            kn = ", ".join(_number(k) for k in np.asarray(source.kn))
            return _with("MULTIPOLE", tilt=tilt) + f", KNL={{{kn}}}"
        case "Cavity":
            return _with(
                "RFCAVITY", l=l, volt=1e3 * float(source.v), freq=1e-6 * float(source.freq)
            )
        case "Solenoid":
            return _with("SOLENOID", l=l, ks=2 * float(source.k))
        case "Drift" | "Marker" | "Monitor":
            return _with("DRIFT", l=l) if l else "MARKER"
        case "Matrix" if second_order(source):
            left_out["what matrix elements do beyond their matrix is left out"] += 1
        case "Matrix":
            pass
        case _:
            left_out["elements that MAD-X has not are written as first-order matrices"] += 1
    return _matrix(element, energy)


def _combined(element: Element, left_out: Counter[str]) -> str:
    """A thin one with all its fields, a thick one with those of its kind."""
    source, l = element.source, element.length  # noqa: E741
    normal, skew = ([float(getattr(source, f"k{n}{what}")) for n in range(3)] for what in ("", "s"))
    if not l:
        kick_x, kick_y = -normal[0], skew[0]
        if (kick_x or kick_y) and not any((element.angle, *normal[1:], *skew[1:])):
            return _with("KICKER", hkick=kick_x, vkick=kick_y, tilt=element.tilt)
        if kick_x or kick_y:  # MAD-X bends its design orbit by KNL[0] and KSL[0]
            left_out["of thin magnets with several fields the dipole field is left out"] += 1
        normal[0], skew[0] = element.angle, 0.0
        knl, ksl = (", ".join(map(_number, fields)) for fields in (normal, skew))
        lrad = float(source.lrad)
        text = _with("MULTIPOLE", lrad=lrad, tilt=element.tilt)
        return f"{text}, KNL={{{knl}}}, KSL={{{ksl}}}"
    order = 2 if element.kind == "sextupole" else 1
    rest = [k for n in range(3) if n != order for k in (normal[n], skew[n])]
    if any(rest):
        left_out["of thick magnets with several fields the main one is written"] += 1
    own = {f"k{order}": normal[order], f"k{order}s": skew[order], "tilt": element.tilt}
    return _with("SEXTUPOLE" if order == 2 else "QUADRUPOLE", l=l, **own)


def _bend(element: Element, left_out: Counter[str]) -> str:
    source = element.source
    text = _with(
        "SBEND", l=element.length, angle=element.angle, k1=element.k1, k2=element.k2,
        e1=float(source.e1), e2=float(source.e2), hgap=float(source.gap) / 2,
        fint=float(source.fint), h1=float(source.h_pole1), h2=float(source.h_pole2),
        tilt=element.tilt,
    )  # fmt: skip
    if source.fintx != source.fint:
        text += f", FINTX={_number(source.fintx)}"
    if element.tilt:
        left_out["tilts of bends turn their design plane"] += 1
    kick_x, kick_y = element.errors.kick_x, element.errors.kick_y
    if kick_y:  # K0S has no effect in MAD-X's TWISS
        roll = -kick_y / math.sin(element.angle)
        text += f", DPSI={_number(roll)}"
        kick_x -= roll**2 * math.sin(element.angle) / 2
        left_out["vertical kicks of bends are written as their rolls"] += 1
    if kick_x:
        text += f", K0={_number((element.angle - kick_x) / element.length)}"
    return text


def _matrix(element: Element, energy: float) -> str:
    """In MAD-X's coordinates: its time has the opposite sign."""
    sign: Any = np.diag([1.0, 1.0, 1.0, 1.0, -1.0, 1.0])
    r = sign @ first_order(element, energy) @ sign
    entries = [
        f"RM{i + 1}{j + 1}={_number(r[i, j])}"
        for i in range(6)
        for j in range(6)
        if r[i, j] != (i == j)
    ]
    return ", ".join([_with("MATRIX", l=element.length), *entries])
