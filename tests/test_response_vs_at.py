"""Orbit responses against AT's closed orbits, finite differences, and the measured PETRA III."""

import re

import at
import numpy as np
import pytest
from numpy.testing import assert_allclose
from shared import measured_data

from tmlattice import Cause, TaylorNetwork, load_ring, off_momentum, read_measurement
from tmlattice.beam.closed_orbit import ResponseModel
from tmlattice.beam.response_derivatives import ResponseSlopes
from tmlattice.effects import CATALOGUE, RingEffect, apply
from tmlattice.errors import EffectError, MeasurementError, UnknownNameError
from tmlattice.machine import at_orbit
from tmlattice.machine.at_engine import AtEngine
from tmlattice.observe.compared import OfResponse


@pytest.fixture(scope="module")
def model(petra3):
    return ResponseModel(petra3)


@pytest.fixture(scope="module")
def engine(petra3):
    return AtEngine(petra3)


SOME = [0, 5, 100, 300, 498]


def derivatives(model, hypotheses):
    slopes = ResponseSlopes(model)
    return slopes.whole(slopes.factors(hypotheses))


def test_response_of_correctors_vs_at(model, engine):
    names = [model.correctors[i] for i in SOME]
    step = 1e-6  # rad: both sides cancel the second order, the third is below 1e-9 m
    settings = [{name: {"kick": side * step}} for name in names for side in (1, -1)]
    orbits = engine.closed_orbits(settings).reshape(len(names), 2, -1, 2)
    theirs = (orbits[:, 0] - orbits[:, 1]) / 2
    assert np.abs(theirs).max() > 4e-5
    assert_allclose(step * model.response(names), theirs, atol=1e-9)  # 3.7e-10 was measured


def test_rf_response_vs_at(model, engine):
    step = 1e-8  # relative: delta is 1e-5
    up, down = engine.closed_orbits([{"rf": {"frequency_relative": s}} for s in (step, -step)])
    assert_allclose(step * model.rf_response(), (up - down) / 2, atol=1e-9)
    assert np.abs(up).max() > 4e-6


def test_engine_vs_ats_own_search(petra3, engine):
    name = next(e.name for e in petra3.elements if e.kind == "hcorrector")
    lattice = engine.lattice()
    (place,) = [i for i, e in enumerate(lattice) if e.FamName == name]
    lattice[place].KickAngle = [1e-5, 0.0]
    monitors = [i for i, e in enumerate(lattice) if isinstance(e, at.Monitor)]
    _, theirs = at.find_sync_orbit(lattice, dct=0.0, refpts=monitors)
    mine = engine.closed_orbits([{name: {"kick": 1e-5}}])[0]
    assert_allclose(mine, theirs[:, [0, 2]], atol=1e-9)


def test_finite_steps_vs_at(model, engine):
    """The second order of a step of 100 microradians, that a linear response lacks."""
    names = [model.correctors[i] for i in SOME[:3]]
    mine = model.closed_orbits(names, [1e-4] * 3)
    theirs = engine.closed_orbits([{name: {"kick": 1e-4}} for name in names])
    rms = np.sqrt(np.mean((mine - theirs) ** 2))
    assert rms < 1e-6  # third order and slicing, at orbits of millimetres
    assert np.sqrt(np.mean((theirs - 1e-4 * model.response(names)) ** 2)) > 10 * rms


def test_the_third_order_of_two_sided_steps_vs_at(model, engine):
    """Half of it arises within long sextupoles, which second-order maps lack: 2 % of it here."""
    names = [model.correctors[i] for i in SOME[:3]]
    up, down = (model.closed_orbits(names, [side * 5e-5] * 3) for side in (1, -1))
    settings = [{name: {"kick": side * 5e-5}} for name in names for side in (1, -1)]
    theirs = engine.closed_orbits(settings).reshape(3, 2, *up.shape[1:])
    third = up - down - 1e-4 * model.response(names)
    assert np.sqrt(np.mean(third**2)) > 4e-7
    # 5 nm: both codes' linear responses differ by 4e-6
    assert_allclose(up - down, theirs[:, 0] - theirs[:, 1], atol=2e-8)


