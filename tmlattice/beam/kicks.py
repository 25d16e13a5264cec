"""Orbit and dispersion of the closed orbit's own kicks.

The kicks of a stored beam (errors of bends, displaced quadrupoles, correctors that compensate them)
are weaker at higher energy, by the relative energy. They hardly show in the orbit, in which they
were made to cancel. They show in the dispersion, where no gradient makes the same contribution.
"""

from collections.abc import Sequence

import numpy as np

from tmlattice.arrays import Array, Indices
from tmlattice.beam.closed_orbit import ResponseModel
from tmlattice.lattice import Ring

KICKING = ({"bend", "quadrupole", "hcorrector"}, {"bend", "quadrupole", "vcorrector"})
"""Kinds of magnets that kick a closed orbit, in x and in y."""


def kicking(ring: Ring, plane: int) -> Indices:
    """Indices of the magnets that kick in a plane."""
    return np.array([i for i, e in enumerate(ring.magnets) if e.kind in KICKING[plane]], dtype=int)


def orbits_of_kicks(
    model: ResponseModel,
    sources: Sequence[int] | Indices,
    exits: Indices,
    rows: Array,
    kicks: Array | int,
) -> Array:
    """Closed orbit for a kick behind each of some magnets, m, [place, source].

    Args:
        exits: number of magnets before each place, [place].
        rows: d orbit / d state there, [place, n].
        kicks: changes of the state, [source, n]; or the plane, for 1 rad each.
    """
    behind = np.asarray(sources) + 1
    if isinstance(kicks, int):
        kicks = np.tile(np.eye(model.dimension)[2 * kicks + 1], (len(behind), 1))
    launch_kick = np.einsum("kij,kj->ki", model.inverse[behind], kicks)
    start = launch_kick @ model.closing.T
    return np.asarray(rows @ start.T + (exits[:, None] >= behind) * (rows @ launch_kick.T))


def dispersion_of_kicks(model: ResponseModel, step: float, plane: int) -> Array:
    """Change of an RF step's orbit by a kick of 1 rad behind each magnet that kicks in a plane, m,
    [monitor, source].

    A particle of higher energy is kicked less. Away from the axis its path is longer by the same
    share, which changes the energy of the step.

    Args:
        plane: 0 or 1.
    """
    rows = model.reading_slopes[:, plane]
    sources = kicking(model.ring, plane)
    orbits = orbits_of_kicks(model, sources, model.maps.at, rows, plane)
    own = rows @ model.rf_start / model.rf_start[5]
    whole = orbits + own[:, None] * _energies(model, plane)
    return np.asarray(-step * model.rf_start[5] * whole)


def dispersion_behind(model: ResponseModel, layers: Sequence[int] | Indices, plane: int) -> Array:
    """Change of the dispersion behind some layers by a kick of 1 rad behind each magnet that kicks
    in a plane, m per relative energy, [layer, source] (plane: 0 or 1)."""
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
    """Relative energy at a fixed frequency for a path that is longer by a metre, 1/m; a kick of
    1 rad lengthens it by the dispersion at its position."""
    return float(-model.rf_start[5] / model.slip)


def by_energy(
    model: ResponseModel,
    names: Sequence[str],
    at: Indices,
    at_monitors: Array,
    at_correctors: Array,
) -> Array:
    """Change of correctors' orbits at a fixed frequency by a dispersion beyond the model's, m/rad,
    [corrector, monitor, 2].

    A corrector's orbit is longer by its kick times the dispersion at its position, and the energy
    follows. As the map is symplectic, the dispersion at correctors counts as much as that at
    monitors.

    Args:
        at: indices of the monitors among the ring's, [monitor].
        at_monitors: the RF's orbit over the energy of its step in the model, m, [monitor, 2].
        at_correctors: in the plane of each, m per relative energy, [corrector].
    """
    own = model.rf_response()[at] / model.rf_start[5]
    energy = model.columns(names).start[:, 5]
    more = energy_of_way(model) * at_correctors
    return np.asarray((energy + more)[:, None, None] * at_monitors + more[:, None, None] * own)
