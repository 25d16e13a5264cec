"""How far the gap between model and machine shrinks, judged on shots that the fit never saw.

In each held-out shot only the launch is refitted, on one half of the monitors; the readings of the
other half are predicted. closed = 1 - (r_after^2 - sigma^2) / (r_before^2 - sigma^2), where sigma^2
is the variance of a reading and of what the refitted launch predicts for it.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tmlattice.beam.model import Model
from tmlattice.effects import Cause
from tmlattice.inference.newton import Fit, Problem, fit
from tmlattice.inference.whitening import Whitening
from tmlattice.observe.data import Data

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


def held_out_gap(
    models: Sequence[Model],
    data: Data,
    steps: Sequence[Sequence[Cause]],
    seed: int = 0,
) -> Gap:
    """The gap of a series of models on shots that no fit saw.

    Args:
        models: of these shots, one for each step: they differ in what is known beside the causes.
        data: their readings.
        steps: the causes of each model; the first is the design's, mostly ().
        seed: of the bootstrap.
    """
    count = len(models[0].at)
    odd = np.tile(np.arange(count) % 2 == 1, data.turns)
    fitted = data.without(np.broadcast_to(odd[None, :, None], data.valid.shape))
    whitening = Whitening(fitted)
    scored = data.valid & odd[None, :, None]
    residuals, sigmas = [], []
    for model, causes in zip(models, steps, strict=True):
        launches = fit(Problem(model, fitted, whitening, {}, tuple(causes)), (), data.launches)
        difference = data.readings - launches.paths.readings
        residuals.append(np.where(scored, difference, np.nan))
        sigmas.append(_sigma(data, launches, whitening))
    left = np.array(residuals)
    misfits = tuple(misfit(r, s) for r, s in zip(left, sigmas, strict=True))
    closed, interval = None, None
    if len(left) > 1:
        closed, interval = _closed(left[0], left[-1], sigmas[0], sigmas[-1], seed)
    return Gap(misfits, left, closed, interval)


def _sigma(data: Data, launches: Fit, whitening: Whitening) -> Array:
    """rms of a reading less its prediction from a launch that was fitted to other readings."""
    slopes = launches.paths.launch[..., whitening.columns]
    covariance = launches.projection.covariance()  # [shot, column, column]
    predicted = np.einsum("srpi,sij,srpj->srp", slopes, covariance, slopes, optimize=True)
    return np.asarray(np.sqrt(data.sigma**2 + predicted))


def misfit(residual: Array, sigma: Array) -> Misfit:
    """rms and chi-square per reading of what is not NaN."""
    valid = np.isfinite(residual)
    if not valid.any():
        return Misfit(np.nan, np.nan)
    r, s = residual[valid], sigma[valid]
    return Misfit(float(np.sqrt((r**2).mean())), float(((r / s) ** 2).mean()))


def _closed(
    before: Array, after: Array, sigma_before: Array, sigma_after: Array, seed: int
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
