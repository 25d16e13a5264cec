"""Polynomial differential equations as truncated Taylor maps, and back.

dX/dt = sum over exponents of coefficient * X^exponents, written as `terms`: exponents ->
coefficient vector [n]. Free fall with drag, dv/dt = 9.8 - 0.00392 v^2:

>>> fall = taylor_map_of_ode({(0,): [9.8], (2,): [-0.00392]}, order=2, time=0.1)
>>> fall.coefficients                    # [0.979874527], [[0.999615938]], [[-3.91799e-4]]
>>> ode_of_taylor_map(fall, time=0.1)    # {(0,): [9.8], (1,): [0], (2,): [-0.00392]}

A coefficient that oscillates in time is a further coordinate: s' = omega c, c' = -omega s.
"""

from collections.abc import Callable, Mapping
from itertools import product
from math import comb

import numpy as np
from numpy.typing import ArrayLike

from tmlattice.arrays import Array
from tmlattice.errors import TmlatticeError
from tmlattice.maps.taylor import (
    Exponents,
    TaylorMap,
    _Table,
    _table,
    exponents_up_to,
    kronecker_exponents,
    parent_of,
)

Terms = Mapping[Exponents, ArrayLike]

ROUNDING = 1e-17  # below half a unit in the last place
STEPS = 10_000


class OdeError(TmlatticeError):
    """Raised for an equation without a map over that time, or a map without an equation."""


class _Equation:
    """Compiled right-hand side.

    Attributes:
        n: number of coordinates.
        terms: exponents with their coefficient vectors [n].
        products: exponents of more than one factor in the terms, those they are built from first.
    """

    def __init__(self, terms: Terms) -> None:
        if not terms:
            raise ValueError("an equation needs at least one term: {exponents: coefficients}")
        self.n = len(next(iter(terms)))
        self.terms = [(e, np.asarray(c, dtype=float)) for e, c in terms.items()]
        needed: dict[Exponents, None] = {}
        for exponents, coefficient in self.terms:
            if len(exponents) != self.n or any(e < 0 for e in exponents) or not self.n:
                raise ValueError(f"{exponents} are no exponents of {self.n} coordinates")
            if coefficient.shape != (self.n,):
                raise ValueError(
                    f"the coefficient of {exponents} has the shape {coefficient.shape}; "
                    f"it should be ({self.n},)"
                )
            below = tuple(exponents)
            while sum(below) > 0:
                needed[below] = None
                below = parent_of(below)[0]
        self.products = sorted((e for e in needed if sum(e) > 1), key=sum)


def right_hand_side(terms: Terms) -> Callable[[float, ArrayLike], Array]:
    """Return dX/dt as a function of the time and of states [..., n], for a numerical solver.

    Args:
        terms: exponents -> coefficient vector [n].
    """
    equation = _Equation(terms)

    def slope(t: float, x: ArrayLike) -> Array:
        x = np.asarray(x, dtype=float)
        total = np.zeros_like(x)
        for exponents, coefficient in equation.terms:
            total += np.prod(x ** np.array(exponents), axis=-1)[..., None] * coefficient
        return total

    return slope


def recentred(terms: Mapping[Exponents, ArrayLike], centre: ArrayLike) -> dict[Exponents, Array]:
    """Return the same equation for the distance from `centre` [n]: X = centre + distance."""
    centre = np.asarray(centre, dtype=float)
    result: dict[Exponents, Array] = {}
    for exponents, coefficient in terms.items():
        for kept in product(*(range(e + 1) for e in exponents)):
            factor = 1.0
            for e, k, c in zip(exponents, kept, centre, strict=True):
                factor *= comb(e, k) * c ** (e - k)
            if factor:
                part = factor * np.asarray(coefficient, dtype=float)
                result[kept] = result.get(kept, np.zeros(len(centre))) + part
    return result


