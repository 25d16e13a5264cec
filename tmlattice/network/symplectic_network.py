"""The ring in layers that are symplectic by construction."""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from tmlattice.arrays import Array, Flags
from tmlattice.beam import flows, sweeps
from tmlattice.beam.aperture import check_alive
from tmlattice.beam.chain import Chain, merged, products
from tmlattice.beam.sweeps import curved
from tmlattice.maps import RingMaps
from tmlattice.maps.taylor import second_derivatives
from tmlattice.network.base import NetworkChain
from tmlattice.network.generators import (
    cubic_generator,
    field,
    multipoles,
    nearest_symplectic,
    pull_field,
)


class _FlowSweep(torch.autograd.Function):
    """(launch [batch, n], W0, generator) -> readings [batch, monitor, 2]."""

    @staticmethod
    def forward(  # type: ignore[override]
        ctx: Any, launch: Tensor, W0: Tensor, generator: Tensor, W1: Array, maps: RingMaps
    ) -> Tensor:
        """Readings of one pass through all layers."""
        size, states = sweeps.begun(launch.detach().numpy(), len(W1) + 1)
        middles = np.empty_like(states[:, 1:])
        fields = _flow(generator.detach().numpy())
        w0 = W0.detach().numpy()
        sweeps.run(flows.forward, len(states), size, w0, W1, *fields, states, middles)
        check_alive(states, maps)
        _, A, Q, moves, _ = fields
        ctx.kept = (maps, size, states, middles, W1, A, Q, moves, len(launch))
        return torch.from_numpy(sweeps.unpack(sweeps.read_out(maps, size, states), len(launch)))

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, pulls: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        """Gradients with respect to the launch, the kicks W0 and all generators."""
        maps, size, states, middles, W1, A, Q, moves, batch = ctx.kept
        packed = sweeps.pack(np.ascontiguousarray(pulls.numpy()), len(size[1]))
        adjoint, inner = np.empty_like(states), np.empty_like(states)
        sweeps.run(
            flows.reverse, len(states), size, W1, A, Q, moves, np.zeros_like(moves), maps.R1,
            maps.R2, curved(maps.R2), maps.start, states, middles, packed, adjoint, inner,
        )  # fmt: skip
        kicks = generators = None
        if ctx.needs_input_grad[1]:
            kicks = torch.from_numpy(adjoint[:, 1:].sum(axis=(0, 3)))
        if ctx.needs_input_grad[2]:
            pulled = np.zeros(W1.shape[:2]), np.zeros_like(A), np.zeros_like(Q)
            sweeps.run(sweeps.weights, len(W1), size, middles, inner, *pulled)
            generators = torch.from_numpy(pull_field(*pulled))
        launch = torch.from_numpy(sweeps.unpack(adjoint[:, 0], batch))
        return launch, kicks, generators, None, None


_SKEW = np.ones((4, 10), dtype=bool)
"""Zeros of Q for a generator that is even in (y, py)."""
_SKEW[:2, [0, 1, 4, 7, 8, 9]] = False
_SKEW[2:, [2, 3, 5, 6]] = False


def _flow(generator: Array) -> tuple[Array, Array, Array, Flags, Flags]:
    """The fields of generators: c, A, Q; whether each moves anything; and whether, in four
    coordinates, it is of pure second degree and keeps the mid-plane."""
    c, A, Q = field(generator)
    linear: Flags = np.asarray(c.any(axis=1) | A.any(axis=(1, 2)))
    flat = np.zeros(len(c), dtype=bool)
    if c.shape[1] == 4:
        flat = ~(linear | np.asarray(Q[:, _SKEW].any(axis=1)))
    return c, A, Q, linear | np.asarray(Q.any(axis=(1, 2))), flat


