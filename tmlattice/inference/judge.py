"""How far the gap between model and measurement shrinks, judged on readings that no fit saw.

closed = 1 - (r_after^2 - v) / (r_before^2 - v), where v is the variance that the noise of readings
makes of what is left, refitted nuisances included. Its interval says what the noise of these
readings leaves open of it.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from tmlattice.inference import chi2

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Misfit:
    """What a model leaves.

    Attributes:
        rms: m.
        chi2_per_dof: per reading, in the covariance that the model expects.
        expected: the rms that the model expects, m: of noise, of refitted nuisances, and of what is
            not known of the model; None where nobody asked.
    """

    rms: float
    chi2_per_dof: float
    expected: float | None = None


@dataclass(frozen=True)
class Left:
    """What a model leaves of readings that no fit saw, some of them correlated.

    Attributes:
        residual: readings less model, [reading], m.
        noise: covariance that the noise of readings makes of that, [reading, reading], m^2.
        covariance: the same with what is not known of the model; None: nothing more.
    """

    residual: Array
    noise: Array
    covariance: Array | None = None


@dataclass(frozen=True)
class Half:
    """Readings of one half of the monitors.

    Attributes:
        left: less the model, [reading], m.
        slopes: d reading / d nuisance, [reading, nuisance].
        sigma: noise, [reading], m.
    """

    left: Array
    slopes: Array
    sigma: Array


def other_half(
    gives: Half, scored: Half, off: Array, known: Array, unknown: Array | None = None
) -> Left:
    """What a model leaves of one half where the other one gives the nuisances.

    Args:
        gives, scored: the halves.
        off: nuisances as known beforehand less those that the model stands at, [nuisance].
        known: precision of that, [nuisance]; 0 where nothing is known.
        unknown: covariance of what is not known of the model, readings of both halves, those that
            give first, [reading, reading], m^2; None: nothing.
    """
    # by the noise alone: nuisances so fitted take up what else is wrong near these readings
    weighed = gives.slopes / gives.sigma[:, None] ** 2
    information = gives.slopes.T @ weighed + np.diag(known)
    size = np.sqrt(np.maximum(np.diagonal(information), 1e-300))
    inverse = np.linalg.pinv(information / size[:, None] / size) / size[:, None] / size
    gain = inverse @ weighed.T  # nuisance per reading
    moved = gain @ gives.left + inverse @ (known * off)
    errors = (gain * gives.sigma**2) @ gain.T + (inverse * known) @ inverse
    noise = np.diag(scored.sigma**2) + scored.slopes @ errors @ scored.slopes.T
    whole = None
    if unknown is not None:
        takes = np.hstack([-scored.slopes @ gain, np.eye(len(scored.left))])
        whole = noise + takes @ unknown @ takes.T
    return Left(scored.left - scored.slopes @ moved, noise, whole)


@dataclass(frozen=True)
class Judged:
    """All held-out readings of one model.

    Attributes:
        residuals: readings less model, NaN where not scored, [shot, reading, 2], m.
        parts: those that are scored, in groups without correlation with one another; empty where
            the model has no answer.
    """

    residuals: Array
    parts: tuple[Left, ...]


@dataclass(frozen=True)
class Gap:
    """The gap on held-out shots, model after model.

    Attributes:
        misfits: of each model, in the order asked for.
        residuals: readings less model, NaN where not scored, [model, shot, reading, 2], m.
        closed: share of the gap of model `since` that the last one closes; None where that is the
            last one itself, or has no gap beyond the noise.
        interval: of `closed`, 95 %.
        since: index of the model with which the last one is compared.
        readings: how many are scored.
        lost: whether one of the two models loses readings that the other one has: nobody judges it.
    """

    misfits: tuple[Misfit, ...]
    residuals: Array
    explained: float | None
    interval: tuple[float, float] | None
    since: int = 0
    readings: int = 0
    lost: bool = False

    def significant(self, false_alarm: float) -> bool:
        """Whether model `since` leaves more of these readings than it expects.

        Args:
            false_alarm: probability of such a remainder by chance, below which it is significant.
        """
        square = self.readings * self.misfits[self.since].chi2_per_dof
        return bool(chi2.sf(square, self.readings) < false_alarm)


def held_out_gap(judged: Sequence[Judged], since: int = 0) -> Gap:
    """The gap of a series of models on readings that no fit saw.

    Args:
        judged: by model, the first the design's.
        since: the model whose gap is explained by the last one.
    """
    misfits = tuple(_misfit(model.parts) for model in judged)
    explained, interval = None, None
    if since < len(judged) - 1 and judged[since].parts and judged[-1].parts:
        explained, interval = _closed(judged[since].parts, judged[-1].parts)
    residuals = np.array([model.residuals for model in judged])
    readings, last = (int(np.isfinite(residuals[i]).sum()) for i in (since, -1))
    return Gap(misfits, residuals, explained, interval, since, readings, readings != last)


def _misfit(parts: Sequence[Left]) -> Misfit:
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


def _closed(
    before: Sequence[Left], after: Sequence[Left]
) -> tuple[float | None, tuple[float, float] | None]:
    """The noise is the same in both, so that much of it goes out of their ratio."""
    one, other = _together(before), _together(after)
    if len(one.residual) != len(other.residual):
        return None, None  # the beam is lost in one of them
    V = other.noise
    twice = float(np.vdot(V, V))
    moved_one, moved_other = V @ one.residual, V @ other.residual
    bottom = float(one.residual @ one.residual - np.trace(one.noise))
    top = float(other.residual @ other.residual - np.trace(V))
    # of what is left without noise, the noise being taken out of its estimate
    spread_bottom = 2 * twice + 4 * max(float(one.residual @ moved_one) - twice, 0.0)
    spread_top = 2 * twice + 4 * max(float(other.residual @ moved_other) - twice, 0.0)
    shared = 2 * twice + 4 * (float(one.residual @ moved_other) - twice)
    if bottom < 5 * np.sqrt(spread_bottom):
        return None, None
    left = max(top, 0.0) / bottom
    variance = (spread_top + left**2 * spread_bottom - 2 * left * shared) / bottom**2
    width = 1.96 * float(np.sqrt(max(variance, 0.0)))
    explained = 1 - left
    return float(explained), (float(explained - width), float(min(explained + width, 1.0)))


def _together(parts: Sequence[Left]) -> Left:
    """All parts as one: two models may group the same readings differently."""
    residual = np.concatenate([part.residual for part in parts])
    return Left(residual, block_diag(*(part.noise for part in parts)))