def test_a_corrector_that_is_rolled_kicks_by_its_turned_kick_too(petra3, model):
    """Against the maps of a ring with rolled correctors, in both planes."""
    names, angle = [model.correctors[i] for i in SOME], 0.1
    rolled = apply(petra3, [Cause("corrector_roll", name, angle) for name in names])
    mine = np.cos(angle) * model.response(names) + np.sin(angle) * model.response(
        names, turned=True
    )
    theirs = ResponseModel(rolled).response(names)
    assert_allclose(mine, theirs, atol=1e-9 * np.abs(theirs).max())


def test_a_step_of_a_corrector_with_errors_vs_the_maps_of_the_stepped_ring(petra3, model):
    names = [model.correctors[i] for i in SOME]
    assert {petra3[name].kind for name in names} == {"hcorrector", "vcorrector"}
    errors = [
        Cause(effect, name, amount) for name in names
        for effect, amount in (("corrector_roll", 0.1), ("corrector_position", 0.02))
    ]  # fmt: skip
    machine = apply(petra3, errors)
    mine = ResponseModel(machine).closed_orbits(names, [1e-6] * len(names))
    for name, orbit in zip(names, mine, strict=True):
        stepped = ResponseModel(apply(machine, (), {name: {"kick": 1e-6}}))
        # the third order of sextupoles is far smaller
        assert_allclose(orbit, stepped.readings, atol=1e-6 * np.abs(orbit).max())


def test_without_energy_a_horizontal_kick_moves_less(petra3, model):
    """Without energy shift lacks -eta_m eta_c / (alpha C): what the longer path takes."""
    flat = ResponseModel(petra3, dimension=4)
    name = max(model.correctors, key=lambda c: abs(model.columns([c]).start[0, 5]))
    (shift,) = model.columns([name]).start[:, 5]
    dispersion = model.rf_response() / model.rf_start[5]
    gain = model.response([name])[0] - flat.response([name])[0]
    assert_allclose(gain, shift * dispersion, atol=1e-6 * np.abs(gain).max())
    facts = off_momentum(TaylorNetwork.from_ring(petra3, 6), petra3.length)
    k = model.columns([name]).layer[0] + 1
    assert_allclose(-shift, facts.dispersion[k, 0] / (facts.momentum_compaction * petra3.length),
                    rtol=1e-3)  # fmt: skip


# h of the finite differences: their own error is its square
CASES = {
    "quadrupole_gradient": ("quadrupole", 1e-5),
    "gradient_absolute": ("sextupole", 1e-6),
    "skew_gradient": ("quadrupole", 1e-6),
    "quadrupole_roll": ("quadrupole", 1e-5),
    "quadrupole_offset_x": ("quadrupole", 1e-6),
    "quadrupole_offset_y": ("quadrupole", 1e-6),
    "dipole_field": ("bend", 1e-6),
    "dipole_roll": ("bend", 1e-6),
    "corrector_kick_x": ("hcorrector", 1e-8),
    "corrector_kick_y": ("vcorrector", 1e-8),
    "sextupole_strength": ("sextupole", 1e-3),
    "sextupole_offset_x": ("sextupole", 1e-6),
    "sextupole_offset_y": ("sextupole", 1e-6),
    "insertion_device_focusing": ("wiggler", 1e-6),
    "family_gradient": ("family", 1e-6),
    "family_sextupole": ("family", 1e-3),
    "corrector_roll": ("hcorrector", 1e-4),
    "radiation_loss_bends": (None, 1e-4),
    "radiation_loss_wigglers": (None, 1e-4),
}


ON_THE_RING = [n for n, e in CATALOGUE.items() if isinstance(e, RingEffect)]


