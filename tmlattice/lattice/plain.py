"""A ring with errors as a ring of plain elements, for formats that know none.

What a magnet's errors do is written into what every format has: a roll is a tilt, a kick of a
corrector its angle, thin gradients in a quadrupole its k1 and tilt, in a matrix element its matrix.
What has no place there is told.
"""

import copy
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tmlattice.lattice.ring import NO_ERRORS, Element, Errors, Ring

Array = NDArray[np.float64]

_TURNS = ("quadrupole", "sextupole", "octupole")


NAMED = 4
"""Elements that a sentence names."""


def plain(ring: Ring) -> tuple[Ring, tuple[str, ...]]:
    """The ring without errors that acts most like it, and what it lacks, a sentence each."""
    changed: dict[int, Element] = {}
    told: dict[str, list[str]] = {}
    for place, element in enumerate(ring.elements):
        if element.errors != NO_ERRORS:
            changed[place], lacks = _plain(element)
            for what in lacks:
                told.setdefault(what, []).append(element.name)
    return ring.with_elements(changed), tuple(w.replace("{}", _some(n)) for w, n in told.items())


def _some(names: list[str]) -> str:
    more = len(names) - NAMED
    return ", ".join(names[:NAMED]) + (f" and {more} more" if more > 0 else "")


def _plain(element: Element) -> tuple[Element, list[str]]:
    """The element without errors, and sentences about what that lacks, its name as {}."""
    errors = element.errors
    left: dict[str, Any] = {
        name: value for name, value in vars(errors).items() if value != getattr(NO_ERRORS, name)
    }
    told = []
    bare = replace(element, errors=NO_ERRORS, source=element.data or element.source)
    if element.kind in ("hcorrector", "vcorrector"):
        bare = _corrector(bare, errors)
        for name in ("kick_x", "kick_y", "roll"):
            left.pop(name, None)
    if element.kind == "quadrupole" and element.length and (errors.k1l or errors.k1sl):
        bare = _quadrupole(bare, errors)
        told.append("thin gradients in the middle of {} are written as fields of their bodies")
        for name in ("k1l", "k1sl"):
            left.pop(name, None)
    if element.kind in _TURNS and "roll" in left:
        bare = bare.changed(tilt=bare.tilt + left.pop("roll"))
    if type(bare.source).__name__ in ("Matrix", "Marker"):
        bare = _matrix(bare, errors)
        for name in ("k1l", "k1sl", "entrance_k1l", "entrance", "middle"):
            left.pop(name, None)
    told += [f"{name} of {{}} cannot be written; the package's own JSON holds it" for name in left]
    return bare, told


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
