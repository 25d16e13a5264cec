"""Weights of the readings of a hierarchical fit: noise, discrepancy, outliers and bad BPMs.

>>> state = look(state, 0)
>>> weight(state, 0)                               # 1 / variance, [column, monitor]
"""

from dataclasses import replace

import numpy as np

from tmlattice.arrays import REDUNDANT, TINY, Array, Flags
from tmlattice.diagnosis.response.state import State
from tmlattice.inference import chi2
from tmlattice.inference.judgement import FEW, OUTLIERS, SIGNIFICANT
from tmlattice.inference.normal import amounts, common, times_precision

TYPICAL = 10.0
"""Number of readings by which the typical misfit counts in the model discrepancy of each column."""
LEAST = 0.2
"""Least model discrepancy, and least noise given jitter, as a share of the noise."""
BLIND = 0.2
"""Gain below which a BPM does not read the beam."""
DISPERSION = "quadrupole_gradient"
"""The family that determines the dispersion. Before it is fitted, the residual of the RF's orbit is
many times all others, and would bias the BPM gains."""
COUPLING = "skew_gradient"
"""The family that determines the readings in the other plane."""

CLIPPED = 3.0
"""Limit of a residual, in units of the typical one: an outlier is no common pattern."""


def weight(state: State, block: int) -> Array:
    """Return 1 / variance of the fitted readings, 1/m2, and 0 of others, [column, monitor]."""
    data, split = state.data, state.split
    use = np.isfinite(data.pick(data.orbits, block)) & state.good
    use[:-1] &= state.fitted[:-1, None]
    use[-1] &= split.half[-1]
    variance = data.noise_of(block) ** 2 + state.lacking[block][:, None] ** 2
    return np.where(use, counts(state, block) * state.share[block] / variance, 0.0)


def taken(state: State, block: int) -> Array | None:
    """Return the factor of the information that beam jitter takes from the weights, see
    `inference.normal.common`, [column, monitor, pattern]; None without jitter."""
    return None if state.jitter is None else _common(state, block)[0]


def _common(state: State, block: int) -> tuple[Array, Array]:
    """The factor of the information that jitter takes, and its term of the log evidence."""
    assert state.jitter is not None
    count = counts(state, block)
    alone = weight(state, block) / count
    own, scale = common(alone, state.jitter[state.data.plane_of(block)])
    return own * np.sqrt(count)[:, :, None], count[:, 0] * scale


def weighed(state: State, block: int, left: Array) -> Array:
    """Return the inverse covariance of fitted readings times `left`, 1/m, [column, monitor]."""
    weights, own = weight(state, block), taken(state, block)
    left = np.where(weights > 0, left, 0.0)
    return weights * left if own is None else times_precision(weights, own, left)


def log_scale(state: State, block: int) -> float:
    """Return the log determinant of that inverse covariance."""
    weights = weight(state, block)
    use = weights > 0
    count = np.broadcast_to(counts(state, block), use.shape)[use]
    total = float(count @ np.log(weights[use] / count))
    return total if state.jitter is None else total - float(_common(state, block)[1].sum())


def without_jitter(state: State, block: int, left: Array) -> tuple[Array, Array]:
    """Return the residual given the most probable jitter of each fitted column; and the readings'
    noise without jitter, which is included in stated and estimated noise; m, [column, monitor]."""
    noise = state.data.noise_of(block)
    if state.jitter is None:
        return left, noise
    patterns = state.jitter[state.data.plane_of(block)]
    own = amounts(weight(state, block) / counts(state, block), patterns, left)[0]
    alone = np.maximum(noise**2 - np.sum(patterns**2, axis=1), (LEAST * noise) ** 2)
    return left - np.einsum("ck,ckm->cm", own, patterns), np.sqrt(alone)


def counts(state: State, block: int) -> Array:
    """Return the effective sample size of one reading, [column, 1]."""
    plane = state.data.plane_of(block)
    own = np.ones(len(plane)) if state.independent is None else state.independent[block, plane]
    return np.asarray(own[:, None])


def look(state: State, block: int) -> State:
    """Return the state with its present model discrepancy, weights of outliers, and good BPMs."""
    data = state.data
    use = weight(state, block) > 0
    left = np.where(use, data.pick(state.at.left, block), np.nan)
    left, alone = without_jitter(state, block, left)
    share = _shares(state, block, left)
    typical = float(chi2.typical(left[:-1, state.good]))
    noise = float(np.median(data.noise))
    shared = TYPICAL * typical**2 + np.nansum(share[block] * left**2, axis=1)
    squares = shared / (TYPICAL + use.sum(axis=1))
    if state.has_fitted(DISPERSION):
        squares[-1] = typical**2  # the RF counts like a typical column
    lacking = state.lacking.copy()
    lacking[block] = np.sqrt(np.maximum(squares - noise**2, (LEAST * noise) ** 2))
    good = good_monitors(state, block)
    if block:
        good &= state.good
    return _independent(replace(state, lacking=lacking, share=share, good=good), block, left, alone)


def _shares(state: State, block: int, left: Array) -> Array:
    """The factors on the weights of the readings, [block, column, monitor].

    The RF's orbit is read once: a few outliers (zeros where nothing was read, for example) would be
    fitted by kicks and an energy offset. Those of correctors count only in the last fit.

    Args:
        state: of the fit.
        block: 0 in-plane, 1 coupling.
        left: residuals, m, NaN where nothing is fitted, [column, monitor].
    """
    out = state.share.copy()
    times = SIGNIFICANT / np.maximum(np.abs(pulls(state, block, left)), SIGNIFICANT)
    times = np.where(np.isfinite(left), times, 1.0)
    if state.robust:
        out[block, :-1] = times[:-1] ** 2
    if state.has_fitted(DISPERSION) and np.isfinite(left[-1]).sum() >= FEW:
        out[block, -1] = times[-1] ** 4
    return out


