"""A map learned over a whole solution, against the map that made it and finite differences."""

import numpy as np
import pytest

from tmlattice.maps import TaylorMap, taylor_map_of_ode
from tmlattice.systems.learning import (
    DivergedError,
    fit_map,
    fit_step_by_step,
    follow,
    map_of_weights,
    weights_of,
)

DAMPED = {(0, 1): [1.0, -0.1], (1, 0): [0.0, -1.0], (3, 0): [0.0, 0.3]}


def test_step_by_step_recovers_the_map_that_made_the_solutions(rng):
    truth = taylor_map_of_ode(DAMPED, 3, 0.3)
    solutions = follow(truth, rng.uniform(-0.8, 0.8, (4, 2)), 30).swapaxes(0, 1)
    found = fit_step_by_step(solutions, 3)
    np.testing.assert_allclose(weights_of(found), weights_of(truth), atol=1e-10)


def test_a_hidden_coordinate_and_start_are_recovered():
    truth = taylor_map_of_ode(DAMPED, 3, 0.3)
    solution = follow(truth, [0.5, -0.2], 40)[:, :1]
    first = taylor_map_of_ode({**DAMPED, (0, 1): [1.0, 0.0], (1, 0): [0.0, -0.9]}, 3, 0.3)
    free = np.zeros(weights_of(first).shape, dtype=bool)
    free[1, 1:3] = True
    fit = fit_map(first, solution, (0,), [0.5, 0.0], 1e-3, free, free_start=(1,))
    assert np.abs(fit.residuals).max() < 1e-3
    assert abs(fit.start[1] + 0.2) < 0.02  # the first row of the map stays the wrong model's


def test_error_is_the_spread_of_repeated_measurements():
    truth = taylor_map_of_ode(DAMPED, 3, 0.3)
    clean = follow(truth, [0.5, 0.0], 40)
    free = np.zeros(weights_of(truth).shape, dtype=bool)
    free[1, 1] = True
    found, errors = [], []
    for seed in range(40):
        noisy = clean + 0.01 * np.random.default_rng(seed).normal(size=clean.shape)
        fit = fit_map(truth, noisy, (0, 1), clean[0], 0.01, free)
        found.append(weights_of(fit.taylor_map)[1, 1])
        errors.append(fit.error_of(lambda m: weights_of(m)[1, 1]))
    assert np.std(found) == pytest.approx(np.mean(errors), rel=0.35)  # 40 cases: 11 %
    assert abs(np.mean(found) - weights_of(truth)[1, 1]) < 4 * np.mean(errors) / np.sqrt(40)


def test_missing_observations_are_ignored():
    truth = taylor_map_of_ode(DAMPED, 3, 0.3)
    seen = follow(truth, [0.5, 0.0], 40)
    seen[5:9] = np.nan
    first = map_of_weights(weights_of(truth) * 1.01, 3)
    fit = fit_map(first, seen, (0, 1), [0.5, 0.0], 1e-3)
    np.testing.assert_allclose(
        follow(fit.taylor_map, [0.5, 0.0], 40), follow(truth, [0.5, 0.0], 40), atol=1e-6
    )


def test_a_first_map_that_runs_away_is_refused():
    with pytest.raises(DivergedError, match="diverges at step"):
        fit_map(TaylorMap.linear(np.diag([3.0, 1.0])), np.ones((40, 2)), (0, 1), [1.0, 1.0], 0.1)
