"""Magnets of several fields in one: nothing is lost in the maps, the engines or the JSON."""

import warnings

import at
import numpy as np
import pytest
from at.load.utils import element_from_dict
from scipy.io import loadmat
from shared import measured_data

from tmlattice import load_ring
from tmlattice.beam.chain import Chain
from tmlattice.effects import find
from tmlattice.lattice import save_ring
from tmlattice.lattice.at_file import ring_from_at
from tmlattice.machine.at_engine import AtEngine
from tmlattice.machine.ocelot_engine import OcelotEngine
from tmlattice.maps import ring_matrix
from tmlattice.maps.quadratic import composed, of_ocelot, parts_of, quadratic_map
from tmlattice.optics import off_momentum, one_turn_optics

ENERGY = 1.9


def cell(coils):
    """A FODO cell whose magnets carry coils for other fields."""
    A = [1e-5, 0.02, 1.0] if coils else [0.0, 0.0, 0.0]
    more = np.array([-2e-5, 0.01, 0.0]) if coils else np.zeros(3)
    way = at.Drift("d", 0.4)
    bend = at.Dipole("b", 1.2, np.pi / 8, 0.0, PassMethod="ExactSectorBendPass")
    return [
        at.Quadrupole("qf", 0.4, 0.9), way, at.Monitor("bpm"),
        at.Sextupole("sf", 0.2, 11.0, PolynomA=A, PolynomB=[*more[:2], 11.0]), way, bend, way,
        at.Quadrupole("qd", 0.4, -0.95, PolynomA=[0, A[1], 0], PolynomB=[0, -0.95, 0]), way,
        at.Sextupole("sd", 0.2, -19.0, PolynomA=A, PolynomB=[*more[:2], -19.0]), way, bend, way,
    ]  # fmt: skip


@pytest.fixture(scope="module")
def lattice():
    made = at.Lattice([e.deepcopy() for _ in range(8) for e in cell(True)], energy=ENERGY * 1e9)
    for element in made:
        if isinstance(element, at.Multipole):
            element.NumIntSteps = 30
    return made


@pytest.fixture(scope="module")
def ring(lattice):
    return ring_from_at(lattice, "coils")


def test_a_sextupole_with_coils_is_a_sextupole_that_can_be_found_wrong(ring):
    assert ring.counts()["sextupole"] == 16
    assert ring.counts()["quadrupole"] == 16
    assert ring["sf::3"].k2 == 22.0
    assert ring["sf::3"].k1 == pytest.approx(0.01)
    assert len(find("sextupole_strength").places(ring)) == 16
    assert "qd::0" in find("quadrupole_gradient").places(ring)
    assert ring["qd::0"].k1 < 0  # a skew trim does not turn it into a focusing one


def test_chromaticity_is_that_of_at_which_the_coils_do_not_take_away(lattice, ring):
    ours = off_momentum(Chain.from_ring(ring, 6), ring.length).chromaticity
    # the orbit that the dipole coils make feeds third orders down, which second-order maps lack
    np.testing.assert_allclose(ours, at.get_chrom(lattice)[:2], rtol=2e-3)
    without = [e for e in lattice if not isinstance(e, at.Sextupole)]
    bare = at.get_chrom(at.Lattice(without, energy=ENERGY * 1e9))[:2]
    assert np.abs(ours - bare).min() > 1  # it is the sextupoles that are compared


def test_first_turn_of_both_engines_is_that_of_the_file(lattice, ring):
    launches = np.zeros((2, 6))
    launches[0, :4] = [1e-4, 0, 1e-4, 0]
    tracked = lattice.track(np.asfortranarray(launches.T), refpts=at.Monitor)[0]
    expected = np.moveaxis(tracked[[0, 2], :, :, 0], [0, 1, 2], [2, 0, 1])
    assert np.abs(expected[1]).max() > 2e-5  # the dipole coils move the beam
    for engine in (AtEngine, OcelotEngine):
        found = engine(ring).track(launches)[:, 0]
        np.testing.assert_allclose(found, expected, rtol=0, atol=2e-8, err_msg=engine.name
                                   if hasattr(engine, "name") else "at")  # fmt: skip


