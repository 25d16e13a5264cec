"""The residual of a fit of an orbit response, compared with its expected covariance.

Fitted readings are compared with their noise; fitted numbers reduce the degrees of freedom.
Held-out readings are compared with the posterior predictive covariance (Gelman et al., Bayesian
Data Analysis, ch. 6): the noise, and what the fit leaves undetermined of the ring, of the BPMs and
of the held-out corrector's calibration and roll. The kick of a held-out corrector is free.

>>> [(block.name, block.ratio) for block in remainder(state)]
"""

from collections.abc import Iterator

import numpy as np
from scipy.linalg import solve_triangular

from tmlattice.arrays import Array, Flags, Indices
from tmlattice.diagnosis.assessment import Block
from tmlattice.diagnosis.response.linear import Linear, linear
from tmlattice.diagnosis.response.state import State
from tmlattice.diagnosis.response.stated import of_sizes
from tmlattice.inference.normal import Posterior

BLOCKS = ("in-plane", "coupling", "RF")


def remainder(state: State) -> tuple[Block, ...]:
    """Return chi-square of fitted and held-out readings of a converged state, with its learnt
    priors: in-plane, coupling, and the RF's orbit; without those that have no reading."""
    return tuple(block for block in _blocks(state) if block.freedom >= 1)


def _blocks(state: State) -> Iterator[Block]:
    fitted, half = ~state.split.held[:-1], state.split.half[-1]
    last = len(state.data.plane) - 1
    for block in (0, 1):
        there, found, more = _solved(state, block)
        name = BLOCKS[block]
        own = _Sum(state, block)
        for c in np.flatnonzero(fitted).tolist():
            own.add(c, state.good)
        yield Block(f"fitted, {name}", own.chi2, own.readings - _numbers(found))
        held = _Sum(state, block, there, found, more)
        for c in np.flatnonzero(state.split.held[:-1]).tolist():
            held.add(c, state.good, free=True)
        yield Block(f"held-out, {name}", held.chi2, held.readings)
        if block == 0:
            for which, monitors in (("fitted", half), ("held-out", ~half)):
                fit = (there, found, more) if which == "held-out" else ()
                rf = _Sum(state, block, *fit)
                rf.add(last, state.good & monitors)
                yield Block(f"{which}, {BLOCKS[2]}", rf.chi2, rf.readings)


def _solved(state: State, block: int) -> tuple[Linear | None, Posterior | None, Array | None]:
    """The fit of a block, and roots of the covariance by unknown prior scales."""
    if not state.of_block(block):
        return None, None, None
    there = linear(state, block)
    found = there.posterior
    return there, found, of_sizes(state, block, there)


def _numbers(found: Posterior | None) -> float:
    """Effective number of parameters: 1 for each by the data, 0 for each by its prior."""
    if found is None:
        return 0.0
    return float(len(found.prior) - np.trace(found.covariance))


class _Sum:
    """Chi-square of readings, column by column, in the covariance of their noise and, of held-out
    ones, of the fit's posterior (by Woodbury's identity).

    Args:
        state, block: of the readings.
        there, found, more: the fit, see `_solved`; None: their noise alone.
    """

    def __init__(
        self,
        state: State,
        block: int,
        there: Linear | None = None,
        found: Posterior | None = None,
        more: Array | None = None,
    ) -> None:
        self.state, self.block = state, block
        self.there, self.found, self.more = there, found, more
        data = state.data
        self.left = data.pick(state.at.left, block)
        # outliers count in the fit, and here, as if their noise were larger
        with np.errstate(divide="ignore"):
            self.noise = data.noise_of(block) / np.sqrt(state.share[block])
        self.square, self.readings = 0.0, 0
        size = 0 if found is None or more is None else len(found.prior) + more.shape[1]
        self.vector, self.matrix = np.zeros(size), np.eye(size)

    def add(self, column: int, monitors: Flags, free: bool = False) -> None:
        """The readings of a column at some BPMs; with its kick free or fixed."""
        read = np.flatnonzero(
            monitors & np.isfinite(self.left[column]) & np.isfinite(self.noise[column])
        )
        if not len(read):
            return
        sigma = self.noise[column, read]
        rows = np.column_stack([self.left[column, read], *self._slopes(column, read)])
        rows /= sigma[:, None]
        if self.state.jitter is not None:
            orbits = self.state.jitter[self._plane(column)][:, read].T / sigma[:, None]
            lower = np.linalg.cholesky(np.eye(len(read)) + orbits @ orbits.T)
            rows = solve_triangular(lower, rows, lower=True)
        if free:
            kick = self.state.at.seen(self.state.at.beam)
            slope = self.state.data.pick(kick, self.block)[column, read] / sigma
            if self.block == 0 and slope.any():
                slope /= np.linalg.norm(slope)
                rows -= np.outer(slope, slope @ rows)
                self.readings -= 1
        left, slopes = rows[:, 0], rows[:, 1:]
        self.square += float(left @ left)
        self.readings += len(read)
        self.vector += slopes.T @ left
        self.matrix += slopes.T @ slopes

    def _plane(self, column: int) -> int:
        """The plane of the block's readings of a column."""
        return int(self.state.data.plane_of(self.block)[column])

    def _slopes(self, column: int, read: Indices) -> list[Array]:
        """Roots of the posterior covariance of the readings, m, [reading, number]."""
        if self.there is None or self.found is None or self.more is None:
            return []
        rows = self.there.of_column(column, read, self._plane(column))
        spread = np.asarray((rows @ self.found.spread).T)
        return [solve_triangular(self.found.factor, spread, lower=True).T, rows @ self.more]

    @property
    def chi2(self) -> float:
        """The sum over all readings."""
        if not len(self.vector):
            return self.square
        return self.square - float(self.vector @ np.linalg.solve(self.matrix, self.vector))
