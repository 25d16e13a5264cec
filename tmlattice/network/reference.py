"""The plain torch loop over layers: slow, obvious, and the referee of the compiled sweeps."""

import torch
from torch import Tensor

from tmlattice.network.network import TaylorNetwork


def plain_readings(network: TaylorNetwork, launch: Tensor) -> Tensor:
    """Readings [batch, monitor, 2] of launch [batch, n] by a loop of torch operations.

    The same mathematics as `network(launch)`, differentiated by torch alone.
    """
    maps = network.maps
    i, j = torch.triu_indices(network.dimension, network.dimension)
    R0, R1, R2 = (torch.from_numpy(r) for r in (maps.R0, maps.R1, maps.R2))
    readings = []
    state = launch

    def read_at(exit_: int) -> None:
        for m in range(int(maps.start[exit_]), int(maps.start[exit_ + 1])):
            products = state[:, i] * state[:, j]
            readings.append(R0[m] + state @ R1[m].T + products @ R2[m].T)

    read_at(0)
    for k in range(len(network.layers)):
        products = state[:, i] * state[:, j]
        state = network.W0[k] + state @ network.W1[k].T + products @ network.W2[k].T
        read_at(k + 1)
    return torch.stack(readings, dim=1)
