"""What a diagnosis is told to look for, and what it can."""

import warnings
from dataclasses import replace

import numpy as np
import pytest

from tmlattice.diagnosis import diagnose
from tmlattice.effects import Cause
from tmlattice.errors import EffectError
from tmlattice.inference.scan import effective_number, look_elsewhere
from tmlattice.machine import simulate

SHOTS = {"shots": 3, "seed": 1, "engine": "ocelot", "amplitude": 3e-4, "noise": 2e-6}


@pytest.fixture(scope="module")
def ring(small_ring):
    """Without its wiggler."""
    return replace(
        small_ring, elements=tuple(e for e in small_ring.elements if e.kind != "wiggler")
    )


@pytest.fixture(scope="module")
def data(ring):
    """The energy of every shot is free."""
    sigma = (1e-4, 2e-5, 1e-4, 2e-5, 1e-4)
    return simulate(ring, [], launch_sigma=sigma, **SHOTS).measurement()


@pytest.mark.parametrize(
    ("effects", "says"),
    [
        ([], "no effect is named"),
        (["insertion_device_focusing"], "no place in '.*small_ring.py' .*wigglers"),
        (["energy_offset"], "cannot be separated from the launch"),
        (["radiation_loss_wigglers", "energy_offset"], "energy_offset cannot .*; radiation_loss_w"),
    ],
)
def test_what_cannot_be_looked_for_is_said_in_a_sentence(ring, data, effects, says):
    with pytest.raises(EffectError, match=says):
        diagnose(ring, data, effects=effects)


def test_what_cannot_be_looked_for_is_left_out_beside_what_can(ring, data):
    asked = ["insertion_device_focusing", "dipole_field", "energy_offset"]
    found = diagnose(ring, data, effects=asked)
    assert {name for name, _ in found.explanation.scan.hypotheses} == {"dipole_field"}


def test_dead_monitors_alone_are_named_and_nothing_is_searched(small_ring):
    dead = [Cause("monitor_dead", small_ring.monitors[5].name, 1.0)]
    data = simulate(small_ring, dead, **SHOTS).measurement()
    found = diagnose(small_ring, data, effects=["monitor_dead"])
    assert [(f.effect, f.element) for f in found.findings] == [("monitor_dead", dead[0].element)]
    assert found.explanation.scan.hypotheses == ()


def test_a_statistic_of_zero_is_certain_in_noise_and_warns_nobody():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert look_elsewhere(0.0, 1, 500.0) == 1.0
        assert effective_number(np.zeros(64), 1) == 1.0


def test_a_wake_is_found_where_it_is_asked_for(small_ring):
    data = simulate(small_ring, [Cause("wake_kick_y", "wig_1", 0.02)], **SHOTS).measurement()
    found = diagnose(small_ring, data, effects=["wake_kick_x", "wake_kick_y", "dipole_field"])
    assert (found.findings[0].effect, found.findings[0].element) == ("wake_kick_y", "wig_1")
    assert found.findings[0].amount == pytest.approx(0.02, abs=4 * found.findings[0].amount_sigma)


SEVERAL = (
    Cause("quadrupole_offset_x", "QD::13", 0.0013),
    Cause("dipole_field", "bend::19", 0.0014),
    Cause("quadrupole_gradient", "QF::2", 0.04),
    Cause("sextupole_offset_y", "sf::15", -0.0012),
)


def test_more_than_three_faults_are_no_small_errors_everywhere(small_ring):
    """Three are sought first; chi-square alone would let three stand."""
    data = simulate(small_ring, SEVERAL, shots=8, seed=13).measurement()
    effects = {f.effect for f in SEVERAL} | {"dipole_roll", "corrector_kick_x", "monitor_gain_x"}
    found = diagnose(
        small_ring, data, effects=sorted(effects | {"quadrupole_offset_y", "sextupole_offset_x"})
    )
    named = {(f.effect, f.element): f for f in found.findings}
    for fault in SEVERAL[:3]:
        told = named[fault.effect, fault.element]
        assert abs(told.amount - fault.amount) < 4 * told.amount_sigma
        assert told.amount_sigma < 0.1 * abs(fault.amount)
    assert len(named) == len(SEVERAL)
    assert not found.priors
