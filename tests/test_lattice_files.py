"""Lattice files other than OCELOT's: AT's own physics is the referee of what was read."""

import functools
import json
import operator
import warnings

import at
import numpy as np
import pytest
from at_ring import at_lattice
from scipy.io import savemat
from shared import measured_data, valid

from tmlattice import load_ring, ring_maps
from tmlattice.beam.chain import Chain
from tmlattice.errors import LatticeError
from tmlattice.lattice import save_ring
from tmlattice.lattice.at_file import ring_from_at
from tmlattice.lattice.load import contents
from tmlattice.maps import ring_matrix
from tmlattice.maps.quadratic import composed, quadratic_map
from tmlattice.optics import ring_tunes

pytestmark = pytest.mark.usefixtures("forked_readers")

ENERGY = 3.0


def write(folder, name, text):
    path = folder / name
    path.write_text(text)
    return path


ELEMENTS = {
    "bend with edges, gap and gradient": at.Dipole(
        "b", 1.2, 0.2, 0.3, EntranceAngle=0.1, ExitAngle=0.07, FullGap=0.05,
        FringeInt1=0.5, FringeInt2=0.6,
    ),
    "weak bend with a sextupole": at.Dipole("b", 1.0, 5e-3, 0.0, PolynomB=[0, 0, 12.0]),
    "hardly bent sextupole with a gradient": at.Dipole(
        "b", 0.4, 1e-4, 0.0, PolynomB=[0, -0.5, 12.0]
    ),
    "quadrupole": at.Quadrupole("q", 0.5, -0.8),
    "skew quadrupole": at.Quadrupole("q", 0.5, 0.0, PolynomA=[0, 0.7]),
    "half-skew quadrupole": at.Quadrupole("q", 0.5, 0.4, PolynomA=[0, -0.7]),
    "rolled quadrupole": at.Quadrupole("q", 0.5, 0.8),
    "quadrupole with a sextupole": at.Quadrupole("q", 0.5, 0.8, PolynomB=[0, 0.8, 15.0]),
    "sextupole": at.Sextupole("s", 0.3, 25.0),
    "skew sextupole": at.Sextupole("s", 0.3, 0.0, PolynomA=[0, 0, 25.0], PolynomB=[0, 0, 0]),
    "sextupole with skew and gradient coils": at.Sextupole(
        "s", 0.3, 25.0, PolynomA=[0, 0.02, 3.0], PolynomB=[0, -0.03, 25.0],
    ),
    "quadrupole with every field": at.Quadrupole(
        "q", 0.4, 1.2, PolynomA=[2e-4, 0.05, -4.0], PolynomB=[-1e-4, 1.2, 9.0],
    ),
    "sextupole with corrector coils": at.Sextupole("s", 0.3, 25.0, KickAngle=[2e-4, -1e-4]),
    "rolled sextupole with coils": at.Sextupole(
        "s", 0.3, 25.0, PolynomA=[1e-4, 0.3, 0], PolynomB=[2e-4, 0, 25.0],
    ),
    "defocusing quadrupole with a skew trim": at.Quadrupole("q", 0.5, -0.8, PolynomA=[0, 0.01]),
    "thin multipole": at.ThinMultipole("t", [0.0, 0.2, 3.0], [0.0, -0.3, 4.0]),
    "thin multipole that kicks": at.ThinMultipole("t", [1e-4, 0.2, 3.0], [2e-4, -0.3, 4.0]),
    "vertical corrector": at.Corrector("v", 0.3, [0.0, 2e-4]),
    "horizontal corrector": at.Corrector("h", 0.0, [2e-4, 0.0]),
    "corrector of both planes": at.Corrector("hv", 0.3, [2e-4, -1e-4]),
    "matrix": at.M66("m", at.find_elem_m66(at.Dipole("b", 1.0, 0.3, 0.2))),
    "solenoid": at.Element("sol", Length=0.5, K=0.2, PassMethod="SolenoidLinearPass"),
    "shifted quadrupole": at.Quadrupole("q", 0.5, 0.8),
    "shifted sextupole": at.Sextupole("s", 0.3, 25.0),
    "turned quadrupole": at.Quadrupole("q", 0.5, 0.8),
    "sheared sextupole": at.Sextupole("s", 0.3, 25.0),
    "bend without its fringe field": at.Dipole(
        "b", 1.2, 0.2, EntranceAngle=0.1, ExitAngle=0.07, FullGap=0.05, FringeInt1=0.5,
        FringeInt2=0.5, FringeBendEntrance=0, FringeBendExit=0,
    ),
    "bend whose exact pass method has no edges": at.Dipole(
        "b", 1.2, 0.2, EntranceAngle=0.1, ExitAngle=0.07, FringeBendEntrance=0, FringeBendExit=0,
        PassMethod="ExactSectorBendPass",
    ),
    "bend whose gradient is about a straight axis": at.Dipole(
        "b", 1.2, 0.2, 0.3, EntranceAngle=0.1, ExitAngle=0.1, PassMethod="ExactRectBendPass",
    ),
    "bend whose linear pass method has no coils": at.Dipole(
        "b", 1.2, 0.2, 0.3, KickAngle=[1e-4, 1e-4], PolynomA=[0, 0.1], PassMethod="BendLinearPass",
    ),
    "quadrupole whose linear pass method has no other fields": at.Quadrupole(
        "q", 0.5, 0.8, PolynomA=[1e-4, 0.1, 9.0], PassMethod="QuadLinearPass",
    ),
    "multipole whose pass method is thin": at.Multipole(
        "t", 0.0, [0, 0.2, 3.0], [0, -0.3, 4.0], PassMethod="ThinMPolePass",
    ),
    "quadrupole with linear fringes": at.Quadrupole(
        "q", 0.5, 0.8, FringeQuadEntrance=2, FringeQuadExit=2,
        fringeIntM0=np.array([0.0, 3e-3, 1e-4, 0, 0]),
        fringeIntP0=np.array([0.0, 3e-3, 1e-4, 0, 0]),
    ),
    "rolled quadrupole with one linear fringe": at.Quadrupole(
        "q", 0.5, 0.8, FringeQuadExit=2,
        fringeIntM0=np.array([0.0, 3e-3, 1e-4, 0, 0]),
        fringeIntP0=np.array([0.0, 2e-3, 2e-4, 0, 0]),
    ),
    "rolled corrector": at.Corrector("h", 0.0, [2e-4, 0.0]),
    "corrector whose field is scaled": at.Corrector("h", 0.2, [2e-4, -1e-4], FieldScaling=0.5),
    "corrector whose pass method is of a solenoid": at.Corrector(
        "h", 0.5, [2e-4, 0.0], K=0.2, PassMethod="SolenoidLinearPass",
    ),
    "element that is a matrix by its pass method": at.Element(
        "e", PassMethod="Matrix66Pass", M66=at.find_elem_m66(at.Dipole("b", 1.0, 0.3, 0.2)),
    ),
}  # fmt: skip
for element in ELEMENTS.values():
    element.NumIntSteps = 400
