"""Priors of amounts, and posterior moments with one faulty member among others."""

from itertools import product

import numpy as np
import pytest
from scipy.integrate import quad

from tmlattice.beam.model import Model
from tmlattice.effects import Cause, find, rare
from tmlattice.inference.errors import moments
from tmlattice.inference.normal import Normal, solve
from tmlattice.inference.priors import AmountPrior, Group, Student
from tmlattice.machine import simulate
from tmlattice.observe.data import of_measurement
from tmlattice.observe.first_turns import FirstTurns

FREEDOMS = (1.0, 4.0, np.inf)
AMOUNTS = np.array([-0.3, -0.02, 1e-4, 0.01, 0.07, 2.0])


@pytest.mark.parametrize("freedom", FREEDOMS)
def test_density_holds_all_of_the_probability(freedom):
    prior = Student(0.03, freedom)
    total, _ = quad(lambda u: np.exp(prior.peak - prior.penalty(0.03 * u)) * 0.03, -np.inf, np.inf)
    assert total == pytest.approx(1.0, rel=1e-7)


@pytest.mark.parametrize("freedom", FREEDOMS)
def test_pull_towards_zero_is_the_slope_of_the_penalty(freedom):
    prior = Student(0.03, freedom)
    h = 1e-5 * np.abs(AMOUNTS)
    slope = (prior.penalty(AMOUNTS + h) - prior.penalty(AMOUNTS - h)) / (2 * h)
    np.testing.assert_allclose(prior.precision(AMOUNTS) * AMOUNTS, slope, rtol=1e-7)


def test_tails_forgive_what_gauss_does_not():
    far = [float(Student(0.03, freedom).penalty(0.3)) for freedom in FREEDOMS]
    assert far == sorted(far)
    assert far[0] == pytest.approx(np.log(101))  # Cauchy: 1 + 10^2
    assert far[2] == pytest.approx(50)


def test_an_amount_without_a_size_is_even_in_its_logarithm():
    """A decade holds a quarter of four, of both signs; beyond the largest fault it is thin."""
    prior = AmountPrior()

    def density(amount):
        return np.exp(prior.log_density(Cause("corrector_calibration", "c", amount)))

    inside, _ = quad(density, 0.02, 0.2)
    assert 2 * inside == pytest.approx(0.25, rel=1e-6)
    beyond, _ = quad(density, 2.0, 20.0)  # the largest calibration error is 2
    assert beyond < 0.2 * inside
    assert prior.log_density(Cause("monitor_swap", "m", 1.0)) == 0.0


def test_amounts_beyond_the_bound_cannot_be():
    prior = AmountPrior(Student(0.03, np.inf), bound=0.1)
    assert prior.log_density(Cause("quadrupole_gradient", "q", 0.11)) == -np.inf
    assert np.isfinite(prior.log_density(Cause("quadrupole_gradient", "q", -0.09)))


def test_stray_gradient_is_rarer_than_a_magnet_whose_own_gradient_is_wrong(small_ring):
    """In a sextupole; in the middle of a quadrupole it is but another form of its own."""
    effects = ["quadrupole_gradient", "gradient_absolute"]
    places = {name: len(find(name).places(small_ring)) for name in effects}
    data = of_measurement(small_ring, simulate(small_ring, [], shots=1).measurement())
    problem = FirstTurns(
        model=Model(small_ring, data.settings), data=data, places=places,
        rare=rare(small_ring, effects),
    )  # fmt: skip
    own, inside, stray = (
        np.exp(problem.prior((name, place))) * places[name]
        for name, place in (
            ("quadrupole_gradient", "QD::5"),
            ("gradient_absolute", "QD::5"),
            ("gradient_absolute", "sd::5"),
        )
    )
    assert [own, inside] == pytest.approx([(1 - problem.judgement.unknown) / 2] * 2)
    assert stray == pytest.approx(0.1 * own)


# --- posterior moments with one faulty member among others, against every combination of scales ---
SOUND, FAULT = 1e-3, 0.03


def all_combinations(normal, group):
    """Mean and covariance, every combination of the members' scales weighed with its evidence."""
    chances, scales = group.mixture()
    logs, means, squares = [], [], []
    for chosen in product(range(len(scales)), repeat=len(normal.vector)):
        own = list(chosen)
        precision = normal.matrix + np.diag(scales[own] ** -2.0)
        mean = np.linalg.solve(precision, normal.vector)
        logs.append(np.log(chances[own]).sum() - np.log(scales[own]).sum()
                    - np.linalg.slogdet(precision)[1] / 2 + normal.vector @ mean / 2)  # fmt: skip
        means.append(mean)
        squares.append(np.linalg.inv(precision) + np.outer(mean, mean))
    share = np.exp(np.array(logs) - max(logs))
    share /= share.sum()
    mean = share @ np.array(means)
    return mean, np.tensordot(share, np.array(squares), 1) - np.outer(mean, mean)


