"""Which elements are pieces of one magnet."""

from pathlib import Path

import at
import machine_data
import numpy as np

from tmlattice import load_ring
from tmlattice.lattice.at_file import ring_from_at


def ring_of(*elements):
    return ring_from_at(at.Lattice(elements, energy=1e9, periodicity=1), "x")


WAY = at.Drift("d", 0.1)


def test_halves_around_a_monitor_or_a_corrector_are_one_magnet():
    half = at.Quadrupole("Q", 0.2, 1.0)
    coil = at.Corrector("COR", 0.0, [0, 0])
    ring = ring_of(half, at.Monitor("M"), half, WAY, half, coil, half, WAY, half)
    assert ring.pieces("q::0") == ring.pieces("q::1") == ("q::0", "q::1")
    assert ring.pieces("q::3") == ("q::2", "q::3")
    assert ring.pieces("q::4") == ("q::4",)
    assert ring.pieces("cor_h") == ("cor_h",)


def test_magnets_of_two_supplies_that_touch_are_two():
    ring = ring_of(
        at.Quadrupole("QA", 0.2, 1.0), at.Quadrupole("QB", 0.2, 1.1), at.Sextupole("QB", 0.2, 1.1)
    )
    assert ring.slices == {}


def test_slices_of_a_dipole_and_its_edges_are_the_dipole():
    bend = [at.Dipole(f"DL_{i}", 0.3 + 0.01 * i, 0.02 + 0.01 * i, 0.0) for i in range(3)]
    edge = at.Multipole("CROSSTALK", 0.001, [0, 0], [0, 3.0])
    ring = ring_of(
        edge, *bend, edge, WAY, edge, at.Sextupole("S", 0.2, 30.0), WAY,
        at.Dipole("B", 0.3, 0.1, 0.0), at.Dipole("BACK", 0.3, -0.1, 0.0),
    )  # fmt: skip
    assert ring.pieces("dl_1") == ("crosstalk::0", "dl_0", "dl_1", "dl_2", "crosstalk::1")
    assert ring.pieces("crosstalk::2") == ("crosstalk::2", "s")
    assert ring.pieces("b") == ("b",)  # the next one bends back
    assert [ring.elements[i].name for i in ring.slices] == ["dl_2", "s"]


def test_a_sextupole_cut_for_a_coil_stays_one_magnet():
    ring = load_ring(Path(machine_data.__file__).parent / "dba.mat", correctors="SF")
    for i in range(8):
        assert ring.pieces(f"sf_2::{i}") == (f"sf::{i}", f"sf_2::{i}")
        assert np.isclose(ring[f"sf_2::{i}"].s - ring[f"sf::{i}"].s, 0.05)
        assert ring.pieces(f"qfm::{i}") == (f"qfm::{i // 2 * 2}", f"qfm::{i // 2 * 2 + 1}")
