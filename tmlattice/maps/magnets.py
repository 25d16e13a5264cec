"""One second-order map per magnet, from OCELOT's own matrices.

The elements between two magnets (drifts, monitors, markers, cavities) are composed with the magnet
that follows. So layer k leads from the exit of magnet k - 1 to the exit of magnet k, and the chain
of layers is the ring.
"""

import io
from collections.abc import Hashable, Iterable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import groupby
from typing import Any

import numpy as np

from tmlattice import cache
from tmlattice.arrays import Array, Indices
from tmlattice.by_name import by_name
from tmlattice.errors import LatticeError
from tmlattice.lattice.ring import KEPT, NO_ERRORS, Element, Errors, Ring
from tmlattice.maps.quadratic import (
    Quadratic,
    Weights,
    drift,
    identity,
    of_ocelot,
    parts_of,
    physics_of,
    quadratic_map,
    quadratic_maps,
    stacked,
)
from tmlattice.maps.taylor import TaylorMap


def element_map(element: Element, energy: float, dimension: int = 4) -> TaylorMap:
    """Return the second-order map of one element from OCELOT, its parts composed.

    Args:
        energy: GeV.
        dimension: 4 for (x, px, y, py), 6 for OCELOT's (x, px, y, py, tau, p).
    """
    return TaylorMap(quadratic_map(element, energy, dimension).reduced())


def part_maps(element: Element, energy: float) -> list[TaylorMap]:
    """Return OCELOT's second-order maps of an element's parts: the body, or edge, body and edge
    (energy: GeV)."""
    return [TaylorMap(of_ocelot(part, 4).reduced()) for part in parts_of(element, energy, False)]


@dataclass(frozen=True)
class RingMaps:
    """The weights of a ring's chain of layers, stacked.

    Attributes:
        layers: names of the magnets, one a layer, in beam order.
        s: position of each layer's exit, m, [layer].
        W0, W1, W2: the layers, [layer, n], [layer, n, n], [layer, n, n (n + 1) / 2].
        monitors: names of the monitors in beam order.
        s_monitors: their positions, m, [monitor].
        at: the exit of each monitor's state: 0 is the start of the ring, k the exit of layer k - 1,
            [monitor].
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
    at: Indices
    R0: Array
    R1: Array
    R2: Array
    closing: TaylorMap

    @property
    def dimension(self) -> int:
        """Number of coordinates, 4 or 6."""
        return int(self.W0.shape[1])

    @cached_property
    def start(self) -> Indices:
        """The monitors at exit k are start[k] to start[k + 1] - 1, [layer + 2]."""
        return np.searchsorted(self.at, np.arange(len(self.layers) + 2)).astype(np.int64)


MAPS = ("maps",)
"""Where the `memory` of a ring's layers has its `RingMaps`."""
KNOWN = 20_000
"""Maps, and layers, in memory, some 40 MB: more than a large ring has different ones."""


