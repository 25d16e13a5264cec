"""The inverse root of a covariance: either way it is one, and both say the same."""

import numpy as np
import pytest

from tmlattice.inference.whitening import inverse_root


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
