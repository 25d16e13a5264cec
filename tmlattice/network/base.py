"""Common part of networks: launches as tensors or arrays, states and turns of the chain."""

from collections.abc import Callable
from typing import Self

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from tmlattice.arrays import Array
from tmlattice.beam.chain import LayerChain


class NetworkChain(torch.nn.Module, LayerChain):
    """Common part of networks: launches as tensors or arrays; states and turns of the chain."""

    W0: torch.nn.Parameter
    DEVICES: tuple[str, ...] = ("cpu",)

    def extra_repr(self) -> str:
        """Return the text for print(network)."""
        return (
            f"layers={len(self.layers)}, monitors={len(self.monitors)}, dimension={self.dimension}"
        )

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        """Apply `.to`, `.float`, `.cuda`, ... to every tensor; TypeError: another type than
        float64, or a device without sweeps."""
        after = fn(torch.empty(0, dtype=torch.float64, device=self.W0.device))
        if after.dtype != torch.float64:
            raise TypeError(
                f"a network computes in float64, not {str(after.dtype).removeprefix('torch.')}: a "
                "turn has some 1500 layers, and a tune needs all digits; convert its readings, "
                "network(launch).float()"
            )
        if after.device.type not in self.DEVICES:
            raise TypeError(
                f"{type(self).__name__} does not run on '{after.device}'; it runs on "
                f"{' and '.join(self.DEVICES)}"
            )
        result: Self = super()._apply(fn, recurse)  # type: ignore[no-untyped-call]
        return result

    def _launch(self, launch: ArrayLike | Tensor) -> Tensor:
        if not isinstance(launch, Tensor):
            return torch.from_numpy(super()._start(launch)).to(self.W0.device)
        if launch.ndim != 2 or launch.shape[1] != self.dimension:
            raise ValueError(
                f"launch has the shape {tuple(launch.shape)}; it should be "
                f"[batch, {self.dimension}]"
            )
        return launch.to(self.W0.device, torch.float64).contiguous()

    def _start(self, launch: ArrayLike | Tensor) -> Array:
        return np.asarray(self._launch(launch).detach().cpu().numpy())

    def readings(self, launch: ArrayLike | Tensor) -> Array:
        """Return (x, y) at every monitor on one pass as an array, [batch, monitor, 2], m."""
        with torch.no_grad():
            return np.asarray(self(launch).cpu().numpy())
