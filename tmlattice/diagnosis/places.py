"""Places by the BPMs on both sides."""

from collections.abc import Sequence

import numpy as np

from tmlattice.lattice import Ring


def between(ring: Ring, positions: Sequence[float]) -> tuple[tuple[float, float], tuple[str, ...]]:
    """The interval from the last BPM before to the first one behind, m, and their names."""
    s = np.array([monitor.s for monitor in ring.monitors])
    low, high = min(positions), max(positions)
    before = int(np.searchsorted(s, low, side="left")) - 1
    behind = int(np.searchsorted(s, high, side="right"))
    start = float(s[before]) if before >= 0 else 0.0
    end = float(s[behind]) if behind < len(s) else ring.length
    near = [ring.monitors[i].name for i in (before, behind) if 0 <= i < len(s)]
    return (start, end), tuple(near)
