"""The aperture beyond which a trajectory is lost."""

import numpy as np

from tmlattice.arrays import Array, Flags
from tmlattice.errors import BeamLostError
from tmlattice.maps import RingMaps

APERTURE = 1.0
"""m and rad: far outside any beam pipe, where second-order maps are meaningless."""


def bounded(n: int) -> list[int]:
    """Coordinates of n that the aperture bounds: not tau, the fifth of six, as the delay of a
    particle grows turn by turn without RF."""
    return [i for i in range(n) if i != 4]


def lost(states: Array) -> Flags:
    """Whether states [..., n] are outside the aperture, or NaN, [...]."""
    inside = np.abs(states[..., bounded(states.shape[-1])]) < APERTURE
    return np.asarray(~np.all(inside, axis=-1))


def check_alive(states: Array, maps: RingMaps) -> None:
    """Raise where a trajectory of states [block, layer + 1, n, lane] has left the aperture;
    BeamLostError: names the trajectory and the layer where it was lost."""
    last = states[:, -1]
    if np.isfinite(last).all() and np.abs(last).max(initial=0.0) < APERTURE:
        return
    anywhere = lost(np.moveaxis(states, 2, 3)).any(axis=1)  # [block, lane]
    if not anywhere.any():
        return
    block, lane = np.unravel_index(int(anywhere.argmax()), anywhere.shape)
    trajectory = int(block) * states.shape[-1] + int(lane)
    raise lost_beam(states[block, :, :, lane], trajectory, maps)


def lost_beam(states: Array, trajectory: int, maps: RingMaps, turn: int = 0) -> BeamLostError:
    """The error for a lost trajectory with these states [layer + 1, n] in its turn."""
    gone = lost(states)
    exit_ = int(gone.argmax())
    where = f"in layer {exit_ - 1} ('{maps.layers[exit_ - 1]}')" if exit_ else "at the launch"
    when = f" in turn {turn}" if turn else ""
    return BeamLostError(
        f"trajectory {trajectory} is lost {where}{when}: a coordinate exceeds {APERTURE:g} m or "
        "rad; launch closer to the axis, or lower the learning rate"
    )
