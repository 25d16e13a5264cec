"""MAD-X decks against MAD-X 5.09 itself, and words of real machines' files."""

import json
import warnings
from pathlib import Path

import numpy as np
import pytest
import tfs

from tmlattice import load_ring
from tmlattice.beam.chain import Chain
from tmlattice.errors import LatticeError
from tmlattice.maps import ring_matrix
from tmlattice.optics import closed_orbit, off_momentum, twiss

FIELD = json.loads((Path(__file__).parent / "lattices" / "madx_decks.json").read_text())
DECKS = FIELD["decks"]


def read(folder, text, **options):
    path = folder / "ring.madx"
    path.write_text(text)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return load_ring(path, **options)


@pytest.mark.parametrize("name", DECKS)
def test_deck_is_the_ring_that_madx_tracks(tmp_path, name):
    deck = DECKS[name]
    ring = read(tmp_path, deck["text"])
    assert ring.energy == pytest.approx(deck["energy"], rel=1e-7)
    light = deck["mass"] < 1e-3
    assert ring.mass == pytest.approx(deck["mass"], rel=1e-6 if light else 1e-8)
    assert ring.length == pytest.approx(deck["length"], abs=1e-9)
    chain = Chain.from_ring(ring)
    # both are products of the same linear maps; where the orbit is bent, second order differs
    orbit = closed_orbit(chain)
    away = np.abs(deck["orbit"]).max()
    np.testing.assert_allclose(orbit[:4], deck["orbit"], rtol=0, atol=1e-9 + 2e-3 * away)
    tolerance = 2e-6 + 0.02 * away
    np.testing.assert_allclose(
        twiss(chain).total_tunes % 1, [deck["q1"] % 1, deck["q2"] % 1], rtol=0, atol=tolerance
    )


PLAIN = DECKS["plain"]["text"]


REFUSED_TABLES = {
    "kick next to hkick": "its closed orbit is .* mm at most, the table has .* mm",
    "thin solenoid": "has the SOLENOID 'xx', whose numbers a table does not hold",
}


@pytest.mark.parametrize("name", FIELD["tables"])
def test_table_is_the_ring_that_madx_has_written(tmp_path, name):
    path = tmp_path / "twiss.tfs"
    path.write_text(FIELD["tables"][name]["table"])
    if name in REFUSED_TABLES:
        with pytest.raises(LatticeError, match=REFUSED_TABLES[name]):
            load_ring(path)
        return
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        ring = load_ring(path)
    table = tfs.read(str(path))
    start, header = table.iloc[0], table.headers
    tunes = twiss(Chain.from_ring(ring)).total_tunes
    orbit = max(header["XCOMAX"], header["YCOMAX"])
    np.testing.assert_allclose(tunes, [header["Q1"], header["Q2"]], rtol=0, atol=2e-6 + 0.1 * orbit)
    found = off_momentum(Chain.from_ring(ring, 6), ring.length).dispersion[0]
    stated = [start.get(column, 0.0) for column in ("DX", "DY")]
    np.testing.assert_allclose(found, stated, rtol=0, atol=1e-5 + 10 * orbit)


def with_element(element):
    return PLAIN.replace("bb, at=4.2;", f"bb, at=4.2; {element}")


