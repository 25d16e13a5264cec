"""The scan: how much better the data are explained by each hypothesis, alone and linearly.

Three families stand beside each other: effects of the catalogue, one amount each; a free kick per
shot at each layer ("something is here", without a name); and a monitor whose readings are all free.
The threshold is for the whole scan: the largest statistic of pure noise is simulated, and its tail
is that of a number of independent hypotheses, which is fitted.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from tmlattice.diagnosis.model import Hypothesis, Model, Paths
from tmlattice.diagnosis.whitening import Projection, Whitening

Array = NDArray[np.float64]

CHUNK = 512
"""Hypotheses at a time: the memory of a scan does not grow with their number."""

DRAWS = 64
"""Of pure noise, for the threshold."""

BLIND = 1e-6
"""A signature of which launches leave less than this share cannot be seen."""


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


def _chunks(hypotheses: Sequence[Hypothesis]) -> Iterator[tuple[slice, Sequence[Hypothesis]]]:
    for start in range(0, len(hypotheses), CHUNK):
        part = slice(start, min(start + CHUNK, len(hypotheses)))
        yield part, hypotheses[part]


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
    size = len(hypotheses)
    statistic, amount, information = np.zeros(size), np.zeros(size), np.zeros(size)
    largest = np.zeros(DRAWS)
    noise = None
    if effective is None:
        draws = np.random.default_rng([seed, 1]).standard_normal((DRAWS, len(residual)))
        noise = projection.out(draws).T
    clean = projection.out(residual)
    for part, some in _chunks(hypotheses):
        rows = whitening.signature(
            np.nan_to_num(model.signatures(paths, some, launches)) * active[:, None, None]
        )
        whole = np.einsum("hr,hr->h", rows, rows)
        rows = projection.out(rows)
        norm = np.einsum("hr,hr->h", rows, rows)
        seen = norm > BLIND**2 * whole
        seen &= norm > 0
        safe = np.where(seen, norm, 1.0)
        inner = rows @ clean
        statistic[part] = np.where(seen, inner**2 / safe, 0.0)
        amount[part] = np.where(seen, inner / safe, 0.0)
        information[part] = np.where(seen, norm, 0.0)
        if noise is not None and seen.any():
            largest = np.maximum(largest, ((rows @ noise)[seen] ** 2 / norm[seen, None]).max(0))
    if effective is None:
        effective = effective_number(largest, 1)
    return Scan(tuple(hypotheses), statistic, amount, information, effective)


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


def evidence_of_scale(values: Array, information: Array) -> Array:
    """Largest log evidence of independent amounts with one common unknown rms, [place].

    Args:
        values: best amounts in units of their own error, [place, parameter].
        information: 1 / variance of each amount, relative to the largest, [place, parameter].
    """
    best = np.zeros(len(values))
    for ratio in _RATIOS:
        shrink = ratio * information
        gain = 0.5 * (values**2 * shrink / (1 + shrink) - np.log1p(shrink)).sum(axis=1)
        best = np.maximum(best, gain)
    return best


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
        grams, inners = [], []
        for m in range(monitors):
            alone = np.zeros((len(shots), turns, 2, *shape))
            for i, shot in enumerate(shots):
                for turn in range(turns):
                    for plane in range(2):
                        alone[i, turn, plane, shot, turn * monitors + m, plane] = 1.0
            rows = whitening.signature(alone).reshape(-1, len(clean))
            rows = projection.out(rows)
            grams.append((rows @ rows.T)[None])
            inners.append((rows @ clean)[None])
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