def taylor_map_of_ode(terms: Terms, order: int, time: float) -> TaylorMap:
    """Return the map from X(0) to X(time) under dX/dt = sum of terms, up to `order`.

    It is the flow's Taylor polynomial in its start at X = 0, constant terms included: each
    coefficient is that of the exact flow, whatever the degree of the terms. The weights obey the
    equation dM/dt = F(M), truncated at the order. It is solved by Lie series (Taylor series in
    time), in as many steps as rounding-error convergence needs.

    Args:
        terms: exponents [n] -> coefficient vector [n]; units are the coordinates' own.
        order: of the truncation in X, 1 or more.
        time: duration; may be negative.

    Raises:
        OdeError: the solution from X = 0 diverges before the end.
        ValueError: exponents and coefficients of different dimensions.

    Source: M. Berz, Modern Map Methods in Particle Beam Physics (1999), for the expansion; A.
    Jorba, M. Zou, Experimental Mathematics 14 (2005) 99, for series in time with steps.
    """
    equation = _Equation(terms)
    if order < 1:
        raise ValueError(f"a map has at least the order 1, not {order}")
    table = _table(equation.n, order)
    rows = TaylorMap.identity(equation.n, order)._rows
    if time:
        rows = _lie_series(equation, rows, time, table)
    return TaylorMap._of_rows(rows, order)


def _lie_series(equation: _Equation, rows: Array, time: float, table: _Table) -> Array:
    degree = len(table.starts) + 20  # in time; the degree k in X may first appear at t^(k - 1)
    blocks = list(zip(table.starts[:-1], table.starts[1:], strict=True))
    left = abs(time)
    for _ in range(STEPS):
        series = _series(equation, rows, np.sign(time), degree, table)
        # largest coefficient by power of time, coordinate and degree in X
        size = np.stack([abs(series[:, :, a:b]).max(axis=2) for a, b in blocks], axis=2)
        powers = np.arange(degree + 1)[:, None, None]
        step = left
        while step > 0:
            sizes = size * step**powers
            if (sizes[-2:] <= ROUNDING * sizes.max(axis=0)).all():
                break
            step *= 0.7
        if not step > 1e-12 * abs(time):
            break
        rows = np.asarray(np.tensordot(step ** np.arange(degree + 1), series, 1))
        left -= step
        if left <= 0:
            return rows
    raise OdeError(
        f"the solution from X = 0 diverges after {abs(time) - left:.6g} of "
        f"{abs(time):.6g}; take a shorter time, or another centre by `recentred`"
    )


def _series(
    equation: _Equation, rows: Array, direction: float, degree: int, table: _Table
) -> Array:
    """Coefficients of time^0 to time^degree of the weights, [power, n, monomial]."""
    n, monomials = rows.shape
    x = np.zeros((degree + 1, n, monomials))
    x[0] = rows
    # the coordinates are views of x, filled with it
    values = {tuple(int(i == j) for j in range(n)): x[:, i] for i in range(n)}
    values |= {e: np.zeros((degree + 1, monomials)) for e in ((0,) * n, *equation.products)}
    values[(0,) * n][0, 0] = 1.0
    for j in range(degree):
        for exponents in equation.products:
            below, variable = parent_of(exponents)
            values[exponents][j] = table.convolve(values[below][: j + 1], x[j::-1, variable])
        slope = sum(c[:, None] * values[e][j] for e, c in equation.terms)
        x[j + 1] = direction * slope / (j + 1)
    return x


