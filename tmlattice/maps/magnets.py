"""One second-order map per magnet, from OCELOT's own matrices.

OCELOT gives an element as a sequence of parts (three for a bend: entrance edge, body, exit edge),
each x -> B + R x + x^T T x. The parts are composed to second order; what lies between two magnets
(drifts, monitors, markers, cavities) is composed with the magnet that follows. So layer k is the
way from the exit of magnet k - 1 to the exit of magnet k, and the chain of layers is the ring.
"""

import functools
import io
from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tmlattice import cache
from tmlattice.errors import LatticeError
from tmlattice.lattice.ring import KEPT, NO_ERRORS, Element, Ring, Slopes
from tmlattice.maps.taylor import TaylorMap

Array = NDArray[np.float64]


@functools.cache
def _pairs(n: int) -> tuple[NDArray[np.intp], NDArray[np.intp], Array]:
    """Rows and columns of the pairs i <= j of n coordinates, and how often each stands in T."""
    i, j = np.triu_indices(n)
    return i, j, np.where(i == j, 1.0, 2.0)


@dataclass(frozen=True)
class Quadratic:
    """x -> B + R x + x^T T x with T [out, n, n] symmetric in its last two indices, or None if 0."""

    B: Array
    R: Array
    T: Array | None

    def after(self, first: "Quadratic") -> "Quadratic":
        """This after `first`, to second order in x."""
        if self.T is None:
            bent = None if first.T is None else _on_rows(self.R, first.T)
            return Quadratic(self.B + self.R @ first.B, self.R @ first.R, bent)
        fed = self.T @ first.B  # [out, n]: what the constant part feeds down, half of it
        slope = self.R + 2.0 * fed
        bent = first.R.T @ self.T @ first.R
        if first.T is not None:
            bent = bent + _on_rows(slope, first.T)
        return Quadratic(self.B + (self.R + fed) @ first.B, slope @ first.R, bent)

    def reduced(self) -> tuple[Array, Array, Array]:
        """W0 [out], W1 [out, n], W2 [out, n (n + 1) / 2] in the reduced Kronecker order."""
        i, j, _ = _pairs(self.R.shape[1])
        if self.T is None:
            return self.B, self.R, np.zeros((len(self.B), len(i)))
        return self.B, self.R, _pairs(self.R.shape[1])[2] * self.T[:, i, j]


FAINT = 3e-4
"""rad; below, OCELOT's map of a bend with k2 has lost a hundredth of its second order to rounding
(k2 terms are differences over powers of the curvature; at 1e-5 they are 1000 times too large)."""


def _on_rows(matrix: Array, T: Array) -> Array:
    """`np.tensordot(matrix, T, 1)`, whose checks cost more than the product."""
    rows, n = len(T), T.shape[-1]
    return (matrix @ T.reshape(rows, n * n)).reshape(-1, n, n)


def _identity(n: int) -> Quadratic:
    return Quadratic(np.zeros(n), np.eye(n), None)


Part = tuple[Array, Array, Array]

ASKED = 5_000
"""Elements' parts that are remembered, some 20 MB: a scan asks for each in many hypotheses."""

_asked: dict[Hashable, list[Part]] = {}


def _parts(element: Element, energy: float, split: bool) -> list[Part]:
    """OCELOT's (B [6], R [6, 6], T [6, 6, 6]) for each part of an element: do not change them.

    With `split` the body comes as two halves, in the middle of the list.
    """
    physics = _physics(element)
    if isinstance(physics, int):
        return _parts_of_ocelot(element.source, energy, split)
    known = _asked.get((physics, energy, split))
    if known is None:
        if len(_asked) > ASKED:
            _asked.clear()
        known = _asked[physics, energy, split] = _parts_of_ocelot(element.source, energy, split)
    return known


