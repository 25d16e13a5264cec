"""How far a trajectory may go before it counts as lost."""

import numpy as np
from numpy.typing import NDArray

from tmlattice.beam import sweeps
from tmlattice.errors import BeamLostError
from tmlattice.maps import RingMaps

Array = NDArray[np.float64]

APERTURE = 1.0
"""m and rad: far outside any beam pipe, and where second-order maps have lost all meaning."""


def check_alive(states: Array, maps: RingMaps, size: sweeps.Size, batch: int) -> None:
    """Raise where a trajectory of states [block, layer + 1, n, lane] has left the aperture.

    Raises:
        BeamLostError: names the trajectory and the layer where it was lost.
    """
    last = states[:, -1]
    if np.isfinite(last).all() and np.abs(last).max(initial=0.0) < APERTURE:
        return
    alive = np.abs(states) < APERTURE  # false for NaN too
    lost = ~np.all(alive, axis=2)  # [block, layer + 1, lane]
    anywhere = np.any(lost, axis=1)
    block, lane = np.unravel_index(int(anywhere.argmax()), anywhere.shape)
    exit_ = int(lost[block, :, lane].argmax())
    trajectory = int(block) * len(size[1]) + int(lane)
    where = f"in layer {exit_ - 1} ('{maps.layers[exit_ - 1]}')" if exit_ else "at the launch"
    raise BeamLostError(
        f"trajectory {trajectory} is lost {where}: a coordinate exceeds {APERTURE:g} m or rad; "
        "launch closer to the axis, or lower the learning rate"
    )
