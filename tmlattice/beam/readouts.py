"""Beam positions at the monitors, turn by turn, and where the beam is lost."""

from dataclasses import dataclass

import numpy as np

from tmlattice.arrays import Array, Flags
from tmlattice.beam import sweeps
from tmlattice.beam.layers import Layers
from tmlattice.beam.rf import NO_RF, Cavities
from tmlattice.beam.sweeps import curved

APERTURE = 0.05
"""m; distance from the axis at a magnet's exit beyond which a beam is lost."""


@dataclass(frozen=True)
class Lost:
    """Place of a beam loss.

    Attributes:
        shot, turn: from 0.
    """

    shot: int
    turn: int
    element: str

    def __str__(self) -> str:
        return f"shot {self.shot} is lost on turn {self.turn} in '{self.element}'"


def lost(states: Array, names: tuple[str, ...]) -> tuple[Lost, ...]:
    """Return the shots whose beam leaves the aperture, and where.

    Args:
        states: at the start and at every exit, turn by turn, [shot, step + 1, n].
        names: of the layers; a turn has one step more, the drift to its end.
    """
    gone = outside(states)
    found = []
    for shot in np.flatnonzero(gone[:, -1]):
        turn, step = divmod(max(int(gone[shot].argmax()) - 1, 0), len(names) + 1)
        found.append(Lost(int(shot), turn, names[min(step, len(names) - 1)]))
    return tuple(found)


def outside(states: Array) -> Flags:
    """Whether a beam [shot, step + 1, n] has left the aperture at or before each exit, [shot, step
    + 1]; true for NaN."""
    inside = np.abs(states[:, :, 0:3:2]).max(axis=2) < APERTURE
    return ~np.logical_and.accumulate(inside, axis=1)


def positions(launches: Array, turns: int, layers: Layers, cavities: Cavities = NO_RF) -> Array:
    """Return (x, y) at every monitor on every turn, [shot, turn, monitor, 2], m; NaN if lost.

    Args:
        launches: [shot, n].
        turns: at least 1.
        cavities: in six coordinates; none on a single turn.
    """
    at = layers.at
    size, states = sweeps.begun(launches, layers.steps + 1)
    readings = np.empty((len(states), len(at), 2, len(size[1])))
    beam = np.empty((len(launches), turns, len(at), 2))
    bends, bent = layers.curved, curved(layers.R[2])
    alive = np.ones(len(launches), dtype=bool)
    for turn in range(turns):
        sweeps.run(
            sweeps.turn, len(states), size, *layers.W, bends, layers.third, cavities.exits,
            cavities.values, states,
        )  # fmt: skip
        sweeps.run(sweeps.read, len(states), size, *layers.R, bent, at, states, readings)
        beam[:, turn] = sweeps.unpack(readings, len(launches))
        inside = np.abs(states[:, :, 0:3:2]).max(axis=2) < APERTURE  # [block, exit, lane]
        inside = sweeps.unpack(np.logical_and.accumulate(inside, axis=1), len(launches))
        beam[:, turn][~(inside[:, at] & alive[:, None])] = np.nan
        alive &= inside[:, -1]
        states[:, 0] = states[:, -1]
    return beam
