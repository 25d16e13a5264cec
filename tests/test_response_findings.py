"""An orbit response with few causes: each is named, whoever is held out; with AT as the machine."""

import numpy as np
import pytest

from tmlattice import Cause, diagnose
from tmlattice.diagnosis.suspects import numbers
from tmlattice.machine.response import simulate_response
from tmlattice.observe.orbit_response import Errors, Predicted
from tmlattice.observe.response_data import response_data
from tmlattice.observe.response_problem import Response
from tmlattice.observe.steady import NOTHING
from tmlattice.report.amounts import all_of


def measured(ring, causes, **options):
    return simulate_response(ring, causes, progress=False, **{"seed": 3, **options}).measured


@pytest.mark.parametrize("seed", [0, 1])
def test_a_reversed_corrector_is_named_also_where_it_is_held_out(small_ring, seed):
    """Seed 0 holds v3 out, whose own kick would hide its calibration; seed 1 does not."""
    response = measured(small_ring, [Cause("corrector_calibration", "v3", -2.0)])
    result = diagnose(small_ring, response, seed=seed)
    held = dict(zip(result.response.measured.correctors, result.response.held, strict=False))
    assert held["v3"] == (seed == 0)
    assert result.verdict == "identified"
    (found,) = result.findings
    assert (found.effect, found.element) == ("corrector_calibration", "v3")
    assert abs(found.amount + 2.0) < 4 * found.amount_sigma < 0.02
    assert result.fit_after.chi2_per_dof == pytest.approx(1.0, abs=0.15)


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
