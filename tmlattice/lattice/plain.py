"""A ring with errors as a ring of plain elements, and what writers of other formats share.

What a magnet's errors do is written into what every format has: a roll is a tilt, a kick of a
corrector its angle, thin gradients in a quadrupole its k1 and tilt, in a matrix element its matrix.
A format that has more (misalignments, field errors) names what it holds; the rest is stated.

A writer takes elements as the readers make them, in MAD-X's words (`part_of`), and has its own
names for these.
"""

import cmath
import copy
import re
from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from tmlattice.arrays import Array
from tmlattice.errors import first_of
from tmlattice.lattice.parts import Part
from tmlattice.lattice.ring import NO_ERRORS, Element, Errors, Ring
from tmlattice.speaks import listed

_TURNS = ("quadrupole", "sextupole", "octupole")
_NO_FIELD = ("drift", "monitor", "cavity", "hcorrector", "vcorrector")
"""Kinds that are the same wherever their axis is."""
STRAIGHT = frozenset({"Quadrupole", "Sextupole", "Octupole", "CombinedMultipole", "Multipole"})
BENDS = frozenset({"SBend", "RBend", "Bend"})
"""OCELOT's classes, as a writer finds them in an element's source."""
FIELDS = ("kick_x", "kick_y", "k1l", "k1sl")
"""Errors that are dipole and quadrupole fields."""

Holds = Callable[[Element], Collection[str]]
"""The errors of an element that a format has a place for."""


NAMED = 4
"""Elements that a sentence names."""


def plain(ring: Ring, holds: Holds = lambda element: ()) -> tuple[Ring, tuple[str, ...]]:
    """The ring that acts most like it without errors but those that a format holds, and what it
    lacks, a sentence each.

    Args:
        ring: with its errors.
        holds: which of an element's errors the writer writes itself.
    """
    changed: dict[int, Element] = {}
    affected: dict[str, list[str]] = {}
    for place, element in enumerate(ring.elements):
        if element.errors != NO_ERRORS:
            changed[place], lacks = _plain(element, holds(element))
            for what in lacks:
                affected.setdefault(what, []).append(element.name)
    return ring.with_elements(changed), tuple(
        w.replace("{}", listed(n, NAMED)) for w, n in affected.items()
    )


def error_fields(element: Element) -> tuple[complex, complex]:
    """Dipole and quadrupole fields among an element's errors: integrated k_n + i k_ns, in the axes
    of its tilt."""
    e = element.errors
    dipole, gradient = complex(-e.kick_x, e.kick_y), complex(e.k1l, e.k1sl)
    turn = cmath.exp(1j * element.tilt)
    return dipole * turn, gradient * turn**2


def part_of(element: Element) -> Part | None:
    """An element without its errors in MAD-X's words; None of one that is a matrix everywhere."""
    source, length = element.source, element.length
    keyword, values = "drift" if length else "marker", dict[str, Any]()

    def own(names: str) -> dict[str, Any]:
        return {name: float(getattr(source, name)) for name in names.split()}

    if element.kind == "monitor":
        return Part(element.family, "monitor", {"l": length})
    match type(source).__name__:
        case "Quadrupole":
            keyword, values = element.kind, own("k1 k2 tilt")
        case "Sextupole":
            keyword, values = "sextupole", own("k2 tilt")
        case "Octupole":
            keyword, values = "octupole", own("k3 tilt")
        case "CombinedMultipole" if length:
            keyword, values = element.kind, own("k0 k0s k1 k1s k2 k2s tilt")
        case "CombinedMultipole":
            keyword, values = "multipole", own("angle lrad tilt")
            normal, skew = own("k0 k1 k2"), own("k0s k1s k2s")
            values |= {"knl": [*normal.values()], "ksl": [*skew.values()]}
        case "Multipole" if not length:
            keyword, values = "multipole", {"knl": np.array(source.kn, float), **own("tilt")}
        case "SBend" | "RBend" | "Bend":
            keyword, values = "sbend", own("angle k1 k2 e1 e2 fint fintx tilt")
            values |= {"hgap": source.gap / 2, "h1": source.h_pole1, "h2": source.h_pole2}
        case "Hcor" | "Vcor":
            keyword = "hkicker" if element.kind == "hcorrector" else "vkicker"
            kick = element.angle * cmath.exp(1j * element.tilt)
            x, y = (k if abs(k) > 1e-12 * abs(kick) else 0.0 for k in (kick.real, kick.imag))
            if y if keyword == "hkicker" else x:
                keyword = "kicker"
            values = {"hkick": x, "vkick": y}
        case "Cavity":
            keyword = "rfcavity"
            values = {"volt": 1e3 * float(source.v), "freq": 1e-6 * float(source.freq)}
        case "Solenoid":
            keyword, values = "solenoid", {"ks": 2 * float(source.k)}
        case "Drift" | "Marker" | "Monitor":
            pass
        case _:
            return None
    return Part(element.family, keyword, {"l": length, **values})


def second_order(source: Any) -> bool:
    """Whether a matrix element does more than its matrix."""
    return bool(np.any(source.t) or np.any(source.b) or source.delta_e)


