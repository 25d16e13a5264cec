"""The validation of a hierarchical fit of an orbit response, and the size of its residual.

For each held-out corrector the kick is estimated from half of the BPMs, and the prediction is
scored on the other half. The outer validation set (`score`) selects nothing. The inner one
(`inner`) selects families, with standard errors, because it may have only four correctors.

In the `remainder` fitted readings are compared with their noise; fitted numbers reduce the degrees
of freedom. Held-out readings are compared with the posterior predictive covariance (Gelman et al.,
Bayesian Data Analysis, ch. 6): the noise, and what the fit leaves undetermined of the ring, of the
BPMs and of the held-out corrector's calibration and roll. The kick of a held-out corrector is
free.

>>> [(block.name, block.ratio) for block in remainder(state)]
"""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from scipy.linalg import solve_triangular

from tmlattice.arrays import Array, Flags, Indices
from tmlattice.diagnosis.assessment import Block
from tmlattice.diagnosis.records import HIDDEN
from tmlattice.diagnosis.response.linear import Linear, linear
from tmlattice.diagnosis.response.state import State, amplitudes, rms_of
from tmlattice.diagnosis.response.stated import of_sizes
from tmlattice.effects import with_labels
from tmlattice.inference.normal import Posterior

JUDGES, VETO = np.array([1.0, 1.0, 0.25]), 0.01
"""Weights of log rms in the validation score: in-plane, coupling, RF (one reading per BPM); and the
fall of the score that rejects a family against the evidence, which may fit model discrepancy."""
FEWEST = 3
"""Fewest correctors of a validation: a single one may agree by chance."""
FLOOR = np.array([0.1, 0.1, 1.0])
"""Share of the noise that is added to each rms in quadrature, in-plane, coupling and RF: for
readings without noise (simulated ones) a smaller residual is no improvement."""
WORTH = 0.05
"""Least fall of the score that rejects jitter."""


@dataclass(frozen=True)
class Step:
    """The scores of a fit.

    Attributes:
        effect: what is fitted; "design": the model alone.
        parameters: their number.
        heldout_rms_in_plane, heldout_rms_coupling: of held-out correctors, m.
        heldout_rms_position: in-plane, with a position jump of each held-out corrector, m.
        heldout_rms_roll: coupling, with a roll of each held-out corrector, by the BPMs that
            determine its kick, m; NaN before rolls are fitted.
        heldout_chi2_per_dof: in-plane, by the readings' noise.
        dispersion_rms: residual of the RF's orbit in x at BPMs that are not fitted, m.
        kept: whether a family is in the result.
        log_evidence: for a family, when it was tested; NaN for a step and for an implausible
            family.
        compared: held-out readings in-plane, coupling and RF, by their noise.
    """

    effect: str
    parameters: int
    heldout_rms_in_plane: float = float("nan")
    heldout_rms_coupling: float = float("nan")
    heldout_chi2_per_dof: float = float("nan")
    dispersion_rms: float = float("nan")
    heldout_rms_position: float = float("nan")
    heldout_rms_roll: float = float("nan")
    kept: bool = True
    log_evidence: float = float("nan")
    compared: tuple[Block, ...] = field(default=(), metadata=HIDDEN)

    @property
    def reversed_decision(self) -> str:
        """The decision on a family, reversed, in words."""
        return f"{'without' if self.kept else 'with'} {with_labels(self.effect)}"


class _Missed(NamedTuple):
    """Residuals of held-out correctors, m, [column, monitor], NaN except at BPMs that validate.

    Attributes:
        inside, outside: in-plane, coupling.
        jumped: in-plane, with a position jump of the corrector.
        rolled: coupling, with a roll of the corrector, if it has one.
        squares, cross: squares in-plane and coupling, in units of the noise.
        spread: factor on the variance of `squares` by the error of the kick.
        rf: of the RF's orbit, [monitor].
        rf_squares: squares of these, in units of the noise.
    """

    inside: Array
    outside: Array
    jumped: Array
    rolled: Array
    squares: Array
    cross: Array
    spread: Array
    rf: Array
    rf_squares: Array


