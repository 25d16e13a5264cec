"""Small decks of MAD-X, one statement, attribute or class each; referee: MAD-X 5.09 itself."""

import json
import warnings
from pathlib import Path

import numpy as np
import pytest

from tmlattice import load_ring
from tmlattice.beam.chain import Chain
from tmlattice.errors import LatticeError
from tmlattice.optics import closed_orbit, off_momentum, twiss

DECKS = json.loads((Path(__file__).parent / "lattices" / "madx_decks.json").read_text())["decks"]


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


def with_element(element):
    return PLAIN.replace("bb, at=4.2;", f"bb, at=4.2; {element}")


REFUSED = {
    "match": (PLAIN + "match, sequence=ring; vary, name=kq; endmatch;", "MATCH changes strengths"),
    "ealign": (PLAIN + "use, sequence=ring; ealign, dx=1e-4;", "EALIGN moves elements"),
    "efcomp": (PLAIN + "efcomp, order=0, dkn={1e-4};", "EFCOMP gives elements field errors"),
    "taper": (PLAIN + "taper, reset;", "TAPER changes strengths along the ring"),
    "setvars_lin": (PLAIN + "setvars_lin, table=t;", "SETVARS_LIN sets variables from a table"),
    "correct": (PLAIN + "correct, flag=ring;", "CORRECT sets correctors"),
    "random": (PLAIN + "qf, k1=1.1 + 1e-3*gauss();", r"GAUSS\(\) is random"),
    "result": (PLAIN + "qf, k1=table(twiss, qf, k1l);", r"TABLE\(\) reads a result"),
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
    "exciter": (with_element("h: hkicker, sinkick=1, at=4.95;"), r"SINKICK of h \(1\)"),
    "later length": (PLAIN + "qf, l=0.5;", r"left out.*the later L or ANGLE .* of qf \(1\)"),
}


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
    "name", ["plain", "rbend", "sbend poles", "thin bends", "beam beta", "arrow"]
)
def test_chromaticity_is_that_of_madx(tmp_path, name):
    """Per energy, as MAD-X has it; both from maps of second order."""
    deck = DECKS[name]
    ring = read(tmp_path, deck["text"])
    found = off_momentum(Chain.from_ring(ring, 6), ring.length).chromaticity
    np.testing.assert_allclose(found, [deck["dq1"], deck["dq2"]], rtol=0, atol=1e-3)
