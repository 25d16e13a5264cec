"""Rings that accelerator-toolbox ships: the questions of `benchmarks/rings.py`, of their files."""

import sys
from pathlib import Path

import at
import machine_data
import numpy as np
import pytest
from command import refused, tmlattice

from tmlattice import load_ring
from tmlattice.machine.at_engine import AtEngine
from tmlattice.machine.ocelot_engine import OcelotEngine

FOLDER = Path(machine_data.__file__).parent
sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
import rings  # noqa: E402

SMALL = {case.name: case for case in rings.cases() if case.name in ("dba", "thomx")}


@pytest.mark.parametrize("name", SMALL)
@pytest.mark.filterwarnings("ignore::at.AtWarning")
def test_small_ring_agrees_with_at_and_its_fault_is_found(name):
    row = rings.study(SMALL[name])
    for key, limit in rings.LIMITS.items():
        assert row[key] < limit, (key, row)
    assert row["place"], row
    assert row["verdict"] in ("identified", "ambiguous"), row
    assert row["tune_fit"] < 0.01, row  # the change is 0.02 to 0.05
    assert row["green"]


def test_a_case_that_is_wrong_is_not_green():
    row = {"tunes_at": 1e-5, "turn_file": 1e-3, "place": False, "tune_fit": 1e-3}
    assert not rings.green(row)
    assert rings.green({**row, "place": True})
    assert not rings.green({**row, "place": True, "turn_file": 0.1})


@pytest.mark.parametrize(
    ("name", "correctors"), [("soleil.m", 191), ("australian_synchrotron.m", 32)]
)
def test_a_ring_with_a_cavity_is_built_by_both_engines(name, correctors):
    """The default engine once refused six of six. Correctors of both planes are there."""
    ring = load_ring(FOLDER / name)
    counts = ring.counts()
    assert counts["cavity"] >= 1
    assert counts["hcorrector"] == counts["vcorrector"] == correctors
    launch = np.zeros((1, 6))
    launch[0, :4] = [1e-5, 0, 1e-5, 0]
    a, b = (engine(ring).track(launch, 2) for engine in (AtEngine, OcelotEngine))
    # of orbits of 10 to 50 micrometres
    np.testing.assert_allclose(a, b, rtol=0, atol=2e-8)


def test_a_file_that_at_refuses_ends_in_one_sentence(tmp_path):
    words = "info", FOLDER / "errnoclass.mat"
    refused(*words, cwd=tmp_path, says="cannot be read as an AT lattice")
    quiet = tmlattice("info", FOLDER / "noenergy.mat", cwd=tmp_path, check=0)
    assert "AT " not in quiet.stderr  # AT's own words stay in the log
    assert at.load_lattice(FOLDER / "hmba.mat").energy == 6e9
