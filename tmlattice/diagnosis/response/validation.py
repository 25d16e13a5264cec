"""The validation of a hierarchical fit of an orbit response, on correctors that were not fitted.

For each of them the kick is estimated from half of the BPMs, and the prediction is scored on the
other half. The outer validation set (`score`) selects nothing. The inner one (`inner`) selects
families, with standard errors, because it may have only four correctors.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tmlattice.diagnosis.response.state import State, amplitudes, rms_of

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

JUDGES, VETO = np.array([1.0, 1.0, 0.25]), 0.01
"""Weights of the log rms of held-out correctors (in-plane, coupling, RF: one reading a BPM), and
the largest fall of their sum without an accepted step. The marginal likelihood alone would take
model discrepancy for noise, and fit it."""
CORRECTORS = np.array([1.0, 1.0, 0.0])
"""The same, of correctors alone: all BPMs share the jitter of the RF's orbit."""
FLOOR = np.array([0.1, 0.1, 1.0])
"""Share of the noise that is added to the residuals in-plane, across and of the RF, so that
residuals below it count alike."""
SURELY = 1.0
"""Standard errors of a fall from which on it counts."""


class Chi2(NamedTuple):
    """A sum of squares in units of the noise, with the number of readings."""

    total: float
    readings: int

    @property
    def per_reading(self) -> float:
        """Chi-square per reading; 1 is noise."""
        return self.total / max(self.readings, 1)


@dataclass(frozen=True)
class Score:
    """Validation scores: rms in m; see `Step`. Chi-squares are in-plane, across, of the RF."""

    in_plane: float
    coupling: float
    chi2_per_dof: float
    dispersion: float
    position: float
    roll: float
    chi2: tuple[Chi2, Chi2, Chi2]


class _Missed(NamedTuple):
    """Residuals of the far readings of held-out correctors, m, column by column.

    Attributes:
        inside: in-plane.
        outside: across.
        jumped: in-plane, with a position jump of the corrector's own.
        rolled: across, with a roll of the corrector's own, of those that have one.
        squares, cross: in-plane and across, in units of the noise, squared.
        spread: of `squares`: what the kick's own error adds, times.
        rf: of the RF's orbit.
        rf_squares: in units of the noise, squared.
        rf_monitors: which monitors those are, [monitor].
    """

    inside: list[Array]
    outside: list[Array]
    jumped: list[Array]
    rolled: list[Array]
    squares: list[Array]
    cross: list[Array]
    spread: list[Array]
    rf: Array
    rf_squares: Array
    rf_monitors: Flags


def _missed(state: State, validation: Flags, rf: Flags | None = None) -> _Missed:
    """Validation scores of held-out correctors; see `score`."""
    data, at, half = state.data, state.at, state.split.half
    read = at.seen(at.beam)
    straight, across = data.pick(read), data.pick(read, 1)
    orbits, orbits_across = data.pick(data.orbits), data.pick(data.orbits, 1)
    jumps = data.pick(at.seen(at.jumps))
    turned = state.allows("corrector_roll")
    rolls = data.pick(at.seen(at.across), 1) if turned else np.zeros_like(straight)
    variance, variance_across = (data.noise_of(block) ** 2 for block in (0, 1))
    inside, jumped, outside, rolled, squares, spread = [], [], [], [], [], []
    cross = []
    for c in np.flatnonzero(validation):
        seen = np.isfinite(orbits[c]) & state.good
        near, far = seen & half[c], seen & ~half[c]
        if not (near.any() and far.any()):
            continue
        # all alike: model discrepancy is not the readings' noise
        kick, miss = amplitudes(straight[c][:, None], orbits[c], near, far)
        inside.append(miss)
        squares.append(miss**2 / variance[c, far])
        # the kick's error adds to the reading's
        spread.append(1 + straight[c, far] ** 2 / np.sum(straight[c, near] ** 2))
        jumped.append(amplitudes(np.stack([straight[c], jumps[c]], 1), orbits[c], near, far)[1])
        left = orbits_across[c] - kick[0] * across[c]
        there = np.isfinite(left)
        outside.append(left[far & there])
        cross.append(outside[-1] ** 2 / variance_across[c, far & there])
        if rolls[c].any() and (near & there).any():
            rolled.append(amplitudes(rolls[c][:, None], left, near & there, far & there)[1])
    judge = state.good & np.isfinite(orbits[-1]) & (~half[-1] if rf is None else rf)
    of_rf = (orbits[-1] - straight[-1])[judge]
    return _Missed(inside, outside, jumped, rolled, squares, cross, spread, of_rf,
                   of_rf**2 / variance[-1, judge], judge)  # fmt: skip