offset = np.array([2e-4, 0, -3e-4, 0, 0, 0])
for shifted in ("shifted quadrupole", "shifted sextupole"):
    ELEMENTS[shifted].T1, ELEMENTS[shifted].T2 = -offset, offset
psi = 0.3
turn = np.eye(6)
turn[:4, :4] = np.kron([[np.cos(psi), np.sin(psi)], [-np.sin(psi), np.cos(psi)]], np.eye(2))
for rolled in (what for what in ELEMENTS if what.startswith("rolled")):
    ELEMENTS[rolled].R1, ELEMENTS[rolled].R2 = turn, turn.T
ELEMENTS["turned quadrupole"].T1 = np.array([1e-4, -4e-4, -2e-4, 8e-4, 0, 0])  # yaw and pitch
ELEMENTS["turned quadrupole"].T2 = np.array([1e-4, 4e-4, -2e-4, -8e-4, 0, 0])
ELEMENTS["turned quadrupole"].R1, ELEMENTS["turned quadrupole"].R2 = turn, turn.T
ELEMENTS["sheared sextupole"].R1 = np.eye(6) + np.diag([0, 0.1, 0, 0, 0], 1)
ELEMENTS["sheared sextupole"].T2 = offset


@pytest.mark.filterwarnings("ignore:.*beyond (its|the model and a) first-order matrix")
@pytest.mark.parametrize("what", ELEMENTS)
def test_element_moves_a_particle_as_in_at(what):
    """0.1 mm and 0.1 mrad to second order; strong bends, whose terms AT lacks, to first."""
    lattice = at.Lattice([ELEMENTS[what].deepcopy()], energy=ENERGY * 1e9, periodicity=1)
    ring = ring_from_at(lattice, what)
    map_ = composed(quadratic_map(element, ENERGY, 4) for element in ring.elements)
    big, tolerance = (1e-7, 1e-12) if what.startswith("bend") else (1e-4, 5e-10)
    starts = np.array([[big, 0, 0, 0], [0, big, 0, 0], [0, 0, big, 0], [0, 0, 0, big],
                       [big, -big, big, big], [0, 0, 0, 0]])  # fmt: skip
    six = np.zeros((6, len(starts)))
    six[:4] = starts.T
    tracked = lattice.track(np.asfortranarray(six), refpts=[1])[0][:4, :, 0, 0].T
    mapped, _ = map_(starts)
    np.testing.assert_allclose(mapped, tracked, rtol=0, atol=tolerance)
    kick = np.abs(tracked - starts).max()
    assert kick > big / 100  # it does something


