"""A ring with known causes, and its layers with a shot's settings and further causes.

The order is settings, known causes, further causes: a corrector's calibration error acts on the
kick that was set.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from tmlattice.arrays import ComplexArray
from tmlattice.beam.layers import LayerParts, Layers
from tmlattice.beam.nonlinear import third_order, third_orders
from tmlattice.beam.rf import Cavities, Rf, cavities, frequency_of, rf_of
from tmlattice.effects import (
    Cause,
    Directions,
    Hypothesis,
    RingEffect,
    Settings,
    apply,
    find,
    set_elements,
)
from tmlattice.effects.directions import directions, kept_directions, ring_effect, sitting_on
from tmlattice.lattice import Element, Ring
from tmlattice.maps import LayerMaps, RingMaps, changed_maps, ring_maps

MADE = 10_000
"""Changed layers in memory: some 20 MB."""
KEPT = 4
"""Rings with known causes that are cached with a ring."""
MAX_CHANGES = 10
"""Known causes up to which a ring is cached."""


def on_ring(causes: Sequence[Cause]) -> list[Cause]:
    """Causes that act on elements."""
    return [cause for cause in causes if isinstance(find(cause.effect), RingEffect)]


@dataclass(frozen=True)
class Assembly:
    """A ring with known causes, its layers, and the directions of hypotheses in them.

    Attributes:
        rf: see `rf_of`.
    """

    design: Ring
    known: tuple[Cause, ...]
    ring: Ring
    layers: LayerMaps
    maps: RingMaps
    rf: Rf
    _directions: dict[tuple[Hypothesis, ...], Directions] = field(repr=False)
    _touched: dict[Hypothesis, tuple[int, ...]] = field(default_factory=dict, repr=False)

    @cached_property
    def _known_at(self) -> Mapping[int, list[Cause]]:
        """Known causes by the index of their element."""
        found: dict[int, list[Cause]] = {}
        for cause in on_ring(self.known):
            for place in _members(self.design, cause):
                found.setdefault(place, []).append(cause)
        return found

    @cached_property
    def loss(self) -> float:
        """Relative energy that the design orbit loses in a turn by the known causes."""
        return sum(element.errors.loss for element in self.ring.elements)

    def changed(self, settings: Settings, causes: Sequence[Cause] = ()) -> dict[int, Element]:
        """Return the elements that settings and further causes change, with the known causes."""
        changed = set_elements(self.design, settings)
        for place in changed:
            changed[place] = self._with(changed[place], self._known_at.get(place, ()))
        for cause in on_ring(causes):
            for place in _members(self.design, cause):
                element = changed.get(place, self.ring.elements[place])
                changed[place] = self._with(element, (cause,))
        return changed

    def _with(self, element: Element, causes: Sequence[Cause]) -> Element:
        for cause in causes:
            effect = find(cause.effect)
            assert isinstance(effect, RingEffect)
            element = effect.changed(element, cause.amount, self.design.energy)
        return element

    def layers_with(self, replaced: Mapping[int, Element]) -> dict[int, LayerParts]:
        """Return the layers of these elements."""
        touched = {int(self.layers.layer_of[place]) for place in replaced}
        return {k: self.part(k, replaced) for k in sorted(touched)}

    def part(self, k: int, replaced: Mapping[int, Element]) -> LayerParts:
        """Return layer k with other elements by index in the ring."""
        magnet = self.layers.first_element(k + 1) - 1
        third = third_order(replaced[magnet]) if magnet in replaced else self.third[k]
        return (*self.layers.layer(k, replaced), third)

    @property
    def third(self) -> ComplexArray:
        """The third order of the layers, [step, 4]."""
        return third_orders(self.layers)

    def layers_of(self, cause: Cause) -> tuple[int, ...]:
        """Layers that a cause changes."""
        key = (cause.effect, cause.element)
        if key not in self._touched:
            members = _members(self.design, cause)
            self._touched[key] = tuple(sorted({int(self.layers.layer_of[m]) for m in members}))
        return self._touched[key]

    def cavities(self, settings: Settings, causes: Sequence[Cause] = ()) -> Cavities:
        """Return the RF of a shot: it replaces the design orbit's loss with these causes."""
        lost = (self.turn_loss(cause) * cause.amount for cause in causes)
        return cavities(
            self.design, self.rf, self.layers.layer_of, self.loss + sum(lost),
            frequency_of(settings),
        )  # fmt: skip

    def turn_loss(self, cause: Cause) -> float:
        """Relative energy that a turn loses for one unit of a cause."""
        if not cause.effect.startswith("radiation"):
            return 0.0
        members = [self.design.elements[m] for m in _members(self.design, cause)]
        one = (self._with(e, (Cause(cause.effect, cause.element, 1.0),)) for e in members)
        return sum(b.errors.loss - a.errors.loss for a, b in zip(members, one, strict=True))

    def directions(self, hypotheses: Sequence[Hypothesis]) -> Directions:
        """Return directions of hypotheses without settings, at the design: distributed errors turn
        a direction by as little as they are large."""
        key = tuple(hypotheses)
        if key not in self._directions:
            design = assembly(self.design, (), self.layers.dimension).layers
            self._directions[key] = kept_directions(design, key)
        return self._directions[key]


