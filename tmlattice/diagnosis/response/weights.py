"""Weights of the readings of a hierarchical fit, and the variance components that make them.

>>> state = learnt(state, spent)
>>> weight(state, 0)                               # 1 / variance, [column, monitor]

Readings have Student's distribution about the model. Their variance is that of their noise, of the
misfit of their column and of the misfit of their BPM. Each column also has amounts of common modes:
waves of the closed orbit (beam jitter), a drift of the energy (the RF's orbit) and the place of its
corrector's field. They are integrated out, see `inference.common`. All scales are learnt from the
residuals.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tmlattice.diagnosis.response.state import DRIFT, KINDS, PLACE, State
from tmlattice.inference.common import amounts, common, times_precision
from tmlattice.inference.priors import Group

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

FREEDOM = 6.0
"""Degrees of freedom of the readings' Student distribution."""
TAILS = 4.0
"""Degrees of freedom of the amounts of common modes."""
COUNT = 10.0
"""Number of a column's own readings that the typical column's misfit counts as; a misfit of zero
counts as much for each BPM."""
LEAST = 0.05
"""Least misfit of a column, as a share of the noise."""
DAMPING = 0.7
"""Share of a step of the misfits that is taken: columns and monitors would else take turns."""
MEDIAN_SQUARE = 0.455
"""Median of chi-square of one degree of freedom."""


class Spent(NamedTuple):
    """Degrees of freedom of a block's parameters in its readings, and in the RF's."""

    all: float
    rf: float


def used(state: State, block: int) -> Flags:
    """Fitted readings, [column, monitor]."""
    data, split = state.data, state.split
    use = np.isfinite(data.pick(data.orbits, block)) & state.good
    use[:-1] &= state.fitted[:-1, None]
    use[-1] &= split.half[-1]
    if state.exploring:
        use[-1] &= ~split.inner_rf
    return np.asarray(use)


def variance(state: State, block: int) -> Array:
    """Variance of each reading, without common modes and Student weights, m^2, [column,
    monitor]."""
    noise, plane = state.noise, state.data.plane_of(block)
    return np.asarray(
        state.data.noise_of(block) ** 2 + noise.column[block][:, None] + noise.monitor[block][plane]
    )


def weight(state: State, block: int) -> Array:
    """1 / variance of the fitted readings, 0 of the others, [column, monitor]."""
    return np.where(used(state, block), state.noise.share[block] / variance(state, block), 0.0)


def patterns(state: State, block: int) -> Array:
    """Common modes of each column, with their usual size, m, [column, pattern, monitor]."""
    data, at, noise = state.data, state.at, state.noise
    plane = data.plane_of(block)
    out = np.zeros((data.shape[0], noise.size.shape[2], data.shape[1]))
    if "waves" in noise.kinds and block == 1:
        out[:, KINDS["waves"]] = noise.waves[plane]
    if "drift" in noise.kinds:
        out[:, KINDS["drift"]] = at.seen(at.beam)[-1].T[plane][:, None]
    if "place" in noise.kinds and block == 0:
        kicks = data.kicks * (1 + at.errors.calibration)
        out[:, KINDS["place"]] = (data.pick(at.seen(at.jumps)) * kicks[:, None])[:, None]
    out *= noise.size[block][:, :, None]
    out[-1] = 0.0  # the RF's orbit is one step: nothing is common to it and others
    return out


def taken(state: State, block: int) -> Array:
    """Reduction of the weights by common modes, see `inference.common`, [column, monitor,
    pattern]."""
    return common(weight(state, block), patterns(state, block))[0]


def weighed(state: State, block: int, left: Array) -> Array:
    """Inverse covariance of the fitted readings times the residual, 1/m, [column, monitor]."""
    return times_precision(weight(state, block), taken(state, block), left)


