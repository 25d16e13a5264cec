"""Compiled: closed orbits for many settings of one corrector each, not linearised."""

import numpy as np

from tmlattice.beam.nonlinear import bend_state
from tmlattice.compiled import jit


@jit
def settle(  # type: ignore[no-untyped-def]
    first, last, W0, W1, W2, curved, third, layer, V0, V1, V2, solve, turn, tolerance, paths, good,
):  # fmt: skip
    """Find closed orbits by Broyden's method from a given Jacobian.

    Args:
        W0, W1, W2, curved, third: see `Layers`.
        layer: the map that is replaced, [orbit].
        V0, V1, V2: its replacement, [orbit, ...].
        solve: the start's change for a mismatch of the turn in the first coordinates, [n, free].
        turn: prescribed change of these in a turn, [free].
        tolerance: largest change of the start, m and rad.
        paths: starts with the guess, [orbit, 0]; filled, [orbit, map + 1, n].
        good: filled: whether it converged, [orbit].
    """
    n, free = paths.shape[2], len(turn)
    miss, before, weight = np.zeros(free), np.zeros(free), np.zeros(free)
    change, error = np.zeros(n), np.zeros(n)
    for orbit in range(first, last):
        inverse = solve.copy()
        for step in range(60):
            for k in range(paths.shape[1] - 1):
                x, y = paths[orbit, k], paths[orbit, k + 1]
                replaced = k == layer[orbit]
                for a in range(n):
                    total = V0[orbit, a] if replaced else W0[k, a]
                    m = 0
                    for i in range(n):
                        value = V1[orbit, a, i] if replaced else W1[k, a, i]
                        if curved[k]:
                            for j in range(i, n):
                                bend = V2[orbit, a, m] if replaced else W2[k, a, m]
                                value += bend * x[j]
                                m += 1
                        total += value * x[i]
                    y[a] = total
                bend_state(third[k], y)
            for i in range(free):
                miss[i] = paths[orbit, -1, i] - paths[orbit, 0, i] - turn[i]
            if step > 0:  # Broyden's update of the inverse Jacobian
                below = 0.0
                for a in range(n):
                    error[a] = change[a]
                    for i in range(free):
                        error[a] -= inverse[a, i] * (before[i] - miss[i])
                for i in range(free):
                    weight[i] = 0.0
                    for a in range(n):
                        weight[i] += change[a] * inverse[a, i]
                    below += weight[i] * (before[i] - miss[i])
                if below != 0.0:
                    for a in range(n):
                        for i in range(free):
                            inverse[a, i] += error[a] * weight[i] / below
            largest = 0.0
            for a in range(n):
                change[a] = 0.0
                for i in range(free):
                    change[a] += inverse[a, i] * miss[i]
                paths[orbit, 0, a] += change[a]
                if not abs(change[a]) <= largest:  # true for NaN
                    largest = abs(change[a]) if abs(change[a]) < 1.0 else np.inf
            for i in range(free):
                before[i] = miss[i]
            if not largest < 1.0:
                break
            if largest < tolerance:
                good[orbit] = True
                break
