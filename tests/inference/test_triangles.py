"""Triangular factors and their inverses, against numpy's."""

import numpy as np
import pytest

from tmlattice.inference.normal import MAX_LAPACK, inverse_of_lower, lower_factor


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
