"""Rings in the formats of other codes: what is read back is the ring that was written."""

import json
import warnings
from dataclasses import replace

import numpy as np
import pytest
from command import tmlattice
from conftest import SMALL

from tmlattice import Cause, load_ring, simulate
from tmlattice.beam.chain import Chain
from tmlattice.effects import apply
from tmlattice.errors import LatticeError
from tmlattice.lattice import save_ring
from tmlattice.lattice.ring import PROTON_GEV
from tmlattice.machine.response import simulate_response
from tmlattice.measurement import write_measurement
from tmlattice.optics import ring_tunes

FORMATS = ("ring.json", "ring.at.json", "ring.xsuite.json", "ring.madx", "ring.seq", "ring.py")
NUMBERED = (".xsuite.json", ".madx", ".seq")
"""Formats of definitions, in which members of a family that differ have names of their own."""
FOREIGN = FORMATS[1:]


def names(ring):
    return [element.name.casefold().replace("..", "::") for element in ring.elements]


@pytest.fixture(scope="module")
def uneven(small_ring):
    """With a magnet of its own strength, a tilt, a cavity's worth of everything that is written."""
    ring = small_ring.with_changed("QD::5", k1=-0.85).with_changed("sd::3", tilt=0.2)
    return ring.with_changed("v3", angle=1e-4)


@pytest.mark.parametrize("file", FORMATS)
def test_ring_that_is_read_back_has_the_same_maps(uneven, file, tmp_path):
    assert save_ring(uneven, tmp_path / file) == () or file.endswith(NUMBERED)
    back = load_ring(tmp_path / file)
    assert back.energy == uneven.energy
    assert [e.kind for e in back.elements] == [e.kind for e in uneven.elements]
    drifts = np.array([e.kind == "drift" for e in uneven.elements])  # MAD-X numbers definitions
    assert (np.array(names(back)) == np.array(names(uneven)))[~drifts].all()
    # numbers are written to their last digit; tilts and matrices are turned there and back
    assert ring_tunes(back) == pytest.approx(ring_tunes(uneven), abs=1e-12)
    launch = [[1e-3, 1e-4, -5e-4, 2e-4, 0.0, 1e-3]]
    turns = [Chain.from_ring(ring, 6).track(launch, 1)[0, 1] for ring in (uneven, back)]
    assert turns[1][:4] == pytest.approx(turns[0][:4], abs=1e-13)


@pytest.mark.parametrize("file", FORMATS)
def test_protons_are_as_fast_in_the_file(small_ring, file, tmp_path):
    ring = replace(small_ring, mass=PROTON_GEV)
    save_ring(ring, tmp_path / file)
    back = load_ring(tmp_path / file)
    # OCELOT's maps are told the energy of an electron that is as fast
    assert back.map_energy == pytest.approx(ring.map_energy, rel=1e-12)
    assert file.endswith(".py") or back.mass == pytest.approx(PROTON_GEV, rel=1e-9)


@pytest.fixture(scope="module")
def thin(tmp_path_factory):
    """A ring of thin bends, upright and in the vertical plane, with gradients on them."""
    path = tmp_path_factory.mktemp("thin") / "thin.madx"
    cells = "".join(
        f"qf, at={5 * k + 0.5}; bb, at={5 * k + 1.5}; mq, at={5 * k + 2}; qd, at={5 * k + 3};"
        f" ch, at={5 * k + 3.5}; bb, at={5 * k + 4};\n"
        for k in range(8)
    )
    path.write_text(
        "beam, particle=proton, energy=3; mq: monitor; ch: hkicker; vv: multipole, ksl={1e-3};\n"
        "qf: quadrupole, l=0.4, k1=1.1; qd: quadrupole, l=0.4, k1=-1.15;\n"
        "bb: multipole, knl={twopi/16, 0.01}, lrad=1;\n"
        f"ring: sequence, l=40, refer=centre;\n{cells}vv, at=39.5;\nendsequence;\n"
    )
    with pytest.warns(UserWarning, match="products of curvature and gradient of bb"):
        return load_ring(path)


@pytest.mark.parametrize("file", FORMATS)
def test_thin_bends_are_written(thin, file, tmp_path):
    save_ring(thin, tmp_path / file)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        back = load_ring(tmp_path / file)
    assert ring_tunes(back) == pytest.approx(ring_tunes(thin), abs=1e-9)
    assert back.length == pytest.approx(thin.length)


def test_at_engine_and_maps_bend_a_thin_ring_alike(thin):
    """The response to a corrector, whose path length shifts the energy by a thin bend's R51."""
    made = [
        simulate_response(thin, correctors=["ch::0"], progress=False, noise=0.0, engine=engine)
        for engine in ("at", "ocelot")
    ]
    first, second = (response.measured.response for response in made)
    np.testing.assert_allclose(first, second, rtol=0, atol=1e-6 + 2e-3 * abs(first).max())


