"""elegant's lattices: RPN, names and lines, and each class against what it is equal to."""

import os
import warnings

import numpy as np
import pytest
from shared import measured_data

from tmlattice import load_ring
from tmlattice.beam.chain import Chain
from tmlattice.errors import LatticeError
from tmlattice.maps import ring_matrix
from tmlattice.optics import twiss

BASE = {
    "BB": 'CSBEND, L=1, ANGLE="pi 8 /"',
    "QF": "KQUAD, L=0.4, K1=1.1",
    "QD": "KQUAD, L=0.4, K1=-1.15",
    "SX": "KSEXT, L=0.2, K2=3",
    "MQ": "MONI",
    "CH": "HKICK",
    "CV": "VKICK",
    "D0": "DRIF, L=0.1",
    "D1": "DRIF, L=0.4",
    "D2": "DRIF, L=0.7",
    "D3": "DRIF, L=0.6",
    "D4": "DRIF, L=0.3",
}
CELL = "CELL: LINE=(D0,QF,D0,MQ,D1,CH,BB,D2,QD,D0,MQ,D3,CV,BB,D4,SX)\nRING: LINE=(8*CELL)\n"
TUNES = [2.303238, 1.599761]
"""Of the base ring, by MAD-X."""


def write(folder, text, name="ring.lte"):
    path = folder / name
    path.write_text(text)
    return path


def deck(*more, cell=CELL, **changes):
    """The base ring with other elements: a keyword is a name, its value the definition."""
    definitions = [f"{name}: {value}" for name, value in {**BASE, **changes}.items()]
    return "\n".join([*definitions, *more]) + "\n" + cell + "USE, RING\n"


def load(folder, *more, cell=CELL, **changes):
    path = write(folder, deck(*more, cell=cell, **changes))
    return load_ring(path, energy=3.0)


def orbit(ring):
    return np.asarray(Chain.from_ring(ring).closed_orbit(np.zeros(4))[0])


def assert_same(ring, other):
    """Both rings have the same length, matrix and closed orbit."""
    assert ring.length == pytest.approx(other.length, abs=1e-9)
    np.testing.assert_allclose(ring_matrix(ring), ring_matrix(other), rtol=0, atol=1e-7)
    largest = [np.abs(orbit(r)).max(0) for r in (ring, other)]
    np.testing.assert_allclose(largest[0], largest[1], rtol=1e-3, atol=1e-9)


def tunes(ring):
    return twiss(Chain.from_ring(ring)).total_tunes


def test_base_ring_has_mad_x_s_tunes_and_is_given_its_energy(tmp_path):
    ring = load(tmp_path, CV="KICKER")
    np.testing.assert_allclose(tunes(ring), TUNES, rtol=0, atol=1e-6)
    counts = ring.counts()
    assert (counts["monitor"], counts["hcorrector"], counts["vcorrector"]) == (16, 16, 8)
    assert (ring["sx::2"].k2, ring["bb::0"].angle) == pytest.approx((3.0, np.pi / 8))
    with pytest.raises(LatticeError, match="no beam energy; give energy="):
        load_ring(tmp_path / "ring.lte")


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("15_elegant/rpn.lte", TUNES),
        ("15_elegant/include.lte", TUNES),
        ("15_elegant/ehkick.lte", TUNES),
        ("15_elegant/drift_alias.lte", TUNES),
        ("15_elegant/fse_quad.lte", [2.393841, 1.565619]),
        ("15_elegant/ccbend.lte", [1.439753, 2.360031]),
        ("03_rbend_negative/pos_rben.lte", [1.44405, 2.36132]),
        ("03_rbend_negative/neg_rben.lte", [1.44405, 2.36132]),
    ],
)
def test_field_lattices(name, expected):
    path = measured_data("field_lattices", name)
    np.testing.assert_allclose(tunes(load_ring(path, energy=3.0)), expected, rtol=0, atol=1e-5)


