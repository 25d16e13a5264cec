"""What is stated of held-out readings holds: the misfit to expect, and the interval of the gap."""

import numpy as np
import pytest

from tmlattice.inference.judge import Half, Judged, Left, held_out_gap, other_half

READINGS, LAUNCHES, ERRORS = 40, 4, 30
SIGMA = 20e-6


@pytest.fixture
def halves(rng):
    """Slopes of launch and of small errors in both halves, and the rms that the errors leave."""
    launch = rng.standard_normal((2, READINGS, LAUNCHES))
    errors = 10e-6 * rng.standard_normal((2 * READINGS, ERRORS))
    return launch, errors


def judged(halves, signal, rng, unknown):
    launch, errors = halves
    truth = signal + (errors @ rng.standard_normal(ERRORS) if unknown else 0.0)
    moved = np.concatenate(launch) @ (1e-4 * rng.standard_normal(LAUNCHES))
    read = truth + moved + SIGMA * rng.standard_normal(2 * READINGS)
    sigma = np.full(READINGS, SIGMA)
    first, second = (
        Half(part, slopes, sigma) for part, slopes in zip(np.split(read, 2), launch, strict=True)
    )
    covariance = errors @ errors.T if unknown else None
    none = np.zeros(LAUNCHES)
    return other_half(first, second, none, none, covariance)


def of(left):
    return Judged(left.residual.reshape(1, -1, 1), (left,))


@pytest.mark.parametrize("unknown", [False, True])
def test_the_misfit_to_expect_is_what_comes(halves, rng, unknown):
    found = [held_out_gap([of(judged(halves, 0.0, rng, unknown))]).misfits[0] for _ in range(300)]
    square = np.mean([one.rms**2 for one in found])
    assert np.sqrt(square) == pytest.approx(found[0].expected, rel=0.05)
    # 300 times 40 readings: a width of 0.013
    assert np.mean([one.chi2_per_dof for one in found]) == pytest.approx(1, abs=0.05)


def test_a_launch_known_beforehand_is_weighed_with_the_readings(halves, rng):
    launch, _ = halves
    sigma = np.full(READINGS, SIGMA)
    known = np.full(LAUNCHES, 1e-6)
    errors = []
    for _ in range(200):
        true = known * rng.standard_normal(LAUNCHES)
        first, second = (
            Half(slopes @ true + SIGMA * rng.standard_normal(READINGS), slopes, sigma)
            for slopes in launch
        )
        left = other_half(first, second, np.zeros(LAUNCHES), known**-2)
        errors.append(left.residual @ np.linalg.solve(left.noise, left.residual) / READINGS)
    assert np.mean(errors) == pytest.approx(1, abs=0.05)
    assert np.sqrt(np.trace(left.noise) / READINGS) < 1.01 * SIGMA  # the readings alone: 1.05


def test_the_interval_of_what_is_closed_holds_in_95_per_cent(halves, rng):
    launch, _ = halves
    gap = 60e-6 * rng.standard_normal(2 * READINGS)
    rest = 0.3 * gap + 5e-6 * rng.standard_normal(2 * READINGS)  # what the model leaves of it
    gain = np.linalg.pinv(launch[0])
    clean = [part[READINGS:] - launch[1] @ (gain @ part[:READINGS]) for part in (gap, rest)]
    true = 1 - np.sum(clean[1] ** 2) / np.sum(clean[0] ** 2)
    inside = []
    for seed in range(400):
        both = [judged(halves, part, np.random.default_rng(seed), False) for part in (gap, rest)]
        low, high = held_out_gap([of(left) for left in both]).interval
        inside.append(low <= true <= high)
    assert 0.92 < np.mean(inside) <= 0.98  # a width of 0.011


def test_no_share_is_told_of_a_gap_within_the_noise(halves, rng):
    both = [of(judged(halves, 0.0, rng, False)) for _ in range(2)]
    assert held_out_gap(both).explained is None


def test_a_gap_of_which_a_model_loses_the_beam_is_judged_by_nobody(halves, rng):
    whole = judged(halves, 1e-4, rng, False)
    seen = whole.residual.copy()
    seen[0] = np.nan
    fewer = Left(whole.residual[1:], whole.noise[1:, 1:])
    found = held_out_gap([of(whole), Judged(seen.reshape(1, -1, 1), (fewer,))])
    assert found.explained is None
    assert found.lost
    assert not held_out_gap([of(whole)] * 2).lost