def _parts_of_ocelot(source: Any, energy: float, split: bool) -> list[Part]:
    from tmlattice.lattice.ocelot import SecondTM, TMTypes, elements

    atom = source.element
    supported = source.supported_tms  # None: the family declares nothing, and takes any
    bare = isinstance(source, elements.Matrix)  # OCELOT does not know its inside
    body = [(TMTypes.MAIN, atom.l / 2)] * 2 if split and not bare else [(TMTypes.MAIN, None)]
    edges = [(TMTypes.ENTRANCE, None)], [(TMTypes.EXIT, None)]
    parts = [*edges[0], *body, *edges[1]] if atom.has_edge else body
    if supported is None or SecondTM in supported:
        try:
            second = [SecondTM.from_element(atom, *part).get_params(energy) for part in parts]
            return [(p.B.ravel(), *_tilted(p.R, p.T, p.tilt)) for p in second]
        except (AttributeError, NotImplementedError):
            pass  # it has no second order: a linear element
    zero = np.zeros((6, 6, 6))
    linear = zip(source.B(energy), source.R(energy), strict=True)
    return [(B.ravel(), R, zero) for B, R in linear]


def _tilted(R: Array, T: Array, tilt: float) -> tuple[Array, Array]:
    """R and T in axes that are turned by the tilt: what OCELOT's `get_rotated_R` and `_T` say.

    The latter is compiled when first called, which takes longer than all maps of a ring.
    """
    if tilt == 0:
        return R, T
    from tmlattice.lattice.ocelot import rot_mtx

    there, back = rot_mtx(tilt), rot_mtx(-tilt)
    return back @ R @ there, np.tensordot(back, there.T @ T @ there, 1)


def _physics(element: Element) -> Hashable:
    """Equal for elements with equal maps, but for their errors: the class and every attribute of
    the source but those for people."""
    if element.data is not None:
        return element.data
    source = element.source
    values = vars(source.element)
    physics = tuple(values[k] for k in values if k not in ("id", "color", "params"))
    if not values.get("params") and all(isinstance(v, _NUMBERS) for v in physics):
        return (type(source), physics)
    return id(source)  # it holds more than numbers: a matrix, a field map


_NUMBERS = (int, float, type(None))


def _of_ocelot(part: Part, n: int) -> Quadratic:
    B, R, T = part
    bent = T[:n, :n, :n]
    bent = 0.5 * (bent + bent.swapaxes(1, 2))
    return Quadratic(B[:n], R[:n, :n], bent if bent.any() else None)


def _quadratic(element: Element, energy: float, n: int) -> Quadratic:
    errors = element.errors
    if element.kind == "bend" and element.k2 and abs(element.angle) < FAINT:
        raise LatticeError(
            f"bend '{element.name}' bends by {element.angle:g} rad and has k2: OCELOT's map of it "
            f"is wrong below {FAINT:g} rad; make it a sextupole and a corrector"
        )
    if element.kind == "cavity":  # what it gives depends on the turn: that is the beam's
        element = _empty(element)
    if errors == NO_ERRORS:
        total = _chain(_of_ocelot(part, n) for part in _parts(element, energy, False))
    else:
        first, second = _halves(element, energy, n)
        total = _chain(
            [
                _thin(n, k1l=errors.entrance_k1l, slopes=errors.entrance),
                _shift(n, -errors.dx, -errors.dy),
                _turn(n, errors.roll),
                first,
                _thin(n, errors.kick_x, errors.kick_y, errors.k1l, errors.k1sl, errors.middle),
                _loss(n, errors.loss, element),
                second,
                _turn(n, -errors.roll),
                _shift(n, errors.dx, errors.dy),
            ]
        )
    finite = np.isfinite(total.R).all() and np.isfinite(total.B).all()
    if not finite or (total.T is not None and not np.isfinite(total.T).all()):
        raise LatticeError(
            f"OCELOT's map of {element.kind} '{element.name}' is not finite; check its strengths"
        )
    return total


def _empty(element: Element) -> Element:
    """The same element as a drift."""
    from tmlattice.lattice.ocelot import elements

    return replace(element, source=elements.Drift(l=element.length))


def _chain(parts: Iterable[Quadratic | None]) -> Quadratic:
    """The parts in beam order, composed; None moves nothing."""
    given = [part for part in parts if part is not None]
    total = given[0]
    for part in given[1:]:
        total = part.after(total)
    return total


