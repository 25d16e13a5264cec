"""Every effect of the catalogue: its derivative against the finite change of the tracked turn."""

from dataclasses import replace

import numpy as np
import pytest
from places import PLACES

from tmlattice import load_ring
from tmlattice.beam.model import Model
from tmlattice.effects import (
    CATALOGUE,
    Cause,
    LaunchEffect,
    Monitors,
    RingEffect,
    apply,
    beams,
    check,
    find,
    monitors_with,
    names,
)
from tmlattice.errors import EffectError, LatticeError, UnknownNameError
from tmlattice.lattice import save_ring
from tmlattice.machine import draw_shots
from tmlattice.maps import element_map
from tmlattice.maps.magnets import ring_maps, ring_matrix

SETTINGS = {
    "hcor_sw_4": {"kick": 1e-4},
    "vcor_a1_5": {"kick": -1e-4},
    "qd::4": {"k1_relative": 0.01},
}


@pytest.fixture(scope="module")
def launches(petra3):
    return draw_shots(petra3, 2, 1e-3, seed=1).launches[:, [0, 1, 2, 3, 5]]


@pytest.fixture(scope="module")
def model(petra3):
    return Model(petra3, [{}, SETTINGS])


@pytest.fixture(scope="module")
def paths(model, launches):
    return model.paths(launches)


def finite_change(model, launches, effect, place):
    """d readings / d amount^power of the tracked turn, by differences around no effect."""
    if effect.discrete:
        return model.readings(launches, [Cause(effect.name, place, 1.0)]) - model.readings(launches)
    h = 7e-4 * effect.largest
    if effect.power == 2:  # even in the amount: what two steps leave of its square
        base = model.readings(launches)
        one, two = (model.readings(launches, [Cause(effect.name, place, k * 20 * h)]) - base
                    for k in (1, 2))  # fmt: skip
        return (16 * one - two) / 12 / (20 * h) ** 2
    up = model.readings(launches, [Cause(effect.name, place, h)])
    return (up - model.readings(launches, [Cause(effect.name, place, -h)])) / (2 * h)


IN_A_TURN = [name for name, effect in CATALOGUE.items() if not effect.of_turns]
"""What a single turn shows; of what many turns do see `test_turn_offset`."""


@pytest.mark.parametrize("name", IN_A_TURN)
def test_derivative_vs_finite_change_of_the_tracked_turn(model, launches, paths, name):
    assert name in PLACES, f"'{name}' has no test: add the places where it is to be tried"
    effect = find(name)
    for place in PLACES[name]:
        signature = model.signatures(paths, [(name, place)], launches)[0]
        change = finite_change(model, launches, effect, place)
        size = np.linalg.norm(np.nan_to_num(change, nan=1.0))
        assert size > 0
        # central differences leave (1e-3)^2 of an effect's own nonlinearity; one step of a spread
        # leaves its fourth power
        most = 1e-5 if effect.power == 2 else 3e-6
        if "sextupole" in name:  # its third order is in the turn, not in the signature
            most = 3e-3
        assert np.linalg.norm(np.nan_to_num(change - signature)) < most * size, place
        assert np.array_equal(np.isnan(change), np.isnan(signature))


# A wrong polarity and more, a roll, exchanged planes, an offset: what a diagnosis may know.
KNOWN = [
    Cause("monitor_gain_x", "bpm_a4_3", -1.84),
    Cause("monitor_gain_y", "bpm_a4_3", 0.2),
    Cause("monitor_roll", "bpm_a4_3", 0.1),
    Cause("monitor_coupling", "bpm_a4_3", 0.05),
    Cause("monitor_offset_x", "bpm_a4_3", 1e-3),
    Cause("monitor_swap", "bpm_a4_3", 1.0),
]


@pytest.fixture(scope="module")
def known(petra3, launches):
    """The same monitor errors everywhere that is tried, and a fitted one on top."""
    model = Model(petra3, [{}, SETTINGS], known=KNOWN)
    return model, model.paths(launches)


@pytest.mark.parametrize(
    "name", [name for name in IN_A_TURN if not isinstance(CATALOGUE[name], RingEffect)]
)
def test_known_monitor_errors_are_in_the_signatures_of_launch_and_readings(known, launches, name):
    model, paths = known
    effect = find(name)
    place = None if isinstance(effect, LaunchEffect) else "bpm_a4_3"
    signature = model.signatures(paths, [(name, place)], launches)[0]
    seen = model.maps.monitors.index("bpm_a4_3")
    change = finite_change(model, launches, effect, place)
    mine, there = signature[:, seen], change[:, seen]
    assert np.array_equal(np.isnan(mine), np.isnan(there))
    if name != "monitor_dead":
        assert np.linalg.norm(mine - there) < 3e-6 * np.linalg.norm(there)
        assert np.linalg.norm(there) > 0


