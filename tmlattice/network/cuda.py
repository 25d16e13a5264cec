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
from typing import Any, NamedTuple

import torch
import triton
import triton.language as tl
from torch import Tensor

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
    """n rows as a tuple; zeros outside."""
    x = ()
    for i in tl.static_range(n):
        x = x + (tl.load(at + i * stride, mask=inside, other=0.0),)
    return x


@triton.jit
def _store(at, stride, x, n: tl.constexpr, inside):  # type: ignore[no-untyped-def]
    for i in tl.static_range(n):
        tl.store(at + i * stride, x[i], mask=inside)


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
    for _turn in range(turns):
        layer = w
        for k in range(layers):
            x = _image(layer, tl.load(curved + k), x, n, n)
            layer += n * width
        at += n * batch
        _store(at, batch, x, n, inside)


@triton.jit
def _read(r, bent, first, last, x, readings, monitors, own, inside, n: tl.constexpr):  # type: ignore[no-untyped-def]
    """Readings of the monitors first to last - 1, that hang on one exit."""
    width: tl.constexpr = (n + 1) * (n + 2) // 2
    for m in range(first, last):
        y = _image(r + m * 2 * width, tl.load(bent + m), x, 2, n)
        at = readings + (own.to(tl.int64) * monitors + m) * 2
        tl.store(at, y[0], mask=inside)
        tl.store(at + 1, y[1], mask=inside)


