"""The algebra of truncated maps, and maps of polynomial equations against closed solutions."""

import tracemalloc

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from tmlattice.maps import (
    TaylorMap,
    kronecker_exponents,
    ode_of_taylor_map,
    recentred,
    right_hand_side,
    symplectic_form,
    taylor_map_of_ode,
)
from tmlattice.maps.ode import OdeError, exponents_up_to


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


# --- maps of polynomial equations, against closed solutions, expm and a tight numerical solver ----
FALL = {(0,): [9.8], (2,): [-0.00392]}
PREDATORS = {(1, 0): [1.0, 0.0], (1, 1): [-1.0, 1.0], (0, 1): [0.0, -1.0]}


def pendulum(k):
    return {(0, 1): [1.0, 0.0], (1, 0): [0.0, -k], (3, 0): [0.0, k / 6]}


def random_terms(seed, n, degree, constant):
    rng = np.random.default_rng(seed)
    terms = {e: rng.normal(size=n) / (1 + sum(e)) for e in exponents_up_to(n, degree)}
    terms[(0,) * n] = constant * rng.normal(size=n)
    return terms


def solution(terms, x, duration, start=0.0):
    done = solve_ivp(
        right_hand_side(terms),
        (start, start + duration),
        x,
        method="DOP853",
        rtol=1e-13,
        atol=1e-15,
    )
    return done.y[:, -1]


def test_free_fall_is_the_derivatives_of_the_hyperbolic_tangent():
    W0, W1, W2 = taylor_map_of_ode(FALL, 2, 0.1).coefficients
    a = np.sqrt(9.8 * 0.00392) * 0.1
    np.testing.assert_allclose(W0, [50 * np.tanh(a)], rtol=1e-14)
    np.testing.assert_allclose(W1, [[1 / np.cosh(a) ** 2]], rtol=1e-14)
    np.testing.assert_allclose(W2, [[-np.tanh(a) / np.cosh(a) ** 2 / 50]], rtol=1e-13)


def test_ideal_pendulum_has_the_printed_map():
    W3 = taylor_map_of_ode(pendulum(9.8 / 0.30), 3, 0.1).coefficients[3]
    np.testing.assert_allclose(W3[0, :3], [0.02445, 0.002389, 1.21e-4], rtol=3e-3)
    np.testing.assert_allclose(W3[0, 3], 2e-6, atol=5e-7)  # printed with one digit
    np.testing.assert_allclose(W3[1], [0.43723, 0.065468, 0.004534, 1.21e-4], rtol=3e-3)


@pytest.mark.parametrize("order", [1, 4, 10])
def test_every_coefficient_of_a_closed_solution(order):
    t = 0.7  # x' = x^2: x / (1 - x t) = x + t x^2 + t^2 x^3 + ...
    W = taylor_map_of_ode({(2,): [1.0]}, order, t).coefficients
    np.testing.assert_allclose([w.item() for w in W[1:]], t ** np.arange(order), rtol=1e-13)


def test_a_solution_that_runs_to_infinity_is_refused():
    with pytest.raises(OdeError, match=r"diverges after 1\.57"):
        taylor_map_of_ode({(0,): [1.0], (2,): [1.0]}, 2, 1.6)