def log_likelihood(state: State, block: int) -> float:
    """Log density of the residuals, common modes integrated out (Laplace), up to a constant of the
    data."""
    use = used(state, block)
    if not use.any():
        return 0.0
    weights, modes = weight(state, block), patterns(state, block)
    left = np.where(use, state.data.pick(state.at.left, block), 0.0)
    likely = amounts(weights, modes, left)[0]
    left, v = left - np.einsum("ck,ckm->cm", likely, modes), variance(state, block)
    each = (FREEDOM + 1) / 2 * np.log1p(left**2 / (FREEDOM * v)) + 0.5 * np.log(v)
    total = float(each[use].sum()) + 0.5 * float(np.sum(likely**2))
    return -total - 0.5 * float(common(weights, modes)[1].sum())


def learnt(state: State, spent: dict[int, Spent], alike: bool = False) -> State:
    """The state with variance components from the residuals.

    Args:
        state: after a round.
        spent: degrees of freedom of each block's parameters.
        alike: all columns and all monitors have the same misfit: which of them are wrong is unknown
            before convergence.
    """
    old = state.noise
    new = replace(
        old, column=old.column.copy(), monitor=old.monitor.copy(), share=old.share.copy(),
        size=old.size.copy(), scale=old.scale.copy(),
    )  # fmt: skip
    state = replace(state, noise=new)
    for block in (0, 1):
        use = used(state, block)
        if not use.any():
            continue
        weights, modes = weight(state, block), patterns(state, block)
        left = np.where(use, state.data.pick(state.at.left, block), 0.0)
        likely, covariance = amounts(weights, modes, left)
        left = left - np.einsum("ck,ckm->cm", likely, modes)
        kept = np.einsum("ckk->ck", covariance)
        _learn_modes(state, block, use, likely, kept, alike)
        own = spent.get(block, Spent(0.0, 0.0))
        own = own._replace(all=own.all + float(np.sum(1 - kept[use.any(axis=1)])))
        _learn_misfits(state, block, use, left, own, alike)
    column, monitor = (
        before + DAMPING * (after - before)
        for before, after in ((old.column, new.column), (old.monitor, new.monitor))
    )
    return replace(state, noise=replace(new, column=column, monitor=monitor))


def with_waves(state: State) -> State:
    """Return the state with orbit waves in the plane that is not kicked, as a common mode of each
    step. Their first size is that of a least-squares fit to the residuals: given discrepancies that
    contain them already, they would stay at zero."""
    old, block = state.noise, 1
    noise = replace(
        old, kinds=(*old.kinds, "waves"), column=old.column.copy(), size=old.size.copy(),
        scale=old.scale.copy(),
    )  # fmt: skip
    use, plane = used(state, block), state.data.plane_of(block)
    left = np.where(use, state.data.pick(state.at.left, block), 0.0)
    likely = np.full((len(use), noise.waves.shape[1]), np.nan)
    for c in np.flatnonzero(use[:-1].sum(axis=1) > 2 * noise.waves.shape[1]):
        seen = use[c]
        modes = noise.waves[plane[c]][:, seen].T
        likely[c] = np.linalg.lstsq(modes, left[c, seen], rcond=None)[0]
        rest = np.sum((left[c, seen] - modes @ likely[c]) ** 2) / (seen.sum() - modes.shape[1])
        square = rest - np.mean(state.data.noise_of(block)[c, seen] ** 2)
        noise.column[block, c] = min(noise.column[block, c], max(square, _floor(state)))
    for read in (0, 1):
        own = likely[plane == read]
        own = own[np.isfinite(own[:, 0])]
        if len(own):
            square = np.mean(np.median(own**2, axis=0))
            noise.scale[block, read, 0] = float(np.sqrt(max(square, _floor(state))))
        noise.size[block, plane == read, KINDS["waves"]] = noise.scale[block, read, 0]
    return replace(state, noise=noise)


def _floor(state: State) -> float:
    """Least misfit of a column, m^2."""
    return (LEAST * float(np.median(state.data.noise))) ** 2


