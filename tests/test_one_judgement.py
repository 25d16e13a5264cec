"""Sentences of one page that exclude one another: a judgement is made once, and stated once."""

from dataclasses import replace

import numpy as np
import pytest

from tmlattice import Cause, diagnose, simulate
from tmlattice.diagnosis.data_checks import check_data
from tmlattice.machine.response import simulate_response
from tmlattice.report.tables import notes, optics_rows
from tmlattice.report.text import small_rows, to_do, verdict_sentence

BACKGROUND = {"all": None}


def page(diagnosis):
    """All sentences."""
    told = [text for _, text in notes(diagnosis, diagnosis.provenance)]
    judged = [one.text(diagnosis.assessment) for one in diagnosis.assessment.statements]
    sizes = [text for _, text in small_rows(diagnosis)]
    return " ".join([verdict_sentence(diagnosis), *to_do(diagnosis), *judged, *told, *sizes])


@pytest.fixture(scope="module")
def imperfect(small_ring):
    """First turns of a machine with the usual small errors."""
    return simulate(small_ring, background=BACKGROUND, shots=6, seed=1, machine_seed=5)


@pytest.fixture(scope="module")
def diagnosis(small_ring, imperfect):
    return diagnose(small_ring, imperfect.measurement())


def noise_of(ring, data):
    return {check.name: check for check in check_data(ring, data).checks}["noise"]


def test_a_noise_far_below_what_neighbours_leave_is_not_just_ok(small_ring, imperfect):
    """Two shots do not tell noise from errors of the machine; eight do, from shot to shot."""
    data = replace(imperfect.measurement(), noise=np.full((35, 2), 2e-6))
    two = noise_of(small_ring, data.select(shots=[0, 1]))
    assert two.status == "note"
    assert "2 shots do not show which" in two.sentence
    exact = simulate(
        small_ring, background=BACKGROUND, shots=8, seed=1, machine_seed=5, noise=2e-6
    ).measurement()  # fmt: skip
    eight = noise_of(small_ring, exact)
    assert eight.status == "fine"
    assert "errors of the machine" in eight.sentence


def test_sizes_that_the_readings_do_not_determine_have_no_ratio(diagnosis):
    rows = small_rows(diagnosis)
    assert rows
    for _, text in rows:
        assert ("times the usual" in text) != ("not determined by these readings" in text)


def test_nobody_is_asked_for_the_reference_that_was_given(small_ring, imperfect, diagnosis):
    assert "--reference" in page(diagnosis)
    before = imperfect.measurement()
    after = simulate(
        small_ring, [Cause("quadrupole_gradient", "QD::5", -2e-3)], background=BACKGROUND,
        shots=6, seed=2, machine_seed=5,
    ).measurement()  # fmt: skip
    found = diagnose(small_ring, after, reference=before)
    assert "eference from before" not in page(found)
    assert "--reference" not in page(found)


def test_a_closed_orbit_stands_where_an_error_makes_one(small_ring):
    def names(cause):
        found = diagnose(small_ring, simulate(small_ring, [cause], shots=4, seed=1).measurement())
        assert found.causes
        return [name for name, *_ in optics_rows(found)]

    assert not any("orbit" in n for n in names(Cause("quadrupole_gradient", "QD::5", -0.1)))
    assert any("orbit" in n for n in names(Cause("corrector_kick_y", "v5", 1e-4)))


def test_what_is_left_is_no_noise_where_an_effect_is_missing(small_ring):
    """Coupling, which no effect of the fit makes; in-plane readings are left with noise."""
    measured = simulate_response(
        small_ring, [Cause("skew_gradient", "QD::5", 0.02)], engine="ocelot", seed=1
    ).measured
    found = diagnose(small_ring, measured, effects=["quadrupole_gradient"])
    assert "An effect is missing from the model" in page(found)
    assert found.assessment.remainder == "effect_missing"
    sound = simulate_response(small_ring, engine="ocelot", seed=1).measured
    healthy = diagnose(small_ring, sound, effects=["quadrupole_gradient"])
    assert healthy.assessment.remainder == "noise"
    assert "effect is missing from" not in page(healthy)
