"""The scan: how much better the data are explained by each hypothesis, alone and linearly.

Three families stand beside each other: effects of the catalogue, one amount each; a free kick per
shot at each layer ("something is here", without a name); and a monitor whose readings are all free.
The threshold is for the whole scan: the largest statistic of pure noise is simulated, and its tail
is that of a number of independent hypotheses, which is fitted.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from scipy.special import logsumexp

from tmlattice.diagnosis.model import Hypothesis, Model, Paths
from tmlattice.diagnosis.whitening import Projection, Whitening
from tmlattice.effects import ReadingEffect, find

Array = NDArray[np.float64]

CHUNK = 512
"""Hypotheses at a time: the memory of a scan does not grow with their number."""

DRAWS = 64
"""Of pure noise, for the threshold."""

BLIND = 1e-9
"""A signature of which launches leave less than this share (of its square) cannot be seen."""

FAR = 100.0
"""What would not be seen at this many times its largest fault is not there to be seen."""


@dataclass(frozen=True)
class Scan:
    """Statistics of every hypothesis.

    Attributes:
        hypotheses: (effect, place).
        statistic: fall of chi-square by one amount, [hypothesis]; 0 for what cannot be seen.
        amount: best amount ** power of the linear model, [hypothesis].
        information: 1 / its variance, [hypothesis]; 0 for what cannot be seen.
        effective: number of independent hypotheses that pure noise sees.
    """

    hypotheses: tuple[Hypothesis, ...]
    statistic: Array
    amount: Array
    information: Array
    effective: float

    def p_value(self, statistic: float) -> float:
        """Chance that pure noise reaches this anywhere in the scan."""
        return look_elsewhere(statistic, 1, self.effective)

    def threshold(self, rate: float) -> float:
        """The statistic that pure noise reaches in this share of data sets."""
        return free_threshold(rate, 1, self.effective)


def look_elsewhere(statistic: float, freedom: int, effective: float) -> float:
    """Chance that the largest of `effective` chi-squares of so many degrees reaches this."""
    return float(-np.expm1(effective * np.log1p(-stats.chi2.sf(statistic, freedom))))


def free_threshold(rate: float, freedom: int, effective: float) -> float:
    """The chi-square of so many degrees that the largest of `effective` reaches at this rate."""
    return float(stats.chi2.isf(-np.expm1(np.log1p(-rate) / effective), freedom))


def effective_number(largest: Array, freedom: int) -> float:
    """How many independent chi-squares have maxima like these [draw]: maximum likelihood.

    The exponent N of F(t)^N has the estimate -draws / sum log F(t).
    """
    tail = stats.chi2.sf(largest, freedom)
    return float(max(len(largest) / -np.log1p(-tail).sum(), 1.0))


def scan(
    model: Model,
    paths: Paths,
    launches: Array,
    hypotheses: Sequence[Hypothesis],
    whitening: Whitening,
    projection: Projection,
    residual: Array,
    active: NDArray[np.bool_],
    *,
    effective: float | None = None,
    seed: int = 0,
) -> Scan:
    """Every hypothesis against the residual of the model as it stands.

    Args:
        model, paths, launches: the base, and its trajectories.
        hypotheses: see `Model.hypotheses`.
        whitening, projection: of the data and of the launches.
        residual: whitened rows, launches fitted.
        active: shots in which a cause would be there, [shot].
        effective: number of independent hypotheses where it is known already; else simulated.
        seed: of the simulation.
    """
    draws = np.zeros((0, len(residual)))
    if effective is None:
        random = np.random.default_rng([seed, 1])
        draws = projection.out(random.standard_normal((DRAWS, len(residual))))
    data = np.concatenate([projection.out(residual)[None], draws])
    sums = _Sums(len(hypotheses), len(data))
    rest = np.ones(len(hypotheses), dtype=bool)
    if whitening.dense and model.turns == 1:
        metric = DenseMetric(model, paths, whitening, projection, active)
        for done in (metric.kicks(hypotheses, data, sums), metric.readings(hypotheses, data, sums)):
            rest[done] = False
    elif not whitening.dense:
        for add in (_kicks, _readings):
            done = add(model, paths, hypotheses, whitening, projection, data, active, sums)
            rest[done] = False
    left = np.flatnonzero(rest)
    for start in range(0, len(left), CHUNK):
        part = left[start : start + CHUNK]
        some = [hypotheses[i] for i in part]
        signatures = np.nan_to_num(model.signatures(paths, some, launches))
        rows = whitening.signature(signatures * active[:, None, None])
        sums.add(part, np.einsum("hr,hr->h", rows, rows), projection.inside(rows), rows @ data.T)
    norm = sums.whole - sums.inside
    reach = np.array([FAR * find(name).largest ** find(name).power for name, _ in hypotheses])
    seen = (norm > BLIND * sums.whole) & (norm * reach**2 > 1.0)
    safe = np.where(seen, norm, 1.0)
    squares = np.where(seen[:, None], sums.inner**2 / safe[:, None], 0.0)
    if effective is None:
        effective = effective_number(squares[:, 1:].max(axis=0), 1)
    return Scan(
        tuple(hypotheses),
        statistic=squares[:, 0],
        amount=np.where(seen, sums.inner[:, 0] / safe, 0.0),
        information=np.where(seen, norm, 0.0),
        effective=effective,
    )


class _Sums:
    """Signatures squared, their part along the launches' directions squared, and their products
    with data rows, [hypothesis], [hypothesis], [hypothesis, data]."""

    def __init__(self, hypotheses: int, data: int) -> None:
        self.whole = np.zeros(hypotheses)
        self.inside = np.zeros(hypotheses)
        self.inner = np.zeros((hypotheses, data))

    def add(self, at: NDArray[np.intp], whole: Array, inside: Array, inner: Array) -> None:
        self.whole[at] = whole
        self.inside[at] = inside
        self.inner[at] = inner


def _behind(sums: Array) -> Array:
    """Sums over all readings from each one on, [shot, reading + 1, ...]."""
    zero = np.zeros_like(sums[:, :1])
    return np.concatenate([np.cumsum(sums[:, ::-1], axis=1)[:, ::-1], zero], axis=1)


def _kicks(
    model: Model,
    paths: Paths,
    hypotheses: Sequence[Hypothesis],
    whitening: Whitening,
    projection: Projection,
    data: Array,
    active: NDArray[np.bool_],
    sums: _Sums,
) -> NDArray[np.intp]:
    """Single kicks: a signature is the launch's own from a reading on, so that sums over the
    readings behind each, taken once, give every product."""
    which, start, pulled = model.single_kicks(paths, hypotheses)
    if not len(which):
        return which
    pulled = pulled * active[:, None, None]
    slopes = whitening.weight[..., None] * model.slopes(paths)  # [shot, reading, 2, n]
    shots, readings = slopes.shape[:2]
    Q = projection.Q[:, :-5].reshape(shots, readings, 2, -1)
    gram = _behind(np.einsum("smpi,smpj->smij", slopes, slopes, optimize=True))
    along = _behind(np.einsum("smpi,smpq->smiq", slopes, Q, optimize=True))
    whole = np.einsum("ski,skij,skj->k", pulled, gram[:, start], pulled, optimize=True)
    inside = np.einsum("ski,skiq->skq", pulled, along[:, start], optimize=True)
    rows = data.reshape(len(data), shots, -1)[:, :, :-5].reshape(len(data), shots, readings, 2)
    inner = np.empty((len(which), len(data)))
    for d, row in enumerate(rows):
        behind = _behind(np.einsum("smpi,smp->smi", slopes, row))
        inner[:, d] = np.einsum("ski,ski->k", pulled, behind[:, start])
    sums.add(which, whole, np.einsum("skq,skq->k", inside, inside), inner)
    return which


def _readings(
    model: Model,
    paths: Paths,
    hypotheses: Sequence[Hypothesis],
    whitening: Whitening,
    projection: Projection,
    data: Array,
    active: NDArray[np.bool_],
    sums: _Sums,
) -> NDArray[np.intp]:
    """Effects on readings: a signature lives in the readings of one monitor."""
    monitor = {name: m for m, name in enumerate(model.maps.monitors)}
    of_effect: dict[str, list[int]] = {}
    for i, (name, _) in enumerate(hypotheses):
        if isinstance(find(name), ReadingEffect):
            of_effect.setdefault(name, []).append(i)
    shots = len(paths.beam)
    shape = (shots, model.turns, len(monitor), 2)
    Q = projection.Q[:, :-5].reshape(*shape, -1)
    rows = data.reshape(len(data), shots, -1)[:, :, :-5].reshape(len(data), *shape)
    for name, members in of_effect.items():
        effect = find(name)
        assert isinstance(effect, ReadingEffect)
        h = 1.0 if effect.discrete else 1e-6
        change = whitening.weight * np.nan_to_num(effect.change(paths.beam, h) / h)
        change = (change * active[:, None, None]).reshape(shape)
        at = [monitor[place] for _, place in (hypotheses[i] for i in members) if place is not None]
        along = np.einsum("stmp,stmpq->smq", change, Q, optimize=True)
        sums.add(
            np.array(members),
            np.einsum("stmp,stmp->m", change, change)[at],
            np.einsum("smq,smq->m", along, along)[at],
            np.einsum("stmp,dstmp->md", change, rows, optimize=True)[at],
        )
    return np.array([i for members in of_effect.values() for i in members], dtype=np.intp)


class DenseMetric:
    """Products of signatures where a background correlates all readings of all shots.

    Readings stand monitor by monitor. The launches' signatures behind each monitor have a Gram
    matrix that grows by that monitor's rows: all of them cost one product of the precision with
    the slopes.

    Args:
        model, paths: the base.
        whitening, projection: the noise with its background, and the launches.
        active: shots in which a cause would be there.
    """

    def __init__(
        self,
        model: Model,
        paths: Paths,
        whitening: Whitening,
        projection: Projection,
        active: NDArray[np.bool_],
    ) -> None:
        self.model, self.paths, self.whitening = model, paths, whitening
        self.weight = whitening.weight * active[:, None, None]
        shots, monitors = self.weight.shape[:2]
        self.order = (
            np.arange(self.weight.size).reshape(shots, monitors, 2).transpose(1, 0, 2).ravel()
        )
        precision = whitening.projected_precision(projection)
        self.precision = precision[np.ix_(self.order, self.order)]

    def data(self, rows: Array) -> Array:
        """Precision times data, for products with signatures: [data, shot, reading, 2]."""
        parts = rows.reshape(len(rows), self.weight.shape[0], -1)[:, :, :-5]
        return self.whitening.back(parts) * (self.weight > 0)

    @cached_property
    def slopes(self) -> Array:
        """Weighted d readings / d launch, [shot, reading, 2, n]."""
        return np.asarray(self.weight[..., None] * self.model.slopes(self.paths))

    @cached_property
    def grams(self) -> Array:
        """Of the launches' signatures from each reading on, [reading + 1, shot n, shot n]."""
        shots, monitors, _, n = self.slopes.shape
        spread = np.zeros((monitors, shots, 2, shots, n))
        for shot in range(shots):
            spread[:, shot, :, shot] = self.slopes[shot]
        H = spread.reshape(monitors, 2 * shots, shots * n)
        rows = H.reshape(-1, shots * n)
        grams = np.zeros((monitors + 1, shots * n, shots * n))
        for m in range(monitors - 1, -1, -1):
            own = slice(2 * shots * m, 2 * shots * (m + 1))
            behind = slice(2 * shots * (m + 1), None)
            cross = H[m].T @ (self.precision[own, behind] @ rows[behind])
            self_ = H[m].T @ self.precision[own, own] @ H[m]
            grams[m] = grams[m + 1] + cross + cross.T + self_
        return grams

    def kicks(self, hypotheses: Sequence[Hypothesis], rows: Array, sums: _Sums) -> NDArray[np.intp]:
        """Add the single kicks among the hypotheses; returns which these are."""
        which, start, pulled = self.model.single_kicks(self.paths, hypotheses)
        if not len(which):
            return which
        stacked = np.moveaxis(pulled, 0, 1).reshape(len(which), -1)  # [kick, shot n]
        whole = np.empty(len(which))
        for m in np.unique(start):
            at = start == m
            whole[at] = np.einsum("ki,ij,kj->k", stacked[at], self.grams[m], stacked[at])
        inner = np.empty((len(which), len(rows)))
        model_slopes = self.model.slopes(self.paths)
        for d, row in enumerate(self.data(rows)):
            behind = _behind(np.einsum("smpi,smp->smi", model_slopes, row))
            inner[:, d] = np.einsum("ski,ski->k", pulled, behind[:, start])
        sums.add(which, whole, np.zeros(len(which)), inner)
        return which

    def block(self, m: int) -> Array:
        """Precision of one monitor's readings, in units of their noise, [shot 2, shot 2]."""
        shots = len(self.weight)
        own = slice(2 * shots * m, 2 * shots * (m + 1))
        return np.asarray(self.precision[own, own])

    def readings(
        self, hypotheses: Sequence[Hypothesis], rows: Array, sums: _Sums
    ) -> NDArray[np.intp]:
        """Add the effects on readings; returns which these are."""
        monitor = {name: m for m, name in enumerate(self.model.maps.monitors)}
        data = self.data(rows)
        done = []
        for i, (name, place) in enumerate(hypotheses):
            effect = find(name)
            if not isinstance(effect, ReadingEffect) or place is None:
                continue
            m = monitor[place]
            h = 1.0 if effect.discrete else 1e-6
            change = np.nan_to_num(effect.change(self.paths.beam[:, m], h) / h)
            weighted = (self.weight[:, m] * change).ravel()
            whole = weighted @ self.block(m) @ weighted
            inner = np.einsum("sp,dsp->d", change, data[:, :, m])
            sums.add(np.array([i]), whole, np.zeros(1), inner)
            done.append(i)
        return np.array(done, dtype=np.intp)


