"""The network: weights stacked over layers, readings of a launch, tracking; its file."""

from enum import StrEnum
from importlib import import_module
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from tmlattice.arrays import Array
from tmlattice.beam import sweeps
from tmlattice.beam.aperture import APERTURE, bounded, lost_beam
from tmlattice.beam.chain import Chain, first_pass
from tmlattice.beam.sweeps import curved
from tmlattice.errors import TmlatticeError, choice, missing_package
from tmlattice.input_files import zip_of
from tmlattice.lattice.ring import Ring
from tmlattice.maps import RingMaps
from tmlattice.network.autograd import BackEnd, Sweep, Tensors
from tmlattice.network.base import NetworkChain
from tmlattice.network.reference import monomials, packed, plain_pass
from tmlattice.network.symplectic_network import SymplecticNetwork


class OnLost(StrEnum):
    """Treatment of a lost trajectory."""

    RAISE = "raise"
    INF = "inf"


class CompiledSweep:
    """See `autograd.BackEnd`; the forward sweep stores the states of all exits."""

    def __init__(self, maps: RingMaps, r: Tensor, start: Tensor) -> None:
        self.maps, self.r, self.start = maps, r, start

    def forward(self, launch: Tensor, weights: Tensors) -> tuple[Tensor, Tensor, Tensor]:
        """One pass through all layers."""
        own = [w.detach().numpy() for w in weights]
        states, readings = first_pass(own, self.maps, launch.detach().numpy())
        both = (sweeps.unpack(values, len(launch)) for values in (readings, states[:, -1]))
        read, end = map(torch.from_numpy, both)
        return read, end, torch.from_numpy(states)

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


