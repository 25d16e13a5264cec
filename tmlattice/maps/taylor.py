"""The algebra of truncated Taylor maps of any order and dimension.

A map sends x [n] to W0 + W1 x + W2 x^[2] + ..., where x^[k] holds the products of k coordinates in
the reduced Kronecker order: x1^2, x1 x2, ..., x1 xn, x2^2, ..., xn^2 for k = 2. Each Wk is
[n, C(n + k - 1, k)].

Internally a polynomial is one row over all monomials of degree 0 to the order, degree by degree.
The product of two is a table look-up, made once for each dimension and order.
"""

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations_with_replacement, pairwise
from math import comb

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tmlattice.arrays import Array

Indices = NDArray[np.intp]
Exponents = tuple[int, ...]


def kronecker_exponents(n: int, degree: int) -> list[Exponents]:
    """Exponents of the monomials of one degree in n variables, in the reduced Kronecker order."""
    return [
        tuple(variables.count(i) for i in range(n))
        for variables in combinations_with_replacement(range(n), degree)
    ]


def exponents_up_to(n: int, order: int) -> list[Exponents]:
    """Return exponents of degree 0 to `order` in n coordinates, in the order of a map's weights."""
    return [e for degree in range(order + 1) for e in kronecker_exponents(n, degree)]


def parent_of(exponents: Exponents) -> tuple[Exponents, int]:
    """Return the monomial with one factor less, and the index of that factor."""
    variable = next(i for i, e in enumerate(exponents) if e)
    return tuple(e - (i == variable) for i, e in enumerate(exponents)), variable


def second_derivatives(W2: Array) -> Array:
    """d2 (image) / d x_i d x_j [..., m, n, n] of second-order coefficients W2 [..., m, pairs]."""
    pair, twice = _pair(W2.shape[-1])
    return np.asarray(W2[..., pair] * twice)


@functools.cache
def _pair(count: int) -> tuple[Indices, Array]:
    """Index of the pair of each entry of a symmetric matrix, and its factor, [n, n]."""
    n = round((8 * count + 1) ** 0.5 - 1) // 2
    i, j = np.triu_indices(n)
    pair = np.empty((n, n), dtype=np.intp)
    pair[i, j] = pair[j, i] = np.arange(len(i))
    return pair, 1.0 + np.eye(n)