B = np.sqrt(3.0**2 - 0.00051099895**2) / 0.299792458  # T m, of electrons of 3 GeV
GAMMA = 3.0 / 0.00051099895
REVERSED = "RING: LINE=(8*(QF,-HALF))\nHALF: LINE=(D1,BB,2*D2,QD,D3)\n"
STRAIGHT = "RING: LINE=(8*(QF,D3,QD,D2,D2,BB,D1))\n"
ROTATED = "RING: LINE=(8*({},MQ,D1,CH,BB,D2,QD,MQ,D3,CV,BB,D4,SX))\n"
EQUAL = {
    "shortened class": ({"QF": "QUADRUPOLE, L=0.4, K1=1.1", "BB": "CSBEN, L=1, ANGLE=0.4"},
                        {"BB": "SBEND, L=1, ANGLE=0.4"}),
    "quadrupole FSE": ({"QF": "KQUAD, L=0.4, K1=1, FSE=0.1"}, {}),
    "quadrupole by its pole tip": ({"QF": f"KQUAD, L=0.4, BORE=0.02, B={1.1 * 0.02 * B}"}, {}),
    "quadrupole's steering": ({"QF": "KQUAD, L=0.4, K1=1.1, HKICK=1E-5, VKICK=2E-5"},
                              {"QF": "DQCOR, L=0.4, K1=1.1, HKICK=2E-5, HCALIBRATION=0.5, "
                                     "VKICK=2E-5"}),
    "sextupole by its pole tip": ({"SX": f"KSEXT, L=0.2, BORE=0.02, B={3 * 0.02**2 * B / 2}"}, {}),
    "sextupole's gradient": ({"SX": "KSEXT, L=0.2, K2=3, K1=0.1, J1=0.02, DX=1E-4"},
                             {"SX": "SEXT, L=0.2, K2=3, K1=0.1, J1=0.02, DX=1E-4"}),
    "KQUSE": ({"QF": "KQUSE, L=0.4, K1=1, FSE1=0.1, K2=4, FSE2=0.5"},
              {"QF": "KQUSE, L=0.4, K1=1.1, K2=6"}),
    "MULT": ({"CH": "MULT, ORDER=1, KNL=0.02"},
             {"CH": "EMATRIX, R11=1, R22=1, R33=1, R44=1, R55=1, R66=1, R21=-0.02, R43=0.02"}),
    "MULT by its pole tip": ({"CH": f"MULT, ORDER=1, BORE=0.02, BTIPL={0.01 * 0.02 * B}, FACTOR=2"},
                             {"CH": "MULT, ORDER=1, KNL=0.02"}),
    "kicks": ({"CH": "HKICK, KICK=2E-5, CALIBRATION=0.5", "CV": "EVKICK, KICK=1E-5"},
              {"CH": "EHKICK, KICK=1E-5", "CV": "VKICK, KICK=1E-5"}),
    "turned kick": ({"CH": 'HKICK, KICK=1E-5, TILT="pi 2 /"'}, {"CH": "VKICK, KICK=1E-5"}),
    "pair of kicks": ({"CH": "KICKER, HKICK=1E-5, VKICK=2E-5"},
                      {"CH": "EKICKER, HKICK=1E-5, VKICK=4E-5, VCALIBRATION=0.5"}),
    "rectangular bend": ({"BB": f"RBEN, L={4 / 0.4 * np.sin(0.2)}, ANGLE=0.4"},
                         {"BB": "CSBEND, L=2, ANGLE=0.4, E1=0.2, E2=0.2"}),
    "bend's other sign": ({"BB": f"RBEN, L={4 / 0.4 * np.sin(0.2)}, ANGLE=-0.4, E1=0.1"},
                          {"BB": "CSBEND, L=2, ANGLE=-0.4, E1=-0.1, E2=-0.2"}),
    "straight bend": ({"BB": "CCBEND, L=1, ANGLE=0.4, K1=-0.1"},
                      {"BB": "CSBEND, L=1, ANGLE=0.4, K1=-0.1, E1=0.2, E2=0.2"}),
    "turned straight bend": ({"BB": "CCBEND, L=1, ANGLE=0.4, YAW=0.05"},
                             {"BB": "CSBEND, L=1, ANGLE=0.4, E1=0.15, E2=0.25"}),
    "gap": ({"BB": "CSBEND, L=1, ANGLE=0.4, E1=0.1, E2=0.1, HGAP=0.02"},
            {"BB": "CSBEND, L=1, ANGLE=0.4, E1=0.1, E2=0.1, HGAP=0.01, FINT1=1, FINT2=1"}),
    "no edges": ({"BB": "CSBEND, L=1, ANGLE=0.4, E1=0.1, E2=0.1, EDGE1_EFFECTS=0, HGAP=0.02"},
                 {"BB": "SBEN, L=1, ANGLE=0.4, E2=0.1, HGAP=0.02, FINT=0.5, EDGE1_EFFECTS=0"}),
    "B1 for K1": ({"BB": "CSBEND, L=1, ANGLE=0.4, USE_BN=1, B1=-0.25"},
                  {"BB": "CSBEND, L=1, ANGLE=0.4, K1=-0.1"}),
    "FSE of a bend": ({"BB": "CSBEND, L=1, ANGLE=0.4, K1=-0.1, FSE=1E-3"},
                      {"BB": "CSBEND, L=1, ANGLE=0.4, K1=-0.1001, FSE_DIPOLE=1E-3"}),
    "FSE of a gradient": ({"BB": "CSBEND, L=1, ANGLE=0.4, K1=-0.1, FSE_QUADRUPOLE=0.1"},
                          {"BB": "CSBEND, L=1, ANGLE=0.4, K1=-0.11"}),
    "steering of a bend": ({"BB": "CSBEND, L=1, ANGLE=0.4, XKICK=-4E-5"},
                           {"BB": "CSBEND, L=1, ANGLE=0.4, FSE=1E-4"}),
    "bend without an angle": ({"BB": "CSBEND, L=1, K1=0.2"}, {"BB": "KQUAD, L=1, K1=0.2"}),
    "drifts": ({"D1": "EDRIFT, L=0.4", "D2": "CSRDRIFT, L=0.7, USE_STUPAKOV=1", "D3":
                "LSCDRIFT, L=0.6", "MQ": "WATCH, FILENAME=x.w1, MODE=coord", "D0": "ECOL, L=0.1"},
               {}),
    "silent elements": ({"MQ": "MARK, FITPOINT=1", "CH": "CHARGE, TOTAL=1E-9", "CV":
                         "SCRAPER, INSERT_FROM=+x, POSITION=0.02"}, {}),
    "monitors": ({"MQ": "HMON, WEIGHT=2, READOUT=x"}, {}),
    "RF cavity": ({"CH": "RFCA, VOLT=1E6, FREQ=5E8, PHASE=180"}, {"CH": "MARK"}),
    "inert elements": ({"CH": "MALIGN", "CV": "ENERGY", "MQ": "MAGNIFY, MX=1"}, {}),
    "rotations": ({"CH": "ROTATE, TILT=0.05, EXCLUDE_OPTICS=1"}, {}),
    "solenoid by its field": ({"CH": f"SOLE, L=0.3, B={0.2 * B}"}, {"CH": "SOLE, L=0.3, KS=-0.2"}),
    "pieces of a bend without faces between": (
        {"BB": 'CSBEND, L=0.5, ANGLE="pi 16 /", E1=0.1, E2=0.1',
         "cell": CELL.replace("BB", "BB,MK,BB") + "MK: MARK\n"},
        {"BB": 'CSBEND, L=1, ANGLE="pi 8 /", E1=0.1, E2=0.1'}),
    "reversed line": ({"cell": REVERSED, "BB": "CSBEND, L=1, ANGLE=0.4, E1=0.1, E2=0.3"},
                      {"cell": STRAIGHT, "BB": "CSBEND, L=1, ANGLE=0.4, E1=0.3, E2=0.1"}),
    "reversed bend": ({"cell": STRAIGHT.replace("BB", "-BB"),
                       "BB": "CSBEND, L=1, ANGLE=0.4, E1=0.1, E2=0.3"},
                      {"cell": STRAIGHT, "BB": "CSBEND, L=1, ANGLE=0.4, E1=0.3, E2=0.1"}),
    "rotations around a magnet": (
        {"cell": ROTATED.format("ROT1,QF,ROT2") + "ROT1: ROTATE, TILT=0.05\n"
                                                  "ROT2: ROTATE, TILT=-0.05\n"},
        {"cell": ROTATED.format("QF"), "QF": "KQUAD, L=0.4, K1=1.1, TILT=0.05"}),
    "matrix of a drift": ({"D0": "EMATRIX, L=0.1, R11=1, R12=0.1, R22=1, R33=1, R34=0.1, R44=1, "
                                 "R55=1, R66=1"}, {}),
    "weak wiggler": ({"D1": "WIGGLER, L=0.4, RADIUS=1E9, POLES=20"}, {}),
    "wiggler by its field": ({"D1": f"WIGGLER, L=0.4, B={B / 8}, POLES=20"},
                             {"D1": "WIGGLER, L=0.4, RADIUS=8"}),
    "wiggler by its K": ({"D1": "WIGGLER, L=0.4, K=2.3, POLES=20"},
                         {"D1": f"WIGGLER, L=0.4, RADIUS={GAMMA * 0.04 / 2 / np.pi / 2.3}"}),
}  # fmt: skip