WRITTEN = {  # where orbits are compared: formats make two elements of a wiggler with fields
    "fields": ([-1], 1e-6, [
        Cause("quadrupole_roll", "QF::3", 0.01),
        Cause("corrector_kick_x", "v3", 2e-5),
        Cause("corrector_kick_y", "v7", -3e-5),
        Cause("insertion_device_focusing", "wig_1", 3e-3),
        Cause("skew_gradient", "wig_1", 2e-3),
    ]),
    "misalignments": (slice(None), 1e-4, [
        Cause("quadrupole_offset_x", "QF::3", 1e-4),
        Cause("quadrupole_offset_y", "QD::7", -2e-4),
        Cause("sextupole_offset_x", "sf::6", 5e-4),
    ]),
}  # fmt: skip


@pytest.mark.parametrize("file", FOREIGN)
@pytest.mark.parametrize("what", WRITTEN)
def test_errors_that_a_format_can_say_are_written(small_ring, what, file, tmp_path):
    places, least, causes = WRITTEN[what]
    ring = apply(small_ring, causes)
    save_ring(ring, tmp_path / file)
    back = load_ring(tmp_path / file)
    assert ring_tunes(back) == pytest.approx(ring_tunes(ring), abs=1e-9)
    orbits = [Chain.from_ring(r).closed_orbit()[0][places] for r in (ring, back)]
    assert np.abs(orbits[0]).max(0)[[0, 2]].min() > least
    np.testing.assert_allclose(orbits[1], orbits[0], rtol=0, atol=1e-12)


@pytest.mark.parametrize("file", FOREIGN)
def test_errors_that_a_format_has_no_place_for_are_told(small_ring, file, tmp_path):
    causes = [Cause("corrector_position", "v5", 0.02), Cause("gradient_absolute", "QD::5", 4e-3)]
    told = save_ring(apply(small_ring, causes), tmp_path / file)
    assert any("ds of v5 cannot be written" in sentence for sentence in told)
    assert any("thin gradients in the middle of QD::5" in sentence for sentence in told)
    back = load_ring(tmp_path / file)
    magnet = small_ring["QD::5"]
    name = "qd..5" if file.endswith(NUMBERED) else "QD::5"
    assert back[name].k1 == pytest.approx(magnet.k1 + 4e-3 / magnet.length)
    assert save_ring(apply(small_ring, causes), tmp_path / "own.json") == ()
    assert load_ring(tmp_path / "own.json")["v5"].errors.ds == 0.02


def test_skew_gradient_of_a_quadrupole_is_written_as_its_tilt(small_ring, tmp_path):
    """In magnets that stand upright, in one that is tilted, and in one that has no field."""
    ring = small_ring.with_changed("QF::7", tilt=0.3).with_changed("QD::9", k1=0.0)
    causes = [Cause("skew_gradient", name, 1e-4) for name in ("QF::3", "QD::5", "QF::7", "QD::9")]
    causes.append(Cause("gradient_absolute", "QF::7", 2e-4))
    faulty = apply(ring, causes)
    (told,) = save_ring(faulty, tmp_path / "ring.at.json")
    assert "QF::3, QD::5, QF::7, QD::9 are written as fields of their bodies" in told
    back = load_ring(tmp_path / "ring.at.json")
    turns = [Chain.from_ring(r).one_turn_map()[1] for r in (ring, faulty, back)]
    # thin and thick differ to second order in the length of a magnet
    assert np.abs(turns[2] - turns[1]).max() < 0.1 * np.abs(turns[1] - turns[0]).max()


def test_name_of_no_format_is_refused_before_anything_is_written(small_ring, tmp_path):
    with pytest.raises(LatticeError, match=r"\.at\.json"):
        save_ring(small_ring, tmp_path / "ring.txt")
    assert list(tmp_path.iterdir()) == []


def test_diagnose_writes_the_ring_as_found_and_repaired(small_ring, tmp_path):
    """The repaired ring's settings on the machine as found give the design's tunes."""
    fault = Cause("quadrupole_gradient", "QD::5", -0.05)
    roll = Cause("quadrupole_roll", "QF::11", 0.02)
    data = simulate(
        small_ring, [fault, roll], shots=4, seed=1, amplitude=3e-4, noise=2e-6
    ).measurement()
    write_measurement(tmp_path / "m", data)
    done = tmlattice(
        "diagnose", SMALL, tmp_path / "m", "--lattice-out", "found.at.json", "--corrected-out",
        "set.py", "--json", "a.json", cwd=tmp_path, check=0,
    )  # fmt: skip
    assert "turn QF::11 upright" in done.stdout.split("written:")[1]
    design = small_ring["QD::5"].k1
    found, settings = load_ring(tmp_path / "found.at.json"), load_ring(tmp_path / "set.py")
    told = {f["element"]: f for f in json.loads((tmp_path / "a.json").read_text())["findings"]}
    a = told["QD::5"]["amount"]
    assert found["QD::5"].k1 == pytest.approx((1 + a) * design)
    assert settings["QD::5"].k1 == pytest.approx(design / (1 + a))
    assert settings["QF::11"].tilt == 0.0
    there = apply(settings, [Cause("quadrupole_gradient", "QD::5", a)])
    assert ring_tunes(there) == pytest.approx(ring_tunes(small_ring), abs=1e-9)


def test_suffix_without_a_format_is_refused_before_the_work(tmp_path):
    done = tmlattice(
        "diagnose", SMALL, tmp_path, "--corrected-out", "ring.lte", cwd=tmp_path, check=2
    )
    assert done.stderr