def problem(slopes, truth, noise):
    """Readings without a noise of their own, which the posterior still has."""
    J = np.asarray(slopes) / noise
    return Normal(J.T @ J, J.T @ (J @ truth))


def members(count):
    return Group("gradient", np.eye(count), SOUND, largest=0.3)


DETERMINED = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
SUM_ALONE = [[1.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
FIRST_UNSEEN = [[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]


@pytest.mark.parametrize("noise", [2e-4, 1e-3, 5e-3])
@pytest.mark.parametrize("slopes", [DETERMINED, SUM_ALONE, FIRST_UNSEEN])
def test_moments_are_those_of_all_combinations_of_scales(slopes, noise):
    """Three members of 24 are read; where two stand for each other a Gaussian is nearly right."""
    group = members(24)
    seen = problem(slopes, np.array([FAULT, 4e-4, -6e-4]), noise)
    matrix, vector = np.zeros((24, 24)), np.zeros(24)
    matrix[:3, :3], vector[:3] = seen.matrix, seen.vector
    found = moments(Normal(matrix, vector), [group], np.zeros(24))
    mean, covariance = all_combinations(seen, group)
    width = np.sqrt(np.diag(covariance))
    assert (np.abs(found.mean[:3] - mean) < 0.1 * width + 2e-5).all()
    alone = slopes is not SUM_ALONE
    stated = np.sqrt(np.diag(found.covariance))
    np.testing.assert_allclose(stated[:3], width, rtol=0.05 if alone else 0.25)
    chances, scales = group.mixture()
    np.testing.assert_allclose(stated[3:], np.sqrt(chances @ scales**2))


def test_a_faulty_member_that_the_data_determine_is_found_and_nothing_else_moves():
    truth = np.array([FAULT, 4e-4, -6e-4])
    found = moments(problem(DETERMINED, truth, 2e-4), [members(3)], np.zeros(3))
    np.testing.assert_allclose(found.mean, truth, atol=2e-4)
    assert (np.sqrt(np.diag(found.covariance)) < 3e-4).all()


def test_either_of_two_members_may_be_the_faulty_one_if_only_their_sum_is_known():
    """A Gaussian prior with a scale learnt for each of them chooses one, 20 stated errors off."""
    truth = np.zeros(24)
    truth[0] = FAULT
    J = np.eye(24)[1:]
    J[0, 0] = 1.0
    normal = Normal(J.T @ J / 2e-4**2, J.T @ (J @ truth) / 2e-4**2)
    found = moments(normal, [members(24)], np.zeros(24))
    np.testing.assert_allclose(found.mean[:2], FAULT / 2, rtol=0.02)
    one, other = width = np.sqrt(np.diag(found.covariance))[:2]
    np.testing.assert_allclose(width, FAULT / 2, rtol=0.25)
    assert found.covariance[0, 1] < -0.95 * one * other
    each = np.full(24, SOUND)
    each[1] = FAULT
    chosen = solve(normal, [Group("gradient", np.eye(24), SOUND, each=each)], rounds=0)
    assert abs(chosen.values[0] - truth[0]) > 20 * chosen.sigma[0]
    assert (np.abs(found.mean - truth)[:2] < 1.5 * width).all()


def test_a_member_that_the_data_do_not_see_may_be_faulty():
    """The stated error covers a fault of 3 %, though the others scatter by 0.1 %."""
    found = moments(problem(FIRST_UNSEEN, np.zeros(3), 2e-4), [members(3)], np.zeros(3))
    assert np.sqrt(found.covariance[0, 0]) > FAULT
    assert np.sqrt(found.covariance[1, 1]) < 3e-4
    gauss = Group("gradient", np.eye(3), SOUND)
    held = moments(problem(FIRST_UNSEEN, np.zeros(3), 2e-4), [gauss], np.zeros(3))
    np.testing.assert_allclose(np.sqrt(held.covariance[0, 0]), SOUND, rtol=1e-2)


@pytest.mark.slow
def test_pulls_are_one_over_machines_as_the_prior_has_them(rng):
    """Eight members, one faulty in the mean, of which the data know half the sum of neighbours."""
    group = members(8)
    chances, scales = group.mixture()
    J = (np.eye(8) + 0.9 * np.roll(np.eye(8), 1, axis=1))[:6] / 1e-3
    squares, faulty = [], []
    for _ in range(400):
        truth = scales[rng.choice(len(scales), 8, p=chances)] * rng.standard_normal(8)
        normal = Normal(J.T @ J, J.T @ (J @ truth + rng.standard_normal(6)))
        found = moments(normal, [group], np.zeros(8))
        squares.append((found.mean - truth) ** 2 / np.diag(found.covariance))
        faulty.append(squares[-1][np.argmax(np.abs(truth))])
    assert 0.9 < np.sqrt(np.mean(squares)) < 1.2
    assert np.sqrt(np.median(faulty)) < 2
