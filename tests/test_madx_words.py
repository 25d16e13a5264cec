"""Words of real MAD-X files that AT's reader does not know; referees: OCELOT, the manual."""

import warnings

import numpy as np
import pytest
from ocelot.cpbd.elements import Solenoid

from tmlattice import load_ring
from tmlattice.errors import LatticeError
from tmlattice.maps import ring_matrix

BEAM = "beam, particle=electron, energy=3;\n"
D = "d: drift, l=1e-9;\n"


def read(folder, text, **options):
    """The ring, without a word of warning."""
    path = folder / "ring.madx"
    path.write_bytes(text if isinstance(text, bytes) else (BEAM + text).encode())
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return load_ring(path, **options)


def matrix(folder, text):
    return ring_matrix(read(folder, text))[:4, :4]


def test_collimators_are_ways_and_other_words_are_named(tmp_path):
    """PETRA III; it also defines `none`, which AT takes for all that is unknown."""
    text = (
        "none = 0;\nc: {}, l:=0.2, xsize:=0.06;\ne: ecollimator, l:=0;\nq: quadrupole, l=0.5, k1=1;"
        "\nring: sequence, l=2;\nc, at=0.5;\ne, at=1;\nq, at=1.5;\nendsequence;\n"
    )
    ring = read(tmp_path, text.format("rcollimator"))
    assert ring.length == pytest.approx(2)
    assert ring["c"].kind == "drift"
    assert ring["c"].length == pytest.approx(0.2)
    with pytest.raises(LatticeError, match="no element or command 'rcolimator' is known"):
        read(tmp_path, text.format("rcolimator"))


def test_a_solenoid_turns_and_focuses(tmp_path):
    """R12 = sin(KS L) / KS; OCELOT's k is KS / 2."""
    found = matrix(tmp_path, "s: solenoid, l=0.8, ks=0.4;\nring: line=(s);\n")
    assert found[0, 1] == pytest.approx(np.sin(0.32) / 0.4, rel=1e-9)
    np.testing.assert_allclose(found, Solenoid(l=0.8, k=0.2).R(3.0)[0][:4, :4], atol=1e-9)


def test_edges_that_stand_by_themselves_are_those_of_the_bend(tmp_path):
    edges = "e1=0.08, hgap=0.03, fint=0.5"
    whole = matrix(tmp_path, f"b: sbend, l=1, angle=0.2, e2=0.08, {edges};\nring: line=(b);\n")
    bend = f"b: sbend, l=1, angle=0.2;\ne: dipedge, h=0.2, {edges};\n"
    apart = matrix(tmp_path, bend + "ring: line=(e, b, e);\n")
    np.testing.assert_allclose(apart, whole, atol=1e-12)
    assert abs(whole[3, 2]) > 1e-3
    flat, upright = (
        matrix(tmp_path, f"{D}e: dipedge, h=0.2, {edges}, tilt={tilt};\nring: line=(e, d);\n")
        for tilt in ("0", "pi/2")
    )
    np.testing.assert_allclose(upright[[1, 3], [0, 2]], flat[[3, 1], [2, 0]], atol=1e-12)
    # without a gap it is a thin quadrupole, turned the same way
    edge = matrix(tmp_path, f"{D}e: dipedge, h=0.2, e1=0.08, tilt=0.3;\nring: line=(e, d);\n")
    k1 = -0.2 * np.tan(0.08) / 1e-6
    thin = matrix(tmp_path, f"q: quadrupole, l=1e-6, k1={k1}, tilt=0.3;\nring: line=(q);\n")
    np.testing.assert_allclose(edge, thin, atol=2e-6)
    assert abs(thin[1, 2]) > 1e-3


def test_names_without_a_value_are_zero_and_told(tmp_path):
    path = tmp_path / "ring.madx"
    path.write_text(
        BEAM + "q: quadrupole, l=0.5, k1:=kq;\np: quadrupole, l=0.5, k1:=2*kp;\nkp = 1;\n"
        "ring: line=(q, p);\n"
    )
    with pytest.warns(UserWarning, match=r"kq \(1\) have no value: taken for 0, as by MAD-X"):
        ring = load_ring(path)
    assert (ring["q"].k1, ring["p"].k1) == (0.0, 2.0)


def test_a_rectangular_bend_may_have_no_angle(tmp_path):
    """PS Booster: its bends get theirs from a file of strengths."""
    ring = read(tmp_path, "b: rbend, l=1.6;\nring: sequence, l=3;\nb, at=1.5;\nendsequence;\n")
    assert ring["b"].length == pytest.approx(1.6)
    assert ring["b"].angle == 0


PARTS = """d: drift, l=1;
part.1: sequence, l=2; d, at=1; endsequence;
other: sequence, l=2; d, at=1; endsequence;
whole: sequence, l=6; part.1, at=1; other, at=3; d, at=5; endsequence;
"""


def test_the_sequence_that_stands_in_no_other_is_the_ring(tmp_path):
    """PS: 100 units and 10 sectors, with dots in their names."""
    assert read(tmp_path, PARTS).length == pytest.approx(6)
    more = PARTS + "second: sequence, l=2; other, at=1; endsequence;\n"
    with pytest.raises(LatticeError, match="has the sequences whole, second; name one"):
        read(tmp_path, more)
    assert read(tmp_path, more, sequence="part.1").length == pytest.approx(2)


def test_an_expression_in_brackets_is_no_list(tmp_path):
    """LHC: ad34.lr3 := (aip3/3)*(1-r0) was the list of 'aip3/3)*(1-r0'."""
    ring = read(
        tmp_path,
        "a = 0.3; b = 0.1;\none := (a/3)*(1-b);\ntwo := (a+b);\n"
        "q: quadrupole, l=0.5, k1:=one;\np: quadrupole, l=0.5, k1:=(two);\n"
        "m: multipole, knl:={0, (a)*(b)};\nm1: multipole, knl:={two};\nring: line=(q, p, m);\n",
    )
    assert ring["q"].k1 == pytest.approx(0.09)
    assert ring["p"].k1 == pytest.approx(0.4)
    thin = matrix(tmp_path, D + "m: multipole, knl:={0, (0.3)*(0.1)};\nring: line=(m, d);\n")
    assert thin[1, 0] == pytest.approx(-0.03)


def test_lines_may_go_on_as_in_mad_8(tmp_path):
    text = 'a: drift, l=1;\nb: drift, l=2;\nring: line=(a, &\n b, a);\ntitle, "a & b";\n'
    assert read(tmp_path, text).length == pytest.approx(4)


@pytest.mark.parametrize("code", ["latin-1", "utf-16", "utf-8-sig"])
@pytest.mark.parametrize("end", ["\r", "\r\n"])
def test_texts_of_other_systems(tmp_path, code, end):
    text = f"{BEAM}! d\xe9fini\na: drift, l=1; // two\nring: line=(2*a);\n".replace("\n", end)
    assert read(tmp_path, text.encode(code)).length == pytest.approx(2)