@pytest.mark.parametrize("n", [1, 3, 6])
def test_linear_equation_is_the_matrix_exponential(n, rng):
    A, b = rng.normal(size=(n, n)), rng.normal(size=n)
    terms = {e: A[:, e.index(1)] for e in kronecker_exponents(n, 1)} | {(0,) * n: b}
    W0, W1 = taylor_map_of_ode(terms, 1, 1.3).coefficients
    block = expm(1.3 * np.block([[A, b[:, None]], [np.zeros((1, n + 1))]]))
    np.testing.assert_allclose(W1, block[:n, :n], rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(W0, block[:n, n], rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("order", [2, 3, 4, 5])
def test_truncation_error_falls_with_the_power_of_the_step(order):
    # x' quadratic: what is cut, degree order + 1, first appears with time^order
    x = np.array([0.6, 0.9])
    errors = [
        np.abs(taylor_map_of_ode(PREDATORS, order, t)(x) - solution(PREDATORS, x, t)).max()
        for t in (0.04, 0.02)
    ]
    assert np.log2(errors[0] / errors[1]) == pytest.approx(order, abs=0.2)


def test_a_hamiltonian_flow_is_symplectic_up_to_its_order():
    defect = taylor_map_of_ode(pendulum(30.0), 5, 0.3).symplectic_defect()
    for part in defect[:5]:
        assert np.abs(part).max() < 1e-11
    assert np.abs(defect[6]).max() > 1e-6


@pytest.mark.parametrize(("n", "order"), [(2, 10), (6, 4)])
def test_high_order_and_dimension_against_the_solver_within_megabytes(n, order):
    terms = random_terms(n, n, 2, constant=0.2)
    tracemalloc.start()
    m = taylor_map_of_ode(terms, order, 0.5)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    x = 0.02 * np.random.default_rng(1).normal(size=n)
    np.testing.assert_allclose(m(x), solution(terms, x, 0.5), atol=1e-8 if n == 6 else 1e-12)
    assert peak < 50e6  # measured 3


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 10**6), st.integers(1, 3), st.integers(1, 4), st.sampled_from([0.0, 0.5]))
def test_from_the_equation_to_the_map_and_back(seed, n, order, constant):
    terms = random_terms(seed, n, order, constant)
    found = ode_of_taylor_map(taylor_map_of_ode(terms, order, 0.3), 0.3)
    assert list(found) == exponents_up_to(n, order)
    size = max(np.abs(c).max() for c in terms.values())
    for exponents, coefficient in found.items():
        np.testing.assert_allclose(coefficient, terms[exponents], atol=1e-9 * (1 + size))


def test_from_the_map_to_the_equation_and_back(rng):
    parts = [rng.normal(size=(2, k + 1)) * 0.1 for k in (1, 2, 3)]
    trained = TaylorMap([[0.02, -0.01], np.eye(2) + parts[0], *parts[1:]])
    again = taylor_map_of_ode(ode_of_taylor_map(trained, 0.1), 3, 0.1)
    for one, other in zip(trained.coefficients, again.coefficients, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-13)


def test_high_degrees_keep_the_branch_of_the_linear_part():
    # the phase in one step is 2.5: three times that is beyond half a turn, where the principal
    # logarithm of the action on cubic monomials would fold it
    terms = {(0, 1): [2.5, 0.3], (1, 0): [-0.1, -2.5], (3, 0): [0.2, 0.7], (1, 2): [0.0, 0.4]}
    found = ode_of_taylor_map(taylor_map_of_ode(terms, 3, 1.0), 1.0)
    for exponents, coefficient in found.items():
        np.testing.assert_allclose(coefficient, terms.get(exponents, [0, 0]), atol=1e-11)


def test_maps_without_a_logarithm_are_refused():
    with pytest.raises(OdeError, match="no real logarithm"):
        ode_of_taylor_map(TaylorMap.linear(-np.diag([1.0, 2.0])), 1.0)
    with pytest.raises(OdeError, match="no real logarithm"):
        ode_of_taylor_map(TaylorMap.linear([[1.0, 1.0], [1.0, 1.0]]), 1.0)


def test_moving_the_centre_changes_no_velocity(rng):
    terms = random_terms(3, 3, 4, constant=1.0)
    centre, x = rng.normal(size=3), rng.normal(size=(5, 3))
    moved = recentred(terms, centre)
    np.testing.assert_allclose(
        right_hand_side(moved)(0.0, x), right_hand_side(terms)(0.0, centre + x), rtol=1e-10
    )


@pytest.mark.parametrize(
    "terms", [{}, {(1, 0): [1.0]}, {(1,): [1.0], (1, 0): [1.0, 0.0]}, {(-1,): [1.0]}]
)
def test_terms_that_do_not_fit_are_refused(terms):
    with pytest.raises(ValueError, match=r"term|coefficient|exponents"):
        taylor_map_of_ode(terms, 2, 0.1)