def _halves(element: Element, energy: float, n: int) -> tuple[Quadratic, Quadratic]:
    """The maps to and from the middle of an element's body."""
    if element.length == 0:  # as thin as what is put into it
        parts = [_of_ocelot(part, n) for part in _parts(element, energy, False)]
        return _identity(n), _chain(parts)
    parts = [_of_ocelot(part, n) for part in _parts(element, energy, True)]
    middle = len(parts) // 2
    if len(parts) % 2 == 0:
        return _chain(parts[:middle]), _chain(parts[middle:])
    from scipy.linalg import sqrtm

    body = parts[middle]  # of a bare matrix, or of a cavity: it comes in one piece
    root = np.array(np.real(sqrtm(body.R)), dtype=np.float64)
    back: Array = np.linalg.inv(root).astype(np.float64)
    first = Quadratic(np.zeros(n), root, None)
    second = body.after(Quadratic(np.zeros(n), back, None))
    return _chain([*parts[:middle], first]), _chain([second, *parts[middle + 1 :]])


def _thin(
    n: int,
    kick_x: float = 0.0,
    kick_y: float = 0.0,
    k1l: float = 0.0,
    k1sl: float = 0.0,
    slopes: Slopes = NO_ERRORS.middle,
) -> Quadratic | None:
    """px += kick_x - k1l x + k1sl y, py += kick_y + k1l y + k1sl x, and what the slopes say."""
    if kick_x == kick_y == k1l == k1sl == 0 and not any(slopes):
        return None
    B, R = np.zeros(n), np.eye(n)
    B[1], B[3] = kick_x, kick_y
    R[1, 0], R[3, 2] = -k1l, k1l
    R[1, 2] = R[3, 0] = k1sl
    R[np.ix_([1, 3], [0, 2])] += np.reshape(slopes, (2, 2))
    return Quadratic(B, R, None)


def _shift(n: int, dx: float, dy: float) -> Quadratic | None:
    if dx == dy == 0:
        return None
    B = np.zeros(n)
    B[0], B[2] = dx, dy
    return Quadratic(B, np.eye(n), None)


def _turn(n: int, roll: float) -> Quadratic | None:
    """Coordinates in axes that are turned by `roll` from x towards y."""
    if roll == 0:
        return None
    R = np.eye(n)
    cos, sin = np.cos(roll), np.sin(roll)
    R[0, 0] = R[1, 1] = R[2, 2] = R[3, 3] = cos
    R[0, 2] = R[1, 3] = sin
    R[2, 0] = R[3, 1] = -sin
    return Quadratic(np.zeros(n), R, None)


def _loss(n: int, loss: float, element: Element) -> Quadratic | None:
    """The energy falls by loss (1 + p)^2; the slopes stay, so the momenta fall with it."""
    if loss == 0:
        return None
    if n != 6:
        raise LatticeError(
            f"{element.kind} '{element.name}' loses energy, which four coordinates cannot hold; "
            "take six (dimension=6)"
        )
    B, R = np.zeros(n), np.eye(n)
    B[5] = -loss
    R[5, 5] = 1 - 2 * loss
    R[1, 1] = R[3, 3] = 1 - loss
    return Quadratic(B, R, None)


def element_map(element: Element, energy: float, dimension: int = 4) -> TaylorMap:
    """The second-order map of one element from OCELOT, its parts composed.

    Args:
        element: of a ring.
        energy: GeV.
        dimension: 4 for (x, px, y, py), 6 for OCELOT's (x, px, y, py, tau, p).
    """
    return TaylorMap(_quadratic(element, energy, dimension).reduced())


def part_maps(element: Element, energy: float, dimension: int = 4) -> list[TaylorMap]:
    """OCELOT's second-order maps of an element's parts: the body, or edge, body and edge.

    Args:
        element, energy, dimension: see `element_map`.
    """
    parts = _parts(element, energy, False)
    return [TaylorMap(_of_ocelot(part, dimension).reduced()) for part in parts]


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


Weights = tuple[Array, Array, Array]


KNOWN = 20_000
"""Maps that are remembered, some 40 MB: more than a large ring has different elements."""


