"""A dense fit of a design that is far from the ring that was measured, or stores no beam at all."""

import dataclasses

import numpy as np
import pytest
from shared import parted, small_steps

from tmlattice.diagnosis.data_checks import check_data
from tmlattice.diagnosis.families.steps import STEPS
from tmlattice.diagnosis.response import first_guess
from tmlattice.diagnosis.response.hierarchical import fit_families
from tmlattice.diagnosis.response.state import begin, bend
from tmlattice.effects import Cause
from tmlattice.errors import UnstableRingError
from tmlattice.observe.compared import ANOTHER, OfResponse

NOISE = 2e-8


def measured(ring, focusing, defocusing=0.0):
    """Of a ring whose quadrupoles are all stronger, by polarity, and scatter by 0.3 %."""
    rng = np.random.default_rng(5)
    causes = [
        Cause("quadrupole_gradient", e.name,
              (focusing if e.k1 > 0 else defocusing) + 3e-3 * rng.standard_normal())
        for e in ring.elements if e.kind == "quadrupole"
    ]  # fmt: skip
    return small_steps(ring, causes, noise=NOISE, seed=1)


def test_a_far_design_is_fitted_from_where_it_resembles_the_readings(small_ring):
    """All focusing quadrupoles 3 % weak: from the design itself every family was refused."""
    design = begin(*parted(small_ring, measured(small_ring, -0.03), 1))
    (values,) = first_guess.first_guess(design).values.values()
    own = [e.k1 > 0 for e in small_ring.elements if e.kind == "quadrupole"]
    assert (values[own] < 0).all()  # of several that resemble the readings the best one
    fit = fit_families(design.data, design.split, STEPS[:3])
    assert fit.steps[0].heldout_rms_in_plane > 20 * NOISE
    assert fit.steps[-1].heldout_rms_in_plane < 1.5 * NOISE
    gradients = fit.state.values["gradient"]
    assert abs(np.median(gradients[own]) + 0.03) < 2e-3
    assert abs(np.median(gradients[np.logical_not(own)])) < 2e-3


def test_a_far_lattice_is_no_wrong_sign_and_no_other_ring(small_ring):
    """ALS with 3 % on its largest family: y was said to be reversed, or the ring to be another."""
    data = measured(small_ring, 0.02, 0.06)
    assert OfResponse(small_ring, data).misfit().max() > ANOTHER
    (check,) = check_data(small_ring, data).reported
    assert check.status == "note"
    assert "is far from the ring that was measured" in check.sentence
    reversed_ones = dataclasses.replace(data, response=-data.response)
    assert any(check.status == "wrong" for check in check_data(small_ring, reversed_ones).reported)


def in_mm(data):
    return dataclasses.replace(rf_in_mm(data), response=1e3 * data.response)


def in_mrad(data):
    return dataclasses.replace(data, kicks=1e3 * data.kicks)


def rf_in_mm(data):
    return dataclasses.replace(data, rf=dataclasses.replace(data.rf, orbit=1e3 * data.rf.orbit))


@pytest.mark.parametrize(
    ("change", "said"),
    [(in_mm, "readings-in-mm"), (in_mrad, "kicks-in-mrad"), (rf_in_mm, "the RF's orbit is ")],
)
def test_units_are_asked_of_a_far_lattice_too(small_ring, change, said):
    """With kicks of their own every unit resembles the readings; the note alone was said."""
    error, far = check_data(small_ring, change(measured(small_ring, 0.02, 0.06))).reported
    assert "is far from the ring that was measured" in far.sentence
    assert error.status == "wrong"
    assert said in error.sentence


def test_a_near_design_is_where_the_fit_begins(small_ring):
    near = begin(*parted(small_ring, measured(small_ring, 0.005), 1))
    assert first_guess.first_guess(near) is None


def test_a_design_that_stores_no_beam_with_a_step_keeps_what_it_has(small_ring):
    """`no closed orbit` had been all that was said of SPEAR3 with 2 % on its main quadrupoles."""
    data = measured(small_ring, 0.0)
    large = dataclasses.replace(data, kicks=5e3 * data.kicks, response=5e3 * data.response)
    state = begin(*parted(small_ring, large, 1))
    with pytest.raises(UnstableRingError):
        state.at.bend()
    assert bend(state).at is state.at