@pytest.mark.parametrize("name", EQUAL)
def test_class_is_equal_to_another(tmp_path, name):
    mine, other = EQUAL[name]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        assert_same(load(tmp_path, **mine), load(tmp_path, **other))


def test_wiggler_focuses_by_half_its_curvature_squared(tmp_path):
    with pytest.warns(UserWarning, match="beyond its first-order matrix of d1"):
        ring = load(tmp_path, D1="WIGGLER, L=0.4, RADIUS=8, POLES=20")
    assert ring.counts()["wiggler"] == 8
    thin = f"MULT, ORDER=1, KNL={-0.4 / (2 * 8**2)}"  # of a focusing in both planes, halved
    base = tunes(load(tmp_path))
    x, y = tunes(ring) - base
    assert abs(x) < 1e-9
    beside = tunes(load(tmp_path, CH=thin))[1] - base[1]
    assert y == pytest.approx(beside, rel=0.2)  # the beta function changes over the length


def test_fringe_quadrupole_is_a_ramp(tmp_path):
    whole = load(tmp_path, QF="QUAD, L=0.4, K1=0.55")
    ramp = load(tmp_path, QF="QUFRINGE, L=0.4, K1=1.1, DIRECTION=1")
    assert ramp.length == pytest.approx(whole.length)
    np.testing.assert_allclose(tunes(ramp), tunes(whole), atol=0.02)
    assert np.abs(tunes(ramp) - tunes(whole)).max() > 1e-4


