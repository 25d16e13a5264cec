"""The back end of a graphics card, which needs torch and Triton alone.

Every CUDA build of torch brings Triton. Benchmark, and comparison with the CPU: benchmarks/gpu.py.
"""

from collections.abc import Iterator
from contextlib import AbstractContextManager
from typing import Any

import torch
from torch import Tensor

from tmlattice.network import kernels
from tmlattice.network.autograd import Tensors
from tmlattice.network.reference import packed

CONFIGURATION: dict[str, dict[str, int]] = {
    "track": {"BLOCK": 256, "num_warps": 1},
    "readings": {"BLOCK": 64, "num_warps": 1},
    "states": {"BLOCK": 128, "num_warps": 1},
    "reverse": {"BLOCK": 64, "num_warps": 1},
    "sums": {"BLOCK": 32, "num_warps": 1, "PART": 8192},
}
"""Of each kernel: trajectories (at most) and warps of a program; trajectories of a partial sum.
Measured on one H100, docs/results/gpu.json."""


def _curved(w: Tensor) -> Tensor:
    """Whether the polynomials [layer, row, coefficient] have a second order, [layer]."""
    n = (round((8 * w.shape[-1] + 1) ** 0.5) - 3) // 2
    return (w[..., 1 + n :] != 0).flatten(1).any(dim=1).to(torch.int32)


def _ceil(count: int, size: int) -> int:
    return -(-count // size)


def _on(tensor: Tensor) -> AbstractContextManager[Any]:
    """Set the current device, on which Triton starts kernels."""
    return torch.cuda.device_of(tensor)  # type: ignore[no-untyped-call]


def _programs(states: Tensor, kernel: str) -> tuple[tuple[int], dict[str, int]]:
    """The grid and the constants for states [..., batch]: small programs if there are too few
    trajectories for the card's schedulers, four on each multiprocessor."""
    options = dict(CONFIGURATION[kernel])
    batch = states.shape[-1]
    while options["BLOCK"] > 32 and batch < 4 * multiprocessors(states) * options["BLOCK"]:
        options["BLOCK"] //= 2
    return (_ceil(batch, options["BLOCK"]),), options


def multiprocessors(tensor: Tensor) -> int:
    """Return how many the card of this tensor has."""
    return torch.cuda.get_device_properties(tensor.device).multi_processor_count


def track(launch: Tensor, w: Tensor, turns: int) -> Tensor:
    """Return states [batch, turns + 1, n] at the start of every turn, from launch [batch, n]
    (turns: at least 1)."""
    n = launch.shape[1]
    history = launch.new_empty(turns + 1, n, len(launch))
    history[0] = launch.T
    grid, options = _programs(history, "track")
    options.setdefault("UNROLL", max(options["BLOCK"] // 64, 1))  # layers in a row, as measured
    if missing := -len(w) % options["UNROLL"]:
        still = torch.eye(n, w.shape[2] - 1, dtype=w.dtype, device=w.device)
        still = torch.nn.functional.pad(still, (1, 0))  # an identity layer
        w = torch.cat([w, still.expand(missing, -1, -1)])
    curved = _curved(w)
    skip = bool(curved.sum() < 0.9 * len(w))
    with _on(w):
        kernels.track[grid](w, curved, history, turns, len(w), len(launch), n, SKIP=skip, **options)
    return history.permute(2, 0, 1)


class TritonSweep:
    """See `autograd.BackEnd`. The forward sweep stores nothing: the states are computed again, a
    part of the trajectories at a time, so that a quarter of the card's memory is enough for any
    batch."""

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
        for part in parts(launch, len(w)):
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
        grid, options = _programs(states, "states" if readings is None else "readings")
        with _on(w):
            kernels.forward[grid](
                w, curved, *self.read_outs, states, states if readings is None else readings,
                layers, len(self.r), states.shape[-1], n, KEEP=readings is None,
                READ=readings is not None, **options,
            )  # fmt: skip

    def reverse(
        self, w: Tensor, curved: Tensor, states: Tensor, pulls: Tensor, adjoint: Tensor
    ) -> None:
        """Fill adjoint [layer + 1, n, batch] from adjoint[-1] and pulls [batch, monitor, 2]; of one
        layer alone, it is replaced by that of the first."""
        layers, n, _ = w.shape
        grid, options = _programs(states, "reverse")
        with _on(w):
            kernels.reverse[grid](
                w, curved, *self.read_outs, states, pulls, *pulls.stride(), adjoint, layers,
                states.shape[-1], n, KEEP=len(adjoint) > 1, **options,
            )  # fmt: skip


def parts(launch: Tensor, layers: int) -> Iterator[slice]:
    """Equal parts of the trajectories, few enough for a quarter of the card's memory."""
    batch, n = launch.shape
    room = torch.cuda.get_device_properties(launch.device).total_memory // 4
    largest = max(room // (2 * (layers + 1) * n * launch.itemsize), 1)
    size = _ceil(batch, max(_ceil(batch, largest), 1))
    for first in range(0, batch, max(size, 1)):
        yield slice(first, min(first + size, batch))


def sums(states: Tensor, adjoint: Tensor) -> Tensor:
    """Return the gradient by the weights, [layer, n, 1 + n + n (n + 1) / 2]."""
    steps, n, batch = states.shape
    rows = 4 if n == 4 else 2  # as many sums as fit into registers
    parts = _ceil(batch, CONFIGURATION["sums"]["PART"])
    partial = states.new_empty(parts, steps - 1, n, (n + 1) * (n + 2) // 2)
    with _on(states):
        kernels.sums[(steps - 1, parts, n // rows)](
            states, adjoint, partial, steps - 1, batch, n, rows, **CONFIGURATION["sums"]
        )
    return partial.sum(dim=0)
