"""The compiled sweeps as one autograd function, so that any torch loss and optimiser works."""

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tmlattice.beam import sweeps
from tmlattice.beam.chain import first_pass
from tmlattice.beam.sweeps import curved
from tmlattice.maps import RingMaps

Array = NDArray[np.float64]


class Sweep(torch.autograd.Function):
    """(launch [batch, n], W0, W1, W2) -> readings [batch, monitor, 2] and exits' states.

    The backward pass is the adjoint sweep: it costs about two forward sweeps, whatever the number
    of weights.
    """

    @staticmethod
    def forward(  # type: ignore[override]
        ctx: Any, launch: Tensor, W0: Tensor, W1: Tensor, W2: Tensor, maps: RingMaps
    ) -> Tensor:
        """Readings of one pass through all layers."""
        w0, w1, w2 = (w.detach().numpy() for w in (W0, W1, W2))
        batch, n = launch.shape
        states, readings = first_pass((w0, w1, w2), maps, launch.detach().numpy())
        size, bends, bent = sweeps.size_of(n, batch), curved(w2), curved(maps.R2)
        ctx.save_for_backward(W1, W2)
        ctx.kept = (maps, size, states, bends, bent, batch)
        return torch.from_numpy(sweeps.unpack(readings, batch))

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, pulls: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        """Gradients with respect to the launch and to all weights."""
        W1, W2 = (w.detach().numpy() for w in ctx.saved_tensors)
        maps, size, states, bends, bent, batch = ctx.kept
        packed = sweeps.pack(np.ascontiguousarray(pulls.numpy()), len(size[1]))
        adjoint = np.empty_like(states)
        sweeps.run(
            sweeps.reverse, len(states), size, W1, W2, bends, maps.R1, maps.R2, bent, maps.start,
            states, packed, adjoint,
        )  # fmt: skip
        gradients: list[Tensor | None] = [None, None, None]
        if any(ctx.needs_input_grad[1:4]):
            g0, g1, g2 = np.zeros(W1.shape[:2]), np.zeros_like(W1), np.zeros_like(W2)
            sweeps.run(sweeps.weights, len(W1), size, states, adjoint, g0, g1, g2)
            gradients = [torch.from_numpy(g) for g in (g0, g1, g2)]
        launch = torch.from_numpy(sweeps.unpack(adjoint[:, 0], batch))
        return launch, *gradients, None
