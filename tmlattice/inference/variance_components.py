"""Variance components: the sizes of a machine's distributed errors, from its readings.

The errors are Gaussian with one rms per family (such as an effect): C = C0 + sum_h t_h^2 K_h with
K_h = S_h^T S_h of the family's signatures at their usual rms. The scales t_h maximise the
restricted likelihood, launches projected out, by the average information of Gilmour, Thompson and
Cullis (1995). A prior keeps families that the readings do not determine near the others. The
evidence decides whether there are distributed errors at all.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.linalg import cho_solve

from tmlattice.arrays import TINY, Array, Flags
from tmlattice.inference.newton import ITERATIONS
from tmlattice.inference.normal import inverse_by_factor, lower_factor
from tmlattice.inference.priors import MAX_STEP, SCALE_SPREAD

COMMON_SPREAD = 1.5
"""rms of the common log scale: machines differ by factors of five."""

FAMILY_SPREAD = 0.7
"""rms of one family's log scale relative to the others: by factors of two."""


PLANES = 0.9
"""Correlation of a family's log scale with that of the other plane: one survey, one hardware."""

MIN_GAIN = 0.5
"""Gain of log likelihood below which the iteration ends: steps converge quadratically."""


@dataclass(frozen=True)
class VarianceComponents:
    """Estimated scales of distributed errors.

    Attributes:
        scale: of each family, relative to its usual size, [family].
        covariance: of the log scales, [family, family].
        noise: scale of each part of the noise, relative to its first guess, [part].
        log_evidence: over no distributed errors with the guessed noise.
        log_marginal: log marginal likelihood, up to a constant.
    """

    scale: Array
    covariance: Array
    noise: Array
    log_evidence: float
    log_marginal: float

    @property
    def error(self) -> Array:
        """Standard deviation of each log scale, [family]."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))


def fit_variance_components(
    rows: Array,
    launches: Array,
    families: Sequence[Array],
    noise: Sequence[Flags] = (),
    prior: Array | None = None,
) -> VarianceComponents:
    """Return the most probable scales of families of distributed errors.

    Args:
        rows: residual in units of the noise, [row].
        launches: orthonormal directions of the launches, [row, direction].
        families: usual rms times signature of each error of a family, [error, row].
        noise: parts of the rows whose noise is estimated too, [row] each; none: noise is known.
        prior: covariance of the log scales before these rows; None: of families without planes.
    """

    def out(x: Array) -> Array:
        return np.asarray(x - (x @ launches) @ launches.T)

    clean = out(rows)
    inside = launches @ launches.T
    seen = [out(some) for some in (*families, *(np.diag(mask.astype(float)) for mask in noise))]
    parts = [own.T @ own for own in seen]
    # without a scale: the noise where it is known, and the launches' directions
    base = inside if noise else np.eye(len(rows))
    known = prior_covariance(range(len(families))) if prior is None else prior
    precision = np.eye(len(known) + len(noise)) / SCALE_SPREAD**2
    precision[: len(known), : len(known)] = np.linalg.inv(known)
    size = np.zeros(len(parts))
    now = _state(clean, base, parts, size, precision)
    damping = 1e-3
    for _ in range(ITERATIONS):
        step = np.linalg.solve(now.information + damping * np.eye(len(size)), now.slope)
        step *= min(1.0, MAX_STEP / np.abs(step).max(initial=TINY))
        trial = _state(clean, base, parts, size + step, precision)
        if trial.value <= now.value + 1e-9:
            if damping > 1e3 or np.abs(step).max(initial=0.0) < 0.02:
                break
            damping = max(10 * damping, 0.1)
            continue
        gained, size, now, damping = trial.value - now.value, size + step, trial, damping / 5
        if gained < MIN_GAIN:
            break
    covariance = np.linalg.inv(now.information)
    none = -0.5 * float(clean @ clean)
    occam = 0.5 * (np.linalg.slogdet(precision)[1] + np.linalg.slogdet(covariance)[1])
    count = len(families)
    return VarianceComponents(
        np.exp(size[:count]),
        np.asarray(covariance[:count, :count], dtype=float),
        np.exp(size[count:]),
        float(now.value + occam - none),
        float(now.value + occam),
    )


@dataclass(frozen=True)
class _State:
    value: float
    slope: Array
    information: Array


def prior_covariance(kinds: Sequence[Any]) -> Array:
    """Return the prior covariance of the log scales, [family, family].

    Args:
        kinds: of each family; the two planes of one error are families of one kind.
    """
    alike = np.array([[one == other for other in kinds] for one in kinds])
    own = np.where(np.eye(len(kinds), dtype=bool), 1.0, PLANES * alike)
    return np.asarray(COMMON_SPREAD**2 + FAMILY_SPREAD**2 * own)


def _state(
    rows: Array, base: Array, parts: Sequence[Array], size: Array, precision: Array
) -> _State:
    """Log posterior of the scales, its slope, and the average information."""
    weights = np.exp(2 * size)
    covariance = base.copy()
    for weight, part in zip(weights, parts, strict=True):
        covariance += weight * part
    try:
        factor = lower_factor(covariance)
    except np.linalg.LinAlgError:
        return _State(-np.inf, np.zeros(len(size)), np.eye(len(size)))
    solved = cho_solve((factor, True), rows, check_finite=False)
    value = -np.log(np.diag(factor)).sum() - 0.5 * rows @ solved - 0.5 * size @ precision @ size
    moved = np.array([w * (part @ solved) for w, part in zip(weights, parts, strict=True)])
    back = cho_solve((factor, True), moved.T, check_finite=False)
    inverse = inverse_by_factor(factor)
    traces = np.array([w * np.vdot(inverse, part) for w, part in zip(weights, parts, strict=True)])
    slope = moved @ solved - traces - precision @ size
    information = 2 * moved @ back + precision
    return _State(float(value), slope, information)
