"""Noise of an orbit response, estimated from its readings.

Between two kicks an orbit is free: a monitor's reading is a linear function of its neighbours'
readings, the same for every corrector that is not between them (and with one neighbour more for the
energy). The residual of the best such function has the noise of all its readings.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tmlattice.errors import MeasurementError
from tmlattice.lattice import Ring
from tmlattice.measurement import OrbitResponse
from tmlattice.observe.noise import SAME_PLACE

Array = NDArray[np.float64]

NEIGHBOURS = 4
"""Neighbours of a monitor: two for the orbit, one for the energy, one more."""
SPARE = 2
"""Columns over neighbours, at least, for a fit."""
WRONG = 0.1
"""Share of the columns that may be outliers."""
OVERSTATED = 3.0
"""Ratio to the estimate above which stated noise is too large, or includes beam jitter."""
_MAD = 1.4826  # of a Gaussian


class Places(NamedTuple):
    """Positions of monitors and correctors, m, and the length of the ring."""

    monitors: Array
    correctors: Array
    length: float


def places(ring: Ring, measured: OrbitResponse) -> Places:
    """Return the positions of a measurement's monitors and correctors."""
    s = [
        np.array([ring[name].s for name in names])
        for names in (measured.monitors, measured.correctors)
    ]
    return Places(s[0], s[1], ring.length)


def estimated_noise(measured: OrbitResponse, where: Places) -> Array:
    """rms of one orbit change, m, [monitor, 2], the same for all monitors of a plane.

    Args:
        measured: in beam order.
        where: positions; one signal under two names counts once (see `noise`).

    Raises:
        MeasurementError: too few monitors or columns.
    """
    planes = np.array([int(p == "y") for p in measured.planes])
    found = []
    for p in (0, 1):
        own = measured.response[planes == p, :, p]
        seen = np.isfinite(own).mean(axis=0) > 0.5 if len(own) else np.zeros(0, dtype=bool)
        read, s = own[:, seen], where.monitors[seen]
        copied = (np.diff(read, axis=1) == 0).all(axis=0) & (np.diff(s) < SAME_PLACE)
        alone = ~np.append(False, copied)[: len(s)]
        kicked = where.correctors[planes == p]
        found.append(_residual_noise(read[:, alone], s[alone], kicked, where.length))
    sizes = np.array(found)
    if not np.isfinite(sizes).any():
        raise MeasurementError(
            "the noise of the readings is not stated, and too few columns or monitors determine "
            "it: state it"
        )
    sizes = np.where(np.isfinite(sizes), sizes, np.nanmax(sizes))
    return np.tile(sizes, (len(measured.monitors), 1))


def completed(ring: Ring, measured: OrbitResponse) -> Array:
    """Stated noise, m, [monitor, 2]; if missing, that of the plane's typical monitor, or an
    estimate from the readings.

    Raises:
        MeasurementError: the readings do not determine it.
    """
    shape = (len(measured.monitors), 2)
    noise = np.full(shape, np.nan) if measured.noise is None else np.asarray(measured.noise)
    for p in (0, 1):
        there = np.isfinite(noise[:, p])
        if there.any():
            blank = np.isnan(noise) & (np.arange(2) == p)
            noise = np.where(blank, np.median(noise[there, p]), noise)
    if np.isnan(noise).any():
        noise = np.where(np.isnan(noise), estimated_noise(measured, places(ring, measured)), noise)
    return noise


def stated_and_estimated(ring: Ring, measured: OrbitResponse) -> Array | None:
    """Typical stated noise, and the noise estimated from neighbours, m, [which, plane]; None if
    nothing is stated, or too few readings determine it."""
    if measured.noise is None:
        return None
    try:
        shown = estimated_noise(measured, places(ring, measured))
    except MeasurementError:
        return None
    return np.stack([np.nanmedian(measured.noise, axis=0), shown[0]])


def overstated(ring: Ring, measured: OrbitResponse) -> bool:
    """Whether the noise stated in one plane is far above the estimate from neighbours: it includes
    beam jitter, which neighbours share, or is wrong."""
    both = stated_and_estimated(ring, measured)
    return both is not None and bool((both[0] > OVERSTATED * both[1]).any())


def _residual_noise(read: Array, s: Array, kicked: Array, length: float) -> float:
    """Noise of readings [column, monitor], in beam order; NaN with too few.

    Args:
        read: m, NaN where missing.
        s: positions of the monitors, m.
        kicked: positions of the columns' correctors, m.
        length: of the ring, m.
    """
    left = []
    for m in range(len(s)) if len(s) > NEIGHBOURS else ():
        at = (m + np.arange(-(NEIGHBOURS // 2), NEIGHBOURS // 2 + 1)) % len(s)
        among = (kicked - s[at[0]]) % length <= (s[at[-1]] - s[at[0]]) % length
        rows = ~among & np.isfinite(read[:, at]).all(axis=1)
        if rows.sum() < SPARE * NEIGHBOURS:
            continue
        others, own = read[rows][:, np.delete(at, NEIGHBOURS // 2)], read[rows, m]
        kept = np.ones(len(own), dtype=bool)
        for _ in range(3):
            rule = np.linalg.lstsq(others[kept], own[kept], rcond=None)[0]
            miss = np.abs(own - others @ rule)
            kept = miss <= np.quantile(miss, 1 - WRONG)
        freedom = (kept.sum() - NEIGHBOURS) / kept.sum()
        left.append(np.median(miss) * _MAD / np.sqrt(freedom * (1 + rule @ rule)))
    return float(np.median(left)) if left else float("nan")
