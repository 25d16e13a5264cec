"""Rings as other codes keep them: MAD-X's tables and a line that Xsuite wrote."""

import json
from pathlib import Path

import numpy as np
import pytest
from shared import measured_data

from tmlattice import load_ring
from tmlattice.beam.chain import Chain
from tmlattice.errors import LatticeError
from tmlattice.maps import ring_matrix
from tmlattice.optics import off_momentum, ring_tunes, twiss

MADX = """
beam, particle=proton, energy=26;
qf: quadrupole, l=0.4, k1=0.9;  qd: quadrupole, l=0.4, k1=-0.95;  qs: quadrupole, l=0.2, k1s=0.1;
b:  sbend, l=1.2, angle=2*pi/16, e1=pi/16, e2=pi/16, k1=0.01, hgap=0.02, fint=0.5;
sf: sextupole, l=0.2, k2=6.0;   sd: sextupole, l=0.2, k2=-9.0;
ch: hkicker, l=0.1, kick=1e-5;  cv: vkicker, l=0.1;  ck: kicker, l=0.2;  m1: monitor;
rf: rfcavity, volt=0.1, harmon=8;
ring: sequence, l=64, refer=centre;
%s
endsequence;
"""
CELL = {"m1": 0.1, "qf": 0.5, "sf": 1.0, "ch": 1.3, "b_1": 2.2, "cv": 3.2, "qd": 4.5, "sd": 5.0,
        "b_2": 6.2, "qs": 7.0, "ck": 7.3, "rf": 7.9}  # fmt: skip
COLUMNS = ["NAME", "KEYWORD", "S", "L", "ANGLE", "K0L", "K0SL", "K1L", "K1SL", "K2L", "TILT",
           "E1", "E2", "HGAP", "FINT", "WX", "HKICK", "VKICK", "VOLT", "FREQ"]  # fmt: skip
KEYWORDS = {"bend": "SBEND", "hcorrector": "HKICKER", "vcorrector": "VKICKER",
            "cavity": "RFCAVITY"}  # fmt: skip


@pytest.fixture(scope="module")
def madx(tmp_path_factory):
    path = tmp_path_factory.mktemp("madx") / "ring.seq"
    places = (f"  {k.split('_')[0]}, at={8 * i + at};" for i in range(8) for k, at in CELL.items())
    path.write_text(MADX % "\n".join(places))
    return load_ring(path)


def table(ring, folder, centre=0.0, drop=(), drifts=False, **header):
    """The table that MAD-X's TWISS writes of a ring, with or without drifts."""
    header = {"ENERGY": ring.energy, "MASS": ring.mass, "LENGTH": ring.length, **header}
    kept = [c for c in COLUMNS if c not in drop]
    lines = [f"@ {k} %le {v!r}" for k, v in header.items() if v is not None]
    types = ("%s" if c in kept[:2] else "%le" for c in kept)
    lines += ["* " + " ".join(kept), "$ " + " ".join(types)]
    for e in ring.elements:
        if e.kind == "drift" and not drifts:
            continue
        source = e.source
        row = {
            "NAME": f'"{e.family.upper()}"',
            "KEYWORD": f'"{KEYWORDS.get(e.kind, e.kind.upper())}"',
            "S": e.s + (0.5 - centre) * e.length,
            "L": e.length,
            "ANGLE": e.angle if e.kind == "bend" else 0.0,
            "K0L": e.angle if e.kind == "multipole" else 0.0,
            "K1L": e.k1 * e.length,
            "K2L": e.k2 * e.length,
            "TILT": 0.0 if e.kind == "vcorrector" else e.tilt,  # OCELOT's are turned
            "E1": getattr(source, "e1", 0.0),
            "E2": getattr(source, "e2", 0.0),
            "HGAP": getattr(source, "gap", 0.0) / 2,
            "FINT": getattr(source, "fint", 0.0),
            "HKICK": e.angle if e.kind == "hcorrector" else 0.0,
            "VOLT": 1e3 * getattr(source, "v", 0.0),
            "FREQ": 1e-6 * getattr(source, "freq", 0.0),
        }
        lines.append(" ".join(str(row.get(c, 0.0)) for c in kept))
    path = folder / "twiss.tfs"
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.mark.parametrize("keyword", ["QUADRUPOLE", "SBEND", "SEXTUPOLE", "DRIFT"])
def test_a_row_that_is_gone_of_a_table_with_drifts_is_missed(madx, tmp_path, keyword):
    path = table(madx, tmp_path, drifts=True)
    assert load_ring(path).length == pytest.approx(madx.length)
    lines = path.read_text().splitlines()
    rows = [i for i, line in enumerate(lines) if f'"{keyword}"' in line]
    for i in (rows[0], rows[-1]):
        path.write_text("\n".join([*lines[:i], *lines[i + 1 :], ""]))
        with pytest.raises(LatticeError, match="a row is missing"):
            load_ring(path)


