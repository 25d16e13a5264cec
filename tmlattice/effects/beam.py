"""Errors of the beam."""

import numpy as np
from numpy.polynomial.hermite_e import hermegauss

from tmlattice.arrays import Array
from tmlattice.effects.effect import LaunchEffect, register

NODES = 5
"""Energies of a Gaussian spread: exact for readings to the ninth power of delta."""


@register
class EnergyOffset(LaunchEffect):
    """The beam's energy differs from that of the magnets' settings. All shots arrive with it; a
    stored beam has it, if the RF frequency does not match the circumference."""

    name = "energy_offset"
    words = "energy deviation of the beam"
    responds = True
    calibrates = True
    headline = True
    energy = True
    shifts = 5
    unit = "relative"
    sign = "p += amount: of the launch, common to all shots, or of the closed orbit"
    quantity = "energy deviation"
    recommended_action = "match the energy of the beam to the ring"
    to_check = (
        "Compare the injector's energy, or of a stored beam the frequency of the RF, with the "
        "field of the ring's bends, which may all have the opposite error."
    )
    largest = 5e-3

    def beams(self, launches: Array, amount: float) -> tuple[Array, Array]:
        """Return the launches at the other energy."""
        moved = launches.copy()
        moved[..., 5] += amount
        return np.ones(1), moved[None]


@register
class EnergySpread(LaunchEffect):
    """Particles of a shot differ in energy; a monitor reads their centroid."""

    name = "energy_spread"
    responds = True
    calibrates = True  # changes all readings
    words = "energy spread of the beam"
    energy = True
    one_sign = True
    unit = "relative"
    sign = "rms of the particles' relative energy deviation"
    quantity = "energy spread"
    recommended_action = "reduce the energy spread of the beam, or include it in the model"
    to_check = "Measure the injector's energy spread; check its RF phases."
    largest = 3e-3
    power = 2

    def beams(self, launches: Array, amount: float) -> tuple[Array, Array]:
        """Return weights and nodes of Gauss-Hermite quadrature."""
        nodes, weights = hermegauss(NODES)
        moved = np.repeat(launches[None], NODES, axis=0)
        moved[..., 5] += amount * nodes[:, None]
        return weights / weights.sum(), moved
