"""The noise of an orbit response where nobody states it, from the readings alone.

Between two kicks an orbit is free: what a monitor reads follows from what its neighbours read, in
the same way for every corrector that does not stand among them (and the energy's share with the
one neighbour more). What is left of the best such rule has the noise of all its readings.
"""

import numpy as np
from numpy.typing import NDArray

from tmlattice.errors import MeasurementError
from tmlattice.measurement import OrbitResponse
from tmlattice.observe.noise import SAME_PLACE

Array = NDArray[np.float64]

NEIGHBOURS = 4
"""Readings that a monitor's follows from: two for the orbit, one for the energy, one to spare."""
SPARE = 3
"""Times as many columns as neighbours at least, for a rule to be fitted."""
AMONG = 0.2
"""Share of the columns that may stand among the neighbours: the furthest off are left out."""
_MAD = 1.4826  # of a Gaussian


def learnt_noise(measured: OrbitResponse, s: Array) -> Array:
    """rms of one orbit change, m, [monitor, 2], the same for all monitors of a plane.

    Args:
        measured: in beam order.
        s: where its monitors stand, m; one signal under two names counts once (see `noise`).

    Raises:
        MeasurementError: too few monitors or columns.
    """
    planes = np.array([int(p == "y") for p in measured.planes])
    found = []
    for p in (0, 1):
        own = measured.response[planes == p, :, p]
        seen = np.isfinite(own).mean(axis=0) > 0.5 if len(own) else np.zeros(0, dtype=bool)
        read, places = own[:, seen], s[seen]
        copied = (np.diff(read, axis=1) == 0).all(axis=0) & (np.diff(places) < SAME_PLACE)
        read = read[:, ~np.append(False, copied)[: len(places)]]
        read = read[np.isfinite(read).all(axis=1)]
        found.append(_left(read))
    sizes = np.array(found)
    if not np.isfinite(sizes).any():
        raise MeasurementError(
            "the noise of the readings is not stated, and too few columns or monitors tell it: "
            "state it"
        )
    sizes = np.where(np.isfinite(sizes), sizes, np.nanmax(sizes))
    return np.tile(sizes, (len(measured.monitors), 1))


def _left(read: Array) -> float:
    """Of [column, monitor], in beam order."""
    columns, monitors = read.shape if read.ndim == 2 else (0, 0)
    if columns < SPARE * NEIGHBOURS or monitors < NEIGHBOURS + 1:
        return float("nan")
    left = []
    for m in range(monitors):
        at = (m + np.arange(-(NEIGHBOURS // 2), NEIGHBOURS // 2 + 1)) % monitors
        others = read[:, np.delete(at, NEIGHBOURS // 2)]
        kept = np.ones(columns, dtype=bool)
        for _ in range(3):  # correctors that stand among them do not follow the rule
            rule = np.linalg.lstsq(others[kept], read[kept, m], rcond=None)[0]
            miss = np.abs(read[:, m] - others @ rule)
            kept = miss <= np.quantile(miss, 1 - AMONG)
        freedom = (kept.sum() - NEIGHBOURS) / kept.sum()
        rms = np.median(miss) * _MAD / np.sqrt(freedom * (1 + rule @ rule))
        left.append(rms)
    return float(np.median(left))
