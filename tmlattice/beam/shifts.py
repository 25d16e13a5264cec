"""Effect of small changes in layers on first-turn readings, as shifts of the launch.

A change in a layer acts on the trajectory behind it like a shift of the launch. A reading changes
by its row times the shift, and products with all changes are running sums: d readings / d changes
is never formed.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


@dataclass(frozen=True)
class Shifts:
    """Readings as linear functions of changes, at some trajectories.

    Attributes:
        rows: d reading / d launch, [shot, monitor, 2, n].
        shift: of the launch for a unit of each change, in beam order, [shot, change, n].
        upto: changes before each monitor, [monitor].
        present: valid readings, [shot, monitor, 2]; the rows of all products.
    """

    rows: Array
    shift: Array
    upto: Indices
    present: NDArray[np.bool_]

    def _running(self, terms: Array) -> Array:
        """Sums of terms [change, ...] over the changes before each monitor, [monitor, ...]."""
        total = np.concatenate([np.zeros((1, *terms.shape[1:])), np.cumsum(terms, axis=0)])
        return np.asarray(total[self.upto])

    def times(self, amounts: Array) -> Array:
        """J amounts: change of the readings, [row]."""
        moved = self._running(np.moveaxis(self.shift * amounts[:, None], 1, 0))
        return np.asarray(np.einsum("smpa,msa->smp", self.rows, moved)[self.present])

    def transposed(self, rows: Array) -> Array:
        """J^T rows, [change]."""
        weights = np.zeros(self.present.shape)
        weights[self.present] = rows
        at_start = np.einsum("smpa,smp->msa", self.rows, weights)
        later = np.zeros((len(self.upto) + 1, *at_start.shape[1:]))
        later[:-1] = np.cumsum(at_start[::-1], axis=0)[::-1]
        # the first monitor behind change j is the first with upto > j
        first = np.searchsorted(self.upto, np.arange(self.shift.shape[1]), side="right")
        return np.asarray(np.einsum("sja,jsa->j", self.shift, later[first]))

    def kernel(self, variance: Array) -> Array:
        """J P J^T for variances P [change], [row, row]."""
        shots, monitors = self.rows.shape[:2]
        if self.shift.shape[1] <= 2 * shots * monitors:  # J itself is faster
            A = self.matrix * np.sqrt(variance)
            return np.asarray(A @ A.T)
        low = np.minimum.outer(np.arange(monitors), np.arange(monitors))
        K = np.empty((shots, monitors, 2, shots, monitors, 2))
        for s in range(shots):
            for t in range(s + 1):
                both = self._running(
                    np.einsum("ja,jb->jab", self.shift[s] * variance[:, None], self.shift[t])
                )
                half = self.rows[s][:, None] @ both[low]  # [monitor, monitor, 2, n]
                block = (half @ self.rows[t].swapaxes(1, 2)).swapaxes(1, 2)
                K[s, :, :, t] = block
                K[t, :, :, s] = block.transpose(2, 3, 0, 1)
        there = self.present.ravel()
        return np.asarray(K.reshape(len(there), -1)[np.ix_(there, there)])

    @cached_property
    def matrix(self) -> Array:
        """J itself, [row, change]; for few changes."""
        seen = np.arange(self.shift.shape[1]) < self.upto[:, None]
        J = np.einsum("smpa,sja->smpj", self.rows, self.shift) * seen[:, None, :]
        return np.asarray(J[self.present])

    def launch_kernel(self, sigma: Array) -> Array:
        """Covariance of the readings by errors of the launches, rms sigma [n] or [shot, n]:
        [row, row]."""
        shots, monitors = self.rows.shape[:2]
        each = np.broadcast_to(sigma, (shots, self.rows.shape[3]))
        scaled = (self.rows * each[:, None, None]).reshape(shots, monitors * 2, -1)
        K = np.zeros((shots, monitors * 2, shots, monitors * 2))
        for s in range(shots):
            K[s, :, s] = scaled[s] @ scaled[s].T
        there = self.present.ravel()
        return np.asarray(K.reshape(len(there), -1)[np.ix_(there, there)])