REFUSED = {
    "no beam": (PLAIN.split("\n", 1)[1], "no BEAM with an energy; give energy="),
    "no ring": ("q: quadrupole, l=0.1, k1=1;\n", "no SEQUENCE and no LINE"),
    "no element": (
        "s: sequence, l=1; nothing, at=0.5; endsequence; beam, pc=1;",
        "cannot be read as MAD-X: .*nothing",
    ),
    "match": (PLAIN + "match, sequence=ring; vary, name=kq; endmatch;", "MATCH changes strengths"),
    "ealign": (PLAIN + "use, sequence=ring; ealign, dx=1e-4;", "EALIGN moves elements"),
    "efcomp": (PLAIN + "efcomp, order=0, dkn={1e-4};", "EFCOMP gives elements field errors"),
    "taper": (PLAIN + "taper, reset;", "TAPER changes strengths along the ring"),
    "setvars_lin": (PLAIN + "setvars_lin, table=t;", "SETVARS_LIN sets variables from a table"),
    "correct": (PLAIN + "correct, flag=ring;", "CORRECT sets correctors"),
    "random": (PLAIN + "qf, k1=1.1 + 1e-3*gauss();", r"GAUSS\(\) is random"),
    "result": (PLAIN + "qf, k1=table(twiss, qf, k1l);", r"TABLE\(\) reads a result"),
    "two signs": (PLAIN + "x = 2*-0.5;", r"'2\*-0.5' has two signs in a row, which MAD-X does not"),
    "replace by a sequence": (
        PLAIN + "seqedit, sequence=ring; replace, element=cell[2], by=cell; endedit;",
        "'cell' is no element; SEQEDIT puts in elements only",
    ),
    "list": (PLAIN.replace("k1=1.1", "k1={1.1}"), r"K1 of QUADRUPOLE 'qf' \(line 4 .* is a list"),
    "thin bend": (
        with_element("m: multipole, ksl={0.01}, angle=0.01, at=4.95;"),
        r"ANGLE of MULTIPOLE 'm', which bends vertically by its KSL \(line 8",
    ),
    "no place": (PLAIN.replace("qf, at=0.3;", "qf, at=0.3; qf;"), "'qf' has no AT in its sequence"),
    "range": (PLAIN + "use, sequence=ring, range=qf/qd;", "USE with a RANGE takes a part"),
    "beam-beam": (with_element("b: beambeam, charge=1, at=4.95;"), "BEAMBEAM 'b' .* by its CHARGE"),
    "beam-beam by default": (with_element("b: beambeam, at=4.95;"), "BEAMBEAM 'b' .* by its"),
    "install": (
        PLAIN + "seqedit, sequence=cell; install, element=qf; endedit;", "AT is missing"
    ),
    "flattened names": (
        PLAIN + "seqedit, sequence=ring; flatten; replace, element=mq, by=sf; endedit;",
        "FLATTEN has made 8 elements 'mq' of one name",
    ),
    "edit after flatten": (
        PLAIN + "half: sequence, l=41.6; ring, at=20.8; endsequence;"
        "seqedit, sequence=cell; install, element=q9, class=sf, at=5; endedit;"
        "one: sequence, l=10, refer=entry; cell, at=0; endsequence;"
        "seqedit, sequence=one; flatten; remove, element=q9; endedit;",
        "put ENDEDIT and another SEQEDIT before",
    ),
    "cycle": (
        PLAIN + "seqedit, sequence=cell; cycle, start=qd; endedit;",
        "CYCLE starts at 'qd', which has a length; take a marker",
    ),
    "extract": (
        PLAIN + "extract, sequence=cell, from=qf, to=qd, newname=part;",
        "EXTRACT is not from a marker to a marker",
    ),
    "call": (PLAIN + "call;", "it calls"),
    "one of a list": (PLAIN + "sf->knl[1] = 0.03;", "one number of a list is not set so"),
    "undefined in a sequence": (with_element("qx, at=4.95;"), "no element or command 'qx' is"),
    "no momentum": (PLAIN.replace("energy=3", "pc=p0"), "BEAM has PC=0; give one above 0"),
    "argument of a macro": (
        PLAIN + "f(x): macro = { qf->k1 = x; }; exec, f(-0.5);",
        "the argument '-0.5' of a macro is an expression, which MAD-X cuts off",
    ),
    "length of a sequence": (
        PLAIN + "qf, k1=ring->l/40;", "'ring->l' of a sequence is 0 in MAD-X; write its value"
    ),
    "branch without braces": (PLAIN + "if (1 == 1) qf, k1=2;", "IF is not followed by"),
    "kick of a kicker": (with_element("k: kicker, kick=1e-4, at=4.95;"), "KICK of KICKER 'k'"),
    "nested branches": (
        PLAIN + "if (1 == 1) { if (1 == 2) { qf, k1=2; } } else { frobnicate; } wrong;",
        "no element or command 'wrong'",
    ),
    "rotation": (
        with_element("y: yrotation, angle=1e-3, at=4.95;"), "YROTATION 'y' .* by its ANGLE"
    ),
    "energy": (
        with_element("w: matrix, kick6=1e-4, at=4.95;"), "matrix 'w' changes the energy in every"
    ),
    "class": (with_element("w: wigglerx, at=4.95;"), "no element or command 'wigglerx' is known"),
    "attribute": (PLAIN + "qf, k1x=1;", "attribute K1X of QUADRUPOLE 'qf'"),
    "tapered magnet": (PLAIN + "qf, ktap=0.01;", "attribute KTAP of QUADRUPOLE 'qf'"),
    "pitch": (PLAIN + "qf, dtheta=1e-3;", "attribute DTHETA of QUADRUPOLE 'qf'"),
    "overlap": (
        with_element("q: quadrupole, l=0.4, at=2.9;"),
        "'q' begins at 2.700000 m, before the end of 'qd' at 3.100000 m",
    ),
    "beyond": (
        with_element("q: quadrupole, l=0.4, at=5.1;"), "its length ends at 41.600000 m, before"
    ),
    "particle": (
        PLAIN.replace("particle=electron", "particle=pb54"), "particle 'pb54' without a MASS"
    ),
    "word": (PLAIN + "frobnicate, x=1;", "no element or command 'frobnicate' is known"),
    "line": (PLAIN + "qf, k1=1..2;", r"in the statement 'qf, k1=1..2', line \d+ of ring.madx"),
}  # fmt: skip
WARNED = {
    "variable without a value": (
        PLAIN + "qf, k1:=kq + kp; kp = 1;",
        r"kq \(1\) have no value: taken for 0, as by MAD-X",
    ),
    "makethin": (PLAIN + "makethin, sequence=ring;", "MAKETHIN is not carried out"),
    "system": (PLAIN + 'system, "touch x";', "SYSTEM is not run"),
    "thick knl": (PLAIN + "qf, knl={0,0.01};", r"left out.*KNL of the QUADRUPOLE .* of qf \(1\)"),
    "crab cavity": (
        with_element("c: crabcavity, volt=1, at=4.95;"),
        "voltage does in the CRABCAVITY",
    ),
    "decapole": (
        with_element("d: multipole, knl={0,0,0,0,9}, at=4.95;"),
        "above the sextupole of d",
    ),
    "shift in a line": (
        PLAIN + "d1: drift, l=2; own: line=(8*(qf,d1,qd,d1)); qf, dx=1e-3; use, period=own;",
        r"left out.*DX of the QUADRUPOLE \(as in a LINE\) of qf \(1\)",
    ),
    "no value": (PLAIN + "qf, tilt;", "TILT of 'qf' has no value: 0, as in MAD-X"),
    "radiation": (PLAIN.replace("energy=3", "energy=3, radiate"), "RADIATE of BEAM: orbits and"),
    "not defined": (PLAIN + "qx, k1=3; qy->k1 = 2;", r"qx, qy \(2\) are not defined: skipped"),
    "length of a sequence": (PLAIN + "ring, l=43;", "L of the sequence 'ring' stays as defined"),
    # its faces stay parallel here, as in Xsuite
    "rectangular bend of bv": (
        PLAIN.replace("energy=3", "energy=3, bv=-1").replace("bb: sbend", "bb: rbend"),
        r"MAD-X's TWISS gives half the angle in faces \(BV=-1\) of bb \(1\)",
    ),
    "last statement": (PLAIN + "qf, k1=1.05", r"'qf, k1=1.05' \(line \d+ of .*\) has no ';'"),
    "beam of a sequence without an energy": (
        PLAIN + "beam, sequence=ring, charge=-1;",
        "BEAM of the sequence 'ring' states no energy, which is 1 GeV in MAD-X",
    ),
    "mass of a known particle": (
        DECKS["beam mass of a known particle"]["text"],
        "MASS AND CHARGE OF BEAM: those of the proton are taken, as in MAD-X",
    ),
    "two signs of logic": (
        PLAIN + "if (1 == 1 && 2 == 2 && 3 == 3) { qf, k1=0; }",
        r"IF \(1 == 1 && 2 == 2 && 3 == 3\): what stands behind the first && or",
    ),
    "exciter": (with_element("h: hkicker, sinkick=1, at=4.95;"), r"SINKICK of h \(1\)"),
    "attributes in the sequence": (
        PLAIN.replace("qf, at=0.3;", "qf, at=0.3, k1=1.15;"),
        r"left out.*attributes given in the sequence \(as in MAD-X\) of qf \(1\)",
    ),
    "later length": (PLAIN + "qf, l=0.5;", r"left out.*the later L or ANGLE .* of qf \(1\)"),
}