COLUMN = np.array([[1.0], [1.0], [0.0], [1.0], [1.0], [0.0]])
KICKS = [np.outer(np.linspace(-1, 1, 5), np.linspace(-1, 1, 7)) for _ in range(4)]
SAVED = [
    *ELEMENTS.values(),
    *map(at.Marker, ("it's", "a;b", "a%b", "[q]", "x{1}", "a...b", "é", "", "x\\y", "'\"")),
    at.Marker("others", Tags=["a", "b"], Own={"a": 1.0}, On=True, Off=False, E=[],
              Flags=np.array([True, False]), Gain=np.float64(1.5), N=3, Nan=np.nan, Inf=np.inf),
    at.Octupole("o", 0.2, [0, 0, 0, 0], [0, 0.1, 0, 30.0]),
    at.Multipole("m", 0.2, [0, 0.02, 0.3], [0, 0.2, 3.0], MaxOrder=1),
    at.Drift("d", -0.2, RApertures=np.array([-0.1, 0.1, -0.1, 0.1])),
    at.Collimator("c", 0.2, [-0.1, 0.1, -0.1, 0.1]),
    at.Aperture("a", [-0.1, 0.1, -0.1, 0.1]),
    at.Monitor("bpm_1", Offset=[1e-4, 0.0]),
    at.Wiggler("w", 0.6, 0.1, 1.0),
    at.Wiggler("w", 0.6, 0.1, 1.0, By=COLUMN.ravel(), Bx=[1, 0.5, 1, 0, 1, 0], Nstep=8),
    at.Element("w", Length=0.6, PassMethod="GWigSymplecticPass", Lw=0.1, Bmax=1.0, Nstep=10,
               Nmeth=4, NHharm=1, NVharm=0, By=COLUMN, Bx=np.zeros((6, 0)), Energy=ENERGY * 1e9),
    at.InsertionDeviceKickMap("id", "IdTablePass", "x.txt", 3.0, 5, 1.0, *KICKS,
                              np.linspace(-1e-2, 1e-2, 7), np.linspace(-1e-2, 1e-2, 5)),
    at.Multipole("e", 0.3, [0, 0], [0, 0.3], PassMethod="ExactHamiltonianPass", Type=2,
                 MultipoleFringe=0),
    at.Element("t", PassMethod="MatrixTijkPass", M66=np.eye(6), Tijk=np.zeros((6, 6, 6)))
]  # fmt: skip


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("suffix", [".mat", ".json", ".m", ".repr"])
@pytest.mark.parametrize(
    "properties",
    [
        {},
        {"energy": 1.5e9, "particle": "electron", "name": "a 'b' [c] %"},
        {"energy": 7e12, "particle": at.Particle("proton"), "harmonic_number": 7, "own": [1, 2]},
        {"energy": 4e13, "particle": at.Particle("lead", rest_energy=193.7e9, charge=82)},
    ],
    ids=["relativistic", "electron", "proton", "ion"],
)
def test_a_saved_ring_is_the_ring(tmp_path, suffix, properties):
    rows = SAVED if suffix not in (".m", ".mat") else SAVED[:-1]  # MATLAB has two axes
    rows = SAVED[::9] if properties else rows
    given = {"energy": ENERGY * 1e9, "periodicity": 2, "name": "r", **properties}
    lattice = at.Lattice([e.deepcopy() for e in rows], **given)
    path = tmp_path / f"{'ring' if properties else '2024-ring (1)'}{suffix}"
    at.save_lattice(lattice, path)
    known, ring = ring_from_at(lattice, "r"), load_ring(path)
    assert contents(ring)[:2] == contents(known)[:2]
    for a, b in zip(contents(ring)[2], contents(known)[2], strict=True):
        assert a[:2] == b[:2]
        np.testing.assert_allclose(a[2:7], b[2:7], rtol=1e-12, atol=1e-15)
        assert a[7] == b[7]
    for a, b in zip(ring.elements, known.elements, strict=True):
        for one, other in zip(a.source.R(ENERGY), b.source.R(ENERGY), strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-12)


