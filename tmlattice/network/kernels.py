"""The sweeps as Triton kernels for a graphics card, in n coordinates.

All coefficients of a layer lie together, `w` [layer, n, 1 + n + n (n + 1) / 2]: row a holds W0[a],
W1[a, :], W2[a, :]. Read-outs have the same form, `r` [monitor, 2, ...]. Trajectories are the last
axis, states [layer + 1, n, batch], so that neighbouring threads access neighbouring numbers. A
program carries `BLOCK` trajectories, several to a thread, in registers through all layers: one load
of a coefficient serves several of them. Sums over trajectories have one order and no atomic
additions, so that a result repeats bit by bit.

Where `curved` (of a read-out: `bent`) is zero the second order is skipped. The dimension and BLOCK
are compile-time constants: loops over coordinates are unrolled.
"""

import triton
import triton.language as tl


@triton.constexpr_function
def _pair(i: int, j: int, n: int) -> int:
    """Index of x_i x_j in the reduced Kronecker order."""
    i, j = min(i, j), max(i, j)
    return i * n - i * (i - 1) // 2 + j - i


@triton.jit
def _load(at, stride, n: tl.constexpr, inside):
    """Load n rows as a tuple; zeros outside. They bypass the first cache, which is for weights."""
    x = ()
    for i in tl.static_range(n):
        x = x + (tl.load(at + i * stride, mask=inside, other=0.0, cache_modifier=".cg"),)
    return x


@triton.jit
def _store(at, stride, x, n: tl.constexpr, inside):
    for i in tl.static_range(n):
        tl.store(at + i * stride, x[i], mask=inside, cache_modifier=".cs")