def pulls(state: State, block: int, left: Array) -> Array:
    """Return residuals in units of the column's typical one, or of the noise if that is larger."""
    typical = chi2.typical(left, axis=1)
    return np.asarray(left / np.fmax(state.data.noise_of(block), typical[:, None]))


def _independent(state: State, block: int, left: Array, noise: Array) -> State:
    """The state with its effective sample size, once gradients are fitted: residuals by gradients
    are betatron oscillations, too."""
    if state.independent is None or not state.has_fitted(DISPERSION):
        return state
    own = state.independent.copy()
    read = left[:-1] * np.sqrt(state.share[block, :-1])
    for p in (0, 1):
        rows = state.data.plane_of(block)[:-1] == p
        own[block, p] = independent(read[rows], noise[:-1][rows])
    return replace(state, independent=own)


def independent(left: Array, noise: Array) -> float:
    """Return the effective sample size as a share of the readings; 1 if the residual is noise.

    Model discrepancy is not white: it is a few betatron oscillations, common to many columns and
    BPMs. If each residual counted as independent, evidence and errors would be overconfident. White
    noise spreads over all singular vectors of the residual, betatron oscillations over few. The
    participation ratio of the squared singular values counts them, relative to its expectation for
    white noise. (For C x M Gaussian numbers the squared singular values s have E sum s = C M and E
    sum s^2 = C M (C + M + 1).)

    Args:
        left: residuals of a fit, m, NaN where nothing was read, [column, monitor].
        noise: rms noise of each reading, m, [column, monitor].
    """
    seen = np.isfinite(left)
    left, noise = np.where(seen, left, 0.0), np.where(seen, noise, 0.0)
    rows, columns = seen.any(axis=1), seen.any(axis=0)
    left, noise, seen = (own[rows][:, columns] for own in (left, noise, seen))
    C, M = left.shape
    if min(C, M) < FEW or not left.any():
        return 1.0
    lacking = max(1 - float(np.sum(noise**2) / np.sum(left**2)), 0.0)
    # a column or BPM with large residuals is no common pattern either
    for axis in (1, 0, 1):
        typical = np.sum(left**2, axis=axis, keepdims=True) / seen.sum(axis=axis, keepdims=True)
        left = left / np.sqrt(np.maximum(typical, TINY))
    squares = np.linalg.svd(np.clip(left, -CLIPPED, CLIPPED), compute_uv=False) ** 2
    white = C * M / (C + M + 1)
    share = min(float(squares.sum() ** 2 / np.sum(squares**2)) / white, 1.0)
    return float(1 / (1 + lacking * (1 / share - 1)))


def good_monitors(state: State, block: int = 0, bad: float = SIGNIFICANT) -> Flags:
    """Return the BPMs that agree with the others, given gains, [monitor]; in the plane that is not
    kicked also given fitted skew gradients, before which all are good.

    Args:
        state: of the fit.
        block: 0 in-plane, 1 coupling.
        bad: ratio to the median rms residual, given gains, above which a BPM is bad.
    """
    data = state.data
    ratio = np.zeros(data.shape[1])
    read, orbits = data.pick(state.at.read, block), data.pick(data.orbits, block)
    for p in (0, 1) if block == 0 or state.has_fitted(COUPLING) else ():
        rows = state.fitted & (data.plane == p)
        if rows.sum() < FEW:
            continue
        own = np.full(data.shape[1], np.inf)
        rounded = REDUNDANT * float(np.sqrt(np.mean(np.nan_to_num(orbits[rows]) ** 2)))
        for spared in (0.0, OUTLIERS):
            rms, gain, count = _given_own_gain(read[rows], orbits[rows], spared)
            if block == 0:
                rms[gain < BLIND] = np.inf  # reversed, until gains are fitted
            read_at_all = count > 0  # a plane may have no readings
            typical = max(np.median(rms[read_at_all]), rounded) if read_at_all.any() else np.inf
            # otherwise the fit has diverged, and BPMs are not bad
            share = rms / typical if 0 < typical < np.inf else np.zeros_like(rms)
            own = np.minimum(own, np.where(read_at_all, share, 0.0))
        ratio = np.maximum(ratio, own)
    return np.asarray(ratio <= bad)


def _given_own_gain(read: Array, orbits: Array, spared: float = 0.0) -> tuple[Array, Array, Array]:
    """The rms residual of each BPM given its own gain, m; that gain, relative to the fitted one;
    and the number of readings, [monitor].

    Args:
        read, orbits: of the model and measured, m, [column, monitor].
        spared: share of a BPM's readings, the largest residuals, that is omitted.
    """
    seen = np.isfinite(orbits)
    if spared:
        left = np.abs(orbits - read * _gain(read, orbits, seen))
        worst_last = np.argsort(np.argsort(np.where(seen, left, np.inf), axis=0), axis=0)
        seen &= worst_last < np.ceil((1 - spared) * seen.sum(axis=0))
    gain = _gain(read, orbits, seen)
    count = seen.sum(axis=0)
    left = np.where(seen, orbits - gain * read, 0.0)
    return np.sqrt((left**2).sum(axis=0) / np.maximum(count, 1)), gain, count


def _gain(read: Array, orbits: Array, seen: Flags) -> Array:
    u, d = np.where(seen, read, 0), np.where(seen, orbits, 0)
    return np.asarray((u * d).sum(axis=0) / np.maximum((u * u).sum(axis=0), TINY))
