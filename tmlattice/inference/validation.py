"""Reduction of the gap between model and measurement on held-out readings.

explained = 1 - (r_after^2 - v) / (r_before^2 - v), where r are residuals in units of the noise, and
v is their variance by it, refitted nuisances included. Its interval is that of the same noise.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tmlattice.arrays import Array
from tmlattice.errors import UnstableRingError
from tmlattice.inference import chi2
from tmlattice.inference.judgement import SIGNIFICANT
from tmlattice.inference.newton import fit_nuisances
from tmlattice.inference.problem import Problem
from tmlattice.inference.whitening import ROUNDING


@dataclass(frozen=True)
class Misfit:
    """Size of a model's residuals.

    Attributes:
        rms: m.
        chi2_per_dof: per reading, in the covariance that the model expects.
        expected: expected rms, m, of noise, refitted nuisances and model uncertainty; None: not
            computed.
    """

    rms: float
    chi2_per_dof: float
    expected: float | None = None


@dataclass(frozen=True)
class Residuals:
    """Residuals of held-out readings, some of them correlated, in units of their noise.

    Attributes:
        residual: readings less model, [reading].
        noise: of the readings, m, [reading].
        spread: root of their covariance by the refitted nuisances, [reading, nuisance].
        unknown: their covariance by the model's uncertainty, [reading, reading]; None: none.
    """

    residual: Array
    noise: Array
    spread: Array
    unknown: Array | None = None


@dataclass(frozen=True)
class Half:
    """Rows of one half of the monitors, in units of their noise.

    Attributes:
        left: readings less model, [row].
        slopes: d row / d nuisance, [row, nuisance].
        model: d row / d error of the model, of size 1, [error, row]; or without any.
    """

    left: Array
    slopes: Array
    model: Array


def cross_predicted(fitted: Half, scored: Half, noise: Array, known: int = 0) -> Residuals:
    """Residuals of one half of the monitors with nuisances fitted to the other half.

    Args:
        fitted: one half, with what is known of the nuisances before.
        scored: the other half.
        noise: of its readings, m, [row].
        known: the last errors of the model, so many of them, do not add to its covariance but were
            removed from it, by the readings of the fit.
    """
    # weighted by the noise alone: nuisances also absorb model errors near these readings
    size = np.linalg.norm(fitted.slopes, axis=0)
    size = np.where(size > 0, size, 1.0)
    into, values, vectors = np.linalg.svd(fitted.slopes / size, full_matrices=False)
    kept = values > ROUNDING * max(fitted.slopes.shape)
    into = into[:, kept]
    spread = scored.slopes @ (vectors[kept].T / values[kept] / size[:, None])

    def beyond(own: Array, others: Array) -> Array:
        """Rows of the scored half without the nuisances of the fitted half."""
        return np.asarray(own - (others @ into) @ spread.T)

    unknown = None
    if len(scored.model):
        rows = beyond(scored.model, fitted.model)
        there, removed = rows[: len(rows) - known], rows[len(rows) - known :]
        unknown = there.T @ there - removed.T @ removed
    return Residuals(beyond(scored.left, fitted.left), noise, spread, unknown)


def predicted(
    problem: Problem, errors: Array | None = None, known: int = 0
) -> tuple[tuple[Residuals, ...], Array]:
    """Residuals of a validation set. Its own nuisances are fitted to half of the BPMs, and the
    readings of the others are predicted; all readings, if it has none.

    Args:
        problem: of these readings; its `fixed` causes are the model's.
        errors: d reading / d error of the model, of size 1, m, [error, *shape of `valid`]; None: no
            uncertainty.
        known: see `cross_predicted`.

    Returns:
        The residuals, none where the model has no solution; and readings less model, NaN where not
            scored, m, of the shape of `valid`.
    """
    owner = problem.owner()  # -1: tunes, and what is known before
    residuals = np.full(problem.valid.shape, np.nan)
    reading = np.unique(owner[problem.valid & (owner >= 0)])
    # the Thue-Morse sequence: out of step with cells, and with BPMs of one plane that alternate
    odd = np.isin(owner, reading[[i.bit_count() % 2 == 1 for i in range(len(reading))]])
    scored = problem.valid & (odd if problem.free else owner >= 0)
    other = problem.without(odd)
    try:
        fitted = fit_nuisances(other, (), other.first)
        point = problem.at((), fitted.nuisances)
    except UnstableRingError:
        return (), residuals
    if fitted.projection is None or point.projection is None or not scored.any():
        return (), residuals
    unit = problem.as_rows(scored.astype(float))
    own = unit > 0
    model = np.zeros((0, *problem.valid.shape)) if errors is None else errors
    before, behind = other.as_rows(model), problem.as_rows(model)
    found = []
    for (there, slopes), (here, others) in zip(
        fitted.projection.blocks(errors is not None), point.projection.blocks(errors is not None),
        strict=True,
    ):  # fmt: skip
        mine = own[here]
        if mine.any():
            found.append(cross_predicted(
                Half(fitted.residual[there], slopes, before[:, there]),
                Half(point.residual[here][mine], others[mine], behind[:, here][:, mine]),
                1 / unit[here][mine], known,
            ))  # fmt: skip
    residuals[scored] = np.concatenate([one.residual * one.noise for one in found])
    return tuple(found), residuals


CLOSED = 0.1
"""Share of the gap that causes at least close. Faults that are fitted where the settings of the
shots are missing close 0.03 of it, or widen it."""


@dataclass(frozen=True)
class Gap:
    """Gap between models and held-out readings.

    Attributes:
        misfits: of each model, in the order of the arguments.
        residuals: readings less model, NaN where not scored, m, [model, *shape of the readings];
            of several measurements flat.
        explained: share of the gap of model `baseline` that the last model explains; None if that
            is the last one itself, or its gap is within the noise.
        interval: of `explained`, 95 %.
        baseline: index of the model with which the last one is compared.
        readings: number of scored readings.
        lost: whether the two models lose the beam at different readings: they cannot be compared.
    """

    misfits: tuple[Misfit, ...]
    residuals: Array
    explained: float | None
    interval: tuple[float, float] | None
    baseline: int = 0
    readings: int = 0
    lost: bool = False

    def significant(self, false_alarm: float) -> bool:
        """Whether the gap of model `baseline` is larger than expected.

        Args:
            false_alarm: largest p-value of a significant gap.
        """
        square = self.readings * self.misfits[self.baseline].chi2_per_dof
        return bool(chi2.sf(square, self.readings) < false_alarm)

    @property
    def refutes(self) -> bool:
        """Whether the last model leaves the gap of model `baseline` as it is."""
        return self.interval is not None and self.interval[1] < CLOSED


def held_out_gap(
    models: Sequence[Sequence[Residuals]], baseline: int = 0, residuals: Array | None = None
) -> Gap:
    """Return the gap of a series of models on held-out readings.

    Args:
        models: uncorrelated groups of residuals of each, none where it has no solution; the first
            is the design.
        baseline: index of the model with which the last one is compared.
        residuals: see `Gap`.
    """
    explained, interval = None, None
    if baseline < len(models) - 1 and models[baseline] and models[-1]:
        explained, interval = _explained(models[baseline], models[-1])
    readings, last = (sum(len(own.residual) for own in models[i]) for i in (baseline, -1))
    residuals = np.zeros((len(models), 0)) if residuals is None else residuals
    misfits = tuple(map(_misfit, models))
    return Gap(misfits, residuals, explained, interval, baseline, readings, readings != last)


def _misfit(parts: Sequence[Residuals]) -> Misfit:
    count = sum(len(part.residual) for part in parts)
    if not count:
        return Misfit(np.nan, np.nan)
    square = weighed = expected = 0.0
    for part in parts:
        square += float(np.sum((part.residual * part.noise) ** 2))
        variance = 1 + np.sum(part.spread**2, axis=1)
        if part.unknown is None:  # by Woodbury
            inside = np.eye(part.spread.shape[1]) + part.spread.T @ part.spread
            along = part.residual @ part.spread
            weighed += float(part.residual @ part.residual - along @ np.linalg.solve(inside, along))
        else:
            covariance = np.eye(len(variance)) + part.spread @ part.spread.T + part.unknown
            weighed += float(part.residual @ np.linalg.solve(covariance, part.residual))
            variance = np.diag(covariance)
        expected += float(variance @ part.noise**2)
    return Misfit(float(np.sqrt(square / count)), weighed / count, float(np.sqrt(expected / count)))


def _explained(
    before: Sequence[Residuals], after: Sequence[Residuals]
) -> tuple[float | None, tuple[float, float] | None]:
    """Explained share of the gap and its interval; the noise of both models is the same."""
    # two models may group the same readings differently
    one, other = (np.concatenate([part.residual for part in parts]) for parts in (before, after))
    if len(one) != len(other):
        return None, None  # the beam is lost in one of them
    trace_one, trace = (
        len(one) + sum(float(np.sum(part.spread**2)) for part in parts) for parts in (before, after)
    )
    inside = [part.spread.T @ part.spread for part in after]
    twice = len(one) + sum(float(2 * np.trace(own) + np.sum(own**2)) for own in inside)
    ends = np.cumsum([len(part.residual) for part in after])[:-1]

    def product(x: Array, y: Array) -> float:
        """In the covariance of the noise."""
        along = (
            (a @ part.spread) @ (b @ part.spread)
            for a, b, part in zip(np.split(x, ends), np.split(y, ends), after, strict=True)
        )
        return float(x @ y + sum(along))

    bottom = float(one @ one) - trace_one
    top = float(other @ other) - trace
    # variances of the noise-free squares; the noise's own part is subtracted
    spread_bottom = 2 * twice + 4 * max(product(one, one) - twice, 0.0)
    spread_top = 2 * twice + 4 * max(product(other, other) - twice, 0.0)
    shared = 2 * twice + 4 * (product(one, other) - twice)
    if bottom < SIGNIFICANT * np.sqrt(spread_bottom):
        return None, None
    left = max(top, 0.0) / bottom
    variance = (spread_top + left**2 * spread_bottom - 2 * left * shared) / bottom**2
    width = 1.96 * float(np.sqrt(max(variance, 0.0)))
    explained = 1 - left
    return float(explained), (float(explained - width), float(min(explained + width, 1.0)))