def test_a_bend_with_other_fields_keeps_them_in_its_middle():
    form = {"EntranceAngle": 0.05, "ExitAngle": 0.05, "NumIntSteps": 100}
    others = {"PolynomA": [3e-4, 0.05, 4.0], "PolynomB": [-2e-4, 0.4, 6.0]}
    starts = 1e-3 * np.vstack([np.zeros(4), np.eye(4)[[0, 2]]])
    moved, tracked = [], []
    for fields in (others, {"PolynomB": [0, 0.4, 6.0]}):
        element = at.Dipole("B", 0.3, 0.1, 0.0, **form, **fields)
        lattice = at.Lattice([element], energy=ENERGY * 1e9, periodicity=1)
        found = ring_from_at(lattice, "x")
        way = composed(quadratic_map(element, ENERGY, 4) for element in found.elements)
        moved.append(way(starts)[0])
        six = np.zeros((6, 3), order="F")
        six[:4] = starts.T
        tracked.append(lattice.track(six)[0][:4, :, 0, 0].T)
        if fields is others:
            assert [e.name for e in found.elements][:3] == ["b", "b_coil", "b_2"]
            assert found.pieces("b") == ("b", "b_2")
    # what the other fields do: thin in the middle here, spread over 0.3 m there
    effect, ours = np.subtract(*tracked), np.subtract(*moved)
    assert np.abs(effect).max(axis=0).min() > 1e-6
    np.testing.assert_allclose(
        ours, effect, rtol=0.02, atol=0.02 * np.abs(effect).max(axis=0).min()
    )


def test_half_and_half_is_the_whole(ring):
    element = ring["sf::0"]
    whole = composed(of_ocelot(p, 6) for p in parts_of(element, ENERGY, False))
    halves = composed(of_ocelot(p, 6) for p in parts_of(element, ENERGY, True))
    np.testing.assert_allclose(halves.R, whole.R, rtol=0, atol=1e-8)  # its kick feeds down twice
    np.testing.assert_allclose(halves.T, whole.T, rtol=0, atol=1e-4)


def test_every_format_that_is_written_keeps_kinds_and_maps(ring, tmp_path):
    for name in ("ring.json", "ring.at.json", "ring.py"):
        save_ring(ring, tmp_path / name)
        again = load_ring(tmp_path / name)
        assert again.counts() == ring.counts(), name
        np.testing.assert_allclose(ring_matrix(again), ring_matrix(ring), rtol=0, atol=1e-12)


def test_own_json_and_a_change_keep_every_field(ring, tmp_path):
    changed = ring.with_changed("sf::1", k2=10.0)
    save_ring(changed, tmp_path / "ring.json")
    again = load_ring(tmp_path / "ring.json")
    assert again.elements == changed.elements
    for name in ("k0", "k0s", "k1", "k1s", "k2s"):
        assert getattr(again["sf::1"].source, name) == getattr(ring["sf::1"].source, name) != 0
    assert again["sf::1"].source.k2 == 10.0
    assert ring["sf::1"].source.k2 == 22.0


def test_a_corrector_of_two_planes_kicks_in_both_and_one_that_is_named_in_one():
    lattice = at.Lattice(
        [
            at.Quadrupole("q", 0.3, 1.0),
            at.Corrector("COR", 0.2, [1e-4, -2e-4]),
            at.Corrector("K1", 0.0, [0, 0]),
            at.Corrector("HCM", 0.0, [0, 0]),
            at.Corrector("VCM", 0.0, [0, 0]),
            at.Corrector("HCM2", 0.0, [1e-4, 1e-4]),  # what kicks is not left out
            at.Corrector("COR", 0.2, [0, 0]),
            at.Drift("d", 1.0),
            at.Monitor("bpm"),
        ],
        energy=1e9,
    )
    ring = ring_from_at(lattice, "x")
    planes = {e.name: e.kind[0] for e in ring.elements if "corrector" in e.kind}
    assert planes == {
        "cor_h::0": "h", "cor_v::0": "v", "k1_h": "h", "k1_v": "v", "hcm": "h", "vcm": "v",
        "hcm2_h": "h", "hcm2_v": "v", "cor_h::1": "h", "cor_v::1": "v",
    }  # fmt: skip
    assert ring.length == pytest.approx(lattice.circumference)
    start = np.zeros((1, 6))
    tracked = lattice.track(start.T.copy(order="F"), refpts=at.Monitor)[0][[0, 2], 0, 0, 0]
    for engine in (AtEngine, OcelotEngine):
        np.testing.assert_allclose(engine(ring).track(start)[0, 0, 0], tracked, rtol=0, atol=1e-12)
        kicked = engine(ring).track(start, settings=[{"cor_v::1": {"kick": 1e-4}}])[0, 0, 0]
        np.testing.assert_allclose(kicked - tracked, [0, 1.1e-4], rtol=0, atol=1e-9)