@triton.jit
def _ahead(w, n: tl.constexpr):
    """Load one number of every cache line of the layer at w: all warps would wait for each."""
    place = 8 * tl.arange(0, 32)
    return tl.load(w + place, mask=place < n * (n + 1) * (n + 2) // 2, other=0.0)


@triton.jit
def _polynomial(w, x, rows: tl.constexpr, second: tl.constexpr, n: tl.constexpr):
    """The rows of a polynomial at x, in Horner's form."""
    width: tl.constexpr = (n + 1) * (n + 2) // 2
    y = ()
    for a in tl.static_range(rows):
        row = w + a * width
        total = tl.load(row)
        for i in tl.static_range(n):
            slope = tl.load(row + 1 + i)
            if second:
                for j in tl.static_range(i, n):
                    slope += tl.load(row + 1 + n + _pair(i, j, n)) * x[j]
            total += slope * x[i]
        y = y + (total,)
    return y


@triton.jit
def _image(w, curved, x, rows: tl.constexpr, n: tl.constexpr):
    """The same; the second order is skipped where it is zero."""
    if curved != 0:
        y = _polynomial(w, x, rows, True, n)
    else:
        y = _polynomial(w, x, rows, False, n)
    return y


@triton.jit
def _slopes(w, x, up, rows: tl.constexpr, second: tl.constexpr, n: tl.constexpr):
    """J(x)^T up of a polynomial."""
    width: tl.constexpr = (n + 1) * (n + 2) // 2
    bends = ()
    if second:
        for m in tl.static_range(1 + n, width):
            bend = tl.load(w + m) * up[0]
            for a in tl.static_range(1, rows):
                bend += tl.load(w + a * width + m) * up[a]
            bends = bends + (bend,)
    down = ()
    for i in tl.static_range(n):
        total = tl.load(w + 1 + i) * up[0]
        for a in tl.static_range(1, rows):
            total += tl.load(w + a * width + 1 + i) * up[a]
        if second:
            for j in tl.static_range(n):
                bend = bends[_pair(i, j, n)]
                total += (bend + bend if i == j else bend) * x[j]
        down = down + (total,)
    return down


@triton.jit
def _pull(w, curved, x, up, rows: tl.constexpr, n: tl.constexpr):
    if curved != 0:
        down = _slopes(w, x, up, rows, True, n)
    else:
        down = _slopes(w, x, up, rows, False, n)
    return down


@triton.jit(do_not_specialize=["turns", "layers", "batch"])
def track(
    w, curved, history, turns, layers, batch, n: tl.constexpr, SKIP: tl.constexpr,
    UNROLL: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Fill history[1:] [turn, n, batch] from history[0]; the layers are a multiple of UNROLL, and
    `curved` is read only with SKIP."""
    width: tl.constexpr = (n + 1) * (n + 2) // 2
    own = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = own < batch
    at = history + own
    x = _load(at, batch, n, inside)
    seen = tl.zeros([32], tl.float64)
    for _turn in range(turns):
        for first in range(0, layers, UNROLL):
            for k in tl.static_range(UNROLL):
                here = w + (first + k) * n * width
                seen += _ahead(w + (first + k + 1) % layers * n * width, n)
                if SKIP:
                    x = _image(here, tl.load(curved + first + k), x, n, n)
                else:
                    x = _polynomial(here, x, n, True, n)
        at += n * batch
        _store(at, batch, x, n, inside)
    tl.store(history + tl.arange(0, 32), seen, mask=tl.arange(0, 32) < -turns)  # never


@triton.jit
def _read(r, bent, first, last, x, readings, batch, own, inside, n: tl.constexpr):
    """Return readings of the monitors first to last - 1, at one exit."""
    width: tl.constexpr = (n + 1) * (n + 2) // 2
    for m in range(first, last):
        y = _image(r + m * 2 * width, tl.load(bent + m), x, 2, n)
        at = readings + m * 2 * batch.to(tl.int64) + own
        _store(at, batch, y, 2, inside)


@triton.jit(do_not_specialize=["layers", "monitors", "batch"])
def forward(
    w, curved, r, bent, start, states, readings, layers, monitors, batch,
    n: tl.constexpr, KEEP: tl.constexpr, READ: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Readings [monitor, 2, batch] of one pass from states[0]; fill states[1:] [layer + 1, n,
    batch] (KEEP), or replace states[0] by the last of them."""
    width: tl.constexpr = (n + 1) * (n + 2) // 2
    own = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = own < batch
    at = states + own
    x = _load(at, batch, n, inside)
    seen = tl.zeros([32], tl.float64)
    for k in range(layers):
        seen += _ahead(w + (k + 1) % layers * n * width, n)
        if READ:
            first = tl.load(start + k)
            last = tl.load(start + k + 1)
            _read(r, bent, first, last, x, readings, batch, own, inside, n)
        x = _image(w + k * n * width, tl.load(curved + k), x, n, n)
        if KEEP:
            at += n * batch
            _store(at, batch, x, n, inside)
    if READ:
        first = tl.load(start + layers)
        _read(r, bent, first, monitors, x, readings, batch, own, inside, n)
    if not KEEP:
        _store(at, batch, x, n, inside)
    tl.store(states + tl.arange(0, 32), seen, mask=tl.arange(0, 32) < -layers)  # never


@triton.jit
def _sense(r, bent, first, last, x, below, pulls, by_monitor, by_plane, inside, n: tl.constexpr):
    """Add the contribution of the monitors at one exit to d loss / d x."""
    width: tl.constexpr = (n + 1) * (n + 2) // 2
    for m in range(first, last):
        up = _load(pulls + m * by_monitor.to(tl.int64), by_plane, 2, inside)
        added = _pull(r + m * 2 * width, tl.load(bent + m), x, up, 2, n)
        total = ()
        for i in tl.static_range(n):
            total = total + (below[i] + added[i],)
        below = total
    return below


@triton.jit(do_not_specialize=["by_batch", "by_monitor", "by_plane", "layers", "batch"])
def reverse(
    w, curved, r, bent, start, states, pulls, by_batch, by_monitor, by_plane, adjoint, layers,
    batch, n: tl.constexpr, KEEP: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Fill adjoint[:-1] [layer + 1, n, batch] = d loss / d states from adjoint[-1], of the states
    behind the last layer, and from pulls [batch, monitor, 2]; or (not KEEP) replace adjoint [n,
    batch] of the last states by that of the first."""
    width: tl.constexpr = (n + 1) * (n + 2) // 2
    own = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = own < batch
    x_at = states + layers.to(tl.int64) * n * batch + own
    at = adjoint + own
    if KEEP:
        at += layers.to(tl.int64) * n * batch
    last = tl.load(start + layers + 1)
    first = tl.load(start + layers)
    up = _load(at, batch, n, inside)
    x = _load(x_at, batch, n, inside)
    pulls += own.to(tl.int64) * by_batch
    up = _sense(r, bent, first, last, x, up, pulls, by_monitor, by_plane, inside, n)
    if KEEP:
        _store(at, batch, up, n, inside)
    seen = tl.zeros([32], tl.float64)
    x_at -= n * batch
    entrance = _load(x_at, batch, n, inside)
    for back in range(layers):
        k = layers - 1 - back
        seen += _ahead(w + tl.maximum(k - 1, 0) * n * width, n)
        x = entrance
        x_at -= tl.minimum(k, 1) * n * batch  # of the layer before, early enough
        entrance = _load(x_at, batch, n, inside)
        up = _pull(w + k * n * width, tl.load(curved + k), x, up, n, n)
        first = tl.load(start + k)
        last = tl.load(start + k + 1)  # not carried from the previous step: Triton 3.6 loses it
        up = _sense(r, bent, first, last, x, up, pulls, by_monitor, by_plane, inside, n)
        if KEEP:
            at -= n * batch
            _store(at, batch, up, n, inside)
    if not KEEP:
        _store(at, batch, up, n, inside)
    tl.store(adjoint + tl.arange(0, 32), seen, mask=tl.arange(0, 32) < -layers)  # never


@triton.jit(do_not_specialize=["layers", "batch"])
def sums(
    states, adjoint, sums, layers, batch,
    n: tl.constexpr, ROWS: tl.constexpr, PART: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Fill sums [part, layer, n, 1 + n + n (n + 1) / 2]: adjoint at a layer's exit times the
    monomials at its entrance, summed over the trajectories of a part."""
    width: tl.constexpr = (n + 1) * (n + 2) // 2
    k = tl.program_id(0)
    part = tl.program_id(1)
    row = tl.program_id(2) * ROWS
    x_at = states + k.to(tl.int64) * n * batch
    up_at = adjoint + ((k + 1).to(tl.int64) * n + row) * batch
    total = ()
    for _ in tl.static_range(ROWS * width):
        total = total + (tl.zeros([BLOCK], tl.float64),)
    for first in range(part * PART, tl.minimum((part + 1) * PART, batch), BLOCK):
        own = first + tl.arange(0, BLOCK)
        inside = own < batch
        x = _load(x_at + own, batch, n, inside)
        up = _load(up_at + own, batch, ROWS, inside)
        new = ()
        for a in tl.static_range(ROWS):
            new = new + (total[a * width] + up[a],)
            for i in tl.static_range(n):
                new = new + (total[a * width + 1 + i] + up[a] * x[i],)
            for i in tl.static_range(n):
                kick = up[a] * x[i]
                for j in tl.static_range(i, n):
                    new = new + (total[a * width + 1 + n + _pair(i, j, n)] + kick * x[j],)
        total = new
    at = sums + (part.to(tl.int64) * layers + k) * n * width + row * width
    for m in tl.static_range(ROWS * width):
        tl.store(at + m, tl.sum(total[m], 0))