@pytest.mark.parametrize(
    "name", ["sequence as SAVE writes it", "list of a later element", "length of a later value"]
)
def test_what_has_no_effect_is_not_warned_of(tmp_path, name):
    strictly(tmp_path, DECKS[name]["text"].encode())


def test_expressions_of_the_beam_use_the_energy_that_is_given(tmp_path):
    text = PLAIN.split("\n", 1)[1].replace("k1=1.1", "k1:=11/beam->brho")
    ring = read(tmp_path, text, energy=3.0)
    assert ring["qf::0"].k1 == pytest.approx(11 / (3.0 / 0.299792458), rel=1e-6)


@pytest.mark.parametrize("what", REFUSED)
def test_what_would_change_the_ring_is_refused_by_name(tmp_path, what):
    text, message = REFUSED[what]
    with pytest.raises(LatticeError, match=message):
        read(tmp_path, text)


@pytest.mark.parametrize("what", WARNED)
def test_what_is_passed_over_is_named_in_a_warning(tmp_path, what):
    text, message = WARNED[what]
    path = tmp_path / "ring.madx"
    path.write_text(text)
    with pytest.warns(UserWarning, match=message):
        load_ring(path)


@pytest.mark.parametrize(
    "name", ["plain", "rbend", "sbend poles", "sbend k1 k2", "thin bends", "beam beta", "arrow"]
)
def test_chromaticity_is_that_of_madx(tmp_path, name):
    """Per energy, as MAD-X has it; both from maps of second order."""
    deck = DECKS[name]
    ring = read(tmp_path, deck["text"])
    found = off_momentum(Chain.from_ring(ring, 6), ring.length).chromaticity
    np.testing.assert_allclose(found, [deck["dq1"], deck["dq2"]], rtol=0, atol=1e-3)


