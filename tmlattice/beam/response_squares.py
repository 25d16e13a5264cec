"""Compiled: squares of changes of an orbit response in factors."""

import numpy as np

from tmlattice.compiled import jit_sums


# `reassoc`: the sum may follow the vector unit's order.
@jit_sums
def squares(seen, readings, start, change, first, weight):  # type: ignore[no-untyped-def]
    """Weighted sum over all readings of (seen . start + readings . change)^2, [error].

    Args:
        seen: change of the readings of a launch by an error, [error, n, reading]; n is even.
        readings: readings of a launch, [n, reading].
        start: launches of the columns, for the readings before and behind each column's kick,
            [2, column, n].
        change: of these by an error, [2, error, column, n].
        first: the first reading behind each column's kick, [column].
        weight: of each reading, [column, reading].
    """
    errors, n, count = seen.shape
    out = np.zeros(errors)
    left = np.empty(count)
    for h in range(errors):
        total = 0.0
        for c in range(len(first)):
            for side in range(2):
                low, high = (0, first[c]) if side == 0 else (first[c], count)
                left[low:high] = 0.0
                for i in range(0, n, 2):
                    u, v = start[side, c, i], start[side, c, i + 1]
                    a, b = change[side, h, c, i], change[side, h, c, i + 1]
                    for r in range(low, high):
                        left[r] += (
                            u * seen[h, i, r] + v * seen[h, i + 1, r]
                            + a * readings[i, r] + b * readings[i + 1, r]
                        )  # fmt: skip
            for r in range(count):
                total += weight[c, r] * left[r] * left[r]
        out[h] = total
    return out