class LayerMaps:
    """Layers of one ring, made one by one, also with replaced elements.

    Equal elements share one map, and every map of OCELOT is cached, so that a hypothesis or a
    shot's settings cost only the layers that they change.

    Args:
        ring: at least one magnet.
        dimension: 4 for (x, px, y, py) at the nominal energy, 6 for OCELOT's six coordinates.

    Attributes:
        layer_of: the layer whose map holds each element; the number of layers for those behind the
            last magnet, [element].
        origin: the layers that these were changed from, and the indices of the changed elements; or
            None.
        memory: cache of results from these maps.

    Raises:
        LatticeError: a ring without magnets, or a map that is not finite.
        ValueError: another dimension.
    """

    def __init__(self, ring: Ring, dimension: int = 4) -> None:
        if dimension not in (4, 6):
            raise ValueError(f"OCELOT's maps have 4 or 6 coordinates, not {dimension}")
        if not ring.magnets:
            raise LatticeError(f"'{ring.name}' has no magnet; a network needs at least one")
        self.ring = ring
        self.dimension = dimension
        magnet = np.array([element.is_magnet for element in ring.elements])
        self.layer_of = np.concatenate([[0], np.cumsum(magnet)[:-1]])
        self._first = np.searchsorted(self.layer_of, np.arange(len(ring.magnets) + 2))
        self._known: dict[Hashable, Quadratic] = {}
        self._kept: list[Any] = []
        self._ways: dict[int, tuple[Quadratic, list[Weights]]] = {}
        self._equal: dict[Hashable, tuple[Quadratic, list[Weights]]] = {}
        self.origin: tuple[LayerMaps, tuple[int, ...]] | None = None
        self.memory: dict[Hashable, Any] = {}

    def changed_to(self, ring: Ring) -> tuple["LayerMaps", list[int]]:
        """Return the layers of a ring with other elements in the same places, and indices of the
        changed ones; the cache is shared."""
        own = self.ring.elements
        pairs = zip(own, ring.elements, strict=True)
        places = [i for i, (a, b) in enumerate(pairs) if a is not b]
        other = copy(self)
        other.ring = ring
        other.origin = (self, tuple(places))
        other.memory = {}
        moving = [i for i in places if not _both_at_rest(own[i], ring.elements[i])]
        self.maps([ring.elements[i] for i in moving])  # together
        # a changed way is like no other
        changed = {int(self.layer_of[i]) for i in moving if not own[i].is_magnet}
        ways = {k: other._composed(ring.elements[i] for i in self._ahead(k)) for k in changed}
        other._ways = {**self._ways, **ways}
        return other, sorted({int(self.layer_of[i]) for i in moving})

    @classmethod
    def of(cls, ring: Ring, dimension: int) -> "LayerMaps":
        """Return the layers of a ring, remembered with it: for a design, which many models share.

        Raises:
            LatticeError: see `LayerMaps`.
        """
        return ring.remembered(("layers", dimension), lambda: cls(ring, dimension))

    def __getstate__(self) -> dict[str, Any]:
        """Without what is remembered, which is large and made again."""
        return {**vars(self), "memory": {}}

    @staticmethod
    def physics(element: Element) -> tuple[Hashable, Hashable]:
        """Key that is equal for elements with equal maps."""
        return (physics_of(element), element.errors)

    def map(self, element: Element) -> Quadratic:
        """Return the map of one element, of this ring or not."""
        return self.maps([element])[0]

    def maps(self, elements: Sequence[Element]) -> list[Quadratic]:
        """Return the maps of elements; together they take a fraction of the time."""
        if len(self._known) > KNOWN:  # a fit asks for ever new amounts
            self._known.clear()
            self._equal.clear()
            self._kept.clear()  # no entry by id is left
        keys = [self.physics(element) for element in elements]
        fresh = {
            key: element
            for key, element in zip(keys, elements, strict=True) if key not in self._known
        }  # fmt: skip
        if fresh:
            found = quadratic_maps(list(fresh.values()), self.ring.map_energy, self.dimension)
            self._known.update(zip(fresh, found.each(), strict=True))
            # an id: keep its source alive
            self._kept += [e.source for key, e in fresh.items() if isinstance(key[0], int)]
        return [self._known[key] for key in keys]

    def first_element(self, k: int) -> int:
        """Index in `ring.elements` of the first element of layer k."""
        return int(self._first[k])

    def way(self, k: int) -> Quadratic:
        """Return the map from the exit of layer k - 1 to its magnet; equal ones are one object."""
        return self._between(k)[0]

    def _between(self, k: int) -> tuple[Quadratic, list[Weights]]:
        """The way to the magnet of layer k, and the read-outs of the monitors there; read-only."""
        if k not in self._ways:
            own = [self.ring.elements[i] for i in self._ahead(k)]
            own = [element for element in own if _moves(element) or element.kind == "monitor"]
            physics = tuple((self.physics(e), e.kind == "monitor") for e in own)
            if physics not in self._equal:
                self._equal[physics] = self._composed(own)
            self._ways[k] = self._equal[physics]
        return self._ways[k]

    def _ahead(self, k: int) -> range:
        """Indices of the elements before the magnet of layer k."""
        first, last = self._first[k : k + 2]
        return range(first, last - (k < len(self.ring.magnets)))

    def layer(
        self, k: int, replaced: Mapping[int, Element] | None = None
    ) -> tuple[Weights, list[Weights]]:
        """Return the weights of layer k, and the read-outs of the monitors before its magnet.

        Args:
            k: up to the number of layers, which means the drift from the last magnet to the end.
            replaced: other elements by index in the ring.
        """
        given, ahead = replaced or {}, self._ahead(k)
        if any(i in given for i in ahead):
            own = (given.get(i, self.ring.elements[i]) for i in ahead)
            way, readouts = self._composed(own)
        else:
            way, readouts = self._between(k)
        if k < len(self.ring.magnets):
            magnet = given.get(ahead.stop, self.ring.elements[ahead.stop])
            way = self.map(magnet).after(way)
        return way.reduced(), readouts

    def weights(self, layers: Sequence[int]) -> Weights:
        """Return the weights of layers with magnets, stacked; see `layer`."""
        maps, ways = self.maps([self.ring.magnets[k] for k in layers]), map(self.way, layers)
        n = self.dimension
        return stacked(maps, n).after(stacked(list(ways), n)).reduced()

    def readouts(self, k: int) -> list[Weights]:
        """Return the read-outs of the monitors before the magnet of layer k; read-only."""
        return self._between(k)[1]

    def _composed(self, elements: Iterable[Element]) -> tuple[Quadratic, list[Weights]]:
        at = self.dimension, self.ring.map_energy
        way = identity(self.dimension)
        readouts = []
        for drifts, run in groupby(elements, _drifts):
            if drifts:  # decks cut some straight sections into hundreds
                way = drift(sum(element.length for element in run), *at).after(way)
                continue
            for element in run:
                if element.kind == "monitor":  # read in its middle; nearly all are thin
                    half = element.length / 2
                    here = drift(half, *at).after(way) if half else way
                    W0, W1, W2 = here.reduced()
                    readouts.append((W0[:3:2], W1[:3:2], W2[:3:2]))
                if _moves(element):
                    way = self.map(element).after(way)
        return way, readouts


