"""Where each effect of the catalogue is tried: one line an effect, or its tests fail."""

import re

import numpy as np

from tmlattice.effects import CATALOGUE

CORRECTORS = ["hcor_sw_4", "vcor_a1_5"]
MONITORS = ["bpm_a4_3"]
GRADIENTS = ["qd::12", "s1::48", "wiggler::3", "a3", "qskew_nw_1"]

PLACES = {
    "quadrupole_gradient": ["qd::12", "qa4::14", "q1_se"],
    "gradient_absolute": GRADIENTS,
    "skew_gradient": GRADIENTS,
    "quadrupole_roll": ["qd::12", "qa2::13"],
    "quadrupole_offset_x": ["qd::12", "qa3::2"],
    "quadrupole_offset_y": ["qd::12", "qa3::2"],
    "family_gradient": ["qd", "qe5"],
    "family_sextupole": ["s1", "s4"],
    "dipole_field": ["b::28", "b_in::10", "bo_out::5"],
    "dipole_roll": ["b::28", "b_in::10", "bo_out::5"],
    "bend_gradient": ["b::28", "b_in::10", "bo_out::5"],
    "corrector_kick_x": CORRECTORS,
    "corrector_kick_y": CORRECTORS,
    "corrector_calibration": CORRECTORS,
    "corrector_roll": CORRECTORS,
    "corrector_position": CORRECTORS,
    "sextupole_strength": ["s1::48", "s4::26"],
    "sextupole_offset_x": ["s1::48", "s4::26"],
    "sextupole_offset_y": ["s1::48", "s4::26"],
    "insertion_device_focusing": ["wiggler::0", "wiggler::12"],
    "monitor_offset_x": MONITORS,
    "monitor_offset_y": MONITORS,
    "monitor_gain_x": MONITORS,
    "monitor_gain_y": MONITORS,
    "monitor_roll": MONITORS,
    "monitor_coupling": MONITORS,
    "monitor_swap": MONITORS,
    "monitor_turn_offset": MONITORS,
    "monitor_dead": MONITORS,
    "energy_offset": [None],
    "energy_spread": [None],
    "radiation_loss_bends": [None],
    "radiation_loss_wigglers": [None],
    "vertical_focusing": ["wiggler::3", "a3", "b_in::0"],
    "wake_kick_x": ["wiggler::3", "a3"],
    "wake_kick_y": ["wiggler::3", "a3"],
}

_TERM = re.compile(r"(p[xy]) ([+-])= amount ([xy])\b")
THIN = [name for name, effect in CATALOGUE.items() if _TERM.search(effect.sign)]
"""Effects whose `sign` states a thin kick in full: "px -= amount x, py += amount y"."""


def kicked(name, amount, state):
    """(x, px, y, py) after the thin kick that an effect's `sign` states."""
    after = np.array(state[:4], dtype=float)
    for momentum, plus, place in _TERM.findall(CATALOGUE[name].sign):
        share = amount * state[{"x": 0, "y": 2}[place]]
        after[{"px": 1, "py": 3}[momentum]] += share if plus == "+" else -share
    return after