def test_phase_advances_of_the_last_row_stand_for_tunes_of_the_header(madx, tmp_path):
    path = table(madx, tmp_path)
    x, y = ring_tunes(madx)
    lines = path.read_text().splitlines()
    first = next(i for i, line in enumerate(lines) if line.startswith("*"))
    rows = [f"{line} 0.0 0.0" for line in lines[first + 2 : -1]]
    path.write_text("\n".join([
        *lines[:first], f"{lines[first]} MUX MUY", f"{lines[first + 1]} %le %le", *rows,
        f"{lines[-1]} {x} {y}", "",
    ]))  # fmt: skip
    assert load_ring(path).length == pytest.approx(madx.length)
    quadrupole = next(row for row in rows if '"QUADRUPOLE"' in row)
    path.write_text(path.read_text().replace(f"{quadrupole}\n", "", 1))
    with pytest.raises(LatticeError, match="contradicts its header"):
        load_ring(path)


@pytest.mark.parametrize("centre", [0.0, 0.5])
def test_twiss_table_is_the_ring_that_it_is_of(madx, tmp_path, centre):
    ring = load_ring(table(madx, tmp_path, centre))
    assert (ring.energy, ring.mass) == (madx.energy, pytest.approx(madx.mass))
    np.testing.assert_allclose(ring_matrix(ring), ring_matrix(madx), rtol=0, atol=1e-9)
    rings = (ring, madx)
    ours, theirs = (off_momentum(Chain.from_ring(r, 6), r.length).chromaticity for r in rings)
    np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-6)
    for kind in ("quadrupole", "bend", "sextupole", "monitor", "hcorrector", "vcorrector"):
        assert ring.counts()[kind] == madx.counts()[kind], kind
    places = {e.name: e.s for e in ring.elements}
    for e in madx.elements:
        if e.kind not in ("drift", "marker"):
            assert places[e.name] == pytest.approx(e.s, abs=1e-9)
    assert ring["ch::3"].angle == 1e-5
    assert ring["rf::0"].source.v == pytest.approx(1e-4)


def test_rectangular_bends_have_their_edges(madx, tmp_path):
    path = table(madx, tmp_path, drop=("E1", "E2"))
    path.write_text(path.read_text().replace('"SBEND"', '"RBEND"'))
    np.testing.assert_allclose(
        ring_matrix(load_ring(path)), ring_matrix(madx), rtol=0, atol=1e-9
    )  # pi / 16 is half the angle


def stated(ring):
    """What MAD-X's header would state of a ring."""
    q1, q2 = twiss(Chain.from_ring(ring)).total_tunes
    effects = off_momentum(Chain.from_ring(ring, 6), ring.length)
    dq1, dq2 = effects.chromaticity
    alfa = ring.beta**2 * effects.momentum_compaction + ring.gamma**-2
    own = {"Q1": q1, "Q2": q2, "DQ1": dq1, "DQ2": dq2, "ALFA": alfa}
    return {key: float(value) for key, value in own.items()}


def test_header_decides_whether_rbend_edges_hold_half_the_angle(madx, tmp_path):
    """MAD-X 5.09 writes whole angles, earlier versions what the RBEND's E1 was."""
    header = stated(madx)
    path = table(madx, tmp_path, **header)
    path.write_text(path.read_text().replace('"SBEND"', '"RBEND"'))
    np.testing.assert_allclose(ring_matrix(load_ring(path)), ring_matrix(madx), rtol=0, atol=1e-9)
    half = str(np.pi / 16)
    path.write_text(path.read_text().replace(half, "0.0"))
    np.testing.assert_allclose(ring_matrix(load_ring(path)), ring_matrix(madx), rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("gone", "message"),
    [
        ("QF", "its tunes are .* the header states|its motion is unstable"),
        ("SD", "its chromaticities are .* the header states"),
        ("B", "its tunes are .* the header states|its motion is unstable"),
    ],
)
def test_table_without_a_row_contradicts_its_header(madx, tmp_path, gone, message):
    path = table(madx, tmp_path, **stated(madx))
    rows = path.read_text().splitlines()
    first = next(i for i, row in enumerate(rows) if row.startswith(f'"{gone}"'))
    path.write_text("\n".join([*rows[:first], *rows[first + 1 :]]) + "\n")
    with pytest.raises(LatticeError, match=f"contradicts its header: (?:{message})"):
        load_ring(path)


