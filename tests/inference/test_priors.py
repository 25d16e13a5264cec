"""Priors of amounts: densities that are densities, and a pull that is their slope."""

import numpy as np
import pytest
from scipy.integrate import quad

from tmlattice.beam.model import Model
from tmlattice.effects import Cause, find, rare
from tmlattice.inference.priors import AmountPrior, Student
from tmlattice.machine import simulate
from tmlattice.observe.data import of_measurement
from tmlattice.observe.first_turns import FirstTurns

FREEDOMS = (1.0, 4.0, np.inf)
AMOUNTS = np.array([-0.3, -0.02, 1e-4, 0.01, 0.07, 2.0])


@pytest.mark.parametrize("freedom", FREEDOMS)
def test_density_holds_all_of_the_probability(freedom):
    prior = Student(0.03, freedom)
    total, _ = quad(lambda u: np.exp(prior.peak - prior.penalty(0.03 * u)) * 0.03, -np.inf, np.inf)
    assert total == pytest.approx(1.0, rel=1e-7)


@pytest.mark.parametrize("freedom", FREEDOMS)
def test_pull_towards_zero_is_the_slope_of_the_penalty(freedom):
    prior = Student(0.03, freedom)
    h = 1e-5 * np.abs(AMOUNTS)
    slope = (prior.penalty(AMOUNTS + h) - prior.penalty(AMOUNTS - h)) / (2 * h)
    np.testing.assert_allclose(prior.precision(AMOUNTS) * AMOUNTS, slope, rtol=1e-7)


def test_tails_forgive_what_gauss_does_not():
    far = [float(Student(0.03, freedom).penalty(0.3)) for freedom in FREEDOMS]
    assert far == sorted(far)
    assert far[0] == pytest.approx(np.log(101))  # Cauchy: 1 + 10^2
    assert far[2] == pytest.approx(50)


def test_an_amount_without_a_size_is_even_in_its_logarithm():
    """A decade holds a quarter of four, of both signs; beyond the largest fault it is thin."""
    prior = AmountPrior(decades=4.0)

    def density(amount):
        return np.exp(prior.log_density(Cause("corrector_calibration", "c", amount)))

    inside, _ = quad(density, 0.02, 0.2)
    assert 2 * inside == pytest.approx(0.25, rel=1e-6)
    beyond, _ = quad(density, 2.0, 20.0)  # the largest calibration error is 2
    assert beyond < 0.2 * inside
    assert prior.log_density(Cause("monitor_swap", "m", 1.0)) == 0.0


def test_amounts_beyond_the_bound_cannot_be():
    prior = AmountPrior(Student(0.03, np.inf), bound=0.1)
    assert prior.log_density(Cause("quadrupole_gradient", "q", 0.11)) == -np.inf
    assert np.isfinite(prior.log_density(Cause("quadrupole_gradient", "q", -0.09)))


def test_stray_gradient_is_rarer_than_a_magnet_whose_own_gradient_is_wrong(small_ring):
    """In a sextupole; in the middle of a quadrupole it is but another form of its own."""
    effects = ["quadrupole_gradient", "gradient_absolute"]
    places = {name: len(find(name).places(small_ring)) for name in effects}
    data = of_measurement(small_ring, simulate(small_ring, [], shots=1).measurement())
    problem = FirstTurns(
        model=Model(small_ring, data.settings), data=data, places=places,
        rare=rare(small_ring, effects),
    )  # fmt: skip
    own, inside, stray = (
        np.exp(problem.prior((name, place))) * places[name]
        for name, place in (
            ("quadrupole_gradient", "QD::5"),
            ("gradient_absolute", "QD::5"),
            ("gradient_absolute", "sd::5"),
        )
    )
    assert [own, inside] == pytest.approx([(1 - problem.judgement.unknown) / 2] * 2)
    assert stray == pytest.approx(0.1 * own)