@dataclass(frozen=True)
class FreeScan:
    """The same for what has no name: free kicks at places, or free readings of monitors.

    Attributes:
        places: layers, or monitors, [place].
        gain: by how much the log evidence grows, [place].
        statistic: fall of chi-square, [place].
        freedom: number of parameters, [place].
        amounts: best values, [place, parameter], zero where there is none.
    """

    places: NDArray[np.int64]
    gain: Array
    statistic: Array
    freedom: NDArray[np.int64]
    amounts: Array


_RATIOS = np.logspace(-1, 8, 46)
"""Prior variance of a free amount over that of its best measured direction: even in its log."""


def evidence_of_scale(values: Array, information: Array) -> Array:
    """Log evidence of independent amounts with one common unknown rms, [place].

    Args:
        values: best amounts in units of their own error, [place, parameter].
        information: 1 / variance of each amount, relative to the largest, [place, parameter].
    """
    gains = []
    for ratio in _RATIOS:
        shrink = ratio * information
        gains.append(0.5 * (values**2 * shrink / (1 + shrink) - np.log1p(shrink)).sum(axis=1))
    return np.asarray(logsumexp(gains, axis=0) - np.log(len(_RATIOS)))


def _free_scan(places: NDArray[np.int64], gram: Array, inner: Array) -> FreeScan:
    """Statistics of groups of parameters.

    Args:
        places: their names, [place].
        gram: information, [place, block, p, p]; parameters of different blocks are independent.
        inner: signatures times residual, [place, block, p].
    """
    values, vectors = np.linalg.eigh(gram)
    top = np.maximum(values.max(axis=(1, 2), keepdims=True), 1e-300)
    seen = values > 1e-10 * top
    along = np.einsum("kbpq,kbp->kbq", vectors, inner)
    safe = np.where(seen, values, 1.0)
    scaled = np.where(seen, along / np.sqrt(safe), 0.0).reshape(len(gram), -1)
    information = np.where(seen, values / top, 0.0).reshape(len(gram), -1)
    amounts = np.einsum("kbpq,kbq->kbp", vectors, np.where(seen, along / safe, 0.0))
    return FreeScan(
        places,
        evidence_of_scale(scaled, information),
        (scaled**2).sum(axis=1),
        seen.reshape(len(gram), -1).sum(axis=1),
        amounts.reshape(len(gram), -1),
    )


