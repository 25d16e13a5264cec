"""The bubble's five-dimensional form and its maps against the equation in R alone."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from tmlattice.maps import right_hand_side, taylor_map_of_ode
from tmlattice.maps.ode import OdeError
from tmlattice.systems.cavitation import GENTLE, READING, STEPS, Bubble, damping_of, ladder, learn


def test_the_polynomial_form_is_rayleigh_plesset():
    bubble = Bubble(drive=0.65)
    times = np.linspace(0, 2 * bubble.period, 50)
    done = solve_ivp(
        right_hand_side(bubble.terms), (0, times[-1]), bubble.start, method="DOP853",
        t_eval=times, rtol=1e-12, atol=1e-13,
    )  # fmt: skip
    np.testing.assert_allclose(done.y.T, bubble.solution(times), atol=1e-8)


def test_a_bubble_at_rest_rings_at_minnaert_with_tension():
    # omega^2 = (3 p_g - 2 sigma / R) / (rho R^2) for an isothermal gas, without vapour
    bubble = Bubble(vapour=0.0, viscosity=0.0, drive=0.0)
    m = taylor_map_of_ode(bubble.terms, 1, 0.1)
    angles = np.abs(np.angle(np.linalg.eigvals(m.coefficients[1]))) / 0.1 / bubble.time
    surface = 2 * bubble.tension / bubble.radius
    omega = np.sqrt((3 * (bubble.pressure + surface) - surface) / bubble.density) / bubble.radius
    wave = 2 * np.pi * bubble.frequency
    assert min(abs(angles - omega)) < 1e-6 * omega
    assert min(abs(angles - wave)) < 1e-6 * wave


def test_maps_follow_growth_collapse_and_rebound():
    bubble = Bubble(drive=0.65)
    run = ladder(bubble, order=5, tolerance=1e-2).follow(bubble.start, 1.5 * bubble.period)
    truth = bubble.solution(run.times)
    assert run.times[-1] == pytest.approx(1.5 * bubble.period)
    assert truth[:, 0].max() > 0.5
    assert truth[:, 0].min() < -0.5
    assert np.abs(run.states - truth)[:, 0].max() < 1e-2  # measured 7e-3
    steps = np.diff(run.times)
    smallest = run.radius[:-1] < 0.6
    assert steps[smallest].max() < steps.max()


def test_a_ladder_that_is_too_short_is_an_error():
    bubble = Bubble(drive=0.8)
    with pytest.raises(OdeError, match="more halvings"):
        ladder(bubble, order=3, halvings=2).follow(bubble.start, bubble.period)


@pytest.mark.slow
def test_viscosity_is_learned_from_one_oscillation_and_predicts_a_stronger_wave():
    times = GENTLE.period / STEPS * np.arange(2 * STEPS + 1)
    radii = GENTLE.solution(times[: STEPS * 3 // 2 + 1])[:, 0] + 1
    noisy = radii + READING * np.random.default_rng(1).normal(size=radii.shape)
    wrong = replace(GENTLE, viscosity=0.5 * GENTLE.viscosity)
    learned = learn(noisy, wrong)
    value, error = learned.viscosity
    assert abs(value - GENTLE.viscosity) < 3 * error
    assert GENTLE.viscosity - wrong.viscosity > 3 * error
    stronger = replace(GENTLE, drive=0.5).solution(times)[:, 0] + 1
    model = replace(wrong, drive=0.5).solution(times)[:, 0] + 1
    ours = np.sqrt(np.mean((learned.radii(2, 0.5) - stronger) ** 2))
    assert ours < 0.15 * np.sqrt(np.mean((model - stronger) ** 2))


def test_damping_of_a_model_is_what_went_in():
    m = taylor_map_of_ode(GENTLE.terms, 2, 0.02)
    assert damping_of(m, 0.02) == pytest.approx(GENTLE.damping, rel=1e-9)