def test_matrix_element_keeps_dispersion_in_ocelots_coordinates():
    bend = at.Dipole("b", 1.0, 0.3, 0.2, PassMethod="BendLinearPass")
    both = [
        ring_from_at(at.Lattice([e], energy=ENERGY * 1e9, periodicity=1), "x")
        for e in (bend, at.M66("m", at.find_elem_m66(bend), Length=1.0))
    ]
    of_bend, of_matrix = (
        np.linalg.multi_dot([*e.source.R(ENERGY)[::-1], np.eye(6)])
        for e in (both[0].elements[0], both[1].elements[0])
    )
    of_bend[4, 5] = of_matrix[4, 5]  # OCELOT adds the speed's L / gamma^2, AT has none
    np.testing.assert_allclose(of_matrix, of_bend, rtol=0, atol=1e-7)  # AT's is by differences


def test_names_planes_and_periods():
    lattice = at.Lattice(
        [
            at.Monitor("BPM", CommonName="BPM_A"),
            at.Quadrupole("QF", 0.4, 1.0),
            at.Corrector("VCM", 0.1, [0, 0]),
            at.Corrector("HCM", 0.1, [0, 0]),
            at.Corrector("C", 0.1, [0, 0], MADType="VKICKER"),
            at.Multipole("S", 0.2, [0, 0, 0], [0, 0, 4.0]),
            at.Octupole("Z", 0.2, [0, 0, 0, 0], [0, 0, 0, 0]),
            at.RFCavity("RF", 0.5, 1e6, 5e8, 100, ENERGY * 1e9),
        ],
        energy=ENERGY * 1e9,
        periodicity=2,
    )
    ring = ring_from_at(lattice, "x")
    assert [e.name for e in ring.elements[:2]] == ["bpm_a::0", "qf::0"]
    assert [e.kind for e in ring.elements[:8]] == [
        "monitor", "quadrupole", "vcorrector", "hcorrector", "vcorrector", "sextupole",
        "octupole", "cavity",
    ]  # fmt: skip
    assert len(ring.elements) == 16
    assert ring["s::1"].k2 == 8.0  # PolynomB[2] is k2 / 2


def test_what_is_left_out_is_warned_of_once():
    quadrupole = at.Quadrupole("q", 0.5, 1.0, PolynomB=[0, 1, 0, 0, 7.0])
    lattice = at.Lattice(
        [quadrupole, quadrupole.deepcopy(), at.Quadrupole("p", 0.5, 1.0, PolynomB=[0, 1, 0, 5.0])],
        energy=1e9, periodicity=1,
    )  # fmt: skip
    with pytest.warns(UserWarning, match=r"left out.* above the sextupole of q, p \(3\)") as caught:
        ring_from_at(lattice, "x")
    assert len(caught) == 1


@pytest.mark.parametrize("which", ["petra3", "small_ring"])
def test_own_json_keeps_every_map_to_the_bit(tmp_path, request, which):
    ring = request.getfixturevalue(which)
    quadrupole = next(e for e in ring.elements if e.kind == "quadrupole")
    ring = ring.with_changed(quadrupole.name, k1=0.9 * quadrupole.k1)
    path = tmp_path / "ring.json"
    save_ring(ring, path)
    again = load_ring(path)
    assert again.elements == ring.elements
    assert again.energy == ring.energy
    assert again.changes == ring.changes
    for dimension in (4, 6):
        before, after = ring_maps(ring, dimension), ring_maps(again, dimension)
        for key in ("W0", "W1", "W2", "R0", "R1", "R2", "at"):
            assert np.array_equal(getattr(before, key), getattr(after, key)), key
    assert path.stat().st_size < 500_000
    valid(path, "lattice")
    save_ring(again, tmp_path / "twice.json")
    twice = json.loads((tmp_path / "twice.json").read_text())
    assert {**twice, "name": ""} == {**json.loads(path.read_text()), "name": ""}