# --- words of real MAD-X files that AT's reader does not know; referees: OCELOT, the manual -------
BEAM = "beam, particle=electron, energy=3;\n"
D = "d: drift, l=1e-9;\n"


def strictly(folder, text, **options):
    """The ring, without a word of warning."""
    path = folder / "ring.madx"
    path.write_bytes(text if isinstance(text, bytes) else (BEAM + text).encode())
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return load_ring(path, **options)


def matrix(folder, text):
    return ring_matrix(strictly(folder, text))[:4, :4]


def test_edges_that_stand_by_themselves_are_turned_with_their_gap(tmp_path):
    """MAD-X's figures of a `dipedge` are those of two decks, of which none has both."""
    edge = D + "e: dipedge, h=0.2, e1=0.08, hgap=0.03, fint=0.5, tilt={};\nring: line=(e, d);\n"
    flat, upright = (matrix(tmp_path, edge.format(tilt)) for tilt in ("0", "pi/2"))
    np.testing.assert_allclose(upright[[1, 3], [0, 2]], flat[[3, 1], [2, 0]], atol=1e-12)
    assert abs(flat[3, 2]) > 1e-3


STRICT = {  # what each real file had is read without a word, and gives this length
    "collimator, and `none` as a name, PETRA III": (
        "none = 0; c: rcollimator, l:=0.2, xsize:=0.06; e: ecollimator, l:=0;\n"
        "ring: line=(c, e, c);\n", 0.4),
    "rectangular bend without an angle, PS Booster": ("b: rbend, l=1.6; ring: line=(b);\n", 1.6),
    "brackets that are no list, LHC": (
        "a = 0.3; b = 0.1; one := (a/3)*(1-b); two := (a+b); m: multipole, knl:={two};\n"
        "q: drift, l:=one; p: drift, l:=(two); ring: line=(q, p);\n", 0.49),
    "lines that go on as in MAD-8": (
        'a: drift, l=1;\nb: drift, l=2;\nring: line=(a, &\n b, a);\ntitle, "a & b";\n', 4.0),
}  # fmt: skip


