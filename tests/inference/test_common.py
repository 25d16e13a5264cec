"""Patterns in common, triangular factors and whitening, against dense algebra."""

import numpy as np
import pytest

from tmlattice.inference.errors import LinearFit, Rows, cluster_robust_errors
from tmlattice.inference.normal import (
    MAX_LAPACK,
    Slopes,
    amounts,
    common,
    inverse_of_lower,
    lower_factor,
    normal_equations,
    times_precision,
)
from tmlattice.inference.whitening import inverse_root

COLUMNS, MONITORS, ERRORS, PATTERNS = 6, 9, 3, 2


@pytest.fixture
def problem():
    """Rows of parameters, weights (some readings are missing), patterns, residual."""
    random = np.random.default_rng(1)
    plane = np.arange(COLUMNS) % 2
    slopes = [random.standard_normal((COLUMNS, MONITORS)) for _ in range(2)]
    rows = Rows(plane, *slopes, [Slopes(random.standard_normal((ERRORS, COLUMNS, MONITORS)))])
    weight = random.uniform(0.5, 2.0, (COLUMNS, MONITORS))
    weight[0, 3] = weight[4, 0] = 0.0
    patterns = random.standard_normal((COLUMNS, PATTERNS, MONITORS))
    return rows, weight, patterns, random.standard_normal((COLUMNS, MONITORS))


def dense(rows, weight, patterns):
    """Slopes [reading, parameter] and covariance of the readings that are there, and which."""
    seen = np.flatnonzero(weight.ravel())
    column, monitor = np.divmod(seen, MONITORS)
    J = rows.times(column, monitor, np.eye(2 * MONITORS + COLUMNS + ERRORS))
    own = patterns[column, :, monitor]
    V = np.diag(1 / weight.ravel()[seen]) + (own @ own.T) * (column[:, None] == column)
    return J, V, seen


def test_inverse_covariance_and_its_determinant(problem):
    rows, weight, patterns, left = problem
    taken, scale = common(weight, patterns)
    _, V, seen = dense(rows, weight, patterns)
    expected = np.linalg.solve(V, left.ravel()[seen])
    np.testing.assert_allclose(
        times_precision(weight, taken, left).ravel()[seen], expected, rtol=1e-9
    )
    whole = np.linalg.slogdet(V)[1] + np.log(weight.ravel()[seen]).sum()
    assert scale.sum() == pytest.approx(whole, rel=1e-9)


def test_normal_equations_are_generalised_least_squares(problem):
    rows, weight, patterns, left = problem
    normal = normal_equations(left, weight, *rows, common(weight, patterns)[0])
    J, V, seen = dense(rows, weight, patterns)
    np.testing.assert_allclose(normal.matrix, J.T @ np.linalg.solve(V, J), atol=1e-9)
    np.testing.assert_allclose(
        normal.vector, J.T @ np.linalg.solve(V, left.ravel()[seen]), atol=1e-9
    )


def test_most_probable_amounts(problem):
    _, weight, patterns, left = problem
    likely, covariance = amounts(weight, patterns, np.where(weight > 0, left, np.nan))
    for c in range(COLUMNS):
        inside = (patterns[c] * weight[c]) @ patterns[c].T + np.eye(PATTERNS)
        np.testing.assert_allclose(
            inside @ likely[c], (patterns[c] * weight[c]) @ np.where(weight[c] > 0, left[c], 0)
        )
        np.testing.assert_allclose(covariance[c], np.linalg.inv(inside), atol=1e-12)