def test_field_error_of_a_bend_moves_the_orbit(tmp_path):
    ring = load(tmp_path, BB='CSBEND, L=1, ANGLE="pi 8 /", FSE=1E-3')
    other = load(tmp_path, CH="HKICK, KICK=-1E-4")
    assert np.abs(orbit(ring)[:, 0]).max() > 1e-3
    assert np.sign(orbit(ring)[:, 0].mean()) == np.sign(orbit(other)[:, 0].mean())


RPN = {
    "1.1": 1.1,
    "2 3 pow": 8.0,
    "pi 4 / tan": 1.0,
    "90 dsin 1 datan 45 - +": 1.0,
    "3 4 hypot sqr sqrt 5 -": 0.0,
    "1 chs abs 2 rec -": 0.5,
    "1 2 atan2": np.arctan2(2, 1),
    "180 dtor pi -": 0.0,
    "7 2 mod 2.7 int +": 3.0,
    "1 2 max2 3 min2": 2.0,
    "2 = *": 4.0,
    "1 2 swap -": 1.0,
    "5870.85 gamma.p beta.p": 1.0,
    "kq 2 *": 2.2,
    "KQ": 1.1,
    "1 3 sto other pop other +": 4.0,
    "1e300" + " = *" * 60 + " pop 2": 2.0,
}


@pytest.mark.parametrize("text", RPN)
def test_rpn(tmp_path, text):
    more = ["% 0.55 2 * sto kq", f'QX: KQUAD, L=1, K1="{text}"', "ONE: LINE=(QX)"]
    path = write(tmp_path, deck(*more))
    ring = load_ring(path, sequence="one", energy=3.0)
    assert ring.elements[0].k1 == pytest.approx(RPN[text], abs=1e-6)


