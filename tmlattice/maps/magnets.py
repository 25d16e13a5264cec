"""One second-order map per magnet, from OCELOT's own matrices.

OCELOT gives an element as a sequence of parts (three for a bend: entrance edge, body, exit edge),
each x -> B + R x + x^T T x. The parts are composed to second order; what lies between two magnets
(drifts, monitors, markers, cavities) is composed with the magnet that follows. So layer k is the
way from the exit of magnet k - 1 to the exit of magnet k, and the chain of layers is the ring.
"""

from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tmlattice.errors import LatticeError
from tmlattice.lattice.ring import Element, Ring
from tmlattice.maps.taylor import TaylorMap

Array = NDArray[np.float64]


@dataclass(frozen=True)
class _Quadratic:
    """x -> B + R x + x^T T x with T [out, n, n] symmetric in its last two indices, or None if 0."""

    B: Array
    R: Array
    T: Array | None

    def after(self, first: "_Quadratic") -> "_Quadratic":
        """This after `first`, to second order in x."""
        if self.T is None:
            bent = None if first.T is None else np.tensordot(self.R, first.T, 1)
            return _Quadratic(self.B + self.R @ first.B, self.R @ first.R, bent)
        fed = self.T @ first.B  # [out, n]: what the constant part feeds down, half of it
        slope = self.R + 2.0 * fed
        bent = first.R.T @ self.T @ first.R
        if first.T is not None:
            bent = bent + np.tensordot(slope, first.T, 1)
        return _Quadratic(self.B + (self.R + fed) @ first.B, slope @ first.R, bent)

    def reduced(self) -> tuple[Array, Array, Array]:
        """W0 [out], W1 [out, n], W2 [out, n (n + 1) / 2] in the reduced Kronecker order."""
        n = self.R.shape[1]
        i, j = np.triu_indices(n)
        if self.T is None:
            return self.B, self.R, np.zeros((len(self.B), len(i)))
        return self.B, self.R, np.where(i == j, 1.0, 2.0) * self.T[:, i, j]


def _identity(n: int) -> _Quadratic:
    return _Quadratic(np.zeros(n), np.eye(n), None)


def _parts(source: Any, energy: float) -> list[tuple[Array, Array, Array]]:
    """OCELOT's (B [6], R [6, 6], T [6, 6, 6]) for each part of an element."""
    from tmlattice.lattice.ocelot import SecondTM, TMTypes

    atom = source.element
    supported = source.supported_tms  # None: the family declares nothing, and takes any
    if supported is None or SecondTM in supported:
        parts = [TMTypes.ENTRANCE, TMTypes.MAIN, TMTypes.EXIT] if atom.has_edge else [TMTypes.MAIN]
        try:
            second = [SecondTM.from_element(atom, part).get_params(energy) for part in parts]
            return [(p.B.ravel(), p.get_rotated_R(), p.get_rotated_T()) for p in second]
        except (AttributeError, NotImplementedError):
            pass  # it has no second order: a linear element
    zero = np.zeros((6, 6, 6))
    linear = zip(source.B(energy), source.R(energy), strict=True)
    return [(B.ravel(), R, zero) for B, R in linear]


def _physics(source: Any) -> Hashable:
    """Equal for elements with equal maps: the class and every attribute but those for people."""
    values = vars(source.element)
    physics = tuple(values[k] for k in values if k not in ("id", "color", "params"))
    if not values.get("params") and all(isinstance(v, int | float | None) for v in physics):
        return (type(source), physics)
    return id(source)  # it holds more than numbers: a matrix, a field map


def _quadratic(element: Element, energy: float, n: int) -> _Quadratic:
    total = _identity(n)
    for B, R, T in _parts(element.source, energy):
        bent = T[:n, :n, :n]
        bent = 0.5 * (bent + bent.swapaxes(1, 2))
        part = _Quadratic(B[:n], R[:n, :n], bent if bent.any() else None)
        total = part.after(total)
    finite = np.isfinite(total.R).all() and np.isfinite(total.B).all()
    if not finite or (total.T is not None and not np.isfinite(total.T).all()):
        raise LatticeError(
            f"OCELOT's map of {element.kind} '{element.name}' is not finite; check its strengths"
        )
    return total


def element_map(element: Element, energy: float, dimension: int = 4) -> TaylorMap:
    """The second-order map of one element from OCELOT, its parts composed.

    Args:
        element: of a ring.
        energy: GeV.
        dimension: 4 for (x, px, y, py), 6 for OCELOT's (x, px, y, py, tau, p).
    """
    return TaylorMap(_quadratic(element, energy, dimension).reduced())


def way_map(elements: Sequence[Element], energy: float, dimension: int = 4) -> TaylorMap:
    """Second-order map of elements in beam order: a layer, with the drifts before its magnet.

    Args:
        elements: any, in beam order.
        energy: GeV.
        dimension: 4 or 6.
    """
    way = _identity(dimension)
    for element in elements:
        way = _quadratic(element, energy, dimension).after(way)
    return TaylorMap(way.reduced())