@pytest.fixture(scope="module")
def bent(small_ring):
    """A small ring whose orbit is not on the axis: every term of the second order counts."""
    return apply(small_ring, [Cause("corrector_kick_x", "v3", 2e-5),
                              Cause("corrector_kick_y", "v7", 3e-5)])  # fmt: skip


@pytest.mark.parametrize("effect", [n for n in ON_THE_RING if n != "corrector_calibration"])
def test_derivative_vs_finite_difference(bent, effect):
    kind, h = CASES.get(effect, (None, 1e-4 * CATALOGUE[effect].largest))
    places = CATALOGUE[effect].places(bent)
    if kind in (None, "family"):
        place = places[-1]
    else:
        fitting = [p for p in places if bent[p].kind == kind]
        if not fitting:
            pytest.skip(f"the small ring has no {kind} for it")
        place = fitting[len(fitting) // 2]
    (mine,) = derivatives(ResponseModel(bent), [(effect, place)])
    up, down = (ResponseModel(apply(bent, [Cause(effect, place, a)])) for a in (h, -h))
    theirs = (up.response() - down.response()) / (2 * h)
    rf = (up.rf_response() - down.rf_response()) / (2 * h)
    for own, other in ((mine[:-1], theirs), (mine[-1], rf)):
        assert_allclose(own, other, atol=3e-5 * np.abs(other).max() + 1e-6)
    assert np.abs(theirs).max() > 0


def test_correctors_that_are_not_set_move_no_map_wherever_their_fields_are(bent):
    """A changed model against one made anew; two correctors of `bent` are kicks and change."""
    rng = np.random.default_rng(1)
    model = ResponseModel(bent)
    causes = [
        Cause(effect, name, 0.02 * rng.standard_normal())
        for effect in ("corrector_position", "corrector_roll")
        for name in model.correctors
    ]
    ring = apply(bent, causes)
    changed, anew = model.changed_to(ring), ResponseModel(ring)
    scale = np.abs(anew.response()).max()
    assert_allclose(changed.response(), anew.response(), atol=1e-12 * scale)
    assert_allclose(changed.readings, anew.readings, atol=1e-15)
    assert np.abs(changed.response() - model.response()).max() > 0.01 * scale
    at_rest = [e.name for e in bent.elements if e.name in model.correctors and not e.errors.kick_x
               and not e.errors.kick_y]  # fmt: skip
    assert 0 < len(at_rest) < len(model.correctors)
    for names, count in ((at_rest, 0), (model.correctors, len(model.correctors) - len(at_rest))):
        moved = apply(bent, [c for c in causes if c.element in names])
        assert len(model.layers.changed_to(moved)[1]) == count


def test_a_ring_without_correctors_has_an_empty_response(small_ring):
    kinds = [e.kind for e in small_ring.elements]
    assert "vcorrector" in kinds
    none = ResponseModel(small_ring).response([])
    assert none.shape == (0, len(small_ring.monitors), 2)


def test_gradient_at_a_marker_moves_the_monitors_behind_it(petra3, model):
    """No magnet stands between: the read-outs themselves change."""
    kinds = "".join(
        {"marker": "m", "monitor": "b", "drift": "d"}.get(e.kind, "-") for e in petra3.elements
    )
    place = petra3.elements[re.search("m[d]*b", kinds).start()].name
    (mine,) = derivatives(model, [("gradient_absolute", place)])
    up, down = (
        ResponseModel(apply(petra3, [Cause("gradient_absolute", place, a)])) for a in (1e-5, -1e-5)
    )
    theirs = (up.response() - down.response()) / 2e-5
    assert_allclose(mine[:-1], theirs, atol=1e-5 * np.abs(theirs).max())


def test_derivative_by_calibration_is_the_response(bent):
    model = ResponseModel(bent)
    (mine,) = derivatives(model, [("corrector_calibration", "v5")])
    c = model.correctors.index("v5")
    assert_allclose(mine[c], model.response()[c], rtol=1e-9, atol=1e-12)
    assert not np.delete(mine, c, axis=0).any()


def test_refusals(small_ring):
    model = ResponseModel(small_ring)
    with pytest.raises(UnknownNameError, match="did you mean"):
        model.response(["v33"])
    with pytest.raises(MeasurementError, match="not a corrector"):
        model.response(["QF::0"])
    with pytest.raises(EffectError, match="does not act on the ring"):
        derivatives(model, [("monitor_gain_x", "last_a")])


def test_design_vs_measured_petra3():
    """The README of the data: 160.8 micrometres, all blocks and monitors, by another code."""
    folder = measured_data("petra3_orbit_response")
    ring, measured = load_ring(folder / "p3_low_beta.mat"), read_measurement(folder)
    *_, design = OfResponse(ring, measured).pairs(measured)[:2]
    difference = measured.response - design[:-1]
    assert_allclose(np.sqrt(np.nanmean(difference**2)), 160.8e-6, rtol=1e-3)
    rf = measured.rf.orbit - design[-1]
    assert np.sqrt(np.nanmean(rf**2)) < 0.15 * np.sqrt(np.nanmean(measured.rf.orbit**2))


def test_the_rf_s_finite_step_in_maps_already_made(small_ring):
    model = ResponseModel(small_ring)
    step = 2e-3 / model.rf_start[5]
    whole = [ResponseModel(small_ring, frequency=f) for f in (-step / 2, step / 2)]
    assert_allclose(model.rf_change(step), whole[1].readings - whole[0].readings, atol=1e-15)
    there = model.at_frequency(step)
    assert_allclose(there.response(), ResponseModel(small_ring, frequency=step).response(),
                    rtol=1e-12, atol=1e-12)  # fmt: skip
    # and from there: the change goes on where the model stands
    assert_allclose(
        there.rf_change(step),
        ResponseModel(small_ring, frequency=1.5 * step).readings - whole[1].readings, atol=1e-15,
    )  # fmt: skip
    assert np.abs(model.rf_change(step) - model.rf_response() * step).max() > 1e-8


def test_unset_orbit_is_found_once(small_ring, monkeypatch):
    """Every step of a response found it again: half of the time."""
    calls = []
    found = at_orbit.stored
    monkeypatch.setattr(at_orbit, "stored", lambda turn: calls.append(turn) or found(turn))
    engine = AtEngine(small_ring, [Cause("quadrupole_offset_x", "QF::5", 1e-4)])
    one, two = (engine.closed_orbits([{"v6": {"kick": kick}}]) for kick in (1e-5, 2e-5))
    assert len(calls) == 1
    fresh = AtEngine(small_ring, [Cause("quadrupole_offset_x", "QF::5", 1e-4)])
    assert_allclose(fresh.closed_orbits([{"v6": {"kick": 2e-5}}]), two, atol=0)
    assert np.abs(one - two).max() > 1e-6


@pytest.mark.parametrize("deviation", [1e-3, -1e-3])
def test_the_orbit_at_another_energy_vs_at(petra3, model, engine, deviation):
    """AT is told the energy, and not the frequency that makes it."""
    lattice = engine.lattice()
    lattice.disable_6d()
    monitors = [i for i, e in enumerate(lattice) if isinstance(e, at.Monitor)]
    _, theirs = at.find_orbit4(lattice, dp=deviation, refpts=monitors)
    there = model.at_energy(deviation)
    # that energy is linear in the frequency is as good as the ring's second order: 2e-3 of it
    assert_allclose(there.state[5], deviation, rtol=5e-3)
    size = np.abs(theirs[:, 0]).max()
    assert size > 1e-4
    assert_allclose(there.readings[:, 0], theirs[:, 0], rtol=0, atol=5e-3 * size)
    # and from there as far back
    back = there.at_energy(-deviation)
    assert np.abs(back.readings).max() < 5e-3 * size
