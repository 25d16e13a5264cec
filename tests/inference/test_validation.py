"""What is stated of held-out readings holds: the misfit to expect, and the interval of the gap."""

from dataclasses import replace

import numpy as np
import pytest

from tmlattice.inference.validation import Half, Residuals, cross_predicted, held_out_gap

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
    model = errors.T / SIGMA if unknown else np.zeros((0, 2 * READINGS))
    first, second = (
        Half(left / SIGMA, slopes / SIGMA, own)
        for left, slopes, own in zip(
            np.split(read, 2), launch, np.split(model, 2, axis=1), strict=True
        )
    )
    return cross_predicted(first, second, np.full(READINGS, SIGMA))


@pytest.mark.parametrize("unknown", [False, True])
def test_expected_misfit_is_the_measured_one(halves, rng, unknown):
    found = [held_out_gap([[judged(halves, 0.0, rng, unknown)]]).misfits[0] for _ in range(300)]
    square = np.mean([one.rms**2 for one in found])
    assert np.sqrt(square) == pytest.approx(found[0].expected, rel=0.05)
    # 300 times 40 readings: a width of 0.013
    assert np.mean([one.chi2_per_dof for one in found]) == pytest.approx(1, abs=0.05)


def test_a_launch_known_beforehand_is_weighed_with_the_readings(halves, rng):
    launch, _ = halves
    known = np.full(LAUNCHES, 1e-6)
    none = np.zeros((0, READINGS))
    misfits = []
    for _ in range(200):
        true = known * rng.standard_normal(LAUNCHES)
        read = launch @ true + SIGMA * rng.standard_normal((2, READINGS))
        prior = np.zeros((0, READINGS + LAUNCHES))
        rows = np.concatenate([launch[0] / SIGMA, np.diag(1 / known)])
        first = Half(np.append(read[0] / SIGMA, np.zeros(LAUNCHES)), rows, prior)
        second = Half(read[1] / SIGMA, launch[1] / SIGMA, none)
        left = cross_predicted(first, second, np.full(READINGS, SIGMA))
        misfits.append(held_out_gap([[left]]).misfits[0])
    assert np.mean([one.chi2_per_dof for one in misfits]) == pytest.approx(1, abs=0.05)
    assert misfits[0].expected < 1.01 * SIGMA  # the readings alone: 1.05


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
        low, high = held_out_gap([[left] for left in both]).interval
        inside.append(low <= true <= high)
    assert 0.92 < np.mean(inside) <= 0.98  # a width of 0.011


def test_no_share_is_stated_of_a_gap_within_the_noise(halves, rng):
    both = [[judged(halves, 0.0, rng, False)] for _ in range(2)]
    assert held_out_gap(both).explained is None


def test_a_gap_is_not_scored_if_a_model_loses_the_beam(halves, rng):
    whole = judged(halves, 1e-4, rng, False)
    fewer = Residuals(whole.residual[1:], whole.noise[1:], whole.spread[1:])
    found = held_out_gap([[whole], [fewer]])
    assert found.explained is None
    assert found.lost
    assert not held_out_gap([[whole]] * 2).lost


def test_readings_of_two_measurements_count_by_their_noise(halves, rng):
    """Of precise orbits all of the gap is explained, of a dispersion nothing, which is far larger
    in metres and half as large in units of the noise: 4 of 5."""
    orbits, coarse = (judged(halves, 0.0, rng, False) for _ in range(2))
    dispersion = replace(coarse, noise=1e3 * coarse.noise)
    far = rng.standard_normal(READINGS)
    before = [
        replace(one, residual=one.residual + size * far)
        for one, size in ((orbits, 2e3), (dispersion, 1e3))
    ]
    found = held_out_gap([before, [orbits, before[1]]])
    assert found.explained == pytest.approx(0.8, abs=1e-2)


def test_what_the_readings_of_the_fit_removed_is_no_uncertainty(halves, rng):
    """Errors of the model less those that earlier readings determine: the whole covariance."""
    launch, errors = halves
    seen = 0.5 * errors[:, :10]
    rows = np.concatenate([errors, seen], axis=1).T / SIGMA
    first, second = (
        Half(np.zeros(READINGS), slopes / SIGMA, own)
        for slopes, own in zip(launch, np.split(rows, 2, axis=1), strict=True)
    )
    found = cross_predicted(first, second, np.full(READINGS, SIGMA), known=10)
    gain = launch[1] @ np.linalg.pinv(launch[0])
    takes = np.hstack([-gain, np.eye(READINGS)])
    whole = takes @ (errors @ errors.T - seen @ seen.T) @ takes.T / SIGMA**2
    np.testing.assert_allclose(found.unknown, whole, atol=1e-9 * np.abs(whole).max())
