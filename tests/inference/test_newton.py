"""How a fit ends is said, and where it has to be said: linear algebra and rings as referees."""

from dataclasses import replace

import numpy as np
import pytest

from tmlattice import Cause, diagnose, simulate
from tmlattice.beam.model import Model
from tmlattice.errors import BeamLostError
from tmlattice.inference.newton import Outcome, fit
from tmlattice.observe.data import of_measurement
from tmlattice.observe.first_turns import FirstTurns

FAULT = Cause("quadrupole_gradient", "QD::5", -0.05)


@pytest.fixture(scope="module")
def measured(small_ring):
    return simulate(
        small_ring, [FAULT], shots=3, amplitude=1e-4, noise=1e-6, engine="ocelot", seed=2
    ).measurement()


@pytest.fixture(scope="module")
def problem(small_ring, measured):
    data = of_measurement(small_ring, measured)
    return FirstTurns(
        model=Model(small_ring, data.settings), data=data, places={"quadrupole_gradient": 32}
    )


def test_a_settled_fit_finds_the_amount(problem):
    found = fit(problem, [replace(FAULT, amount=-0.01)], problem.data.launches)
    assert found.outcome is Outcome.CONVERGED
    assert found.good
    sigma = np.sqrt(found.covariance[0, 0])
    assert abs(found.causes[0].amount - FAULT.amount) < 4 * sigma < 0.005


def test_too_few_steps_are_reported(problem):
    found = fit(problem, [replace(FAULT, amount=0.2)], problem.data.launches, steps=1)
    assert found.outcome is Outcome.STEPS


def test_a_lost_beam_is_no_explanation(problem):
    far = problem.data.launches + np.array([0.2, 0, 0, 0, 0])
    found = fit(problem, [FAULT], far)
    assert found.outcome is Outcome.LOST
    assert not found.good
    assert found.log_evidence == -np.inf
    assert "lost" in found.point.lost


def test_what_is_far_worse_is_given_up(problem):
    wrong = Cause("quadrupole_gradient", "QF::9", 0.01)
    right = fit(problem, [FAULT], problem.data.launches)
    found = fit(problem, [wrong], problem.data.launches, hopeless=right.log_evidence)
    assert found.outcome is Outcome.GIVEN_UP
    assert found.log_evidence < right.log_evidence - 50


def test_launches_that_the_design_loses_are_one_sentence(small_ring, measured):
    launches = measured.launches.copy()
    launches[:, 0] = 0.3
    with pytest.raises(BeamLostError, match=r"lost in .*check the launches' units"):
        diagnose(small_ring, replace(measured, launches=launches), holdout=0)


def test_the_false_alarm_rate_acts_on_what_would_have_been_seen(small_ring):
    """A stricter rate asks for larger amounts: the roots of two thresholds."""
    quiet = simulate(
        small_ring, [], shots=3, amplitude=1e-4, noise=1e-6, engine="ocelot", seed=2
    ).measurement()
    usual, strict = (
        diagnose(small_ring, quiet, holdout=0, false_alarm=rate) for rate in (5e-3, 1e-9)
    )
    assert usual.verdict == strict.verdict == "none"
    for effect, least in usual.sensitivity.items():
        assert strict.sensitivity[effect] > 1.2 * least
    assert strict.provenance["options"]["false_alarm"] == 1e-9
