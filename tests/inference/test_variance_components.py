"""Sizes of small errors are learnt as they were drawn, and none are seen where there are none."""

import numpy as np
import pytest
from scipy import stats

from tmlattice.inference import chi2
from tmlattice.inference.variance_components import fit_variance_components

ROWS, LAUNCHES = 240, 8


@pytest.fixture
def families(rng):
    """Three families of sixty errors each, seen thirty times over the noise at their usual rms."""
    return [30 / np.sqrt(60) * rng.standard_normal((60, ROWS)) for _ in range(3)]


@pytest.fixture
def launches(rng):
    return np.linalg.qr(rng.standard_normal((ROWS, LAUNCHES)))[0]


def readings(families, scales, launches, rng, noise=1.0):
    made = sum(
        scale * rng.standard_normal(len(own)) @ own
        for own, scale in zip(families, scales, strict=True)
    )
    return (
        made + noise * rng.standard_normal(ROWS) + launches @ (1e4 * rng.standard_normal(LAUNCHES))
    )


def test_sizes_are_those_that_were_drawn(families, launches, rng):
    scales = (0.2, 1.0, 4.0)
    pulls = []
    for _ in range(12):
        found = fit_variance_components(
            readings(families, scales, launches, rng), launches, families
        )
        assert found.log_evidence > 100
        pulls.append(np.log(found.scale / scales) / found.error)
    assert 0.6 < np.sqrt(np.mean(np.square(pulls))) < 1.4  # 36 pulls of width 1


def test_no_small_errors_are_seen_in_noise(families, launches, rng):
    for _ in range(10):
        found = fit_variance_components(
            readings(families, (0, 0, 0), launches, rng), launches, families
        )
        assert found.log_evidence < 0
        assert found.scale.max() < 0.05


def test_a_family_that_is_not_seen_stays_near_the_others(families, launches, rng):
    families[2] = 1e-4 * families[2]
    found = fit_variance_components(
        readings(families, (3, 3, 0), launches, rng), launches, families
    )
    assert 1.5 < found.scale[2] < 6
    assert found.error[2] > 0.5 > found.error[:2].max()


def test_the_noise_of_each_part_is_estimated_too(families, launches, rng):
    first = np.arange(ROWS) < ROWS // 2
    rows = readings([0.02 * own for own in families], (1, 1, 1), launches, rng, noise=0.2)
    rows += np.where(first, 0, 0.8) * rng.standard_normal(ROWS)
    families = [0.02 * own for own in families]
    found = fit_variance_components(rows, launches, families, [first, ~first])
    # (0.2, sqrt(0.04 + 0.64)) to twice the error of a width from 120 values
    assert found.noise == pytest.approx([0.2, 0.825], rel=0.3)


def test_a_square_over_an_estimated_variance_is_as_rare_as_student_says():
    for freedom in (5.0, 30.0):
        square = stats.t.isf(1e-6, freedom) ** 2
        assert stats.chi2.sf(chi2.known(square, freedom), 1) == pytest.approx(2e-6, rel=1e-6)
        assert chi2.estimated(chi2.known(square, freedom), freedom) == pytest.approx(square)
    assert chi2.known(30.0, np.inf) == chi2.estimated(30.0, np.inf) == 30.0
