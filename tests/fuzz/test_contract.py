"""Some of what `make fuzz` does, with the same seeds each time."""

import resource
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tmlattice.network import save_network

sys.path.insert(0, str(Path(__file__).parent))
from contract import Inputs, report, tried
from kills import filled, killed, prepared, references

from tmlattice import diagnose, load_ring, read_measurement

pytestmark = pytest.mark.usefixtures("forked_readers")
SOME = 80
"""Inputs, one or more of each format; `make fuzz` takes 10,000."""
WRITING = ("simulate", "check", "import")
"""Of the commands, the quick ones; `make fuzz` kills all of them."""


@pytest.fixture(scope="module")
def inputs(tmp_path_factory):
    """Files of every format, which are accepted as they are."""
    made = Inputs(tmp_path_factory.mktemp("fuzz"), challenges=False)
    made.check_accepted()
    return made


def test_damaged_files_end_in_one_sentence(inputs):
    found = [tried(seed, inputs, np.random.default_rng([19, seed])) for seed in range(SOME)]
    wrong = [own for own in found if own[1] is not None]
    assert not wrong, report(inputs)
    assert sum(tally.refused for tally in inputs.tallies.values()) > SOME / 2, report(inputs)


def test_one_wrong_reading_does_not_spoil_the_others(inputs):
    """2 cm for one monitor of the RF's orbit: a fit that follows it leaves 100 µm everywhere."""
    ring = load_ring(inputs.folder / "ring.json")
    measured = read_measurement(inputs.folder / "response")
    orbit = measured.rf.orbit.copy()
    orbit[3, 0] += 0.02
    wrong = replace(measured, rf=replace(measured.rf, orbit=orbit))
    found = diagnose(ring, wrong, effects=["quadrupole_gradient", "monitor_gain_x"])
    assert found.fit_after.rms < 1.01 * found.fit_before.rms
    assert "fitted, RF" in [block.name for block in found.assessment.significant]


def test_killed_commands_and_full_disks_leave_nothing_half_written(tmp_path):
    master, folder = tmp_path / "master", tmp_path / "work"
    master.mkdir()
    prepared(master, challenges=False)
    whole, results = references(master, folder, WRITING)
    rng = np.random.default_rng(19)
    for name in WRITING:
        assert killed(name, whole, results, master, folder, rng)[0] is None, name
        assert filled(name, results, master, folder, 100) is None, name


def test_a_disk_that_fills_up_while_weights_are_written(small_network, tmp_path):
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, before[1]))
    try:
        with pytest.raises(OSError, match="too large"):
            save_network(small_network, tmp_path / "network.pt")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
