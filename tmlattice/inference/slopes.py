"""Derivatives of readings by errors of the ring: large arrays, read once and never copied.

>>> ring = (Slopes(gradients, None), Slopes(edges, now))
>>> sums = weighed_sums(ring, residual, weight, plane, by_monitor, by_column)
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.blas import dsyrk

from tmlattice.compiled import jit_sums

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

AT_ONCE = 2048
"""Readings weighed at a time: enough for matrix products, within the cache."""


class Slopes(NamedTuple):
    """Derivatives by one family of errors.

    Attributes:
        rows: d reading / d error as computed, [error, column, monitor].
        now: factor since then, [column, monitor]; None: 1.
    """

    rows: Array
    now: Array | None = None

    def times(self, readings: Array) -> Array:
        """Readings [..., column, monitor] times the derivatives, summed, [error, ...]."""
        own = readings if self.now is None else self.now * readings
        flat = self.rows.reshape(len(self.rows), int(np.prod(self.rows.shape[1:])))
        summed = flat @ own.reshape(-1, flat.shape[1]).T
        return np.asarray(summed.reshape(len(self.rows), *readings.shape[:-2]))

    def of(self, column: int, monitor: Indices) -> Array:
        """Derivatives of some readings of a column, [error, reading]."""
        own = self.rows[:, column, monitor]
        return np.asarray(own if self.now is None else own * self.now[column, monitor])

    def through(self, patterns: Array) -> Array:
        """Derivatives times [column, monitor, pattern], summed over monitors, [error, column,
        pattern]."""
        own = patterns if self.now is None else self.now[:, :, None] * patterns
        return np.asarray((self.rows.transpose(1, 0, 2) @ own).transpose(1, 0, 2))


class Sums(NamedTuple):
    """Sums over readings, for the errors of all families in turn.

    Attributes:
        square: J^T W J, the upper triangle, [error, error].
        monitors: with the monitors' derivatives, [error, plane, monitor].
        columns: with the columns' derivatives, [error, column].
        vector: J^T W residual, [error].
    """

    square: Array
    monitors: Array
    columns: Array
    vector: Array


def whole(ring: Sequence[Slopes], shape: tuple[int, ...]) -> Array:
    """Return all derivatives in one array, [error, column, monitor]."""
    parts = [own.rows if own.now is None else own.rows * own.now for own in ring]
    return parts[0] if len(parts) == 1 else np.concatenate([np.zeros((0, *shape)), *parts])


def weighed_sums(
    ring: Sequence[Slopes],
    residual: Array,
    weight: Array,
    plane: Indices,
    by_monitor: Array,
    by_column: Array,
) -> Sums:
    """Return sums over all readings; see `normal.normal_equations` for the arguments.

    `residual` is finite here. Memory beyond the derivatives is that of `AT_ONCE` readings.
    """
    columns, monitors = residual.shape
    ends = np.cumsum([0, *(len(own.rows) for own in ring)])
    errors = int(ends[-1])
    out = Sums(np.zeros((errors, errors), order="F"), np.zeros((errors, 2, monitors)),
               np.zeros((errors, columns)), np.zeros(errors))  # fmt: skip
    if not errors:
        return out
    step = min(max(AT_ONCE // monitors, 1), columns)
    buffer = np.empty(errors * step * monitors)
    root = np.sqrt(weight)
    square, by_monitor, by_column = out.square, weight * by_monitor, weight * by_column
    scales = [
        [np.ascontiguousarray(a if own.now is None else a * own.now)
         for a in (root, by_monitor, by_column)]
        for own in ring
    ]  # fmt: skip
    for low in range(0, columns, step):
        some = slice(low, min(low + step, columns))
        count = some.stop - low
        weighed = buffer[: errors * count * monitors].reshape(errors, count, monitors)
        for own, scale, begin, end in zip(ring, scales, ends, ends[1:], strict=False):
            mine = slice(begin, end)
            weights, u, v = (factor[some] for factor in scale)
            _weigh(own.rows[:, some], weights, u, v, plane[some], weighed[mine],
                   out.monitors[mine], out.columns[mine, some])  # fmt: skip
        flat = weighed.reshape(errors, -1)
        square = dsyrk(1.0, flat.T, beta=1.0, c=square, trans=1, lower=0, overwrite_c=1)
        out.vector[:] += flat @ (root[some] * residual[some]).ravel()
    return out._replace(square=square)


# `reassoc`: the sum may follow the vector unit's order.
@jit_sums
def _weigh(rows, root, by_monitor, by_column, plane, weighed, monitors, columns):  # type: ignore[no-untyped-def]
    """Sum over the derivatives of one family in one pass; adds to `monitors`.

    Args:
        rows: [error, column, monitor].
        root, by_monitor, by_column: factors of the derivatives, [column, monitor].
        plane: [column].
        weighed, monitors, columns: results, see `Sums`; weighed is root times rows.
    """
    for i in range(rows.shape[0]):
        for c in range(rows.shape[1]):
            own, into = rows[i, c], weighed[i, c]
            added, total = monitors[i, plane[c]], 0.0
            for m in range(rows.shape[2]):
                slope = own[m]
                into[m] = root[c, m] * slope
                added[m] += by_monitor[c, m] * slope
                total += by_column[c, m] * slope
            columns[i, c] = total
