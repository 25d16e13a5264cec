"""A search comes to an end, and one wild reading is what it is."""

import signal
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tmlattice import diagnose, simulate

sys.path.insert(0, str(Path(__file__).parent.parent / "fuzz"))
from inputs import ring as ring_of_ten


@pytest.fixture(scope="module")
def ring():
    return ring_of_ten()


@pytest.fixture(scope="module")
def measured(ring):
    """Of the ring as it is, launches unknown, five of its six monitors."""
    data = simulate(ring, [], shots=6, amplitude=1e-3, noise=2e-5, engine="ocelot", seed=0)
    data = data.measurement().select(monitors=[m.name for m in ring.monitors][:5])
    return replace(data, launches=np.zeros_like(data.launches), launch_sigma=None)


@pytest.fixture
def minutes():
    """Two, in which a search that comes to an end has ended."""

    def end(*_):
        raise TimeoutError("the search goes on and on")

    before = signal.signal(signal.SIGALRM, end)
    signal.alarm(120)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


@pytest.mark.usefixtures("minutes")
@pytest.mark.parametrize(("shot", "monitor"), [(1, 1), (0, 2), (2, 0)])
def test_a_reading_of_a_metre_is_rejected_and_is_no_finding(ring, measured, shot, monitor):
    """It spoils launches, so that a scan takes it for a gain or a magnet, in turns for ever."""
    readings = measured.readings.copy()
    readings[shot, 0, monitor, 0] = 1.0
    found = diagnose(ring, replace(measured, readings=readings), holdout=0)
    assert found.verdict == "none"
    name = ring.monitors[monitor].name
    assert any("rejected" in one and name in one for one in found.warnings)
