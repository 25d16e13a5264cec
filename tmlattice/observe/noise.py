"""Estimates of the readings' noise from neighbouring monitors or from repeated shots.

Without an error in between, the reading of a monitor follows from those of the two before it, in
each plane. The remainder has the noise of three readings with known weights; the median over all
monitors is robust to some errors. Two names of one signal, of monitors at one place, count once.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from tmlattice.arrays import TINY, Array
from tmlattice.beam.model import Paths
from tmlattice.errors import MeasurementError
from tmlattice.inference import chi2
from tmlattice.inference.judgement import ENOUGH, MISSTATED, OUTLIERS
from tmlattice.lattice import Ring
from tmlattice.measurement import OrbitResponse
from tmlattice.observe.data import Data
from tmlattice.observe.sections import Passes, SectionFits

SAME_PLACE = 1e-6
"""m; monitors within this distance are at one place."""


def local_misfit(data: Data, paths: Paths) -> Array:
    """Each reading's difference from the model less the prediction from its two predecessors, over
    the norm of the weights, [shot, reading, 2]; NaN without a prediction."""
    result = np.full(data.valid.shape, np.nan)
    own = _signals(data, paths)
    difference = np.where(data.valid, data.readings - paths.readings, np.nan)[:, own]
    for plane, columns in ((0, (0, 1)), (1, (2, 3))):
        slope = paths.launch[:, own, plane][:, :, columns]  # [shot, reading, 2]
        first, second, third = slope[:, :-2], slope[:, 1:-1], slope[:, 2:]
        determinant = _cross(first, second)
        with np.errstate(divide="ignore", invalid="ignore"):
            a = _cross(third, second) / determinant
            b = _cross(first, third) / determinant
            size = np.sqrt(1 + a**2 + b**2)
            r = difference[:, :, plane]
            left = (r[:, 2:] - a * r[:, :-2] - b * r[:, 1:-1]) / size
        # large weights amplify small model errors
        result[:, own[2:], plane] = np.where(size < 10, left, np.nan)
    return result


def _signals(data: Data, paths: Paths) -> NDArray[np.intp]:
    """Readings that are not identical copies of the one before at the same place."""
    moved = np.abs(np.diff(paths.beam_launch[..., :4], axis=1)).max(axis=(0, 2, 3))
    copied = (np.diff(data.readings, axis=1) == 0) & (data.valid[:, 1:] == data.valid[:, :-1])
    copied = copied.all(axis=(0, 2)) & data.valid[:, 1:].any(axis=(0, 2))
    return np.flatnonzero(np.append(True, ~(copied & (moved <= SAME_PLACE))))


def _cross(a: Array, b: Array) -> Array:
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])


def estimate(several: Sequence[tuple[Data, Paths]]) -> Array:
    """rms noise of one reading in x and y, m, [2]; NaN for a plane with too few readings.

    Args:
        several: measurements with the same electronics, with the model's paths through their shots.
    """
    misfit = np.concatenate([local_misfit(*own).reshape(-1, 2) for own in several])
    planes = [own[np.isfinite(own)] for own in misfit.T]
    return np.array([chi2.typical(p) if len(p) > ENOUGH else np.nan for p in planes])


SCATTER = 2
"""Passes beyond those absorbed by errors of monitors and magnets: a constant, and a part linear in
the trajectory in its plane (or in both, with enough passes)."""
PASSES = 5 + SCATTER
"""Passes from which errors of both planes are subtracted."""


def scatter(several: Sequence[tuple[Data, Paths]]) -> Array:
    """rms noise of one reading from its scatter between shots, m, [2]; NaN with too few shots.

    Static errors (offsets, gains, gradients between neighbours) leave a constant in every shot, or
    a part linear in the trajectory. That is fitted and subtracted, so that it does not count as
    noise. The median over the readings is robust to a fault of some shots.

    Args:
        several: see `estimate`.
    """
    turn = min(paths.readings.shape[1] for _, paths in several)
    misfit = np.concatenate([local_misfit(*own)[:, :turn] for own in several])
    orbit = np.concatenate([paths.readings[:, :turn] for _, paths in several])
    variances: list[list[float]] = [[], []]
    for plane in (0, 1):
        for i in range(1, misfit.shape[1]):
            there = np.isfinite(misfit[:, i, plane])
            count = int(there.sum())
            both = count >= PASSES  # the other plane too, with enough shots
            columns = 4 if both else 2
            freedom = count - columns - 1
            if freedom < SCATTER:
                continue
            linear = orbit[there, i - 1 : i + 1][:, :, slice(None) if both else plane]
            square = _scattered(misfit[there, i, plane], linear.reshape(count, columns))
            usual = float(chi2.median_per_freedom(freedom))
            variances[plane].append(square / freedom / usual)
    return np.array([
        np.sqrt(np.median(own)) if len(own) >= ENOUGH else np.nan for own in variances
    ])  # fmt: skip


def _scattered(left: Array, linear: Array) -> float:
    """Sum of squares beyond a constant and a part that is linear in columns, [row, column]."""
    fixed = np.column_stack([np.ones(len(left)), linear])
    fixed = fixed / np.maximum(np.abs(fixed).max(axis=0), TINY)
    return float(np.sum((left - fixed @ np.linalg.lstsq(fixed, left, rcond=None)[0]) ** 2))


IN_PROPORTION = 0.015
"""Share of the orbit that unknown errors leave in proportion to what is not subtracted."""


def noise_scatter(passes: Passes, found: SectionFits) -> float | None:
    """Scatter of a reading from pass to pass over its noise; None if it is not determined.

    Distributed errors leave a constant in every shot, or a part linear in its trajectory: that is
    subtracted, and the remainder is noise. Too few passes, or too small a remainder compared with
    errors of the other plane, determine nothing.
    """
    count = len(found.left)
    both = count >= PASSES
    if count < 3 + SCATTER:
        return None
    ratios = []
    for w in range(found.left.shape[1]):
        for reading in range(found.left.shape[2]):
            if not found.there[:, w, reading].all() or (found.freedom[:, w] < 2).any():
                continue
            plane = slice(0, 4) if both else slice(2 * (reading % 2), 2 * (reading % 2) + 2)
            linear = found.start[:, w, plane]
            share = found.freedom[:, w].mean() / found.there[:, w].sum(axis=1).mean()
            square = _scattered(found.left[:, w, reading], linear)
            ratios.append(float(square / (count - 1 - linear.shape[1]) / share))
    if len(ratios) < ENOUGH:
        return None
    random = float(np.sqrt(np.median(ratios)))
    orbit = float(np.sqrt(np.nanmean(passes.readings**2)))
    if not both and random * float(np.median(passes.sigma)) < IN_PROPORTION * orbit:
        return None
    return random


NEIGHBOURS = 4
"""Neighbours of a monitor: two for the orbit, one for the energy, one more."""


def estimated_noise(ring: Ring, measured: OrbitResponse) -> Array:
    """rms of one orbit change, m, [monitor, 2], the same for all monitors of a plane.

    Args:
        ring: for the positions; one signal under two names counts once (see `noise`).
        measured: in beam order.

    Raises:
        MeasurementError: too few monitors or columns.
    """
    planes = np.array([int(p == "y") for p in measured.planes])
    at = np.array([ring[name].s for name in measured.monitors])
    correctors = np.array([ring[name].s for name in measured.correctors])
    found = []
    for p in (0, 1):
        own = measured.response[planes == p, :, p]
        seen = np.isfinite(own).mean(axis=0) > 0.5 if len(own) else np.zeros(0, dtype=bool)
        read, s = own[:, seen], at[seen]
        copied = (np.diff(read, axis=1) == 0).all(axis=0) & (np.diff(s) < SAME_PLACE)
        alone = ~np.append(False, copied)[: len(s)]
        kicked = correctors[planes == p]
        found.append(_residual_noise(read[:, alone], s[alone], kicked, ring.length))
    sizes = np.array(found)
    if not np.isfinite(sizes).any():
        raise MeasurementError(
            "the noise of the readings is not stated, and too few columns or BPMs determine "
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
        noise = np.where(np.isnan(noise), estimated_noise(ring, measured), noise)
    return noise


def stated_and_estimated(ring: Ring, measured: OrbitResponse) -> Array | None:
    """Typical stated noise, and the noise estimated from neighbours, m, [which, plane]; None if
    nothing is stated, or too few readings determine it."""
    if measured.noise is None:
        return None
    try:
        shown = estimated_noise(ring, measured)
    except MeasurementError:
        return None
    there = [own[np.isfinite(own)] for own in measured.noise.T]
    stated = [np.median(own) if len(own) else np.nan for own in there]
    return np.stack([stated, shown[0]])


def overstated(ring: Ring, measured: OrbitResponse) -> bool:
    """Whether the noise stated in one plane is far above the estimate from neighbours: it includes
    beam jitter, which neighbours share, or is wrong."""
    both = stated_and_estimated(ring, measured)
    return both is not None and bool((both[0] > MISSTATED * both[1]).any())


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
        if rows.sum() < ENOUGH:
            continue
        others, own = read[rows][:, np.delete(at, NEIGHBOURS // 2)], read[rows, m]
        kept = np.ones(len(own), dtype=bool)
        for _ in range(3):
            rule = np.linalg.lstsq(others[kept], own[kept], rcond=None)[0]
            miss = np.abs(own - others @ rule)
            kept = miss <= np.quantile(miss, 1 - OUTLIERS)
        freedom = (kept.sum() - NEIGHBOURS) / kept.sum()
        left.append(chi2.typical(miss) / np.sqrt(freedom * (1 + rule @ rule)))
    return float(np.median(left)) if left else float("nan")