def test_reading_effects_join_what_a_fit_has_found(petra3, launches):
    """A monitor that is exchanged by the fit: its x reads y, so an error of x is one of y."""
    model = Model(petra3, [{}, SETTINGS])
    causes = [Cause("monitor_swap", "bpm_a4_3", 1.0), Cause("monitor_gain_x", "bpm_a4_3", 0.5)]
    paths = model.paths(launches, causes)
    signature = model.signatures(paths, [("monitor_offset_x", "bpm_a4_3")], launches)[0]
    h = 1e-6
    up, down = (
        model.readings(launches, [*causes, Cause("monitor_offset_x", "bpm_a4_3", a)])
        for a in (h, -h)
    )
    change = (up - down) / (2 * h)
    assert np.abs(change).max() == pytest.approx(1.0)
    assert np.abs(change - signature).max() < 1e-6


@pytest.mark.parametrize("name", CATALOGUE)
def test_an_effect_leaves_the_given_ring_unchanged(petra3, name):
    before = ring_matrix(petra3)
    errors = [element.errors for element in petra3.elements]
    k1 = [element.k1 for element in petra3.elements]
    amount = 1.0 if CATALOGUE[name].discrete else 0.3 * CATALOGUE[name].largest
    apply(petra3, [Cause(name, PLACES[name][0], amount)], SETTINGS)
    assert np.array_equal(ring_matrix(petra3), before)
    assert [element.errors for element in petra3.elements] == errors
    assert [element.k1 for element in petra3.elements] == k1


@pytest.mark.parametrize("name", CATALOGUE)
def test_an_effect_describes_itself(petra3, name):
    effect = CATALOGUE[name]
    assert effect.name == name
    assert all([effect.unit, effect.sign, effect.sits_on_text])
    assert effect.largest > (effect.background or 0) >= 0
    places = effect.places(petra3)
    assert set(PLACES[name]) <= set(places)
    assert len(set(places)) == len(places)


def test_no_test_case_is_left_of_an_effect_that_went():
    assert set(PLACES) == set(CATALOGUE)


def test_tangents_vs_finite_change_of_the_launch(model, launches, paths):
    for column in range(5):
        h = np.zeros(5)
        h[column] = 1e-6
        change = (model.readings(launches + h) - model.readings(launches - h)) / 2e-6
        slope = paths.launch[..., column]
        assert np.abs(change - slope).max() < 1e-6 * np.abs(slope).max()


def test_two_turns_are_one_chain(petra3, launches):
    """The second turn of a shot is the first turn of where it ended; signatures carry on."""
    model = Model(petra3, [{}], turns=2)
    paths = model.paths(launches[:1])
    for hypothesis in [("quadrupole_gradient", "qd::12"), ("skew_gradient", "a3")]:
        signature = model.signatures(paths, [hypothesis], launches[:1])[0]
        change = finite_change(model, launches[:1], find(hypothesis[0]), hypothesis[1])
        assert np.linalg.norm(change - signature) < 1e-5 * np.linalg.norm(change)
    end = paths.states[:, len(model.maps.W0) + 1]
    second = Model(petra3, [{}]).paths(end[:, [0, 1, 2, 3, 5]])
    assert np.abs((paths.states[0, -1] - second.states[0, -1])[[0, 1, 2, 3, 5]]).max() < 1e-12


def test_a_kick_in_a_cavity_sits_in_its_middle(tmp_path):
    path = tmp_path / "line.py"
    path.write_text(
        "from ocelot import *\nenergy = 6.0\n"
        "ring = [Cavity(l=0.6, freq=5e8, eid='it'), Quadrupole(l=0.1, k1=0.1, eid='q')]\n"
    )
    ring = apply(load_ring(path), [Cause("wake_kick_y", "it", 0.05)])
    x, px, y, py = 1e-3, 1e-4, 2e-3, -2e-4
    kick = 0.05 * (y + 0.3 * py)
    expected = [x + 0.6 * px, px, y + 0.6 * py + 0.3 * kick, py + kick]
    assert element_map(ring["it"], 6.0)([x, px, y, py]) == pytest.approx(expected, abs=1e-12)


def test_a_kick_survives_the_lattice_file(small_ring, tmp_path):
    ring = apply(small_ring, [Cause("wake_kick_y", "wig_1", 0.02)])
    save_ring(ring, tmp_path / "ring.json")
    again = load_ring(tmp_path / "ring.json")["wig_1"]
    assert again.errors == ring["wig_1"].errors != small_ring["wig_1"].errors


