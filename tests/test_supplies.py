"""Quadrupoles that are alike in the design are one supply; pieces that are one magnet."""

import json
import pickle
from collections import Counter
from dataclasses import replace
from pathlib import Path

import at
import machine_data
import numpy as np
import pytest
from command import tmlattice
from shared import gradients

from tmlattice import load_ring
from tmlattice.beam.assembly import Group, assembly
from tmlattice.effects import Cause, apply, find
from tmlattice.effects.directions import directions, directions_nearby
from tmlattice.errors import LatticeError
from tmlattice.lattice import save_ring
from tmlattice.lattice.at_file import ring_from_at
from tmlattice.lattice.marked import marked
from tmlattice.maps import LayerMaps

SUPPLY = "QFm0r and 15 of its strength"
HYPOTHESES = [
    ("family_gradient", SUPPLY), ("family_gradient", "QDm0r and 15 of its strength"),
    ("family_sextupole", "sf"), ("quadrupole_gradient", "QFm2r"), ("quadrupole_gradient", "QFm3r"),
    ("radiation_loss_bends", None),
]  # fmt: skip


@pytest.fixture(scope="module")
def ring(small_ring):
    count = Counter()

    def own(element):
        name = f"{element.family}m{count[element.family]}r"
        count[element.family] += 1
        return replace(element, name=name, family=name)

    return replace(
        small_ring,
        elements=tuple(own(e) if e.kind == "quadrupole" else e for e in small_ring.elements),
    )


def test_it_is_a_place_of_what_a_supply_has(ring, small_ring):
    supply = find("family_gradient")
    assert supply.places(ring) == [SUPPLY, "QDm0r and 15 of its strength"]
    assert supply.places(small_ring) == ["QF", "QD"]
    changed = apply(ring, [Cause("family_gradient", SUPPLY.upper(), 0.01)])
    for e, before in zip(changed.elements, ring.elements, strict=True):
        own = before.kind == "quadrupole" and before.k1 > 0
        assert e.k1 == pytest.approx(1.01 * before.k1 if own else before.k1)
    assert find("family_sextupole").places(ring) == find("family_sextupole").places(small_ring)


def test_a_changed_ring_has_those_of_its_design(ring, tmp_path):
    rng = np.random.default_rng(1)
    changed = apply(ring, gradients(ring, 1e-3, rng))
    assert replace(changed, known_supplies=None).supplies == {}  # by its strengths none
    save_ring(changed, tmp_path / "as_found.json")
    for same in (changed, pickle.loads(pickle.dumps(changed)),
                 load_ring(tmp_path / "as_found.json")):  # fmt: skip
        assert same.supplies == ring.supplies
        assert find("family_gradient").members(same, SUPPLY) == find("family_gradient").members(
            ring, SUPPLY
        )


@pytest.mark.parametrize("off", ["QFm0r", "QFm1r"])
def test_a_magnet_that_is_off_is_no_member(ring, off):
    there = ring.with_changed(off, k1=0.0)
    members = find("family_gradient").members(there, SUPPLY)
    assert len(members) == 15
    assert ring.index(off) not in members
    assert apply(there, [Cause("family_gradient", SUPPLY, 0.01)])[off].k1 == 0


def test_marked_correctors_part_their_magnets(ring):
    """Halves of a magnet are members, both."""
    cut = marked(ring, correctors=["QFm0r", "QFm1r"])
    members = [cut.elements[i].name for i in find("family_gradient").members(cut, SUPPLY)]
    assert len(members) == 18
    assert {"QFm0r", "QFm0r_2", "QFm1r", "QFm1r_2"} < set(members)


def test_a_supply_of_what_is_no_element(ring, tmp_path):
    save_ring(ring, tmp_path / "ring.json")
    document = json.loads((tmp_path / "ring.json").read_text())
    document["supplies"][SUPPLY][2] = "QFm99r"
    (tmp_path / "ring.json").write_text(json.dumps(document))
    with pytest.raises(LatticeError, match=f"the supply '{SUPPLY}' has 'QFm99r', which is no"):
        load_ring(tmp_path / "ring.json")


def test_a_place_with_blanks_on_the_command_line(ring, tmp_path):
    save_ring(ring, tmp_path / "ring.json")
    tmlattice("simulate", "ring.json", "--shots", 1, "--out", "out", "--effect",
              f"family_gradient {SUPPLY} 0.01", "--truth", "truth.json", cwd=tmp_path,
              check=0)  # fmt: skip
    truth = json.loads((tmp_path / "truth.json").read_text())
    assert [cause["element"] for cause in truth["effects"]] == [SUPPLY]


def by_hypothesis(found):
    """{hypothesis: rows}, wherever they stand."""
    out = {}
    for i, hypothesis in enumerate(found.hypotheses):
        rows = np.flatnonzero(found.owner == i)
        rows = rows[np.argsort(found.layer[rows], kind="stable")]
        out[hypothesis] = [getattr(found, name)[rows] for name in ("layer", "D0", "D1", "D2")]
    return out


@pytest.mark.parametrize("k1", [1.17, 0.0])
def test_derivatives_of_a_changed_ring(ring, k1):
    """Kept ones, and those that a shot's settings change, are as worked out anew."""
    layers = LayerMaps(ring, 6)
    directions_nearby(layers, HYPOTHESES)
    there = ring.with_changed("QFm3r", k1=k1)
    fresh = by_hypothesis(directions(LayerMaps(there, 6), HYPOTHESES))
    nearby = by_hypothesis(directions_nearby(layers.changed_to(there)[0], HYPOTHESES))
    settings = {"QFm3r": {"k1_relative": k1 / ring["QFm3r"].k1 - 1}}
    shots = Group(0, np.zeros(1, dtype=int), settings, assembly(ring, (), 6))
    for found in (nearby, by_hypothesis(shots.directions(HYPOTHESES))):
        for hypothesis in HYPOTHESES:
            if k1 == 0 and hypothesis[1] == "QFm3r":
                continue  # has none to ask for
            for a, b in zip(found[hypothesis], fresh[hypothesis], strict=True):
                assert a.shape == b.shape, hypothesis
                np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-12 * np.abs(b).max(initial=1))


# --- which elements are pieces of one magnet ------------------------------------------------------
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