@pytest.mark.parametrize(
    ("place", "value", "message"),
    [
        ("version", 2, "version 2 of 'tmlattice-lattice'"),
        ("format", "tmlattice-info", "format 'tmlattice-info', which is no"),
        ("sequence", None, 'has no "sequence"'),
        ("sequence", ["q?"], r"'q\?', which has no definition"),
        ("definitions.QF.kind", "hexapole", 'is "hexapole"; it should be one of'),
        ("definitions.QF.class", "eval", 'is "eval"; it should be one of'),
        ("definitions.QF.parameters.k9", 1.0, "'k9'.* lacks"),
        ("definitions.QF.parameters.k1", "x", "QF.parameters.k1 is .* should be a number"),
        ("energy_gev", 0, "energy_gev"),
        ("changes", {"qx::0": {"k1": 1.0}}, "'changes' has 'qx::0', which is no"),
    ],
)
def test_damaged_own_json_ends_in_one_sentence(tmp_path, small_ring, place, value, message):
    """Another value in one place; None: nothing."""
    path = tmp_path / "ring.json"
    save_ring(small_ring, path)
    content = json.loads(path.read_text())
    *way, last = place.split(".")
    owner = functools.reduce(operator.getitem, way, content)
    owner[last] = value
    if value is None:
        del owner[last]
    path.write_text(json.dumps(content))
    with pytest.raises(LatticeError, match=message):
        load_ring(path)


def test_files_with_no_ring_end_in_one_sentence(tmp_path):
    with pytest.raises(LatticeError, match="not JSON"):
        load_ring(write(tmp_path, "a.json", "{"))
    with pytest.raises(LatticeError, match="holds no lattice"):
        load_ring(write(tmp_path, "b.json", "[1]"))
    with pytest.raises(LatticeError, match="AT lattice"):
        load_ring(write(tmp_path, "c.json", '{"some": "thing"}'))
    savemat(tmp_path / "d.mat", {"x": np.arange(3.0)})
    with pytest.raises(LatticeError, match="no single lattice"):
        load_ring(tmp_path / "d.mat")
    whole = (tmp_path / "d.mat").read_bytes()
    (tmp_path / "d.mat").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(LatticeError, match=r"d\.mat' cannot be read as a MATLAB file"):
        load_ring(tmp_path / "d.mat")
    with pytest.raises(LatticeError, match="cannot be read as a MATLAB file"):
        load_ring(write(tmp_path, "e.mat", "no matlab"))
    with pytest.raises(LatticeError, match="no lattice file that can be read"):
        load_ring(write(tmp_path, "f.xyz", ""))


FOREIGN = {
    "a command file of elegant: give": "&run_setup\n lattice = ring.lte &end\n",
    "a table of SDDS": "SDDS1\n&column name=s, type=double &end\n",
    "a lattice of Bmad": "parameter[e_tot] = 3e9\nq: quadrupole, l = 0.4\n",
    "a lattice of SAD": "FFS;\nQUAD QF = (L=.4 K1=.44);\nLINE RING=(QF);\n",
    "a lattice of MAD-NG": "local quadrupole in MAD.element\nlocal q = quadrupole 'q' {l=1}\n",
    "a lattice of PALS": '{"PALS": {"facility": []}}\n',
    "a lattice of Tracy": "{ring}\ndefine lattice;\nqf: quadrupole, l=0.4, k=1.1;\n",
    "a lattice of OPA": "energy = 2.4;\nb: bending, l=1, t=22.5;\nring: b, b;\n",
    "a lattice of MAD-8": "TITLE\n A\nBEAM, ENERGY=3\nQ: QUADRUPOLE, L=1, &\n K1=1\nR: LINE=(Q)\n",
}


@pytest.mark.parametrize("suffix", [".madx", ".lte", ".lat"])
@pytest.mark.parametrize("what", FOREIGN)
def test_formats_that_are_not_read_are_named(tmp_path, what, suffix):
    with pytest.raises(LatticeError, match=what):
        load_ring(write(tmp_path, f"ring{suffix}", FOREIGN[what]), energy=3.0)


def fodo(**changed):
    """A ring of AT with other elements."""
    own = {
        "q": at.Quadrupole("q", 0.4, 1.1, NumIntSteps=40),
        "d": at.Drift("d", 0.5),
        "b": at.Dipole("b", 1.0, np.pi / 8, 0.0),
        "f": at.Quadrupole("f", 0.4, -1.15, NumIntSteps=40),
        "m": at.Marker("m"),
        **changed,
    }
    return at.Lattice([own[key] for key in "qmdbdfmdb"], energy=3e9, periodicity=8)


QUADRUPOLE = {"PassMethod": "StrMPoleSymplectic4Pass", "PolynomA": [0.0, 0.0],
              "PolynomB": [0.0, 0.3], "MaxOrder": 1, "NumIntSteps": 10}  # fmt: skip


