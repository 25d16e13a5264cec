"""The ring as a chain of layers: states, turns, the map of a turn, without torch.

>>> chain = Chain(ring_maps(ring))
>>> chain.readings([[1e-3, 0, 1e-3, 0]])                # [1, monitor, 2], m
>>> chain.track([[1e-5, 0, 1e-5, 0]], turns=500)        # [1, 501, 4]
"""

from collections.abc import Callable, Sequence
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tmlattice.arrays import Array
from tmlattice.beam import sweeps
from tmlattice.beam import tangents as kernels
from tmlattice.beam.aperture import APERTURE, check_alive, lost
from tmlattice.beam.layers import Layers
from tmlattice.beam.rf import NO_RF
from tmlattice.beam.sweeps import curved
from tmlattice.by_name import by_name
from tmlattice.errors import BeamLostError, UnstableRingError
from tmlattice.lattice.ring import Ring
from tmlattice.maps import RingMaps, ring_maps

NO_ORBIT = (
    "no closed orbit: the search does not converge; the ring is at an integer resonance, or its "
    "kicks are too large"
)


def products(matrices: Array) -> Array:
    """Cumulative products of the matrices [step, n, n], from the start, [step + 1, n, n]."""
    steps, n = matrices.shape[:2]
    total = np.empty((steps + 1, n, n))
    kernels.products(np.ascontiguousarray(matrices), total)
    return total


def merged(matrices: Array, ends: NDArray[np.intp]) -> Array:
    """Products of runs of the matrices [step, n, n] in beam order, each up to and including one of
    the rising `ends`, [end, n, n]."""
    whole = np.empty((len(ends), *matrices.shape[1:]))
    kernels.merge(np.ascontiguousarray(matrices), ends, whole)
    return whole


def closing(turn: Array, free: NDArray[np.intp], rows: NDArray[np.intp]) -> Array:
    """Correction of the start for a mismatch of a turn, (1 - turn)^-1 in the free coordinates,
    [n, row].

    Args:
        turn: one-turn matrix, [n, n].

    Raises:
        UnstableRingError: the matrix is singular.
    """
    solve = np.zeros((len(turn), len(rows)))
    try:
        solve[free] = np.linalg.inv((np.eye(len(turn)) - turn)[np.ix_(rows, free)])
    except np.linalg.LinAlgError:
        raise UnstableRingError(NO_ORBIT) from None
    return solve


def first_pass(weights: Sequence[Array], maps: RingMaps, start: Array) -> tuple[Array, Array]:
    """Return states [block, layer + 1, n, lane] and readings [block, monitor, 2, lane], from
    launches [batch, n]."""
    W0, W1, W2 = weights
    size, states = sweeps.begun(start, len(W0) + 1)
    sweeps.run(sweeps.forward, len(states), size, W0, W1, W2, curved(W2), states)
    return states, sweeps.read_out(maps, size, states)