def _missed(
    state: State, validation: Flags, rf: Flags | None = None, jitter: Array | None = None
) -> _Missed:
    """Residuals of held-out correctors; see `score`.

    Args:
        state, validation: as there.
        rf: BPMs that validate the RF's response, [monitor]; None: those that are not fitted.
        jitter: orbits of beam jitter, see `State`, whose amplitudes the near BPMs determine, too.
    """
    data, at, half = state.data, state.at, state.split.half
    orbits = data.pick(data.orbits)
    seen = np.isfinite(orbits) & state.good
    columns = np.flatnonzero(validation & (seen & half).any(axis=1) & (seen & ~half).any(axis=1))
    near, far = seen[columns] & half[columns], seen[columns] & ~half[columns]

    def picked(readings: Array, block: int = 0) -> Array:
        return data.pick(readings, block)[columns]

    read = at.seen(at.beam)
    straight = picked(read)
    moving = np.zeros((2, 0, data.shape[1])) if jitter is None else jitter
    moving, typical = moving.swapaxes(1, 2), np.median(data.noise, axis=0)
    held = np.broadcast_to(typical[:, None], (2, moving.shape[2]))
    # equal weights: model discrepancy does not scale with the noise
    plane = data.plane[columns]
    patterns = np.concatenate([straight[..., None], moving[plane]], axis=2)
    (kick, *_), left = amplitudes(
        patterns, picked(data.orbits), near, np.pad(held[plane], ((0, 0), (1, 0)))
    )
    inside = np.where(far, left, np.nan)
    # the error of the kick adds to that of the reading
    spread = 1 + straight**2 / np.sum(straight**2, axis=1, where=near, keepdims=True)
    both = np.stack([straight, picked(at.seen(at.jumps))], axis=2)
    jumped = np.where(far, amplitudes(both, picked(data.orbits), near)[1], np.nan)
    left = picked(data.orbits, 1) - kick[:, None] * picked(read, 1)
    near, far = near & np.isfinite(left), far & np.isfinite(left)
    left = amplitudes(moving[1 - plane], left, near, held[1 - plane])[1]
    outside = np.where(far, left, np.nan)
    rolled = np.full_like(outside, np.nan)
    if state.allows("corrector_roll"):
        rolls = picked(at.seen(at.across), 1)
        known = far & np.any(near & (rolls != 0), axis=1, keepdims=True)
        rolled = np.where(known, amplitudes(rolls[..., None], left, near)[1], np.nan)
    left = orbits[-1] - data.pick(read)[-1]
    scored = state.good & np.isfinite(left) & (~half[-1] if rf is None else rf)
    near = state.good & np.isfinite(left) & half[-1] & ~scored
    left = amplitudes(moving[0], left, near, held[0])[1]
    of_rf = np.where(scored, left, np.nan)
    variance = [data.noise_of(block) ** 2 for block in (0, 1)]
    return _Missed(
        inside, outside, jumped, rolled, inside**2 / variance[0][columns],
        outside**2 / variance[1][columns], spread, of_rf, of_rf**2 / variance[0][-1],
    )  # fmt: skip


def score(state: State, effect: str, parameters: int = 0) -> Step:
    """Return the validation scores; each corrector's kick is estimated from its near BPMs.

    Args:
        state: to validate on its held-out correctors.
        effect, parameters: of the step.
    """
    missed = _missed(state, state.split.held)
    squares = {"in-plane": missed.squares / missed.spread, "coupling": missed.cross,
               "RF": missed.rf_squares}  # fmt: skip
    return Step(
        effect,
        parameters,
        heldout_rms_in_plane=rms_of(missed.inside),
        heldout_rms_coupling=rms_of(missed.outside),
        heldout_chi2_per_dof=float(np.nanmean(missed.squares)),
        dispersion_rms=rms_of(missed.rf),
        heldout_rms_position=rms_of(missed.jumped),
        heldout_rms_roll=rms_of(missed.rolled),
        compared=tuple(
            Block(name, float(np.nansum(own)), int(np.isfinite(own).sum()))
            for name, own in squares.items()
        ),
    )


