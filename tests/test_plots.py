"""Figures show what was measured and tracked; the ring from above against AT's geometry."""

from types import SimpleNamespace

import at
import matplotlib.pyplot as plt
import numpy as np
import pytest
from at_ring import at_lattice
from numpy.testing import assert_allclose
from shared import first_turns

from tmlattice import Cause, diagnose, one_turn_optics, twiss
from tmlattice.lattice.survey import survey
from tmlattice.plots import plan, plot_betas, plot_phase_space
from tmlattice.plots.readings import before_findings, design_readings, plot_readings


@pytest.fixture(scope="module")
def weak(small_ring):
    turns = first_turns(small_ring, [Cause("quadrupole_gradient", "QD::9", -0.05)])
    return diagnose(small_ring, turns)


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
    assert f"rms in µm: design {wanted[0]} before the finding, {wanted[1]} behind" in text
    plt.close(figure)


# --- figures of optics show what was tracked ------------------------------------------------------
@pytest.mark.parametrize("plane", [0, 1])
def test_phase_space_ellipse_goes_through_tracked_states(small_network, plane):
    optics = one_turn_optics(small_network)
    launch = np.zeros((1, 4))
    launch[0, 2 * plane] = 1e-6  # sextupoles do nothing at a micrometre
    launch[0, 2 * plane + 1] = 3e-7
    states = small_network.track(launch, turns=300)
    ax = plot_phase_space(states, plane, optics=optics)
    dots, ellipse = (np.array(line.get_data()).T for line in ax.get_lines())
    scale = np.abs(dots).max(axis=0)
    apart = np.linalg.norm(dots[:, None] / scale - ellipse[None] / scale, axis=2).min(axis=1)
    assert apart.max() < 0.026  # half of the way between two of its 181 points
    assert np.array(ax.get_lines()[0].get_data()).shape == (2, 301)


def test_betas_are_smooth_between_elements_vs_at(small_ring):
    s, beta = twiss(small_ring).along(0.02)
    sliced = small_ring.to_at().slice(size=0.02)
    _, _, at_ends = sliced.get_optics(range(len(sliced)), method=at.linopt4)
    for plane in (0, 1):
        there = np.interp(at_ends.s_pos, s, beta[:, plane])
        assert (
            np.abs(there / at_ends.beta[:, plane] - 1).max() < 0.012
        )  # straight lines: 0.06, 0.10
    assert np.diff(s).max() < 0.0201


def test_betas_are_drawn_in_metres_along_the_ring(small_ring, small_network):
    optics = twiss(small_network)
    figure = plot_betas(small_ring, optics, span=(0, 10))
    ax, strip = figure.axes
    s, beta = ax.get_lines()[1].get_data()
    assert np.interp(optics.s, s, beta) == pytest.approx(optics.beta[:, 1])
    assert s[-1] <= small_ring.length
    assert "[m]" in ax.get_ylabel()
    assert strip.get_xlim() == (0, 10)


# --- the ring from above, against AT's own geometry -----------------------------------------------
@pytest.mark.parametrize("name", ["small_ring", "petra3"])
def test_plan_matches_at(name, request):
    """Element by element; AT's y points to the other side where it turns the other way."""
    ring = request.getfixturevalue(name)
    plan = survey(ring)
    theirs, _ = at.get_geometry(at_lattice(ring))
    assert len(theirs.x) == len(plan.ends)
    assert_allclose(plan.ends[:, 0], theirs.x, atol=1e-9 * ring.length)
    assert_allclose(abs(plan.ends[:, 1]), abs(theirs.y), atol=1e-9 * ring.length)


def test_a_ring_closes_and_turns_to_the_right(petra3):
    plan = survey(petra3)
    assert_allclose(plan.ends[-1], plan.ends[0], atol=1e-3)  # of a diameter of 730 m
    assert plan.ends[:, 1].min() < -700
    assert plan.ends[:, 1].max() < 1


def test_places_between_elements_lie_on_the_orbit(small_ring):
    plan = survey(small_ring)
    quadrupole = small_ring["QD::5"]
    assert_allclose(plan.along(quadrupole.s, small_ring), plan.at(["QD::5"])[0], atol=1e-9)


def test_names_of_findings_that_stand_together_step_aside(small_ring):
    """The name of the last but one would stand on that of the one before, from the other side."""
    places = {"a": 10.0, "b": 11.0, "c": 12.0, "end_1": 13.2, "QF::3": 20.0, "d": 60.0}
    found = [
        SimpleNamespace(s=s, where=None, element=name, label=name) for name, s in places.items()
    ]
    nowhere = SimpleNamespace(s=None, where=None, element=None, elements=())
    plan_of = survey(small_ring)
    diagnosis = SimpleNamespace(ring=small_ring, findings=(*found, nowhere), suspects=())
    placed = plan.placed(diagnosis, plan_of)
    assert [number for number, *_ in placed] == [1, 2, 3, 4, 5, 6]
    assert placed[0][-1] == placed[-1][-1] == 0
    ax = plan.plot_plan(diagnosis)
    ax.figure.canvas.draw()
    boxes = [text.get_window_extent() for text in ax.texts]
    assert len(boxes) == 6
    assert not any(one.overlaps(other) for i, one in enumerate(boxes) for other in boxes[:i])
    plt.close(ax.figure)
