"""The RF's orbit against the correctors: apart where gradients do not make it, at one else."""

from dataclasses import replace

import numpy as np
import pytest

from tmlattice import diagnose
from tmlattice.diagnosis.families.dispersion import USUAL, HorizontalKicks
from tmlattice.diagnosis.families.steps import STEPS
from tmlattice.diagnosis.response.inconsistencies import CLEAR, inconsistencies
from tmlattice.diagnosis.response.stepwise import fit_steps
from tmlattice.effects import Cause, apply
from tmlattice.machine.response import simulate_response
from tmlattice.observe.orbit_response import Errors, Predicted
from tmlattice.observe.response_data import response_data
from tmlattice.observe.split import split_columns
from tmlattice.report.response_text import inconsistency_texts

WITHOUT = STEPS[:3]
"""Calibrations, gains, gradients."""
WITH = [*WITHOUT, *(step for step in STEPS if isinstance(step.families[0], HorizontalKicks))]


def gradients():
    """Errors of all quadrupoles."""
    rng = np.random.default_rng(3)
    return [
        Cause("quadrupole_gradient", f"{family}::{i}", 2e-3 * rng.standard_normal())
        for family in ("QF", "QD")
        for i in range(16)
    ]


def measured(ring, kicks, rf_step=-3000.0):
    """Of a ring with gradient errors; kicks that add to the RF's orbit, and to the correctors' by
    the energy, so many times the usual."""
    read = simulate_response(
        ring, gradients(), kick=1e-5, noise=2e-8, rf_step=rf_step, engine="ocelot", progress=False
    ).measured
    if not kicks:
        return read
    data, family = response_data(ring, read), HorizontalKicks()
    drawn = kicks * USUAL * np.random.default_rng(5).standard_normal(len(family.patterns(data).rf))
    none = Errors.none(data)
    added = Predicted(data, family.put(none, drawn, data)).read - Predicted(data, none).read
    rf = replace(read.rf, orbit=read.rf.orbit + added[-1])
    return replace(read, response=read.response + added[:-1], rf=rf)


def apart(ring, read, steps):
    data = response_data(ring, read)
    split = split_columns(data, 0.2, np.random.default_rng(0))
    return inconsistencies(fit_steps(data, split, steps).state)


def test_they_agree_where_gradients_make_the_rfs_orbit(small_ring):
    assert apart(small_ring, measured(small_ring, 0), WITHOUT) is None


@pytest.mark.parametrize("steps", [WITH, WITHOUT])
def test_kicks_pull_gradients_apart_whether_they_are_in_the_fit_or_not(small_ring, steps):
    found = apart(small_ring, measured(small_ring, 3), steps)
    assert found.missed > found.known
    assert found.chi2 > 2 * found.readings  # 26 and 2.9 times were measured
    assert (
        found.pulls or steps is WITHOUT
    )  # where kicks are missing, gradients have made up for them
    for own in found.pulls:
        assert abs(own.pull) >= CLEAR
        assert np.sign(own.with_rf - own.correctors) == np.sign(own.pull)
        assert own.with_rf_sigma < own.correctors_sigma


def test_without_an_rf_there_is_nothing_to_compare(small_ring):
    read = replace(measured(small_ring, 0), rf=None)
    assert apart(small_ring, read, WITHOUT) is None


def test_a_diagnosis_says_so(small_ring):
    effects = ["quadrupole_gradient", "dipole_field"]
    found = diagnose(small_ring, measured(small_ring, 3), effects=effects)
    told = found.as_json()["inconsistencies"]
    assert told["chi2"] > 2 * told["readings"]
    assert f"{told['pulls'][0]['name']} " in inconsistency_texts(found)[1]
    assert "are inconsistent" in found.report()


def test_the_correctors_tell_the_gradients_whatever_the_rfs_orbit_asks_for(small_ring):
    """The RF's orbit of a ring whose QF are 1 % stronger than when the correctors were stepped."""
    stronger = apply(small_ring, [Cause("family_gradient", "QF", 0.01)])
    read = replace(measured(small_ring, 0), rf=measured(stronger, 0).rf)
    found = apart(small_ring, read, WITHOUT)
    true = {cause.element: cause.amount for cause in gradients()}
    assert len(found.pulls) > 5
    for own in found.pulls:
        assert abs(own.correctors - true[own.name]) < 4 * own.correctors_sigma
        assert abs(own.with_rf - true[own.name]) > abs(own.correctors - true[own.name])