def test_header_that_states_other_figures_is_a_contradiction(madx, tmp_path):
    right = stated(madx)
    load_ring(table(madx, tmp_path, **right))
    for key, by in (("Q1", 0.01), ("DQ2", 6.0), ("ALFA", right["ALFA"] / 10), ("LENGTH", 0.1)):
        header = {**right, "LENGTH": madx.length}
        wrong = table(madx, tmp_path, **{**header, key: header[key] + by})
        with pytest.raises(LatticeError, match="contradicts its header"):
            load_ring(wrong)


def test_figures_that_other_models_and_cavities_change_are_no_contradiction(madx, tmp_path):
    """PTC may leave out products of curvature and gradient; with RF on MAD-X's ALFA is another, and
    so may be its chromaticity, by CHROM."""
    right = stated(madx)
    load_ring(table(madx, tmp_path, drop=("WX",), **{**right, "DQ2": right["DQ2"] + 6.0}))
    path = table(madx, tmp_path, **{**right, "DQ2": right["DQ2"] + 6.0})
    path.write_text('@ NAME %s "PTC_TWISS"\n' + path.read_text())
    load_ring(path)
    load_ring(table(madx, tmp_path, **{**right, "ALFA": 0.97 * right["ALFA"]}))


DECKS = json.loads((Path(__file__).parent / "lattices" / "madx_decks.json").read_text())["decks"]


@pytest.mark.parametrize(
    ("name", "radius"), [("thin bends", "2.54648"), ("thin bends no lrad", "")]
)
def test_thin_bends_without_a_length_have_that_of_the_headers_tunes(
    tmp_path, name, radius, recwarn
):
    deck = DECKS[name]
    (tmp_path / "ring.madx").write_text(deck["text"])
    header = {"Q1": deck["q1"], "Q2": deck["q2"], "ALFA": deck["alfa"]}
    path = table(load_ring(tmp_path / "ring.madx"), tmp_path, **header)
    ring = load_ring(path)
    own = [str(w.message) for w in recwarn if "no column LRAD" in str(w.message)]
    assert [radius in text for text in own] == ([True] if radius else [])
    tunes = twiss(Chain.from_ring(ring)).total_tunes
    np.testing.assert_allclose(tunes, [deck["q1"], deck["q2"]], rtol=0, atol=2e-6)


def test_table_off_momentum_is_of_the_same_ring(madx, tmp_path):
    load_ring(table(madx, tmp_path, DELTAP=1e-3, XCOMAX=2e-3, Q1=0.1, Q2=0.2))


def test_a_cavity_without_its_voltage_may_be_on(madx, tmp_path):
    x, y = ring_tunes(madx)
    path = table(madx, tmp_path, drop=("VOLT",), Q1=x + 5e-4, Q2=y)
    assert load_ring(path).counts()["cavity"] == 8
    path.write_text(path.read_text().replace('"RFCAVITY"', '"MARKER"'))
    with pytest.raises(LatticeError, match="its tunes are"):
        load_ring(path)


@pytest.mark.parametrize(
    ("old", "new", "drop", "message"),
    [
        ('"QUADRUPOLE"', '"SOLENOID"', (), "SOLENOID 'QF' and no column KS or KSI"),
        ('"QF"', '"QF"', ("K1L",), "QUADRUPOLE 'QF' and no column K1L"),
        ('"MONITOR"', '"DIPEDGE"', ("E1",), "DIPEDGE 'm1' without its H"),
    ],
)
def test_fields_that_a_table_lacks_are_named(madx, tmp_path, old, new, drop, message):
    path = table(madx, tmp_path, drop=drop)
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises(LatticeError, match=message):
        load_ring(path)


def test_header_states_the_particle_by_its_name_and_the_energy_by_its_momentum(madx, tmp_path):
    momentum = float(np.sqrt(madx.energy**2 - madx.mass**2))
    path = table(madx, tmp_path, ENERGY=None, MASS=None, PARTICLE="PROTON", PC=momentum)
    path.write_text(path.read_text().replace("PARTICLE %le 'PROTON'", 'PARTICLE %06s "PROTON"'))
    ring = load_ring(path)
    assert (ring.mass, ring.energy) == pytest.approx((madx.mass, madx.energy))
    path.write_text(path.read_text().replace("PROTON", "PB54"))
    with pytest.raises(LatticeError, match="particle 'pb54' without a MASS"):
        load_ring(path)


