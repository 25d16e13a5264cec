"""The back end of the CPU: compiled sweeps over blocks of trajectories."""

import numpy as np
import torch
from torch import Tensor

from tmlattice.beam import sweeps
from tmlattice.beam.sweeps import curved
from tmlattice.maps import RingMaps
from tmlattice.network.autograd import Tensors


class CompiledSweep:
    """See `autograd.BackEnd`; the forward sweep stores the states of all exits."""

    def __init__(self, maps: RingMaps, r: Tensor, start: Tensor) -> None:
        self.maps, self.r, self.start = maps, r, start

    def forward(self, launch: Tensor, weights: Tensors) -> tuple[Tensor, Tensor, Tensor]:
        """One pass through all layers."""
        batch, n = launch.shape
        W0, W1, W2 = (w.detach().numpy() for w in weights)
        size = sweeps.size_of(n, batch)
        packed = sweeps.pack(launch.detach().numpy(), len(size[1]))
        states = np.empty((len(packed), len(W0) + 1, *packed.shape[1:]))
        states[:, 0] = packed
        sweeps.run(sweeps.forward, len(packed), size, W0, W1, W2, curved(W2), states)
        maps = self.maps
        readings = np.empty((len(packed), len(maps.at), 2, len(size[1])))
        out = maps.R0, maps.R1, maps.R2, curved(maps.R2), maps.at
        sweeps.run(sweeps.read, len(packed), size, *out, states, readings)
        end = sweeps.unpack(states[:, -1], batch)
        return (
            torch.from_numpy(sweeps.unpack(readings, batch)),
            torch.from_numpy(end),
            torch.from_numpy(states),
        )

    def backward(
        self, launch: Tensor, weights: Tensors, kept: Tensor, pulls: Tensors, wanted: bool
    ) -> tuple[Tensor, tuple[Tensor | None, ...]]:
        """The adjoint sweep, then sums over trajectories."""
        batch, n = launch.shape
        _, W1, W2 = (w.detach().numpy() for w in weights)
        states, size, maps = kept.numpy(), sweeps.size_of(n, batch), self.maps
        packed, end = (sweeps.pack(p.contiguous().numpy(), len(size[1])) for p in pulls)
        adjoint = np.empty_like(states)
        adjoint[:, -1] = end
        sweeps.run(
            sweeps.reverse, len(states), size, W1, W2, curved(W2), maps.R1, maps.R2,
            curved(maps.R2), maps.start, states, packed, adjoint,
        )  # fmt: skip
        gradients: tuple[Tensor | None, ...] = (None, None, None)
        if wanted:
            sums = np.zeros(W1.shape[:2]), np.zeros_like(W1), np.zeros_like(W2)
            sweeps.run(sweeps.weights, len(W1), size, states, adjoint, *sums)
            gradients = tuple(torch.from_numpy(g) for g in sums)
        return torch.from_numpy(sweeps.unpack(adjoint[:, 0], batch)), gradients
