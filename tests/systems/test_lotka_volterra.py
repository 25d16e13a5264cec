"""Lotka-Volterra: the learned map against the equation's, and the verdicts of the table."""

import numpy as np
import pytest

from tmlattice.maps import taylor_map_of_ode
from tmlattice.systems.learning import follow, weights_of
from tmlattice.systems.lotka_volterra import EQUATION, STEP, UNSEEN, Cell, learn, solutions


def test_solutions_keep_their_invariant():
    # x' = y (1 + x), y' = -x (2 + y): x - ln(1 + x) + y - 2 ln(1 + y / 2) stays
    for x, y in np.moveaxis(solutions([(0.5, 0.5), (0.8, 0.8)]), 2, 1):
        kept = x - np.log1p(x) + y - 2 * np.log1p(y / 2)
        np.testing.assert_allclose(kept, kept[0], rtol=1e-10)


def test_the_map_of_one_solution_predicts_the_unseen():
    truth = solutions(UNSEEN)
    run = follow(learn(), truth[:, 0], truth.shape[1] - 1).swapaxes(0, 1)
    assert (np.sqrt(np.mean((run - truth) ** 2, axis=(1, 2))) < 5e-3).all()  # measured 1.5e-3
    model = weights_of(taylor_map_of_ode(EQUATION, 3, STEP))
    assert np.abs(weights_of(learn()) - model)[:, 1:3].max() < 5e-5


@pytest.mark.parametrize(
    ("learned", "unseen", "verdict"),
    [
        (0.01, (0.01, 0.04, 0.0), "generalised"),
        (0.01, (0.01, 0.06, 0.0), "memorised"),
        (0.06, (0.01, 0.01, 0.0), "underfitted"),
        (np.inf, (0.01, 0.01, 0.0), "underfitted"),
    ],
)
def test_the_criterion(learned, unseen, verdict):
    assert Cell("", "none", 1, learned, unseen, 1).verdict == verdict