class Validated(NamedTuple):
    """Residuals of the inner validation set: sums of squares, m^2, and numbers of readings.

    Attributes:
        columns: of each corrector, in-plane and coupling, [column, 2, (sum, count)].
        rf: of each BPM, of the RF's orbit, [monitor, (sum, count)].
    """

    columns: Array
    rf: Array

    @property
    def logs(self) -> Array:
        """Log rms in-plane, coupling and RF; NaN without readings."""
        return _logs(np.concatenate([self.columns.sum(axis=0), self.rf.sum(axis=0)[None]]))


def _logs(sums: Array) -> Array:
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(0.5 * np.log(sums[..., 0] / sums[..., 1]))


def inner(state: State, by_others: Array | None = None) -> Validated:
    """Return the residuals of the inner validation set: in-plane, coupling and dispersion.

    Each half of the BPMs determines the kicks once, and the amplitudes of the state's beam jitter.
    Otherwise the jitter of the held-out steps would hide improvements.

    Args:
        state: to validate.
        by_others: leave-one-out residuals of the RF's fitted BPMs, see `rf_by_others`, m,
            [monitor]; they count in the validation, too.
    """
    other = replace(state, split=replace(state.split, half=~state.split.half))
    missed = [
        _missed(one, state.split.inner, state.split.inner_rf, state.jitter)
        for one in (state, other)
    ]
    left = np.stack([[one.inside, one.outside] for one in missed])
    columns = np.stack([np.nansum(left**2, axis=(0, 3)), np.isfinite(left).sum(axis=(0, 3))]).T
    of_rf = missed[0].rf
    if by_others is not None:
        of_rf = np.where(np.isfinite(of_rf), of_rf, by_others)
    rf = np.stack([np.nan_to_num(of_rf) ** 2, np.isfinite(of_rf)], axis=1)
    floor = (FLOOR * float(np.median(state.data.noise))) ** 2
    columns[..., 0] += floor[:2] * columns[..., 1]
    rf[:, 0] += floor[2] * rf[:, 1]
    return Validated(columns, rf)


def lost(without: Validated, within: Validated) -> tuple[float, float]:
    """Return the rise of the validation score (weighted log rms; lower is better) without a family,
    and its standard error by the jackknife over correctors and over BPMs of the RF's orbit. It is
    infinite for fewer than `FEWEST` correctors."""
    whole = float(np.nansum(JUDGES * (without.logs - within.logs)))
    variance = 0.0
    for now, then, weights in (
        (within.columns, without.columns, JUDGES[:2]),
        (within.rf[:, None], without.rf[:, None], JUDGES[2:]),
    ):
        counted = now[:, 0, 1] > 0
        if counted.sum() > 1:
            one_less = [_logs(own.sum(axis=0) - own[counted]) for own in (then, now)]
            changes = np.nansum(weights * (one_less[0] - one_less[1]), axis=1)
            variance += (len(changes) - 1) * float(np.var(changes))
    enough = np.count_nonzero(within.columns[:, 0, 1]) >= FEWEST
    return whole, float(np.sqrt(variance)) if enough else np.inf


def against(change: tuple[float, float], least: float = VETO) -> bool:
    """Return whether validation is better without, by `lost`: by a standard error and `least`."""
    return change[0] < -max(least, change[1])


BLOCKS = ("in-plane", "coupling", "RF")


