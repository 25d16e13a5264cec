"""The figure of the readings: the gap begins where the fault is."""

import matplotlib.pyplot as plt
import numpy as np
import pytest

from tmlattice import Cause, diagnose, simulate
from tmlattice.plots.readings import before_findings, design_readings, plot_readings

SHOTS = {"shots": 4, "seed": 1, "engine": "ocelot", "amplitude": 3e-4, "noise": 2e-6}


def found(ring, cause):
    return diagnose(ring, simulate(ring, [cause], **SHOTS).measurement())


@pytest.fixture(scope="module")
def weak(small_ring):
    return found(small_ring, Cause("quadrupole_gradient", "QD::9", -0.05))


def test_gap_of_the_design_begins_at_the_finding(small_ring, weak):
    """Before it the design leaves noise, though its launch fitted to all monitors would not."""
    before = before_findings(weak)
    s = np.array([monitor.s for monitor in small_ring.monitors])
    assert (before == (s < small_ring["QD::9"].s)).all()
    readings = weak.trajectories.data.readings

    def rms(model, at):
        return np.sqrt(np.mean((readings - model)[:, at] ** 2))

    own, everywhere = design_readings(weak), weak.trajectories.before
    assert rms(own, before) < 1.2 * 2e-6  # less than the noise by what the launch takes up
    assert rms(everywhere, before) > 2 * 2e-6
    assert rms(own, ~before) > 5 * 2e-6


def test_figure_says_the_rms_before_and_behind_in_micrometres(weak):
    figure = plot_readings(weak, shot=0)
    (text,) = (t.get_text() for t in figure.axes[3].texts)
    data, before = weak.trajectories.data, before_findings(weak)
    left = 1e6 * (data.readings - design_readings(weak))[0, :, 1]
    wanted = [f"{np.sqrt(np.mean(left[at] ** 2)):.1f}" for at in (before, ~before)]
    assert f"rms of the design {wanted[0]} before the finding, {wanted[1]} behind" in text
    plt.close(figure)