@pytest.mark.filterwarnings("ignore:.*beyond its first-order matrix")
@pytest.mark.parametrize(
    "changed",
    [
        {"m": at.Drift("m", 0.2, **QUADRUPOLE)},
        {"m": at.Monitor("m", Length=0.2, **QUADRUPOLE)},
        {"m": at.Corrector("m", 0.2, [1e-5, 2e-5], **QUADRUPOLE)},
        {"m": at.Corrector("m", 0.2, [1e-4, 2e-4], PassMethod="DriftPass")},
        {"m": at.Quadrupole("m", 0.2, 0.3, PassMethod="SolenoidLinearPass")},
        {"m": at.Drift("m", 0.2, PassMethod="WiggLinearPass", InvRho=0.5, KxKz=0.0)},
        {"m": at.Monitor("m", Length=0.2, PassMethod="WiggLinearPass", InvRho=0.5, KxKz=0.0)},
        {"m": at.SimpleRadiation("m", taux=100, tauy=100, tauz=50, U0=1e5)},
        {"b": at.Dipole("b", 1.0, np.pi / 8, PassMethod="BndMPoleSymplectic4RadPass")},
        {"m": at.M66("m", np.diag([2, 0.5, 2, 0.5, 1, 1]), Length=0.2, PassMethod="DriftPass")},
        {"m": at.Multipole("m", 0.2, [0, 0, 0], [0, 3.0, 80.0], PassMethod="DriftPass")},
        {"m": at.Dipole("m", 0.2, 0.1, 0.0, EntranceAngle=0.05, PassMethod="DriftPass")},
    ],
)
def test_pass_method_and_not_the_class_says_what_at_tracks(changed):
    lattice = fodo(**changed)
    ring = ring_from_at(lattice, "x")
    lattice = lattice.disable_6d(at.LongtMotion, copy=True)
    matrix = np.linalg.matrix_power(lattice.find_m44()[0], 8)
    mine, other = (np.sort(np.angle(np.linalg.eigvals(m))) for m in (ring_matrix(ring), matrix))
    np.testing.assert_allclose(mine, other, rtol=0, atol=2e-4)  # AT's integration
    orbit = Chain.from_ring(ring).closed_orbit(np.zeros(4))[0][0]
    np.testing.assert_allclose(orbit, lattice.find_orbit4()[0][:4], rtol=0.01, atol=1e-9)


@pytest.mark.parametrize(
    ("changed", "same"),
    [
        ({"m": at.RFCavity("m", 0.2, 1e6, 5e8, 32, 3e9, **QUADRUPOLE)},
         {"m": at.Multipole("m", 0.2, [0], [0, 0.3])}),
        ({"m": at.Element("m", Length=0.2, PassMethod="RFCavityPass", Voltage=1e6, Frequency=5e8)},
         {"m": at.Drift("m", 0.2)}),
        ({"b": at.Dipole("b", 1.0, np.pi / 8, 0.1, PassMethod="BndOldRadPass")},
         {"b": at.Dipole("b", 1.0, np.pi / 8, 0.1)}),
        ({"m": at.Element("m", Length=0.2, PassMethod="StrMPoleSymplectic4RadPass",
                          **{k: v for k, v in QUADRUPOLE.items() if k != "PassMethod"})},
         {"m": at.Multipole("m", 0.2, [0], [0, 0.3])}),
    ],
)  # fmt: skip
def test_radiation_and_acceleration_are_left_out_by_the_pass_method(changed, same):
    mine, other = (ring_matrix(ring_from_at(fodo(**own), "x")) for own in (changed, same))
    np.testing.assert_allclose(mine, other, rtol=0, atol=1e-12)


GIVEN = {
    "Q": {"Class": "Quadrupole", "Length": 0.4, "PolynomB": [0.0, 1.1], "PolynomA": [0.0, 0.0],
          "MaxOrder": 1.0, "NumIntSteps": 20.0, "PassMethod": "StrMPoleSymplectic4Pass"},
    "B": {"Class": "Bend", "Length": 1.0, "BendingAngle": 0.1, "EntranceAngle": 0.0,
          "ExitAngle": 0.0, "PolynomB": [0.0, 0.0], "PolynomA": [0.0, 0.0], "MaxOrder": 1.0,
          "NumIntSteps": 20.0, "PassMethod": "BndMPoleSymplectic4Pass"},
    "D": {"Class": "Drift", "Length": 1.0, "PassMethod": "DriftPass"},
}  # fmt: skip


