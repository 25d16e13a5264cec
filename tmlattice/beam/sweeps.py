"""The compiled sweeps: trajectories forward through all layers, sensitivities back.

A layer takes the state x [n] to W0 + W1 x + W2 [x]^2, with the products x_i x_j (i <= j) in the
reduced Kronecker order. A ring is a chain of some 1500 layers that differ from each other, so the
chain is the loop, and the weights stream through it once for every block of `lanes` trajectories.
The dimension and the number of lanes are compile-time constants: the compiler unrolls the small
loops, runs one trajectory as a short chain of fused products (lanes = 1), and fills the vector
unit with many (lanes = 64). Blocks are shared among threads; sums over trajectories are taken in
one fixed order, so the result does not depend on their number.

Axes: `states` [block, layer + 1, n, lane], `W0` [layer, n], `W1` [layer, n, n],
`W2` [layer, n, n (n + 1) / 2], read-outs `R0` [monitor, 2], `R1` [monitor, 2, n],
`R2` [monitor, 2, n (n + 1) / 2].
"""

import math
from collections.abc import Callable

import numpy as np

from tmlattice.arrays import Array, Flags
from tmlattice.beam.nonlinear import bend_state
from tmlattice.beam.threads import share
from tmlattice.compiled import jit, jit_sums
from tmlattice.maps import RingMaps

Size = tuple[tuple[None, ...], tuple[None, ...]]

LANES = (1, 16, 64)
"""Trajectories of a block: one, some, many. One needs the shortest chain of operations; many need
long rows for the vector unit."""


def run(kernel: Callable[..., None], count: int, size: Size, *arguments: object) -> None:
    """Call `kernel(first, last, size, *arguments)` over `count` blocks or layers.

    Many trajectories are shared among threads; for one or a few, waking a thread costs more than
    it saves.
    """
    if len(size[1]) < LANES[-1]:
        kernel(0, count, size, *arguments)
    else:
        share(kernel, count, size, *arguments)


_PLANES = (None, None)

# `contract`: products are fused into sums, exact to rounding and repeatable; no other fast
# mathematics for states. `reassoc`: sums over lanes may follow the vector unit's order.


@jit
def put(x, y):  # type: ignore[no-untyped-def]
    """y [n, lane] = x; an assignment of slices takes seconds to compile, for its messages."""
    for a in range(x.shape[0]):
        for v in range(x.shape[1]):
            y[a, v] = x[a, v]


@jit
def _polynomial(size, k, W0, W1, W2, curved, x, y):  # type: ignore[no-untyped-def]
    """y [., lane] = polynomial k of x [n, lane], in Horner's form: few and short chains."""
    n, lanes = len(size[0]), len(size[1])
    for a in range(y.shape[0]):
        if curved[k]:
            for v in range(lanes):
                total = W0[k, a]
                m = 0
                for i in range(n):
                    slope = W1[k, a, i]
                    for j in range(i, n):
                        slope += W2[k, a, m] * x[j, v]
                        m += 1
                    total += slope * x[i, v]
                y[a, v] = total
        else:
            for v in range(lanes):
                total = W0[k, a]
                for i in range(n):
                    total += W1[k, a, i] * x[i, v]
                y[a, v] = total


@jit
def _pull(size, rows, k, W1, W2, curved, x, above, below):  # type: ignore[no-untyped-def]
    """below [n, lane] += J(x)^T above [row, lane]: a sensitivity carried back through
    polynomial k."""
    n, lanes, height = len(size[0]), len(size[1]), len(rows)
    for i in range(n):
        for v in range(lanes):
            total = below[i, v]
            for a in range(height):
                total += W1[k, a, i] * above[a, v]
            below[i, v] = total
    if curved[k]:
        m = 0
        for i in range(n):
            for j in range(i, n):
                for v in range(lanes):
                    bend = 0.0
                    for a in range(height):
                        bend += W2[k, a, m] * above[a, v]
                    below[i, v] += bend * x[j, v]
                    below[j, v] += bend * x[i, v]
                m += 1


@jit
def forward(first, last, size, W0, W1, W2, curved, states):  # type: ignore[no-untyped-def]
    """Fill states [block, 1:, n, lane] from states[block, 0]."""
    for block in range(first, last):
        for k in range(W0.shape[0]):
            _polynomial(size, k, W0, W1, W2, curved, states[block, k], states[block, k + 1])


@jit
def turn(first, last, size, W0, W1, W2, curved, third, exits, rf, states):  # type: ignore[no-untyped-def]
    """`forward` with the third order of `Layers`, with the cavities of `Cavities`, and the slip of
    the turn at its end."""
    lanes = len(size[1])
    for block in range(first, last):
        for k in range(W0.shape[0] + 1):
            if k > 0:
                x, y = states[block, k - 1], states[block, k]
                _polynomial(size, k - 1, W0, W1, W2, curved, x, y)
                if third[k - 1, 0] != 0 or third[k - 1, 2] != 0:
                    for v in range(lanes):
                        bend_state(third[k - 1], y[:, v])
            for c in range(len(exits)):
                if exits[c] == k:
                    for v in range(lanes):
                        angle = rf[1] - rf[2] * states[block, k, 4, v]
                        states[block, k, 5, v] += rf[0] * math.sin(angle)
        if len(exits):
            for v in range(lanes):
                states[block, -1, 4, v] += rf[3]


