"""Symplectic defect of layers, as a differentiable penalty.

The Jacobian of a second-order layer is linear in the state, J(x) = G_0 + sum_i x_i G_i with
G_0 = W1 and G_i = d2 (image) / dx dx_i. So J(x)^T S J(x) - S is a quadratic polynomial in x, its
coefficients M_uv (u <= v in 0, ..., n) come from pairs of these matrices, and it is antisymmetric:
its strictly upper triangle is sufficient. The penalty is the sum of the squares of these
coefficients. In one plane they are the five equations of the paper and a sixth, the coefficient
of x^2, which the paper omits; the factors are 1, 1, 1, 2, 4, 2.

Source: A. Ivanov, U. Iben, A. Golovkina, physics-based polynomial neural networks for one-shot
learning of dynamical systems, for the penalty in one plane.
"""

from typing import Any

import numpy as np
import torch
from torch import Tensor

from tmlattice.arrays import Array
from tmlattice.beam.threads import share
from tmlattice.compiled import jit
from tmlattice.maps.taylor import symplectic_form
from tmlattice.network.reference import plain_penalty_parts

_LANES = 32  # layers side by side: their matrices together stay in the first cache


@jit
def _gather(size, first, count, W1, W2, G):  # type: ignore[no-untyped-def]
    """G [n + 1, n, n, lane] of the layers first to first + count - 1; zeros beyond."""
    n = len(size)
    G[:] = 0.0
    for lane in range(count):
        k = first + lane
        for a in range(n):
            m = 0
            for i in range(n):
                G[0, a, i, lane] = W1[k, a, i]
                for j in range(i, n):
                    w = W2[k, a, m]
                    G[1 + i, a, j, lane] += w
                    G[1 + j, a, i, lane] += w
                    m += 1


