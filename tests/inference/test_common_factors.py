"""Common factors of many numbers, given others that cannot be resolved; likely sets of them."""

from itertools import combinations

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from tmlattice.inference.common_factors import FactorModel, likely_sets, over_sets

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


# --- sets of reasons: all that are likely, by enumerating every set of few candidates -------------
FAMILIES = np.kron(np.eye(4), np.ones((10, 1)))
A, B, C, D, FIRST_THREE, LAST_TWO, ALL = range(7)
CANDIDATES = np.column_stack(
    [FAMILIES, FAMILIES[:, :3].sum(axis=1), FAMILIES[:, 2:].sum(axis=1), np.ones(40)]
)


def levels(means, noise=0.1, candidates=CANDIDATES, seed=0):
    """Of 40 numbers in four families, each known to `noise`."""
    values = FAMILIES @ np.array(means, dtype=float)
    values = values + noise * np.random.default_rng(seed).standard_normal(40)
    information = np.eye(40) / noise**2
    return FactorModel(
        information,
        information @ values,
        candidates,
        np.full(40, 1e-12),
        np.full(candidates.shape[1], 3.0),
    )


def two_ways(means, noise=0.1):
    """The first of four families is told by itself, or beside what three share: as likely."""
    own = levels(means, noise, np.delete(CANDIDATES, [LAST_TWO, ALL], axis=1))
    rest = [D] if means[D] else []
    own.cost[FIRST_THREE] += own.log_evidence([A, FIRST_THREE, *rest])
    own.cost[FIRST_THREE] -= own.log_evidence([A, B, C, *rest])
    return own


def test_every_likely_set_is_found_with_its_probability():
    own = two_ways([2, 1, 1, 0.5], 0.3)
    every = [one for count in range(6) for one in combinations(range(5), count)]
    every = [one for one in every if (own.squares(one) >= 25).all()]
    logs = np.array([own.log_evidence(one) for one in every])
    shares = np.exp(logs - logs.max())
    shares /= shares.sum()
    expected = {one: share for one, share in zip(every, shares, strict=True) if share > 1e-2}
    found = {one.chosen: one.probability for one in likely_sets(own, 5)}
    assert len(expected) > 1
    for one, share in expected.items():
        assert found[one] == pytest.approx(share, abs=0.01)


def test_log_evidence_is_that_of_the_readings():
    """Against the density of the readings themselves, with and without the candidates."""
    own = levels([2, 1, 1, 0])
    chosen = [A, FIRST_THREE]
    noise = 0.1
    y = np.linalg.solve(np.eye(40) / noise**2, own_score(noise))
    with_them = noise**2 * np.eye(40) + 9.0 * CANDIDATES[:, chosen] @ CANDIDATES[:, chosen].T

    def density(covariance):
        return -0.5 * y @ np.linalg.solve(covariance, y) - 0.5 * np.linalg.slogdet(covariance)[1]

    expected = density(with_them) - density(noise**2 * np.eye(40)) - 2 * np.log(7)
    assert own.log_evidence(chosen) == pytest.approx(expected, abs=1e-6)
    assert own.log_evidence(chosen) == pytest.approx(
        own.gains([])[0][A] + own.gains([A])[0][FIRST_THREE]
    )


def own_score(noise):
    values = FAMILIES @ np.array([2.0, 1, 1, 0])
    return (values + noise * np.random.default_rng(0).standard_normal(40)) / noise**2


def test_an_amount_that_depends_on_the_set_has_such_an_error():
    """2, or 1 beside the 1 that three share."""
    own = two_ways([2, 1, 1, 3])
    sets = likely_sets(own, 5)
    told = {one.candidate: (one, there) for one, there in over_sets(own, sets)}
    first, there = told[A]
    assert there > 0.99
    assert first.sigma == pytest.approx(np.sqrt(0.5), rel=0.05)
    last, there = told[D]
    assert there > 0.99
    assert last.sigma < 0.04
    inside = [one for one in sets if FIRST_THREE in one.chosen]
    assert sum(one.probability for one in inside) == pytest.approx(0.5, abs=0.05)


def test_significant_sets_are_reported_though_others_are_more_probable():
    """One more candidate that explains less than is asked for, and more than it costs."""
    own = two_ways([2, 1, 1, 3])
    before = likely_sets(own, 5)
    more = np.concatenate([np.delete(CANDIDATES, [LAST_TWO, ALL], axis=1), np.eye(40)[:, [17]]], 1)
    noise = 0.1
    values = FAMILIES @ np.array([2.0, 1, 1, 3])
    values = values + noise * np.random.default_rng(0).standard_normal(40)
    values[17] += 4.7 * noise - (values[17] - 1)
    information = np.eye(40) / noise**2
    slab = np.append(np.full(5, 3.0), 0.5)
    other = FactorModel(information, information @ values, more, np.full(40, 1e-12), slab)
    other.cost[:5] = own.cost
    other.cost[5] = -8.0
    sets = likely_sets(other, 5)
    assert all(5 not in one.chosen for one in sets)
    assert {one.chosen for one in sets[:2]} == {one.chosen for one in before[:2]}
    assert sets[1].probability > 0.1


def test_sets_of_the_same_span_are_one_reported_in_parts():
    """All by 1 and three by 1 more: the fourth alone by 1, the three by 2."""
    own = levels([2, 2, 2, 1])
    own.cost[ALL] -= 3.0  # else it is found so at once
    sets = likely_sets(own, 7)
    assert sets[0].chosen == (D, FIRST_THREE)
    assert sets[0].probability > 0.9
    assert all(not {ALL, FIRST_THREE} <= set(one.chosen) for one in sets)
    told = {one.candidate: one for one, _ in over_sets(own, sets)}
    assert told[FIRST_THREE].amount == pytest.approx(2, abs=0.1)
    assert told[D].amount == pytest.approx(1, abs=0.1)
    assert told[D].alternatives == ((D, 1.0),)


def test_without_factors_the_empty_set_is_reported():
    own = levels([0, 0, 0, 0])
    sets = likely_sets(own, 7)
    assert sets[0].chosen == ()
    assert over_sets(own, sets) == []


def test_amounts_are_averaged_over_an_uncertain_neighbour():
    """Two numbers that are hardly told apart, one of which is clear: by enumeration."""
    information = np.array([[4.0, 3.9], [3.9, 4.0]]) * 1e2
    own = FactorModel(
        information, information @ [0.8, 0.5], np.eye(2), np.full(2, 1e-12), np.full(2, 3.0)
    )
    alone, both = own.fitted([0]), own.fitted([0, 1])
    odds = np.exp(own.log_evidence([0, 1]) - own.log_evidence([0]))
    share = odds / (1 + odds)
    assert 0.1 < share < 0.9
    mean = (1 - share) * alone[0][0] + share * both[0][0]
    beside = share * (1 - share) * (both[0][0] - alone[0][0]) ** 2
    (amount,), (variance,) = own.averaged([0])
    assert amount == pytest.approx(mean)
    within = (1 - share) * alone[1][0, 0] + share * both[1][0, 0]
    assert variance == pytest.approx(within + beside)
    assert own.reasons([0], [(own, 1.0)])[0].sigma == pytest.approx(np.sqrt(variance))
