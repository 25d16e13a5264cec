"""The ring as a network: one unshared second-order layer per magnet, one read-out per monitor.

>>> network = TaylorNetwork.from_ring(load_ring("petra3"))
>>> network(launch)                     # readings [batch, monitor, 2], differentiable
>>> network.track(launch, turns=500)    # states [batch, turns + 1, n]
>>> symplectic_penalty(network.W1, network.W2).sum()
"""

from tmlattice.errors import missing_package

try:
    from tmlattice.network.free_layers import FreeLayers
    from tmlattice.network.network import (
        TaylorNetwork,
        load_network,
        plain_readings,
        save_network,
    )
    from tmlattice.network.symplectic import penalty_parts, symplectic_penalty
    from tmlattice.network.symplectic_network import SymplecticNetwork
except ModuleNotFoundError as error:  # torch, which a diagnosis does not need
    raise missing_package(error, "networks, and fits of their weights, need", "network") from error

__all__ = [
    "FreeLayers",
    "SymplecticNetwork",
    "TaylorNetwork",
    "load_network",
    "penalty_parts",
    "plain_readings",
    "save_network",
    "symplectic_penalty",
]
