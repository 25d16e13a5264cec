"""Figures of optics show what was tracked."""

import at
import numpy as np
import pytest

from tmlattice import one_turn_optics, twiss
from tmlattice.plots import plot_betas, plot_phase_space


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