def scan_kicks(
    model: Model,
    paths: Paths,
    layers: Sequence[int],
    whitening: Whitening,
    projection: Projection,
    residual: Array,
    active: NDArray[np.bool_],
) -> FreeScan:
    """A free kick (px, py) in every active shot, in the middle of each of these layers' magnets."""
    clean = projection.out(residual)
    shots = np.flatnonzero(active)
    if whitening.dense and model.turns == 1:
        metric = DenseMetric(model, paths, whitening, projection, active)
        first, pulled = model.free_kicks(paths, np.asarray(layers))  # [layer, 2, shot, n]
        behind = _behind(
            np.einsum("smpi,smp->smi", model.slopes(paths), metric.data(clean[None])[0])
        )
        n = pulled.shape[3]
        gram = np.empty((len(layers), 1, 2 * len(shots), 2 * len(shots)))
        inner = np.empty((len(layers), 1, 2 * len(shots)))
        for k, m in enumerate(first):
            V = np.zeros((len(shots), 2, model.shots, n))
            for i, shot in enumerate(shots):
                V[i, :, shot] = pulled[k, :, shot]
            flat = V.reshape(2 * len(shots), -1)
            gram[k, 0] = flat @ metric.grams[m] @ flat.T
            inner[k, 0] = flat @ behind[:, m].ravel()
        return _free_scan(np.asarray(layers), gram, inner)
    grams, inners = [], []
    for start in range(0, len(layers), 128):
        kicked = model.kick_signatures(paths, np.asarray(layers[start : start + 128]))
        places = len(kicked)
        if whitening.dense:
            alone = np.zeros((places, len(shots), *kicked.shape[1:]))
            for i, shot in enumerate(shots):
                alone[:, i, :, shot] = kicked[:, :, shot]
            rows = projection.out(whitening.signature(alone)).reshape(places, 1, -1, len(clean))
            parts = clean[None]
        else:  # shots are independent: a kick reaches the rows of its own alone
            rows = projection.out(whitening.signature(kicked))
            rows = rows.reshape(places, 2, whitening.shots, -1).swapaxes(1, 2)[:, shots]
            parts = clean.reshape(whitening.shots, -1)[shots]
        grams.append(np.einsum("kbpr,kbqr->kbpq", rows, rows, optimize=True))
        inners.append(np.einsum("kbpr,br->kbp", rows, parts, optimize=True))
    return _free_scan(np.asarray(layers), np.concatenate(grams), np.concatenate(inners))


