"""Reading OCELOT lattice files: names, kinds, places, and the traps of real files."""

import numpy as np
import pytest

from tmlattice import TaylorNetwork, load_ring
from tmlattice.effects import find
from tmlattice.errors import LatticeError, UnknownNameError
from tmlattice.lattice import middle_of_first_arc
from tmlattice.lattice.ocelot import elements
from tmlattice.optics import twiss


def write(folder, text, name="machine.py"):
    path = folder / name
    path.write_text(text)
    return path


def test_names_follow_the_rule(small_ring):
    names = [e.name for e in small_ring.elements]
    assert len(set(names)) == len(names)
    assert "bpm_start" in names  # stands once: no number
    assert [n for n in names if n.startswith("QF")] == [f"QF::{i}" for i in range(16)]
    assert "generated_a" in names  # OCELOT made up the id: the lowest-sorting variable
    assert "generated_b" not in names
    assert not any("ID_" in n for n in names)
    assert small_ring["qf::3"] is small_ring["QF::3"]  # case does not matter
    assert small_ring["bpm_start::0"] is small_ring["bpm_start"]


@pytest.mark.parametrize(
    ("ring", "names"),
    [
        ("[Quadrupole(l=0.1, k1=1.0), Drift(l=1), Drift(l=1)]",
         ["quadrupole", "drift::0", "drift::1"]),
        ("[Quadrupole(l=0.1, eid='QA'), Drift(l=1, eid='d'), Quadrupole(l=0.2, eid='qa')]",
         ["QA::0", "d", "qa::1"]),
        ("MagneticLattice((q, (q, [q])))", ["q::0", "q::1", "q::2"]),
    ],
)  # fmt: skip
@pytest.mark.parametrize("variable", ["ring", "cell", "lattice", "mine"])
def test_names_of_elements_without_a_name_of_one_and_of_nested_ones(
    tmp_path, variable, ring, names
):
    text = "from ocelot import *\nenergy = 1.0\nq = Quadrupole(l=0.1, k1=1.0, eid='q')\n"
    path = write(tmp_path, f"{text}{variable} = {ring}\n")
    found = load_ring(path, sequence="mine" if variable == "mine" else None)
    assert [e.name for e in found.elements] == names
    assert found[names[-1].upper()] is found.elements[-1]


def test_places_and_strengths(small_ring):
    quadrupole = small_ring["QF::0"]
    assert (quadrupole.kind, quadrupole.length, quadrupole.k1, quadrupole.s) == (
        "quadrupole", 0.4, 0.9, 0.2
    )  # fmt: skip
    cell = 4 * 0.5 + 2 * 0.4 + 2 * 1.2 + 2 * 0.2 + 2 * 0.5
    np.testing.assert_allclose(small_ring["QF::7"].s, 7 * cell + 0.2)
    assert small_ring["sd::0"].k2 == -9.0
    np.testing.assert_allclose(small_ring["bend::0"].angle, np.pi / 16)
    assert small_ring.energy == 3.0
    assert small_ring["wig_1"].kind == "wiggler"
    assert small_ring.counts()["monitor"] == 35


def test_a_matrix_without_an_id_is_of_the_kind_that_its_variable_names(tmp_path):
    entries = "l=0.5, r11=1.0, r12=0.5, r22=1.0, r33=0.99, r34=0.5, r43=-0.02, r44=1.0"
    text = (
        f"from ocelot import *\nenergy = 3.0\nwiggler = Matrix({entries})\n"
        f"snake = Matrix({entries})\n"
        f"ring = [wiggler, Drift(l=1.0), wiggler, snake, Matrix({entries}), Monitor(eid='m')]\n"
    )
    ring = load_ring(write(tmp_path, text))
    kinds = {e.name: e.kind for e in ring.elements if e.is_magnet}
    assert kinds == {"wiggler::0": "wiggler", "wiggler::1": "wiggler", "snake": "matrix",
                     "matrix": "matrix"}  # fmt: skip
    assert find("insertion_device_focusing").places(ring) == list(kinds)
    assert len(find("radiation_loss_wigglers").members(ring, None)) == 2


