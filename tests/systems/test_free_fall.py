"""Free fall against the hyperbolic tangent and the paper's figures."""

import numpy as np
import pytest

from tmlattice.systems.free_fall import (
    comparisons,
    predicted_masses,
    runge_kutta_map,
    step_errors,
    velocity,
)
from tmlattice.systems.learning import weights_of


def test_velocity_obeys_the_equation():
    t, h = np.linspace(0, 10, 7), 1e-5
    slope = (velocity(t + h, 80.0) - velocity(t - h, 80.0)) / (2 * h)
    np.testing.assert_allclose(slope, 9.8 - 0.392 / 80 * velocity(t, 80.0) ** 2, rtol=1e-8)


def test_runge_kutta_is_a_map_of_degree_16():
    v, step = 12.0, 0.1
    rows = weights_of(runge_kutta_map(step))
    assert rows.shape == (1, 17)
    assert rows[0, 16] != 0
    k = [9.8 - 0.00392 * v**2]
    for part in (0.5, 0.5, 1.0):
        k.append(9.8 - 0.00392 * (v + part * step * k[-1]) ** 2)
    by_hand = v + step / 6 * (k[0] + 2 * k[1] + 2 * k[2] + k[3])
    np.testing.assert_allclose(runge_kutta_map(step)([v]), [by_hand], rtol=1e-14)


def test_errors_fall_with_the_step_by_the_order():
    errors = step_errors([0.2, 0.1])
    slopes = {k: np.log2(e[0] / e[1]) for k, e in errors.taylor.items()}
    assert np.log2(errors.euler[0] / errors.euler[1]) == pytest.approx(1, abs=0.1)
    assert slopes[2] == pytest.approx(1, abs=0.1)  # v^3 comes with the step squared, once a step
    assert slopes[4] == pytest.approx(3, abs=0.2)
    assert np.log2(errors.runge_kutta[0] / errors.runge_kutta[1]) == pytest.approx(4, abs=0.2)


def test_a_map_of_two_masses_predicts_others_and_a_forest_does_not():
    pytest.importorskip("sklearn")
    found = predicted_masses([60, 70, 90, 120, 150])
    assert (found.taylor < 0.5).all()  # of 38 to 61 m/s; measured 0.02 to 0.45
    assert (found.forest > 5 * found.taylor).all()
    assert found.forest.max() > 10


def test_the_table_names_the_misprints():
    rows = comparisons(step_errors([0.5]), predicted_masses([90], forest=False))
    by_name = {row.quantity: row for row in rows}
    quadratic = by_name["dt = 0.1 s: quadratic [s/m]"]
    assert quadratic.here == pytest.approx(-3.91799e-4, abs=5e-10)
    assert quadratic.paper == -3.842686e-4
    assert "misprint" in quadratic.why
    assert by_name["steps of 15 s at 0.5 s"].here == 30
