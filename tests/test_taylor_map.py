"""The algebra of truncated maps, by its laws and against direct evaluation."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tmlattice.maps import TaylorMap, kronecker_exponents, symplectic_form


def random_map(seed, n, order, constant=0.0):
    rng = np.random.default_rng(seed)
    parts = [
        rng.uniform(-1, 1, (n, len(kronecker_exponents(n, k)))) / (k + 1)
        for k in range(1, order + 1)
    ]
    return TaylorMap([constant * rng.uniform(-1, 1, n), *parts])


maps = st.tuples(st.integers(0, 10**6), st.integers(1, 4), st.integers(1, 4))


def test_kronecker_order_is_the_papers():
    assert kronecker_exponents(2, 2) == [(2, 0), (1, 1), (0, 2)]
    assert kronecker_exponents(3, 2)[:4] == [(2, 0, 0), (1, 1, 0), (1, 0, 1), (0, 2, 0)]


def test_evaluation_by_hand():
    m = TaylorMap([[1, 2], [[1, 0], [0, 3]], [[0, 1, 0], [0, 0, 2]]])
    np.testing.assert_allclose(m([0.5, -2.0]), [1 + 0.5 - 1.0, 2 - 6 + 8.0])


@settings(max_examples=40, deadline=None)
@given(maps)
def test_composition_agrees_with_nested_evaluation_up_to_the_order(given_map):
    seed, n, order = given_map
    first, second = random_map(seed, n, order), random_map(seed + 1, n, order)
    direction = np.random.default_rng(seed + 2).uniform(-1, 1, n)
    errors = []
    for size in (1e-2, 5e-3):
        x = size * direction
        errors.append(np.abs((second @ first)(x) - second(first(x))).max())
    # what is left out starts at order + 1: halving x divides it by 2^(order + 1), a little less
    assert errors[1] <= errors[0] / 2 ** (order + 0.5) + 1e-15


@settings(max_examples=30, deadline=None)
@given(maps)
def test_jacobian_matches_central_differences(given_map):
    seed, n, order = given_map
    m = random_map(seed, n, order, constant=1.0)
    x = np.random.default_rng(seed).uniform(-1, 1, n)
    h = 1e-5
    steps = h * np.eye(n)
    differences = ((m(x + steps) - m(x - steps)) / (2 * h)).T
    np.testing.assert_allclose(m.jacobian(x), differences, rtol=1e-7, atol=1e-8)


@pytest.mark.parametrize(("n", "order"), [(2, 1), (2, 3), (4, 2), (6, 2)])
def test_symplectic_defect_matches_direct_evaluation(n, order, rng):
    m = random_map(3, n, order)
    x = rng.uniform(-1, 1, n)
    jacobian = m.jacobian(x)
    form = symplectic_form(n)
    direct = jacobian.T @ form @ jacobian - form
    total = np.zeros((n, n))
    for degree, part in enumerate(m.symplectic_defect()):
        monomials = [np.prod(x ** np.array(e)) for e in kronecker_exponents(n, degree)]
        total += part @ monomials
    np.testing.assert_allclose(total, direct, atol=1e-12)


@pytest.mark.parametrize(
    "coefficients", [[[0.0, 0.0]], [[0, 0], [[1, 0]]], [[0, 0], np.eye(2), np.zeros((2, 4))]]
)
def test_wrong_shapes_are_refused(coefficients):
    with pytest.raises(ValueError, match="W"):
        TaylorMap(coefficients)


def test_maps_of_different_dimension_do_not_compose():
    with pytest.raises(ValueError, match="do not compose"):
        TaylorMap.identity(2) @ TaylorMap.identity(4)
