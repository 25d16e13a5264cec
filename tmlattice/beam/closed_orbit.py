"""Closed orbit at fixed RF frequency, and its derivative for every corrector and for the RF.

A kick v at the exit of a layer acts on the turn like w = C^-1 v at its start, C the matrix from
the start to there. With the one-turn matrix M the closed orbit at the start moves by dz, where

    (M - 1) dz + M w = (0, 0, 0, 0, d tau, *):

the four transverse coordinates repeat, the turn lasts as long as the RF's harmonic number of
periods (d tau = 0 at fixed frequency), and the energy is free to make it so. The sixth row is the
energy's: without losses it is conserved, and what is lost is given back at the ring's end.
"""

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tmlattice.arrays import Array, Flags, Indices
from tmlattice.beam.chain import NO_ORBIT, Chain, closing
from tmlattice.beam.layers import Layers
from tmlattice.beam.nonlinear import third_orders
from tmlattice.beam.settle import settle
from tmlattice.beam.threads import share
from tmlattice.errors import MeasurementError, UnstableRingError
from tmlattice.lattice import Ring
from tmlattice.maps import LayerMaps, RingMaps, changed_maps, ring_maps
from tmlattice.maps.quadratic import Quadratic, slopes, stacked
from tmlattice.maps.taylor import second_derivatives

KICK = 1e-4
"""Of the central differences of a corrector's map, rad; the maps are linear in the kick."""
CORRECTORS = {"hcorrector": "x", "vcorrector": "y"}


@dataclass(frozen=True)
class Columns:
    """Correctors as sources of an orbit change.

    Attributes:
        names, planes: of the correctors.
        place: in `ring.elements`, [column].
        layer: of each, [column].
        slope: d v / d x of the kick v at the layer's exit, 1/rad, [column, n, n].
        start: the closed orbit at the start of the ring for one radian, [column, n].
        launch_kick: the kick at the layer's exit as a change of the launch, [column, n].
    """

    names: tuple[str, ...]
    planes: tuple[str, ...]
    place: Indices
    layer: Indices
    slope: Array
    start: Array
    launch_kick: Array