def test_monitor_model_in_the_order_of_the_design_page():
    monitors = Monitors.perfect(1)
    for name, amount in [
        ("monitor_gain_x", 0.1),
        ("monitor_gain_y", -0.2),
        ("monitor_coupling", 0.05),
        ("monitor_roll", 0.3),
        ("monitor_offset_x", 1e-3),
        ("monitor_swap", 1.0),
    ]:
        find(name).set(monitors, 0, amount)
    x, y = 2e-3, -1e-3
    turned = [x * np.cos(0.3) + y * np.sin(0.3), -x * np.sin(0.3) + y * np.cos(0.3)]
    mixed = [turned[0] + 0.05 * turned[1], turned[1] + 0.05 * turned[0]]
    by_hand = [1.1 * mixed[0] + 1e-3, 0.8 * mixed[1]]
    assert monitors.read(np.array([[x, y]]))[0] == pytest.approx(by_hand[::-1])


def test_monitors_are_known_by_what_they_make_of_the_beam(rng):
    """The inverse of their matrices: reversed ones, and much mixing, too."""
    given = Monitors.perfect(50)
    given.gain = rng.choice([1.0, -1.0], (50, 2)) * rng.uniform(0.5, 1.5, (50, 2)) - 1
    given.roll, given.coupling = rng.uniform(-0.2, 0.2, 50), rng.uniform(-0.5, 0.5, 50)
    found = Monitors.of(given.matrix())
    for name in ("gain", "roll", "coupling"):
        np.testing.assert_allclose(getattr(found, name), getattr(given, name), atol=1e-12)
    hardly = np.array([[[1.0, 0.02], [0.03, 0.001]], [[0.9, 1.1], [0.0, -1.0]]])
    np.testing.assert_allclose(Monitors.of(hardly).matrix(), hardly, atol=1e-12)
    swapped = Monitors.of(np.array([[[0.0, 1.0], [1.0, 0.0]]]))
    np.testing.assert_array_equal(swapped.gain, -1.0)


def test_energy_spread_is_a_gaussian_average():
    launches = np.zeros((1, 6))
    weights, nodes = beams(launches, [Cause("energy_spread", None, 1e-3)])
    p = nodes[:, 0, 5]
    assert weights.sum() == pytest.approx(1)
    assert weights @ p**2 == pytest.approx(1e-6)
    assert weights @ p**4 == pytest.approx(3e-12)


@pytest.mark.parametrize(
    ("cause", "error", "says"),
    [
        (Cause("quadrupole_gradiant", "qd::12", 0.1), UnknownNameError, "quadrupole_gradient"),
        (Cause("quadrupole_gradient", "qd_12", 0.1), UnknownNameError, "qd::12"),
        (Cause("quadrupole_gradient", "s1::48", 0.1), EffectError, "a sextupole"),
        (Cause("quadrupole_gradient", "qskew_nw_1", 0.1), EffectError, "k1 not 0"),
        (Cause("monitor_gain_x", "qd::12", 0.1), EffectError, "BPMs"),
        (Cause("quadrupole_gradient", "qd::12", float("nan")), EffectError, "give a number"),
        (Cause("monitor_swap", "bpm_a4_3", 0.3), EffectError, "there or not"),
    ],
)
def test_impossible_causes_are_errors_with_a_remedy(petra3, cause, error, says):
    with pytest.raises(error, match=says):
        check(petra3, [cause])


def test_an_effect_without_a_place_is_refused(small_ring):
    bare = [e for e in small_ring.elements if e.kind != "wiggler"]
    with pytest.raises(EffectError, match=r"no place in .*wigglers"):
        check(replace(small_ring, elements=bare), [Cause("radiation_loss_wigglers", None, 1.0)])


def test_wrong_settings_and_loss_in_four_coordinates_are_refused(petra3):
    with pytest.raises(EffectError, match="correctors have kick"):
        apply(petra3, [], {"qd::12": {"kick": 1e-5}})
    lossy = apply(petra3, [Cause("radiation_loss_bends", None, 1.0)])
    with pytest.raises(LatticeError, match="six"):
        ring_maps(lossy, 4)


def test_causes_add_up(petra3):
    both = apply(petra3, [Cause("quadrupole_offset_x", "qd::12", a) for a in (1e-4, 2e-4)])
    assert both["qd::12"].errors.dx == pytest.approx(3e-4)
    monitors = monitors_with(petra3, [Cause("monitor_gain_x", "bpm_a4_3", 0.1)] * 2)
    assert monitors.gain.max() == pytest.approx(0.21)


def test_names_come_in_the_order_of_the_catalogue():
    assert "wake_kick_x" not in names()  # unless it is asked for
    assert names(["wake_kick_x"]) == ["wake_kick_x"]
    assert names(["dipole_field", "quadrupole_roll"]) == ["quadrupole_roll", "dipole_field"]
    with pytest.raises(UnknownNameError):
        names(["dipole"])
