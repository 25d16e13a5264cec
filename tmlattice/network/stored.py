"""A network's weights as a file."""

from io import BytesIO
from pathlib import Path

import torch

from tmlattice.errors import TmlatticeError
from tmlattice.input_files import zip_of
from tmlattice.lattice.ring import Ring
from tmlattice.network.network import TaylorNetwork


def save_network(network: torch.nn.Module, path: Path) -> None:
    """Write the parameters (W0, W1, W2) with torch, without the lattice."""
    content = BytesIO()
    torch.save(network.state_dict(), content)  # to memory: torch's error for a full disk is unclear
    path.write_bytes(content.getvalue())


def load_network(ring: Ring, path: Path) -> TaylorNetwork:
    """Return the network of a ring with the weights of a file (tensors alone: no code is run).

    Raises:
        TmlatticeError: no such file, no network's, or one of a ring of other magnets.
    """
    wanted = (
        f"the weights of a network of '{ring.name}'; name the network.pt that `tmlattice tune-fit` "
        "wrote for this lattice"
    )
    content = zip_of(path, TmlatticeError, wanted)
    try:
        weights = torch.load(content, map_location="cpu", weights_only=True)
        dimension = int(weights["W0"].shape[1])
        network = TaylorNetwork.from_ring(ring, dimension)
        network.load_state_dict(weights)
    except Exception as error:
        raise TmlatticeError(f"'{path}' does not contain {wanted}") from error
    return network
