"""The two engines against each other: maps of OCELOT, thick symplectic tracking by AT."""

import numpy as np
import pytest
from conftest import SMALL
from places import PLACES

from tmlattice import load_ring
from tmlattice.effects import CATALOGUE, Cause, ReadingEffect
from tmlattice.machine import Machine, draw_shots

SETTINGS = {"hcor_sw_4": {"kick": 5e-5}, "vcor_a1_5": {"kick": -5e-5}}


@pytest.fixture(scope="module")
def shots(petra3):
    return draw_shots(petra3, 3, 1e-3, seed=3, settings=[SETTINGS] * 3)


@pytest.fixture(scope="module")
def orbits(petra3, shots):
    return {
        engine: Machine(petra3, engine=engine).beam(shots.launches, 1, shots.settings)
        for engine in ("at", "ocelot")
    }


ON_THE_BEAM = [n for n, effect in CATALOGUE.items() if not isinstance(effect, ReadingEffect)]


@pytest.mark.parametrize("name", ON_THE_BEAM)
def test_change_of_the_orbit_is_the_same_in_both_engines(petra3, shots, orbits, name):
    effect = CATALOGUE[name]
    amount = effect.background or effect.largest / 10
    for place in PLACES[name]:
        causes = [Cause(name, place, amount)]
        at, ocelot = (
            Machine(petra3, causes, engine=engine).beam(shots.launches, 1, shots.settings) - before
            for engine, before in orbits.items()
        )
        size = np.sqrt((at**2).mean())
        assert size > 1e-9
        error = np.sqrt(((at - ocelot) ** 2).mean()) / size
        # a spread is seen in the second order of the energy: its share of third-order terms
        # (launch x energy^2) is not in second-order maps, 4 % of a change of half a micrometre
        assert error < (0.06 if name == "energy_spread" else 0.02), place


def test_radiating_turns_keep_their_beam_in_both_engines(petra3):
    """300 turns with radiation and the RF that makes it good: the energy does not run away."""
    shots = draw_shots(petra3, 1, 1e-4, sigma=(0,) * 5, seed=1)
    for engine in ("at", "ocelot"):
        beam = Machine(petra3, engine=engine, radiation=True).beam(shots.launches, 300)
        late = beam[0, -50:]
        assert np.isfinite(late).all()
        assert np.sqrt((late**2).mean()) < 1.5e-3  # the sawtooth orbit and the launch's own


def test_a_set_gradient_of_a_bend_is_the_same_in_both_engines(small_ring):
    """k1_relative of a combined-function bend, alone and in the model."""
    ring = small_ring.with_changed("bend::3", k1=-0.05)
    setting = {"bend::3": {"k1_relative": 0.1}}
    shots = draw_shots(ring, 2, 1e-3, seed=3)
    changes = {}
    for engine in ("at", "ocelot"):
        machine = Machine(ring, engine=engine)
        there = machine.beam(shots.launches, 1, [setting] * 2)
        changes[engine] = there - machine.beam(shots.launches)
    size = np.sqrt((changes["at"] ** 2).mean())
    assert size > 1e-5
    assert np.sqrt(((changes["at"] - changes["ocelot"]) ** 2).mean()) < 0.02 * size


def test_a_matrix_that_kicks_does_so_in_both_engines(tmp_path):
    """A misaligned magnet of an AT file is such a matrix; beside a fault in its middle as well."""
    text = SMALL.read_text().replace(
        "root = sqrt", "wiggler.b[:4, 0] = [1e-5, 2e-5, -3e-5, 1e-5]\nroot = sqrt"
    )
    (tmp_path / "ring.py").write_text(text)
    ring = load_ring(tmp_path / "ring.py")
    launches = np.zeros((1, 6))
    for causes in ([], [Cause("insertion_device_focusing", "wig_1", 0.5)]):
        at, ocelot = (
            Machine(ring, causes, engine=engine).beam(launches, 2) for engine in ("at", "ocelot")
        )
        assert np.abs(ocelot).max() > 1e-4
        np.testing.assert_allclose(at, ocelot, rtol=0, atol=1e-8)  # sextupoles, to third order
