"""Directions of effects in the space of a network's weights.

An effect of the ring changes the map of its element's layer. The derivative of that layer's weights
by the amount, evaluated at the state at the layer's entrance, is the effect's kick on the
trajectory at the layer's exit. If the element is no magnet (a marker), monitors may read between it
and the exit: then their read-outs change too.

The derivatives are central differences of the layers' own maps. `LayerMaps` caches every map of
OCELOT, so that equal magnets cost one.
"""

import io
from collections.abc import Collection, Hashable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from tmlattice import cache
from tmlattice.arrays import Array, Indices
from tmlattice.effects.effect import FamilyEffect, Hypothesis, RingEffect, find
from tmlattice.lattice import Element, Ring
from tmlattice.lattice.ring import KEPT
from tmlattice.maps import LayerMaps
from tmlattice.maps.quadratic import Quadratic, Weights, quadratic_maps, slopes, stacked

STEP = 1e-3
"""Step of differences over the largest fault: their error is STEP^2 of an effect's nonlinearity."""


@dataclass(frozen=True)
class Directions:
    """Derivatives of weights by the amounts of hypotheses; members of a family have a row each.

    Attributes:
        hypotheses: (effect, place), effects of the ring only.
        owner, layer: the hypothesis and the layer of each row, [row].
        D0, D1, D2: d weights / d amount, [row, n], [row, n, n], [row, n, n (n + 1) / 2].
        read_owner, monitor: the same for rows that move a read-out, [read].
        E0, E1, E2: d read-out / d amount, [read, 2], [read, 2, n], [read, 2, n (n + 1) / 2].
    """

    hypotheses: tuple[Hypothesis, ...]
    owner: Indices
    layer: Indices
    D0: Array
    D1: Array
    D2: Array
    read_owner: Indices
    monitor: Indices
    E0: Array
    E1: Array
    E2: Array

    def replaced(self, which: Sequence[int], fresh: "Directions") -> "Directions":
        """Return the directions with rows of hypotheses `which` replaced by those of `fresh`."""
        owner = np.array(which, dtype=np.int64)
        keep = ~np.isin(self.owner, owner)
        keep_read = ~np.isin(self.read_owner, owner)
        joined = {
            name: np.concatenate([getattr(self, name)[kept], getattr(fresh, name)])
            for names, kept in (
                (("layer", "D0", "D1", "D2"), keep),
                (("monitor", "E0", "E1", "E2"), keep_read),
            )
            for name in names
        }
        return Directions(
            hypotheses=self.hypotheses,
            owner=np.concatenate([self.owner[keep], owner[fresh.owner]]),
            read_owner=np.concatenate([self.read_owner[keep_read], owner[fresh.read_owner]]),
            **joined,
        )


MANY = 100
"""Number of hypotheses from which directions are stored in the cache folder."""


def kept_directions(layers: LayerMaps, hypotheses: Sequence[Hypothesis]) -> Directions:
    """Return `directions` in a ring as in its file, from the user's cache folder if they were
    computed before."""
    file = layers.ring.memory.get(KEPT)
    if file is None or len(hypotheses) < MANY:
        return directions(layers, hypotheses)
    key = cache.key("directions", file, layers.dimension, tuple(hypotheses))
    kept = cache.load(key, partial(_read, layers, hypotheses))
    if kept is not None:
        return kept
    found = directions(layers, hypotheses)
    written = io.BytesIO()
    np.savez(written, **{name: getattr(found, name) for name in ARRAYS})
    cache.save(key, written.getvalue())
    return found


