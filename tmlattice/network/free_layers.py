"""A network with some free layers, in named groups for an optimiser."""

from collections.abc import Mapping, Sequence
from fnmatch import fnmatchcase

import torch
from numpy.typing import ArrayLike
from torch import Tensor

from tmlattice.errors import LatticeError
from tmlattice.network.network import TaylorNetwork


class FreeLayers(torch.nn.Module):
    """A network whose parameters are the weights of chosen layers; all others are fixed.

    >>> part = FreeLayers(network, {"defocusing": "qd*", "sextupoles": "sextupole"})
    >>> optimiser = torch.optim.Adam([
    ...     {"params": part.groups["defocusing"].parameters(), "lr": 1e-6},
    ...     {"params": part.groups["sextupoles"].parameters(), "lr": 1e-3},
    ... ])

    Args:
        network: initial weights; it is not changed.
        groups: for every name of a group a kind of magnet ("quadrupole"), a pattern of names
            ("qd*"), or names.
        weights: free ones of W0, W1, W2. A magnet without a field on the axis has no W0, and free
            kicks explain any orbit: by default they are fixed.

    Attributes:
        groups: parameters by group, then by weight, [layer of the group, ...].
        layers: of every group, the numbers of its layers.

    Raises:
        LatticeError: a group without a layer, or two groups with the same one.
    """

    network: TaylorNetwork
    groups: torch.nn.ModuleDict

    def __init__(
        self,
        network: TaylorNetwork,
        groups: Mapping[str, str | Sequence[str]],
        weights: Sequence[str] = ("W1", "W2"),
    ) -> None:
        super().__init__()
        self.network = network.copy().requires_grad_(False)
        self.groups = torch.nn.ModuleDict()
        self.layers: dict[str, list[int]] = {}
        for name, which in groups.items():
            layers = _layers(network, which)
            if not layers:
                raise LatticeError(f"group '{name}': no layer is a '{which}' or has such a name")
            for other, taken in self.layers.items():
                if both := sorted({*layers} & {*taken}):
                    raise LatticeError(
                        f"groups '{other}' and '{name}' share the layer '{network.layers[both[0]]}'"
                    )
            self.layers[name] = layers
            self.groups[name] = torch.nn.ParameterDict(
                {w: getattr(network, w).detach()[layers].clone() for w in weights}
            )

    def merged(self) -> TaylorNetwork:
        """Return a copy of the network with the present weights."""
        new = self.network.copy()
        with torch.no_grad():
            for name, weight in self._weights().items():
                getattr(new, name).copy_(weight)
        return new.requires_grad_(True)

    def forward(
        self, launch: ArrayLike | Tensor, turns: int | None = None, *, on_lost: str = "raise"
    ) -> Tensor:
        """Return readings, see `TaylorNetwork.forward`."""
        options = {"turns": turns, "on_lost": on_lost}
        readings: Tensor = torch.func.functional_call(
            self.network, self._weights(), (launch,), options
        )
        return readings

    def _weights(self) -> dict[str, Tensor]:
        whole: dict[str, Tensor] = dict(self.network.named_parameters())
        for name, group in self.groups.items():
            place = torch.tensor(self.layers[name], device=self.network.W0.device)
            for weight, moved in group.named_parameters():
                whole[weight] = whole[weight].index_copy(0, place, moved)
        return whole


def _layers(network: TaylorNetwork, which: str | Sequence[str]) -> list[int]:
    if not isinstance(which, str):
        return [k for k, name in enumerate(network.layers) if name in set(which)]
    kinds = [m.kind for m in network.ring.magnets] if network.ring else [""] * len(network.layers)
    both = enumerate(zip(network.layers, kinds, strict=True))
    return [k for k, (name, kind) in both if kind == which or fnmatchcase(name, which)]
