"""The sweeps on a graphics card, as Triton kernels: every CUDA build of torch brings Triton.

All coefficients of a layer lie together, `w` [layer, n, 1 + n + n (n + 1) / 2]: row a holds W0[a],
W1[a, :], W2[a, :]. Read-outs have the same form, `r` [monitor, 2, ...]. Trajectories are the last
axis, states [layer + 1, n, batch], so that neighbouring threads access neighbouring numbers. A
program carries `BLOCK` trajectories, several to a thread, in registers through all layers: one load
of a coefficient serves several of them. Sums over trajectories have one order and no atomic
additions, so that a result repeats bit by bit.

This module needs torch and Triton alone. Benchmark and comparison with the CPU: benchmarks/gpu.py.
"""

from collections.abc import Iterator
from contextlib import AbstractContextManager
from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor

from tmlattice.network.autograd import Tensors
from tmlattice.network.reference import packed

CONFIGURATION: dict[str, dict[str, int]] = {
    "track": {"BLOCK": 256, "num_warps": 1},
    "forward": {"BLOCK": 128, "num_warps": 1},
    "reverse": {"BLOCK": 64, "num_warps": 1},
    "sums": {"BLOCK": 32, "num_warps": 1, "PART": 8192},
}
"""Of each kernel: trajectories and warps of a program; trajectories of a partial sum."""


@triton.constexpr_function  # type: ignore[untyped-decorator]
def _pair(i: int, j: int, n: int) -> int:
    """Place of x_i x_j in the reduced Kronecker order."""
    i, j = min(i, j), max(i, j)
    return i * n - i * (i - 1) // 2 + j - i


@triton.jit
def _load(at, stride, n: tl.constexpr, inside):  # type: ignore[no-untyped-def]
    """n rows as a tuple; zeros outside. They stay out of the first cache: it is for weights."""
    x = ()
    for i in tl.static_range(n):
        x = x + (tl.load(at + i * stride, mask=inside, other=0.0, cache_modifier=".cg"),)
    return x


@triton.jit
def _store(at, stride, x, n: tl.constexpr, inside):  # type: ignore[no-untyped-def]
    for i in tl.static_range(n):
        tl.store(at + i * stride, x[i], mask=inside, cache_modifier=".cs")


