"""Strengths that may be wrong: of every powered quadrupole and sextupole, as relative changes.

OCELOT computes the map of a magnet at nine strengths. In between its coefficients are polynomials
of the change, to rounding, so that a fit moves four hundred strengths at once and has their exact
derivatives in a millisecond.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import ArrayLike, NDArray

from tmlattice.errors import TmlatticeError
from tmlattice.lattice import Element, Ring
from tmlattice.maps.magnets import LayerMaps, layer_elements, way_map

Array = NDArray[np.float64]
Weights = tuple[Array, Array, Array]

ATTRIBUTES = {"quadrupole": "k1", "sextupole": "k2"}

LARGEST = 1.5
"""Largest relative change of a strength."""

DEGREE = 8
"""Degree of the polynomials over +-LARGEST. cos(L sqrt(k)) is a series in k L^2, 0.8 at most here,
whose ninth term is below 1e-16."""


@dataclass(frozen=True)
class Strength:
    """The strength of one magnet.

    Attributes:
        layer: of the magnet.
        name: of the magnet.
        attribute: k1 or k2.
        elements: of the layer; the magnet is the last.
        energy: `Ring.map_energy`, GeV.
    """

    layer: int
    name: str
    attribute: str
    elements: tuple[Element, ...]
    energy: float

    @property
    def value(self) -> float:
        """Design strength, 1/m2 or 1/m3."""
        return float(getattr(self.elements[-1], self.attribute))

    def magnet(self, change: float) -> Element:
        """Return the magnet with a relative change of its strength."""
        return self.elements[-1].changed(**{self.attribute: self.value * (1 + change)})

    def weights(self, change: float, dimension: int = 4) -> Weights:
        """OCELOT's W0, W1, W2 of the layer with a relative change of its magnet's strength."""
        way = (*self.elements[:-1], self.magnet(change))
        W0, W1, W2 = way_map(way, self.energy, dimension).coefficients
        return W0, W1, W2


def strengths_of(ring: Ring, kinds: Sequence[str] = ("quadrupole", "sextupole")) -> list[Strength]:
    """Return the powered magnets of some kinds, in beam order.

    Raises:
        TmlatticeError: the ring has none.
    """
    found = [
        Strength(k, e[-1].name, ATTRIBUTES[e[-1].kind], e, ring.map_energy)
        for k, e in enumerate(layer_elements(ring))
        if e[-1].kind in kinds and getattr(e[-1], ATTRIBUTES[e[-1].kind]) != 0
    ]
    if not found:
        raise TmlatticeError(f"'{ring.name}' has no powered {' or '.join(kinds)} to fit")
    return found


@dataclass(frozen=True)
class RingStrengths:
    """Strengths of a ring, and the layers as functions of them.

    Attributes:
        strengths: in beam order.
        layer: of each, [strength].
        curves: Chebyshev coefficients of W0, W1, W2, [degree + 1, strength, ...].
    """

    strengths: list[Strength]
    layer: NDArray[np.int64]
    curves: Weights

    def weights(self, changes: ArrayLike) -> Weights:
        """W0, W1, W2 of the layers for relative changes [strength] within +-LARGEST."""
        return _sums(_series(changes), self.curves)

    def slopes(self, changes: ArrayLike) -> Weights:
        """Derivatives of the weights by the changes."""
        basis = _series(changes)[:-1]
        d0, d1, d2 = (np.asarray(chebyshev.chebder(c), np.float64) / LARGEST for c in self.curves)
        return _sums(basis, (d0, d1, d2))


def _series(changes: ArrayLike) -> Array:
    return np.asarray(chebyshev.chebvander(np.asarray(changes, float) / LARGEST, DEGREE).T)


def _sums(basis: Array, curves: Weights) -> Weights:
    W0, W1, W2 = (np.einsum("dj,dj...->j...", basis, c) for c in curves)
    return W0, W1, W2


def _curves(ring: Ring, strengths: Sequence[Strength], dimension: int) -> Weights:
    nodes = np.cos(np.pi * (np.arange(DEGREE + 1) + 0.5) / (DEGREE + 1))
    layers = LayerMaps(ring, dimension)  # one map for equal magnets
    at_nodes = [
        [layers.map(s.magnet(LARGEST * x)).after(layers.way(s.layer)).reduced() for s in strengths]
        for x in nodes
    ]
    to_series = np.linalg.inv(chebyshev.chebvander(nodes, DEGREE))
    stacked = (np.array([[w[i] for w in row] for row in at_nodes]) for i in range(3))
    W0, W1, W2 = (np.asarray(np.tensordot(to_series, w, 1), dtype=np.float64) for w in stacked)
    return W0, W1, W2


_kept: list[tuple[Ring, tuple[Any, ...], RingStrengths]] = []


def ring_strengths(ring: Ring, kinds: Sequence[str], dimension: int = 4) -> RingStrengths:
    """Return `strengths_of` a ring with their layers; cached for the last rings, as a study fits
    hundreds of measurements of one design."""
    key = (tuple(kinds), dimension)
    for known, known_key, found in _kept:
        if known is ring and known_key == key:
            return found
    strengths = strengths_of(ring, kinds)
    layer = np.array([s.layer for s in strengths])
    made = RingStrengths(strengths, layer, _curves(ring, strengths, dimension))
    _kept.append((ring, key, made))
    del _kept[:-4]
    return made
