"""A stored beam: turns after a kick, of one particle or of many, and tunes."""

import functools
from dataclasses import dataclass
from typing import Any

import at
import numpy as np

from tmlattice.arrays import Array
from tmlattice.errors import UnstableRingError
from tmlattice.machine import at_orbit
from tmlattice.machine.at_engine import AtEngine, Settings
from tmlattice.machine.network_engine import NetworkEngine

TRANSVERSE, ALL = (0, 1, 2, 3), (0, 1, 2, 3, 4, 5)
ENERGY = 1e-3
"""Half the step in energy of a chromaticity."""


@dataclass(frozen=True)
class Beam:
    """Particles of a stored beam; one is the centroid alone, which does not decohere.

    Attributes:
        emittance: of the two modes, m rad.
    """

    particles: int = 1
    emittance: tuple[float, float] = (0.0, 0.0)
    spread: float = 0.0


def turns_of(
    engine: AtEngine | NetworkEngine,
    kicked: Array,
    turns: int,
    settings: Settings,
    beam: Beam,
    random: np.random.Generator,
) -> Array:
    """Return the centroid of a stored beam after a kick, [turn, monitor, 2], m.

    It is stored on the closed orbit of the ring with its errors, and with its RF, and matched to
    it. Lost particles no longer count; the beam is lost (NaN) with half of them.

    Args:
        kicked: change of x, px, y, py by the kick at the start of the ring, m and rad, [4].
    """
    line, with_rf, late = engine.stored_line(settings)
    state = stored_orbit(engine, line, late)
    rf = with_rf != line
    if rf:
        state = at_orbit.closed(functools.partial(engine.one_pass, with_rf), state, ALL, late)
    states = np.tile(state, (beam.particles, 1))
    if beam.particles > 1:
        states += _matched(engine, with_rf, state, rf, beam, random)
    states[:, :4] += kicked
    moving = np.asfortranarray(states.T)
    seen = engine.centroids(with_rf, moving, turns)
    return np.array([np.where(alive[:, None] > 0.5, mean, np.nan) for mean, alive in seen])


def tunes_of(engine: AtEngine, settings: Settings) -> tuple[Array, Array]:
    """Return tunes in [0, 1) and chromaticities dQ / d delta of the stored beam, each [mode]."""
    line, _, late = engine.stored_line(settings)
    state = stored_orbit(engine, line, late)
    turn = functools.partial(engine.one_pass, line)
    tune = _tunes(turn, state)
    slopes = []
    for step in (ENERGY, -ENERGY):
        other = at_orbit.closed(turn, state + step * np.eye(6)[4], TRANSVERSE)
        slopes.append((_tunes(turn, other) - tune + 0.5) % 1 - 0.5)
    return tune, (slopes[0] - slopes[1]) / (2 * ENERGY)


def stored_orbit(engine: AtEngine | NetworkEngine, line: Any, late: float) -> Array:
    """State of the stored beam at the start of the line, without RF, [6]."""
    turn = functools.partial(engine.one_pass, line)
    start, solve = at_orbit.stored(turn)
    return at_orbit.settle(turn, start, solve, late)[0] if late else start


def _tunes(turn: at_orbit.Turn, state: Array) -> Array:
    _, eigenvalues = _modes(at_orbit.one_turn(turn, state)[:4, :4])
    return np.asarray(np.angle(eigenvalues) / (2 * np.pi) % 1)


def _modes(matrix: Array) -> tuple[Array, Any]:
    """Normalised directions and eigenvalues of a turn, modes in the order of x, y, z."""
    try:
        directions, eigenvalues = at.a_matrix(matrix)
    except at.AtError:
        raise UnstableRingError("the ring is unstable at its closed orbit: no tune") from None
    if np.abs(np.abs(eigenvalues) - 1).max() > 1e-2:
        raise UnstableRingError("the ring is unstable at its closed orbit: no tune")
    return np.asarray(directions), eigenvalues


def _matched(
    engine: AtEngine | NetworkEngine,
    line: Any,
    state: Array,
    rf: bool,
    beam: Beam,
    random: np.random.Generator,
) -> Array:
    """Deviations of particles from the closed orbit, [particle, 6]: Gaussian and of zero mean, but
    for the curvature of the orbits.

    With the RF they fill its bucket. Without it each keeps its energy, on the closed orbit of that
    energy to second order: on a straight one it would oscillate before the kick.
    """
    turn = functools.partial(engine.one_pass, line)
    matrix = at_orbit.one_turn(turn, state)
    drawn = random.standard_normal((beam.particles, 6))
    drawn -= drawn.mean(axis=0)
    sizes = np.sqrt(np.repeat([*beam.emittance, 0.0], 2))
    curvature = np.zeros(6)
    if rf:
        directions, _ = _modes(matrix)
        sizes[4:] = beam.spread / np.hypot(directions[4, 4], directions[4, 5])
    else:
        directions = np.zeros((6, 6))
        directions[:4, :4] = _modes(matrix[:4, :4])[0]
        other = np.eye(6)[4] * ENERGY
        up, down = (at_orbit.closed(turn, state + s * other, TRANSVERSE) - state for s in (1, -1))
        directions[:4, 4] = (up - down)[:4] / (2 * ENERGY)
        curvature[:4] = (up + down)[:4] / (2 * ENERGY**2)
        directions[4, 4] = 1.0
        sizes[4:] = beam.spread, 0.0
    own = drawn * sizes
    return np.asarray(own @ directions.T + own[:, 4:5] ** 2 * curvature)