class LayerMaps:
    """The layers of one ring, made one by one, also with some elements replaced.

    Elements with equal physics share one map, and what was asked of OCELOT once is kept, so that a
    hypothesis or a shot's settings cost only the layers that they touch.

    Args:
        ring: at least one magnet.
        dimension: 4 for (x, px, y, py) at the nominal energy, 6 for OCELOT's six coordinates.

    Attributes:
        layer_of: the layer whose map holds each element; the number of layers for those behind the
            last magnet, [element].

    Raises:
        LatticeError: a ring without magnets, or a map that is not finite.
        ValueError: another dimension.
    """

    def __init__(self, ring: Ring, dimension: int = 4) -> None:
        if dimension not in (4, 6):
            raise ValueError(f"OCELOT's maps have 4 or 6 coordinates, not {dimension}")
        if not ring.magnets:
            raise LatticeError(f"'{ring.name}' has no magnet; a network needs one at least")
        self.ring = ring
        self.dimension = dimension
        magnet = np.array([element.is_magnet for element in ring.elements])
        self.layer_of = np.concatenate([[0], np.cumsum(magnet)[:-1]])
        self._first = np.searchsorted(self.layer_of, np.arange(len(ring.magnets) + 2))
        self._known: dict[Hashable, Quadratic] = {}
        self._kept: list[Any] = []
        self._ways: dict[int, Quadratic] = {}
        self._equal: dict[Hashable, Quadratic] = {}
        self._layers: dict[Hashable, tuple[Weights, list[Weights]]] = {}

    @staticmethod
    def physics(element: Element) -> tuple[Hashable, Hashable]:
        """Equal for elements with equal maps."""
        return (_physics(element), element.errors)

    def map(self, element: Element) -> Quadratic:
        """The map of one element, of this ring or not."""
        key = self.physics(element)
        known = self._known.get(key)
        if known is None:
            if len(self._known) > KNOWN:  # a fit asks for ever new amounts
                self._known.clear()
                self._kept.clear()
            known = self._known[key] = _quadratic(element, self.ring.energy, self.dimension)
            if isinstance(key[0], int):  # an id: its source must not be freed
                self._kept.append(element.source)
        return known

    def first_element(self, k: int) -> int:
        """The place in `ring.elements` of the first element of layer k."""
        return int(self._first[k])

    def way(self, k: int) -> Quadratic:
        """From the exit of layer k - 1 to the entrance of its magnet; one object for equal ways."""
        if k not in self._ways:
            between = self.ring.elements[self._first[k] : self._first[k + 1] - 1]
            moving = [e for e in between if _moves(e)]
            physics = tuple(self.physics(e) for e in moving)
            if physics not in self._equal:
                parts = [self.map(e) for e in moving]
                self._equal[physics] = _chain([_identity(self.dimension), *parts])
            self._ways[k] = self._equal[physics]
        return self._ways[k]

    def layer(
        self, k: int, replaced: Mapping[int, Element] | None = None
    ) -> tuple[Weights, list[Weights]]:
        """The weights of layer k, and the read-outs of the monitors before its magnet: do not
        change them, equal layers share them.

        Args:
            k: up to the number of layers, which names the way from the last magnet to the end.
            replaced: other elements at places of the ring.
        """
        first, last = self._first[k : k + 2]
        own = self.ring.elements[first:last]
        if replaced:
            return self._composed([replaced.get(first + i, e) for i, e in enumerate(own)])
        physics = tuple((self.physics(e), e.kind == "monitor") for e in own)
        if physics not in self._layers:
            self._layers[physics] = self._composed(own)
        return self._layers[physics]

    def _composed(self, elements: Iterable[Element]) -> tuple[Weights, list[Weights]]:
        way = _identity(self.dimension)
        readouts = []
        for element in elements:
            if element.kind == "monitor":  # read in its middle; nearly all have no length
                half = element.length / 2
                here = _drift(half, self.dimension).after(way) if half else way
                W0, W1, W2 = here.reduced()
                readouts.append((W0[:3:2], W1[:3:2], W2[:3:2]))
            if _moves(element):
                way = self.map(element).after(way)
        return way.reduced(), readouts


