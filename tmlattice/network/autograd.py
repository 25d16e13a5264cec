"""The sweeps as one autograd function, so that any torch loss and optimiser works.

First derivatives come from the adjoint sweep of a back end: compiled for the CPU, or Triton kernels
for a graphics card. It costs about two forward sweeps, whatever the number of weights. Second
derivatives come from the plain torch loop: exact, and as slow as that loop.
"""

from typing import Any, Protocol

import torch
from torch import Tensor

from tmlattice.network.reference import plain_pass

Tensors = tuple[Tensor, ...]


class BackEnd(Protocol):
    """Implementation of the sweeps on a device.

    Attributes:
        r: read-outs [monitor, 2, 1 + n + n (n + 1) / 2], see `plain_pass`.
        start: the monitors at exit k are start[k] to start[k + 1] - 1, [layer + 2].
    """

    r: Tensor
    start: Tensor

    def forward(self, launch: Tensor, weights: Tensors) -> tuple[Tensor, Tensor, Tensor]:
        """Return readings [batch, monitor, 2], states behind the last layer [batch, n], and data
        for `backward`."""

    def backward(
        self, launch: Tensor, weights: Tensors, kept: Tensor, pulls: Tensors, wanted: bool
    ) -> tuple[Tensor, tuple[Tensor | None, ...]]:
        """Return gradients by the launch and, if wanted, by the weights, from those by the readings
        and by the last states."""


class Sweep(torch.autograd.Function):
    """(launch [batch, n], W0, W1, W2) -> readings [batch, monitor, 2], states behind the last
    layer [batch, n]."""

    @staticmethod
    def forward(  # type: ignore[override]
        launch: Tensor, W0: Tensor, W1: Tensor, W2: Tensor, back_end: BackEnd
    ) -> tuple[Tensor, Tensor, Tensor]:
        """One pass through all layers."""
        return back_end.forward(launch, (W0, W1, W2))

    @staticmethod
    def setup_context(ctx: Any, inputs: Any, output: Any) -> None:
        """Store the data for the gradient."""
        *tensors, ctx.back_end = inputs
        ctx.mark_non_differentiable(output[2])
        ctx.save_for_backward(*tensors, output[2])

    @staticmethod
    def backward(ctx: Any, pulls: Tensor, end: Tensor, _: Tensor) -> Any:  # type: ignore[override]
        """Gradients by the launch and all weights."""
        wanted = any(ctx.needs_input_grad[1:4])
        gradients = _Gradient.apply(  # type: ignore[no-untyped-call]
            pulls, end, *ctx.saved_tensors, ctx.back_end, wanted
        )
        return *gradients, None

    @staticmethod
    def vmap(*_: Any) -> Any:
        """Raise: a launch is a batch already."""
        raise NotImplementedError(
            "torch.func.vmap cannot batch a network: give it all launches at once, [batch, n], or "
            "use tmlattice.network.plain_readings, which is made of torch's own operations"
        )

    @staticmethod
    def jvp(*_: Any) -> Any:
        """Raise: the sweeps carry gradients backwards only."""
        raise NotImplementedError(
            "a network has no forward-mode derivative (jvp, jacfwd, hessian): use torch.func.vjp "
            "or torch.autograd, network.one_turn_map for matrices, or "
            "tmlattice.network.plain_readings, which is made of torch's own operations"
        )


class _Gradient(torch.autograd.Function):
    """The adjoint sweep, which can be differentiated once more."""

    @staticmethod
    def forward(pulls: Tensor, end: Tensor, *others: Any) -> Any:  # type: ignore[override]
        launch, W0, W1, W2, kept, back_end, wanted = others
        by_launch, by_weights = back_end.backward(launch, (W0, W1, W2), kept, (pulls, end), wanted)
        return by_launch, *by_weights

    @staticmethod
    def setup_context(ctx: Any, inputs: Any, output: Any) -> None:
        *tensors, _kept, ctx.back_end, _ = inputs
        ctx.save_for_backward(*tensors)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *pulls: Tensor | None) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        given = [tensor.detach().requires_grad_() for tensor in ctx.saved_tensors]
        back_end: BackEnd = ctx.back_end
        with torch.enable_grad():
            passed = plain_pass(given[2], given[3:], back_end.r, back_end.start)
            first = torch.autograd.grad(passed, given[2:], given[:2], create_graph=True)
            pairs = [(f, p) for f, p in zip(first, pulls, strict=True) if p is not None]
            total = sum(((f * p).sum() for f, p in pairs), torch.zeros((), dtype=torch.float64))
            second = torch.autograd.grad(total, given, allow_unused=True)
        return *second, None, None, None