def _members(ring: Ring, cause: Cause) -> list[int]:
    return ring_effect(cause.effect).members(ring, cause.element)


def assembly(ring: Ring, known: Sequence[Cause] = (), dimension: int = 6) -> Assembly:
    """Return a ring with known causes; cached with the ring if they are few."""
    known = tuple(known)
    key = ("model", known, dimension)
    few = len(known) < MAX_CHANGES
    if few and key in ring.memory:
        kept: Assembly = ring.memory[key]
        return kept
    with_known = apply(ring, known)
    layers = LayerMaps.of(ring, dimension)
    maps = ring_maps(ring, dimension, layers)
    if with_known is not ring:
        layers, touched = layers.changed_to(with_known)
        maps = changed_maps(maps, layers, touched)
    shared = {} if few else assembly(ring, (), dimension)._directions
    made = Assembly(ring, known, with_known, layers, maps, rf_of(ring), shared)
    if few:
        others = [k for k in ring.memory if k[0] == "model" and k[1]]
        if len(others) >= KEPT:  # a study with other causes in each case would fill the memory
            del ring.memory[others[0]]
        ring.memory[key] = made
    return made


class Group:
    """Shots with equal settings, and the layers of their ring."""

    def __init__(
        self,
        number: int,
        shots: NDArray[np.intp],
        settings: Settings,
        there: Assembly,
    ) -> None:
        self.number = number
        self.shots = shots
        self.settings = settings
        self.there = there
        self.layers = Layers.of(there.maps, there.third)
        self.replaced = there.changed(settings)
        own = there.layers_with(self.replaced)
        self.touched = frozenset(own)
        self.layers.put(own)
        self._latest: tuple[tuple[Hypothesis, ...], Directions] | None = None

    def parts(
        self,
        causes: Sequence[Cause],
        made: dict[tuple[int, tuple[Cause, ...], int], LayerParts],
    ) -> dict[int, LayerParts]:
        """Return the layers of causes, with these causes."""
        touching: dict[int, list[Cause]] = {}
        for cause in causes:
            for layer in self.there.layers_of(cause):
                touching.setdefault(layer, []).append(cause)
        replaced: dict[int, Element] | None = None
        found: dict[int, LayerParts] = {}
        if len(made) > MADE:
            made.clear()
        for layer, own in touching.items():
            key = (layer, tuple(own), self.number if layer in self.touched else -1)
            part = made.get(key)
            if part is None:
                if replaced is None:
                    replaced = self.there.changed(self.settings, causes)
                part = made[key] = self.there.part(layer, replaced)
            found[layer] = part
        return found

    def directions(self, hypotheses: Sequence[Hypothesis]) -> Directions:
        """Return directions of hypotheses, anew for those on elements that the settings change."""
        base = self.there.directions(hypotheses)
        key = tuple(hypotheses)
        if not self.touched:
            return base
        if self._latest is not None and self._latest[0] == key:
            return self._latest[1]
        ring = self.there.ring
        set_ring = ring.with_elements(self.replaced)
        again = sitting_on(ring, set_ring, key, self.replaced)
        layers = LayerMaps(set_ring, self.there.layers.dimension)
        fresh = directions(layers, [key[i] for i in again])
        found = base.replaced(again, fresh)
        if len(key) > MAX_CHANGES:
            self._latest = (key, found)
        return found
