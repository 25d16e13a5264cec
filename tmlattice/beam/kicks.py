"""What the closed orbit's own kicks do: the orbit that they make, and the dispersion.

Whatever kicks a stored beam (errors of bends, displaced quadrupoles, correctors that put its orbit
straight) kicks it less where its energy is higher, by the share of the energy. The orbit hardly
tells these kicks, for they were made to cancel in it; the dispersion does, and no gradient makes
what they add to it.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from tmlattice.beam.closed_orbit import ResponseModel
from tmlattice.lattice import Ring

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

KICKING = ({"bend", "quadrupole", "hcorrector"}, {"bend", "quadrupole", "vcorrector"})
"""Magnets that a closed orbit has its kicks of, in x and in y."""


def kicking(ring: Ring, plane: int) -> Indices:
    """The magnets that kick in a plane, as their places among the ring's magnets."""
    return np.array([i for i, e in enumerate(ring.magnets) if e.kind in KICKING[plane]], dtype=int)


def orbits_of_kicks(
    model: ResponseModel, sources: Sequence[int] | Indices, exits: Indices, rows: Array, plane: int
) -> Array:
    """Closed orbit by a kick of 1 rad behind each of some magnets, m, [place, source].

    Args:
        model: of the ring.
        sources: magnets.
        exits: of how many magnets each place is behind, [place].
        rows: d orbit / d state there, [place, n].
        plane: of the kicks.
    """
    behind = np.asarray(sources) + 1
    kick = np.zeros((len(behind), model.dimension))
    kick[:, 2 * plane + 1] = 1.0
    launch_kick = np.einsum("kij,kj->ki", model.inverse[behind], kick)
    start = launch_kick @ model.closing.T
    return np.asarray(rows @ start.T + (exits[:, None] >= behind) * (rows @ launch_kick.T))


def dispersion_of_kicks(model: ResponseModel, step: float, plane: int) -> Array:
    """What a step of the RF adds to the orbit at the monitors by a kick of 1 rad behind each magnet
    that kicks in a plane, m, [monitor, source].

    A particle of more energy is kicked less; and as it passes beside the axis its way is longer
    there by as much, so that another energy belongs to the step.

    Args:
        model: of the ring, six coordinates.
        step: relative, of the frequency.
        plane: 0 or 1.
    """
    rows = model.reading_slopes[:, plane]
    sources = kicking(model.ring, plane)
    orbits = orbits_of_kicks(model, sources, model.maps.at, rows, plane)
    own = rows @ model.rf_start / model.rf_start[5]
    whole = orbits + own[:, None] * _energies(model, plane)
    return np.asarray(-step * model.rf_start[5] * whole)


def dispersion_behind(model: ResponseModel, layers: Sequence[int] | Indices, plane: int) -> Array:
    """What a kick of 1 rad behind each magnet that kicks in a plane adds to the dispersion behind
    some layers, m per relative energy, [layer, source].

    Args:
        model: of the ring, six coordinates.
        layers: behind which.
        plane: 0 or 1.
    """
    behind = np.asarray(layers) + 1
    rows = model.tangents[behind][:, 2 * plane]
    orbits = orbits_of_kicks(model, kicking(model.ring, plane), behind, rows, plane)
    own = rows @ model.rf_start / model.rf_start[5]
    return np.asarray(own[:, None] * _energies(model, plane) - orbits)  # at a fixed energy


def _energies(model: ResponseModel, plane: int) -> Array:
    """Relative energy by a kick of 1 rad behind each magnet that kicks in a plane, [1, source]."""
    start, last = np.zeros(1, dtype=int), np.eye(model.dimension)[[5]]
    return orbits_of_kicks(model, kicking(model.ring, plane), start, last, plane)


def energy_of_way(model: ResponseModel) -> float:
    """Relative energy that a fixed frequency asks for, of a way that is longer by a metre, 1/m: a
    kick of 1 rad lengthens it by the dispersion where it stands."""
    return float(-model.rf_start[5] / model.slip)


def by_energy(
    model: ResponseModel,
    names: Sequence[str],
    at: Indices,
    at_monitors: Array,
    at_correctors: Array,
) -> Array:
    """What a dispersion that the model does not have adds to correctors' orbits at a fixed
    frequency, m/rad, [corrector, monitor, 2].

    A corrector's orbit is longer by its kick times the dispersion where it stands, and the energy
    follows: the kicks that a particle of another energy misses lengthen its way, for their map is
    symplectic. So the dispersion at correctors counts as much as that at monitors.

    Args:
        model: of the ring, six coordinates.
        names: of the correctors.
        at: the monitors' places among the ring's, [monitor].
        at_monitors: the RF's orbit over the energy that its step makes in the model, m, [monitor,
            2].
        at_correctors: in the plane of each, m per relative energy, [corrector].
    """
    own = model.rf_response()[at] / model.rf_start[5]
    energy = model.columns(names).start[:, 5]
    more = energy_of_way(model) * at_correctors
    return np.asarray((energy + more)[:, None, None] * at_monitors + more[:, None, None] * own)