def symplectic_form(n: int) -> Array:
    """S [n, n] of the symplectic condition J^T S J = S, in OCELOT's order of coordinates.

    Two or four coordinates: diag(J, ...), J = [[0, 1], [-1, 0]]. Six: diag(J, J, -J), because
    OCELOT's (tau, p) has the opposite sign.
    """
    signs = [1.0, 1.0, -1.0] if n == 6 else [1.0] * (n // 2)
    if n % 2 or n > 6:
        raise ValueError(f"no symplectic form for {n} coordinates: 2, 4 and 6 have one")
    return np.kron(np.diag(signs), np.array([[0.0, 1.0], [-1.0, 0.0]]))


@dataclass(frozen=True)
class _Table:
    """Monomials of degree 0 to `order`, and their products."""

    exponents: Indices  # [monomial, n]
    starts: tuple[int, ...]  # of each degree, and the end
    parents: Indices  # [monomial, 2]: it is monomial parents[., 0] times variable parents[., 1]
    left: Indices  # products left * right that stay within the order, by target
    right: Indices
    first: Indices  # [monomial]: the products from first[k] to first[k + 1] go to monomial k

    def multiply(self, a: Array, b: Array) -> Array:
        """Product of polynomials [..., monomial], truncated at the order."""
        # products are sorted by target, and every monomial is a target: 1 times itself
        return np.asarray(
            np.add.reduceat(a[..., self.left] * b[..., self.right], self.first, axis=-1)
        )

    def convolve(self, a: Array, b: Array) -> Array:
        """Sum over i of the products a[i] b[i] of polynomials [i, monomial], [monomial]."""
        products = np.einsum("ij,ij->j", a[:, self.left], b[:, self.right])
        return np.asarray(np.add.reduceat(products, self.first))


@functools.cache
def _table(n: int, order: int) -> _Table:
    rows = exponents_up_to(n, order)
    starts = [0, *(comb(n + degree, degree) for degree in range(order + 1))]
    index = {row: i for i, row in enumerate(rows)}
    parents = [(0, 0)]
    for below, variable in map(parent_of, rows[1:]):
        parents.append((index[below], variable))
    left, right, target = [], [], []
    for i, a in enumerate(rows):
        for j, b in enumerate(rows[: starts[order - sum(a) + 1]]):
            left.append(i)
            right.append(j)
            target.append(index[tuple(x + y for x, y in zip(a, b, strict=True))])
    arrays = (np.array(v, dtype=np.intp) for v in (rows, parents, left, right, target))
    exponents, parent_array, left_array, right_array, target_array = arrays
    by_target = np.argsort(target_array, kind="stable")
    return _Table(
        exponents.reshape(len(rows), n),
        tuple(starts),
        parent_array,
        left_array[by_target],
        right_array[by_target],
        np.searchsorted(target_array[by_target], np.arange(len(rows))).astype(np.intp),
    )


class TaylorMap:
    """x -> W0 + W1 x + W2 x^[2] + ... + Wp x^[p], truncated at order p.

    Args:
        coefficients: W0 [n], W1 [n, n], W2 [n, n (n + 1) / 2], ..., Wp [n, C(n + p - 1, p)] in
            the reduced Kronecker order; the units are the coordinates' own.

    Attributes:
        n: number of coordinates.
        order: p.

    Raises:
        ValueError: a coefficient array of another shape (the message states the right one).

    Source: A. Ivanov, S. Golovkina, U. Iben, physics-based polynomial neural networks.
    """

    def __init__(self, coefficients: Sequence[ArrayLike]) -> None:
        arrays = [np.array(w, dtype=float) for w in coefficients]
        if len(arrays) < 2 or arrays[0].ndim != 1:
            raise ValueError("a map has at least W0 [n] and W1 [n, n]")
        self.n = len(arrays[0])
        self.order = len(arrays) - 1
        for degree, w in enumerate(arrays[1:], start=1):
            wanted = (self.n, comb(self.n + degree - 1, degree))
            if w.shape != wanted:
                raise ValueError(f"W{degree} has the shape {w.shape}; it should be {wanted}")
        self._rows = np.concatenate([arrays[0][:, None], *arrays[1:]], axis=1)

    @classmethod
    def _of_rows(cls, rows: Array, order: int) -> "TaylorMap":
        new = cls.__new__(cls)
        new.n, new.order, new._rows = len(rows), order, rows
        return new

    @classmethod
    def identity(cls, n: int, order: int = 1) -> "TaylorMap":
        """Return the identity."""
        return cls.linear(np.eye(n), order)

    @classmethod
    def linear(cls, matrix: ArrayLike, order: int = 1) -> "TaylorMap":
        """Return the map x -> matrix x, with zero coefficients up to `order`."""
        matrix = np.asarray(matrix, dtype=float)
        n = len(matrix)
        higher = [np.zeros((n, comb(n + k - 1, k))) for k in range(2, order + 1)]
        return cls([np.zeros(n), matrix, *higher])

    @property
    def _table(self) -> _Table:
        return _table(self.n, self.order)

    @property
    def exponents(self) -> Indices:
        """Exponents of the monomials of degree 0 to the order, [monomial, n]."""
        return self._table.exponents.copy()

    @property
    def coefficients(self) -> list[Array]:
        """W0 [n], W1 [n, n], W2 [n, n (n + 1) / 2], ..., copies."""
        starts = self._table.starts
        parts = [self._rows[:, a:b].copy() for a, b in pairwise(starts)]
        return [parts[0][:, 0], *parts[1:]]

    def __repr__(self) -> str:
        return f"TaylorMap(n={self.n}, order={self.order})"

    def monomials(self, x: ArrayLike) -> Array:
        """Return monomials of degree 0 to the order of the states x [..., n], [..., monomial]."""
        x = np.asarray(x, dtype=float)
        values = np.ones((*x.shape[:-1], len(self._table.exponents)))
        for i, (parent, variable) in enumerate(self._table.parents[1:], start=1):
            values[..., i] = values[..., parent] * x[..., variable]
        return values

    def __call__(self, x: ArrayLike) -> Array:
        """Return images of the states x [..., n], the same shape."""
        return np.asarray(self.monomials(x) @ self._rows.T)

    def truncated(self, order: int) -> "TaylorMap":
        """Return the map cut, or filled with zeros, to another order."""
        rows = np.zeros((self.n, _table(self.n, order).starts[-1]))
        kept = min(rows.shape[1], self._rows.shape[1])
        rows[:, :kept] = self._rows[:, :kept]
        return self._of_rows(rows, order)

    def after(self, first: "TaylorMap", order: int | None = None) -> "TaylorMap":
        """Return this map after `first`: x -> self(first(x)), truncated (else the higher order).

        Exact up to the order, constant terms included; see `__matmul__`.
        """
        if first.n != self.n:
            raise ValueError(f"maps of {self.n} and {first.n} coordinates do not compose")
        order = max(self.order, first.order) if order is None else order
        # all terms of the outer map: a constant in `first` feeds them down
        return self._of_rows(self._rows @ first.powers(self.order, order), order)

    def powers(self, degree: int, order: int) -> Array:
        """Return the monomials of the image, of degree 0 to `degree`, as polynomials of x that are
        truncated at an order, [monomial, monomial]."""
        table, inner = _table(self.n, order), self.truncated(order)._rows
        values = [np.eye(1, inner.shape[1])[0]]
        for parent, variable in _table(self.n, degree).parents[1:]:
            values.append(table.multiply(values[parent], inner[variable]))
        return np.array(values)

    def __matmul__(self, first: "TaylorMap") -> "TaylorMap":
        """Return `second @ first`: first `first`, then `second`, as with matrices."""
        return self.after(first)

    def jacobian(self, x: ArrayLike) -> Array:
        """Return d image / d x at the states x [..., n], [..., n (image), n (x)]."""
        x = np.asarray(x, dtype=float)
        columns = [self._derivative(i) for i in range(self.n)]
        maps = [self._of_rows(column, self.order - 1) for column in columns]
        return np.stack([m(x) for m in maps], axis=-1)

    def _derivative(self, i: int) -> Array:
        """Rows over monomials up to order - 1 of the derivative by x_i."""
        index = {row: k for k, row in enumerate(exponents_up_to(self.n, self.order - 1))}
        rows = np.zeros((self.n, len(index)))
        for k, exponents in enumerate(self._table.exponents.tolist()):
            if exponents[i]:
                below = list(exponents)
                below[i] -= 1
                rows[:, index[tuple(below)]] += exponents[i] * self._rows[:, k]
        return rows

    def symplectic_defect(self) -> list[Array]:
        """Return the coefficients of J(x)^T S J(x) - S by degree 0, 1, ..., 2 (order - 1).

        Entry k is [n, n, monomials of degree k]; all are zero for a symplectic map. A truncated
        map of a magnet has its first non-zero entry at degree `order`.
        """
        degree = 2 * (self.order - 1)
        table = _table(self.n, degree)
        jacobian = np.zeros((self.n, self.n, table.starts[-1]))
        for i in range(self.n):
            column = self._derivative(i)
            jacobian[:, i, : column.shape[1]] = column
        form = symplectic_form(self.n)
        defect = np.zeros_like(jacobian)
        defect[:, :, 0] -= form
        for a, b in zip(*np.nonzero(form), strict=True):
            defect += form[a, b] * table.multiply(jacobian[a][:, None, :], jacobian[b][None, :, :])
        return [defect[:, :, a:b] for a, b in pairwise(table.starts)]
