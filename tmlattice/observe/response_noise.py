"""The noise of an orbit response where nobody states it, from the readings alone.

Between two kicks an orbit is free: what a monitor reads follows from what its neighbours read, in
the same way for every corrector that does not stand among them (and the energy's share with the
one neighbour more). What is left of the best such rule has the noise of all its readings.
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
"""Readings that a monitor's follows from: two for the orbit, one for the energy, one to spare."""
SPARE = 2
"""Times as many columns as neighbours at least, for a rule to be fitted."""
WRONG = 0.1
"""Share of the columns that need not follow it: readings that went wrong."""
OVERSTATED = 3.0
"""So many times what the readings leave is too large a noise, or a jitter of the beam."""
_MAD = 1.4826  # of a Gaussian


class Places(NamedTuple):
    """Where monitors and correctors stand, m, and the length of the ring."""

    monitors: Array
    correctors: Array
    length: float


def places(ring: Ring, measured: OrbitResponse) -> Places:
    """Of a measurement's monitors and correctors."""
    s = [
        np.array([ring[name].s for name in names])
        for names in (measured.monitors, measured.correctors)
    ]
    return Places(s[0], s[1], ring.length)


def learnt_noise(measured: OrbitResponse, where: Places) -> Array:
    """rms of one orbit change, m, [monitor, 2], the same for all monitors of a plane.

    Args:
        measured: in beam order.
        where: its monitors and correctors stand; one signal under two names counts once (see
            `noise`).

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
        found.append(_left(read[:, alone], s[alone], kicked, where.length))
    sizes = np.array(found)
    if not np.isfinite(sizes).any():
        raise MeasurementError(
            "the noise of the readings is not stated, and too few columns or monitors tell it: "
            "state it"
        )
    sizes = np.where(np.isfinite(sizes), sizes, np.nanmax(sizes))
    return np.tile(sizes, (len(measured.monitors), 1))


def completed(ring: Ring, measured: OrbitResponse) -> Array:
    """The noise that is stated, m, [monitor, 2]; where a monitor has none, what is usual of its
    plane, and where no monitor of a plane has, what the readings tell.

    Raises:
        MeasurementError: they do not tell it either.
    """
    shape = (len(measured.monitors), 2)
    noise = np.full(shape, np.nan) if measured.noise is None else np.asarray(measured.noise)
    for p in (0, 1):
        there = np.isfinite(noise[:, p])
        if there.any():
            blank = np.isnan(noise) & (np.arange(2) == p)
            noise = np.where(blank, np.median(noise[there, p]), noise)
    if np.isnan(noise).any():
        noise = np.where(np.isnan(noise), learnt_noise(measured, places(ring, measured)), noise)
    return noise


def stated_and_shown(ring: Ring, measured: OrbitResponse) -> Array | None:
    """The typical noise that is stated, and the one that neighbours leave of each other's readings,
    m, [which, plane]; None where nothing is stated, or too few readings say it."""
    if measured.noise is None:
        return None
    try:
        shown = learnt_noise(measured, places(ring, measured))
    except MeasurementError:
        return None
    return np.stack([np.nanmedian(measured.noise, axis=0), shown[0]])


def overstated(ring: Ring, measured: OrbitResponse) -> bool:
    """Whether the noise is stated far larger, in one plane, than neighbours leave of each other's
    readings: it has a jitter of the beam in it, which they share, or is wrong."""
    both = stated_and_shown(ring, measured)
    return both is not None and bool((both[0] > OVERSTATED * both[1]).any())


def _left(read: Array, s: Array, kicked: Array, length: float) -> float:
    """Of [column, monitor], in beam order; NaN where too few say it.

    Args:
        read: m, NaN where nothing was read.
        s: where the monitors stand, m.
        kicked: where the columns' correctors stand, m.
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
