"""Hamiltonian polynomials as layer parameters: their order, their field, their multipoles.

A generator is H(x) = sum g_i x_i + sum g_ij x_i x_j + sum g_ijk x_i x_j x_k (i <= j <= k), without
the constant, as one row g in the reduced Kronecker order, degree by degree: 34 numbers for four
coordinates, 83 for six. Its field S grad H is c + A m + Q m^[2]; whatever g is, the flow of the
field is symplectic. A field of multipoles at one place has the generator

    H = b0 x - a0 y + b1 (x^2 - y^2) / 2 - a1 x y + b2 (x^3 - 3 x y^2) / 6 - a2 (3 x^2 y - y^3) / 6,

the integrated strengths b1 = k1 L and b2 = k2 L in OCELOT's sign, and kicks px -= b0, py += a0.
"""

import functools

import numpy as np

from tmlattice.arrays import Array
from tmlattice.maps.taylor import kronecker_exponents, second_derivatives, symplectic_form

DEGREE = 3
"""Largest degree of a generator: its flow agrees with a second-order map to second order."""


@functools.cache
def exponents(n: int) -> tuple[tuple[int, ...], ...]:
    """Exponents of a generator's monomials in n coordinates, in their order."""
    return tuple(row for degree in range(1, DEGREE + 1) for row in kronecker_exponents(n, degree))


@functools.cache
def field_matrix(n: int) -> Array:
    """Return [n, 1 + n + n (n + 1) / 2, coefficient]: the field's Taylor coefficients from g."""
    lower = [row for degree in range(DEGREE) for row in kronecker_exponents(n, degree)]
    place = {row: i for i, row in enumerate(lower)}
    gradient = np.zeros((n, len(lower), len(exponents(n))))
    for k, row in enumerate(exponents(n)):
        for i in range(n):
            if row[i]:
                below = tuple(e - (i == j) for j, e in enumerate(row))
                gradient[i, place[below], k] += row[i]
    matrix = np.einsum("ab,bmk->amk", symplectic_form(n), gradient)
    matrix.flags.writeable = False
    return np.asarray(matrix)


@functools.cache
def _by_degree(n: int) -> list[tuple[slice, Array]]:
    """Coefficients of one degree for each of c, A, Q, and `field_matrix` between them,
    [coefficient, n * column]."""
    parts, column, first = [], 0, 0
    for degree in range(1, DEGREE + 1):
        width = len(kronecker_exponents(n, degree - 1))
        count = len(kronecker_exponents(n, degree))
        columns, own = slice(column, column + width), slice(first, first + count)
        matrix = field_matrix(n)[:, columns, own].reshape(n * width, count).T
        parts.append((own, np.ascontiguousarray(matrix)))
        column, first = column + width, first + count
    return parts


def field(generator: Array) -> tuple[Array, Array, Array]:
    """Return c [layer, n], A [layer, n, n], Q [layer, n, n (n + 1) / 2] of S grad H by layer
    (generator: [layer, coefficient])."""
    n = dimension_of(generator.shape[-1])
    c, A, Q = (
        (generator[:, own] @ matrix).reshape(len(generator), n, -1) for own, matrix in _by_degree(n)
    )
    return c[..., 0], A, Q


def pull_field(c: Array, A: Array, Q: Array) -> Array:
    """Return the transpose of `field`: gradients by c, A, Q as one by g."""
    n = c.shape[1]
    parts = zip((c, A, Q), _by_degree(n), strict=True)
    rows = [part.reshape(len(c), -1) @ matrix.T for part, (_, matrix) in parts]
    return np.concatenate(rows, axis=1)


def dimension_of(coefficients: int) -> int:
    """Return the number of coordinates of a generator with this many coefficients; ValueError: no
    generator of degree three has this number."""
    for n in (4, 6):
        if len(exponents(n)) == coefficients:
            return n
    raise ValueError(f"no generator has {coefficients} coefficients: 34 and 83 are possible")


def nearest_symplectic(W1: Array) -> Array:
    """Return symplectic matrices near W1 [layer, n, n], by Newton's iteration for the polar part;
    ValueError: a matrix too far from symplectic (names the layer)."""
    S = symplectic_form(W1.shape[-1])
    W = W1
    for _ in range(30):
        product = S.T @ W.swapaxes(-1, -2) @ S @ W  # the identity, for a symplectic W
        defect = np.abs(product - np.eye(len(S))).max(axis=(-1, -2))
        if not defect.max() > 1e-15:
            break
        if not defect.max() < 1.0:
            raise ValueError(
                f"W1 of layer {int(defect.argmax())} is not near a symplectic matrix (defect "
                f"{defect.max():.2g}); start from a design, or fine-tune with method='map'"
            )
        better = W @ (1.5 * np.eye(len(S)) - 0.5 * product)
        small = defect.max() < 1e-12
        W = np.where((defect > 1e-15)[:, None, None], better, W)
        if small:
            break
    return W


def cubic_generator(W1: Array, W2: Array) -> Array:
    """Return generators [layer, coefficient] of layers' second-order parts, at the layers' exits.

    A layer W1 x + W2 x^[2] is u + Q u^[2] with u = W1 x. Where the layer is symplectic to second
    order, Q u^[2] is a Hamiltonian field; the rest (2e-6 of OCELOT's T) is ignored.

    Args:
        W1: [layer, n, n], symplectic.
        W2: [layer, n, n (n + 1) / 2].
    """
    n = W1.shape[-1]
    S = symplectic_form(n)
    inverse = S.T @ W1.swapaxes(-1, -2) @ S
    bent = np.einsum("lapq,lpi,lqj->laij", second_derivatives(W2), inverse, inverse)
    third = np.einsum("ab,laij->lbij", S, bent)  # S^T field = grad H; S^T_ba = S_ab
    third = sum(third.transpose(0, *p) for p in ((1, 2, 3), (2, 3, 1), (3, 1, 2))) / 3
    generator = np.zeros((len(W1), len(exponents(n))))
    for k, row in enumerate(exponents(n)):
        if sum(row) == 3:
            i, j, m = (v for v, e in enumerate(row) for _ in range(e))
            repeats = np.prod([[1, 1, 2, 6][e] for e in row])
            generator[:, k] = third[:, i, j, m] / repeats
    return generator


def multipoles(generator: Array) -> dict[str, Array]:
    """Return integrated multipoles of generators, from their terms in x and y alone.

    Args:
        generator: [layer, coefficient].

    Returns:
        {"kick_x", "kick_y" (rad), "gradient", "skew_gradient" (k1 L, 1/m), "sextupole",
        "skew_sextupole" (k2 L, 1/m2)}, each [layer]. Parts that no multipole has (x^2 + y^2) are
        ignored.
    """
    n = dimension_of(generator.shape[-1])
    place = {row: i for i, row in enumerate(exponents(n))}

    def term(x: int, y: int) -> Array:
        return np.asarray(generator[:, place[(x, 0, y, 0, 0, 0)[:n]]])

    return {  # least squares onto each multipole's own pattern of coefficients
        "kick_x": -term(1, 0),
        "kick_y": -term(0, 1),
        "gradient": term(2, 0) - term(0, 2),
        "skew_gradient": -term(1, 1),
        "sextupole": 0.6 * term(3, 0) - 1.8 * term(1, 2),
        "skew_sextupole": 0.6 * term(0, 3) - 1.8 * term(2, 1),
    }
