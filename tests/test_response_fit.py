"""The block solver of the response's fit against dense normal equations, and known errors."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from tmlattice.diagnosis.response_fit import fit


@pytest.fixture
def problem(rng):
    columns, monitors, errors = 12, 9, 7
    plane = rng.integers(0, 2, columns)
    weight = rng.uniform(0.5, 2, (columns, monitors)) / 1e-4
    weight[3, 4] = 0  # a missing reading
    u, v = rng.standard_normal((2, columns, monitors))
    v[-1] = 0  # a column without a parameter of its own
    J = rng.standard_normal((errors, columns, monitors))
    residual = 0.1 * rng.standard_normal((columns, monitors))
    residual[3, 4] = np.nan
    return residual, weight, plane, u, v, J


def dense(residual, weight, plane, u, v, J):
    """The whole design matrix, [reading, parameter]."""
    columns, monitors = residual.shape
    rows = []
    for c in range(columns):
        for m in range(monitors):
            row = np.zeros(2 * monitors + columns + len(J))
            row[2 * m + plane[c]] = u[c, m]
            row[2 * monitors + c] = v[c, m]
            row[2 * monitors + columns :] = J[:, c, m]
            rows.append(row)
    return np.array(rows)


def test_fit_vs_dense_least_squares(problem, rng):
    residual, weight, *_ = problem
    X = dense(*problem)
    start = 0.05 * rng.standard_normal(X.shape[1])
    found = fit(*problem, 0.3, 0.2, 0.1, start=start, rounds=1)
    prior = np.concatenate([np.full(18, 0.3), np.full(12, 0.2), np.full(7, 0.1)])
    w, y = weight.ravel(), np.nan_to_num(residual.ravel()) + X @ start
    matrix = X.T @ (w[:, None] * X) + np.diag(prior**-2)
    whole = np.linalg.solve(matrix, X.T @ (w * y))
    mine = np.concatenate([found.monitor.ravel(), found.column, found.ring])
    assert_allclose(mine, whole, atol=1e-9)
    assert_allclose(found.sigma, np.sqrt(np.diag(np.linalg.inv(matrix))), rtol=1e-8)
    left = y - X @ whole
    seen = w > 0
    assert_allclose(found.left.ravel()[seen], left[seen], atol=1e-9)


def test_scale_of_the_prior_is_that_of_the_truth(rng):
    """200 errors of rms 0.003: the evidence finds it to some 5 % where readings are good."""
    columns, monitors, errors = 40, 30, 200
    J = rng.standard_normal((errors, columns, monitors))
    truth = 3e-3 * rng.standard_normal(errors)
    noise = 1e-3
    residual = np.tensordot(truth, J, 1) + noise * rng.standard_normal((columns, monitors))
    flat = np.full((columns, monitors), noise**-2)
    nothing = np.zeros((columns, monitors))
    plane = np.zeros(columns, dtype=int)
    found = fit(residual, flat, plane, nothing, nothing, J, 0.1, 0.1, 0.1)
    assert_allclose(found.scale, truth.std(), rtol=0.1)
    pull = (found.ring - truth) / found.sigma[-errors:]
    assert 0.8 < pull.std() < 1.2