def written(folder, suffix, **changed):
    """A file of AT whose elements have other attributes; None: not this one."""
    elements = [
        {
            "FamName": name,
            **{k: v for k, v in {**own, **changed.get(name, {})}.items() if v is not None},
        }
        for name, own in GIVEN.items()
    ]
    path = folder / f"ring{suffix}"
    if suffix == ".json":
        properties = {"energy": 3e9, "periodicity": 1, "particle": {"name": "relativistic"}}
        path.write_text(json.dumps({"atjson": 1, "elements": elements, "properties": properties}))
    else:
        ring = {"FamName": "R", "Class": "RingParam", "PassMethod": "IdentityPass", "Length": 0.0,
                "Energy": 3e9, "Periodicity": 1.0}  # fmt: skip
        cells = np.empty((4, 1), dtype=object)
        cells[:, 0] = [ring, *elements]
        savemat(path, {"RING": cells})
    return path


@pytest.mark.parametrize("suffix", [".mat", ".json"])
@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"Q": {"Length": None, "K": 0.3}}, "the element 'Q' the Length 0.3, the file 0"),
        ({"B": {"BendingAngle": None, "K": 0.3}}, "the element 'B' the BendingAngle 0.3, the file"),
        ({"D": {"Length": None}}, "the element 'D': .*length"),
        ({"D": {"Class": "Aperture", "PassMethod": "AperturePass"}}, "the element 'D': .*limits"),
        ({"Q": {"PolynomB": "x"}}, "the element 'Q': .*'x'"),
    ],
)
def test_an_element_that_at_makes_otherwise_is_refused_by_its_name(
    tmp_path, suffix, changed, message
):
    with pytest.raises(LatticeError, match=message):
        load_ring(written(tmp_path, suffix, **changed))


@pytest.mark.filterwarnings("ignore:.*bends")
@pytest.mark.parametrize("suffix", [".mat", ".json"])
@pytest.mark.parametrize("own", [{"K": 0.9}, {"Class": "Sextupole", "H": 0.9}])
def test_a_strength_beside_polynom_b_is_warned_of(tmp_path, suffix, own):
    with pytest.warns(UserWarning, match=r"K or H of Q \(1\) is not that of PolynomB"):
        ring = load_ring(written(tmp_path, suffix, Q=own))
    assert ring["q::0"].k1 == 1.1


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"m": at.Aperture("m", [-1, 1, -1, 1], Length=0.2)}, "AperturePass skips the length"),
        ({"m": at.Monitor("m", Length=0.2)}, r"AT's IdentityPass skips the length.* of m \(1\)$"),
        ({"q": at.Quadrupole("q", 0.4, 1.1, NumIntSteps=1)}, "integration in a few steps"),
        ({"m": at.Quadrupole("m", 0.2, 0.3, PassMethod="IdentityPass")}, "is IdentityPass"),
        ({"m": at.Dipole("m", 0.2, 0.1, PassMethod="DriftPass")}, r"is DriftPass of m \(1\)"),
        ({"m": at.Multipole("m", 0.2, [0], [0.1], PassMethod="ThinMPolePass")}, "skips the length"),
        ({"m": at.CrabCavity("m", 0.0, [1e5, 0.0], 5e8, 100)}, "what crabcavity does"),
        ({"m": at.VariableThinMultipole("m", AmplitudeB=1e-4, FrequencyB=1e3, PhaseB=1.0)},
         "what variablethinmultipole does"),
        ({"b": at.Dipole("b", 1.0, np.pi / 8, 0.0, gK=0.1, PassMethod="ExactSectorBendPass")},
         "what ExactSectorBendPass has beyond the model"),
        ({"b": at.Dipole("b", 1.0, np.pi / 8, 0.0, PassMethod="StrMPoleSymplectic4Pass")},
         "tracks bends straight ahead"),
        ({"m": at.EnergyLoss("m", 1e5, Length=0.2, PassMethod="EnergyLossRadPass")},
         "AT's IdentityPass skips the length"),
    ],
)  # fmt: skip
def test_what_at_tracks_otherwise_is_warned_of(changed, message):
    with pytest.warns(UserWarning, match=message):
        ring_from_at(fodo(**changed), "x")


def test_elements_that_at_tracks_otherwise_are_named_and_counted(small_ring):
    """The first three names, and how many elements there are, also of one name."""
    lattice = at.Lattice(at_lattice(small_ring), energy=3e9, periodicity=1)
    quadrupoles = [e for e in lattice if isinstance(e, at.Quadrupole)]
    for k, element in enumerate(quadrupoles):
        element.FamName, element.NumIntSteps = f"q{k // 2}", 1
    with pytest.warns(UserWarning, match=r"few steps of q0, q1, q2, \.\.\. \(32\)"):
        ring_from_at(lattice, "x")


