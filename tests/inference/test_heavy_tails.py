"""Posterior moments with one faulty member among others, against every combination of scales."""

from itertools import product

import numpy as np
import pytest

from tmlattice.inference.errors import moments
from tmlattice.inference.normal import Normal, solve
from tmlattice.inference.priors import Group

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