class TaylorNetwork(NetworkChain, Chain):
    """A ring as a chain of second-order layers, one per magnet, read by its monitors.

    Layer k sends the state x at the exit of magnet k - 1 to W0[k] + W1[k] x + W2[k] x^[2] at the
    exit of magnet k. States are OCELOT's (x, px, y, py), or (x, px, y, py, tau, p), in m and
    units of the reference momentum. All weights are float64 and of their layer alone.

    `network.to("cuda")` moves it, and all its computations, to a graphics card.

    Attributes:
        W0: [layer, n], parameter.
        W1: [layer, n, n], parameter.
        W2: [layer, n, n (n + 1) / 2], parameter, in the order x1^2, x1 x2, ..., xn^2.
        maps, ring: arguments; names and places of layers and monitors.

    Source: A. Ivanov, I. Agapov, Phys. Rev. Accel. Beams 23 (2020) 074601, for the architecture.
    """

    DEVICES = ("cpu", "cuda")
    _read_outs: Tensor
    _closing: Tensor
    _first_monitor: Tensor

    def __init__(self, maps: RingMaps) -> None:
        torch.nn.Module.__init__(self)
        self.maps = maps
        self.W0 = torch.nn.Parameter(torch.from_numpy(maps.W0.copy()))
        self.W1 = torch.nn.Parameter(torch.from_numpy(maps.W1.copy()))
        self.W2 = torch.nn.Parameter(torch.from_numpy(maps.W2.copy()))
        read_outs = (torch.from_numpy(r) for r in (maps.R0, maps.R1, maps.R2))
        closing = (torch.from_numpy(c) for c in maps.closing.coefficients)
        for name, fixed in (  # moved by `.to`, and no part of `state_dict`
            ("_read_outs", packed(*read_outs)),
            ("_closing", packed(*closing)),
            ("_first_monitor", torch.from_numpy(maps.start)),
        ):
            self.register_buffer(name, fixed, persistent=False)

    def symplectic(self) -> SymplecticNetwork:
        """Return the same ring in layers that are symplectic for any parameters."""
        return SymplecticNetwork.from_network(self)

    def weights(self) -> tuple[Array, Array, Array]:
        """W0, W1, W2 as numpy arrays; on the CPU they share the parameters' memory: read-only."""
        W0, W1, W2 = (w.detach().cpu().numpy() for w in (self.W0, self.W1, self.W2))
        return W0, W1, W2

    def copy(self) -> "TaylorNetwork":
        """Return a copy with the same weights."""
        new = TaylorNetwork(self.maps).to(self.W0.device)
        new.ring = self.ring
        new.load_state_dict(self.state_dict())
        return new

    def sweep(self) -> BackEnd:
        """Back end for the device of the weights."""
        if self.W0.is_cuda:
            on_card: BackEnd = _cuda().TritonSweep(self._read_outs, self._first_monitor)
            return on_card
        return CompiledSweep(self.maps, self._read_outs, self._first_monitor)

    def forward(
        self,
        launch: ArrayLike | Tensor,
        turns: int | None = None,
        *,
        on_lost: OnLost | str = "raise",
    ) -> Tensor:
        """Return readings of every monitor, differentiable by launch and weights.

        First derivatives are fast. Second ones (`create_graph=True`) are exact and take seconds:
        they come from a loop of torch operations (`plain_readings`). Of `torch.func`, `grad` and
        `vjp` work; `vmap` and `jvp` raise errors.

        Args:
            launch: states at the start of the ring, [batch, n].
            turns: number of turns; None: the first one, without an axis for it.
            on_lost: "raise" an error for a lost trajectory, or let its readings be "inf" from that
                turn on: it then adds nothing to a gradient.

        Returns:
            (x, y) in m, [batch, monitor, 2]; with `turns`, [batch, turn, monitor, 2].

        Raises:
            BeamLostError: names the layer where a trajectory was lost.
            ChoiceError: another value of `on_lost`.
            ValueError: a launch of another shape, or no turn.
        """
        on_lost = choice("on_lost", on_lost, OnLost)
        if turns is not None and turns < 1:
            raise ValueError(f"{turns} turns have no reading; read at least one")
        x = self._launch(launch)
        every = x.new_full((len(x), len(self.monitors), 2), torch.inf)
        rows = torch.arange(len(x), device=x.device)
        passes = []
        for turn in range(turns or 1):
            readings, end = self._pass(x)
            alive = self._inside(end.detach())
            if not alive.all():
                if on_lost is OnLost.RAISE:
                    first = int(alive.to(torch.int8).argmin())
                    raise lost_beam(self.states(x[[first]])[0], first, self.maps, turn)
                x, rows = x[alive], rows[alive]
                readings, end = self._pass(x)
            passes.append(readings if len(x) == len(every) else every.index_copy(0, rows, readings))
            if turns is not None and turn + 1 < turns:
                x = monomials(end) @ self._closing.mT
        return passes[0] if turns is None else torch.stack(passes, dim=1)

    @torch.no_grad()
    def one_turn(self, launch: ArrayLike | Tensor) -> tuple[Tensor, Tensor]:
        """Return readings of every monitor [batch, monitor, 2], and the states at the end of the
        turn [batch, n]; NaN where the beam is lost in it. Not differentiable.

        Args:
            launch: states at the start of the ring, [batch, n].
        """
        readings, end = self._pass(self._launch(launch))
        state = monomials(end) @ self._closing.mT
        lost = ~self._inside(state)
        state[lost] = readings[lost] = torch.nan
        return readings, state

    @staticmethod
    def _inside(states: Tensor) -> Tensor:
        """See `aperture.lost`."""
        return (states[:, bounded(states.shape[1])].abs() < APERTURE).all(dim=1)  # false for NaN

    def _pass(self, launch: Tensor) -> tuple[Tensor, Tensor]:
        """Readings, and states behind the last layer."""
        readings, end, _ = Sweep.apply(  # type: ignore[no-untyped-call]
            launch, self.W0, self.W1, self.W2, self.sweep()
        )
        return readings, end

    def _turns(self, start: Array, turns: int) -> Array:
        if not self.W0.is_cuda:
            return super()._turns(start, turns)
        with torch.no_grad():
            layers = packed(self.W0, self.W1, self.W2)
            turn = torch.cat([layers, self._closing[None]])
            launch = torch.from_numpy(start).to(turn.device)
            return np.asarray(_cuda().track(launch, turn, turns).cpu().numpy())


def _cuda() -> Any:
    try:
        return import_module("tmlattice.network.cuda")
    except ModuleNotFoundError as error:
        raise missing_package(error, "networks on a graphics card need", "cuda") from error


def plain_readings(network: TaylorNetwork, launch: Tensor) -> Tensor:
    """Return readings [batch, monitor, 2] of launch [batch, n] by a loop of torch operations.

    The same mathematics as `network(launch)`, differentiated by torch alone: any order, any
    `torch.func` transform.
    """
    weights = network.W0, network.W1, network.W2
    return plain_pass(launch, weights, network._read_outs, network._first_monitor)[0]


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
