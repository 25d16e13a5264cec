"""Reduction of the gap between model and measurement on held-out readings.

explained = 1 - (r_after^2 - v) / (r_before^2 - v), where v is the variance of the residuals by the
readings' noise, refitted nuisances included. Its interval is that of the same noise.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag

from tmlattice.arrays import TINY, Array
from tmlattice.inference import chi2
from tmlattice.inference.judgement import SIGNIFICANT


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
    """Residuals of held-out readings, some of them correlated.

    Attributes:
        residual: readings less model, [reading], m.
        noise: their covariance by the readings' noise, [reading, reading], m^2.
        covariance: the same with the model's uncertainty; None: no uncertainty.
    """

    residual: Array
    noise: Array
    covariance: Array | None = None


@dataclass(frozen=True)
class Half:
    """Readings of one half of the monitors.

    Attributes:
        left: readings less model, [reading], m.
        slopes: d reading / d nuisance, [reading, nuisance].
        sigma: noise, [reading], m.
    """

    left: Array
    slopes: Array
    sigma: Array


def cross_predicted(
    fitted: Half, scored: Half, offset: Array, known: Array, unknown: Array | None = None
) -> Residuals:
    """Residuals of one half of the monitors with nuisances fitted to the other half.

    Args:
        fitted, scored: the halves.
        offset: prior mean of the nuisances less the model's values, [nuisance].
        known: prior precision of the nuisances, [nuisance]; 0: none.
        unknown: covariance of the readings by the model's uncertainty, the fitted half first,
            [reading, reading], m^2; None: none.
    """
    # weighted by the noise alone: nuisances also absorb model errors near these readings
    weighed = fitted.slopes / fitted.sigma[:, None] ** 2
    information = fitted.slopes.T @ weighed + np.diag(known)
    size = np.sqrt(np.maximum(np.diagonal(information), TINY))
    inverse = np.linalg.pinv(information / size[:, None] / size) / size[:, None] / size
    gain = inverse @ weighed.T  # nuisance per reading
    moved = gain @ fitted.left + inverse @ (known * offset)
    errors = (gain * fitted.sigma**2) @ gain.T + (inverse * known) @ inverse
    noise = np.diag(scored.sigma**2) + scored.slopes @ errors @ scored.slopes.T
    whole = None
    if unknown is not None:
        takes = np.hstack([-scored.slopes @ gain, np.eye(len(scored.left))])
        whole = noise + takes @ unknown @ takes.T
    return Residuals(scored.left - scored.slopes @ moved, noise, whole)


@dataclass(frozen=True)
class HeldOut:
    """All held-out readings of one model.

    Attributes:
        residuals: readings less model, NaN where not scored, [shot, reading, 2], m.
        parts: scored residuals in uncorrelated groups; empty where the model has no solution.
    """

    residuals: Array
    parts: tuple[Residuals, ...]


CLOSED = 0.1
"""Share of the gap that causes at least close. Faults that are fitted where the settings of the
shots are missing close 0.03 of it, or widen it."""


@dataclass(frozen=True)
class Gap:
    """Gap between models and held-out readings.

    Attributes:
        misfits: of each model, in the order of the arguments.
        residuals: readings less model, NaN where not scored, [model, shot, reading, 2], m.
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


def held_out_gap(models: Sequence[HeldOut], baseline: int = 0) -> Gap:
    """Return the gap of a series of models on held-out readings.

    Args:
        models: the first is the design.
        baseline: index of the model with which the last one is compared.
    """
    misfits = tuple(_misfit(model.parts) for model in models)
    explained, interval = None, None
    if baseline < len(models) - 1 and models[baseline].parts and models[-1].parts:
        explained, interval = _explained(models[baseline].parts, models[-1].parts)
    residuals = np.array([model.residuals for model in models])
    readings, last = (int(np.isfinite(residuals[i]).sum()) for i in (baseline, -1))
    return Gap(misfits, residuals, explained, interval, baseline, readings, readings != last)


def _misfit(parts: Sequence[Residuals]) -> Misfit:
    count = sum(len(part.residual) for part in parts)
    if not count:
        return Misfit(np.nan, np.nan)
    square = weighed = expected = 0.0
    for part in parts:
        covariance = part.noise if part.covariance is None else part.covariance
        square += float(part.residual @ part.residual)
        weighed += float(part.residual @ np.linalg.solve(covariance, part.residual))
        expected += float(np.trace(covariance))
    return Misfit(float(np.sqrt(square / count)), weighed / count, float(np.sqrt(expected / count)))


def _explained(
    before: Sequence[Residuals], after: Sequence[Residuals]
) -> tuple[float | None, tuple[float, float] | None]:
    """Explained share of the gap and its interval; the noise of both models is the same."""
    # two models may group the same readings differently
    one, other = (np.concatenate([part.residual for part in parts]) for parts in (before, after))
    if len(one) != len(other):
        return None, None  # the beam is lost in one of them
    V_one, V = (block_diag(*(part.noise for part in parts)) for parts in (before, after))
    twice = float(np.vdot(V, V))
    moved_one, moved_other = V @ one, V @ other
    bottom = float(one @ one - np.trace(V_one))
    top = float(other @ other - np.trace(V))
    # variances of the noise-free squares; the noise's own part is subtracted
    spread_bottom = 2 * twice + 4 * max(float(one @ moved_one) - twice, 0.0)
    spread_top = 2 * twice + 4 * max(float(other @ moved_other) - twice, 0.0)
    shared = 2 * twice + 4 * (float(one @ moved_other) - twice)
    if bottom < SIGNIFICANT * np.sqrt(spread_bottom):
        return None, None
    left = max(top, 0.0) / bottom
    variance = (spread_top + left**2 * spread_bottom - 2 * left * shared) / bottom**2
    width = 1.96 * float(np.sqrt(max(variance, 0.0)))
    explained = 1 - left
    return float(explained), (float(explained - width), float(min(explained + width, 1.0)))
