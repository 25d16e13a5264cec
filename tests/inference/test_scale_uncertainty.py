"""What the sizes of families are unknown by, against all sizes one by one."""

import numpy as np
import pytest

from tmlattice.inference import errors
from tmlattice.inference.errors import FACTORS, scale_covariance
from tmlattice.inference.normal import Normal, solve
from tmlattice.inference.priors import Group

READINGS = 40


@pytest.fixture
def problem(monkeypatch):
    """Ten numbers that are known, and one of a kind of its own that two of them make up for."""
    monkeypatch.setattr(errors, "DRAWS", 3000)
    random = np.random.default_rng(2)
    J = random.standard_normal((READINGS, 11))
    J[:, 10] = J[:, 0] + J[:, 1] + 0.1 * J[:, 10]
    truth = np.append(0.3 * random.standard_normal(10), 1.2)
    left = J @ truth + 0.5 * random.standard_normal(READINGS)
    eye = np.eye(11)
    return J / 0.5, left / 0.5, Group("many", eye[:, :10], 0.5), Group("one", eye[:, 10:], 0.02)


def one_by_one(J, left, sizes, chances):
    """Mean and variance of each number, every size weighed with its evidence, densely."""
    logs, means, variances = [], [], []
    for size, chance in zip(sizes, chances, strict=True):
        prior = np.append(np.full(10, 0.25), size**2)
        V = np.eye(len(left)) + (J * prior) @ J.T
        gain = (prior[:, None] * J.T) @ np.linalg.inv(V)
        logs.append(np.log(chance) - 0.5 * left @ np.linalg.solve(V, left)
                    - 0.5 * np.linalg.slogdet(V)[1])  # fmt: skip
        means.append(gain @ left)
        variances.append(prior - np.sum(gain * (J * prior).T, axis=1))
    share = np.exp(np.array(logs) - max(logs))
    return share / share.sum(), np.array(means), np.array(variances)


def variance(factor):
    return np.sum(factor**2, axis=1)


def hyperprior(sizes, group):
    chances = np.exp(-0.5 * (np.log(sizes / group.guess) / group.guessed) ** 2)
    return chances / chances.sum()


def test_a_size_that_the_data_hardly_tell_is_in_the_errors(problem):
    J, left, many, one = problem
    normal = Normal(J.T @ J, J.T @ left)
    more = variance(scale_covariance(normal, [many, one], np.zeros(11)))
    sizes = one.rms * np.exp(FACTORS)
    share, means, variances = one_by_one(J, left, sizes, hyperprior(sizes, one))
    posterior = solve(normal, [many, one], rounds=0)
    told, stated = posterior.values, posterior.sigma**2
    expected = share @ (variances + (means - told) ** 2) - stated
    np.testing.assert_allclose(more, expected, rtol=0.1, atol=1e-3)
    assert more[10] > 10 * stated[10]  # held at zero by a size of 0.02, and it is 1.2
    assert more[0] > stated[0]  # which makes up for it
    assert (more[2:10] < 0.2 * stated[2:10]).all()


def test_a_rejected_family_may_be_present(problem):
    J, left, many, one = problem
    normal = Normal(J.T @ J, J.T @ left)
    more = variance(scale_covariance(normal, [many, one], np.zeros(11), ["one"]))
    sizes = one.rms * np.exp(FACTORS)
    chances = np.append(1.0, hyperprior(sizes, one))  # as likely not there as there
    share, means, variances = one_by_one(J, left, np.append(0.0, sizes), chances)
    told, stated = means[0], variances[0]
    expected = share @ (variances + (means - told) ** 2) - stated
    np.testing.assert_allclose(more, expected, rtol=0.1, atol=1e-3)


def test_rejected_families_are_exchangeable(problem, monkeypatch):
    """ALS: one of two families that do nearly the same is present; a chain may stay with one."""
    monkeypatch.undo()  # draws as many as it draws
    J, left, *_ = problem
    J = np.column_stack([J, J[:, 10] + 0.5 * np.random.default_rng(3).standard_normal(len(J))])
    eye = np.eye(12)
    groups = [
        Group("many", eye[:, :10], 0.5),
        *(Group(f"one {i}", eye[:, [i]], 0.02) for i in (10, 11)),
    ]
    sizes = 0.02 * np.exp(FACTORS)
    chances = np.append(1.0, hyperprior(sizes, groups[1]))
    every = np.append(0.0, sizes)
    logs, means, variances = [], [], []
    for a, first in zip(every, chances, strict=True):
        for b, second in zip(every, chances, strict=True):
            prior = np.concatenate([np.full(10, 0.25), [a**2, b**2]])
            V = np.eye(len(left)) + (J * prior) @ J.T
            gain = (prior[:, None] * J.T) @ np.linalg.inv(V)
            evidence = -0.5 * left @ np.linalg.solve(V, left) - 0.5 * np.linalg.slogdet(V)[1]
            logs.append(np.log(first * second) + evidence)
            means.append(gain @ left)
            variances.append(prior - np.sum(gain * (J * prior).T, axis=1))
    share = np.exp(np.array(logs) - max(logs))
    share /= share.sum()
    expected = share @ (np.array(variances) + (np.array(means) - means[0]) ** 2) - variances[0]
    assert (expected[10:] > 0.05).all()  # either may be there
    normal = Normal(J.T @ J, J.T @ left)
    more = variance(scale_covariance(normal, groups, np.zeros(12), ["one 10", "one 11"]))
    np.testing.assert_allclose(more[10:], expected[10:], rtol=0.35)


def test_known_scales_add_nothing(problem):
    J, left, many, one = problem
    normal = Normal(J.T @ J, J.T @ left)
    posterior = solve(normal, [many], rounds=20)
    assert not scale_covariance(normal, posterior.groups, np.zeros(11)).any()
    held = Group("one", one.basis, 10.0, fixed=True)
    assert not scale_covariance(normal, [*posterior.groups, held], np.zeros(11)).any()
