"""Common factors of many numbers, given others that cannot be resolved."""

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from tmlattice.inference.common_factors import FactorModel

SUPPLIES, EACH = 12, 4
MEMBERS = np.kron(np.eye(SUPPLIES), np.ones((EACH, 1)))
NOISE = 1e-2
TRIED = tuple(np.geomspace(0.03, 3, 9))


def few_readings(changes, seed, readings=14):
    """Factors of supplies whose changes a few readings see, all of them in each."""
    rng = np.random.default_rng(seed)
    slopes = rng.standard_normal((readings, len(MEMBERS)))
    slopes[:, : 4 * EACH] *= 6  # four are seen well
    read = slopes @ MEMBERS @ changes + NOISE * rng.standard_normal(readings)
    return FactorModel(
        slopes.T @ slopes / NOISE**2, slopes.T @ read / NOISE**2, MEMBERS,
        np.full(len(MEMBERS), 1e-4), np.full(SUPPLIES, 3.0),
    )  # fmt: skip


def test_evidence_given_others_is_that_of_the_readings():
    rng = np.random.default_rng(3)
    slopes = rng.standard_normal((9, len(MEMBERS)))
    y = slopes @ MEMBERS @ rng.standard_normal(SUPPLIES)
    own = FactorModel(slopes.T @ slopes, slopes.T @ y, MEMBERS, np.full(len(MEMBERS), 0.1),
                 np.full(SUPPLIES, 3.0))  # fmt: skip
    chosen, others, rms = [1, 4], [0, 2, 7], 0.6
    made = own.given(others, rms)
    plain = np.eye(9)
    sizes = np.zeros(SUPPLIES)
    sizes[chosen], sizes[others] = 3.0, rms
    spread = slopes @ MEMBERS * sizes
    covariance = plain + 0.1 * slopes @ slopes.T + spread @ spread.T
    expected = multivariate_normal(np.zeros(9), covariance).logpdf(y)
    expected -= multivariate_normal(np.zeros(9), plain).logpdf(y)
    found = made.background + made.log_evidence(chosen) + own.cost[chosen].sum()
    assert found == pytest.approx(expected)
    amounts, within = made.fitted(chosen)
    shape = slopes @ MEMBERS[:, chosen]
    rest = covariance - 9.0 * shape @ shape.T
    exact = np.linalg.inv(shape.T @ np.linalg.solve(rest, shape) + np.eye(2) / 9)
    np.testing.assert_allclose(within, exact)
    np.testing.assert_allclose(amounts, exact @ shape.T @ np.linalg.solve(rest, y))


def pulls(given, seeds=30):
    """Pulls of the selected amounts where all supplies changed."""
    found = []
    for seed in range(seeds):
        changes = np.random.default_rng(100 + seed).standard_normal(SUPPLIES)
        own = few_readings(changes, seed)
        chosen = own.choose(SUPPLIES)
        over = [(own, 1.0)]
        if given:
            there = own.given_others(chosen, range(SUPPLIES), TRIED)
            own, chosen, over = there.levels, there.chosen, there.over
        found += [(r.amount - changes[r.candidate]) / r.sigma
                  for r in own.reasons(chosen, over)]  # fmt: skip
    return np.array(found)


def test_unresolved_factors_are_in_the_errors_of_the_selected():
    with_others, without = pulls(True), pulls(False)
    assert len(with_others) > 30
    assert np.sqrt(np.mean(with_others**2)) < 1.6
    assert np.sqrt(np.mean(without**2)) > 3 * np.sqrt(np.mean(with_others**2))


def test_nothing_is_learnt_of_others_that_did_not_change():
    for seed in range(20):
        changes = np.zeros(SUPPLIES)
        changes[[1, 3]] = 1.0, -0.7
        own = few_readings(changes, seed)
        chosen = own.choose(SUPPLIES)
        there = own.given_others(chosen, range(SUPPLIES), TRIED)
        assert (there.levels, there.chosen, there.rms) == (own, chosen, 0.0)
        assert {1, 3} <= set(chosen)


def test_no_selected_factor_no_common_scale():
    own = few_readings(np.random.default_rng(0).standard_normal(SUPPLIES), 0)
    for chosen, alike in (([], range(SUPPLIES)), ([7], [1, 2, 3])):
        there = own.given_others(chosen, alike, TRIED)
        assert (there.levels, there.chosen, there.rms, there.over) == (
            own, chosen, 0.0, ((own, 1.0),)
        )  # fmt: skip