def definitions(
    elements: Sequence[Element], texts: Sequence[str], reserved: Collection[str] = ()
) -> tuple[dict[str, str], list[str], list[str]]:
    """Definitions by name, the name of each element's, and what differs from the ring's names.

    A definition is named for its family. Members of a family that differ have names of their own,
    `qd..12` for `qd::12`.

    Args:
        elements: in beam order.
        texts: what each is in the format.
        reserved: words that are no names.
    """
    kinds: dict[str, dict[str, int]] = {}
    for element, text in zip(elements, texts, strict=True):
        known = kinds.setdefault(element.family.casefold(), {})
        known.setdefault(text, len(known))
    made: dict[str, str] = {}
    line = []
    several = set()
    for element, text in zip(elements, texts, strict=True):
        family = element.family.casefold()
        name = _name(family, reserved)
        if len(kinds[family]) > 1 and element.kind == "drift":
            name += f"..{kinds[family][text]}"
        elif len(kinds[family]) > 1:
            name = _name(element.name.casefold().replace("::", ".."), reserved)
            several.add(family)
        while made.setdefault(name, text) != text:  # names that differ in odd characters
            name += "_"
        line.append(name)
    if not several:
        return made, line, []
    some = first_of(sorted(several), NAMED)
    return made, line, [f"members of {some} differ, and have names of their own: NAME..k for "
                        "NAME::k"]  # fmt: skip


def _name(family: str, reserved: Collection[str]) -> str:
    name = re.sub(r"[^a-z0-9_.]", "_", family)
    return f"e_{name}" if name in reserved or not name[:1].isalpha() else name


def _plain(element: Element, held: Collection[str]) -> tuple[Element, list[str]]:
    """The element without errors but those that are held, and sentences about what that lacks, its
    name as {}."""
    errors = element.errors
    left: dict[str, Any] = {
        name: value for name, value in vars(errors).items() if value != getattr(NO_ERRORS, name)
    }
    lacks = []
    bare = replace(element, errors=NO_ERRORS, source=element.data or element.source)
    if element.is_corrector:
        bare = _corrector(bare, errors)
        for name in ("kick_x", "kick_y", "roll"):
            left.pop(name, None)
    if element.kind in _NO_FIELD:
        for name in ("dx", "dy"):
            left.pop(name, None)
    if element.kind == "quadrupole" and element.length and (errors.k1l or errors.k1sl):
        bare = _quadrupole(bare, errors)
        lacks.append("thin gradients in the middle of {} are written as fields of their bodies")
        for name in ("k1l", "k1sl"):
            left.pop(name, None)
    if element.kind in _TURNS and "roll" in left and "roll" not in held:
        roll = left.pop("roll")
        bare = bare.changed(tilt=bare.tilt + roll)
        own = replace(NO_ERRORS, **{name: left.pop(name) for name in FIELDS if name in left})
        kick = complex(own.kick_x, own.kick_y) * cmath.exp(1j * roll)
        gradient = complex(own.k1l, own.k1sl) * cmath.exp(-2j * roll)
        turned = (kick.real, kick.imag, gradient.real, gradient.imag)
        left |= {name: v for name, v in zip(FIELDS, turned, strict=True) if v}
    if type(bare.source).__name__ in ("Matrix", "Marker"):
        bare = _matrix(bare, errors)
        for name in ("k1l", "k1sl", "entrance_k1l", "entrance", "middle"):
            left.pop(name, None)
    kept = {name: left.pop(name) for name in [*left] if name in held}
    lacks += [f"{name} of {{}} cannot be written; the package's own JSON holds it" for name in left]
    return replace(bare, errors=replace(NO_ERRORS, **kept)), lacks


def _quadrupole(element: Element, errors: Errors) -> Element:
    """Its gradient with thin ones, normal and skew, spread over its length, as k1 and a tilt.

    Tilted by t it has the normal part k1 cos 2t and the skew one k1s = -k1 sin 2t.
    """
    double = 2 * element.tilt
    normal = element.k1 * np.cos(double) + errors.k1l / element.length
    skew = element.k1 * np.sin(double) - errors.k1sl / element.length
    along = normal * np.cos(double) + skew * np.sin(double)
    across = skew * np.cos(double) - normal * np.sin(double)
    if abs(across) < 1e-12 * abs(along):
        return element.changed(k1=float(along))
    size = float(np.hypot(along, across)) * (1 if along >= 0 else -1)
    turn = float(np.arctan2(across * np.sign(size), abs(along))) / 2
    return element.changed(k1=size, tilt=element.tilt + turn)


def _corrector(element: Element, errors: Errors) -> Element:
    """Its kick and what it kicks beyond that, as one kick of its own direction."""
    x = element.angle * np.cos(element.tilt) + errors.kick_x
    y = element.angle * np.sin(element.tilt) + errors.kick_y
    own = element.tilt
    if abs(y * np.cos(own) - x * np.sin(own)) > 1e-9 * np.hypot(x, y):
        own = float(np.arctan2(y, x))
    angle = float(x * np.cos(own) + y * np.sin(own))
    return element.changed(angle=angle, tilt=own + errors.roll)


def _thin(k1l: float, k1sl: float, slopes: tuple[float, ...]) -> Array:
    """A thin kick that is linear in the beam's place, [6, 6]."""
    kick = np.eye(6)
    kick[1, 0], kick[1, 2], kick[3, 0], kick[3, 2] = slopes
    kick[1, 0] -= k1l
    kick[3, 2] += k1l
    kick[1, 2] += k1sl
    kick[3, 0] += k1sl
    return kick


def _matrix(element: Element, errors: Errors) -> Element:
    """A matrix element with its thin kicks inside; a marker becomes one."""
    from scipy.linalg import sqrtm

    from tmlattice.lattice.ocelot import elements

    entrance = _thin(errors.entrance_k1l, 0.0, errors.entrance)
    middle = _thin(errors.k1l, errors.k1sl, errors.middle)
    if type(element.source).__name__ == "Marker":
        source = elements.Matrix(l=0.0, eid=element.family)
        source.r = middle @ entrance
        return replace(element, kind="matrix", source=source)
    source = copy.deepcopy(element.source)
    half = np.real(sqrtm(np.asarray(source.r, dtype=float)))
    whole = np.asarray(source.r) if (middle == np.eye(6)).all() else half @ middle @ half
    source.r = whole @ entrance
    return replace(element, source=source)
