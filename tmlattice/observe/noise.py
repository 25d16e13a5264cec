"""Estimates of the readings' noise from neighbouring monitors or from repeated shots.

Without an error in between, the reading of a monitor follows from those of the two before it, in
each plane. The remainder has the noise of three readings with known weights; the median over all
monitors is robust to some errors. Two names of one signal, of monitors at one place, count once.
"""

import numpy as np
from numpy.typing import NDArray

from tmlattice.beam.model import Paths
from tmlattice.observe.data import Data
from tmlattice.observe.sections import Passes, SectionFits

Array = NDArray[np.float64]

SAME_PLACE = 1e-6
"""m; monitors within this distance are at one place."""
_MAD = 1.4826  # of a Gaussian


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


def estimate(data: Data, paths: Paths) -> Array:
    """rms noise of one reading in x and y, m, [2]; NaN for a plane with too few readings."""
    misfit = local_misfit(data, paths)
    planes = [misfit[:, :, plane][np.isfinite(misfit[:, :, plane])] for plane in (0, 1)]
    return np.array([_MAD * np.median(np.abs(p)) if len(p) > 20 else np.nan for p in planes])


LEAST_FREEDOM = 2
"""Shots beyond those absorbed by errors between neighbours, for an estimate."""
LEAST_READINGS = 8
"""Readings of the median, at least: with two further shots it is known to a fifth."""


def scatter(data: Data, paths: Paths) -> Array:
    """rms noise of one reading from its scatter between shots, m, [2]; NaN with too few shots.

    Static errors (offsets, gains, gradients between neighbours) leave a constant in every shot, or
    a part linear in the trajectory. That is fitted and subtracted, so that it does not count as
    noise. The median over the readings is robust to a fault of some shots.

    Args:
        data: several shots of one machine.
        paths: of the model, through them.
    """
    misfit, orbit = local_misfit(data, paths), paths.readings
    variances: list[list[float]] = [[], []]
    for plane in (0, 1):
        for i in range(1, misfit.shape[1]):
            there = np.isfinite(misfit[:, i, plane])
            count = int(there.sum())
            both = count >= 5 + LEAST_FREEDOM  # the other plane too, with enough shots
            columns = 4 if both else 2
            freedom = count - columns - 1
            if freedom < LEAST_FREEDOM:
                continue
            linear = orbit[there, i - 1 : i + 1][:, :, slice(None) if both else plane]
            fixed = np.column_stack([np.ones(count), linear.reshape(count, columns)])
            fixed = fixed / np.maximum(np.abs(fixed).max(axis=0), 1e-30)
            left = misfit[there, i, plane]
            left = left - fixed @ np.linalg.lstsq(fixed, left, rcond=None)[0]
            usual = (1 - 2 / (9 * freedom)) ** 3  # median of chi-square over its freedom
            variances[plane].append(float(np.sum(left**2)) / freedom / usual)
    return np.array([
        np.sqrt(np.median(own)) if len(own) >= LEAST_READINGS else np.nan for own in variances
    ])  # fmt: skip


SCATTER = 3
"""Passes beyond those absorbed by errors of monitors and magnets: a constant, and a part linear in
the trajectory in its plane (or in both, with enough passes)."""
PASSES = 5 + SCATTER
"""Passes from which errors of both planes are subtracted."""
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
    if count < 3 + SCATTER - 1:
        return None
    ratios = []
    for w in range(found.left.shape[1]):
        for reading in range(found.left.shape[2]):
            if not found.there[:, w, reading].all() or (found.freedom[:, w] < 2).any():
                continue
            plane = slice(0, 4) if both else slice(2 * (reading % 2), 2 * (reading % 2) + 2)
            fixed = np.column_stack([np.ones(count), found.start[:, w, plane]])
            fixed = fixed / np.maximum(np.abs(fixed).max(axis=0), 1e-30)
            left = found.left[:, w, reading]
            left = left - fixed @ np.linalg.lstsq(fixed, left, rcond=None)[0]
            share = found.freedom[:, w].mean() / found.there[:, w].sum(axis=1).mean()
            ratios.append(float(np.sum(left**2) / (count - fixed.shape[1]) / share))
    if len(ratios) < 8:
        return None
    random = float(np.sqrt(np.median(ratios)))
    orbit = float(np.sqrt(np.nanmean(passes.readings**2)))
    if not both and random * float(np.median(passes.sigma)) < IN_PROPORTION * orbit:
        return None
    return random