def scan_monitors(
    monitors: int,
    shape: tuple[int, ...],
    whitening: Whitening,
    projection: Projection,
    residual: Array,
    active: NDArray[np.bool_],
) -> FreeScan:
    """All readings of a monitor free, in every active shot and turn."""
    clean = projection.out(residual)
    shots = np.flatnonzero(active)
    turns = shape[1] // monitors
    reading = np.arange(turns) * monitors
    if whitening.dense:
        blocks = whitening.projected_precision(projection)
        data = whitening.back(clean.reshape(whitening.shots, -1)[:, :-5])
        flat = np.arange(np.prod(shape)).reshape(shape)
        grams, inners = [], []
        for m in range(monitors):
            own = flat[shots][:, reading + m].ravel()
            scale = whitening.weight.ravel()[own]
            grams.append((scale[:, None] * blocks[np.ix_(own, own)] * scale)[None])
            inners.append(data.ravel()[own][None])
        return _free_scan(np.arange(monitors), np.stack(grams), np.stack(inners))
    # the rows of a monitor in its shot, and what the launch's directions have there
    places = 2 * (reading[None, :, None] + np.arange(monitors)[:, None, None]) + np.arange(2)
    places = places.reshape(monitors, -1)  # [monitor, turn * plane]
    weight = whitening.weight.reshape(whitening.shots, -1)[shots][:, places]  # [shot, monitor, p]
    Q = projection.Q[shots][:, places]  # [shot, monitor, p, direction]
    gram = np.eye(places.shape[1]) - np.einsum("smpd,smqd->smpq", Q, Q)
    gram = weight[..., :, None] * gram * weight[..., None, :]
    inner = weight * clean.reshape(whitening.shots, -1)[shots][:, places]
    return _free_scan(np.arange(monitors), gram.swapaxes(0, 1), inner.swapaxes(0, 1))