class ResponseModel:
    """A ring's closed orbit at fixed RF frequency and its derivatives, from the layers' maps.

    Cavities are drifts: on the closed orbit the beam meets the RF at the phase that replaces its
    loss, and a static orbit needs nothing else.

    Args:
        ring: with its errors and settings.
        dimension: 6; or 4 for a beam of constant energy.
        frequency: relative change of the RF frequency from the one at which the design orbit is
            closed; six coordinates.
        orbit_kicks: kicks along the design orbit that act on other energies, behind each magnet in
            x and y, see `beam.kicks`, rad, [magnet, 2]; six coordinates. None: no kicks.

    Attributes:
        ring, layers, maps, frequency, orbit_kicks: arguments.
        state: the closed orbit at the start of the ring, [n].
        path: at the start, at the layers' exits and at the end of the ring, [layer + 2, n].
        tangents: matrices from the start to there, [layer + 2, n, n].
        free: the coordinates that are free at the start: all but tau.
        readings: the closed orbit at the monitors, m, [monitor, 2].
        reading_slopes: d reading / d launch, [monitor, 2, n].

    Raises:
        UnstableRingError: no closed orbit.
    """

    ring: Ring
    layers: LayerMaps
    maps: RingMaps

    def __init__(
        self,
        ring: Ring,
        dimension: int = 6,
        frequency: float = 0.0,
        orbit_kicks: Array | None = None,
    ) -> None:
        if orbit_kicks is not None and (
            dimension != 6 or orbit_kicks.shape != (len(ring.magnets), 2)
        ):
            raise ValueError("kicks of the orbit are [magnet, 2], and need six coordinates")
        self.ring = ring
        # of a design they are remembered; of one of many changed rings they would not be freed
        layers = ring.memory.get(("layers", dimension))
        self.layers = LayerMaps(ring, dimension) if layers is None else layers
        self.orbit_kicks = orbit_kicks
        magnets = np.arange(len(ring.magnets))
        self.maps = self._dispersed(ring_maps(ring, dimension, self.layers), magnets)
        self.free = np.arange(4) if dimension == 4 else np.array([0, 1, 2, 3, 5])
        self._chain = Chain(self.maps)
        self._close(frequency)

    @classmethod
    def of(cls, ring: Ring, dimension: int = 6) -> "ResponseModel":
        """Return the model of a ring, remembered with it: for a design, which is asked for often.

        Raises:
            UnstableRingError: no closed orbit.
        """
        LayerMaps.of(ring, dimension)
        return ring.remembered(("response", dimension), lambda: cls(ring, dimension))

    def at_frequency(self, frequency: float) -> "ResponseModel":
        """Return the same ring, with its maps, at another RF frequency (relative change).

        Raises:
            UnstableRingError: no closed orbit.
        """
        other = copy(self)
        # the new orbit to first order: fewer iterations
        near = self.state + (frequency - self.frequency) * self.rf_start
        other._close(frequency, near)
        return other

    def at_energy(self, deviation: float) -> "ResponseModel":
        """Return the same ring at the RF frequency that changes the closed orbit's energy by a
        relative deviation, to first order.

        Raises:
            UnstableRingError: no closed orbit.
        """
        return self.at_frequency(self.frequency + deviation / self.rf_start[5])

    def changed_to(self, ring: Ring) -> "ResponseModel":
        """Return the model of a ring with other elements in the same places: only their layers are
        computed anew.

        Raises:
            UnstableRingError: no closed orbit.
        """
        other = copy(self)
        other.ring = ring
        other.layers, touched = self.layers.changed_to(ring)
        other._forget()
        if touched:  # else the kicks differ, and the orbit is the same
            other.maps = other._dispersed(changed_maps(self.maps, other.layers, touched), touched)
            other._chain = Chain(other.maps)
            other._close(self.frequency)
        return other

    def _dispersed(self, maps: RingMaps, layers: Sequence[int] | Indices) -> RingMaps:
        """Return the maps with the orbit kicks behind some layers."""
        if self.orbit_kicks is None:
            return maps
        own = np.array([k for k in layers if k < len(self.orbit_kicks)], dtype=np.int64)
        arrays = {name: getattr(maps, name).copy() for name in ("W0", "W1", "W2")}
        for weights in arrays.values():
            weights[own] = self._with_orbit_kicks(own, weights[own])
        return replace(maps, **arrays)

    def _with_orbit_kicks(self, layers: Indices, weights: Array) -> Array:
        """Weights of some layers, and behind each px -= kick p and tau -= kick x, which makes the
        map symplectic, [layer, n, ...]."""
        if self.orbit_kicks is None:
            return weights
        behind = np.tile(np.eye(self.dimension), (len(layers), 1, 1))
        for plane in (0, 1):
            kick = self.orbit_kicks[layers, plane]
            behind[:, 2 * plane + 1, 5] = behind[:, 4, 2 * plane] = -kick
        return np.asarray(np.einsum("kij,kj...->ki...", behind, weights))

    def _forget(self) -> None:
        """Drop what was cached for the previous orbit."""
        self._columns: dict[tuple[tuple[str, ...], bool], Columns] = {}
        for name in ("closing", "inverse", "rf_start"):
            self.__dict__.pop(name, None)

    def _close(self, frequency: float, near: Array | None = None) -> None:
        dimension = self.dimension
        if frequency and dimension != 6:
            raise ValueError("the RF moves the energy, which four coordinates do not have")
        self._forget()
        self.frequency = frequency
        self._turn = np.zeros(len(self.free))
        if dimension == 6:
            self._turn[4] = self.slip * frequency / (1 + frequency)
        self.path, self.tangents = self._chain.closed_orbit(
            near, free=self.free, turn=self._turn, tolerance=1e-15
        )
        self.state = self.path[0]
        self._solve = closing(self.tangents[-1], self.free, np.arange(len(self.free)))

        at, maps = self.maps.at, self.maps
        bent = np.einsum("maij,mj->mai", second_derivatives(maps.R2), self.path[at])
        self.readings = self._read(self.path[at])
        self.reading_slopes = (maps.R1 + bent) @ self.tangents[at]

    @cached_property
    def inverse(self) -> Array:
        """Matrices from the places of the tangents to the start, [layer + 2, n, n]."""
        try:
            return np.asarray(np.linalg.inv(self.tangents))
        except np.linalg.LinAlgError:  # the matrices have overflown
            raise UnstableRingError(NO_ORBIT) from None

    @property
    def dimension(self) -> int:
        """Number of coordinates, 4 or 6."""
        return self.layers.dimension

    @property
    def monitors(self) -> tuple[str, ...]:
        """Monitors in the order of the readings."""
        return self.maps.monitors

    @property
    def slip(self) -> float:
        """d (c T) / d (relative frequency) of the RF's turn T = harmonic / frequency, m."""
        return -self.ring.length / self.ring.beta

    @cached_property
    def correctors(self) -> tuple[str, ...]:
        """All correctors of the ring, in beam order."""
        return tuple(e.name for e in self.ring.elements if e.kind in CORRECTORS)

    @cached_property
    def closing(self) -> Array:
        """dz for a kick w at the start, [n, n]: see the module."""
        rows = np.arange(len(self.free))
        return np.asarray(self._solve @ self.tangents[-1][rows])

    @cached_property
    def rf_start(self) -> Array:
        """The closed orbit's change at the start for a relative step of the frequency, [n]."""
        if self.dimension != 6:
            raise ValueError("the RF moves the energy, which four coordinates do not have")
        return -self._solve[:, 4] * self.slip

    def columns(self, correctors: Sequence[str] | None = None, turned: bool = False) -> Columns:
        """Return correctors as sources.

        Args:
            correctors: names; None: all of the ring, in beam order.
            turned: with their kicks turned by a right angle, from x towards y.

        Raises:
            UnknownNameError: no such element.
            MeasurementError: an element that is not a corrector.
        """
        ring = self.ring
        names = self.correctors if correctors is None else tuple(correctors)
        if (names, turned) in self._columns:
            return self._columns[names, turned]
        place = np.array([ring.index(name) for name in names], dtype=np.int64)
        planes = []
        for i in place:
            element = ring.elements[i]
            if element.kind not in CORRECTORS:
                raise MeasurementError(
                    f"'{element.name}' is a {element.kind}, not a corrector; name a corrector"
                )
            planes.append(CORRECTORS[element.kind])
        layer = self.layers.layer_of[place] if len(place) else np.empty(0, dtype=np.int64)
        # at their layers' exits; the slopes by the state at the entrances
        kick, slope = self._per_kick(place, layer)(self.path[layer])
        if turned:
            kick, slope = _turned(kick), _turned(slope)
        launch_kick = np.einsum("cij,cj->ci", self.inverse[layer + 1], kick)
        found = self._columns[names, turned] = Columns(
            names=tuple(ring.elements[i].name for i in place),
            planes=tuple(planes),
            place=place,
            layer=layer,
            slope=slope,
            start=launch_kick @ self.closing.T,
            launch_kick=launch_kick,
        )
        return found

    def response(self, correctors: Sequence[str] | None = None, turned: bool = False) -> Array:
        """d (closed orbit) / d kick at fixed RF frequency, m/rad, [corrector, monitor, 2].

        Arguments and errors are those of `columns`.
        """
        columns = self.columns(correctors, turned)
        slopes = self.reading_slopes
        before, after = (np.tensordot(own, slopes, (1, 2))
                         for own in (columns.start, columns.launch_kick))  # fmt: skip
        return np.asarray(before + self.downstream(columns)[:, :, None] * after)

    def downstream(self, columns: Columns) -> Flags:
        """Whether a monitor reads behind the corrector, [column, monitor]."""
        return np.asarray(self.maps.at[None] > columns.layer[:, None])

    @property
    def turn(self) -> Layers:
        """A copy of the layers of one turn, with their third order."""
        return Layers.of(self.maps, third_orders(self.layers))

    def closed_orbits(self, correctors: Sequence[str], kicks: Sequence[float] | Array) -> Array:
        """The closed orbit with one corrector stepped, not linearised, m, [orbit, monitor, 2].

        With the third order of sextupoles, see `beam.nonlinear`. `response` is the derivative.

        Args:
            correctors: one for each orbit, also repeatedly.
            kicks: added to the corrector's own, rad, [orbit].

        Raises:
            UnknownNameError: no such element.
            UnstableRingError: no closed orbit is found.
        """
        turn, columns, steps = self.turn, self.columns(correctors), np.asarray(kicks)
        layer = columns.layer
        per_kick = self._per_kick(columns.place, layer).reduced()
        V0, V1, V2 = (
            whole[layer] + (steps * self._with_orbit_kicks(layer, slope).T).T
            for whole, slope in zip(turn.W, per_kick, strict=True)
        )
        paths = np.empty((len(steps), turn.steps + 1, self.dimension))
        paths[:, 0] = self.state + steps[:, None] * columns.start  # the linear orbit
        good = np.zeros(len(paths), dtype=bool)
        share(
            settle, len(paths), *turn.W, turn.curved, turn.third, layer, V0, V1, V2, self._solve,
            self._turn, 1e-14, paths, good,
        )  # fmt: skip
        if not good.all():
            raise UnstableRingError(NO_ORBIT)
        return self._read(paths[:, self.maps.at])

    def _read(self, here: Array) -> Array:
        """Readings [..., monitor, 2] of the states at the monitors' exits."""
        maps, n = self.maps, self.dimension
        count = int(np.prod(here.shape[:-2]))
        x = np.moveaxis(here, -2, 0).reshape(len(maps.at), count, n)  # [monitor, orbit, n]
        bends = second_derivatives(maps.R2).reshape(len(x), 2 * n, n)
        bent = (x @ bends.swapaxes(1, 2)).reshape(*x.shape[:2], 2, n)
        read = maps.R0[:, None] + ((maps.R1[:, None] + bent / 2) @ x[..., None])[..., 0]
        return np.moveaxis(read, 0, 1).reshape(*here.shape[:-1], 2)

    def rf_response(self) -> Array:
        """d (closed orbit) / d (relative RF frequency), m, [monitor, 2]."""
        return np.asarray(self.reading_slopes @ self.rf_start)

    def rf_change(self, step: float) -> Array:
        """The closed orbit's change for a relative step of the RF frequency, from half a step below
        to half a step above, not linearised, m, [monitor, 2].

        Raises:
            UnstableRingError: no closed orbit is found.
        """
        up, down = (self.at_frequency(self.frequency + side * step / 2) for side in (1, -1))
        return up.readings - down.readings

    def _per_kick(self, place: Indices, layer: Indices) -> Quadratic:
        """Derivatives of layers' maps by their correctors' kicks, [column, ...]."""
        layers, n, key = self.layers, self.dimension, ("kicks", place.tobytes())
        if key not in layers.memory:
            correctors = [self.ring.elements[i] for i in place]
            physics = [layers.physics(element) for element in correctors]
            different = dict(zip(physics, correctors, strict=True))
            ends = [
                element.changed(angle=element.angle + side * KICK)
                for element in different.values() for side in (1, -1)
            ]  # fmt: skip
            which = {own: i for i, own in enumerate(different)}
            per_kick = slopes(stacked(layers.maps(ends), n), 2 * KICK)[[which[p] for p in physics]]
            per_kick = per_kick.after(stacked([layers.way(int(k)) for k in layer], n))
            layers.memory[key] = per_kick
        found: Quadratic = layers.memory[key]
        return found


