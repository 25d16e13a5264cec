"""For how much each reading of a dense fit counts: what the model lacks, and monitors that are bad.

>>> state = look(state, 0)
>>> weight(state, 0)                               # 1 / variance, [column, monitor]
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from tmlattice.diagnosis.response.independent import independent
from tmlattice.diagnosis.response.outlier_readings import rf_shares, shares
from tmlattice.diagnosis.response.state import State
from tmlattice.inference.normal import amounts, common, times_precision

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

BAD = 5.0
"""A monitor whose rms residual, its gain fitted, is so many times the median one's is bad."""
SPARED = 0.1
"""Of its readings: a monitor is not bad by the few worst of them alone; these are themselves."""
FEW = 4
"""Correctors that a plane needs for a monitor to be judged by what its gain leaves."""
TYPICAL = 10.0
"""The median misfit of all columns counts as so many readings of each one's own."""
LEAST = 0.2
"""Of the noise: what the model lacks at least, and what noise is left beside a jitter."""
ROUNDED = 1e-6
"""Of the readings: two equal responses differ by less."""
DISPERSION = "quadrupole_gradient"
"""The family that makes the RF's orbit what it is. Before it is there, that orbit is off by many
times what all others are, and would make the monitors' gains what fits it."""
COUPLING = "skew_gradient"
"""The family that makes the other plane's readings what they are."""


def weight(state: State, block: int) -> Array:
    """1 / variance of the readings that are fitted, [column, monitor]."""
    data, split = state.data, state.split
    use = np.isfinite(data.pick(data.orbits, block)) & state.good
    use[:-1] &= state.fitted[:-1, None]
    use[-1] &= split.half[-1]
    if state.exploring:
        use[-1] &= ~split.inner_rf
    variance = data.noise_of(block) ** 2 + state.lacking[block][:, None] ** 2
    count = np.array(np.broadcast_to(counts(state, block), use.shape))
    if state.share is not None:
        count *= state.share[block]
    if state.rf_share is not None:
        count[-1] *= state.rf_share[block]
    return np.where(use, count / variance, 0.0)


def taken(state: State, block: int) -> Array | None:
    """What the beam's jitter takes from the weights, see `inference.common`, [column, monitor,
    pattern]; None where the beam stood still."""
    return None if state.jitter is None else _common(state, block)[0]


def _common(state: State, block: int) -> tuple[Array, Array]:
    """What jitter takes from the weights, and its share of the log evidence."""
    assert state.jitter is not None
    count = counts(state, block)
    alone = weight(state, block) / count
    own, scale = common(alone, state.jitter[state.data.plane_of(block)])
    return own * np.sqrt(count)[:, :, None], count[:, 0] * scale


def weighed(state: State, block: int, left: Array) -> Array:
    """Inverse covariance of the readings that are fitted times what is left, 1/m, [column,
    monitor]."""
    weights, own = weight(state, block), taken(state, block)
    left = np.where(weights > 0, left, 0.0)
    return weights * left if own is None else times_precision(weights, own, left)


def log_scale(state: State, block: int) -> float:
    """Logarithm of the determinant of that inverse covariance."""
    weights = weight(state, block)
    use = weights > 0
    count = np.broadcast_to(counts(state, block), use.shape)[use]
    total = float(count @ np.log(weights[use] / count))
    return total if state.jitter is None else total - float(_common(state, block)[1].sum())


def _without_jitter(state: State, block: int, left: Array) -> tuple[Array, Array]:
    """What is left beside the likeliest jitter of each column, and the readings' noise, which
    stated or learnt has the jitter in it, beside it; m, [column, monitor]."""
    noise = state.data.noise_of(block)
    if state.jitter is None:
        return left, noise
    patterns = state.jitter[state.data.plane_of(block)]
    own = amounts(weight(state, block) / counts(state, block), patterns, left)[0]
    alone = np.maximum(noise**2 - np.sum(patterns**2, axis=1), (LEAST * noise) ** 2)
    return left - np.einsum("ck,ckm->cm", own, patterns), np.sqrt(alone)


def counts(state: State, block: int) -> Array:
    """As how many readings each one counts, [column, 1]."""
    plane = state.data.plane_of(block)
    own = np.ones(len(plane)) if state.independent is None else state.independent[block, plane]
    return np.asarray(own[:, None])