def test_changing_one_place_leaves_the_others_and_the_given_ring(small_ring):
    changed = small_ring.with_changed("QF::3", k1=0.7)
    assert changed["QF::3"].k1 == 0.7
    assert changed["QF::3"].source.k1 == 0.7
    assert changed["QF::2"].source.k1 == changed["QF::4"].source.k1 == 0.9
    assert small_ring["QF::3"].source.k1 == 0.9
    before = TaylorNetwork.from_ring(small_ring).W1
    after = TaylorNetwork.from_ring(changed).W1
    moved = (before != after).any(dim=2).any(dim=1).nonzero().ravel().tolist()
    assert [TaylorNetwork.from_ring(changed).layers[i] for i in moved] == ["QF::3"]


def test_matrix_without_a_longitudinal_block_gets_one(small_ring):
    matrix = small_ring["wig_1"].source.R(3.0)[0]
    assert matrix[4, 4] == matrix[5, 5] == 1.0


def test_monitors_with_no_magnet_between_hang_on_one_layer(small_ring):
    maps = TaylorNetwork.from_ring(small_ring).maps
    at = dict(zip(maps.monitors, maps.at, strict=True))
    assert at["last_a"] == at["last_b"] == len(maps.layers)
    assert at["bpm_start"] == at["bpm::0"] == 0
    network = TaylorNetwork(maps)
    readings = network([[1e-4, 1e-5, 0, 0]])[0].detach().numpy()
    slope = network.states([[1e-4, 1e-5, 0, 0]])[0, -1, 1]
    a, b = (readings[maps.monitors.index(name), 0] for name in ("last_a", "last_b"))
    np.testing.assert_allclose(b - a, 0.5 * slope, rtol=1e-9)  # a drift of 0.5 m between them


def test_octupoles_are_warned_of_once(tmp_path):
    """Diamond-II has 60 of them."""
    path = write(
        tmp_path,
        "from ocelot import *\nenergy = 1.0\n"
        "octs = [Octupole(l=0.1, k3=50.0, eid='oct') for _ in range(5)]\n"
        "named = Octupole(l=0.1, k3=50.0)\n"
        "cell = [Quadrupole(l=0.1, k1=1.0, eid='q'), *octs, named]",
    )
    with pytest.warns(UserWarning, match="octupoles are drifts") as said:
        ring = load_ring(path)
    (octupoles,) = [str(own.message) for own in said if "octupole" in str(own.message)]
    assert octupoles.endswith("trajectories have them: oct, named (6)")
    assert ring["oct::0"].kind == "octupole"


def test_energy_is_read_given_or_warned_of(tmp_path):
    body = "from ocelot import *\nlattice = [Quadrupole(l=0.1, k1=1.0, eid='q')]\n"
    with pytest.warns(UserWarning, match="no beam energy"):
        assert load_ring(write(tmp_path, body)).energy == 6.0
    assert load_ring(write(tmp_path, body), energy=2.5).energy == 2.5
    twiss = write(tmp_path, body + "tws0 = Twiss()\ntws0.E = 14.0\n", "b.py")
    assert load_ring(twiss).energy == 14.0


def test_a_cell_of_the_ring_is_not_the_ring(tmp_path):
    text = "from ocelot import *\nenergy = 3.0\ncell = [Quadrupole(l=0.4, k1=1.1), Drift(l=1)]\n"
    for ring in ("lattice = [[cell, cell], cell]", "lat = MagneticLattice(tuple(3 * cell))"):
        path = write(tmp_path, f"{text}{ring}\n")
        assert load_ring(path).length == pytest.approx(4.2)
        assert load_ring(path, sequence="cell").length == pytest.approx(1.4)


def test_a_multipole_that_bends_the_design_orbit_is_a_thin_bend(tmp_path):
    text = "from ocelot import *\nenergy = 3.0\nring = [Multipole(kn=[0.1, 0.02, 3.0], eid='m')]\n"
    ring = load_ring(write(tmp_path, text))
    assert ring["m"].bending == 0.1
    (own,) = elements.Multipole(kn=[0.1, 0.02, 3.0]).R(3.0)
    (found,) = ring["m"].source.R(ring.map_energy)
    np.testing.assert_allclose(found[:4], own[:4], rtol=0, atol=1e-6)
    assert found[4, 0] == pytest.approx(0.1, abs=1e-6)  # as of a bend; OCELOT has 0


