"""The network: weights stacked over layers, readings of a launch, tracking over many turns."""

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from tmlattice.beam.chain import Chain
from tmlattice.maps import RingMaps
from tmlattice.network.autograd import Sweep
from tmlattice.network.base import NetworkChain
from tmlattice.network.symplectic_network import SymplecticNetwork

Array = NDArray[np.float64]


class TaylorNetwork(NetworkChain, Chain):
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
        torch.nn.Module.__init__(self)
        self.maps = maps
        self.W0 = torch.nn.Parameter(torch.from_numpy(maps.W0.copy()))
        self.W1 = torch.nn.Parameter(torch.from_numpy(maps.W1.copy()))
        self.W2 = torch.nn.Parameter(torch.from_numpy(maps.W2.copy()))

    def symplectic(self) -> SymplecticNetwork:
        """The same ring in layers that are symplectic exactly, and stay so whatever is fitted.

        See `SymplecticNetwork`.
        """
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