def layer_elements(ring: Ring) -> list[tuple[Element, ...]]:
    """For each layer the elements that it is made of: the way to its magnet, and the magnet."""
    layers: list[tuple[Element, ...]] = []
    way: list[Element] = []
    for element in ring.elements:
        way.append(element)
        if element.is_magnet:
            layers.append(tuple(way))
            way = []
    return layers


@dataclass(frozen=True)
class RingMaps:
    """The weights of a ring's chain of layers, stacked.

    Attributes:
        layers: names of the magnets, one a layer, in beam order.
        s: position of each layer's exit, m, [layer].
        W0, W1, W2: the layers, [layer, n], [layer, n, n], [layer, n, n (n + 1) / 2].
        monitors: names of the monitors in beam order.
        s_monitors: their positions, m, [monitor].
        at: the exit that each monitor hangs on: 0 is the start of the ring, k the exit of layer
            k - 1, [monitor].
        R0, R1, R2: from that exit to the reading (x, y), [monitor, 2], [monitor, 2, n],
            [monitor, 2, n (n + 1) / 2].
        closing: map from the exit of the last layer to the end of the ring.
    """

    layers: tuple[str, ...]
    s: Array
    W0: Array
    W1: Array
    W2: Array
    monitors: tuple[str, ...]
    s_monitors: Array
    at: NDArray[np.int64]
    R0: Array
    R1: Array
    R2: Array
    closing: TaylorMap

    @property
    def dimension(self) -> int:
        """Number of coordinates, 4 or 6."""
        return int(self.W0.shape[1])

    @cached_property
    def start(self) -> NDArray[np.int64]:
        """The monitors at exit k are start[k] to start[k + 1] - 1, [layer + 2]."""
        return np.searchsorted(self.at, np.arange(len(self.layers) + 2)).astype(np.int64)


def ring_maps(ring: Ring, dimension: int = 4) -> RingMaps:
    """Second-order maps of all magnets of a ring, and the read-outs of its monitors.

    Args:
        ring: at least one magnet.
        dimension: 4 for (x, px, y, py) at the nominal energy, 6 for OCELOT's six coordinates.

    Raises:
        LatticeError: a ring without magnets, or a map that is not finite.
        ValueError: another dimension.
    """
    if dimension not in (4, 6):
        raise ValueError(f"OCELOT's maps have 4 or 6 coordinates, not {dimension}")
    if not ring.magnets:
        raise LatticeError(f"'{ring.name}' has no magnet; a network needs one at least")
    known: dict[Hashable, _Quadratic] = {}  # OCELOT is asked once for equal elements
    layers: list[tuple[Array, Array, Array]] = []
    exits: list[float] = []
    readouts: list[tuple[Array, Array, Array]] = []
    at: list[int] = []
    way = _identity(dimension)
    s = 0.0
    for element in ring.elements:
        physics = _physics(element.source)
        own = known.get(physics)
        if own is None:
            own = known[physics] = _quadratic(element, ring.energy, dimension)
        s += element.length
        if element.kind == "monitor":  # read in its middle; nearly all have no length
            here = way if element.length == 0 else _half_drift(element.length, dimension).after(way)
            W0, W1, W2 = here.reduced()
            readouts.append((W0[:3:2], W1[:3:2], W2[:3:2]))
            at.append(len(layers))
        if element.is_magnet:
            layers.append(own.after(way).reduced())
            exits.append(s)
            way = _identity(dimension)
        else:
            way = own.after(way)
    W0, W1, W2 = (np.ascontiguousarray(w) for w in map(np.stack, zip(*layers, strict=True)))
    pairs = dimension * (dimension + 1) // 2
    R0, R1, R2 = np.empty((0, 2)), np.empty((0, 2, dimension)), np.empty((0, 2, pairs))
    if readouts:
        R0, R1, R2 = (np.ascontiguousarray(r) for r in map(np.stack, zip(*readouts, strict=True)))
    return RingMaps(
        layers=tuple(e.name for e in ring.magnets),
        s=np.array(exits),
        W0=W0,
        W1=W1,
        W2=W2,
        monitors=tuple(e.name for e in ring.monitors),
        s_monitors=np.array([e.s for e in ring.monitors]),
        at=np.array(at, dtype=np.int64),
        R0=R0,
        R1=R1,
        R2=R2,
        closing=TaylorMap(way.reduced()),
    )


def _half_drift(length: float, n: int) -> _Quadratic:
    matrix = np.eye(n)
    matrix[0, 1] = matrix[2, 3] = length / 2
    return _Quadratic(np.zeros(n), matrix, None)


def ring_matrix(ring: Ring) -> Array:
    """OCELOT's one-turn matrix, the product of its first-order R of every element, [4, 4].

    The truth that tunes are held against; it shares nothing with the network but OCELOT.
    """
    total = np.eye(4)
    for element in ring.elements:
        for matrix in element.source.R(ring.energy):
            total = matrix[:4, :4] @ total
    return total