@triton.jit
def _ahead(w, n: tl.constexpr):  # type: ignore[no-untyped-def]
    """One number of every cache line of the layer at w: all warps would wait for each line."""
    place = 8 * tl.arange(0, 32)
    return tl.load(w + place, mask=place < n * (n + 1) * (n + 2) // 2, other=0.0)


@triton.jit
def _polynomial(w, x, rows: tl.constexpr, second: tl.constexpr, n: tl.constexpr):  # type: ignore[no-untyped-def]
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
def _image(w, curved, x, rows: tl.constexpr, n: tl.constexpr):  # type: ignore[no-untyped-def]
    """The same; the second order is skipped where it is zero."""
    if curved != 0:
        y = _polynomial(w, x, rows, True, n)
    else:
        y = _polynomial(w, x, rows, False, n)
    return y


@triton.jit
def _slopes(w, x, up, rows: tl.constexpr, second: tl.constexpr, n: tl.constexpr):  # type: ignore[no-untyped-def]
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
def _pull(w, curved, x, up, rows: tl.constexpr, n: tl.constexpr):  # type: ignore[no-untyped-def]
    if curved != 0:
        down = _slopes(w, x, up, rows, True, n)
    else:
        down = _slopes(w, x, up, rows, False, n)
    return down


@triton.jit(do_not_specialize=["turns", "layers", "batch"])
def _track(w, curved, history, turns, layers, batch, n: tl.constexpr, BLOCK: tl.constexpr):  # type: ignore[no-untyped-def]
    """Fill history[1:] [turn, n, batch] from history[0]."""
    width: tl.constexpr = (n + 1) * (n + 2) // 2
    own = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = own < batch
    at = history + own
    x = _load(at, batch, n, inside)
    seen = tl.zeros([32], tl.float64)
    for _turn in range(turns):
        for k in range(layers):
            seen += _ahead(w + (k + 1) % layers * n * width, n)
            x = _image(w + k * n * width, tl.load(curved + k), x, n, n)
        at += n * batch
        _store(at, batch, x, n, inside)
    tl.store(history + tl.arange(0, 32), seen, mask=tl.arange(0, 32) < -turns)  # never


@triton.jit
def _read(r, bent, first, last, x, readings, batch, own, inside, n: tl.constexpr):  # type: ignore[no-untyped-def]
    """Readings of the monitors first to last - 1, that hang on one exit."""
    width: tl.constexpr = (n + 1) * (n + 2) // 2
    for m in range(first, last):
        y = _image(r + m * 2 * width, tl.load(bent + m), x, 2, n)
        at = readings + m * 2 * batch.to(tl.int64) + own
        _store(at, batch, y, 2, inside)


@triton.jit(do_not_specialize=["layers", "monitors", "batch"])
def _forward(  # type: ignore[no-untyped-def]
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
def _sense(  # type: ignore[no-untyped-def]
    r, bent, first, last, x, below, pulls, by_monitor, by_plane, inside, n: tl.constexpr
):
    """Add to d loss / d x what the monitors of one exit contribute."""
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
def _reverse(  # type: ignore[no-untyped-def]
    w, curved, r, bent, start, states, pulls, by_batch, by_monitor, by_plane, adjoint, layers, batch,
    n: tl.constexpr, KEEP: tl.constexpr, BLOCK: tl.constexpr,
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
        x_at -= n * batch
        entrance = _load(x_at, batch, n, inside & (k > 0))
        up = _pull(w + k * n * width, tl.load(curved + k), x, up, n, n)
        first = tl.load(start + k)
        last = tl.load(start + k + 1)  # not carried from the step before: Triton 3.6 loses it
        up = _sense(r, bent, first, last, x, up, pulls, by_monitor, by_plane, inside, n)
        if KEEP:
            at -= n * batch
            _store(at, batch, up, n, inside)
    if not KEEP:
        _store(at, batch, up, n, inside)
    tl.store(adjoint + tl.arange(0, 32), seen, mask=tl.arange(0, 32) < -layers)  # never


@triton.jit(do_not_specialize=["layers", "batch"])
def _sums(  # type: ignore[no-untyped-def]
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


def _curved(w: Tensor) -> Tensor:
    """Which polynomials [layer, row, coefficient] have a second order, [layer]."""
    n = (round((8 * w.shape[-1] + 1) ** 0.5) - 3) // 2
    return (w[..., 1 + n :] != 0).flatten(1).any(dim=1).to(torch.int32)


def _on(tensor: Tensor) -> AbstractContextManager[Any]:
    """Triton starts kernels on the current device."""
    return torch.cuda.device_of(tensor)


def _programs(batch: int, kernel: str) -> tuple[int]:
    return (triton.cdiv(batch, CONFIGURATION[kernel]["BLOCK"]),)


def track(launch: Tensor, w: Tensor, turns: int) -> Tensor:
    """States [batch, turns + 1, n] at the start of every turn, from launch [batch, n].

    Args:
        launch: on the card.
        w: all layers of the turn, as `reference.packed`.
        turns: at least 1.
    """
    layers, n, _ = w.shape
    batch = len(launch)
    history = launch.new_empty(turns + 1, n, batch)
    history[0] = launch.T
    with _on(w):
        _track[_programs(batch, "track")](
            w, _curved(w), history, turns, layers, batch, n, **CONFIGURATION["track"]
        )
    return history.permute(2, 0, 1)


class TritonSweep:
    """See `autograd.BackEnd`. Nothing is kept from the forward sweep: the states are found once
    more, a part of the trajectories at a time, so that a quarter of the card's memory is enough for
    any batch."""

    def __init__(self, r: Tensor, start: Tensor) -> None:
        self.r, self.start = r, start
        self.read_outs = r, _curved(r), start.to(torch.int32)

    def forward(self, launch: Tensor, weights: Tensors) -> tuple[Tensor, Tensor, Tensor]:
        """One pass through all layers."""
        w = packed(*weights)
        states = launch.T.clone(memory_format=torch.contiguous_format)
        readings = launch.new_empty(len(self.r), 2, len(launch))
        self.fill(w, _curved(w), states, readings)
        return readings.permute(2, 0, 1), states.T, launch.new_empty(0)

    def backward(
        self, launch: Tensor, weights: Tensors, kept: Tensor, pulls: Tensors, wanted: bool
    ) -> tuple[Tensor, tuple[Tensor | None, ...]]:
        """The adjoint sweep, then sums over trajectories."""
        w = packed(*weights)
        curved = _curved(w)
        by_launch = torch.empty_like(launch)
        total = torch.zeros_like(w)
        for part in _parts(launch, len(w)):
            states = launch.new_empty(len(w) + 1, launch.shape[1], part.stop - part.start)
            states[0] = launch[part].T
            self.fill(w, curved, states)
            adjoint = torch.empty_like(states) if wanted else torch.empty_like(states[-1:])
            adjoint[-1] = pulls[1][part].T
            self.reverse(w, curved, states, pulls[0][part], adjoint)
            by_launch[part] = adjoint[0].T
            if wanted:
                total += sums(states, adjoint)
        n = launch.shape[1]
        by_weights = total[..., 0], total[..., 1 : 1 + n], total[..., 1 + n :]
        return by_launch, by_weights if wanted else (None, None, None)

    def fill(
        self, w: Tensor, curved: Tensor, states: Tensor, readings: Tensor | None = None
    ) -> None:
        """Fill states [layer + 1, n, batch] from states[0]; or readings [monitor, 2, batch], and
        replace states [n, batch] by the last ones."""
        layers, n, _ = w.shape
        batch = states.shape[-1]
        with _on(w):
            _forward[_programs(batch, "forward")](
                w, curved, *self.read_outs, states, states if readings is None else readings,
                layers, len(self.r), batch, n, KEEP=readings is None, READ=readings is not None,
                **CONFIGURATION["forward"],
            )  # fmt: skip

    def reverse(
        self, w: Tensor, curved: Tensor, states: Tensor, pulls: Tensor, adjoint: Tensor
    ) -> None:
        """Fill adjoint [layer + 1, n, batch] from adjoint[-1] and pulls [batch, monitor, 2]; of one
        layer alone, it is replaced by that of the first."""
        layers, n, _ = w.shape
        batch = states.shape[-1]
        with _on(w):
            _reverse[_programs(batch, "reverse")](
                w, curved, *self.read_outs, states, pulls, *pulls.stride(), adjoint, layers, batch,
                n, KEEP=len(adjoint) > 1, **CONFIGURATION["reverse"],
            )  # fmt: skip


def _parts(launch: Tensor, layers: int) -> Iterator[slice]:
    """Equal parts of the trajectories, few enough for a quarter of the card's memory."""
    batch, n = launch.shape
    room = torch.cuda.get_device_properties(launch.device).total_memory // 4
    largest = max(room // (2 * (layers + 1) * n * launch.itemsize), 1)
    size = triton.cdiv(batch, triton.cdiv(batch, largest))
    for first in range(0, batch, size):
        yield slice(first, min(first + size, batch))


def sums(states: Tensor, adjoint: Tensor) -> Tensor:
    """The gradient by the weights, [layer, n, 1 + n + n (n + 1) / 2]."""
    steps, n, batch = states.shape
    rows = 4 if n == 4 else 2  # as many sums as registers hold
    parts = triton.cdiv(batch, CONFIGURATION["sums"]["PART"])
    partial = states.new_empty(parts, steps - 1, n, (n + 1) * (n + 2) // 2)
    with _on(states):
        _sums[(steps - 1, parts, n // rows)](
            states, adjoint, partial, steps - 1, batch, n, rows, **CONFIGURATION["sums"]
        )
    return partial.sum(dim=0)
