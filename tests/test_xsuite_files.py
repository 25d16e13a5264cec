"""Xsuite's JSON: every class against xtrack's figures (lattices/referee_xsuite.py), every form."""

import json
import warnings
from pathlib import Path

import numpy as np
import pytest

from tmlattice import load_ring
from tmlattice.beam.chain import Chain
from tmlattice.errors import LatticeError
from tmlattice.optics import off_momentum, twiss

REFEREE = json.loads((Path(__file__).parent / "lattices" / "xsuite_classes.json").read_text())
DECKS = REFEREE["decks"]
NAMED = {
    "magnet": "the finite number of kicks",
    "octupole": "above the sextupole",
    "rbend_k1_thin_slices": "products of curvature and gradient",
    "thin_bend_k1": "products of curvature and gradient",
}
"""What is left out of a deck, with a warning."""
COUNTS = {
    **dict.fromkeys(("bend_k0_edges", "bend_feed_down", "magnet_bend", "rbend_angle_diff"),
                    ("bend", 16)),
    "base_thick_slices": ("bend", 48), "magnet": ("quadrupole", 16),
    "uniform_solenoid": ("solenoid", 8), "cavity_off": ("cavity", 8),
}  # fmt: skip
"""How many elements of a kind there are: a class is more than its linear map."""


def line_of(deck):
    """The line of a deck, as xtrack writes it, but for what is the same in all of them."""
    return {
        "elements": {**REFEREE["elements"], **deck["elements"]},
        "element_names": deck.get("cell", REFEREE["cell"]) * REFEREE["cells"],
        "particle_ref": REFEREE["particle"],
    }


def load(content, folder, **options):
    path = folder / "ring.json"
    path.write_text(json.dumps(content))
    return load_ring(path, **options)


def excursions(ring):
    """Largest |x| and |y| of the closed orbit, m."""
    path = Chain.from_ring(ring).closed_orbit(np.zeros(4))[0]
    return np.abs(np.asarray(path))[:, [0, 2]].max(0)


BEND = REFEREE["elements"]["bb"]
FEW = {"k1": 0.1, "integrator": "uniform", "num_multipole_kicks": 1}
MAGNET = {"__class__": "Magnet", "length": 0.4, "k1": 1.1}
MANY = {"num_multipole_kicks": 21, "integrator": "yoshida-6"}
KICKS = [
    *(("bb", {**BEND, **FEW, "model": model}, True)
      for model in ("adaptive", "full", "rot-kick-rot", "bend-kick-bend")),
    # as many kicks as the angle asks for, 7 for each 0.022 rad
    ("bb", {**BEND, "k1": 0.4}, False),
    ("bb", {**BEND, "k1": 0.4, "angle": 0.01}, True),
    ("qf", {**MAGNET, "integrator": "adaptive"}, True),
    ("qf", {**MAGNET, "integrator": "yoshida-4"}, True),
    ("qf", {**MAGNET, **MANY}, False),
]  # fmt: skip


@pytest.mark.parametrize(("name", "element", "few"), KICKS)
def test_few_kicks_of_a_magnet_are_named(tmp_path, name, element, few):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        load(line_of({"elements": {name: element}}), tmp_path)
    messages = [str(w.message) for w in caught]
    assert len(messages) == few
    assert all(f"the finite number of kicks of {name} (1)" in message for message in messages)


@pytest.mark.parametrize("name", DECKS)
def test_class_has_xtracks_figures(tmp_path, name):
    deck = DECKS[name]
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        ring = load(line_of(deck), tmp_path)
    messages = [str(w.message) for w in caught]
    assert len(messages) == (name in NAMED)
    assert all(NAMED[name] in message for message in messages)
    assert ring.length == pytest.approx(deck["length"], abs=1e-9)
    assert ring.energy == pytest.approx(3.0)
    if name in COUNTS:
        kind, count = COUNTS[name]
        assert ring.counts()[kind] == count
    tunes = twiss(Chain.from_ring(ring)).total_tunes
    np.testing.assert_allclose(tunes, deck["tunes"], rtol=0, atol=3e-4)
    # maps of second order, and xtrack's own closed orbit to some 1e-9 m
    np.testing.assert_allclose(excursions(ring), deck["orbit"], rtol=0.02, atol=2e-6)
    compaction = off_momentum(Chain.from_ring(ring, 6), ring.length).momentum_compaction
    assert compaction == pytest.approx(deck["momentum_compaction"], rel=5e-4)


