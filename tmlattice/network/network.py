"""The network: weights stacked over layers, readings of a launch, tracking over many turns."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from tmlattice.errors import BeamLostError
from tmlattice.lattice.ring import Ring
from tmlattice.maps import RingMaps, TaylorMap, ring_maps
from tmlattice.maps.taylor import second_derivatives
from tmlattice.network import sweeps
from tmlattice.network.autograd import APERTURE, Sweep, curved

if TYPE_CHECKING:
    from tmlattice.network.symplectic_network import SymplecticNetwork

Array = NDArray[np.float64]


def chain(matrices: Array) -> Array:
    """The product of matrices [step, n, n] in beam order: the last one stands on the left."""
    total = np.eye(matrices.shape[1])
    for matrix in matrices:
        total = matrix @ total
    return total


class LayerChain(torch.nn.Module):
    """What every chain of layers has: names, launches, tracking, the map of a turn.

    A chain says how its layers send states (`_forward`, `_track`) and what their Jacobians are.

    Attributes:
        maps: what it was made from; names and places of layers and monitors.
        ring: the ring of these maps, where it is known.
    """

    maps: RingMaps
    ring: Ring | None = None

    def _forward(self, size: sweeps.Size, states: Array) -> None:
        """Fill states [block, 1:, n, lane] from states[:, 0]: every exit of one pass."""
        raise NotImplementedError

    def _track(self, size: sweeps.Size, history: Array) -> None:
        """Fill history [block, 1:, n, lane] from history[:, 0]: the start of every turn."""
        raise NotImplementedError

    def jacobians(self, x: Array) -> tuple[Array, Array]:
        """States [layer + 2, n] at the launch, all exits and the ring's end, and the Jacobians of
        the layers and of the closing way there [layer + 1, n, n]."""
        raise NotImplementedError

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

    def extra_repr(self) -> str:
        """For print(network)."""
        return (
            f"layers={len(self.layers)}, monitors={len(self.monitors)}, dimension={self.dimension}"
        )

    def _launch(self, launch: ArrayLike | Tensor) -> Tensor:
        if not isinstance(launch, Tensor):
            launch = torch.as_tensor(np.asarray(launch, dtype=float))
        if launch.ndim != 2 or launch.shape[1] != self.dimension:
            raise ValueError(
                f"launch has the shape {tuple(launch.shape)}; it should be "
                f"[batch, {self.dimension}]"
            )
        return launch.to(torch.float64).contiguous()

    def states(self, launch: ArrayLike | Tensor) -> Array:
        """States at the launch and at the exit of every layer on one pass, [batch, layer + 1, n].

        Lost trajectories are not reported: their states grow or become infinite.
        """
        start = self._launch(launch).detach().numpy()
        size = sweeps.size_of(self.dimension, len(start))
        packed = sweeps.pack(start, len(size[1]))
        states = np.empty((len(packed), len(self.layers) + 1, *packed.shape[1:]))
        states[:, 0] = packed
        self._forward(size, states)
        return sweeps.unpack(states, len(start))

    def track(self, launch: ArrayLike | Tensor, turns: int, *, keep_lost: bool = False) -> Array:
        """States at the start of the ring after 0, 1, ..., turns turns.

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
            raise ValueError(f"{turns} turns cannot be tracked; one at least can")
        start = self._launch(launch).detach().numpy()
        size = sweeps.size_of(self.dimension, len(start))
        packed = sweeps.pack(start, len(size[1]))
        history = np.empty((len(packed), turns + 1, *packed.shape[1:]))
        history[:, 0] = packed
        self._track(size, history)
        states = sweeps.unpack(history, len(start))
        if keep_lost:
            lost = ~np.all(np.abs(states) < APERTURE, axis=2)
            states[np.logical_or.accumulate(lost, axis=1)] = np.nan
        else:
            self._check_alive(states)
        return states

    def _check_alive(self, states: Array) -> None:
        lost = ~np.all(np.abs(states) < APERTURE, axis=2)  # [batch, turn], true for NaN
        if not lost.any():
            return
        trajectory = int(np.any(lost, axis=1).argmax())
        turn = int(lost[trajectory].argmax())
        if turn == 0:
            raise BeamLostError(
                f"trajectory {trajectory} starts outside {APERTURE:g} m or rad; launch closer"
            )
        inside = self.states(states[trajectory, turn - 1][None])[0]
        gone = ~np.all(np.abs(inside) < APERTURE, axis=1)
        layer = max(int(gone.argmax()) - 1, 0) if gone.any() else len(self.layers) - 1
        raise BeamLostError(
            f"trajectory {trajectory} is lost in turn {turn}, in layer {layer} "
            f"('{self.layers[layer]}'): its motion grows; launch closer to the axis, or check "
            "that the ring is stable"
        )

    def one_turn_map(self, x: ArrayLike | None = None) -> tuple[Array, Array]:
        """Image and Jacobian of one turn at the state x [n] (else the origin): [n], [n, n].

        The product of the layers' own Jacobians along the trajectory: exact for the chain, where
        a composed second-order map of the turn would not be.
        """
        x = np.zeros(self.dimension) if x is None else np.asarray(x, dtype=float)
        path, matrices = self.jacobians(x)
        return path[-1], chain(matrices)