@triton.jit(do_not_specialize=["layers", "monitors", "batch"])
def _forward(  # type: ignore[no-untyped-def]
    w, curved, r, bent, start, states, readings, layers, monitors, batch,
    n: tl.constexpr, KEEP: tl.constexpr, READ: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Readings [batch, monitor, 2] of one pass from states[0]; fill states[1:] [layer + 1, n,
    batch] (KEEP), or replace states[0] by the last of them."""
    width: tl.constexpr = (n + 1) * (n + 2) // 2
    own = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = own < batch
    at = states + own
    x = _load(at, batch, n, inside)
    first = tl.load(start)
    for k in range(layers):
        if READ:
            last = tl.load(start + k + 1)
            _read(r, bent, first, last, x, readings, monitors, own, inside, n)
            first = last
        x = _image(w, tl.load(curved + k), x, n, n)
        w += n * width
        if KEEP:
            at += n * batch
            _store(at, batch, x, n, inside)
    if READ:
        _read(r, bent, first, monitors, x, readings, monitors, own, inside, n)
    if not KEEP:
        _store(at, batch, x, n, inside)


@triton.jit
def _sense(r, bent, first, last, x, below, pulls, strides, own, inside, n: tl.constexpr):  # type: ignore[no-untyped-def]
    """Add to d loss / d x what the monitors of one exit contribute."""
    width: tl.constexpr = (n + 1) * (n + 2) // 2
    for m in range(first, last):
        at = pulls + own.to(tl.int64) * strides[0] + m * strides[1]
        here = tl.load(at, mask=inside, other=0.0)
        up = (here, tl.load(at + strides[2], mask=inside, other=0.0))
        added = _pull(r + m * 2 * width, tl.load(bent + m), x, up, 2, n)
        total = ()
        for i in tl.static_range(n):
            total = total + (below[i] + added[i],)
        below = total
    return below


@triton.jit(do_not_specialize=["layers", "batch"])
def _reverse(  # type: ignore[no-untyped-def]
    w, curved, r, bent, start, states, pulls, strides, adjoint, layers, batch,
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
    w += layers * n * width
    last = tl.load(start + layers + 1)
    first = tl.load(start + layers)
    up = _load(at, batch, n, inside)
    x = _load(x_at, batch, n, inside)
    up = _sense(r, bent, first, last, x, up, pulls, strides, own, inside, n)
    if KEEP:
        _store(at, batch, up, n, inside)
    for back in range(layers):
        k = layers - 1 - back
        w -= n * width
        x_at -= n * batch
        x = _load(x_at, batch, n, inside)
        up = _pull(w, tl.load(curved + k), x, up, n, n)
        last = first
        first = tl.load(start + k)
        up = _sense(r, bent, first, last, x, up, pulls, strides, own, inside, n)
        if KEEP:
            at -= n * batch
            _store(at, batch, up, n, inside)
    if not KEEP:
        _store(at, batch, up, n, inside)


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


class ReadOuts(NamedTuple):
    """The monitors of a ring: r [monitor, 2, 1 + n + n (n + 1) / 2]; bent [monitor], whether it has
    a second order; start [layer + 2], see `RingMaps`."""

    r: Tensor
    bent: Tensor
    start: Tensor


def packed(W0: Tensor, W1: Tensor, W2: Tensor) -> Tensor:
    """Coefficients of polynomials side by side, [..., row, 1 + n + n (n + 1) / 2]."""
    return torch.cat([W0[..., None], W1, W2], dim=-1)


def unpacked(w: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The inverse of `packed`."""
    n = w.shape[1]
    return w[..., 0], w[..., 1 : 1 + n], w[..., 1 + n :]


def read_outs(R: tuple[Tensor, Tensor, Tensor], start: Tensor) -> ReadOuts:
    """Of R0 [monitor, 2], R1 [monitor, 2, n], R2 [monitor, 2, n (n + 1) / 2] on the card."""
    return ReadOuts(packed(*R), _curved(R[2]), start.to(torch.int32))


def _curved(W2: Tensor) -> Tensor:
    return (W2 != 0).flatten(1).any(dim=1).to(torch.int32)


def _on(tensor: Tensor) -> AbstractContextManager[Any]:
    return torch.cuda.device_of(tensor)


def _programs(batch: int, kernel: str) -> tuple[int]:
    return (triton.cdiv(batch, CONFIGURATION[kernel]["BLOCK"]),)


def _rows(launch: Tensor) -> Tensor:
    """[batch, n] as [n, batch], a copy."""
    return launch.detach().T.clone(memory_format=torch.contiguous_format)


def track(launch: Tensor, w: Tensor, turns: int) -> Tensor:
    """States [batch, turns + 1, n] at the start of every turn, from launch [batch, n]."""
    layers, n, _ = w.shape
    batch = len(launch)
    history = launch.new_empty(turns + 1, n, batch)
    history[0] = launch.T
    with _on(w):
        _track[_programs(batch, "track")](
            w, _curved(unpacked(w)[2]), history, turns, layers, batch, n, **CONFIGURATION["track"]
        )
    return history.permute(2, 0, 1)


def forward(launch: Tensor, w: Tensor, monitors: ReadOuts) -> tuple[Tensor, Tensor]:
    """Readings [batch, monitor, 2] of one pass, and the states behind the last layer [batch, n]."""
    states = _rows(launch)
    readings = launch.new_empty(len(launch), len(monitors.r), 2)
    _pass(w, _curved(unpacked(w)[2]), monitors, states, readings)
    return readings, states.T


def _pass(
    w: Tensor, curved: Tensor, monitors: ReadOuts, states: Tensor, readings: Tensor | None
) -> None:
    layers, n, _ = w.shape
    batch = states.shape[-1]
    with _on(w):
        _forward[_programs(batch, "forward")](
            w, curved, *monitors, states, states if readings is None else readings, layers,
            len(monitors.r), batch, n, KEEP=states.ndim == 3, READ=readings is not None,
            **CONFIGURATION["forward"],
        )  # fmt: skip


def backward(
    launch: Tensor, w: Tensor, monitors: ReadOuts, pulls: Tensor, end: Tensor, weights: bool
) -> tuple[Tensor, Tensor | None]:
    """Gradients by the launch [batch, n] and, if asked for, by w.

    States are found once more, a part of the trajectories at a time, rather than kept: a fraction
    `MEMORY` of the card holds them and the adjoint states, whatever the batch.

    Args:
        launch, w, monitors: of `forward`.
        pulls: d loss / d readings, [batch, monitor, 2].
        end: d loss / d states behind the last layer, [batch, n].
        weights: whether the gradient by w is wanted.
    """
    gradient = torch.empty_like(launch)
    total = torch.zeros_like(w) if weights else None
    curved = _curved(unpacked(w)[2])
    for part in _parts(launch, len(w)):
        states = launch.new_empty(len(w) + 1, launch.shape[1], part.stop - part.start)
        states[0] = launch[part].T
        _pass(w, curved, monitors, states, None)
        adjoint = torch.empty_like(states) if weights else states.new_empty(states.shape[1:])
        (adjoint[-1] if weights else adjoint).copy_(end[part].T)
        _back(w, curved, monitors, states, pulls[part], adjoint)
        gradient[part] = (adjoint[0] if weights else adjoint).T
        if total is not None:
            total += _weights(states, adjoint)
    return gradient, total


MEMORY = 0.25


def _parts(launch: Tensor, layers: int) -> Iterator[slice]:
    """Equal parts of the trajectories, few enough for the card's memory."""
    batch, n = launch.shape
    room = MEMORY * torch.cuda.get_device_properties(launch.device).total_memory
    largest = max(int(room / (2 * (layers + 1) * n * 8)), 1)
    size = triton.cdiv(batch, max(triton.cdiv(batch, largest), 1))
    for first in range(0, batch, size):
        yield slice(first, min(first + size, batch))


def _back(
    w: Tensor, curved: Tensor, monitors: ReadOuts, states: Tensor, pulls: Tensor, adjoint: Tensor
) -> None:
    layers, n, _ = w.shape
    batch = states.shape[-1]
    with _on(w):
        _reverse[_programs(batch, "reverse")](
            w, curved, *monitors, states, pulls, pulls.stride(), adjoint, layers, batch, n,
            KEEP=adjoint.ndim == 3, **CONFIGURATION["reverse"],
        )  # fmt: skip


def _weights(states: Tensor, adjoint: Tensor) -> Tensor:
    """The gradient by w, [layer, n, 1 + n + n (n + 1) / 2]."""
    steps, n, batch = states.shape
    rows = 4 if n == 4 else 2  # as many sums as registers hold
    parts = triton.cdiv(batch, CONFIGURATION["sums"]["PART"])
    sums = states.new_empty(parts, steps - 1, n, (n + 1) * (n + 2) // 2)
    with _on(states):
        _sums[(steps - 1, parts, n // rows)](
            states, adjoint, sums, steps - 1, batch, n, rows, **CONFIGURATION["sums"]
        )
    return sums.sum(dim=0)


def symplectic_coefficients(W1: Tensor, W2: Tensor, form: Tensor) -> Tensor:
    """`tmlattice.network.symplectic.symplectic_coefficients` in torch's own operations,
    differentiable; `form` is the matrix S [n, n]."""
    layers, n, _ = W1.shape
    i, j = torch.triu_indices(n, n, device=W1.device)
    second = W2.new_zeros(layers, n, n, n)
    second[:, :, i, j] = W2
    second = second + second.mT
    G = torch.cat([W1[:, :, None], second], dim=2).flatten(2)  # [layer, image, (u, b)]
    M = (G.mT @ (form @ G)).unflatten(2, (n + 1, n)).unflatten(1, (n + 1, n))  # [layer, u, b, v, c]
    M = M + M.permute(0, 3, 2, 1, 4)
    u, v = torch.triu_indices(n + 1, n + 1, device=W1.device)
    b, c = torch.triu_indices(n, n, 1, device=W1.device)
    M = M[:, u[:, None], b, v[:, None], c] * torch.where(u == v, 0.5, 1.0)[:, None].to(M)
    constant = torch.zeros_like(M[0])
    constant[0] = form[b, c]
    return M - constant


def penalty_parts(W1: Tensor, W2: Tensor, form: Tensor, design: Tensor | None = None) -> Tensor:
    """Sums of squares of these coefficients by degree, [layer, 3], less those of a `design`."""
    n = W1.shape[1]
    M = symplectic_coefficients(W1, W2, form)
    squares = (M if design is None else M - design).square().sum(dim=2)
    return torch.stack(
        [squares[:, 0], squares[:, 1 : n + 1].sum(dim=1), squares[:, n + 1 :].sum(dim=1)], dim=1
    )
