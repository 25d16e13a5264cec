"""An orbit response with few causes: each is named, whoever is held out; with AT as the machine."""

import numpy as np
import pytest

from tmlattice import Cause, diagnose
from tmlattice.diagnosis.response.few import few_causes
from tmlattice.diagnosis.suspects import numbers
from tmlattice.inference.judgement import DEFAULT
from tmlattice.machine.response import simulate_response
from tmlattice.observe.orbit_response import Errors, Predicted
from tmlattice.observe.response_data import response_data
from tmlattice.observe.response_problem import Response, single_causes
from tmlattice.observe.split import split_columns
from tmlattice.observe.steady import NOTHING
from tmlattice.report.amounts import all_of


def measured(ring, causes, **options):
    return simulate_response(ring, causes, progress=False, **{"seed": 3, **options}).measured


def in_sets(result):
    """(effect, element) of each finding's credible set."""
    return [{(m.effect, m.element) for m in f.credible_set} for f in result.findings]


@pytest.mark.parametrize("seed", [0, 1])
def test_a_reversed_corrector_is_named_also_where_it_is_held_out(small_ring, seed):
    """Its own kick would hide a held-out corrector's calibration: half of its monitors are fitted.

    Seed 0 holds v3 out, seed 1 does not.
    """
    response = measured(small_ring, [Cause("corrector_calibration", "v3", -2.0)])
    result = diagnose(small_ring, response, seed=seed)
    held = dict(zip(result.response.measured.correctors, result.response.held, strict=False))
    assert held["v3"] == (seed == 0)
    assert result.verdict == "identified"
    (found,) = result.findings
    assert (found.effect, found.element) == ("corrector_calibration", "v3")
    assert abs(found.amount + 2.0) < 4 * found.amount_sigma < 0.02
    assert result.fit_after.chi2_per_dof == pytest.approx(1.0, abs=0.15)


@pytest.mark.parametrize(
    ("effect", "element", "amount"),
    [
        ("quadrupole_gradient", "QF::2", -0.02),
        ("quadrupole_roll", "QD::4", 0.01),
        ("corrector_calibration", "v5", 0.5),
        ("monitor_gain_x", "end_1", -2.0),
        ("monitor_swap", "bpm::4", 1.0),
    ],
)
def test_one_cause_is_named_as_one(small_ring, effect, element, amount):
    result = diagnose(small_ring, measured(small_ring, [Cause(effect, element, amount)]))
    assert result.verdict in ("identified", "ambiguous")
    (found,) = result.findings
    assert (effect, element) in in_sets(result)[0]
    if (found.effect, found.element) == (effect, element) and found.amount_sigma:
        assert abs(found.amount - amount) < 5 * found.amount_sigma
    document = result.as_json()
    assert document["findings"][0]["credible_set"]
    assert len(document["steps"]) == 2  # the design, and with the cause


@pytest.mark.parametrize(
    "cause",
    [
        Cause("dipole_roll", "bend::10", 1e-3),
        Cause("quadrupole_offset_x", "QD::9", 1e-4),
        Cause("corrector_kick_x", "v4", 2e-5),
    ],
)
def test_a_kick_is_seen_by_the_orbit_that_it_makes_in_the_sextupoles(small_ring, cause):
    """These were no hypotheses: sextupoles were named instead, or small errors everywhere."""
    (found,) = in_sets(diagnose(small_ring, measured(small_ring, [cause])))
    assert (cause.effect, cause.element) in found


def test_a_faint_cause_is_named_where_all_readings_together_are_noise(small_ring):
    """A single cause of a statistic of 60 among 1260 readings: their sum of squares is noise's."""
    cause = Cause("monitor_roll", "bpm::4", 0.01)
    result = diagnose(small_ring, measured(small_ring, [cause]))
    (found,) = result.findings
    assert (found.effect, found.element) == (cause.effect, cause.element)
    assert 30 < found.detection.statistic < 80


def test_a_strong_cause_is_one_beside_columns_that_are_fitted_by_half(small_ring):
    """What was not fitted counted as nothing, which no few patterns explain."""
    cause = Cause("quadrupole_gradient", "QF::2", -0.05)
    data = response_data(small_ring, measured(small_ring, [cause], noise=5e-8, engine="ocelot"))
    split = split_columns(data, 0.2, np.random.default_rng(0))
    (found,) = few_causes(data, split, None, 1, DEFAULT).findings
    assert (found.effect, found.element) == (cause.effect, cause.element)


def test_two_causes_are_two_findings(small_ring):
    causes = [Cause("quadrupole_roll", "QF::2", 0.02), Cause("corrector_calibration", "v7", 0.2)]
    result = diagnose(small_ring, measured(small_ring, causes))
    assert len(result.findings) == 2
    for cause in causes:
        assert any((cause.effect, cause.element) in own for own in in_sets(result))


def test_small_errors_everywhere_are_not_a_few(small_ring):
    """No single cause explains its share, so the families are fitted."""
    data = response_data(
        small_ring, measured(small_ring, [], background={"quadrupole_gradient": 2e-3})
    )
    split = split_columns(data, 0.2, np.random.default_rng(0))
    assert few_causes(data, split, None, 8, DEFAULT) is None


MIXED = (
    Cause("quadrupole_gradient", "QF::2", -0.01),
    Cause("corrector_calibration", "v5", 0.3),
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


def test_what_was_not_measured_is_no_place(small_ring):
    whole = measured(small_ring, [], correctors=["v1", "v2", "v3", "v4", "v5", "v6"])
    hypotheses = single_causes(response_data(small_ring, whole))
    assert ("corrector_calibration", "v1") in hypotheses
    assert ("corrector_calibration", "v7") not in hypotheses
    assert ("corrector_kick_x", "v7") not in hypotheses


def test_a_ring_without_a_closed_orbit_is_said(small_ring):
    data = response_data(small_ring, measured(small_ring, []))
    problem = Response(
        base=Predicted(data, Errors.none(data)), used=np.isfinite(data.orbits), places={}
    )
    strong = [Cause("quadrupole_gradient", f"QF::{k}", 3.0) for k in range(8)]
    point = problem.at(strong, NOTHING)
    assert "closed orbit" in point.lost
    assert point.chi2 == np.inf


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
