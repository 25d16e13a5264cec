"""The network and its penalty in torch's own operations, differentiable to any order: the reference
of the compiled sweeps. The loop over layers is slow; the penalty has no loop and is also used on a
graphics card."""

from collections.abc import Sequence

import torch
from torch import Tensor


def packed(W0: Tensor, W1: Tensor, W2: Tensor) -> Tensor:
    """Return coefficients of polynomials side by side, [..., row, 1 + n + n (n + 1) / 2]."""
    return torch.cat([W0[..., None], W1, W2], dim=-1)


def monomials(x: Tensor) -> Tensor:
    """Return 1, x_i, x_i x_j (i <= j) of states [batch, n], [batch, 1 + n + n (n + 1) / 2]."""
    i, j = torch.triu_indices(x.shape[1], x.shape[1], device=x.device)
    return torch.cat([torch.ones_like(x[:, :1]), x, x[:, i] * x[:, j]], dim=1)


def plain_pass(
    launch: Tensor, weights: Sequence[Tensor], r: Tensor, start: Tensor
) -> tuple[Tensor, Tensor]:
    """Return readings [batch, monitor, 2] and the states behind the last layer [batch, n].

    Args:
        launch: [batch, n].
        weights: W0 [layer, n], W1 [layer, n, n], W2 [layer, n, n (n + 1) / 2].
        r: read-outs, as `packed`, [monitor, 2, 1 + n + n (n + 1) / 2].
        start: the monitors at exit k are start[k] to start[k + 1] - 1, [layer + 2].
    """
    first = [int(m) for m in start]
    w = packed(*weights)
    readings, state = [], launch
    for k in range(len(w) + 1):
        terms = monomials(state)
        readings += [terms @ r[m].mT for m in range(first[k], first[k + 1])]
        if k < len(w):
            state = terms @ w[k].mT
    return torch.stack(readings, dim=1), state


def plain_coefficients(W1: Tensor, W2: Tensor, form: Tensor) -> Tensor:
    """Return `symplectic_coefficients` [layer, pair, entry], differentiable; form: S [n, n]."""
    layers, n, _ = W1.shape
    i, j = torch.triu_indices(n, n, device=W1.device)
    second = W2.new_zeros(layers, n, n, n)
    second[:, :, i, j] = W2
    second = second + second.mT
    G = torch.cat([W1[:, :, None], second], dim=2).flatten(2)  # [layer, image, (u, b)]
    M = (G.mT @ (form @ G)).reshape(layers, n + 1, n, n + 1, n)
    M = M + M.permute(0, 3, 2, 1, 4)  # [layer, u, b, v, c]
    u, v = torch.triu_indices(n + 1, n + 1, device=W1.device)
    b, c = torch.triu_indices(n, n, 1, device=W1.device)
    M = M[:, u[:, None], b, v[:, None], c] * torch.where(u == v, 0.5, 1.0)[:, None].to(M)
    constant = torch.zeros_like(M[0])
    constant[0] = form[b, c]
    difference: Tensor = M - constant
    return difference


def plain_penalty_parts(
    W1: Tensor, W2: Tensor, form: Tensor, design: Tensor | None = None
) -> Tensor:
    """Return `penalty_parts` [layer, 3]; form: S [n, n]."""
    n = W1.shape[1]
    M = plain_coefficients(W1, W2, form)
    squares = (M if design is None else M - design).square().sum(dim=2)
    degrees = squares[:, :1], squares[:, 1 : n + 1], squares[:, n + 1 :]
    return torch.stack([own.sum(dim=1) for own in degrees], dim=1)
