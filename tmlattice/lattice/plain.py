"""A ring with errors as a ring of plain elements, for formats that know none.

What a magnet's errors do is written into what every format has: a roll is a tilt, a kick of a
corrector its angle, a thin gradient in a quadrupole its k1, in a matrix element its matrix. What
has no place there is told.
"""

import copy
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tmlattice.lattice.ring import NO_ERRORS, Element, Errors, Ring

Array = NDArray[np.float64]

_TURNS = ("quadrupole", "sextupole", "octupole", "hcorrector", "vcorrector")


def plain(ring: Ring) -> tuple[Ring, tuple[str, ...]]:
    """The ring without errors that acts most like it, and what it lacks, a sentence each."""
    changed: dict[int, Element] = {}
    told: list[str] = []
    for place, element in enumerate(ring.elements):
        if element.errors != NO_ERRORS:
            changed[place], lacks = _plain(element)
            told += lacks
    return ring.with_elements(changed), tuple(told)


def _plain(element: Element) -> tuple[Element, list[str]]:
    left: dict[str, Any] = {
        name: value
        for name, value in vars(element.errors).items()
        if value != getattr(NO_ERRORS, name)
    }
    told = []
    bare = replace(element, errors=NO_ERRORS, source=element.data or element.source)
    if element.kind in ("hcorrector", "vcorrector"):
        bare = _corrector(bare, element.errors)
        for name in ("kick_x", "kick_y", "roll"):
            left.pop(name, None)
    elif element.kind in _TURNS and "roll" in left:
        bare = bare.changed(tilt=bare.tilt + left.pop("roll"))
    if element.kind == "quadrupole" and element.length and "k1l" in left:
        bare = bare.changed(k1=bare.k1 + left.pop("k1l") / element.length)
        told.append(f"the thin gradient in the middle of {element.name} is written as its k1")
    if type(bare.source).__name__ in ("Matrix", "Marker"):
        bare = _matrix(bare, element.errors)
        for name in ("k1l", "k1sl", "entrance_k1l", "entrance", "middle"):
            left.pop(name, None)
    if left:
        told.append(
            f"{', '.join(left)} of {element.name} cannot be written; the package's own JSON holds "
            "them"
        )
    return bare, told


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
        source = elements.Matrix(l=0.0, eid=element.source.id)
        source.r = middle @ entrance
        return replace(element, kind="matrix", source=source)
    source = copy.deepcopy(element.source)
    half = np.real(sqrtm(np.asarray(source.r, dtype=float)))
    whole = np.asarray(source.r) if (middle == np.eye(6)).all() else half @ middle @ half
    source.r = whole @ entrance
    return replace(element, source=source)