def of_loco(path, energy):
    """The lattice of a LOCO file as AT's own elements."""
    ring = loadmat(path, squeeze_me=True, struct_as_record=False)["RINGData"]
    elements = []
    for e in getattr(ring, "Lattice", ring):
        fields = {k: getattr(e, k) for k in e._fieldnames}
        fields = {k: v for k, v in fields.items() if np.size(v)}
        elements.append(element_from_dict(fields, check=False))
    return at.Lattice(elements, energy=energy, periodicity=1)


def exact_chromaticity(ring):
    """Of the AT engine's exact bends: their orbits, matrices and tunes at +-1e-4."""
    lattice, tunes = AtEngine(ring).lattice(), []
    step = 1e-5 * np.hstack([np.zeros((4, 1)), np.eye(4), -np.eye(4)])
    for delta in (-1e-4, 1e-4):
        orbit = np.zeros(4)
        for _ in range(6):
            states = np.zeros((6, 9), order="F")
            states[:4] = orbit[:, None] + step
            states[4] = delta
            before = states.copy()
            lattice.track(states, in_place=True)
            matrix = (states[:4, 1:5] - states[:4, 5:]) / 2e-5
            orbit += np.linalg.solve(np.eye(4) - matrix, (states - before)[:4, 0])
        halves = [np.trace(matrix[i : i + 2, i : i + 2]) / 2 for i in (0, 2)]
        signs = [np.sign(matrix[i, i + 1]) for i in (0, 2)]
        tunes.append([s * np.arccos(h) / 2 / np.pi for s, h in zip(signs, halves, strict=True)])
    return (np.array(tunes[1]) - tunes[0]) / 2e-4


@pytest.mark.parametrize(
    ("name", "energy", "count", "dropped"),
    [("als_2008-01-05.loco.mat", 1.9e9, 96, 25.0), ("spear3_2006-01-09.loco.mat", 3e9, 72, 10.0)],
)
def test_real_sextupoles_with_coils_make_the_chromaticity(name, energy, count, dropped):
    """Without the sextupoles that were dropped it was -27 / -34 at ALS."""
    lattice = of_loco(measured_data("real_rings", name), energy)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # skew fields of three bends are left out
        found = ring_from_at(lattice, name)
    assert found.counts()["sextupole"] == count
    ours = off_momentum(Chain.from_ring(found, 6), found.length).chromaticity
    # second-order maps have the edges of bends but to second order: 0.2 in y of a small ring; and
    # AT's bends with a gradient lack what its curvature adds, which MAD-X and Xsuite have
    np.testing.assert_allclose(ours, exact_chromaticity(found), rtol=0, atol=0.3)
    lattice.disable_6d()
    np.testing.assert_allclose(ours[0], at.get_chrom(lattice)[0], rtol=0, atol=0.1)
    np.testing.assert_allclose(
        one_turn_optics(Chain.from_ring(found)).tunes, at.get_tune(lattice)[:2], rtol=0, atol=1e-4
    )
    for element in lattice:
        if isinstance(element, at.Multipole) and not isinstance(element, at.Dipole):
            element.PolynomB = np.concatenate([element.PolynomB[:2], np.zeros(6)])
    assert np.abs(ours - at.get_chrom(lattice)[:2]).min() > dropped


def test_real_multipoles_of_several_orders_keep_those_up_to_the_sextupole():
    path = measured_data("real_rings", "esrf_ebs", "betamodel.mat")
    with pytest.warns(UserWarning, match=r"orders of multipoles above the sextupole of .* \(64\)"):
        found = load_ring(path, sequence="betamodel")
    lattice = at.load_lattice(path, use="betamodel")
    lattice.disable_6d()
    np.testing.assert_allclose(
        one_turn_optics(Chain.from_ring(found)).tunes, at.get_tune(lattice)[:2], rtol=0, atol=2e-4
    )
    ours = off_momentum(Chain.from_ring(found, 6), found.length).chromaticity
    np.testing.assert_allclose(ours, at.get_chrom(lattice)[:2], rtol=0, atol=0.1)
    # a gradient at the edge of a sextupole is a piece of it
    assert found.pieces("sj1b") == ("sj1b", "crosstalk_sj1b")
