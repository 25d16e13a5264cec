"""Rings whose files do not say what is a monitor or a corrector, or that are no whole ring."""

import json

import at
import numpy as np
import pytest
from command import tmlattice

from tmlattice import load_ring
from tmlattice.errors import LatticeError, UnknownNameError
from tmlattice.lattice import save_ring
from tmlattice.machine import simulate
from tmlattice.machine.at_engine import AtEngine
from tmlattice.machine.ocelot_engine import OcelotEngine
from tmlattice.machine.response import simulate_response
from tmlattice.maps import ring_matrix


def cell():
    way = at.Drift("D", 0.5)
    bend = at.Dipole("B", 1.2, np.pi / 4, 0.0, EntranceAngle=np.pi / 8, ExitAngle=np.pi / 8)
    return [
        at.Quadrupole("QF", 0.4, 1.2), at.Marker("POS"), way, at.Sextupole("SF", 0.2, 3.0),
        at.Drift("D_STEER", 0.3), bend, at.Drift("D_STEER", 0.3), at.Quadrupole("QD", 0.4, -0.7),
        at.Marker("POS"), way, at.RFCavity("RF", 0.0, 1e5, 1e8, 8, 1e9),
    ]  # fmt: skip


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    folder = tmp_path_factory.mktemp("unmarked")
    at.save_lattice(at.Lattice(cell() * 8, energy=1e9, periodicity=1), folder / "ring.json")
    at.save_lattice(at.Lattice(cell(), energy=1e9, periodicity=1), folder / "cell.json")
    return folder / "ring.json"


def test_markers_are_monitors_and_the_optics_stay(file):
    plain = load_ring(file)
    ring = load_ring(file, monitors="pos*")
    assert [m.name for m in ring.monitors] == [f"pos::{i}" for i in range(16)]
    assert ring.length == pytest.approx(plain.length)
    np.testing.assert_array_equal(ring_matrix(ring), ring_matrix(plain))
    drifts = load_ring(file, monitors=["d_steer::1", "POS"])
    assert len(drifts.monitors) == 17  # a name means one place, a family all of them
    assert drifts["d_steer::1"].length == 0.3


def test_coils_in_drifts_markers_and_sextupoles_kick_where_they_are(file):
    plain = load_ring(file, monitors="POS")
    ring = load_ring(file, monitors="POS", correctors="D_STEER, SF")
    counts = ring.counts()
    assert (counts["hcorrector"], counts["vcorrector"], counts["sextupole"]) == (24, 24, 16)
    assert ring.length == pytest.approx(plain.length)
    assert ring["sf_h::3"].s == pytest.approx(plain["sf::3"].s)
    assert ring["d_steer_v::2"].s == pytest.approx(plain["d_steer::2"].s)
    np.testing.assert_allclose(ring_matrix(ring), ring_matrix(plain), rtol=0, atol=1e-11)
    start = np.zeros((1, 6))
    kick = [{"sf_h::0": {"kick": 1e-5}, "d_steer_v::0": {"kick": -1e-5}}]
    both = [engine(ring).track(start, settings=kick)[0, 0] for engine in (AtEngine, OcelotEngine)]
    np.testing.assert_allclose(both[0], both[1], rtol=0, atol=1e-9)
    # from the sextupole's middle through bend and quadrupole to the second monitor
    assert np.abs(both[0][1]).min() > 5e-6
    assert np.abs(both[0][0]).max() < 1e-12  # the first stands before them


def test_a_trim_coil_of_a_bend_leaves_the_bend_as_it_is(file):
    plain, ring = load_ring(file), load_ring(file, monitors="POS", correctors="B")
    assert ring.counts()["bend"] == 2 * plain.counts()["bend"]
    np.testing.assert_allclose(ring_matrix(ring), ring_matrix(plain), rtol=0, atol=1e-11)
    assert ring["b_h::2"].s == pytest.approx(plain["b::2"].s)
    assert ring.pieces("b::2") == ("b::2", "b_2::2")
    start = np.array([[1e-5, 0, 1e-5, 0, 0, 0]])
    kick = [{"b_h::0": {"kick": 1e-5}}]
    both = [engine(ring).track(start, settings=kick)[0, 0] for engine in (AtEngine, OcelotEngine)]
    np.testing.assert_allclose(both[0], both[1], rtol=0, atol=1e-9)


def test_marked_ring_is_measured_and_kept(file, tmp_path):
    ring = load_ring(file, monitors="POS", correctors="SF")
    assert simulate(ring, shots=1, amplitude=1e-5).measurement().readings.shape == (1, 1, 16, 2)
    measured = simulate_response(ring, correctors=["sf_h::0", "sf_v::0"], progress=False).measured
    assert measured.planes == ("x", "y")
    save_ring(ring, tmp_path / "marked.json")
    assert load_ring(tmp_path / "marked.json").elements == ring.elements


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"monitors": "BPM*"}, UnknownNameError, r"no BPM like 'BPM\*'"),
        ({"monitors": "QF"}, LatticeError, "quadrupole 'qf::0', which cannot be a BPM"),
        ({"correctors": "RF"}, LatticeError, "cavity 'rf::0', which cannot be a corrector"),
    ],
)
def test_what_cannot_be_marked_is_told(file, options, error, message):
    with pytest.raises(error, match=message):
        load_ring(file, **options)


def test_a_ring_without_monitors_ends_in_the_sentence_that_mends_it(file, tmp_path):
    for command in (
        ["simulate", file, "--out", "day"],
        ["simulate", file, "--kind", "orbit-response", "--out", "day"],
        ["tune-fit", file, "--out", "fit"],
        ["dev", "study", "tune-fit", file, "--out", "study"],
    ):
        done = tmlattice(*command, cwd=tmp_path, check=2)
        assert "has no BPM; state which" in done.stderr, command
        assert "monitors = ['BPM*'] in tmlattice.toml" in done.stderr
        assert "such as 'pos'" in done.stderr
    assert list(tmp_path.glob("*/measurement.json")) == []
    ring = load_ring(file)
    for work in (simulate, simulate_response):
        with pytest.raises(LatticeError, match="has no BPM; state which"):
            work(ring)
    tmlattice("init", file, "--monitors", "POS", "-q", cwd=tmp_path, check=0)
    words = ["--shots", 2, "--amplitude", "1e-5", "--out", "day", "-q"]
    tmlattice("simulate", *words, cwd=tmp_path, check=0)
    done = tmlattice("info", "--json", "info.json", "-q", cwd=tmp_path, check=0)
    assert json.loads((tmp_path / "info.json").read_text())["counts"]["monitor"] == 16
    assert done.stderr == ""  # nothing of AT's own warnings


def test_one_cell_taken_for_a_ring_is_told(file, tmp_path):
    done = tmlattice("info", file.parent / "cell.json", cwd=tmp_path, check=0)
    assert "bends by 45 degrees in all, 1/8 of a turn" in done.stderr
    assert "turn" not in tmlattice("info", file, cwd=tmp_path, check=0).stderr
