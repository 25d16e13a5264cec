"""Readings that tell something of their own."""

import numpy as np
import pytest

from tmlattice.diagnosis.response.weights import independent

COLUMNS, MONITORS = 60, 90


@pytest.fixture
def noise():
    return np.full((COLUMNS, MONITORS), 1e-6)


@pytest.fixture
def white(rng, noise):
    return noise * rng.standard_normal(noise.shape)


def test_noise_is_independent_whatever_its_size(white, noise):
    assert independent(white, noise) > 0.97
    assert independent(3 * white, noise) > 0.97  # stated a third too low
    white[3, 5] = np.nan
    white[:, 7] = np.nan
    assert independent(white, noise) > 0.97


def test_waves_are_few(white, noise, rng):
    """Two betatron waves in every column: 2 x 60 numbers among 5400 readings."""
    phase = np.linspace(0, 40, MONITORS)
    waves = rng.standard_normal((COLUMNS, 2)) @ np.stack([np.cos(phase), np.sin(phase)])
    assert 0.02 < independent(white + 1e-5 * waves, noise) < 0.1
    assert independent(white + 2e-7 * waves, noise) > 0.9  # far below the noise


@pytest.mark.parametrize("where", [np.s_[4], np.s_[:, 4], np.s_[4, 4]])
def test_one_that_is_worse_than_others_is_no_pattern(white, noise, where):
    white[where] *= 30
    assert independent(white, noise) > 0.8
