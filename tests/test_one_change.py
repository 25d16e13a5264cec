"""One change of a machine that is known with errors: each weighed with what they make of it."""

from dataclasses import replace

import numpy as np
import pytest
from shared import parted

from tmlattice import diagnose
from tmlattice.diagnosis.families.steps import CHANGES, STEPS
from tmlattice.diagnosis.response.before_after import ANY, drifts
from tmlattice.diagnosis.response.changed_supplies import changed_supplies
from tmlattice.diagnosis.response.hierarchical import rough_fit
from tmlattice.diagnosis.response.linear import linear, with_numbers
from tmlattice.diagnosis.response.rounds import evidence_of, settle
from tmlattice.diagnosis.response.state import begin
from tmlattice.diagnosis.response.undetermined import Blur, Undetermined, and_orbits, undetermined
from tmlattice.diagnosis.response.validation import remainder
from tmlattice.diagnosis.response.weights import weight
from tmlattice.effects import Cause, find
from tmlattice.inference.judgement import DEFAULT
from tmlattice.machine.response import simulate_response
from tmlattice.observe.orbit_response import Errors, Predicted, response_change
from tmlattice.observe.response_data import response_data, split_columns
from tmlattice.observe.response_problem import Response

CROWDED = {"QF::2": 0.04, "QF::9": -0.04, "QD::5": -0.04, "QD::12": 0.04}


def machine(ring, changes=(), seed=1):
    """With all usual small errors, the same ones each time, as AT tracks it."""
    return simulate_response(
        ring, changes, kick=1e-4, noise=2e-6, rf_step=-1000.0, background={"all": None},
        machine_seed=31, seed=seed, progress=False,
    ).measured  # fmt: skip


@pytest.fixture(scope="module")
def before(small_ring):
    return machine(small_ring)


@pytest.fixture(scope="module")
def fitted(small_ring, before):
    """The machine as the first measurement shows it."""
    return rough_fit(begin(*parted(small_ring, before)), STEPS)


@pytest.fixture(scope="module")
def problem(small_ring, before):
    data = response_data(small_ring, before)
    used = np.isfinite(data.orbits)
    return Response(base=Predicted(data, Errors.none(data)), used=used, places={"any": 1})


@pytest.fixture(scope="module")
def crowded_change(small_ring, before, fitted):
    """A fit of a change of four magnets, by 4 %."""
    changes = [Cause("quadrupole_gradient", name, amount) for name, amount in CROWDED.items()]
    first, second = (response_data(small_ring, one)
                     for one in (before, machine(small_ring, changes, seed=2)))  # fmt: skip
    ring_alone = replace(fitted.at.errors, energy=0.0)  # no step was refused, and it has no other
    data = response_change(first, ring_alone, second)
    split = split_columns(data, 0.2, np.random.default_rng(0))
    state = begin(data, split)
    state = replace(state, guessed=ANY)
    return settle(rough_fit(state, CHANGES))


def test_a_blur_is_the_difference_that_an_open_error_makes(fitted, problem):
    """Against differences of the full model, with the change and without."""
    whole = and_orbits(fitted.data.ring, undetermined(fitted))
    alone = np.array([effect != "energy_spread" for effect, _ in whole.hypotheses])
    open_ = Undetermined(whole.hypotheses, whole.root * alone[:, None])  # that goes with the square
    change = Cause("quadrupole_gradient", "QF::3", 0.01)
    of = Blur(problem, open_).of([change])
    for error in (5, 40, open_.root.shape[1] - 3):
        h = 1e-3
        small = [
            Cause(*hypothesis, h * amount)
            for hypothesis, amount in zip(open_.hypotheses, open_.root[:, error], strict=True)
            if amount
        ]
        read = {
            (changed, side): problem.view(
                [*([change] if changed else []), *(Cause(c.effect, c.element, side * c.amount)
                                                    for c in small)]
            ).read
            for changed in (True, False) for side in (1, -1)
        }  # fmt: skip
        slope = (read[True, 1] - read[True, -1] - read[False, 1] + read[False, -1]) / (2 * h)
        size = np.nanmax(np.abs(slope))
        assert np.nanmax(np.abs(of[error] - slope)) < 0.02 * size + 1e-9


