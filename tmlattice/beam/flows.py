"""The compiled sweeps of symplectic layers: a matrix, then the flow of a generator.

A layer takes x to W0 + u + d with u = W1 x and d = f(u + d / 2), where f = c + A m + Q m^[2] is the
field of the layer's generator: one implicit-midpoint step of its flow. The midpoint rule is
symplectic for every generator, exactly so when it is solved to rounding, which takes a handful of
iterations: each makes the error smaller by the field's slope (1e-3 for a magnet at 1 mm).

Where the generator is cubic and even in (y, py), as a design's are (`flat`), half of Q is zero and
is left out.

Axes as in `sweeps`; `middles` [block, layer, n, lane] holds m = u + d / 2.

Source: K. Feng, M. Qin, Symplectic Geometric Algorithms for Hamiltonian Systems, for the midpoint
rule.
"""

import numpy as np

from tmlattice.beam.sweeps import _polynomial, _pull, put
from tmlattice.compiled import jit

_ITERATIONS = 60
_ROUNDING = 1e-16


@jit
def _scratch(size):  # type: ignore[no-untyped-def]
    """Buffer of a layer: the state x, its image y, the middle m, the step d [n, lane each], and the
    largest change of the middle [lane].

    It is one flat array, so that the compiler knows its parts as disjoint: with five arrays it
    tests for overlaps before every short loop, which costs as much as the loop.
    """
    return np.zeros((4 * len(size[0]) + 1) * len(size[1]))


@jit
def _part(size, work, which):  # type: ignore[no-untyped-def]
    """x, y, m or d (0 to 3) of the buffer as [n, lane], a view."""
    n, lanes = len(size[0]), len(size[1])
    return work[which * n * lanes : (which + 1) * n * lanes].reshape((n, lanes))


@jit
def _flat_field(size, k, Q, work):  # type: ignore[no-untyped-def]
    """d = f(m) for a cubic generator that is even in (y, py)."""
    n, lanes = 4, len(size[1])
    m, d = 2 * n * lanes, 3 * n * lanes
    for a in range(2):
        xx, xp, pp = Q[k, a, 0], Q[k, a, 1], Q[k, a, 4]
        yy, yq, qq = Q[k, a, 7], Q[k, a, 8], Q[k, a, 9]
        for v in range(lanes):
            x, p = work[m + v], work[m + lanes + v]
            y, q = work[m + 2 * lanes + v], work[m + 3 * lanes + v]
            in_x = (xx * x + xp * p) * x + pp * p * p
            work[d + a * lanes + v] = in_x + ((yy * y + yq * q) * y + qq * q * q)
    for a in range(2, 4):
        xy, xq, py, pq = Q[k, a, 2], Q[k, a, 3], Q[k, a, 5], Q[k, a, 6]
        for v in range(lanes):
            x, p = work[m + v], work[m + lanes + v]
            y, q = work[m + 2 * lanes + v], work[m + 3 * lanes + v]
            work[d + a * lanes + v] = (xy * y + xq * q) * x + (py * y + pq * q) * p


@jit
def _middle(size, work):  # type: ignore[no-untyped-def]
    """m = y + d / 2; the largest change of any m."""
    n, lanes = len(size[0]), len(size[1])
    y, m, d, change = n * lanes, 2 * n * lanes, 3 * n * lanes, 4 * n * lanes
    for v in range(lanes):
        largest = 0.0
        for a in range(n):
            middle = work[y + a * lanes + v] + 0.5 * work[d + a * lanes + v]
            moved = abs(middle - work[m + a * lanes + v])
            largest = moved if moved > largest else largest
            work[m + a * lanes + v] = middle
        work[change + v] = largest
    return _largest(size, work)


@jit
def _largest(size, work):  # type: ignore[no-untyped-def]
    """Maximum over the lanes, a power of two; NaN is ignored. Comparing halves is vectorised; not
    a plain maximum."""
    first, half = 4 * len(size[0]) * len(size[1]), len(size[1]) // 2
    while half > 0:
        for v in range(half):
            mine, other = work[first + v], work[first + v + half]
            work[first + v] = other if other > mine else mine
        half //= 2
    return work[first]


