"""The noise that nobody states, where the readings could make it nothing."""

from dataclasses import replace

import numpy as np
import pytest

from tmlattice import Cause, diagnose
from tmlattice.fitting.launches import with_noise
from tmlattice.machine import simulate

NOISE = 2e-5


@pytest.fixture(scope="module")
def copied(small_ring):
    """Monitors at one place that are one signal under two names, and no noise stated."""
    data = simulate(
        small_ring, [], shots=4, noise=NOISE, amplitude=5e-4, seed=1, engine="ocelot"
    ).measurement()
    s = np.array([small_ring[name].s for name in data.monitors])
    again = np.flatnonzero(np.diff(s) < 1e-6) + 1
    assert len(again) > len(s) / 3
    readings = data.readings.copy()
    readings[:, :, again] = readings[:, :, again - 1]
    return replace(data, readings=readings, noise=None)


def test_one_signal_under_two_names_has_the_noise_of_one(small_ring, copied):
    found = diagnose(small_ring, copied, holdout=0)
    assert found.noise_estimated
    assert found.noise == pytest.approx((NOISE, NOISE), rel=0.25)
    assert found.verdict == "none"


def test_a_fit_of_weights_takes_that_noise_too(small_ring, copied):
    found, estimated = with_noise(small_ring, copied)
    assert estimated
    assert found.noise == pytest.approx(np.full_like(found.noise, NOISE), rel=0.25)


def test_noise_is_estimated_once_from_measurement_and_reference(small_ring):
    """Small errors everywhere, which neighbours leave of one another, are not taken for noise."""
    options = {"background": {"all": None}, "machine_seed": 7, "noise": NOISE, "amplitude": 4e-4,
               "engine": "ocelot"}  # fmt: skip
    before = simulate(small_ring, [], shots=3, seed=1, **options).measurement()
    fault = Cause("quadrupole_gradient", "QD::5", -0.05)
    after = simulate(small_ring, [fault], shots=3, seed=2, **options).measurement()
    told = []
    before, after = (replace(own, noise=None) for own in (before, after))
    effects = ["quadrupole_gradient", "quadrupole_offset_x", "quadrupole_offset_y"]
    found = diagnose(small_ring, after, reference=before, effects=effects, progress=told.append)
    assert found.noise == pytest.approx((NOISE, NOISE), rel=0.5)  # neighbours leave ten times it
    assert found.noise_estimated
    assert [(one.effect, one.element) for one in found.findings] == [(fault.effect, fault.element)]
    own = found.findings[0]
    assert abs(own.amount - fault.amount) < 4 * own.amount_sigma < 0.04
    assert "reference" in told