def test_statements(tmp_path):
    text = """! a comment, with "one quotation mark
TITLE
 this is no statement: at all
% 1.1 sto kf ! stored
#include: "more.lte"
Q1: QUAD, L=0.4, & the rest follows
"""
    text = text.replace("& the rest follows", "&\n ! a comment in between\n  K1 = kf")
    text += """
"q2": q1, TILT=0.1   ! of another element
qf: Kquad,l=.4,k1="kf chs",N_SLICES=8
"B:1": CSBEND, L=1, ANGLE="pi 8 /"
ring: line=(2*("q2",D1),("B:1"), -qf, q1)
USE, RING
Q1: what follows USE is not read
"""
    write(tmp_path, "D1: DRIFT, L=0.5\nRETURN\nD1: this is not read\n", "more.lte")
    ring = load_ring(write(tmp_path, text), energy=3.0)
    names = [e.family for e in ring.elements]
    assert names == ["q2", "d1", "q2", "d1", "b:1", "qf", "q1"]
    assert [round(e.k1, 6) for e in ring.elements] == [1.1, 0, 1.1, 0, 0, -1.1, 1.1]
    assert ring.elements[0].tilt == pytest.approx(0.1)


def test_use_says_which_line(tmp_path):
    text = deck(cell=CELL + "OTHER: LINE=(2*CELL)\n").replace("USE, RING", "USE, OTHER")
    path = write(tmp_path, text)
    assert load_ring(path, energy=3.0).length == pytest.approx(42.4 / 4)
    assert load_ring(path, sequence="ring", energy=3.0).length == pytest.approx(42.4)
    with pytest.raises(LatticeError, match=r"USE of .* names NO, which no sequence or line"):
        load_ring(write(tmp_path, text.replace("USE, OTHER", "USE, NO")), energy=3.0)
    path = write(tmp_path, text.replace("USE, OTHER", "").replace("RING", "HALVES"))
    with pytest.raises(LatticeError, match="has the sequences HALVES, OTHER; name one"):
        load_ring(path, energy=3.0)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"CH": "UKICKMAP, L=1"}, r"UKICKMAP 'CH' \(line 6 of ring.lte\) acts on the beam"),
        ({"CH": "BRAT, L=1"}, "BRAT 'CH'"),
        ({"CH": "MATR, FILENAME=x.mat"}, "MATR 'CH'"),
        ({"CH": "HPOLE, L=1"}, "element class 'HPOLE' is unknown"),
        ({"CH": "KQU, L=1"}, "element class 'KQU' may be KQUAD, KQUSE"),
        ({"CH": "MALIGN, DXP=1E-5"}, "MALIGN 'CH' .* changes the beam by its DXP"),
        ({"CH": "ENERGY, CENTRAL_ENERGY=5000"}, "ENERGY 'CH' .* CENTRAL_ENERGY"),
        ({"QF": "KQUAD, L=0.4, K1=1, I1P=1E-4"}, "attribute I1P of KQUAD 'QF'"),
        ({"QF": "KQUAD, L=0.4, K1=1, RADIAL=1"}, "attribute RADIAL of KQUAD 'QF'"),
        ({"QF": "KQUAD, L=0.4, KK=1"}, "attribute KK of KQUAD 'QF'"),
        ({"QF": "KQUAD, L=0.4, K1=2*0.5"}, r"K1 is '2\*0.5', which is no number; .* RPN"),
        ({"QF": 'KQUAD, L=0.4, K1="kx 2 *"'}, "'kx' is no number, stored name or known operator"),
        ({"QF": 'KQUAD, L=0.4, K1="1 0 /"'}, "'1 0 /' has no value"),
        ({"QF": 'KQUAD, L=0.4, K1="*"'}, r"'\*' needs 2 numbers"),
        ({"QF": "KQUAD, L=0.4, K1"}, "'K1' gives no value"),
        ({"CH": "EMATRIX, R12=1"}, "EMATRIX 'CH' has no inverse"),
        ({"CH": "RFCA, VOLT=1E6, CHANGE_P0=1"}, "CHANGE_P0"),
        ({"CELL": "MARK"}, "'CELL' is defined twice"),
        ({"CH": "MALIGN, DX=1E-5, ON_PASS=0, FORCE_MODIFY_MATRIX=1"}, "MALIGN 'CH' .* by its DX"),
        ({"QF": "KQUAD, L=0.4, K1=1, K1=1.1"}, "K1 of 'QF' is stated twice"),
        ({"QUAD": "KQUAD, L=0.4, K1=-1", "QX": "QUAD, L=0.4"}, "'QUAD' is an element and a class"),
        ({"cell": "! without a line\n"}, "no SEQUENCE and no LINE"),
    ],
)
def test_what_is_not_modelled_is_named(tmp_path, changes, message):
    with pytest.raises(LatticeError, match=message):
        load(tmp_path, **changes)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"CH": "ZLONGIT, BROAD_BAND=1"}, "what ZLONGIT does of ch"),
        ({"CH": "RFDF, VOLTAGE=1E6"}, "what RFDF does of ch"),
        ({"BB": 'CSBEND, L=1, ANGLE="pi 8 /", K4=3'}, "K4 of bb"),
        ({"CH": "EMATRIX, R11=1, R22=1, R33=1, R44=1, R55=1, R66=1, T211=0.3"}, "T211 of ch"),
        ({"QF": "KQUAD, L=0.4, K1=1.1, EDGE_MULTIPOLES=x.sdds"}, "EDGE_MULTIPOLES of qf"),
        ({"CH": "RFCA, VOLT=1E6, END1_FOCUS=1"}, "END1_FOCUS of ch"),
        ({"CH": "HKICK, B2=10"}, "B2 of ch"),
        ({"MQ": "MONI, XCALIBRATION=1.1, WEIGHT=2"}, r"XCALIBRATION of mq \(1\)$"),
        ({"D1": "DRIF, L=0.4, K1=3"}, "K1 of d1"),
    ],
)  # fmt: skip
def test_what_acts_beyond_the_linear_optics_is_warned_of(tmp_path, changes, message):
    with pytest.warns(UserWarning, match=f"left out of the model: {message}"):
        ring = load(tmp_path, **changes)
    np.testing.assert_allclose(tunes(ring), TUNES, rtol=0, atol=1e-6)