class TaylorNetwork(LayerChain):
    """A ring as a chain of second-order layers, one per magnet, read by its monitors.

    Layer k sends the state x at the exit of magnet k - 1 to W0[k] + W1[k] x + W2[k] x^[2] at the
    exit of magnet k. States are OCELOT's (x, px, y, py), or (x, px, y, py, tau, p), in m and
    units of the reference momentum. All weights are float64 and of their layer alone.

    Args:
        maps: weights and read-outs of a ring.

    Attributes:
        W0: [layer, n], parameter.
        W1: [layer, n, n], parameter.
        W2: [layer, n, n (n + 1) / 2], parameter, in the order x1^2, x1 x2, ..., xn^2.
        maps, ring: what it was made from; names and places of layers and monitors.

    Source: A. Ivanov, I. Agapov, Phys. Rev. Accel. Beams 23 (2020) 074601, for the architecture.
    """

    def __init__(self, maps: RingMaps) -> None:
        super().__init__()
        self.maps = maps
        self.W0 = torch.nn.Parameter(torch.from_numpy(maps.W0.copy()))
        self.W1 = torch.nn.Parameter(torch.from_numpy(maps.W1.copy()))
        self.W2 = torch.nn.Parameter(torch.from_numpy(maps.W2.copy()))

    @classmethod
    def from_ring(cls, ring: Ring, dimension: int = 4) -> "TaylorNetwork":
        """The network of a ring's design, from OCELOT's maps.

        Args:
            ring: see `load_ring`.
            dimension: 4, or 6 for OCELOT's six coordinates.
        """
        made = cls(ring_maps(ring, dimension))
        made.ring = ring
        return made

    def symplectic(self) -> "SymplecticNetwork":
        """The same ring in layers that are symplectic exactly, and stay so whatever is fitted.

        See `SymplecticNetwork`.
        """
        from tmlattice.network.symplectic_network import SymplecticNetwork

        return SymplecticNetwork.from_network(self)

    def weights(self) -> tuple[Array, Array, Array]:
        """W0, W1, W2 as numpy arrays that share the parameters' memory: do not change them."""
        W0, W1, W2 = (w.detach().numpy() for w in (self.W0, self.W1, self.W2))
        return W0, W1, W2

    def copy(self) -> "TaylorNetwork":
        """A network of its own with the same weights."""
        new = TaylorNetwork(self.maps)
        new.ring = self.ring
        new.load_state_dict(self.state_dict())
        return new

    def forward(self, launch: ArrayLike | Tensor) -> Tensor:
        """Readings of every monitor on one pass.

        Args:
            launch: states at the start of the ring, [batch, n].

        Returns:
            (x, y) in m, [batch, monitor, 2]; differentiable by launch and weights.

        Raises:
            BeamLostError: names the layer where a trajectory was lost.
            ValueError: a launch of another shape.
        """
        readings: Tensor = Sweep.apply(  # type: ignore[no-untyped-call]
            self._launch(launch), self.W0, self.W1, self.W2, self.maps
        )
        return readings

    def one_turn_weights(self) -> tuple[Array, Array, Array]:
        """W0, W1, W2 of one whole turn as a chain: the layers, then the way to the ring's end."""
        closing: Sequence[Array] = self.maps.closing.coefficients
        layers = self.weights()
        W0, W1, W2 = (np.concatenate([w, c[None]]) for w, c in zip(layers, closing, strict=True))
        return W0, W1, W2

    def layer_map(self, layer: int) -> TaylorMap:
        """One layer as a Taylor map."""
        return TaylorMap([w[layer] for w in self.weights()])

    def _forward(self, size: sweeps.Size, states: Array) -> None:
        W0, W1, W2 = self.weights()
        sweeps.run(sweeps.forward, len(states), size, W0, W1, W2, curved(W2), states)

    def _track(self, size: sweeps.Size, history: Array) -> None:
        W0, W1, W2 = self.one_turn_weights()
        sweeps.run(sweeps.track, len(history), size, W0, W1, W2, curved(W2), history)

    def jacobians(self, x: Array) -> tuple[Array, Array]:
        """States [layer + 2, n] at the launch, all exits and the ring's end, and the Jacobians of
        the layers and of the closing way there [layer + 1, n, n]."""
        W0, W1, W2 = self.one_turn_weights()
        size = sweeps.size_of(self.dimension, 1)
        states = np.empty((1, len(W0) + 1, self.dimension, 1))
        states[0, 0, :, 0] = x
        sweeps.run(sweeps.forward, 1, size, W0, W1, W2, curved(W2), states)
        path = states[0, :, :, 0]
        slopes = np.einsum("kaij,kj->kai", second_derivatives(W2), path[:-1])
        return path, W1 + slopes
