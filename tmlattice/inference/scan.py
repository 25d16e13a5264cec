"""The scan: improvement of the fit by each hypothesis, alone and linearly.

Three families are scanned: effects of the catalogue, one amount each; a free kick per shot at each
layer, of unknown cause; and a monitor whose readings are all free. The threshold is for the whole
scan: the largest statistic of pure noise is simulated, and the tail of a number of independent
hypotheses is fitted to it.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import logsumexp

from tmlattice.arrays import INVISIBLE, TINY, Array, Indices
from tmlattice.effects import Hypothesis, find
from tmlattice.inference import chi2
from tmlattice.inference.problem import Metric

DRAWS = 64
"""Simulations of pure noise for the threshold: the effective number is known to 12 %."""


MAX_FAULTS = 100.0
"""Largest faults that a hypothesis must need for one standard deviation, at most."""


@dataclass(frozen=True)
class Scan:
    """Statistics of every hypothesis.

    Attributes:
        hypotheses: (effect, place).
        statistic: fall of chi-square by one amount, [hypothesis]; 0 if invisible.
        amount: best amount ** power of the linear model, [hypothesis].
        information: 1 / its variance, [hypothesis]; 0 if invisible.
        effective: number of independent hypotheses in pure noise.
    """

    hypotheses: tuple[Hypothesis, ...]
    statistic: Array
    amount: Array
    information: Array
    effective: float

    def p_value(self, statistic: float) -> float:
        """Probability that pure noise reaches a statistic anywhere in the scan."""
        return look_elsewhere(statistic, 1, self.effective)

    @property
    def chance(self) -> float:
        """P-value of the largest statistic."""
        return self.p_value(float(self.statistic.max(initial=0.0)))

    def threshold(self, rate: float) -> float:
        """Statistic that pure noise reaches at this rate."""
        return free_threshold(rate, 1, self.effective)


def look_elsewhere(statistic: float, freedom: int, effective: float) -> float:
    """Probability that the largest of `effective` chi-squares reaches a statistic."""
    return float(-np.expm1(effective * _log_below(statistic, freedom)))


def _log_below(statistic: float | Array, freedom: int) -> Array:
    """Log probability that one chi-square stays below; always finite."""
    tail = np.minimum(chi2.sf(statistic, freedom), 1 - np.finfo(float).epsneg)
    return np.asarray(np.log1p(-tail))


def free_threshold(rate: float, freedom: int, effective: float) -> float:
    """Chi-square that the largest of `effective` reaches at this rate."""
    return float(chi2.isf(-np.expm1(np.log1p(-rate) / effective), freedom))


def effective_number(largest: Array, freedom: int) -> float:
    """Number of independent chi-squares with maxima like these [draw], by maximum likelihood.

    The exponent N of F(t)^N has the estimate -draws / sum log F(t).
    """
    return float(max(len(largest) / -_log_below(largest, freedom).sum(), 1.0))


def scan(
    metric: Metric,
    hypotheses: Sequence[Hypothesis],
    residual: Array,
    *,
    effective: float | None = None,
    seed: int = 0,
) -> Scan:
    """Scan every hypothesis against the residual.

    Args:
        metric: products at the model's trajectories.
        hypotheses: see `Model.hypotheses`.
        residual: whitened rows, launches fitted.
        effective: number of independent hypotheses; None: simulated.
        seed: of the simulation.
    """
    if not len(hypotheses):
        nothing = np.zeros(0)
        return Scan((), nothing, nothing, nothing, 1.0)
    draws = np.zeros((0, len(residual)))
    if effective is None:
        random = np.random.default_rng([seed, 1])
        draws = metric.projection.out(random.standard_normal((DRAWS, len(residual))))
    data = np.concatenate([metric.projection.out(residual)[None], draws])
    sums = metric.products(hypotheses, data)
    norm = sums.whole - sums.inside
    reach = np.array(
        [MAX_FAULTS * find(name).largest ** find(name).power for name, _ in hypotheses]
    )
    seen = (norm > INVISIBLE * sums.whole) & (norm * reach**2 > 1.0)
    safe = np.where(seen, norm, 1.0)
    squares = np.where(seen[:, None], sums.inner**2 / safe[:, None], 0.0)
    if effective is None:
        effective = effective_number(squares[:, 1:].max(axis=0, initial=0.0), 1)
    return Scan(
        tuple(hypotheses),
        statistic=squares[:, 0],
        amount=np.where(seen, sums.inner[:, 0] / safe, 0.0),
        information=np.where(seen, norm, 0.0),
        effective=effective,
    )


@dataclass(frozen=True)
class FreeScan:
    """Statistics of free kicks at places, or of free readings of monitors.

    Attributes:
        gain: in log evidence, [place]; a place is a layer, or a monitor.
        statistic: fall of chi-square, [place].
        freedom: number of parameters, [place].
        amounts: best values, [place, parameter], zero where there is none.
    """

    gain: Array
    statistic: Array
    freedom: Indices
    amounts: Array


NO_SCAN = FreeScan(np.zeros(0), np.zeros(0), np.zeros(0, np.int64), np.zeros((0, 0)))
"""Scan of no places."""


_RATIOS = np.logspace(-1, 8, 46)
"""Prior variance of a free amount over that of its best measured direction: log-uniform."""


def evidence_of_scale(values: Array, information: Array) -> Array:
    """Log evidence of independent amounts with a common unknown rms, [place].

    Args:
        values: best amounts in units of their own error, [place, parameter].
        information: 1 / variance of each amount, relative to the largest, [place, parameter].
    """
    gains = []
    for ratio in _RATIOS:
        shrink = ratio * information
        gains.append(0.5 * (values**2 * shrink / (1 + shrink) - np.log1p(shrink)).sum(axis=1))
    return np.asarray(logsumexp(gains, axis=0) - np.log(len(_RATIOS)))


def free_scan(gram: Array, inner: Array) -> FreeScan:
    """Statistics of groups of parameters.

    Args:
        gram: information, [place, block, p, p]; parameters of different blocks are independent.
        inner: signatures times residual, [place, block, p].
    """
    values, vectors = np.linalg.eigh(gram)
    top = np.maximum(values.max(axis=(1, 2), keepdims=True), TINY)
    seen = values > 1e-10 * top
    along = np.einsum("kbpq,kbp->kbq", vectors, inner)
    safe = np.where(seen, values, 1.0)
    scaled = np.where(seen, along / np.sqrt(safe), 0.0).reshape(len(gram), -1)
    information = np.where(seen, values / top, 0.0).reshape(len(gram), -1)
    amounts = np.einsum("kbpq,kbq->kbp", vectors, np.where(seen, along / safe, 0.0))
    return FreeScan(
        evidence_of_scale(scaled, information),
        (scaled**2).sum(axis=1),
        seen.reshape(len(gram), -1).sum(axis=1),
        amounts.reshape(len(gram), -1),
    )


def scan_kicks(metric: Metric, layers: Sequence[int], residual: Array) -> FreeScan:
    """Scan a free kick (px, py) in every shot, in the middle of each layer's magnet."""
    clean = metric.projection.out(residual)
    return free_scan(*metric.free_kicks(np.asarray(layers), clean))


def scan_monitors(metric: Metric, residual: Array) -> FreeScan:
    """Scan monitors with free readings in every shot and turn."""
    return free_scan(*metric.free_monitors(metric.projection.out(residual)))
