"""The ordered steps on a simulated orbit response whose errors are known."""

import numpy as np
import pytest

from tmlattice.diagnosis.response import diagnose_response
from tmlattice.effects import Cause
from tmlattice.errors import MeasurementError
from tmlattice.machine.response import simulate_response

CAUSES = [
    Cause("quadrupole_gradient", "QD::5", 0.01),
    Cause("quadrupole_gradient", "QF::9", -0.008),
    Cause("corrector_calibration", "v2", 0.1),
]


@pytest.fixture(scope="module")
def measured(small_ring):
    simulation = simulate_response(
        small_ring, CAUSES, kick=1e-5, noise=2e-8, engine="ocelot", progress=False, seed=3
    )
    return simulation.measured


def test_gradients_close_the_held_out_gap(small_ring, measured):
    result = diagnose_response(small_ring, measured, seed=1)
    assert result.steps[0].effect == "design"
    gaps = [step.heldout_rms_in_plane for step in result.steps]
    assert min(gaps) < 0.2 * gaps[0]
    found = {(c.effect, c.element): c.amount for c in result.causes}
    strongest = sorted(
        (c for c in result.causes if c.effect == "quadrupole_gradient"),
        key=lambda c: -abs(c.amount),
    )[:4]
    assert {"QD::5", "QF::9"} & {c.element for c in strongest}
    assert np.isfinite(list(found.values())).all()


def test_what_is_missing_is_said(small_ring, measured):
    bare = measured.__class__(**{**vars(measured), "rf": None})
    with pytest.raises(MeasurementError, match="RF step"):
        diagnose_response(small_ring, bare)
