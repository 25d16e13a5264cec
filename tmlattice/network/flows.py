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

import numba
import numpy as np

from tmlattice.network.sweeps import _polynomial, _pull

_jit = numba.njit(nogil=True, cache=True, error_model="numpy", fastmath={"contract"})

_ITERATIONS = 60
_ROUNDING = 1e-16


@_jit
def _largest(size, values):  # type: ignore[no-untyped-def]
    """The largest of values [lane], a power of two of them, which are lost; NaN is passed over.

    Halves are compared with halves: the vector unit does it, as it does not a plain maximum.
    """
    half = len(size[1]) // 2
    while half > 0:
        for v in range(half):
            # Not max(): numba's looks for NaN, one lane after another.
            other = values[v + half]
            values[v] = other if other > values[v] else values[v]
        half //= 2
    return values[0]


@_jit
def _flat_field(size, k, Q, m, d):  # type: ignore[no-untyped-def]
    """d = f(m) for a cubic generator that is even in (y, py).

    One row after another: the vectoriser gives up where too many arrays might overlap.
    """
    for a in range(2):
        for v in range(len(size[1])):
            x, p, y, q = m[0, v], m[1, v], m[2, v], m[3, v]
            in_x = (Q[k, a, 0] * x + Q[k, a, 1] * p) * x + Q[k, a, 4] * p * p
            in_y = (Q[k, a, 7] * y + Q[k, a, 8] * q) * y + Q[k, a, 9] * q * q
            d[a, v] = in_x + in_y
    for a in range(2, 4):
        for v in range(len(size[1])):
            x, p, y, q = m[0, v], m[1, v], m[2, v], m[3, v]
            by_x = Q[k, a, 2] * y + Q[k, a, 3] * q
            by_p = Q[k, a, 5] * y + Q[k, a, 6] * q
            d[a, v] = by_x * x + by_p * p


@_jit
def _middle(size, y, d, m, change):  # type: ignore[no-untyped-def]
    """m = y + d / 2, and by how much it changed, change [lane]."""
    for v in range(len(size[1])):
        middle = y[0, v] + 0.5 * d[0, v]
        change[v] = abs(middle - m[0, v])
        m[0, v] = middle
    for a in range(1, len(size[0])):
        for v in range(len(size[1])):
            middle = y[a, v] + 0.5 * d[a, v]
            moved = abs(middle - m[a, v])
            change[v] = moved if moved > change[v] else change[v]
            m[a, v] = middle


@_jit
def _layer(size, k, W0, W1, c, A, Q, moves, flat, x, m, d, change, y):  # type: ignore[no-untyped-def]
    """y [n, lane] = layer k of x; m is left as the middle, d and change [lane] as they come."""
    n, lanes = len(size[0]), len(size[1])
    for a in range(n):
        for v in range(lanes):
            total = 0.0
            for i in range(n):
                total += W1[k, a, i] * x[i, v]
            y[a, v] = total
    for a in range(n):
        for v in range(lanes):
            m[a, v] = y[a, v]
    if moves[k]:
        for v in range(lanes):
            change[v] = abs(y[0, v])
        for a in range(1, n):
            for v in range(lanes):
                other = abs(y[a, v])
                change[v] = other if other > change[v] else change[v]
        scale = _largest(size, change)
        before, left = scale, 0.0
        for _ in range(_ITERATIONS):
            if flat[k]:
                _flat_field(size, k, Q, m, d)
            else:
                _polynomial(size, k, c, A, Q, moves, m, d)
            _middle(size, y, d, m, change)
            left = _largest(size, change)
            # What is still wrong is this change times the factor by which changes shrink.
            if not 4.0 * left * left > _ROUNDING * scale * before:
                break
            before = left
        wrong = 4.0 * left * left
        if wrong > 1e-9 * scale * before and wrong > 1e-15 * before:  # too strong a generator
            for a in range(n):
                for v in range(lanes):
                    d[a, v] = np.nan
        for a in range(n):
            for v in range(lanes):
                y[a, v] += d[a, v] + W0[k, a]
    else:
        for a in range(n):
            for v in range(lanes):
                y[a, v] += W0[k, a]


@_jit
def forward(first, last, size, W0, W1, c, A, Q, moves, flat, states, middles):  # type: ignore[no-untyped-def]
    """Fill states [block, 1:, n, lane] and middles from states[block, 0]."""
    d = np.empty((len(size[0]), len(size[1])))
    change = np.empty(len(size[1]))
    for block in range(first, last):
        for k in range(W0.shape[0]):
            _layer(
                size, k, W0, W1, c, A, Q, moves, flat, states[block, k], middles[block, k], d,
                change, states[block, k + 1],
            )  # fmt: skip


@_jit
def track(first, last, size, W0, W1, c, A, Q, moves, flat, turns):  # type: ignore[no-untyped-def]
    """Fill turns [block, 1:, n, lane] from turns[block, 0]."""
    n, lanes = len(size[0]), len(size[1])
    x = np.empty((n, lanes))
    y = np.empty((n, lanes))
    m = np.empty((n, lanes))
    d = np.empty((n, lanes))
    change = np.empty(lanes)
    for block in range(first, last):
        x[:] = turns[block, 0]
        for turn in range(1, turns.shape[1]):
            for k in range(W0.shape[0]):
                _layer(size, k, W0, W1, c, A, Q, moves, flat, x, m, d, change, y)
                for a in range(n):
                    for v in range(lanes):
                        x[a, v] = y[a, v]
            turns[block, turn] = x


@_jit
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
    and what goes back through the matrix is 2 mu - adjoint.
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
