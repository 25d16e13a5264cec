"""One fault, or few, in an orbit response, among usual small errors too; AT is the machine."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from shared import parted

from tmlattice import Cause, diagnose
from tmlattice.diagnosis.families.dispersion import HorizontalOrbit, VerticalOrbit
from tmlattice.diagnosis.response.detected_faults import (
    as_turned,
    sizes_in,
    small_errors,
    with_number,
)
from tmlattice.diagnosis.response.linear import linear
from tmlattice.diagnosis.response.state import begin
from tmlattice.diagnosis.suspects import numbers
from tmlattice.effects import background_rms
from tmlattice.machine.at_engine import AtEngine
from tmlattice.machine.response import simulate_response
from tmlattice.observe.orbit_response import Errors, Predicted
from tmlattice.observe.response_data import response_data, split_columns
from tmlattice.observe.response_problem import Response
from tmlattice.observe.stored import NOTHING
from tmlattice.report.amounts import all_of

USUAL = background_rms({"all": None})


@pytest.fixture(scope="module")
def measured_with(small_ring):
    """A response of the small ring with everything a little wrong, and with some causes."""

    def measured(*causes, seed=5):
        return simulate_response(
            small_ring, causes, background=USUAL, progress=False, seed=seed, machine_seed=seed
        ).measured

    return measured


@pytest.mark.parametrize("causes", [(), (Cause("quadrupole_gradient", "QD::3", -0.02),)])
def test_the_third_order_of_large_steps_is_no_fault(small_ring, causes):
    """Orbits of millimetres, whose third order is a hundred times the noise, in the ring with the
    fault as in the design."""
    measured = simulate_response(
        small_ring, causes, kick=6e-4, noise=5e-8, progress=False, seed=1
    ).measured
    found = diagnose(small_ring, measured)
    assert found.verdict == ("identified" if causes else "none")
    assert [(own.effect, own.element) for own in found.findings] == [
        (own.effect, own.element) for own in causes
    ]
    for own, cause in zip(found.findings, causes, strict=True):
        assert abs(own.amount - cause.amount) < 4 * own.amount_sigma


def test_a_corrector_that_is_off_is_not_turned(small_ring, measured_with):
    """It kicks in neither plane: what is larger of two noises says nothing."""
    cause = Cause("corrector_calibration", "v2", -1.0)
    data, _ = parted(small_ring, measured_with(cause, seed=9))
    errors = Errors.none(data)
    column = list(data.measured.correctors).index("v2")
    errors.calibration[column], errors.roll[column] = -0.9995, 0.0008
    assert as_turned(cause, 0.04, errors, data) == (cause, 0.04)
    errors.roll[column] = 0.9
    assert as_turned(cause, 0.04, errors, data)[0].effect == "corrector_roll"


def test_gradient_errors_in_one_plane_are_distributed(small_ring):
    """A plane that was not read counts for neither fit."""
    measured = simulate_response(
        small_ring, background={"quadrupole_gradient": 5e-3}, progress=False, seed=0
    ).measured
    response = measured.response.copy()
    response[..., 0] = np.nan
    kept = [n for n, p in zip(measured.correctors, measured.planes, strict=True) if p == "y"]
    measured = replace(measured, response=response, rf=None)
    measured = measured.select(correctors=kept)
    result = diagnose(small_ring, measured, effects=["quadrupole_gradient", "monitor_gain_y"])
    assert (result.verdict, result.findings) == ("distributed", ())
    assert result.unexplained["p_value"] > 1e-3
    assert result.as_json()["inconsistencies"] is None  # without the RF's orbit


def test_sizes_of_small_errors_are_learnt_beside_a_fault(small_ring, measured_with):
    """A reversed corrector makes the rms of 17 calibrations 0.5; it is 0.04 without."""
    data, split = parted(small_ring, measured_with(Cause("corrector_calibration", "v3", -2.0)))
    state = small_errors(begin(data, split))
    sizes = {group.name: group.rms for block in (0, 1) for group in sizes_in(linear(state, block))}
    # of some tens of numbers each: to a fifth, and what is left of the families' slack
    assert 0.5 < sizes["quadrupole_gradient"] / USUAL["quadrupole_gradient"] < 2
    assert 0.5 < sizes["monitor_gain"] / USUAL["monitor_gain_x"] < 2
    assert 0.3 < sizes["horizontal orbit"] < 3  # in units of usual errors


def test_no_fault_is_sought_in_a_residual_far_above_the_noise(small_ring, measured_with):
    """Noise is stated five times too small: any effect that the model lacks would look the same."""
    measured = measured_with()
    found = diagnose(small_ring, replace(measured, noise=measured.noise / 5))
    assert any("single faults" in one and "not sought" in one for one in found.warnings)
    assert found.findings == ()


def test_a_pattern_of_kicks_moves_the_response_as_at_has_it(small_ring):
    """Sign and size of both orbits' rows: kicks of the bends as AT tracks them, no noise."""

    def seen(*causes):
        machine = simulate_response(small_ring, causes, noise=1e-12, progress=False)
        return response_data(small_ring, machine.measured)

    design = seen()
    at = begin(design, split_columns(design, 0.2, np.random.default_rng(0))).at
    for family in (HorizontalOrbit(), VerticalOrbit()):
        value = np.zeros(family.size(design))
        value[0] = 0.05
        put = family.put(at.errors, value, design).ring
        moved = design.pick(seen(*put).orbits - design.orbits, family.block)
        told = 0.05 * family.rows(at, value)[0]
        rest = np.linalg.norm((moved - told)[:-1]) / np.linalg.norm(moved[:-1])
        assert rest < 0.05  # of second order in the kicks


