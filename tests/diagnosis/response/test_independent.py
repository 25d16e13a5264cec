"""Readings that tell something of their own, and judges that know how well they know."""

import numpy as np
import pytest

from tmlattice.diagnosis.response.validation import Validated, against, lost
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


def judged(rms, rng, columns):
    """Of `columns` correctors, in-plane; nobody read anything else."""
    sums = np.zeros((columns, 2, 2))
    sums[:, 0] = np.stack([40 * rms**2, np.full(columns, 40)], axis=1)
    return Validated(sums, np.zeros((5, 2)))


def test_judges_count_what_they_know(rng):
    """Siam: four correctors, by 6 % against gains that the readings want by far."""
    sparse = np.array([1.0, 1.2, 0.9, 3.0])
    with_it, without = (judged(sparse * own, rng, 4) for own in (1.0, [1.0, 1.1, 1.05, 0.85]))
    said = lost(without, with_it)
    assert said[0] < -0.05
    assert not against(said)
    many = rng.uniform(0.9, 1.1, 40)
    said = lost(judged(many, rng, 40), judged(1.06 * many, rng, 40))
    assert said[1] < 0.01
    assert against(said)


@pytest.mark.parametrize(("columns", "decides"), [(1, False), (2, False), (3, True)])
def test_few_judges_that_agree_decide_nothing(rng, columns, decides):
    own = np.ones(columns)
    change = lost(judged(own, rng, columns), judged(1.2 * own, rng, columns))
    assert change[0] == pytest.approx(-np.log(1.2))
    assert against(change) is decides


def test_error_of_the_judges_vs_drawn_again(rng):
    """The jackknife against the scatter of what other correctors would have said."""

    def drawn():
        own = rng.uniform(0.5, 1.5, 30)
        return lost(judged(own * rng.uniform(0.8, 1.2, 30), rng, 30), judged(own, rng, 30))

    said = np.array([drawn() for _ in range(300)])
    assert 0.8 < np.mean(said[:, 1]) / np.std(said[:, 0]) < 1.2