def _turned(kicks: Array) -> Array:
    """Kicks [column, n, ...] turned by a right angle, from x towards y."""
    turned = np.zeros_like(kicks)
    turned[:, :2], turned[:, 2:4] = -kicks[:, 2:4], kicks[:, :2]
    return turned


def feed_down(
    model: ResponseModel, back: NDArray[np.floating[Any]], into: NDArray[np.floating[Any]]
) -> Array:
    """Sources C^-1 T''(., C da) C for a change da of the closed orbit's launch, summed before each
    exit, [layer + 2, n, n, n], da the last axis.

    Args:
        back, into: matrices from the layers' exits to the start and from there into the layers, of
            the motion around the closed orbit, [layer + 2, n, n].
    """
    maps, n = model.maps, model.dimension
    W2 = np.concatenate([maps.W2, maps.closing.coefficients[2][None]])  # with the closing drift
    j = np.flatnonzero(W2.any(axis=(1, 2)))
    summed = np.zeros((len(W2) + 1, n, n, n))
    summed[j + 1] = np.einsum(
        "kai,kijl,klc,kjb->kabc", back[j + 1], second_derivatives(W2[j]), model.tangents[j],
        into[j], optimize=True,
    )  # fmt: skip
    return np.cumsum(summed, axis=0)