def test_rf_of_a_harmonic_number(tmp_path):
    ring = load(line_of(DECKS["cavity_harmonic"]), tmp_path)
    cavity = next(e for e in ring.elements if e.kind == "cavity")
    assert cavity.source.freq == pytest.approx(80 * 299792458.0 / ring.length, rel=1e-6)


@pytest.mark.parametrize("name", REFEREE["refused"])
def test_class_that_is_not_modelled_is_named(tmp_path, name):
    deck = REFEREE["refused"][name]
    changed = next(iter(deck["elements"]))
    cls = deck["elements"][changed]["__class__"]
    with pytest.raises(LatticeError, match=f"{cls} .*'{changed}'|{cls} '{changed}'"):
        load(line_of(deck), tmp_path)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"__class__": "TomorrowsMagnet", "length": 0.0}, "class TomorrowsMagnet .* not modelled"),
        ({"__class__": "Quadrupole", "length": 0.1, "k9": 1.0}, "field k9 of Quadrupole 'ch'"),
        ({"__class__": "Quadrupole", "length": "long"}, "length of Quadrupole 'ch' is 'long'"),
        ({"__class__": "ThickSliceBend", "parent_name": "no"}, "no element 'no'"),
        ({"__class__": "ThickSliceBend"}, "has no parent_name"),
        ({"__class__": "Replica", "parent_name": "ch"}, "repeats itself"),
        ({"__class__": "Cavity", "voltage": 1e3, "lag": 90.0}, "frequency 0 changes the energy"),
        ({"length": 1.0}, "'ch' has no __class__"),
        ({"__class__": "Bend", "length": 1.0, "angle": 0.1, "h": 0.2}, "angle 0.1 rad, and 0.2"),
        (
            {"__class__": "RBend", "length": 1.2, "length_straight": 1.0, "angle": 0.1},
            "length 1.2 m, and 1.00042 m",
        ),
        ({"__class__": "SpaceChargeBiGaussian", "scale_strength": 1.0}, "acts on the beam"),
        ({"__class__": "BeamBeamBiGaussian2D", "other_beam_num_particles": 1e11}, "acts on"),
    ],
)
def test_what_is_not_understood_is_named(tmp_path, content, message):
    line = line_of(DECKS["base"])
    line["elements"]["ch"] = content
    with pytest.raises(LatticeError, match=message):
        load(line, tmp_path)


def test_what_does_not_act_passes(tmp_path):
    line = line_of(DECKS["base"])
    for content in (
        {"__class__": "BeamBeamBiGaussian2D", "other_beam_num_particles": 0.0},
        {"__class__": "Wire", "current": 0.0, "L_phy": 1.0, "xma": 0.1},
        {"__class__": "Wedge"},
        {"__class__": "ParticlesMonitor", "data": {"x": [1.0]}},
    ):
        line["elements"]["ch"] = content
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            assert load(line, tmp_path).length == pytest.approx(44.8)
    line["elements"]["ch"] = {"__class__": "WakeTracker", "components": [1]}
    with pytest.warns(UserWarning, match="left out of the model: what the WakeTracker does of ch"):
        load(line, tmp_path)


def same(ring, name="base"):
    """The ring's length and tunes are those of a deck."""
    assert ring.length == pytest.approx(DECKS[name]["length"], abs=1e-9)
    tunes = twiss(Chain.from_ring(ring)).total_tunes
    np.testing.assert_allclose(tunes, DECKS[name]["tunes"], rtol=0, atol=1e-6)


def test_forms_of_a_file(tmp_path):
    line = line_of(DECKS["base"])
    same(load(line, tmp_path))
    same(load({"xtrack_version": "0.20.0", **line}, tmp_path))
    particle = line.pop("particle_ref")
    same(load({"line": line, "particle": particle}, tmp_path))
    names, elements = line["element_names"], line.pop("elements")
    same(load({"elements": [elements[n] for n in names], "element_names": [
        f"{n}{k}" for k, n in enumerate(names)], "particle_ref": particle}, tmp_path))  # fmt: skip
    environment = {"elements": elements, "lines": {"ring": line, "other": {**line, "mode": "x"}}}
    same(load({**environment, "particle_ref": particle}, tmp_path))
    same(load({**environment, "particle_ref": "e", "particles": {"e": particle}}, tmp_path))
    with pytest.raises(LatticeError, match="reference particle 'e' is not in the file"):
        load({**environment, "particle_ref": "e"}, tmp_path)
    with pytest.raises(LatticeError, match="no reference particle; give energy="):
        load(environment, tmp_path)
    same(load(environment, tmp_path, energy=3.0))
    with pytest.raises(LatticeError, match="has the sequences one, two; name one"):
        load({**environment, "lines": {"one": line, "two": line}}, tmp_path, energy=3.0)
    own = {"lines": {"one": {**line, "elements": elements, "particle_ref": particle}}}
    same(load(own, tmp_path))  # of several lines that share nothing