def look(state: State, block: int) -> State:
    """What the model lacks now; and the monitors that are bad, their own gains apart."""
    data = state.data
    use = weight(state, block) > 0
    left = np.where(use, data.pick(state.at.left, block), np.nan)
    left, alone = _without_jitter(state, block, left)
    if state.share is not None:
        state = replace(state, share=shares(state, block, left[:-1]))
    typical = float(np.nanmedian(np.abs(left[:-1, state.good]))) / 0.6745
    noise = float(np.median(data.noise))
    share = 1.0 if state.share is None else state.share[block]
    shared = TYPICAL * typical**2 + np.nansum(share * left**2, axis=1)
    squares = shared / (TYPICAL + use.sum(axis=1))
    if state.allows(DISPERSION):
        squares[-1] = typical**2  # it is one column among many, and counts like any
        state = replace(state, rf_share=rf_shares(state, block, left[-1]))
    lacking = state.lacking.copy()
    lacking[block] = np.sqrt(np.maximum(squares - noise**2, (LEAST * noise) ** 2))
    good = state.good & _good_across(state) if block else good_monitors(state)
    return _independent(replace(state, lacking=lacking, good=good), block, left, alone)


def _independent(state: State, block: int, left: Array, noise: Array) -> State:
    """With the share of independent readings, where that is looked at: not before there are
    gradients, for all that they make is waves."""
    if state.independent is None or not state.allows(DISPERSION):
        return state
    own, shares = state.independent.copy(), state.share
    read = left[:-1] if shares is None else left[:-1] * np.sqrt(shares[block, :-1])
    for p in (0, 1):
        rows = state.data.plane_of(block)[:-1] == p
        own[block, p] = independent(read[rows], noise[:-1][rows])
    return replace(state, independent=own)


def good_monitors(state: State, bad: float = BAD) -> Flags:
    """Those that read, in the plane that is kicked, what the others make likely, [monitor].

    Args:
        state: that is fitted.
        bad: so many times the median rms residual, gains fitted, is a bad monitor's.
    """
    data = state.data
    read, orbits = data.pick(state.at.read), data.pick(data.orbits)
    ratio = np.zeros(data.shape[1])
    for p in (0, 1):
        rows = state.fitted & (data.plane == p)
        if rows.sum() < FEW:
            continue
        own = np.full(data.shape[1], np.inf)
        rounded = ROUNDED * float(np.sqrt(np.mean(np.nan_to_num(orbits[rows]) ** 2)))
        for spared in (0.0, SPARED):
            rms, gain, count = _given_own_gain(read[rows], orbits[rows], spared)
            rms[gain < 0.2] = np.inf  # reversed, until gains come in
            read_at_all = count > 0  # what was never read says nothing of the other plane
            typical = max(np.median(rms[read_at_all]), rounded) if read_at_all.any() else np.inf
            # else the fit is astray, not half of the monitors
            share = rms / typical if np.isfinite(typical) else np.zeros_like(rms)
            own = np.minimum(own, np.where(read_at_all, share, 0.0))
        ratio = np.maximum(ratio, own)
    return np.asarray(ratio <= bad)


def sound_monitors(state: State) -> Flags:
    """Those that read what is likely in both planes, [monitor]."""
    return good_monitors(state) & _good_across(state)


def _good_across(state: State) -> Flags:
    """Those that read in the other plane what is usual, their own gains apart, once skew gradients
    and rolls say what that is."""
    data = state.data
    good = np.ones(data.shape[1], dtype=bool)
    if not state.allows(COUPLING):
        return good
    read, orbits = data.pick(state.at.read, 1), data.pick(data.orbits, 1)
    for p in (0, 1):
        rows = state.fitted & (data.plane == p)
        if rows.sum() < FEW:
            continue
        bad = np.ones(data.shape[1], dtype=bool)
        for spared in (0.0, SPARED):
            rms, _, count = _given_own_gain(read[rows], orbits[rows], spared)
            usual = rms[(count > 0) & state.good]
            bad &= rms > BAD * np.median(usual) if len(usual) else False
        good &= ~bad
    return good


def _given_own_gain(read: Array, orbits: Array, spared: float = 0.0) -> tuple[Array, Array, Array]:
    """What each monitor leaves with a gain of its own, rms, m; the gain, over those that it has;
    and of how many readings, [monitor].

    Args:
        read, orbits: by the model and measured, m, [column, monitor].
        spared: share of a monitor's readings, its worst ones, that do not count.
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
    return np.asarray((u * d).sum(axis=0) / np.maximum((u * u).sum(axis=0), 1e-30))
