"""The strengths that can be wrong: of every powered quadrupole and sextupole, as relative changes.

A change is known twice: exactly, as OCELOT's map of the changed magnet, and to first order, as a
direction of the layer's generator.
"""

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tmlattice.errors import TmlatticeError
from tmlattice.lattice import Element, Ring
from tmlattice.maps.magnets import layer_elements, way_map
from tmlattice.network.generators import cubic_generator, nearest_symplectic, quadratic_generator

Array = NDArray[np.float64]
Weights = tuple[Array, Array, Array]

ATTRIBUTES = {"quadrupole": "k1", "sextupole": "k2"}
STEP = 1e-3
"""Relative change for derivatives by central differences: third-order error 1e-7."""


@dataclass(frozen=True)
class Strength:
    """The strength of one magnet.

    Attributes:
        layer: of the magnet.
        name: of the magnet.
        attribute: k1 or k2.
        elements: what the layer is made of; the magnet is the last.
        energy: GeV.
    """

    layer: int
    name: str
    attribute: str
    elements: tuple[Element, ...]
    energy: float

    @property
    def value(self) -> float:
        """The design's, 1/m2 or 1/m3."""
        return float(getattr(self.elements[-1], self.attribute))

    def weights(self, change: float, dimension: int = 4) -> Weights:
        """W0, W1, W2 of the layer with its magnet's strength changed by a relative amount."""
        magnet = self.elements[-1]
        source = copy.deepcopy(magnet.source)  # the object may stand in many places
        strength = self.value * (1 + change)
        setattr(source, self.attribute, strength)
        changed = replace(magnet, source=source, **{self.attribute: strength})  # type: ignore[arg-type]
        W0, W1, W2 = way_map((*self.elements[:-1], changed), self.energy, dimension).coefficients
        return W0, W1, W2


def strengths_of(ring: Ring, kinds: Sequence[str] = ("quadrupole", "sextupole")) -> list[Strength]:
    """The powered magnets of some kinds, in beam order.

    Raises:
        TmlatticeError: the ring has none.
    """
    found = [
        Strength(k, e[-1].name, ATTRIBUTES[e[-1].kind], e, ring.energy)
        for k, e in enumerate(layer_elements(ring))
        if e[-1].kind in kinds and getattr(e[-1], ATTRIBUTES[e[-1].kind]) != 0
    ]
    if not found:
        raise TmlatticeError(f"'{ring.name}' has no powered {' or '.join(kinds)} to fit")
    return found


def slopes(strengths: Sequence[Strength], dimension: int = 4) -> Weights:
    """Derivatives of the layers' W0, W1, W2 by the relative changes, stacked over strengths."""
    pairs = [(s.weights(STEP, dimension), s.weights(-STEP, dimension)) for s in strengths]
    d0, d1, d2 = (
        np.stack([(up[i] - down[i]) / (2 * STEP) for up, down in pairs]) for i in range(3)
    )
    return d0, d1, d2


def directions(strengths: Sequence[Strength], dimension: int = 4) -> Array:
    """What a relative change adds to the layer's generator, to first order: [strength,
    coefficient]."""
    rows = []
    for strength in strengths:
        up, down, design = (strength.weights(c, dimension) for c in (STEP, -STEP, 0.0))
        matrix = (up[1] - down[1]) / (2 * STEP) @ np.linalg.inv(design[1])
        W1, W2 = (np.stack([up[i], down[i]]) for i in (1, 2))
        cubic = cubic_generator(nearest_symplectic(W1), W2)
        rows.append(quadratic_generator(matrix) + (cubic[0] - cubic[1]) / (2 * STEP))
    return np.stack(rows)


@dataclass(frozen=True)
class RingStrengths:
    """The strengths of a ring with their derivatives.

    Attributes:
        strengths: in beam order.
        slopes: see `slopes`.
        directions: see `directions`, [strength, coefficient].
    """

    strengths: list[Strength]
    slopes: Weights
    directions: Array


_kept: list[tuple[Ring, tuple[Any, ...], RingStrengths]] = []


def ring_strengths(ring: Ring, kinds: Sequence[str], dimension: int = 4) -> RingStrengths:
    """`strengths_of` a ring with their derivatives; kept for the last rings asked for, as a study
    fits hundreds of measurements of one design."""
    key = (tuple(kinds), dimension)
    for known, known_key, found in _kept:
        if known is ring and known_key == key:
            return found
    strengths = strengths_of(ring, kinds)
    made = RingStrengths(strengths, slopes(strengths, dimension), directions(strengths, dimension))
    _kept.append((ring, key, made))
    del _kept[:-4]
    return made
