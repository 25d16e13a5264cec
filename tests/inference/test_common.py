"""Patterns that the readings of a column have in common, against dense covariances."""

import numpy as np
import pytest

from tmlattice.inference.errors import LinearFit, Rows, cluster_robust_errors
from tmlattice.inference.normal import amounts, common, normal_equations, times_precision

COLUMNS, MONITORS, ERRORS, PATTERNS = 6, 9, 3, 2


@pytest.fixture
def problem():
    """Rows of parameters, weights (some readings are missing), patterns, residual."""
    random = np.random.default_rng(1)
    plane = np.arange(COLUMNS) % 2
    slopes = [random.standard_normal((COLUMNS, MONITORS)) for _ in range(2)]
    rows = Rows(plane, *slopes, random.standard_normal((ERRORS, COLUMNS, MONITORS)))
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