class LayerChain:
    """Common part of chains of layers: names, launches, tracking, the one-turn map.

    A chain defines how its layers act on states (`_forward`, `_track`, `linearised`).
    """

    maps: RingMaps
    ring: Ring | None = None

    def _forward(self, size: sweeps.Size, states: Array) -> None:
        """Fill states [block, 1:, n, lane] from states[:, 0]: every exit of one pass."""
        raise NotImplementedError

    def _track(self, size: sweeps.Size, history: Array) -> None:
        """Fill history [block, 1:, n, lane] from history[:, 0]: the start of every turn."""
        raise NotImplementedError

    def linearised(self) -> Callable[[Array], tuple[Array, Array]]:
        """Return `tangents` as a function, of the weights as they are now."""
        raise NotImplementedError

    def tangents(self, x: Array) -> tuple[Array, Array]:
        """States [layer + 2, n] at the launch x [n], all exits and the ring's end, and d state /
        d launch there, [layer + 2, n, n]."""
        return self.linearised()(x)

    @property
    def dimension(self) -> int:
        """Number of coordinates n."""
        return self.maps.dimension

    @property
    def layers(self) -> tuple[str, ...]:
        """Names of the magnets, one a layer."""
        return self.maps.layers

    @property
    def monitors(self) -> tuple[str, ...]:
        """Names of the monitors, in the order of the readings."""
        return self.maps.monitors

    def _start(self, launch: ArrayLike) -> Array:
        start = np.ascontiguousarray(launch, dtype=float)
        if start.ndim != 2 or start.shape[1] != self.dimension:
            raise ValueError(
                f"launch has the shape {start.shape}; it should be [batch, {self.dimension}]"
            )
        return start

    def states(self, launch: ArrayLike) -> Array:
        """States at the launch and at the exit of every layer on one pass, [batch, layer + 1, n].

        Lost trajectories are not reported: their states grow or become infinite.
        """
        start = self._start(launch)
        size, states = sweeps.begun(start, len(self.layers) + 1)
        self._forward(size, states)
        return sweeps.unpack(states, len(start))

    def track(self, launch: ArrayLike, turns: int, *, keep_lost: bool = False) -> Array:
        """Return states at the start of the ring after 0, 1, ..., turns turns.

        Args:
            launch: states at the start, [batch, n].
            turns: at least 1.
            keep_lost: do not raise for a lost trajectory; its states are NaN from then on.

        Returns:
            [batch, turns + 1, n]; no gradient.

        Raises:
            BeamLostError: names the trajectory, the turn and the layer where it was lost.
            ValueError: a launch of another shape, or no turn.
        """
        if turns < 1:
            raise ValueError(f"{turns} turns cannot be tracked; give at least one")
        states = self._turns(self._start(launch), turns)
        if keep_lost:
            states[np.logical_or.accumulate(lost(states), axis=1)] = np.nan
        else:
            self._check_alive(states)
        return states

    def _turns(self, start: Array, turns: int) -> Array:
        """States [batch, turns + 1, n] at the start of every turn, from `start` [batch, n]."""
        size, history = sweeps.begun(start, turns + 1)
        self._track(size, history)
        return sweeps.unpack(history, len(start))

    def _check_alive(self, states: Array) -> None:
        gone = lost(states)  # [batch, turn]
        if not gone.any():
            return
        trajectory = int(gone.any(axis=1).argmax())
        turn = int(gone[trajectory].argmax())
        if turn == 0:
            raise BeamLostError(
                f"trajectory {trajectory} starts outside {APERTURE:g} m or rad; launch closer"
            )
        inside = self.states(states[trajectory, turn - 1][None])[0]
        gone = lost(inside)
        layer = max(int(gone.argmax()) - 1, 0) if gone.any() else len(self.layers) - 1
        raise BeamLostError(
            f"trajectory {trajectory} is lost in turn {turn}, in layer {layer} "
            f"('{self.layers[layer]}'): its motion grows; launch closer to the axis, or check "
            "that the ring is stable"
        )

    def one_turn_map(self, x: ArrayLike | None = None) -> tuple[Array, Array]:
        """Image and Jacobian of one turn at the state x [n] (else the origin): [n], [n, n].

        The product of the layers' Jacobians along the trajectory is exact for the chain, unlike a
        composed second-order map.
        """
        x = np.zeros(self.dimension) if x is None else np.asarray(x, dtype=float)
        path, total = self.tangents(x)
        return path[-1], total[-1]

    def closed_orbit(
        self,
        start: ArrayLike | None = None,
        *,
        free: ArrayLike = (0, 1, 2, 3),
        turn: ArrayLike = 0.0,
        tolerance: float = 1e-14,
    ) -> tuple[Array, Array]:
        """Find the closed orbit by Newton's method, and return `tangents` at it.

        Args:
            start: first guess, [n]; fixed coordinates keep its value.
            free: free coordinates of the start; as many, from the first on, repeat.
            turn: prescribed change of these in a turn, [free].
            tolerance: m and rad, or 1e-12 of the largest free coordinate.

        Raises:
            UnstableRingError: no closed orbit is found.
        """
        x = np.zeros(self.dimension) if start is None else np.array(start, dtype=float)
        free = np.asarray(free, dtype=np.intp)
        rows = np.arange(len(free))
        found, tangents = False, self.linearised()
        for _ in range(31):
            path, total = tangents(x)
            miss = (path[-1] - x)[rows] - turn
            if not (np.isfinite(miss).all() and np.isfinite(total[-1]).all()):
                break
            if found:
                return path, total
            change = closing(total[-1], free, rows) @ miss
            x = x + change
            found = bool(np.abs(change).max() < max(tolerance, 1e-12 * np.abs(x[free]).max()))
        raise UnstableRingError(NO_ORBIT)


class Chain(LayerChain):
    """Second-order layers, one per magnet, with the read-outs of the ring's monitors.

    Layer k sends the state x at the exit of magnet k - 1 to W0[k] + W1[k] x + W2[k] x^[2] at the
    exit of magnet k. States are OCELOT's (x, px, y, py), or (x, px, y, py, tau, p), in m and units
    of the reference momentum.
    """

    def __init__(self, maps: RingMaps) -> None:
        self.maps = maps

    @classmethod
    @by_name
    def from_ring(cls, ring: Ring, dimension: int = 4) -> Self:
        """Return the chain of a ring's design, from OCELOT's maps.

        Args:
            ring: see `load_ring`.
            dimension: 4, or 6 for OCELOT's six coordinates.
        """
        made = cls(ring_maps(ring, dimension))
        made.ring = ring
        return made

    def weights(self) -> tuple[Array, Array, Array]:
        """W0 [layer, n], W1 [layer, n, n], W2 [layer, n, n (n + 1) / 2]; read-only."""
        return self.maps.W0, self.maps.W1, self.maps.W2

    def readings(self, launch: ArrayLike) -> Array:
        """Return (x, y) at every monitor on one pass, [batch, monitor, 2], m."""
        start = self._start(launch)
        states, readings = first_pass(self.weights(), self.maps, start)
        check_alive(states, self.maps)
        return sweeps.unpack(readings, len(start))

    def turn(self) -> Layers:
        """A copy of the layers of one turn, with the drift to the ring's end."""
        return Layers.of(self.maps, weights=self.weights())

    def _forward(self, size: sweeps.Size, states: Array) -> None:
        W0, W1, W2 = self.weights()
        sweeps.run(sweeps.forward, len(states), size, W0, W1, W2, curved(W2), states)

    def _track(self, size: sweeps.Size, history: Array) -> None:
        turn = self.turn()
        sweeps.run(sweeps.track, len(history), size, *turn.W, turn.curved, history)

    def linearised(self) -> Callable[[Array], tuple[Array, Array]]:
        """Return what `LayerChain.linearised` states."""
        turn, n = self.turn(), self.dimension
        layers = (None,) * n, *turn.W, turn.curved, turn.third, NO_RF.exits, NO_RF.values

        def tangents(x: Array) -> tuple[Array, Array]:
            states = np.empty((1, turn.steps + 1, n))
            total = np.empty((*states.shape, n))
            states[0, 0], total[0, 0] = x, np.eye(n)
            kernels.trajectories(0, 1, *layers, states, total)
            return states[0], total[0]

        return tangents