def test_errors_of_clusters_are_those_of_fits_without_them(problem):
    """Each column, and each monitor, is left out of a fit with dense covariances."""
    rows, weight, patterns, left = problem
    J, V, seen = dense(rows, weight, patterns)
    prior = np.eye(J.shape[1])
    matrix = J.T @ np.linalg.solve(V, J)
    covariance = np.linalg.inv(matrix + prior)
    value = covariance @ (J.T @ np.linalg.solve(V, left.ravel()[seen]))
    rest = np.zeros(weight.size)
    rest[seen] = left.ravel()[seen] - J @ value
    fit = LinearFit.of(matrix, covariance)
    left_over = rest.reshape(weight.shape)
    sigma = cluster_robust_errors(rows, weight, left_over, fit, common(weight, patterns)[0])
    column, monitor = np.divmod(seen, MONITORS)
    expected = np.zeros(len(value))
    for cluster in (column, monitor):
        shares, mismatch = [], []
        for own in np.unique(cluster):
            stay = cluster != own
            V_, J_ = V[np.ix_(stay, stay)], J[stay]
            apart = np.linalg.inv(J_.T @ np.linalg.solve(V_, J_) + prior)
            other = apart @ J_.T @ np.linalg.solve(V_, left.ravel()[seen][stay])
            grown = np.diag(apart) - np.diag(covariance)
            shares.append(grown / np.diag(apart))
            mismatch.append((value - other) ** 2 / np.maximum(grown, 1e-300))
        shares, mismatch = np.array(shares), np.array(mismatch)
        judged = np.where(shares < 0.75, shares, 0.0)
        elsewhere = (judged * mismatch).sum(axis=1) / judged.sum(axis=1)
        mismatch = np.where(shares < 0.75, mismatch, elsewhere[:, None])
        expected += np.maximum((shares * mismatch).sum(axis=0) / shares.sum(axis=0) - 1, 0)
    told = np.diag(covariance @ matrix @ covariance)
    np.testing.assert_allclose(sigma, np.sqrt(np.diag(covariance) + told * expected), rtol=1e-6)


# --- triangular factors and their inverses, against numpy's ---------------------------------------
@pytest.mark.parametrize("n", [1, 7, MAX_LAPACK, MAX_LAPACK + 1, 3 * MAX_LAPACK + 5, 431])
def test_factor_and_inverse_are_numpys(n: int) -> None:
    rows = np.random.default_rng(n).normal(size=(n, n + 20))
    matrix = rows @ rows.T
    factor = lower_factor(matrix.copy())
    assert np.allclose(factor, np.linalg.cholesky(matrix), rtol=0, atol=1e-10 * n)
    inverse = inverse_of_lower(factor)
    assert (np.triu(inverse, 1) == 0).all()
    assert np.allclose(inverse @ factor, np.eye(n), rtol=0, atol=1e-9)
    assert np.allclose(inverse.T @ inverse, np.linalg.inv(matrix), rtol=0, atol=1e-9)


def test_a_matrix_that_is_not_positive_is_an_error() -> None:
    with pytest.raises(np.linalg.LinAlgError, match="not positive"):
        lower_factor(np.diag([1.0, -1.0]))


# --- the inverse root of a covariance: either way it is one, and both say the same ----------------
@pytest.mark.parametrize("errors", [0, 1, 12, 40, 55])
def test_a_root_whitens_its_covariance(errors):
    rng = np.random.default_rng(errors)
    spread = rng.normal(size=(errors, 40)) * 10.0 ** rng.uniform(-3, 3, (errors, 1))
    covariance = np.eye(40) + spread.T @ spread
    root = inverse_root(spread)

    W = root.white(np.eye(40)).T
    # the rounding of a covariance whose largest variance is 1e8
    assert W @ covariance @ W.T == pytest.approx(np.eye(40), abs=1e-6)
    rows = rng.normal(size=(3, 40))
    assert root.back(rows) == pytest.approx(rows @ W)
    assert root.log_scale == pytest.approx(-0.5 * np.linalg.slogdet(covariance)[1], rel=1e-9)


def test_errors_that_repeat_one_another_are_one_direction():
    one = np.random.default_rng(3).normal(size=30)
    root = inverse_root(np.stack([one, one, -one]) * 100)
    assert root.white(one) @ root.white(one) == pytest.approx(
        one @ one / (1 + 3e4 * (one @ one)), rel=1e-6
    )