@pytest.mark.parametrize(("second", "said"), [(3e9, True), (6e9, True), (None, False)])
def test_ring_parameters_beyond_the_first_are_reported(tmp_path, small_ring, second, said):
    from scipy.io import loadmat, savemat

    at.save_lattice(at.Lattice(at_lattice(small_ring), energy=3e9), tmp_path / "ring.mat")
    elements = loadmat(tmp_path / "ring.mat")["RING"].ravel()
    if second:
        more = loadmat(tmp_path / "ring.mat")["RING"].ravel()[0]
        more["Energy"][0, 0] = np.array([[second]])
        elements = np.insert(elements, 1, np.array([more, None], dtype=object)[:1])
    savemat(tmp_path / "ring.mat", {"RING": elements})
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        assert load_ring(tmp_path / "ring.mat").energy == pytest.approx(3.0)
    assert any("More than 1 RingParam" in str(w.message) for w in caught) == said


def test_energy_of_a_lattice_of_at_without_one_is_given(tmp_path):
    ring = np.empty((2, 1), object)
    ring[0, 0] = {"FamName": "q", "PassMethod": "QuadLinearPass", "Length": 0.4, "K": 1.1}
    ring[1, 0] = {"FamName": "d", "PassMethod": "DriftPass", "Length": 0.5}
    savemat(tmp_path / "old.mat", {"THERING": ring, "GLOBVAL": {"LatticeFile": "old"}})
    with pytest.raises(LatticeError, match="states no beam energy; give energy="):
        load_ring(tmp_path / "old.mat")
    assert load_ring(tmp_path / "old.mat", energy=2.5).energy == 2.5
    savemat(tmp_path / "two.mat", {"RING": ring, "THERING": ring})
    with pytest.raises(LatticeError, match=r"no single lattice \(RING, THERING\)"):
        load_ring(tmp_path / "two.mat", energy=2.5)


def test_a_family_of_matlab_may_have_a_word_of_ats(tmp_path):
    """AT would make a cavity of the quadrupole and a wiggler of the drift."""
    tunes = []
    for names in (("qf", "d"), ("RF", "Wig")):
        lattice = fodo()
        cells = np.empty((len(lattice), 1), object)
        for place, element in enumerate(lattice):
            fields = {k: v for k, v in vars(element).items() if v is not None}
            family = {"q": names[0], "d": names[1]}.get(element.FamName, element.FamName)
            cells[place, 0] = {**fields, "FamName": family, "PassMethod": element.PassMethod}
        savemat(tmp_path / "ring.mat", {"RING": cells})
        tunes.append(ring_tunes(load_ring(tmp_path / "ring.mat", energy=3.0)))
    assert tunes[0] == tunes[1]


def test_change_of_the_reference_momentum_is_refused():
    change = at.Element("up", PassMethod="ChangePRefPass", FieldScaling=1.01)
    with pytest.raises(LatticeError, match="'up' changes the reference momentum"):
        ring_from_at(fodo(m=change), "x")


def test_real_at_lattice_has_its_counts_and_the_turn_of_at(tmp_path):
    path = measured_data("petra3_orbit_response", "p3_low_beta.mat")
    ring = load_ring(path)
    wanted = {"monitor": 246, "quadrupole": 417, "sextupole": 230, "wiggler": 20, "bend": 446}
    assert {kind: ring.counts()[kind] for kind in wanted} == wanted
    assert sum(e.tilt != 0 for e in ring.elements if e.kind == "quadrupole") == 16
    lattice = at.load_lattice(path)
    lattice.disable_6d()
    # AT differentiates numerically, which is the larger part of 1e-10
    expected = at.find_m44(lattice)[0]
    difference = np.abs(ring_matrix(ring) - expected).max() / np.abs(expected).max()
    assert difference < 1e-9
    tunes = np.array(ring_tunes(ring)) % 1
    np.testing.assert_allclose(tunes, at.get_tune(lattice), rtol=0, atol=1e-9)
    np.testing.assert_allclose(tunes, [0.12, 0.27], rtol=0, atol=1e-5)
    assert ring.length == pytest.approx(lattice.circumference, abs=1e-8)
    save_ring(ring, tmp_path / "real.json")
    assert load_ring(tmp_path / "real.json").elements == ring.elements
