"""A ring whose own elements have errors is the machine with those causes."""

import numpy as np
import pytest

from tmlattice import load_ring
from tmlattice.effects import CATALOGUE, Cause, apply
from tmlattice.effects.effect import RingEffect
from tmlattice.errors import LatticeError
from tmlattice.lattice import save_ring
from tmlattice.machine.at_engine import AtEngine

LAUNCH = np.array([[1e-4, 1e-5, -1e-4, 1e-5, 0, 0], [0.0] * 6])
EFFECTS = [name for name, effect in CATALOGUE.items() if isinstance(effect, RingEffect)]


@pytest.mark.parametrize("name", EFFECTS)
def test_at_engine_builds_what_the_ring_itself_has(small_ring, name):
    """The engine once passed over the errors of a loaded ring without a word."""
    effect = CATALOGUE[name]
    amount = 1.0 if effect.one_sign else effect.largest / 20  # as much radiation as is expected
    behind = {e.name for e in small_ring.elements if e.s > small_ring.monitors[-1].s}
    place = [p for p in effect.places(small_ring) if p not in behind][-1]
    cause = Cause(name, place, amount)
    settings = None
    if effect.group == "correctors":  # those of calibration and roll need a kick to be seen
        settings = [{cause.element: {"kick": 1e-4}}] * 2
    told = AtEngine(small_ring, [cause]).track(LAUNCH, 1, settings)
    healthy = AtEngine(small_ring).track(LAUNCH, 1, settings)
    wrong = apply(small_ring, [cause], settings[0] if settings else {})
    built = AtEngine(wrong).track(LAUNCH)
    change = np.abs(told - healthy).max()
    assert change > 1e-11
    # a bend's kick is spread, its roll of second order; a loss is made good by no cavity in a turn
    np.testing.assert_allclose(built, told, rtol=0, atol=2e-3 * change)


def test_a_saved_machine_is_simulated_as_it_is(small_ring, tmp_path):
    causes = [Cause("quadrupole_offset_x", "QF::2", 3e-4), Cause("dipole_field", "bend::3", 1e-3)]
    save_ring(apply(small_ring, causes), tmp_path / "found.json")
    again = AtEngine(load_ring(tmp_path / "found.json")).track(LAUNCH)
    np.testing.assert_allclose(again, AtEngine(small_ring, causes).track(LAUNCH), atol=1e-10)
    assert np.abs(again[1]).max() > 1e-4  # a machine with errors does not keep its axis


def test_errors_add_to_causes_and_what_cannot_be_built_is_told(small_ring):
    half = [Cause("quadrupole_offset_y", "QD::1", 1e-4)]
    twice = AtEngine(apply(small_ring, half), half).track(LAUNCH)
    whole = AtEngine(small_ring, [Cause("quadrupole_offset_y", "QD::1", 2e-4)]).track(LAUNCH)
    np.testing.assert_allclose(twice, whole, rtol=0, atol=1e-12)
    place = small_ring.index("bend::0")
    rolled = small_ring.with_elements({place: small_ring["bend::0"].with_errors(roll=1e-3)})
    with pytest.raises(LatticeError, match="'bend::0' with a roll of its own"):
        AtEngine(rolled)