def _learn_modes(
    state: State, block: int, use: Flags, likely: Array, kept: Array, alike: bool
) -> None:
    """Update the scales of the common modes, in place.

    Args:
        state, block, use, alike: as in `learnt`.
        likely: amounts in units of their sizes, [column, pattern].
        kept: share of each amount's prior variance that the readings leave, [column, pattern].
    """
    noise, plane = state.noise, state.data.plane_of(block)
    first = (float(np.median(state.data.noise)), DRIFT, PLACE)
    there = np.arange(noise.size.shape[2])
    for read in (0, 1):
        mine = np.flatnonzero((use.any(axis=1) & (plane == read))[:-1])
        for kind, (name, which) in enumerate(KINDS.items()):
            own = np.ix_(mine, there[which])
            now = noise.size[block][own]
            if not now.size or name not in noise.kinds or (name == "waves" and block == 0):
                continue
            group = Group(
                name, np.eye(now.size), noise.scale[block, read, kind],
                np.inf if alike else TAILS, each=now.ravel(), first=first[kind],
            )  # fmt: skip
            group = group.learn(((now * likely[own]) ** 2).ravel(), kept[own].ravel())
            noise.scale[block, read, kind] = group.rms
            noise.size[block][own] = group.scale.reshape(now.shape)


def _learn_misfits(
    state: State, block: int, use: Flags, left: Array, spent: Spent, alike: bool
) -> None:
    """Update Student weights, and misfits of columns and BPMs by moments, in place.

    Args:
        state, block, use, alike: as in `learnt`.
        left: by the fit and the common modes, m, [column, monitor].
        spent: degrees of freedom.
    """
    noise, data, plane = state.noise, state.data, state.data.plane_of(block)
    count = use.sum(axis=1)
    share = max(1 - (spent.all - spent.rf) / max(int(count[:-1].sum()), 1), 0.1)
    free = count * np.append(np.full(len(count) - 1, share), 0.0)
    free[-1] = max(count[-1] - spent.rf, 0.01 * count[-1])
    grown = (count / np.maximum(free, 1e-9))[:, None]
    v = variance(state, block)
    # a reading is an outlier relative to its column and its BPM, not because
    # these are outliers
    usual = v if alike else np.maximum(v, _typical(left, use)[:, None])
    for read in (0, 1) if not alike else ():
        rows = plane == read
        usual[rows] = np.maximum(usual[rows], _typical(left[rows].T, use[rows].T))
    noise.share[block] = np.where(
        use, np.minimum((FREEDOM + 1) / (FREEDOM + left**2 * grown / usual), 1.0), 1.0
    )
    square = noise.share[block] * left**2 * grown - data.noise_of(block) ** 2
    floor = _floor(state)
    before = noise.monitor[block].copy()
    for _ in range(3):  # columns and monitors explain the same squares
        rest = np.where(use, square - noise.monitor[block][plane], 0.0).sum(axis=1)
        rest /= np.maximum(count, 1)
        fitted = use.any(axis=1)
        typical = max(float(np.median(rest[fitted])), 0.0)
        own = (COUNT * typical + free * rest) / (COUNT + free)
        noise.column[block] = np.maximum(typical if alike else own, floor)
        noise.column[block, -1] = max(typical, floor)  # a single orbit shows no misfit
        if alike:
            return
        for read in (0, 1):
            rows = use & (plane == read)[:, None]
            if not rows.any():
                continue
            w = np.where(rows, (v - before[plane]) ** -2.0, 0.0)
            w /= float(w[rows].mean())
            excess = np.where(rows, square - noise.column[block][:, None], 0.0)
            own = (w * excess).sum(axis=0) / (COUNT + w.sum(axis=0))
            noise.monitor[block, read] = np.maximum(own, 0.0)


def _typical(left: Array, use: Flags) -> Array:
    """Mean square of each row, by the median, m^2, [row]."""
    out = np.zeros(len(left))
    for row in np.flatnonzero(use.any(axis=1)):
        out[row] = np.median(left[row, use[row]] ** 2) / MEDIAN_SQUARE
    return out