def remainder(state: State) -> tuple[Block, ...]:
    """Return chi-square of fitted and held-out readings of a converged state, with its learnt
    priors: in-plane, coupling, and the RF's orbit; without those that have no reading."""
    return tuple(block for block in _blocks(state) if block.freedom >= 1)


class _Fit(NamedTuple):
    """The fit of a block, and a root of the covariance by unknown prior scales."""

    there: Linear
    found: Posterior
    sizes: Array


def _blocks(state: State) -> Iterator[Block]:
    held, rf = state.split.held[:-1], state.split.held.size - 1
    for block in (0, 1):
        fit, numbers = None, 0.0
        if state.of_block(block):
            there = linear(state, block)
            fit = _Fit(there, there.posterior, of_sizes(state, block, there))
            # effective number of parameters: 1 for each by the data, 0 for each by its prior
            numbers = float(len(fit.found.prior) - np.trace(fit.found.covariance))
        chi2, readings = _chi2(state, block, np.flatnonzero(~held), state.good)
        yield Block(f"fitted, {BLOCKS[block]}", chi2, readings - numbers)
        columns = np.flatnonzero(held)
        own = _chi2(state, block, columns, state.good, fit, free=True)
        yield Block(f"held-out, {BLOCKS[block]}", *own)
        if block == 0:
            half = state.split.half[-1]
            for which, monitors, by in (("fitted", half, None), ("held-out", ~half, fit)):
                own = _chi2(state, block, np.array([rf]), state.good & monitors, by)
                yield Block(f"{which}, {BLOCKS[2]}", *own)


def _chi2(
    state: State,
    block: int,
    columns: Indices,
    monitors: Flags,
    fit: _Fit | None = None,
    free: bool = False,
) -> tuple[float, int]:
    """Chi-square of the readings of some columns at some BPMs, and their number, in the covariance
    of their noise, of the fit's posterior and of undetermined errors (by Woodbury's identity); with
    kicks free or fixed."""
    data, square, count = state.data, 0.0, 0
    left, kicks = data.pick(state.at.left, block), data.pick(state.at.seen(state.at.beam), block)
    # outliers count in the fit, and here, as if their noise were larger
    with np.errstate(divide="ignore"):
        noise = data.noise_of(block) / np.sqrt(state.share[block])
    size = 0 if fit is None else len(fit.found.prior) + fit.sizes.shape[1]
    size += 0 if state.undetermined is None else len(state.undetermined)
    vector, matrix = np.zeros(size), np.eye(size)
    for column in columns.tolist():
        plane = int(data.plane_of(block)[column])
        read = np.flatnonzero(monitors & np.isfinite(left[column]) & np.isfinite(noise[column]))
        if not len(read):
            continue
        sigma = noise[column, read]
        slopes: list[Array] = []  # roots of the covariance, m, [reading, number]
        if fit is not None:
            by = fit.there.of_column(column, read, plane)
            spread = np.asarray((by @ fit.found.spread).T)
            inside = solve_triangular(fit.found.factor, spread, lower=True).T
            slopes += [inside, by @ fit.sizes]
        if state.undetermined is not None:
            slopes.append(state.undetermined[:, column, read, plane].T)
        rows = np.column_stack([left[column, read], *slopes]) / sigma[:, None]
        if state.jitter is not None:
            orbits = state.jitter[plane][:, read].T / sigma[:, None]
            lower = np.linalg.cholesky(np.eye(len(read)) + orbits @ orbits.T)
            rows = solve_triangular(lower, rows, lower=True)
        kick = kicks[column, read] / sigma
        if free and block == 0 and kick.any():
            kick /= np.linalg.norm(kick)
            rows -= np.outer(kick, kick @ rows)
            count -= 1
        square += float(rows[:, 0] @ rows[:, 0])
        count += len(read)
        vector += rows[:, 1:].T @ rows[:, 0]
        matrix += rows[:, 1:].T @ rows[:, 1:]
    return square - float(vector @ np.linalg.solve(matrix, vector)), count