@pytest.mark.parametrize("what", STRICT)
def test_words_of_real_files_are_read_in_silence(tmp_path, what):
    text, length = STRICT[what]
    assert strictly(tmp_path, text).length == pytest.approx(length)


def test_brackets_within_a_list(tmp_path):
    thin = matrix(tmp_path, D + "m: multipole, knl:={0, (0.3)*(0.1)};\nring: line=(m, d);\n")
    assert thin[1, 0] == pytest.approx(-0.03)


def test_kinds_of_classes(tmp_path):
    ring = read(tmp_path, with_element(
        "ck: kicker, at=4.9; m2: hmonitor, at=5; screen: instrument, at=5.05; c: rcollimator, "
        "l=0.02, at=5.08; rf: rfcavity, volt=0.1, harmon=8, at=5.1;"))  # fmt: skip
    wanted = {"quadrupole": 16, "bend": 16, "sextupole": 8, "hcorrector": 16, "vcorrector": 16,
              "monitor": 24, "marker": 8, "cavity": 8}  # fmt: skip
    assert {kind: ring.counts()[kind] for kind in wanted} == wanted
    assert (ring["c::0"].kind, ring["sf::0"].k2) == ("drift", 3.0)


PARTS = """d: drift, l=1;
part.1: sequence, l=2; d, at=1; endsequence;
other: sequence, l=2; d, at=1; endsequence;
whole: sequence, l=6; part.1, at=1; other, at=3; d, at=5; endsequence;
"""


def test_the_sequence_that_stands_in_no_other_is_the_ring(tmp_path):
    """PS: 100 units and 10 sectors, with dots in their names."""
    assert strictly(tmp_path, PARTS).length == pytest.approx(6)
    more = PARTS + "second: sequence, l=2; other, at=1; endsequence;\n"
    with pytest.raises(LatticeError, match="has the sequences whole, second; name one"):
        strictly(tmp_path, more)
    assert strictly(tmp_path, more, sequence="part.1").length == pytest.approx(2)
    with pytest.raises(LatticeError, match=r"no sequence in .* named 'secon'; did you mean 'seco"):
        strictly(tmp_path, more, sequence="secon")


@pytest.mark.parametrize("code", ["latin-1", "utf-16", "utf-8-sig"])
@pytest.mark.parametrize("end", ["\r", "\r\n"])
def test_texts_of_other_systems(tmp_path, code, end):
    text = f"{BEAM}! d\xe9fini\na: drift, l=1; // two\nring: line=(2*a);\n".replace("\n", end)
    assert strictly(tmp_path, text.encode(code)).length == pytest.approx(2)
