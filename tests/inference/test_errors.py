"""Stated errors: unknown prior scales, and readings that share model discrepancy."""

from itertools import product

import numpy as np
import pytest

from tmlattice.inference import errors
from tmlattice.inference.errors import (
    FACTORS,
    LinearFit,
    Rows,
    cluster_robust_errors,
    scale_covariance,
)
from tmlattice.inference.normal import Normal, Slopes, normal_equations, solve
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
    """Mean and variance of each number, all sizes of the last ones weighed with their evidence."""
    logs, means, variances = [], [], []
    for size, chance in zip(sizes, chances, strict=True):
        prior = np.append(np.full(10, 0.25), np.square(size))
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
    both = product(np.append(0.0, sizes), repeat=2)
    share, means, variances = one_by_one(J, left, both, np.outer(chances, chances).ravel())
    expected = share @ (variances + (means - means[0]) ** 2) - variances[0]
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


# --- errors of a fit whose readings share what the model lacks, against machines that are known ---
COLUMNS, MONITORS, ERRORS = 24, 20, 12
NOISE = 1e-2


def made_up(rng, lacking):
    """Rows of a ring, and what it lacks, three times the noise, by columns or by monitors."""
    plane = np.arange(COLUMNS) % 2
    own = rng.standard_normal((COLUMNS, MONITORS))
    drives, waves = rng.standard_normal((COLUMNS, 2)), rng.standard_normal((2, MONITORS))
    by_ring = rng.standard_normal((ERRORS, COLUMNS, MONITORS))
    gap = np.zeros(own.shape)
    if lacking == "columns":
        by_ring = rng.standard_normal((ERRORS, COLUMNS, 2)) @ waves
        gap = rng.standard_normal((COLUMNS, 2)) @ waves
    elif lacking == "monitors":
        by_ring = drives @ rng.standard_normal((ERRORS, 2, MONITORS))
        gap = drives @ rng.standard_normal((2, MONITORS))
    noise = rng.standard_normal(own.shape)
    return Rows(plane, own, own, [Slopes(by_ring)]), NOISE * (noise + 3 * gap / np.sqrt(2))


def solved(rows, residual, weight):
    """Posterior with numbers of rms 0.1."""
    normal = normal_equations(residual, weight, *rows)
    size = len(normal.vector)
    found = solve(normal, [Group("all", np.eye(size), 0.1, fixed=True)], rounds=0)
    return found, LinearFit.of(normal.matrix, found.spread @ found.covariance @ found.spread.T)


def readings(rows, values):
    """What numbers make, [column, monitor]."""
    shape = rows.by_monitor.shape
    places = (axis.ravel() for axis in np.indices(shape))
    return rows.times(*places, values[:, None]).reshape(shape)


@pytest.mark.parametrize("lacking", ["nothing", "columns", "monitors"])
def test_stated_errors_hold_where_readings_share_model_discrepancy(lacking):
    """Posterior ones are 2.9 times too small there; of real rings up to seven times."""
    rng = np.random.default_rng(4)
    pulls, plain = [], []
    for _ in range(30):
        rows, noise = made_up(rng, lacking)
        truth = 0.1 * rng.standard_normal(2 * MONITORS + COLUMNS + ERRORS)
        weight = np.full(noise.shape, 1 / np.mean(noise**2))
        residual = readings(rows, truth) + noise
        found, there = solved(rows, residual, weight)
        sigma = cluster_robust_errors(rows, weight, residual - readings(rows, found.values), there)
        assert (sigma >= found.sigma * (1 - 1e-9)).all()
        pulls.append(((found.values - truth) / sigma)[-ERRORS:])
        plain.append(((found.values - truth) / found.sigma)[-ERRORS:])
    size, without = (np.sqrt(np.mean(np.square(own))) for own in (pulls, plain))
    assert 0.8 < size < 1.3
    assert without > 2 or lacking == "nothing"


def test_readings_far_above_their_noise_have_errors_all_the_same(rng):
    """What one cluster alone knows is lost in rounding beside it."""
    rows, noise = made_up(rng, "columns")
    noise *= 1e-8
    weight = np.full(noise.shape, 1 / np.mean(noise**2))
    found, there = solved(rows, noise, weight)
    sigma = cluster_robust_errors(rows, weight, noise - readings(rows, found.values), there)
    assert (sigma < 20 * found.sigma).all()
