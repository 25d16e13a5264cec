"""How far the gap between model and measurement shrinks, judged on readings that no fit saw.

closed = 1 - (r_after^2 - sigma^2) / (r_before^2 - sigma^2), where sigma^2 is the variance of a
reading and of what the refitted nuisances predict for it.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

DRAWS = 400


@dataclass(frozen=True)
class Misfit:
    """What a model leaves: rms in m, and chi-square per degree of freedom."""

    rms: float
    chi2_per_dof: float


@dataclass(frozen=True)
class Gap:
    """The gap on held-out shots, model after model.

    Attributes:
        misfits: of each model, in the order asked for.
        residuals: readings less model, NaN where not scored, [model, shot, reading, 2], m.
        closed: share of the first model's gap that the last one closes; None where there is
            one model only, or the first has no gap beyond the noise.
        interval: of `closed`, 95 %, by bootstrap over shots and monitors.
    """

    misfits: tuple[Misfit, ...]
    residuals: Array
    closed: float | None
    interval: tuple[float, float] | None


def held_out_gap(judged: Sequence[tuple[Array, Array]], seed: int = 0) -> Gap:
    """The gap of a series of models on readings that no fit saw.

    Args:
        judged: by model, the first the design's: what it leaves, NaN where not scored, and the rms
            to expect of that, both [shot, reading, 2], m.
        seed: of the bootstrap.
    """
    misfits = tuple(misfit(residual, sigma) for residual, sigma in judged)
    closed, interval = None, None
    if len(judged) > 1:
        closed, interval = _closed(*judged[0], *judged[-1], seed)
    return Gap(misfits, np.array([residual for residual, _ in judged]), closed, interval)


def misfit(residual: Array, sigma: Array) -> Misfit:
    """rms and chi-square per reading of what is not NaN."""
    valid = np.isfinite(residual)
    if not valid.any():
        return Misfit(np.nan, np.nan)
    r, s = residual[valid], sigma[valid]
    return Misfit(float(np.sqrt((r**2).mean())), float(((r / s) ** 2).mean()))


def _closed(
    before: Array, sigma_before: Array, after: Array, sigma_after: Array, seed: int
) -> tuple[float | None, tuple[float, float] | None]:
    valid = np.isfinite(before) & np.isfinite(after)
    squares = [
        np.where(valid, np.nan_to_num(r) ** 2 - s**2, 0.0).sum(axis=2)
        for r, s in ((before, sigma_before), (after, sigma_after))
    ]  # [shot, reading]
    counts = valid.sum(axis=2)
    spread = np.where(valid, 2 * sigma_before**4, 0.0).sum()
    total = squares[0].sum()
    if total < 5 * np.sqrt(spread):
        return None, None
    closed = float(1 - squares[1].sum() / total)
    random = np.random.default_rng([seed, 2])
    shots = len(squares[0])
    draws = []
    columns = np.flatnonzero(counts.any(axis=0))
    for _ in range(DRAWS):
        s = random.integers(0, shots, shots)
        m = columns[random.integers(0, len(columns), len(columns))]
        top, bottom = (q[s][:, m].sum() for q in (squares[1], squares[0]))
        if bottom > 0:
            draws.append(1 - top / bottom)
    low, high = np.quantile(draws, [0.025, 0.975]) if draws else (np.nan, np.nan)
    return closed, (float(low), float(high))