def _both_at_rest(one: Element, other: Element) -> bool:
    """Whether two elements are one corrector at zero setting differing in position or roll alone.
    A fit of a response changes these for all correctors, and no map."""
    return (
        one.is_corrector
        and one.angle == other.angle == 0
        and (one.data or one.source) is (other.data or other.source)
        and all(e == Errors(ds=e.ds, roll=e.roll) for e in (one.errors, other.errors))
    )


def _drifts(element: Element) -> bool:
    """Whether an element is a drift alone."""
    return element.kind == "drift" and element.errors == NO_ERRORS


def _moves(element: Element) -> bool:
    """Whether an element is more than an empty thin one."""
    thin = element.kind in ("monitor", "marker") and element.length == 0
    return not thin or element.errors != NO_ERRORS


@by_name
def ring_maps(ring: Ring, dimension: int = 4, layers: LayerMaps | None = None) -> RingMaps:
    """Return the second-order maps of all magnets of a ring, and the read-outs of its monitors.

    Args:
        ring: at least one magnet.
        dimension: 4 for (x, px, y, py) at the nominal energy, 6 for OCELOT's six coordinates.
        layers: of the same ring, if available; they remember the maps.

    Raises:
        LatticeError: a ring without magnets, or a map that is not finite.
        ValueError: another dimension.
    """
    if layers is not None and MAPS in layers.memory:
        remembered: RingMaps = layers.memory[MAPS]
        return remembered
    key = cache.key("maps", ring.memory[KEPT], dimension) if KEPT in ring.memory else None
    maps = cache.load(key, partial(_read, ring, dimension)) if key else None
    if maps is None:
        maps = _made(ring, dimension, LayerMaps(ring, dimension) if layers is None else layers)
        if key:
            content = io.BytesIO()
            stacks = {name: getattr(maps, name) for name in _KEPT}
            np.savez(content, *maps.closing.coefficients, **stacks)
            cache.save(key, content.getvalue())
    if layers is not None:
        layers.memory[MAPS] = maps
    return maps