@jit
def _coefficient(size, signs, G, u, v, first, count, design, M):  # type: ignore[no-untyped-def]
    """M [b, c, lane], b < c: the coefficient of x_u x_v (x_0 = 1) in J^T S J - S, less that of a
    design, if given (an array with layers)."""
    n = len(size)
    entry = 0
    pair = u * (n + 1) - u * (u - 1) // 2 + v - u
    for b in range(n):
        for c in range(b + 1, n):
            row = M[b, c]
            start = -signs[b // 2] if u == v == 0 and b % 2 == 0 and c == b + 1 else 0.0
            for lane in range(_LANES):
                row[lane] = start
            for p in range(n // 2):
                sign = signs[p]
                ub, uc = G[u, 2 * p, b], G[u, 2 * p, c]
                ub_, uc_ = G[u, 2 * p + 1, b], G[u, 2 * p + 1, c]
                vb, vc = G[v, 2 * p, b], G[v, 2 * p, c]
                vb_, vc_ = G[v, 2 * p + 1, b], G[v, 2 * p + 1, c]
                if u == v:
                    for lane in range(_LANES):
                        row[lane] += sign * (ub[lane] * vc_[lane] - ub_[lane] * vc[lane])
                else:
                    for lane in range(_LANES):
                        row[lane] += sign * (
                            ub[lane] * vc_[lane]
                            - ub_[lane] * vc[lane]
                            + vb[lane] * uc_[lane]
                            - vb_[lane] * uc[lane]
                        )
            for lane in range(min(count, design.shape[0])):
                row[lane] -= design[first + lane, pair, entry]
            entry += 1


@jit
def _coefficients(size, signs, W1, W2, design, out):  # type: ignore[no-untyped-def]
    """Fill out [layer, pair (u, v), entry (b < c)]."""
    n = len(size)
    G = np.empty((n + 1, n, n, _LANES))
    M = np.empty((n, n, _LANES))
    for first in range(0, W1.shape[0], _LANES):
        count = min(_LANES, W1.shape[0] - first)
        _gather(size, first, count, W1, W2, G)
        pair = 0
        for u in range(n + 1):
            for v in range(u, n + 1):
                _coefficient(size, signs, G, u, v, first, count, design, M)
                entry = 0
                for b in range(n):
                    for c in range(b + 1, n):
                        for lane in range(count):
                            out[first + lane, pair, entry] = M[b, c, lane]
                        entry += 1
                pair += 1


@jit
def _squares(first_tile, last_tile, size, signs, W1, W2, design, parts):  # type: ignore[no-untyped-def]
    """Fill parts [layer, degree]: sums of squares of the coefficients by degree 0, 1, 2."""
    n = len(size)
    G = np.empty((n + 1, n, n, _LANES))
    M = np.empty((n, n, _LANES))
    sums = np.empty((3, _LANES))
    for first in range(first_tile * _LANES, last_tile * _LANES, _LANES):
        count = min(_LANES, W1.shape[0] - first)
        _gather(size, first, count, W1, W2, G)
        sums[:] = 0.0
        for u in range(n + 1):
            for v in range(u, n + 1):
                _coefficient(size, signs, G, u, v, first, count, design, M)
                total = sums[(u > 0) + (v > 0)]
                for b in range(n):
                    for c in range(b + 1, n):
                        row = M[b, c]
                        for lane in range(_LANES):
                            total[lane] += row[lane] * row[lane]
        for lane in range(count):
            for degree in range(3):
                parts[first + lane, degree] = sums[degree, lane]


@jit
def _pull(first_tile, last_tile, size, signs, W1, W2, design, pulls, g1, g2):  # type: ignore[no-untyped-def]
    """Carry d loss / d parts, pulls [layer, degree], back to g1, g2 (added)."""
    n = len(size)
    G = np.empty((n + 1, n, n, _LANES))
    D = np.empty((n + 1, n, n, _LANES))
    M = np.zeros((n, n, _LANES))
    twice = np.zeros((3, _LANES))
    for first in range(first_tile * _LANES, last_tile * _LANES, _LANES):
        count = min(_LANES, W1.shape[0] - first)
        _gather(size, first, count, W1, W2, G)
        D[:] = 0.0
        twice[:] = 0.0
        for lane in range(count):
            for degree in range(3):
                twice[degree, lane] = 2.0 * pulls[first + lane, degree]
        for u in range(n + 1):
            for v in range(u, n + 1):
                _coefficient(size, signs, G, u, v, first, count, design, M)
                scale = twice[(u > 0) + (v > 0)]
                for b in range(n):  # M is antisymmetric: its adjoint is one product
                    for c in range(b + 1, n):
                        upper, lower = M[b, c], M[c, b]
                        for lane in range(_LANES):
                            upper[lane] *= scale[lane]
                            lower[lane] = -upper[lane]
                _back(size, signs, M, G[v], D[u])
                if u != v:
                    _back(size, signs, M, G[u], D[v])
        for lane in range(count):
            k = first + lane
            for a in range(n):
                m = 0
                for i in range(n):
                    g1[k, a, i] += D[0, a, i, lane]
                    for j in range(i, n):
                        g2[k, a, m] += D[1 + i, a, j, lane] + D[1 + j, a, i, lane]
                        m += 1


@jit
def _back(size, signs, A, G, D):  # type: ignore[no-untyped-def]
    """D [n, n, lane] += S G A^T, for an antisymmetric A with zeros on its diagonal."""
    n = len(size)
    for a in range(n):
        other = a + 1 if a % 2 == 0 else a - 1
        sign = signs[a // 2] if a % 2 == 0 else -signs[a // 2]
        for b in range(n):
            for lane in range(_LANES):
                total = 0.0
                for c in range(n):
                    total += A[b, c, lane] * G[other, c, lane]
                D[a, b, lane] += sign * total


def _signs(n: int) -> Array:
    """Signs of the pairs of coordinates in the symplectic form."""
    return np.diag(symplectic_form(n), 1)[::2].copy()


def _tiles(w1: Array) -> int:
    return -(-len(w1) // _LANES)


def _no_design(n: int) -> Array:
    return np.empty((0, (n + 1) * (n + 2) // 2, n * (n - 1) // 2))


class _Squares(torch.autograd.Function):
    """(W1, W2) -> sums of squares of the coefficients by degree, [layer, 3]."""

    @staticmethod
    def forward(ctx: Any, W1: Tensor, W2: Tensor, design: Array) -> Tensor:  # type: ignore[override]
        """The parts of the penalty."""
        n = W1.shape[1]
        w1, w2 = (w.detach().contiguous().numpy() for w in (W1, W2))
        parts = np.empty((len(w1), 3))
        share(_squares, _tiles(w1), (None,) * n, _signs(n), w1, w2, design, parts)
        ctx.save_for_backward(W1, W2)
        ctx.design = design
        return torch.from_numpy(parts)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, pulls: Tensor) -> tuple[Tensor, Tensor, None]:  # type: ignore[override]
        """Return its gradient; computing the coefficients again is cheaper than storing."""
        w1, w2 = (w.detach().contiguous().numpy() for w in ctx.saved_tensors)
        n = w1.shape[1]
        g1, g2 = np.zeros_like(w1), np.zeros_like(w2)
        share(
            _pull, _tiles(w1), (None,) * n, _signs(n), w1, w2, ctx.design,
            pulls.contiguous().numpy(), g1, g2,
        )  # fmt: skip
        return torch.from_numpy(g1), torch.from_numpy(g2), None


def symplectic_coefficients(W1: Tensor, W2: Tensor) -> Array:
    """Return coefficients of J(x)^T S J(x) - S as a polynomial in x, for each layer.

    Args:
        W1: [layer, n, n], float64.
        W2: [layer, n, n (n + 1) / 2], float64, reduced Kronecker order.

    Returns:
        [layer, (n + 1) (n + 2) / 2, n (n - 1) / 2]: by the monomial (1; x1, ..., xn; x1^2, x1 x2,
        ..., xn^2), then by the entry (b, c), b < c, row by row.
    """
    n = W1.shape[1]
    out = np.empty((len(W1), *_no_design(n).shape[1:]))
    w1, w2 = (w.detach().cpu().contiguous().numpy() for w in (W1, W2))
    _coefficients((None,) * n, _signs(n), w1, w2, _no_design(n), out)
    return out


def penalty_parts(W1: Tensor, W2: Tensor, design: Array | None = None) -> Tensor:
    """Return sums of squares of the constant, linear and quadratic coefficients, [layer, 3].

    A truncated map of a thick magnet fulfils the constant and the linear conditions (to about
    2e-6), not the quadratic one. With `design` every part counts only the difference from it.

    Args:
        W1, W2: see `symplectic_coefficients`; differentiable.
        design: coefficients of the unperturbed layers, from `symplectic_coefficients`.
    """
    n = W1.shape[1]
    if W1.is_cuda:
        form = torch.from_numpy(symplectic_form(n)).to(W1.device)
        return plain_penalty_parts(
            W1, W2, form, None if design is None else torch.from_numpy(design).to(W1.device)
        )
    given = _no_design(n) if design is None else design
    parts: Tensor = _Squares.apply(W1, W2, given)  # type: ignore[no-untyped-call]
    return parts


def symplectic_penalty(W1: Tensor, W2: Tensor, design: Array | None = None) -> Tensor:
    """Return the penalty of each layer, [layer]: the sum of its `penalty_parts`; differentiable."""
    return penalty_parts(W1, W2, design).sum(dim=1)