HOSTILE = {
    "repeats without end": "RING2: LINE=(999999999*QF)\nUSE, RING2\n",
    "has a line of lines": "L0: LINE=(QF,QF)\n" + "".join(
        f"L{i}: LINE=(L{i - 1},L{i - 1})\n" for i in range(1, 60)) + "USE, L59\n",
    "contains itself": "LA: LINE=(QF,LB)\nLB: LINE=(LA)\nUSE, LA\n",
    "includes itself": "#INCLUDE: ring.lte\n",
    "includes a device": "#INCLUDE: /dev/zero\n",
    "includes a pipe": "#INCLUDE: pipe\n",
    "goes on without end": "QX: KQUAD, &\n" + "L=0.1, &\n" * 6000,
    "keeps too many numbers": "% " + "1 " * 20_000 + "\n",
    "works without end": ("% " + "1 sto a " * 5000 + "\n") * 500,
    "is nested": "LX: LINE=" + "(" * 300 + "QF" + ")" * 300 + "\n",
    "leaves a bracket open": "LX: LINE=(QF,(QD)\n",
    "names a function of Python": 'QX: KQUAD, L="__import__"\n',
    "reaches a class of Python": "QX: KQUAD, L=().__class__\n",
}  # fmt: skip


@pytest.mark.parametrize("what", HOSTILE)
def test_text_that_never_ends_or_calls_what_is_no_file(tmp_path, monkeypatch, what):
    monkeypatch.chdir(tmp_path)
    os.mkfifo("pipe")
    text = deck().replace("USE, RING\n", "") + HOSTILE[what]
    with pytest.raises(LatticeError) as caught:
        load_ring(write(tmp_path, text), energy=3.0)
    assert len(str(caught.value)) < 600
