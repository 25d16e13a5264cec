"""Compiled loops of the diagnosis: tangent maps along trajectories, signatures of all hypotheses.

A turn has `step` maps: its layers and the closing drift.
Axes: states [shot, step + 1, n], tangents C [shot, step + 1, n, n] = d state / d launch.
"""

import math

import numpy as np

from tmlattice.beam.nonlinear import bend_tangent
from tmlattice.beam.sweeps import put
from tmlattice.compiled import jit


@jit
def trajectories(  # type: ignore[no-untyped-def]
    first, last, size, W0, W1, W2, curved, third, exits, rf, states, tangents
):
    """Fill states [shot, 1:] and tangents [shot, 1:] from states[:, 0] and tangents[:, 0].

    Step k of a turn is that of `Layers`; `exits` and `rf` are those of `Cavities`; the length of
    `size` is n, known when compiled.
    """
    n, steps = len(size), W0.shape[0]
    slopes = np.empty((n, n))
    for shot in range(first, last):
        if len(exits):
            _cavities(0, exits, rf, states[shot, 0], tangents[shot, 0])
        for k in range(states.shape[1] - 1):
            w = k % steps
            x, y = states[shot, k], states[shot, k + 1]
            before, after = tangents[shot, k], tangents[shot, k + 1]
            for a in range(n):
                for i in range(n):
                    slopes[a, i] = W1[w, a, i]
            if curved[w]:
                for a in range(n):
                    m = 0
                    for i in range(n):
                        for j in range(i, n):
                            slopes[a, i] += W2[w, a, m] * x[j]
                            slopes[a, j] += W2[w, a, m] * x[i]
                            m += 1
            for a in range(n):
                total = W0[w, a]
                for i in range(n):  # a quadratic form is half of its slope
                    total += 0.5 * (W1[w, a, i] + slopes[a, i]) * x[i]
                y[a] = total
                for j in range(n):
                    total = 0.0
                    for i in range(n):
                        total += slopes[a, i] * before[i, j]
                    after[a, j] = total
            bend_tangent(third[w], y, after)
            if len(exits):
                _cavities(w + 1, exits, rf, y, after)
                if w + 1 == steps:
                    y[4] += rf[3]
                    if k + 2 < states.shape[1]:
                        _cavities(0, exits, rf, y, after)


@jit
def read(shots, R0, R1, R2, where, states, tangents, beam, slopes):  # type: ignore[no-untyped-def]
    """Fill, for some shots, the beam's positions [shot, reading, 2] at the read-outs, and slopes
    [shot, reading, 2, n], their derivatives by the launch; `where` is that of `Model`."""
    n = states.shape[2]
    slope = np.empty(n)
    for shot in shots:
        for r in range(len(where)):
            m, x, tangent = r % len(R0), states[shot, where[r]], tangents[shot, where[r]]
            for p in range(2):
                for i in range(n):
                    slope[i] = R1[m, p, i]
                    slopes[shot, r, p, i] = 0.0
                pair = 0
                for i in range(n):
                    for j in range(i, n):
                        slope[i] += R2[m, p, pair] * x[j]
                        slope[j] += R2[m, p, pair] * x[i]
                        pair += 1
                total = R0[m, p]
                for i in range(n):
                    total += 0.5 * (R1[m, p, i] + slope[i]) * x[i]
                    for j in range(n):
                        slopes[shot, r, p, j] += slope[i] * tangent[i, j]
                beam[shot, r, p] = total


@jit
def _cavities(exit_, exits, rf, x, tangent):  # type: ignore[no-untyped-def]
    """Apply the cavities at one exit to a state and its tangent."""
    for c in range(len(exits)):
        if exits[c] == exit_:
            angle = rf[1] - rf[2] * x[4]
            x[5] += rf[0] * math.sin(angle)
            slope = -rf[0] * rf[2] * math.cos(angle)
            for j in range(len(x)):
                tangent[5, j] += slope * tangent[4, j]


@jit
def merge(steps, ends, whole):  # type: ignore[no-untyped-def]
    """whole [end, n, n]: the product of the steps behind the last end, up to and including this."""
    n, k = steps.shape[1], 0
    row = np.empty(n)
    for e in range(len(ends)):
        put(steps[k], whole[e])
        for s in range(k + 1, ends[e] + 1):
            for j in range(n):
                for a in range(n):
                    row[a] = 0.0
                    for i in range(n):
                        row[a] += steps[s, a, i] * whole[e, i, j]
                for a in range(n):
                    whole[e, a, j] = row[a]
        k = ends[e] + 1


@jit
def products(steps, total):  # type: ignore[no-untyped-def]
    """total [step + 1, n, n] of matrices [step, n, n]: cumulative products from the start."""
    n = steps.shape[1]
    for a in range(n):
        for j in range(n):
            total[0, a, j] = 1.0 if a == j else 0.0
    for k in range(steps.shape[0]):
        for a in range(n):
            for j in range(n):
                total[k + 1, a, j] = 0.0
            for i in range(n):
                slope = steps[k, a, i]
                if slope != 0.0:
                    for j in range(n):
                        total[k + 1, a, j] += slope * total[k, i, j]


@jit
def kicks(layer, D0, D1, D2, states, steps, out):  # type: ignore[no-untyped-def]
    """out [shot, turn, row, n] = D0 + D1 x + D2 x^2 at the entrance of each row's layer.

    The state is states[shot, turn * steps + layer].
    """
    n = states.shape[2]
    for shot in range(out.shape[0]):
        for turn in range(out.shape[1]):
            for row in range(len(layer)):
                x = states[shot, turn * steps + layer[row]]
                for a in range(n):
                    total = D0[row, a]
                    m = 0
                    for i in range(n):
                        slope = D1[row, a, i]
                        for j in range(i, n):
                            slope += D2[row, a, m] * x[j]
                            m += 1
                        total += slope * x[i]
                    out[shot, turn, row, a] = total


@jit
def carry(first, last, owner, start, launch_kick, G, out):  # type: ignore[no-untyped-def]
    """out [hypothesis, shot, reading, 2] += G v: kicks carried to all readings downstream.

    Args:
        owner: hypothesis of each row, [row].
        start: the first reading downstream of the row, [row, turn].
        launch_kick: the kick as a change of the launch, C^-1 kick, [shot, turn, row, n].
        G: d reading / d launch, [shot, reading, 2, n].
    """
    n = G.shape[3]
    for shot in range(first, last):
        for row in range(len(owner)):
            h = owner[row]
            for turn in range(start.shape[1]):
                v = launch_kick[shot, turn, row]
                for m in range(start[row, turn], G.shape[1]):
                    for plane in range(2):
                        total = 0.0
                        for i in range(n):
                            total += G[shot, m, plane, i] * v[i]
                        out[h, shot, m, plane] += total