def changed_maps(maps: RingMaps, layers: LayerMaps, touched: Sequence[int]) -> RingMaps:
    """Return a ring's maps with some of its layers recomputed.

    Args:
        maps: of a ring that differs from that of `layers` in the touched layers alone.
        touched: layers, up to their number, which means the drift from the last magnet to the end.
    """
    arrays = {name: getattr(maps, name).copy() for name in ("W0", "W1", "W2", "R0", "R1", "R2")}
    end = len(maps.layers)
    magnets = [k for k in touched if k < end]
    if magnets:
        for name, weights in zip(("W0", "W1", "W2"), layers.weights(magnets), strict=True):
            arrays[name][magnets] = weights
    for k in touched:
        for m, readout in enumerate(layers.readouts(k), maps.start[k]):
            for name, value in zip(("R0", "R1", "R2"), readout, strict=True):
                arrays[name][m] = value
    closing = TaylorMap(layers.layer(end)[0]) if end in touched else maps.closing
    return replace(maps, closing=closing, **arrays)


_KEPT = ("s", "W0", "W1", "W2", "s_monitors", "at", "R0", "R1", "R2")


def _read(ring: Ring, dimension: int, content: bytes) -> RingMaps:
    with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
        maps = RingMaps(
            layers=tuple(e.name for e in ring.magnets),
            monitors=tuple(e.name for e in ring.monitors),
            closing=TaylorMap([arrays[f"arr_{degree}"] for degree in range(3)]),
            **{name: arrays[name] for name in _KEPT},
        )
    magnets, monitors = len(maps.layers), len(maps.monitors)
    orders = (dimension,), (dimension, dimension), (dimension, dimension * (dimension + 1) // 2)
    shapes = [(magnets,)] + [(magnets, *order) for order in orders]
    shapes += [(monitors,)] * 2 + [(monitors, 2, *order[1:]) for order in orders]
    for name, shape in zip(_KEPT, shapes, strict=True):
        cache.check_form(getattr(maps, name), shape, magnets + 1 if name == "at" else None)
    for own, shape in zip(maps.closing.coefficients, orders, strict=True):
        cache.check_form(own, shape)
    return maps


def _made(ring: Ring, dimension: int, layers: LayerMaps) -> RingMaps:
    magnets = ring.magnets
    read = [layers.readouts(k) for k in range(len(magnets) + 1)]
    ends = np.cumsum([element.length for element in ring.elements])
    exits = ends[[i for i, element in enumerate(ring.elements) if element.is_magnet]]
    W0, W1, W2 = layers.weights(range(len(magnets)))
    pairs = dimension * (dimension + 1) // 2
    R0, R1, R2 = np.empty((0, 2)), np.empty((0, 2, dimension)), np.empty((0, 2, pairs))
    if any(read):
        every = (own for some in read for own in some)
        R0, R1, R2 = (np.array(own) for own in zip(*every, strict=True))
    return RingMaps(
        layers=tuple(e.name for e in magnets),
        s=exits,
        W0=W0,
        W1=W1,
        W2=W2,
        monitors=tuple(e.name for e in ring.monitors),
        s_monitors=np.array([e.s for e in ring.monitors]),
        at=np.repeat(np.arange(len(read)), [len(own) for own in read]),
        R0=R0,
        R1=R1,
        R2=R2,
        closing=TaylorMap(layers.layer(len(magnets))[0]),
    )


def ring_matrix(ring: Ring) -> Array:
    """Return OCELOT's one-turn matrix, the product of its R of every element, [4, 4].

    It is the reference of tunes and shares nothing with the network but OCELOT. An element with
    `errors` has its linear map at the design axis.
    """
    total = np.eye(4)
    known: dict[Hashable, list[Array]] = {}
    for element in ring.elements:
        if element.errors != NO_ERRORS or element.kind == "cavity":
            total = quadratic_map(element, ring.map_energy, 6).R[:4, :4] @ total
            continue
        physics = physics_of(element)
        if physics not in known:
            known[physics] = [matrix[:4, :4] for matrix in element.source.R(ring.map_energy)]
        for matrix in known[physics]:
            total = matrix @ total
    return total