@jit
def track(first, last, size, W0, W1, W2, curved, turns):  # type: ignore[no-untyped-def]
    """Fill turns [block, 1:, n, lane] from turns[block, 0]; states inside a turn are not kept."""
    n, lanes = len(size[0]), len(size[1])
    x = np.empty((n, lanes))
    y = np.empty((n, lanes))
    for block in range(first, last):
        put(turns[block, 0], x)
        for turn in range(1, turns.shape[1]):
            for k in range(W0.shape[0]):
                _polynomial(size, k, W0, W1, W2, curved, x, y)
                put(y, x)
            put(x, turns[block, turn])


@jit
def read(first, last, size, R0, R1, R2, bent, at, states, readings):  # type: ignore[no-untyped-def]
    """Fill readings [block, monitor, 2, lane]; monitor m reads the state at exit `at[m]`."""
    for block in range(first, last):
        for m in range(R0.shape[0]):
            _polynomial(size, m, R0, R1, R2, bent, states[block, at[m]], readings[block, m])


@jit
def reverse(  # type: ignore[no-untyped-def]
    first, last, size, W1, W2, curved, R1, R2, bent, start, states, pulls, adjoint
):
    """Fill adjoint [block, layer + 1, n, lane] = d loss / d states from
    pulls [block, monitor, 2, lane] = d loss / d readings; adjoint[:, -1] holds the part that is not
    from the readings.

    The monitors at exit k are start[k] to start[k + 1] - 1, in beam order.
    """
    n, lanes = len(size[0]), len(size[1])
    for block in range(first, last):
        for k in range(W1.shape[0], -1, -1):
            below = adjoint[block, k]
            if k < W1.shape[0]:
                for b in range(n):
                    for v in range(lanes):
                        below[b, v] = 0.0
                _pull(
                    size, size[0], k, W1, W2, curved, states[block, k], adjoint[block, k + 1], below
                )
            for m in range(start[k], start[k + 1]):
                _pull(size, _PLANES, m, R1, R2, bent, states[block, k], pulls[block, m], below)


@jit_sums
def weights(first, last, size, states, adjoint, G0, G1, G2):  # type: ignore[no-untyped-def]
    """Gradients of the weights of the layers first to last - 1, summed over trajectories."""
    n, lanes = len(size[0]), len(size[1])
    for k in range(first, last):
        for block in range(states.shape[0]):
            x = states[block, k]
            for a in range(n):
                up = adjoint[block, k + 1, a]
                total = 0.0
                for v in range(lanes):
                    total += up[v]
                G0[k, a] += total
                m = 0
                for i in range(n):
                    total = 0.0
                    for v in range(lanes):
                        total += up[v] * x[i, v]
                    G1[k, a, i] += total
                    for j in range(i, n):
                        total = 0.0
                        for v in range(lanes):
                            total += up[v] * x[i, v] * x[j, v]
                        G2[k, a, m] += total
                        m += 1


def curved(W2: Array) -> Flags:
    """Whether each layer has a second-order part: the sweeps skip zero ones."""
    return np.asarray(W2.any(axis=(1, 2)))


def size_of(n: int, batch: int) -> Size:
    """Compile-time constants of the kernels, as lengths: the dimension and the lanes."""
    lanes = next((lanes for lanes in LANES if batch <= lanes), LANES[-1])
    return (None,) * n, (None,) * lanes


def pack(rows: Array, lanes: int) -> Array:
    """Trajectories [batch, ...] as blocks [block, ..., lane], the last one padded with zeros."""
    blocks = -(-len(rows) // lanes)
    padded = np.zeros((blocks * lanes, *rows.shape[1:]))
    padded[: len(rows)] = rows
    folded = padded.reshape(blocks, lanes, *rows.shape[1:])
    return np.ascontiguousarray(np.moveaxis(folded, 1, -1))


def begun(start: Array, exits: int) -> tuple[Size, Array]:
    """Return the size for launches [batch, n], and states [block, exit, n, lane] of which the first
    exit holds the launches; the others are empty."""
    size = size_of(start.shape[1], len(start))
    packed = pack(start, len(size[1]))
    states = np.empty((len(packed), exits, *packed.shape[1:]))
    states[:, 0] = packed
    return size, states


def read_out(maps: RingMaps, size: Size, states: Array) -> Array:
    """Return the readings [block, monitor, 2, lane] of states [block, layer + 1, n, lane]."""
    readings = np.empty((len(states), len(maps.at), 2, len(size[1])))
    out = maps.R0, maps.R1, maps.R2, curved(maps.R2), maps.at
    run(read, len(states), size, *out, states, readings)
    return readings


def unpack(blocks: Array, batch: int) -> Array:
    """The inverse of `pack`: [block, ..., lane] as [batch, ...], a copy."""
    rows = np.moveaxis(blocks, -1, 1)
    flat = rows.reshape(rows.shape[0] * rows.shape[1], *rows.shape[2:])
    return np.ascontiguousarray(flat[:batch])