def test_tables_that_say_too_little(madx, tmp_path):
    with pytest.raises(LatticeError, match=r"no column L; write the table with .*k1l"):
        load_ring(table(madx, tmp_path, drop=("L",)))
    with pytest.raises(LatticeError, match="states no ENERGY; give energy="):
        load_ring(table(madx, tmp_path, ENERGY=None))
    path = table(madx, tmp_path)
    lines = path.read_text().splitlines()
    path.write_text("\n".join(lines[:8] + lines[20:22] + lines[8:20]) + "\n")
    with pytest.raises(LatticeError, match="elements that overlap"):
        load_ring(path)
    path = table(madx, tmp_path)
    *head, last = path.read_text().splitlines()
    path.write_text("\n".join([*head, "nan".join(last.rsplit(last.split()[-1], 1))]) + "\n")
    with pytest.raises(LatticeError, match=r"no number in the column \w+ of "):
        load_ring(path)
    path.write_text("@ nothing\n")
    with pytest.raises(LatticeError, match="cannot be read as a table of MAD-X"):
        load_ring(path)


def test_sps_has_the_optics_that_its_header_states():
    path = measured_data("real_rings", "sps", "twiss_elements.dat")
    ring = load_ring(path)
    header = dict(line.split()[1::2] for line in path.read_text().splitlines() if line[0] == "@"
                  and line.split()[2] == "%le")  # fmt: skip
    stated = {key: float(value) for key, value in header.items()}
    functions = twiss(Chain.from_ring(ring))
    tunes = [stated["Q1"], stated["Q2"]]
    np.testing.assert_allclose(functions.total_tunes, tunes, rtol=0, atol=1e-6)
    np.testing.assert_allclose(functions.beta.max(0)[0], stated["BETXMAX"], rtol=1e-3)
    effects = off_momentum(Chain.from_ring(ring, 6), ring.length)
    # MAD-X's own chromaticity is of the same second-order maps
    chromaticity = [stated["DQ1"], stated["DQ2"]]
    np.testing.assert_allclose(effects.chromaticity, chromaticity, rtol=0, atol=2e-3)
    assert effects.momentum_compaction == pytest.approx(stated["ALFA"], rel=2e-4)
    assert ring.length == pytest.approx(stated["LENGTH"], abs=1e-6)


XSUITE = Path(__file__).parent / "lattices" / "xtrack_line.json"
TUNES = [2.9958360, 3.8039423]
CHROMATICITY = [12.244, 13.850]


def test_line_of_xsuite_has_xsuites_tunes():
    """Referee: the 4d twiss of xtrack 0.118.4, which wrote the file."""
    ring = load_ring(XSUITE)
    assert ring.energy == pytest.approx(3.0, rel=1e-6)
    counts = ring.counts()
    assert (counts["quadrupole"], counts["bend"], counts["sextupole"]) == (32, 32, 32)
    found = twiss(Chain.from_ring(ring)).total_tunes
    np.testing.assert_allclose(found, TUNES, rtol=0, atol=2e-5)  # xtrack cuts magnets into kicks
    slopes = off_momentum(Chain.from_ring(ring, 6), ring.length).chromaticity
    np.testing.assert_allclose(slopes, CHROMATICITY, rtol=5e-3)  # a slope over a finite step
    marked = load_ring(XSUITE, monitors="bpm")
    assert len(marked.monitors) == 32


def test_orbit_that_nothing_in_a_table_makes_is_a_contradiction(madx, tmp_path):
    """Misaligned magnets bend the orbit, and no column of a table has them."""
    straight = load_ring(table(madx, tmp_path))
    path = table(madx, tmp_path, XCOMAX=6e-5)
    assert load_ring(path).elements == straight.elements  # its correctors make this orbit
    path = table(madx, tmp_path, XCOMAX=1e-3)
    with pytest.raises(LatticeError, match=r"orbit is 0.0612 mm at most, the table has 1 mm"):
        load_ring(path)
    path.write_text(path.read_text().replace("1e-05", "0.0"))
    with pytest.raises(
        LatticeError, match="nothing in it bends the orbit, the table has one of 1 mm"
    ):
        load_ring(path)