def _moves(element: Element) -> bool:
    """False for what is thin and empty."""
    thin = element.kind in ("monitor", "marker") and element.length == 0
    return not thin or element.errors != NO_ERRORS


def ring_maps(ring: Ring, dimension: int = 4, layers: LayerMaps | None = None) -> RingMaps:
    """Second-order maps of all magnets of a ring, and the read-outs of its monitors.

    Args:
        ring: at least one magnet.
        dimension: 4 for (x, px, y, py) at the nominal energy, 6 for OCELOT's six coordinates.
        layers: the same ring's, where they are at hand already.

    Raises:
        LatticeError: a ring without magnets, or a map that is not finite.
        ValueError: another dimension.
    """
    key = cache.key("maps", ring.memory[KEPT], dimension) if KEPT in ring.memory else None
    content = cache.load(key) if key else None
    if content is not None:
        return _read(ring, content)
    maps = _made(ring, dimension, LayerMaps(ring, dimension) if layers is None else layers)
    if key:
        cache.save(key, _written(maps))
    return maps


_KEPT = ("s", "W0", "W1", "W2", "s_monitors", "at", "R0", "R1", "R2")


def _written(maps: RingMaps) -> bytes:
    content = io.BytesIO()
    np.savez(content, *maps.closing.coefficients, **{name: getattr(maps, name) for name in _KEPT})
    return content.getvalue()


def _read(ring: Ring, content: bytes) -> RingMaps:
    with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
        return RingMaps(
            layers=tuple(e.name for e in ring.magnets),
            monitors=tuple(e.name for e in ring.monitors),
            closing=TaylorMap([arrays[f"arr_{degree}"] for degree in range(3)]),
            **{name: arrays[name] for name in _KEPT},
        )


def _made(ring: Ring, dimension: int, layers: LayerMaps) -> RingMaps:
    magnets = ring.magnets
    weights: list[Weights] = []
    readouts: list[Weights] = []
    at: list[int] = []
    for k in range(len(magnets) + 1):
        own, read = layers.layer(k)
        weights.append(own)
        readouts += read
        at += [k] * len(read)
    ends = np.cumsum([element.length for element in ring.elements])
    exits = ends[[i for i, element in enumerate(ring.elements) if element.is_magnet]]
    *chain, closing = weights
    W0, W1, W2 = (np.ascontiguousarray(w) for w in map(np.stack, zip(*chain, strict=True)))
    pairs = dimension * (dimension + 1) // 2
    R0, R1, R2 = np.empty((0, 2)), np.empty((0, 2, dimension)), np.empty((0, 2, pairs))
    if readouts:
        R0, R1, R2 = (np.ascontiguousarray(r) for r in map(np.stack, zip(*readouts, strict=True)))
    return RingMaps(
        layers=tuple(e.name for e in magnets),
        s=exits,
        W0=W0,
        W1=W1,
        W2=W2,
        monitors=tuple(e.name for e in ring.monitors),
        s_monitors=np.array([e.s for e in ring.monitors]),
        at=np.array(at, dtype=np.int64),
        R0=R0,
        R1=R1,
        R2=R2,
        closing=TaylorMap(closing),
    )


def _drift(length: float, n: int) -> Quadratic:
    matrix = np.eye(n)
    matrix[0, 1] = matrix[2, 3] = length
    return Quadratic(np.zeros(n), matrix, None)


def ring_matrix(ring: Ring) -> Array:
    """OCELOT's one-turn matrix, the product of its first-order R of every element, [4, 4].

    The truth that tunes are held against; it shares nothing with the network but OCELOT. Where an
    element has `errors`, its linear map about the design axis stands in.
    """
    total = np.eye(4)
    known: dict[Hashable, list[Array]] = {}
    for element in ring.elements:
        if element.errors != NO_ERRORS or element.kind == "cavity":
            total = _quadratic(element, ring.energy, 6).R[:4, :4] @ total
            continue
        physics = _physics(element)
        if physics not in known:
            known[physics] = [matrix[:4, :4] for matrix in element.source.R(ring.energy)]
        for matrix in known[physics]:
            total = matrix @ total
    return total