def test_file_is_run_as_a_module_with_its_neighbours(tmp_path):
    write(tmp_path, "from ocelot import *\nq = Quadrupole(l=0.1, k1=1.0, eid='q')\n", "parts.py")
    path = write(
        tmp_path,
        "from ocelot import *\nfrom parts import q\nenergy = 1.0\nn = 3\n"
        "ring = [q for i in range(n) if i < n]\n",  # fails under exec(code, globals, locals)
    )
    assert len(load_ring(path).magnets) == 3


def test_negative_drift_of_rounding_does_not_add_half_a_turn(small_ring):
    total = twiss(TaylorNetwork.from_ring(small_ring)).total_tunes
    without = small_ring.elements[: small_ring.index("back")]
    assert small_ring["back"].length < 0
    assert len(without) < len(small_ring.elements)
    assert np.floor(total).tolist() == [3, 3]


OCELOT_RING = """from ocelot import *
q = Quadrupole(l=0.4, k1=1.1); f = Quadrupole(l=0.4, k1=-1.15); d = Drift(l=0.5)
x = {}
ring = 8 * [q, d, SBend(l=1, angle=0.39), d, f, x]
energy = 3.0
"""
CAVITY = "Cavity(l=0.1, v=1e-3, freq=5e8, vx_up=1e-3, eid='rf')"
REFUSED = {
    "no sequence called ring, cell or lattice": "x = 1",
    "is empty": "ring = []",
    "holds 1, which is no element": "ring = [1, 2]",
    "fails to run.*ModuleNotFoundError": "import no_such_module",
    "fails to run.*SyntaxError": "ring = [",
    "fails to run.*SystemExit": "raise SystemExit(3)",
    "vx_up of the Cavity 'rf' is not": OCELOT_RING.format(CAVITY),
    "delta_e of the Matrix 'm' is not modelled": OCELOT_RING.format(
        "Matrix(l=0.1, delta_e=0.01, eid='m')"
    ),
    "dtilt of the Quadrupole 'q1' is not modelled": OCELOT_RING.format(
        "d; q.dtilt = 0.05; q.id = 'q1'"
    ),
}


@pytest.mark.parametrize("message", REFUSED)
def test_what_is_no_ring_or_acts_and_is_not_modelled_is_one_sentence(tmp_path, message):
    with pytest.raises(LatticeError, match=message):
        load_ring(write(tmp_path, REFUSED[message]))


def test_deflecting_cavity_is_warned_of(tmp_path):
    with pytest.warns(UserWarning, match="'crab': what the voltage does in a TDCavity is left out"):
        load_ring(write(tmp_path, OCELOT_RING.format("TDCavity(l=0.1, v=1e-3, eid='crab')")))


def test_unknown_lattices_offer_the_nearest(tmp_path):
    with pytest.raises(UnknownNameError, match="no lattice 'petra'; did you mean 'petra3'"):
        load_ring("petra")
    with pytest.raises(LatticeError, match="no lattice file"):
        load_ring(tmp_path / "none.py")
    with pytest.raises(LatticeError, match="no lattice file that can be read"):
        load_ring(write(tmp_path, "x", "ring.txt"))


def test_only_attributes_that_exist_can_change(small_ring):
    for change in ({"colour_of_paint": 1.0}, {"l": 1.0}):
        with pytest.raises(LatticeError, match="cannot be changed"):
            small_ring.with_changed("QF::3", **change)


def test_default_magnet_is_in_the_middle_of_the_first_arc(petra3):
    magnet = middle_of_first_arc(petra3)
    assert magnet.kind == "quadrupole"
    assert magnet.k1 < 0
    bends = [e.s for e in petra3.elements if e.kind == "bend"]
    assert bends[0] < magnet.s < petra3.length / 8
    assert abs(magnet.s - (bends[0] + petra3.length / 8 - bends[0]) / 2) < 60


def test_tilted_magnet_keeps_its_tilt(tmp_path):
    path = write(
        tmp_path,
        "from ocelot import *\nfrom math import pi\nenergy = 1.0\n"
        "q = Quadrupole(l=0.1, k1=1.0, tilt=pi/4, eid='skew')\n"
        "ring = [q, Drift(l=1.0, eid='d'), Monitor(eid='m')]",
    )
    ring = load_ring(path)
    assert ring["skew"].tilt == pytest.approx(np.pi / 4)
    reading = TaylorNetwork.from_ring(ring)([[1e-3, 0, 0, 0]])[0, 0]
    assert abs(reading[1].item()) > 1e-5  # x is turned into y