def test_the_energy_of_the_beam_alone_is_named(small_ring):
    """However well it is seen; it moves all columns, as no pattern of columns by readings does."""
    measured = simulate_response(
        small_ring, [Cause("energy_offset", None, 2e-3)], noise=1e-7, progress=False, seed=3
    ).measured
    result = diagnose(small_ring, measured)
    (found,) = result.findings
    assert (found.effect, found.element) == ("energy_offset", None)
    assert abs(found.amount - 2e-3) < 2e-5  # maps of second order
    lattice = AtEngine(small_ring).lattice()
    lattice.disable_6d()
    # the beam's own tunes, 0.026 and 0.030 from the design's: to the third order of the energy
    assert_allclose(result.tunes["after"], lattice.get_tune(dp=2e-3)[:2], rtol=0, atol=1e-3)


# --- few causes: each is named, whoever is held out -----------------------------------------------
def measured(ring, causes, **options):
    return simulate_response(ring, causes, progress=False, **{"seed": 3, **options}).measured


def test_a_reversed_corrector_is_named_also_where_it_is_held_out(small_ring):
    """Its own kick would hide its calibration; where it is not, the scenarios have it."""
    response = measured(small_ring, [Cause("corrector_calibration", "v3", -2.0)])
    result = diagnose(small_ring, response, seed=0)
    held = dict(zip(result.response.measured.correctors, result.response.held, strict=False))
    assert held["v3"]
    assert result.verdict == "identified"
    (found,) = result.findings
    assert (found.effect, found.element) == ("corrector_calibration", "v3")
    assert abs(found.amount + 2.0) < 4 * found.amount_sigma < 0.02
    assert result.fit_after.chi2_per_dof == pytest.approx(1.0, abs=0.15)


MIXED = (
    Cause("quadrupole_gradient", "QF::2", -0.01),
    Cause("quadrupole_offset_x", "QF::3", 1e-4),
    Cause("corrector_calibration", "v5", 0.3),
    Cause("corrector_roll", "v5", 0.1),
    Cause("monitor_gain_y", "bpm::6", -1.0),
    Cause("monitor_roll", "bpm::4", 0.1),
)


# slopes of the ring's causes leave out what they do to the spread's own part
@pytest.mark.parametrize("causes", [MIXED, (Cause("energy_spread", None, 1e-3),)])
def test_slope_of_a_cause_is_the_finite_change(small_ring, causes):
    """In closed form, about amounts that are not zero, against the model's own readings."""
    # a small RF step: the closed form is of a small one
    data = response_data(small_ring, measured(small_ring, [], rf_step=-300.0))
    base = Predicted(data, Errors.none(data))
    problem = Response(base=base, used=np.isfinite(data.orbits), places={})
    point = problem.at(causes, NOTHING)
    for i, cause in enumerate(causes):
        h = 1e-3 * abs(cause.amount)
        ends = []
        for side in (h, -h):
            moved = Cause(cause.effect, cause.element, cause.amount + side)
            ends.append(problem.at((*causes[:i], moved, *causes[i + 1 :]), NOTHING).residual)
        finite = (ends[1] - ends[0]) / (2 * h)  # the residual falls as the reading grows
        slope = problem.slope(point, i)
        np.testing.assert_allclose(slope, finite, atol=1e-5 * np.abs(finite).max())
    zero = Cause("monitor_offset_x", "end_3", 1e-4)  # of which differences know nothing
    assert not problem.slope(problem.at((zero,), NOTHING), 0).any()


def test_one_cause_after_another_has_derivatives_of_its_own(small_ring, measured_with):
    """The states of a fit share those that are known."""
    data, split = parted(small_ring, measured_with())
    first, second = ("skew_gradient", "QF::2"), ("skew_gradient", "QD::5")
    state = begin(data, split)
    found = [linear(with_number(state, cause, 1), 1).ring[-1].rows for cause in (first, second)]
    alone = linear(with_number(begin(data, split), second, 1), 1).ring[-1].rows
    assert np.array_equal(found[1], alone)
    assert not np.allclose(found[0], alone, atol=0.1 * np.abs(alone).max())


def test_one_number_of_several_places_is_told_once():
    told = [
        (Cause("vertical_focusing", "b::1", 1e-3), 1e-4),
        (Cause("vertical_focusing", "b::2", 1e-3), 1e-4),
        (Cause("vertical_focusing", "c::1", 1e-3), 2e-4),
        (Cause("vertical_focusing", "c::2", 0.0), 0.0),
        (Cause("vertical_focusing", "c::3", 0.0), 0.0),
    ]
    rows = numbers(told)
    said = [all_of([place.element for place in places], {}) for places, _ in rows]
    assert said == ["b::1 and 1 alike", "c::1", "c::2", "c::3"]
    assert [sigma for _, sigma in rows] == [1e-4, 2e-4, 0.0, 0.0]