def test_numbers_that_nobody_asks_for_are_a_covariance_of_the_readings(fitted, rng):
    """Against the inverse of the whole covariance."""
    there, weights = linear(fitted, 0), weight(fitted, 0)
    assert with_numbers(there, fitted, 0, "none", np.zeros((0, *weights.shape))) is there
    rows = 3e-6 * rng.standard_normal((4, *weights.shape))
    read = weights > 0
    plane = fitted.data.plane_of(0)
    slopes = np.concatenate([
        there.of_column(c, np.flatnonzero(read[c]), plane[c]) for c in np.flatnonzero(read.any(1))
    ])  # fmt: skip
    spread = np.concatenate([rows[:, c, read[c]] for c in np.flatnonzero(read.any(1))], axis=1)
    inverse = np.linalg.inv(np.diag(1 / weights[read]) + spread.T @ spread)
    wider = with_numbers(there, fitted, 0, "more", rows).normal
    n = len(there.start)
    across, own = wider.matrix[:n, n:], wider.matrix[n:, n:] + np.eye(4)
    taken = np.linalg.solve(own, np.column_stack([across.T, wider.vector[n:]]))
    left = fitted.data.pick(fitted.at.left)[read]
    np.testing.assert_allclose(
        wider.matrix[:n, :n] - across @ taken[:, :n], slopes.T @ inverse @ slopes,
        atol=1e-6 * np.abs(wider.matrix).max(),
    )  # fmt: skip
    np.testing.assert_allclose(
        wider.vector[:n] - across @ taken[:, n], slopes.T @ inverse @ left,
        atol=1e-6 * np.abs(wider.vector[:n]).max(),
    )  # fmt: skip


def test_what_is_open_of_a_ring_is_in_what_changed(small_ring, crowded_change):
    """The less the ring is known, the less certain is a change of it. (At 20 % instead of 3 % per
    magnet, which no ring has, other supplies explain it as well.)"""
    places = find("quadrupole_gradient").places(small_ring)
    errors = tuple(("quadrupole_gradient", place) for place in places)
    (of_one, _, _), (of_three, _, state) = (
        changed_supplies(crowded_change, DEFAULT, Undetermined(errors, size * np.eye(len(places))))
        for size in (0.01, 0.03)
    )
    assert {own.element for own in of_one} == set(CROWDED)
    known, *_ = changed_supplies(crowded_change, DEFAULT)
    pulls = [(own.amount - CROWDED[own.element]) / own.amount_sigma for own in of_one]
    assert max(map(abs, pulls)) < 2.5
    most, sure, less = (
        sum(own.detection.statistic for own in found) for found in (known, of_one, of_three)
    )
    assert 0 < less < 0.75 * sure
    assert sure < most
    sigmas, wider = (
        np.array([sigma for (_, sigma), _ in drifts(one)]) for one in (crowded_change, state)
    )
    assert np.all(wider > 0.999 * sigmas)  # of monitors and correctors, too
    assert np.max(wider / sigmas) > 1.2


def test_a_fit_that_has_ended_goes_no_further(fitted):
    """In both planes, whose steps disturb one another: no number moves by half of its error."""
    once = settle(fitted)
    again = settle(once)
    before, after = (evidence_of(own, fitted.good) for own in (fitted, once))
    assert after > before - 0.1  # it had nearly ended
    for block in (0, 1):
        there = linear(again, block)
        for name, at in there.where.items():
            moved = np.abs(again.values[name] - once.values[name])
            assert np.all(moved < 0.5 * there.posterior.sigma[at] + 1e-12), name


def test_a_residual_is_compared_with_its_whole_covariance(fitted, rng):
    """Against the inverse of the covariance by noise and undetermined errors."""
    spread = 3e-6 * rng.standard_normal((4, *fitted.data.orbits.shape))
    state = replace(begin(fitted.data, fitted.split), undetermined=spread)
    (block,) = [own for own in remainder(state) if own.name == "fitted, in-plane"]
    data = fitted.data
    columns = np.flatnonzero(~fitted.split.held[:-1])
    left, sigma = data.pick(state.at.left)[columns].ravel(), data.noise_of(0)[columns].ravel()
    slopes = np.array([data.pick(own)[columns].ravel() for own in spread])
    expected = left @ np.linalg.solve(np.diag(sigma**2) + slopes.T @ slopes, left)
    assert np.isclose(block.chi2, expected, rtol=1e-6)
    assert block.freedom == len(left)


def test_a_supply_of_sextupoles_shows_by_the_orbit_that_nobody_knows(small_ring, before):
    after = machine(small_ring, [Cause("family_sextupole", "sd", 0.1)], seed=2)
    result = diagnose(small_ring, after, reference=before)
    (found,) = result.findings
    assert ("family_sextupole", "sd") in [(m.effect, m.element) for m in found.credible_set]
    assert abs(found.amount - 0.1) < 4 * found.amount_sigma
