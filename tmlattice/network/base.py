"""What every network has: launches as tensors or arrays, states and turns of its chain."""

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from tmlattice.beam.chain import LayerChain

Array = NDArray[np.float64]


class NetworkChain(torch.nn.Module, LayerChain):
    """What every network has: launches as tensors or arrays; states and turns of its chain."""

    def extra_repr(self) -> str:
        """For print(network)."""
        return (
            f"layers={len(self.layers)}, monitors={len(self.monitors)}, dimension={self.dimension}"
        )

    def _launch(self, launch: ArrayLike | Tensor) -> Tensor:
        if not isinstance(launch, Tensor):
            return torch.from_numpy(super()._start(launch))
        if launch.ndim != 2 or launch.shape[1] != self.dimension:
            raise ValueError(
                f"launch has the shape {tuple(launch.shape)}; it should be "
                f"[batch, {self.dimension}]"
            )
        return launch.to(torch.float64).contiguous()

    def _start(self, launch: ArrayLike | Tensor) -> Array:
        return np.asarray(self._launch(launch).detach().numpy())