def ode_of_taylor_map(taylor_map: TaylorMap, time: float) -> dict[Exponents, Array]:
    """Return the polynomial equation dX/dt, of the map's own order, whose map over `time` this is.

    It is the logarithm of the map's action on monomials (Koopman's matrix, Carleman's in the
    other reading), found degree by degree: the linear part is log(W1) / time, and each higher
    degree is then a linear equation.

    - Ambiguity: a map determines frequencies modulo 1 / time. The principal logarithm of W1 is
      taken, so every linear frequency is assumed to be below half a turn in `time`; products of
      frequencies in the higher degrees are counted from it and may be above. A W1 with a negative
      real eigenvalue has no real logarithm.
    - Truncation: coefficients up to the map's order; of an equation of higher degree these are its
      first coefficients if W0 = 0. With W0 not 0 higher degrees feed down, and the result is the
      one equation of this degree with this truncated map.
    - A trained map need not come from an equation of low degree; then the coefficients are those
      of the truncated logarithm, and high ones mean little.

    Args:
        taylor_map: W0, W1, ..., of order p.
        time: between X and its image.

    Returns:
        Exponents -> coefficient vector [n], for all monomials of degree 0 to p.

    Raises:
        OdeError: W1 is singular or has a negative real eigenvalue, the frequencies are resonant,
            or W0 is so large that the iteration does not converge.
    """
    n, order = taylor_map.n, taylor_map.order
    exponents = exponents_up_to(n, order)
    rows = wanted = _logarithm(taylor_map, time)
    for _ in range(50):
        terms = dict(zip(exponents, rows.T, strict=True))
        correction = wanted - _logarithm(taylor_map_of_ode(terms, order, time), time)
        rows = rows + correction
        if np.abs(correction).max() <= 1e-13 * np.abs(rows).max():
            break
    if not np.abs(correction).max() <= 1e-9 * np.abs(rows).max():  # within rounding
        raise OdeError(
            "no equation of the map's order was found near its logarithm: W0 is too large for it; "
            "expand the map about another centre"
        )
    return {e: column.copy() for e, column in zip(exponents, rows.T, strict=True)}


def _logarithm(taylor_map: TaylorMap, time: float) -> Array:
    """Coefficients of the equation [n, monomial], exact for W0 = 0, else a close guess."""
    from scipy.linalg import expm, logm

    n, order = taylor_map.n, taylor_map.order
    W = taylor_map.coefficients
    eigenvalues = np.linalg.eigvals(W[1])
    negative = (eigenvalues.real <= 0) & (abs(eigenvalues.imag) < 1e-12 * abs(eigenvalues))
    if negative.any() or np.linalg.matrix_rank(W[1]) < n:
        raise OdeError(
            f"W1 has the eigenvalue {eigenvalues[np.argmin(eigenvalues.real)]:.4g} and so no real "
            "logarithm; a shorter time between the samples would turn less than half a turn"
        )
    A = np.real(logm(W[1])) / time
    table = _table(n, order)
    rows = np.zeros((n, table.starts[-1]))
    rows[:, 1 : n + 1] = A
    rows[:, 0] = np.linalg.solve(_phi(A, time), W[0])
    exponents = exponents_up_to(n, order)
    for degree in range(2, order + 1):
        a, b = table.starts[degree], table.starts[degree + 1]
        terms = dict(zip(exponents[1:a], rows[:, 1:a].T, strict=True))
        so_far = taylor_map_of_ode(terms, degree, time).coefficients[degree]
        # d W_k / dt = A W_k + P_k x^[k](t), and x^[k] moves with `derivation`
        derivation = _derivation(A, degree)
        generator = np.asarray(
            np.kron(np.eye(n), derivation.T) - np.kron(A, np.eye(b - a)), dtype=np.float64
        )
        propagate = np.kron(expm(A * time), np.eye(b - a)) @ _phi(generator, time)
        if np.linalg.cond(propagate) > 1e13:
            raise OdeError(
                f"the frequencies are resonant at degree {degree} in {time:g}; these terms "
                "cannot be read off a map over that time"
            )
        missing = (W[degree] - so_far).ravel()
        rows[:, a:b] = np.linalg.solve(propagate, missing).reshape(n, b - a)
    return rows


def _phi(matrix: Array, time: float) -> Array:
    """Integral of exp(matrix s) over s from 0 to `time`."""
    from scipy.linalg import expm

    n = len(matrix)
    block = np.zeros((2 * n, 2 * n))
    block[:n, :n] = matrix
    block[:n, n:] = np.eye(n)
    return np.asarray(expm(block * time)[:n, n:])


def _derivation(A: Array, degree: int) -> Array:
    """d x^[degree] / dt = derivation x^[degree] where dx/dt = A x, [monomial, monomial]."""
    n = len(A)
    exponents = kronecker_exponents(n, degree)
    index = {e: i for i, e in enumerate(exponents)}
    result = np.zeros((len(exponents), len(exponents)))
    for row, e in enumerate(exponents):
        for i, power in enumerate(e):
            if power:
                for j in range(n):
                    moved = list(e)
                    moved[i] -= 1
                    moved[j] += 1
                    result[row, index[tuple(moved)]] += power * A[i, j]
    return result
