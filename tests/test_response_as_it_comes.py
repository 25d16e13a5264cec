"""Responses as they come: what was not read, or wrongly, or is a model's, spoils no fit."""

import numpy as np
import pytest
from conftest import SMALL

from tmlattice import diagnose, load_ring
from tmlattice.effects import Cause
from tmlattice.machine.response import simulate_response

NOISE = 1e-6


def ring_of(folder, *edits):
    """The small ring with correctors of both planes by turns, and other edits of its file."""
    text = SMALL.read_text()
    for old, new in (('Vcor(eid=f"v{i}")', '(Hcor if i % 2 else Vcor)(eid=f"v{i}")'), *edits):
        assert old in text
        text = text.replace(old, new)
    (folder / "ring.py").write_text(text)
    return load_ring(folder / "ring.py")


def machine(ring, seed=5, **options):
    """Of a ring with small errors everywhere."""
    rng = np.random.default_rng(seed)
    powered = [e.name for e in ring.elements if e.kind == "quadrupole" and e.k1]
    errors = [Cause("quadrupole_gradient", name, 5e-3 * rng.standard_normal()) for name in powered]
    errors += [
        Cause(f"monitor_gain_{p}", m.name, 0.01 * rng.standard_normal())
        for m in ring.monitors
        for p in "xy"
    ]
    options = {"kick": 1e-4, "noise": NOISE, "rf_step": -3000.0, "seed": 3} | options
    return simulate_response(ring, errors, engine="ocelot", progress=False, **options).measured


@pytest.fixture(scope="module")
def ring(tmp_path_factory):
    return ring_of(tmp_path_factory.mktemp("ring"))


@pytest.fixture(scope="module")
def measured(ring):
    return machine(ring)


def left(result):
    """In plane, in units of the noise."""
    return result.steps[-1].heldout_rms_in_plane / NOISE


def test_no_column_is_exchanged_in_a_design_that_is_far_off(tmp_path, measured):
    """2 % weaker it is across a resonance, where neighbours fit each other's place by chance."""
    far = ring_of(tmp_path, ("k = 0.9", "k = 0.88"))
    known = ["quadrupole_gradient", "monitor_gain_x", "monitor_gain_y"]
    result = diagnose(far, measured, effects=known)
    assert result.steps[0].heldout_rms_in_plane > 100 * NOISE
    assert left(result) < 1.25
    assert not result.findings


COMBINED = """
from math import pi
from ocelot import *
energy = 1.0
bf = [SBend(l=1.0, angle=pi / 8, k1=1.0, eid="BF")]
bd = [SBend(l=1.0, angle=pi / 8, k1=-1.0, eid="BD")]
ring = [
    [Monitor(eid=f"m{i}"), (Hcor if i % 2 else Vcor)(eid=f"c{i}"), Drift(l=0.2), bf, Drift(l=0.4),
     Monitor(eid=f"n{i}"), (Vcor if i % 2 else Hcor)(eid=f"e{i}"), Drift(l=0.2), bd, Drift(l=0.3)]
    for i in range(8)
]
"""


def test_a_ring_without_quadrupoles(tmp_path):
    """Bends focus it: what has no places is left out, and the rest is fitted."""
    (tmp_path / "ring.py").write_text(COMBINED)
    ring = load_ring(tmp_path / "ring.py")
    data = machine(ring, rf_step=None)
    result = diagnose(ring, data)
    assert [step.effect for step in result.steps] == ["design", "monitor_gain_x, monitor_gain_y"]
    assert left(result) < 1.25
    assert result.common_factors is None
