"""The RF's orbit against the correctors: apart where gradients do not make it, at one else."""

from dataclasses import replace

import numpy as np
import pytest

from tests.scenarios import ring_of
from tmlattice import diagnose
from tmlattice.diagnosis.families.dispersion import USUAL, HorizontalKicks
from tmlattice.effects import Cause, apply
from tmlattice.inference.judgement import SIGNIFICANT
from tmlattice.machine.response import simulate_response
from tmlattice.observe.orbit_response import Errors, Predicted
from tmlattice.observe.response_data import response_data
from tmlattice.report.response_text import inconsistency_texts


def gradients():
    """Errors of all quadrupoles."""
    rng = np.random.default_rng(3)
    return [
        Cause("quadrupole_gradient", f"{family}::{i}", 2e-3 * rng.standard_normal())
        for family in ("QF", "QD")
        for i in range(16)
    ]


def measured(ring, kicks, rf_step=-3000.0):
    """With gradient errors, and kicks that add to the RF's orbit so many times the usual."""
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


def found_in(ring, read, *more):
    """The diagnosis by gradients, and the inconsistencies of its JSON."""
    effects = ["quadrupole_gradient", "corrector_calibration", *more]
    diagnosis = diagnose(ring, read, effects=effects)
    return diagnosis, diagnosis.as_json()["inconsistencies"]


def test_they_agree_where_gradients_make_the_rfs_orbit(small_ring):
    assert found_in(small_ring, measured(small_ring, 0))[1] is None


@pytest.mark.parametrize("more", [(), ("dipole_field",)])
def test_kicks_pull_gradients_apart_whether_they_are_in_the_fit_or_not(small_ring, more):
    diagnosis, found = found_in(small_ring, measured(small_ring, 3), *more)
    assert found["missed"] > found["known"]
    assert found["chi2"] > 2 * found["readings"]  # 26 and 2.9 times were measured
    assert "are inconsistent" in diagnosis.report()
    assert found["pulls"] or not more  # where kicks are missing, gradients have made up for them
    for own in found["pulls"]:
        assert abs(own["pull"]) >= SIGNIFICANT
        assert np.sign(own["with_rf"] - own["correctors"]) == np.sign(own["pull"])
        assert own["with_rf_sigma"] < own["correctors_sigma"]
    if more:
        assert f"{found['pulls'][0]['name']} " in inconsistency_texts(diagnosis)[1]


def test_the_correctors_tell_the_gradients_whatever_the_rfs_orbit_asks_for():
    """The RF's orbit of a ring whose QF are 1 % stronger than when the correctors were stepped."""
    ring = ring_of("both")  # of a single horizontal corrector and the RF, either may be right
    stronger = apply(ring, [Cause("family_gradient", "QF", 0.01)])
    read = replace(measured(ring, 0), rf=measured(stronger, 0).rf)
    true = {cause.element: cause.amount for cause in gradients()}
    pulls = [own for own in found_in(ring, read)[1]["pulls"] if own["name"] in true]
    assert len(pulls) > 5
    for own in pulls:
        off = abs(own["correctors"] - true[own["name"]])
        assert off < 4 * own["correctors_sigma"]
        assert abs(own["with_rf"] - true[own["name"]]) > off