def test_particle_of_the_file(tmp_path):
    line = line_of(DECKS["base"])
    line["particle_ref"] = {"mass0": 938272088.0, "q0": 1.0, "p0c": [2e9]}
    ring = load(line, tmp_path)
    assert ring.mass == pytest.approx(0.938272088)
    assert ring.energy == pytest.approx(np.hypot(2.0, 0.938272088))
    for wrong, message in (({"q0": 0.0}, "has the charge 0"), ({"p0c": -2e9}, "momentum -2e")):
        with pytest.raises(LatticeError, match=message):
            load({**line, "particle_ref": {**line["particle_ref"], **wrong}}, tmp_path)


def test_old_words_of_fields(tmp_path):
    line = line_of(DECKS["bend_edges"])
    bend = line["elements"]["bb"]
    bend["h"] = bend.pop("angle") / bend["length"]
    same(load(line, tmp_path), "bend_edges")
    line["elements"]["bb"] |= {"k0": bend["h"], "edge_entry_model": 0}
    same(load(line, tmp_path), "bend_edges")
    line = line_of(DECKS["dipole_edge"])
    edge = line["elements"]["e"]
    edge["_h"] = edge.pop("k")
    same(load(line, tmp_path), "dipole_edge")
    curvature, gap, angle = edge["_h"], edge.pop("hgap"), edge.pop("e1")
    fringe = 2 * gap * edge.pop("fint") * curvature * (1 + np.sin(angle) ** 2) / np.cos(angle)
    edge |= {"_h": 0.0, "_r21": curvature * np.tan(angle)}
    edge |= {"_r43": -curvature * np.tan(angle - fringe)}  # alone in the first files
    same(load(line, tmp_path), "dipole_edge")
    line = line_of(DECKS["quadrupole_tilt"])
    turn = line["elements"]["qf"].pop("rot_s_rad")
    line["elements"]["qf"] |= {"_sin_rot_s": np.sin(turn), "_cos_rot_s": np.cos(turn)}
    same(load(line, tmp_path), "quadrupole_tilt")
    line["elements"]["qd"] |= {"_sin_rot_s": -999.0, "_cos_rot_s": -999.0}  # it has none
    same(load(line, tmp_path), "quadrupole_tilt")


def test_field_of_a_bend_that_is_off(tmp_path):
    line = line_of(DECKS["base"])
    line["elements"]["bb"] |= {"k0": 0.0, "k0_from_h": False}
    ring = load(line, tmp_path)
    assert {e.errors.kick_x for e in ring.elements if e.kind == "bend"} == {np.pi / 8}


def test_line_by_positions(tmp_path):
    deck = REFEREE["composed"]
    ring = load(deck["file"], tmp_path)
    assert ring.length == pytest.approx(deck["length"], abs=1e-9)
    np.testing.assert_allclose(
        twiss(Chain.from_ring(ring)).total_tunes, deck["tunes"], rtol=0, atol=1e-6
    )
    composer = deck["file"]["lines"]["cell"]["composer"]
    changed = json.loads(json.dumps(deck["file"]))
    changed["lines"]["cell"]["composer"]["l"] = f"sqrt(({composer['l']})*({composer['l']}))"
    assert load(changed, tmp_path).length == pytest.approx(deck["length"], abs=1e-9)
    for change, message in (
        ({"components": [{"name": "qf", "at": 1.0, "from_": "bb"}]}, "refers to no element"),
        ({"components": [{"name": "qf", "at": "1/0"}]}, "position '1/0' cannot be worked out"),
        ({"components": [{"name": "qf", "at": 0.2}, {"name": "qd", "at": 0.4}]}, "before the end"),
        ({"components": ["cell"]}, "a line contains itself"),
        ({"l": 1.0}, "its length ends at 1.000000 m"),
    ):
        changed = json.loads(json.dumps(deck["file"]))
        changed["lines"]["cell"]["composer"] = {**composer, **change}
        with pytest.raises(LatticeError, match=message):
            load(changed, tmp_path)