def _read(layers: LayerMaps, hypotheses: Sequence[Hypothesis], content: bytes) -> Directions:
    with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
        kept = Directions(tuple(hypotheses), **arrays)
    n, magnets, monitors = layers.dimension, len(layers.ring.magnets), len(layers.ring.monitors)
    orders = (), (n,), (n * (n + 1) // 2,)
    for owner, place, below, weights, first in (
        (kept.owner, kept.layer, magnets + 1, (kept.D0, kept.D1, kept.D2), n),
        (kept.read_owner, kept.monitor, monitors, (kept.E0, kept.E1, kept.E2), 2),
    ):
        rows = len(owner)
        cache.check_form(owner, (rows,), len(hypotheses))
        cache.check_form(place, (rows,), below)
        for own, order in zip(weights, orders, strict=True):
            cache.check_form(own, (rows, first, *order))
    return kept


REMEMBERED = 20_000
"""Hypotheses whose directions are in the memory of a ring's maps: more than one scan has. Beyond,
the oldest are removed."""


def directions_nearby(layers: LayerMaps, hypotheses: Sequence[Hypothesis]) -> Directions:
    """Return `directions`, cached with the maps; of changed maps only those of changed elements are
    computed anew."""
    key = ("directions", tuple(hypotheses))
    if key not in layers.memory:
        if layers.origin is None:
            found = directions(layers, hypotheses)
        else:
            origin, places = layers.origin
            found = directions_nearby(origin, hypotheses)
            again = sitting_on(origin.ring, layers.ring, hypotheses, places)
            if again:
                found = found.replaced(again, directions(layers, [hypotheses[i] for i in again]))
        layers.memory[key] = found
        own = [
            name for name in layers.memory if isinstance(name, tuple) and name[0] == "directions"
        ]
        while len(own) > 1 and sum(len(name[1]) for name in own) > REMEMBERED:
            del layers.memory[own.pop(0)]
    remembered: Directions = layers.memory.pop(key)
    layers.memory[key] = remembered  # the latest
    return remembered


def sitting_on(
    before: Ring, after: Ring, hypotheses: Sequence[Hypothesis], places: Collection[int]
) -> list[int]:
    """Indices of hypotheses on elements that differ, in one of two rings.

    Args:
        before: caches the places of hypotheses.
        after: the same ring but for some elements.
        hypotheses: (effect, place), effects of the ring only.
        places: indices of these elements.
    """
    key = ("sitting on", tuple(hypotheses))
    if key not in before.memory:
        at: dict[int, list[int]] = {}
        families = []
        for i, (name, place) in enumerate(hypotheses):
            effect = ring_effect(name)
            for member in effect.members(before, place):
                at.setdefault(member, []).append(i)
            if isinstance(effect, FamilyEffect):
                families.append((i, effect, place))
        before.memory[key] = (at, families)
    at, families = before.memory[key]
    found = {i for place in places for i in at.get(place, ())}
    changed = set(places)  # members of a family may be off in one of the rings
    found |= {i for i, effect, place in families
              if not changed.isdisjoint(effect.members(after, place))}  # fmt: skip
    return sorted(found)


def ring_effect(name: str) -> RingEffect:
    """Return the effect of this name, which acts on the ring.

    Raises:
        TypeError: it does not act on the ring.
    """
    effect = find(name)
    if not isinstance(effect, RingEffect):
        raise TypeError(f"{name} does not act on the ring")
    return effect


def directions(layers: LayerMaps, hypotheses: Sequence[Hypothesis]) -> Directions:
    """Return the directions of effects in the weights of a ring's layers.

    Args:
        layers: of the ring, with its settings.
        hypotheses: (effect, place); see `Effect.places`.
    """
    ring, n = layers.ring, layers.dimension
    ends: list[Element] = []
    steps: list[float] = []
    known: dict[Hashable, int | None] = {}  # index of the derivative of an element's map
    pairs: dict[tuple[int, int], int] = {}  # of a derivative and the way to the element
    ways: list[Quadratic] = []
    magnets: list[tuple[int, int, int]] = []  # owner, layer, pair
    others: list[tuple[int, int, int, float, list[Element]]] = []
    rows: list[_Row] = []
    reads: list[_Row] = []
    first_monitor = np.concatenate([[0], np.cumsum([e.kind == "monitor" for e in ring.elements])])
    for owner, (name, place) in enumerate(hypotheses):
        effect = ring_effect(name)
        h = STEP * effect.largest
        for member in effect.members(ring, place):
            element = ring.elements[member]
            k = int(layers.layer_of[member])
            if element.is_magnet:
                key = (name, layers.physics(element))
                if key not in known:
                    plus, minus = (effect.changed(element, a, ring.energy) for a in (h, -h))
                    # the same one: a corrector's calibration without a kick
                    known[key] = None if plus is minus else len(steps)
                    if plus is not minus:
                        ends += [plus, minus]
                        steps.append(2 * h)
                own = known[key]
                if own is not None:
                    way = layers.way(k)
                    pair = pairs.setdefault((own, id(way)), len(ways))
                    if pair == len(ways):
                        ways.append(way)
                    magnets.append((owner, k, pair))
                continue
            up_down = [effect.changed(element, amount, ring.energy) for amount in (h, -h)]
            others.append((owner, k, member, h, up_down))
    layers.maps([element for *_, up_down in others for element in up_down])  # together
    for owner, k, member, h, up_down in others:
        (up, up_read), (down, down_read) = (layers.layer(k, {member: own}) for own in up_down)
        rows.append((owner, k, _slope(up, down, h)))
        start = first_monitor[layers.first_element(k)]
        for i, (a, b) in enumerate(zip(up_read, down_read, strict=True)):
            slope = _slope(a, b, h)
            if any(m.any() for m in slope):
                reads.append((owner, int(start + i), slope))
    if magnets:
        maps = quadratic_maps(ends, ring.map_energy, n)
        each = slopes(maps, np.array(steps))[[own for own, _ in pairs]]
        D0, D1, D2 = each.after(stacked(ways, n)).reduced()
        for owner, k, pair in magnets:
            rows.append((owner, k, (D0[pair], D1[pair], D2[pair])))
    return Directions(tuple(hypotheses), *_stacked(rows, n, n), *_stacked(reads, 2, n))


ARRAYS = ("owner", "layer", "D0", "D1", "D2", "read_owner", "monitor", "E0", "E1", "E2")


def _slope(up: Weights, down: Weights, h: float) -> Weights:
    a, b, c = ((p - m) / (2 * h) for p, m in zip(up, down, strict=True))
    return a, b, c


_Row = tuple[int, int, Weights]
"""Owner, layer or monitor, and weights."""


def _stacked(
    rows: Sequence[_Row], height: int, n: int
) -> tuple[Indices, Indices, Array, Array, Array]:
    owner = np.array([owner for owner, _, _ in rows], dtype=np.int64)
    at = np.array([at for _, at, _ in rows], dtype=np.int64)
    d0, d1, d2 = (
        np.array([weights[i] for _, _, weights in rows]).reshape(-1, height, *order)
        for i, order in enumerate(((), (n,), (n * (n + 1) // 2,)))
    )
    return owner, at, d0, d1, d2
