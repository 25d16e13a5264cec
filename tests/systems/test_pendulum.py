"""The pendulum: recovered length and damping against what was put in, and the real film."""

import numpy as np
import pytest

from tmlattice.maps import taylor_map_of_ode
from tmlattice.systems.pendulum import (
    damping_of,
    equation,
    film,
    filmed,
    ideal_map,
    learn,
    length_of,
    predict,
)


@pytest.fixture(scope="module")
def learned():
    return learn(filmed(0.09, np.random.default_rng(0)))


def test_length_and_damping_of_a_map_ignore_the_choice_of_velocity():
    m = taylor_map_of_ode(equation(0.25, 0.3), 3, 0.1)
    assert length_of(m) == pytest.approx(0.25, rel=1e-10)
    assert damping_of(m) == pytest.approx(0.3, rel=1e-9)
    change = type(m).linear([[1.0, 0.0], [0.4, 2.0]], 3)
    back = type(m).linear(np.linalg.inv([[1.0, 0.0], [0.4, 2.0]]), 3)
    assert length_of(change @ m @ back) == pytest.approx(0.25, rel=1e-9)
    assert damping_of(change @ m @ back) == pytest.approx(0.3, rel=1e-9)


def test_length_and_damping_within_their_errors():
    pulls = []
    for seed in range(8):
        made = learn(filmed(0.09, np.random.default_rng(seed)))
        pulls.append([
            (value - truth) / error
            for (value, error), truth in ((made.length, 0.28), (made.damping, 0.2))
        ])  # fmt: skip
    assert np.abs(pulls).max() < 3.5
    assert (np.abs(np.mean(pulls, axis=0)) < 1).all()
    assert (np.std(pulls, axis=0) < 1.6).all()


def test_errors_are_small_enough_to_tell_the_true_pendulum_from_the_ideal(learned):
    (length, dl), (damping, dd) = learned.length, learned.damping
    assert 0.30 - length > 10 * dl
    assert damping > 10 * dd
    assert learned.noise == pytest.approx(2e-3, rel=0.35)


@pytest.mark.parametrize("angle", [0.05, -0.17, 0.3])
def test_other_starts_are_predicted_better_than_by_the_ideal(learned, angle, rng):
    truth = filmed(angle, rng, noise=0.0)
    rms = np.sqrt(np.mean((learned.swing(angle) - truth) ** 2))
    ideal = np.sqrt(np.mean((predict(ideal_map(), truth) - truth) ** 2))
    assert rms < 0.02 * abs(angle)
    assert rms < ideal / 10


def test_a_pushed_start_is_predicted(learned, rng):
    truth = filmed(0.1, rng, noise=0.0, velocity=-0.3)
    assert np.sqrt(np.mean((learned.swing(0.1, -0.3) - truth) ** 2)) < 3e-3


def test_the_film_learned_from_one_swing_predicts_the_other():
    a, b = film("a"), film("b")
    if a is None or b is None:
        pytest.skip("TMLATTICE_DATA does not hold pendulum/")
    made = learn(a)
    assert 0.25 < made.length[0] < 0.29  # the builder says 0.28; the film's period asks for 0.266
    assert made.damping[0] > 0.1
    ours, ideal = (predict(m, b)[5:] - b[5:] for m in (made.fit.taylor_map, ideal_map()))
    assert np.sqrt(np.mean(ours**2)) < 0.5 * np.sqrt(np.mean(ideal**2))
