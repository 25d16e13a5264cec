"""A proton ring: its particles are slower than light, and differ in velocity."""

import json
from dataclasses import replace

import at
import numpy as np
import pytest
from command import tmlattice

from tmlattice import load_ring
from tmlattice.beam.chain import Chain
from tmlattice.errors import LatticeError, UnknownNameError
from tmlattice.lattice import save_ring
from tmlattice.lattice.ring import ELECTRON_GEV, PROTON_GEV
from tmlattice.machine.at_engine import AtEngine
from tmlattice.machine.ocelot_engine import OcelotEngine
from tmlattice.machine.response import simulate_response
from tmlattice.optics import off_momentum

MADX = """
! sixteen cells; transition at gamma = 4.1
qf: quadrupole, l=0.4, k1=0.9;  qd: quadrupole, l=0.4, k1=-0.95;
b:  sbend, l=1.2, angle=2*pi/32;
sf: sextupole, l=0.2, k2=4.0;   sd: sextupole, l=0.2, k2=-6.0;
ch: hkicker, l=0.1;  cv: vkicker, l=0.1;  m1: monitor;  rf: rfcavity, volt=4, harmon=8;
beam, particle=proton, energy={energy};
ring: sequence, l=128, refer=centre;
{places}
endsequence;
"""
CELL = {"m1": 0.1, "qf": 0.5, "sf": 1.0, "ch": 1.3, "b_1": 2.2, "cv": 3.2, "qd": 4.5, "sd": 5.0,
        "b_2": 6.2}  # fmt: skip
ENERGY = 12.0


def read(folder, energy):
    places = [f"  {k.split('_')[0]}, at={8 * i + at};" for i in range(16) for k, at in CELL.items()]
    path = folder / "protons.seq"
    path.write_text(MADX.format(energy=energy, places="\n".join([*places, "rf, at=127.9;"])))
    return load_ring(path)


@pytest.fixture(scope="module")
def ring(tmp_path_factory):
    return read(tmp_path_factory.mktemp("protons"), ENERGY)


def test_the_beam_statement_says_the_particle(ring, tmp_path):
    assert ring.mass == pytest.approx(PROTON_GEV, rel=1e-7)
    assert ring.gamma == pytest.approx(ENERGY / 0.938272, rel=1e-6)
    assert ring.beta == pytest.approx(np.sqrt(1 - (0.938272 / ENERGY) ** 2), rel=1e-9)
    save_ring(ring, tmp_path / "ring.json")
    again = load_ring(tmp_path / "ring.json")
    assert (again.mass, again.elements) == (ring.mass, ring.elements)
    with pytest.raises(LatticeError, match=r"0.5 GeV, which is not above .* rest energy of 0.938"):
        load_ring(tmp_path / "ring.json", energy=0.5)


def test_slower_particles_come_late(ring):
    """The time of a turn against momentum: momentum compaction less 1 / gamma^2."""
    fast = replace(ring, energy=120.0)  # the same magnets, ten times as fast
    for own in (ring, fast):
        engine = AtEngine(own)
        response = simulate_response(own, correctors=["ch::0"], progress=False, noise=0.0).measured
        maps = simulate_response(
            own, correctors=["ch::0"], progress=False, noise=0.0, engine="ocelot",
            rf_step=response.rf.step,
        ).measured  # fmt: skip
        np.testing.assert_allclose(maps.rf.orbit, response.rf.orbit, rtol=0, atol=3e-6)
        np.testing.assert_allclose(maps.response, response.response, rtol=0, atol=2e-7)
        effects = off_momentum(Chain.from_ring(own, 6), own.length)
        dispersion = engine_dispersion(engine)
        delta = response.rf.orbit[:, 0] @ dispersion / (dispersion @ dispersion)
        lag = -response.rf.step / response.rf.frequency / delta
        path = at_compaction(engine)
        assert lag == pytest.approx(path - 1 / own.gamma**2, rel=2e-3)
        # that of the optics is of c T and per energy, dE / (p0 c) = beta delta
        assert own.beta**2 * effects.momentum_compaction == pytest.approx(lag, rel=2e-3)


def engine_dispersion(engine):
    lattice = engine.lattice()
    monitors = at.get_refpts(lattice, at.Monitor)
    return at.find_orbit4(lattice, 1e-4, monitors)[1][:, 0] / 1e-4


def at_compaction(engine):
    line = [e for e in engine.lattice() if e.FamName != "velocity"]
    return at.get_mcf(at.Lattice(line, energy=1e9), DPStep=2e-4)


@pytest.mark.parametrize("energy", [ENERGY, 2.5])
def test_many_turns_with_the_cavity_are_stable_above_and_below_transition(ring, energy):
    launches = np.zeros((2, 6))
    launches[0, 0], launches[1, 5] = 1e-4, 1e-4
    own = replace(ring, energy=energy)
    a, b = (engine(own).track(launches, 200) for engine in (AtEngine, OcelotEngine))
    np.testing.assert_allclose(a, b, rtol=0, atol=2e-6)
    # an energy off by 1e-4 swings: over the turns it comes back from the other side
    orbit = b[1, :, :, 0].mean(axis=1)
    assert orbit.min() < -0.5 * orbit.max() < 0
    assert np.abs(orbit).max() < 1.5 * np.abs(orbit[:5]).max()


def test_info_is_per_momentum_and_of_the_path(ring, tmp_path):
    save_ring(ring, tmp_path / "ring.json")
    tmlattice("info", "ring.json", "--json", "info.json", cwd=tmp_path, check=0)
    facts = json.loads((tmp_path / "info.json").read_text())
    engine = AtEngine(ring)
    assert facts["momentum_compaction"] == pytest.approx(at_compaction(engine), rel=2e-3)
    assert facts["mass_gev"] == ring.mass
    lattice = engine.lattice()
    exits = at.get_refpts(lattice, "qf::*") + 1
    up, down = (at.find_orbit4(lattice, delta, exits)[1][:, 0] for delta in (1e-4, -1e-4))
    assert facts["dispersion_max"][0] == pytest.approx((up - down).max() / 2e-4, rel=1e-3)


def test_the_particle_may_be_said(ring, tmp_path):
    silent = replace(ring, mass=ELECTRON_GEV)
    save_ring(silent, tmp_path / "ring.json")
    assert load_ring(tmp_path / "ring.json").mass == ELECTRON_GEV
    for more, mass in (([], ELECTRON_GEV), (["--particle", "proton"], PROTON_GEV)):
        tmlattice("init", "ring.json", *more, "--force", cwd=tmp_path, check=0)
        done = tmlattice("info", "--json", "info.json", cwd=tmp_path, check=0)
        assert ("particles of 0.938272 GeV" in " ".join(done.stdout.split())) == bool(more)
        assert json.loads((tmp_path / "info.json").read_text())["mass_gev"] == mass
    with pytest.raises(UnknownNameError, match="no particle 'prton'; did you mean 'proton'"):
        load_ring(tmp_path / "ring.json", particle="prton")


def test_protons_do_not_radiate(ring):
    with pytest.raises(LatticeError, match="too heavy to radiate"):
        AtEngine(ring, radiation_bends=1.0)