class SymplecticNetwork(NetworkChain):
    """A ring as a chain of symplectic layers: a matrix, then the flow of a generator.

    Layer k sends x to W0[k] + the flow, by one implicit-midpoint step, of generator[k] from
    W1[k] x. Any values of the parameters give a symplectic layer. The design's generators are
    cubic; they agree with the second-order layers to second order, and every long-term tracking
    keeps its action. A change of a generator is the magnet's error (`multipoles`).

    Args:
        maps: names, places and read-outs.
        W0: constant kicks, [layer, n].
        W1: symplectic matrices, [layer, n, n]; fixed.
        generator: [layer, coefficient], see `network.generators`.

    Attributes:
        W0, generator: parameters.
        W1: a fixed tensor: a generator's quadratic part is equivalent to a change of it.
        design: the given generators, [layer, coefficient].
    """

    W1: Tensor
    design: Tensor

    def __init__(self, maps: RingMaps, W0: Array, W1: Array, generator: Array) -> None:
        super().__init__()
        self.maps = maps
        self.W0 = torch.nn.Parameter(torch.from_numpy(W0.copy()))
        self.generator = torch.nn.Parameter(torch.from_numpy(generator.copy()))
        self.register_buffer("W1", torch.from_numpy(W1.copy()))
        self.register_buffer("design", torch.from_numpy(generator.copy()))

    @classmethod
    def from_network(cls, network: Chain) -> "SymplecticNetwork":
        """Return layers that agree with a network's to second order.

        Args:
            network: a design, or a fitted one; its W1 are replaced by the nearest symplectic
                matrices (OCELOT's are symplectic to rounding), and its W2 by their Hamiltonian
                part.

        Raises:
            ValueError: a layer too far from symplectic.
        """
        W0, W1, W2 = network.weights()
        W1 = nearest_symplectic(W1)
        made = cls(network.maps, W0, W1, cubic_generator(W1, W2))
        made.ring = network.ring
        return made

    def copy(self) -> "SymplecticNetwork":
        """Return a copy with the same parameters and the same design."""
        W1 = self.W1.numpy()
        new = SymplecticNetwork(self.maps, self.W0.detach().numpy(), W1, self.design.numpy())
        new.load_state_dict(self.state_dict())
        new.ring = self.ring
        return new

    def symplectic(self) -> "SymplecticNetwork":
        """Return itself."""
        return self

    def correction(self) -> Array:
        """Change of the design's generators, [layer, coefficient]."""
        return np.asarray((self.generator - self.design).detach().numpy())

    def multipoles(self) -> dict[str, Array]:
        """Return the correction of each layer as multipoles, see `generators.multipoles`."""
        return multipoles(self.correction())

    def forward(self, launch: ArrayLike | Tensor) -> Tensor:
        """Return readings of every monitor on one pass, [batch, monitor, 2], m; differentiable.

        Raises:
            BeamLostError: names the layer where a trajectory was lost, or whose generator is so
                strong that its flow has no midpoint.
        """
        readings: Tensor = _FlowSweep.apply(  # type: ignore[no-untyped-call]
            self._launch(launch), self.W0, self.generator, self.W1.numpy(), self.maps
        )
        return readings

    def _fields(self) -> tuple[Array, Array, Array, Array, Array, Flags, Flags]:
        return self.W0.detach().numpy(), self.W1.numpy(), *_flow(self.generator.detach().numpy())

    def _forward(self, size: sweeps.Size, states: Array) -> None:
        middles = np.empty_like(states[:, 1:])
        sweeps.run(flows.forward, len(states), size, *self._fields(), states, middles)

    def _one_turn_fields(self) -> tuple[Array, Array, Array, Array, Array, Flags, Flags]:
        """The fields of all layers, and of the drift to the ring's end as a last one."""
        closing = [w[None] for w in self.maps.closing.coefficients]
        W1 = nearest_symplectic(closing[1])
        end = closing[0], W1, *_flow(cubic_generator(W1, closing[2]))
        both = zip(self._fields(), end, strict=True)
        W0, W1, c, A, Q, moves, flat = (np.concatenate(pair) for pair in both)
        return W0, W1, c, A, Q, moves, flat

    def _track(self, size: sweeps.Size, history: Array) -> None:
        W0, W1, *fields, moves, flat = self._one_turn_fields()
        # Inside a turn consecutive matrices are multiplied.
        ends = np.flatnonzero(moves | W0.any(axis=1))
        ends = np.unique([*ends, len(W1) - 1])
        rest = (w[ends] for w in (*fields, moves, flat))
        sweeps.run(flows.track, len(history), size, W0[ends], merged(W1, ends), *rest, history)

    def linearised(self) -> Callable[[Array], tuple[Array, Array]]:
        """Return what `LayerChain.linearised` states."""

        def tangents(x: Array) -> tuple[Array, Array]:
            path, steps = self.jacobians(x)
            return path, products(steps)

        return tangents

    def jacobians(self, x: Array) -> tuple[Array, Array]:
        """Return the same states, and the Jacobian of every layer and of the closing drift."""
        W0, W1, c, A, Q, moves, flat = self._one_turn_fields()
        size, states = sweeps.begun(np.asarray(x)[None], len(W0) + 1)
        middles = np.empty_like(states[:, 1:])
        sweeps.run(flows.forward, 1, size, W0, W1, c, A, Q, moves, flat, states, middles)
        slopes = A + np.einsum("kaij,kj->kai", second_derivatives(Q), middles[0, :, :, 0])
        half, one = 0.5 * slopes, np.eye(self.dimension)
        steps = np.linalg.solve(one - half, (one + half) @ W1)
        return states[0, :, :, 0], np.asarray(steps, dtype=float)