@jit
def _layer(size, k, W0, W1, c, A, Q, moves, flat, work):  # type: ignore[no-untyped-def]
    """Replace x of the buffer by its image through layer k; m is the middle."""
    n, lanes = len(size[0]), len(size[1])
    y, m, d, change = n * lanes, 2 * n * lanes, 3 * n * lanes, 4 * n * lanes
    for a in range(n):
        for v in range(lanes):
            total = 0.0
            for i in range(n):
                total += W1[k, a, i] * work[i * lanes + v]
            work[y + a * lanes + v] = total
            work[m + a * lanes + v] = total
            work[d + a * lanes + v] = 0.0
    if moves[k]:
        for v in range(lanes):
            largest = 0.0
            for a in range(n):
                other = abs(work[y + a * lanes + v])
                largest = other if other > largest else largest
            work[change + v] = largest
        scale = _largest(size, work)
        before, left = scale, 0.0
        for _ in range(_ITERATIONS):
            if flat[k]:
                _flat_field(size, k, Q, work)
            else:
                _polynomial(size, k, c, A, Q, moves, _part(size, work, 2), _part(size, work, 3))
            left = _middle(size, work)
            # remaining error: this change times the convergence factor
            if not 4.0 * left * left > _ROUNDING * scale * before:
                break
            before = left
        wrong = 4.0 * left * left
        if wrong > 1e-9 * scale * before and wrong > 1e-15 * before:  # too strong a generator
            for v in range(n * lanes):
                work[d + v] = np.nan
    for a in range(n):
        kick = W0[k, a]
        for v in range(lanes):
            i = a * lanes + v
            work[i] = work[y + i] + work[d + i] + kick


@jit
def forward(first, last, size, W0, W1, c, A, Q, moves, flat, states, middles):  # type: ignore[no-untyped-def]
    """Fill states [block, 1:, n, lane] and middles from states[block, 0]."""
    work = _scratch(size)
    x, m = _part(size, work, 0), _part(size, work, 2)
    for block in range(first, last):
        put(states[block, 0], x)
        for k in range(W0.shape[0]):
            _layer(size, k, W0, W1, c, A, Q, moves, flat, work)
            put(x, states[block, k + 1])
            put(m, middles[block, k])


@jit
def track(first, last, size, W0, W1, c, A, Q, moves, flat, turns):  # type: ignore[no-untyped-def]
    """Fill turns [block, 1:, n, lane] from turns[block, 0]."""
    work = _scratch(size)
    x = _part(size, work, 0)
    for block in range(first, last):
        put(turns[block, 0], x)
        for turn in range(1, turns.shape[1]):
            for k in range(W0.shape[0]):
                _layer(size, k, W0, W1, c, A, Q, moves, flat, work)
            put(x, turns[block, turn])


@jit
def reverse(  # type: ignore[no-untyped-def]
    first,
    last,
    size,
    W1,
    A,
    Q,
    moves,
    none,
    R1,
    R2,
    bent,
    start,
    states,
    middles,
    pulls,
    adjoint,
    inner,
):
    """Fill adjoint [block, layer + 1, n, lane] = d loss / d states, and inner [block, layer + 1,
    n, lane] = d loss / d field at the layer's middle (entry k + 1 is of layer k).

    With F the field's slope at the middle, mu = adjoint + F^T mu / 2 is solved as the step was,
    and 2 mu - adjoint is carried back through the matrix.
    """
    n, lanes = len(size[0]), len(size[1])
    slope = np.empty((n, lanes))
    back = np.empty((n, lanes))
    for block in range(first, last):
        for k in range(W1.shape[0], -1, -1):
            below = adjoint[block, k]
            for b in range(n):
                for v in range(lanes):
                    below[b, v] = 0.0
            if k < W1.shape[0]:
                above, mu = adjoint[block, k + 1], inner[block, k + 1]
                for a in range(n):
                    for v in range(lanes):
                        mu[a, v] = above[a, v]
                if moves[k]:
                    scale = 0.0
                    for a in range(n):
                        for v in range(lanes):
                            scale = max(scale, abs(above[a, v]))
                    for _ in range(_ITERATIONS):
                        slope[:] = 0.0
                        _pull(size, size[0], k, A, Q, moves, middles[block, k], mu, slope)
                        left = 0.0
                        for a in range(n):
                            for v in range(lanes):
                                better = above[a, v] + 0.5 * slope[a, v]
                                left = max(left, abs(better - mu[a, v]))
                                mu[a, v] = better
                        if not left > _ROUNDING * scale:
                            break
                for a in range(n):
                    for v in range(lanes):
                        back[a, v] = 2.0 * mu[a, v] - above[a, v]
                _pull(size, size[0], k, W1, Q, none, states[block, k], back, below)
            for m in range(start[k], start[k + 1]):
                _pull(size, (None, None), m, R1, R2, bent, states[block, k], pulls[block, m], below)
