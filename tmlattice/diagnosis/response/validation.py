"""The validation of a hierarchical fit of an orbit response, and the size of its residual.

For each held-out corrector the kick is estimated from half of the BPMs, and the prediction is
scored on the other half (`score`). The RF's orbit is fitted at half of the BPMs, and scored at the
others, less the beam jitter whose amplitude in it the fitted ones determine. No family of errors is
selected by these scores.

In the `remainder` fitted readings are compared with their noise; fitted numbers reduce the degrees
of freedom. Held-out readings are compared with the posterior predictive covariance (Gelman et al.,
Bayesian Data Analysis, ch. 6): the noise, and what the fit leaves undetermined of the ring, of the
BPMs and of the held-out corrector's calibration and roll. The kick of a held-out corrector is
free.

>>> [(block.name, block.ratio) for block in remainder(state)]
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from scipy.linalg import solve_triangular

from tmlattice.arrays import Array, Flags, Indices
from tmlattice.diagnosis.assessment import Block
from tmlattice.diagnosis.records import HIDDEN
from tmlattice.diagnosis.response.linear import Linear, linear
from tmlattice.diagnosis.response.state import State, amplitudes, rms_of
from tmlattice.diagnosis.response.stated import of_sizes
from tmlattice.diagnosis.response.weights import without_jitter
from tmlattice.effects import with_labels
from tmlattice.inference.normal import Posterior

HELPS = 0.98
"""Ratio of held-out rms, with and without causes, below which they improve the prediction."""


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
        dispersion_rms: residual of the RF's orbit in x at BPMs that are not fitted, less jitter, m.
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


def held_out(state: State) -> tuple[Indices, Flags, Flags]:
    """Return the held-out correctors that are read in both halves of the BPMs, and the BPMs that
    determine the kick of each, and those of its score, [column, monitor]."""
    half = state.split.half
    seen = np.isfinite(state.data.pick(state.data.orbits)) & state.good
    both_halves = (seen & half).any(axis=1) & (seen & ~half).any(axis=1)
    columns = np.flatnonzero(state.split.held & both_halves)
    return columns, seen[columns] & half[columns], seen[columns] & ~half[columns]


def score(
    state: State, effect: str, parameters: int = 0, moved: Mapping[int, Array] | None = None
) -> Step:
    """Return the validation scores; each corrector's kick is estimated from its near BPMs.

    Args:
        state: to validate on its held-out correctors.
        effect, parameters: of the step.
        moved: further changes of the predicted readings by block, m, [column, monitor].
    """
    data, at, half = state.data, state.at, state.split.half
    more = [(moved or {}).get(block, np.zeros(data.shape)) for block in (0, 1)]
    orbits = data.pick(data.orbits)
    columns, near, far = held_out(state)

    def picked(readings: Array, block: int = 0) -> Array:
        return data.pick(readings, block)[columns]

    read = at.seen(at.beam)
    straight = picked(read) + more[0][columns]
    # equal weights: model discrepancy does not scale with the noise
    (kick,), left = amplitudes(straight[..., None], orbits[columns], near)
    inside = np.where(far, left, np.nan)
    # the error of the kick adds to that of the reading
    spread = 1 + straight**2 / np.sum(straight**2, axis=1, where=near, keepdims=True)
    patterns = np.stack([straight, picked(at.seen(at.jumps))], axis=2)
    jumped = np.where(far, amplitudes(patterns, orbits[columns], near)[1], np.nan)
    left = picked(data.orbits, 1) - kick[:, None] * (picked(read, 1) + more[1][columns])
    near, far = near & np.isfinite(left), far & np.isfinite(left)
    outside = np.where(far, left, np.nan)
    rolled = np.full_like(outside, np.nan)
    if state.allows("corrector_roll"):
        rolls = picked(at.seen(at.across), 1)
        known = far & np.any(near & (rolls != 0), axis=1, keepdims=True)
        rolled = np.where(known, amplitudes(rolls[..., None], left, near)[1], np.nan)
    of_rf = without_jitter(state, 0, data.pick(at.left) - more[0])[0][-1]
    of_rf = np.where(state.good & ~half[-1], of_rf, np.nan)
    noise = [data.noise_of(block) for block in (0, 1)]
    squares = (inside / noise[0][columns]) ** 2
    compared = {"in-plane": squares / spread, "coupling": (outside / noise[1][columns]) ** 2,
                "RF": (of_rf / noise[0][-1]) ** 2}  # fmt: skip
    return Step(
        effect,
        parameters,
        heldout_rms_in_plane=rms_of(inside),
        heldout_rms_coupling=rms_of(outside),
        heldout_chi2_per_dof=float(np.nanmean(squares)),
        dispersion_rms=rms_of(of_rf),
        heldout_rms_position=rms_of(jumped),
        heldout_rms_roll=rms_of(rolled),
        compared=tuple(
            Block(name, float(np.nansum(own)), int(np.isfinite(own).sum()))
            for name, own in compared.items()
        ),
    )


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
