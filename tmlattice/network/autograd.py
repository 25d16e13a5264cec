"""The compiled sweeps as one autograd function, so that any torch loss and optimiser works."""

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tmlattice.errors import BeamLostError
from tmlattice.maps import RingMaps
from tmlattice.network import sweeps

Array = NDArray[np.float64]

APERTURE = 1.0
"""m and rad: far outside any beam pipe, and where second-order maps have lost all meaning."""


def curved(W2: Array) -> NDArray[np.bool_]:
    """Which layers have a second-order part at all: the sweeps skip it where it is zero."""
    return np.asarray(W2.any(axis=(1, 2)))


def check_alive(states: Array, maps: RingMaps, size: sweeps.Size, batch: int) -> None:
    """Raise where a trajectory of states [block, layer + 1, n, lane] has left the aperture.

    Raises:
        BeamLostError: names the trajectory and the layer where it was lost.
    """
    last = states[:, -1]
    if np.isfinite(last).all() and np.abs(last).max(initial=0.0) < APERTURE:
        return
    alive = np.abs(states) < APERTURE  # false for NaN too
    lost = ~np.all(alive, axis=2)  # [block, layer + 1, lane]
    anywhere = np.any(lost, axis=1)
    block, lane = np.unravel_index(int(anywhere.argmax()), anywhere.shape)
    exit_ = int(lost[block, :, lane].argmax())
    trajectory = int(block) * len(size[1]) + int(lane)
    where = f"in layer {exit_ - 1} ('{maps.layers[exit_ - 1]}')" if exit_ else "at the launch"
    raise BeamLostError(
        f"trajectory {trajectory} is lost {where}: a coordinate exceeds {APERTURE:g} m or rad; "
        "launch closer to the axis, or lower the learning rate"
    )


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
        size = sweeps.size_of(n, batch)
        start = sweeps.pack(launch.detach().numpy(), len(size[1]))
        states = np.empty((len(start), len(w0) + 1, n, len(size[1])))
        states[:, 0] = start
        bends = curved(w2)
        sweeps.run(sweeps.forward, len(start), size, w0, w1, w2, bends, states)
        check_alive(states, maps, size, batch)
        readings = np.empty((len(start), len(maps.at), 2, len(size[1])))
        bent = curved(maps.R2)
        sweeps.run(
            sweeps.read, len(start), size, maps.R0, maps.R1, maps.R2, bent, maps.at, states,
            readings,
        )  # fmt: skip
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
