"""The built-in ring: what the published figures say of it, counted and measured."""

import numpy as np
import pytest

from tmlattice import TaylorNetwork, off_momentum


def test_counts(petra3):
    counts = petra3.counts()
    expected = {
        "quadrupole": 415, "bend": 355, "hcorrector": 262, "vcorrector": 237, "sextupole": 230,
        "wiggler": 20, "monitor": 246,
    }  # fmt: skip
    assert {kind: counts[kind] for kind in expected} == expected
    assert set(counts) <= {*expected, "drift", "marker"}
    assert len(petra3.magnets) == 1519
    assert len(petra3.monitors) == 246
    assert petra3.energy == 6.0
    skew = [e for e in petra3.magnets if e.kind == "quadrupole" and e.tilt != 0]
    assert len(skew) == 16
    assert all(e.k1 == 0 for e in skew)


def test_lengths_and_angles(petra3):
    assert petra3.length == pytest.approx(2303.95, abs=0.1)
    bends = [e for e in petra3.elements if e.kind == "bend"]
    assert sum(e.angle for e in bends) == pytest.approx(2 * np.pi, abs=1e-9)
    assert min(e.length for e in petra3.elements) >= 0.0


def test_names_are_meaningful_and_unique(petra3):
    names = [e.name.casefold() for e in petra3.elements]
    assert len(set(names)) == len(names)
    assert not any(name.startswith("id_") for name in names)
    for kind in ("monitor", "hcorrector", "vcorrector"):
        assert all("::" not in e.name for e in petra3.elements if e.kind == kind)


def test_straights_are_free_of_dispersion(petra3):
    energy = off_momentum(TaylorNetwork.from_ring(petra3, 6), petra3.length)
    inside = {
        name: abs(eta[0])
        for name, eta in zip((e.name for e in petra3.magnets), energy.dispersion[1:], strict=True)
        if name.startswith("wig")
    }
    assert len(inside) == 20
    assert max(inside.values()) < 0.1
    assert abs(energy.dispersion[0, 0]) < 0.1  # the ring starts in the middle of a straight


def test_five_millimetres_survive_5000_turns(petra3_network):
    size = 5e-3
    launch = [[size, 0, 0, 0], [0, 0, size, 0], [size, 0, size, 0], [-size, 0, size, 0]]
    states = petra3_network.track(launch, 5000)
    assert np.isfinite(states).all()
    assert np.abs(states[..., [0, 2]]).max() < 0.03
