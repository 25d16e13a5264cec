"""The noise of readings where nobody states it: from what neighbours leave unexplained.

Between two errors a trajectory is free: the reading of a monitor follows from those of the two
before it, in each plane. What is left of a reading has the noise of three, with known weights; the
median over all monitors does not see a few errors. One signal under two names, of monitors at one
place, counts once: it has no noise against itself.
"""

import numpy as np
from numpy.typing import NDArray

from tmlattice.beam.model import Paths
from tmlattice.observe.data import Data
from tmlattice.observe.sections import Found, Passes

Array = NDArray[np.float64]

SAME_PLACE = 1e-6
"""m; two monitors nearer to each other stand at one place."""
_MAD = 1.4826  # of a Gaussian


def local_misfit(data: Data, paths: Paths) -> Array:
    """Each reading's difference from the model less what its two predecessors make of it, divided
    by the norm of the weights, [shot, reading, 2]; NaN where it cannot be said."""
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
        # where the weights are large, small model errors are too
        result[:, own[2:], plane] = np.where(size < 10, left, np.nan)
    return result


def _signals(data: Data, paths: Paths) -> NDArray[np.intp]:
    """The readings that are no copies, to the last digit, of the one before at the same place."""
    moved = np.abs(np.diff(paths.beam_launch[..., :4], axis=1)).max(axis=(0, 2, 3))
    copied = (np.diff(data.readings, axis=1) == 0) & (data.valid[:, 1:] == data.valid[:, :-1])
    copied = copied.all(axis=(0, 2)) & data.valid[:, 1:].any(axis=(0, 2))
    return np.flatnonzero(np.append(True, ~(copied & (moved <= SAME_PLACE))))


def _cross(a: Array, b: Array) -> Array:
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])


def estimate(data: Data, paths: Paths) -> Array:
    """rms noise of one reading in x and y, m, [2]; NaN for a plane without enough readings."""
    misfit = local_misfit(data, paths)
    planes = [misfit[:, :, plane][np.isfinite(misfit[:, :, plane])] for plane in (0, 1)]
    return np.array([_MAD * np.median(np.abs(p)) if len(p) > 20 else np.nan for p in planes])


LEAST_FREEDOM = 2
"""Shots beyond those that the errors between neighbours take up, to estimate a scatter."""
LEAST_READINGS = 8
"""Of the median: with two shots beyond, it is known to a fifth then."""


def scatter(data: Data, paths: Paths) -> Array:
    """rms noise of one reading from its scatter between shots, m, [2]; NaN without enough shots.

    Static errors (offsets, gains, gradients between neighbours) leave the same of a reading in
    every shot, or what is linear in the trajectory: that is fitted and taken out, so that small
    errors are not taken for noise. The median over the readings does not see a fault that only
    some of the shots have.

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
            both = count >= 5 + LEAST_FREEDOM  # the other plane's too, where there are enough
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
"""Passes beyond those that errors of monitors and magnets take up: a constant, and what is in
proportion to the trajectory in its plane (or in both, where there are enough)."""
PASSES = 5 + SCATTER
"""From which errors of both planes are taken out."""
IN_PROPORTION = 0.015
"""Share of the orbit that unknown errors leave in proportion to what is not taken up."""


def random_part(passes: Passes, found: Found) -> float | None:
    """How many times its noise a reading scatters from pass to pass.

    Small errors everywhere leave the same in every shot, or in proportion to its trajectory: that
    is taken out, and what is left is noise. None where there are too few passes, or too little is
    left to tell it from errors of the other plane.
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