def score(state: State, validation: Flags, rf: Flags | None = None) -> Score:
    """Return the validation scores; each corrector's kick is estimated from its near BPMs.

    Args:
        state: that is validated.
        judges: the correctors of the validation set, [column].
        rf: monitors that validate the RF's response; None: those that did not fit it.
    """
    missed = _missed(state, validation, rf)
    own, others = np.concatenate(missed.squares), np.concatenate([np.zeros(0), *missed.cross])
    return Score(
        in_plane=rms_of(missed.inside),
        coupling=rms_of(missed.outside),
        chi2_per_dof=float(np.mean(own)),
        dispersion=rms_of([missed.rf]),
        position=rms_of(missed.jumped),
        roll=rms_of(missed.rolled) if missed.rolled else float("nan"),
        chi2=(
            Chi2(float(np.sum(own / np.concatenate(missed.spread))), len(own)),
            Chi2(float(np.sum(others)), len(others)),
            Chi2(float(np.sum(missed.rf_squares)), len(missed.rf)),
        ),
    )


class Validated(NamedTuple):
    """Residuals of the inner validation set: sums of squares, m^2, and counts of readings.

    Attributes:
        columns: of each corrector, in-plane and across, [column, 2, (sum, count)].
        rf: of each monitor, of the RF's orbit, [monitor, (sum, count)].
    """

    columns: Array
    rf: Array

    @property
    def logs(self) -> Array:
        """Log rms, in-plane, across and of the RF; NaN without readings."""
        return _logs(np.concatenate([self.columns.sum(axis=0), self.rf.sum(axis=0)[None]]))


def _logs(sums: Array) -> Array:
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(0.5 * np.log(sums[..., 0] / sums[..., 1]))


def inner(state: State) -> Validated:
    """In-plane, coupling and dispersion residuals of the inner correctors; each half of their BPMs
    determines the kick once."""
    other = replace(state, split=replace(state.split, half=~state.split.half))
    said = [_missed(one, state.split.inner, state.split.inner_rf) for one in (state, other)]
    sums = [
        np.array([[[np.sum(own**2), len(own)] for own in pair]
                  for pair in zip(one.inside, one.outside, strict=True)])
        for one in said
    ]  # fmt: skip
    rf = np.zeros((len(state.good), 2))
    rf[said[0].rf_monitors] = np.stack([said[0].rf ** 2, np.ones(len(said[0].rf))], axis=1)
    floor = (FLOOR * float(np.median(state.data.noise))) ** 2
    columns = sums[0] + sums[1]
    columns[..., 0] += floor[:2] * columns[..., 1]
    rf[:, 0] += floor[2] * rf[:, 1]
    return Validated(columns, rf)


def lost(without: Validated, within: Validated, counts: Array = JUDGES) -> tuple[float, float]:
    """The rise of the validation score, and its standard error by the jackknife over correctors and
    BPMs of the RF's orbit. Entries without readings are omitted.

    Args:
        without, within: the two residuals.
        counts: weights of in-plane, across and RF readings.
    """
    whole = float(np.nansum(counts * (without.logs - within.logs)))
    variance = 0.0
    for now, then, weights in (
        (within.columns, without.columns, counts[:2]),
        (within.rf[:, None], without.rf[:, None], counts[2:]),
    ):
        judged = now[:, 0, 1] > 0
        if judged.sum() > 1:
            one_less = [_logs(own.sum(axis=0) - own[judged]) for own in (then, now)]
            said = np.nansum(weights * (one_less[0] - one_less[1]), axis=1)
            variance += (len(said) - 1) * float(np.var(said))
    return whole, float(np.sqrt(variance))


def against(said: tuple[float, float]) -> bool:
    """Whether the validation score is better without, by the result of `lost`."""
    return said[0] < -max(VETO, SURELY * said[1])
