"""Spaces of changes of a network: strengths of magnets, or generators.

A space changes its network's weights (`put`) and gives the effect of a unit of each amount: the
equivalent shift of the launch (`shifts`), and the Hessian that it adds to the quadratic Hamiltonian
(`hessians`).
"""

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from tmlattice.beam.chain import tangents
from tmlattice.beam.strengths import LARGEST, ring_strengths
from tmlattice.lattice import Ring
from tmlattice.maps.taylor import symplectic_form
from tmlattice.network.generators import exponents, field_matrix
from tmlattice.network.network import TaylorNetwork
from tmlattice.network.symplectic_network import SymplecticNetwork
from tmlattice.optics import normal_modes

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

STRENGTH_RMS = 0.01
"""Unit of a strength's amount, relative."""

GENERATOR_RMS = {1: 1e-7, 2: 1e-4, 3: 1e-3}
"""Unit of a generator's coefficient by degree: a kick in rad, a gradient in 1/m, a sextupole in
1/m2."""


class Space:
    """Amounts that change a network.

    Attributes:
        network: a copy, which is changed.
        layer: of each amount, rising, [amount].
        names: of the magnets, if amounts are their strengths; else empty.
        largest: largest amount.
    """

    network: TaylorNetwork | SymplecticNetwork
    layer: Indices
    names: tuple[str, ...] = ()
    largest: float = np.inf

    def put(self, amounts: Array) -> None:
        """Set the network to these amounts, [amount]."""
        raise NotImplementedError

    def shifts(self, amounts: Array, x: Array) -> tuple[Array, Array]:
        """Return Jacobians of the exits M [layer + 1, n, n] at these amounts and the launch x [n],
        and the shift of the launch for a unit of each amount, [amount, n]."""
        raise NotImplementedError

    def hessians(self, amounts: Array) -> Array:
        """Return Hessians of the quadratic Hamiltonian, at the layer's exit, for a unit of each
        amount, [amount, 4, 4]."""
        raise NotImplementedError

    def readings(self, amounts: Array, launches: Array) -> Array:
        """Return readings of the network with these amounts, [shot, monitor, 2], m.

        Raises:
            BeamLostError: names the layer.
        """
        self.put(amounts)
        return self.network.readings(launches)


class Strengths(Space):
    """Relative changes of strengths, in units of `STRENGTH_RMS`."""

    def __init__(self, network: TaylorNetwork, ring: Ring, kinds: Sequence[str]) -> None:
        self.network = network.copy().cpu()
        self.network.requires_grad_(False)
        self.known = ring_strengths(ring, kinds, network.dimension)
        self.layer = self.known.layer
        self.names = tuple(s.name for s in self.known.strengths)
        self.largest = 0.98 * LARGEST / STRENGTH_RMS

    def put(self, amounts: Array) -> None:
        """Set OCELOT's layers of the changed magnets."""
        weights = self.known.weights(STRENGTH_RMS * amounts)
        for parameter, weight in zip(self.network.parameters(), weights, strict=True):
            parameter[self.layer] = torch.from_numpy(weight)

    def shifts(self, amounts: Array, x: Array) -> tuple[Array, Array]:
        """Return the shifts from exact derivatives of the layers."""
        self.put(amounts)
        path, M, back = tangents(self.network, x)
        entrance = path[self.layer]
        i, j = np.triu_indices(len(x))
        d0, d1, d2 = self.known.slopes(STRENGTH_RMS * amounts)
        kick = d0 + np.einsum("jab,jb->ja", d1, entrance)
        kick += np.einsum("jam,jm->ja", d2, entrance[:, i] * entrance[:, j])
        return M, STRENGTH_RMS * np.einsum("jab,jb->ja", back[self.layer + 1], kick)

    def hessians(self, amounts: Array) -> Array:
        """Return the Hessians of the change of each layer's matrix."""
        changes = STRENGTH_RMS * amounts
        rate = self.known.slopes(changes)[1] @ np.linalg.inv(self.known.weights(changes)[1])
        return np.asarray(STRENGTH_RMS * symplectic_form(4).T @ rate[:, :4, :4])


class Generators(Space):
    """Coefficients of all layers' generators, in units of `GENERATOR_RMS`."""

    network: SymplecticNetwork

    def __init__(self, network: TaylorNetwork | SymplecticNetwork) -> None:
        self.network = network.symplectic().copy()
        self.network.requires_grad_(False)
        self.start = self.network.generator.detach().numpy().copy()
        rows = exponents(self.network.dimension)
        self.sizes = np.array([GENERATOR_RMS[sum(row)] for row in rows])
        self.layer = np.repeat(np.arange(len(self.start)), len(rows))

    def put(self, amounts: Array) -> None:
        """Set the generators; layers stay symplectic."""
        change = amounts.reshape(self.start.shape) * self.sizes
        self.network.generator.copy_(torch.from_numpy(self.start + change))

    def shifts(self, amounts: Array, x: Array) -> tuple[Array, Array]:
        """Return the shifts from derivatives of the flow."""
        self.put(amounts)
        _, M, D = self.network.signatures(x)
        return M, np.ascontiguousarray((D * self.sizes).swapaxes(1, 2)).reshape(-1, len(x))

    def hessians(self, amounts: Array) -> Array:
        """Return the Hessians, which do not depend on the amounts."""
        n = self.network.dimension
        slope = np.moveaxis(field_matrix(n)[:, 1 : n + 1], 2, 0) * self.sizes[:, None, None]
        return np.tile(symplectic_form(4).T @ slope[:, :4, :4], (len(self.start), 1, 1))


def tune_slopes(space: Space, amounts: Array) -> Array:
    """Return d (tunes) / d (amounts) [2, amount], on the closed orbit, linear part.

    A Hamiltonian with the Hessian h in a layer turns mode v by v^H h v / 2, in rad (v^H S v = 2 i);
    a pure gradient k gives beta k / 2. The effect of kicks through sextupoles is ignored.

    Raises:
        UnstableRingError: no tune exists.
    """
    space.put(amounts)
    network = space.network
    _, total = network.closed_orbit()
    total = total[:, :4, :4]
    v = (total[1:-1] @ normal_modes(total[-1])[1])[space.layer]
    turned = np.einsum("jav,jab,jbv->vj", v.conj(), space.hessians(amounts), v, optimize=True)
    return np.asarray(np.real(turned) / (4 * np.pi))
