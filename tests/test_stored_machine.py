"""Turns, closed orbits, dispersion, tunes of the virtual machine against AT's own tools."""

import at
import numpy as np
import pytest
from command import refused, tmlattice
from conftest import SMALL
from numpy.testing import assert_allclose
from test_spectra import pulls

from tests.scenarios import ring_of
from tmlattice import Cause, read_measurement
from tmlattice.errors import LatticeError, TmlatticeError, UnstableRingError
from tmlattice.machine.at_engine import AtEngine
from tmlattice.machine.response import simulate_response
from tmlattice.machine.stored_beam import (
    simulate_dispersion,
    simulate_orbits,
    simulate_tunes,
    simulate_turns,
)
from tmlattice.measurement import (
    ClosedOrbit,
    Dispersion,
    OrbitResponse,
    TuneReading,
    TurnByTurn,
    read_truth,
)
from tmlattice.observe.spectra import lines

CAUSES = [
    Cause("quadrupole_gradient", "QF::2", 0.02),
    Cause("quadrupole_roll", "QD::3", 0.02),
    Cause("quadrupole_offset_x", "QF::1", 2e-4),
]
UPRIGHT = CAUSES[:2]
"""Without a change of the orbit, and so of the energy: those matrices are at the design's."""
FREQUENCY = {"rf": {"frequency_relative": 1e-5}}


def tiny_ring(*edits):
    """Six of the small ring's cells, 1 GeV, with weak sextupoles: chromaticities 6 and 3."""
    tiny = (("cells = 16", "cells = 6"), ("energy = 3.0", "energy = 1.0"), ("k2=6.0", "k2=1.5"),
            ("k2=-9.0", "k2=-1.5"))  # fmt: skip
    return ring_of("small", (*tiny, *edits))


@pytest.fixture(scope="module")
def tiny():
    return tiny_ring()


@pytest.fixture(scope="module")
def with_cavity():
    cavity = "ring = [\n    Cavity(l=0.3, v=2e-4, freq=5e8, eid='first'),\n"
    return tiny_ring(("ring = [\n", cavity))


def at_modes(ring, causes=()):
    """Vectors of the modes at the monitors [monitor, plane, mode], and tunes, by AT's matrices."""
    lattice = AtEngine(ring, causes).lattice()
    monitors = [i for i, e in enumerate(lattice) if isinstance(e, at.Monitor)]
    turn, there = at.find_m44(lattice, 0.0, refpts=monitors, XYStep=3e-6)
    directions, eigenvalues = at.a_matrix(turn)
    vectors = directions[:, 0::2] + 1j * directions[:, 1::2]
    tunes = np.angle(eigenvalues) / (2 * np.pi) % 1
    return (there @ vectors)[:, [0, 2]], tunes


def places(ring):
    return np.array([m.s for m in ring.monitors]) / ring.length


def test_lines_of_a_small_kick_are_at_modes(tiny):
    """A micrometre: what is not linear is a thousandth of the noise of 0.01 nm."""
    vectors, tunes = at_modes(tiny, UPRIGHT)
    simulation = simulate_turns(tiny, UPRIGHT, turns=200, amplitude=1e-6, noise=1e-11)
    found = lines(simulation.measured, near=tunes, at=places(tiny))
    assert found.warnings == ()
    assert_allclose(found.tune[0], tunes, atol=1e-7)
    off = pulls(found, vectors[None])
    assert 0.7 < np.sqrt(np.mean(off**2)) < 1.3  # 120 numbers
    assert np.abs(off).max() < 5


def test_lines_of_a_thousand_particles_that_decohere_are_at_modes(tiny):
    """Chromaticity 6 and detuning undo the beam in 30 turns: ratios of monitors stay."""
    vectors, tunes = at_modes(tiny, UPRIGHT)
    simulation = simulate_turns(
        tiny, UPRIGHT, turns=64, amplitude=5e-4, particles=1000, spread=1e-3,
        emittance=(1e-8, 1e-9), noise=1e-5, seed=2,
    )  # fmt: skip
    found = lines(simulation.measured, near=tunes, at=places(tiny))
    size = np.abs(found.envelope[0])
    assert size[0, 30:].mean() < 0.5 * size[0, :5].mean()  # it does decohere
    off = pulls(found, vectors[None])
    assert np.sqrt(np.mean(off**2)) < 1.4
    assert np.abs(off).max() < 5
    assert_allclose(found.tune[0], tunes, atol=3e-3)  # of the beam, not of its middle


@pytest.mark.parametrize("cavity", [False, True])
def test_a_beam_in_the_network_decoheres_as_in_at(tiny, with_cavity, cavity):
    """With the cavity at a turn's end other particles are ahead: the spread is small there."""
    options = {"turns": 64, "amplitude": 3e-4, "particles": 300, "noise": 0.0, "seed": 2}
    options |= {"emittance": (1e-9, 1e-10), "spread": 1e-5 if cavity else 1e-3}
    by_at, by_network = (
        simulate_turns(with_cavity if cavity else tiny, UPRIGHT, engine=engine, **options)
        for engine in ("at", "network")
    )
    expected, got = by_at.measured.readings[0], by_network.measured.readings[0]
    if not cavity:
        assert expected[40:].std() < 0.6 * expected[:5].std()  # it does decohere
    assert np.sqrt(np.mean((got - expected) ** 2)) < 0.02 * expected[:20].std()


def test_what_the_network_does_not_have_is_refused(tiny):
    for options, message in (
        ({"radiation": True}, "no radiation; take the engine 'at'"),
        ({"settings": [FREQUENCY]}, "no settings; take the engine 'at'"),
        ({"causes": [Cause("radiation_loss_bends", None, 1.0)]}, "no radiation"),
    ):
        with pytest.raises(TmlatticeError, match=message):
            simulate_turns(tiny, **options, engine="network", turns=20)
    with pytest.raises(TmlatticeError, match="no engine 'ocelot'; there are at and network"):
        simulate_turns(tiny, engine="ocelot", turns=20)


@pytest.mark.parametrize("radiation", [False, True])
@pytest.mark.parametrize("settings", [{}, FREQUENCY])
def test_beam_that_is_not_kicked_stays_on_the_closed_orbit(with_cavity, settings, radiation):
    options = {"noise": 0.0, "settings": [settings], "radiation": radiation}
    turns = simulate_turns(with_cavity, CAUSES, turns=50, kick=(0.0, 0.0), **options).measured
    orbit = simulate_orbits(with_cavity, CAUSES, **options).measured
    assert np.abs(orbit.orbit).max() > 1e-4
    assert np.ptp(turns.readings[0], axis=0).max() < 1e-10
    # the loss is made good at the cavity, and at the end: a nanometre
    assert_allclose(turns.readings[0, 0], orbit.orbit[0], rtol=0, atol=2e-9)


def test_many_particles_keep_their_middle_and_fill_their_emittance(with_cavity):
    """Within the bucket the middle of 300 particles moves by their non-linearity alone."""
    still = simulate_turns(
        with_cavity, turns=40, kick=(0.0, 0.0), particles=300, spread=2e-5,
        emittance=(1e-10, 1e-11), noise=0.0,
    ).measured  # fmt: skip
    assert np.abs(still.readings).max() < 3e-7  # the beam is 30 to 40 um wide


def test_orbit_of_the_machine_is_read_with_its_monitors(tiny):
    wrong = [*CAUSES, Cause("monitor_offset_x", "end_2", 1e-3), Cause("monitor_dead", "end_3", 1)]
    clean = simulate_orbits(tiny, CAUSES, noise=0.0).measured
    read = simulate_orbits(tiny, wrong, noise=(2e-6, 1e-6), shots=400, seed=1).measured
    at_2, at_3 = (clean.monitors.index(name) for name in ("end_2", "end_3"))
    assert np.isnan(read.orbit[:, at_3]).all()
    off = np.delete(read.orbit - clean.orbit, at_3, axis=1)
    mean = off.mean(axis=(0))
    assert_allclose(mean[at_2], [1e-3, 0], atol=5e-7)
    assert_allclose(np.delete(mean, at_2, axis=0), 0, atol=5e-7)
    assert_allclose(off.std(axis=0).mean(axis=0), [2e-6, 1e-6], rtol=0.05)
    assert_allclose(read.noise, [[2e-6, 1e-6]] * len(read.monitors))


def test_corrector_moves_the_orbit_as_its_response(tiny):
    half = 2e-5
    each = [{"v3": {"kick": half}}, {"v3": {"kick": -half}}]
    orbits = simulate_orbits(tiny, CAUSES, noise=0.0, shots=2, settings=each).measured
    response = simulate_response(
        tiny, CAUSES, correctors=["v3"], kick=2 * half, rf_step=0.0, noise=0.0, progress=False
    ).measured
    assert orbits.settings == tuple(each)
    assert_allclose(orbits.orbit[0] - orbits.orbit[1], response.response[0], rtol=0, atol=1e-11)


def test_dispersion_is_the_responses_own(tiny):
    spread = [*CAUSES, Cause("energy_spread", None, 1e-3)]
    options = {"noise": 0.0, "background": {"quadrupole_gradient": 1e-3}, "machine_seed": 3}
    response = simulate_response(tiny, spread, correctors=["v1"], progress=False, **options)
    rf = response.measured.rf
    own = simulate_dispersion(tiny, spread, steps=[rf.step, rf.step / 2], **options).measured
    assert_allclose(own.orbits[0], rf.orbit, rtol=0, atol=1e-12)
    assert_allclose(own.orbits[1], rf.orbit / 2, rtol=0, atol=2e-2 * np.abs(rf.orbit).max())
    assert (own.steps[0].frequency, own.steps[0].harmonic) == (rf.frequency, rf.harmonic)
    (default,) = simulate_dispersion(tiny, spread, **options).measured.steps
    assert default.step == rf.step


def test_an_energy_offset_moves_orbit_dispersion_and_tunes(tiny):
    """Referee: AT's optics at that energy. The third order of the dispersion is left."""
    offset = 5e-4
    beam = [Cause("energy_offset", None, offset)]
    lattice = AtEngine(tiny, ()).lattice()
    _, there, places = at.get_optics(lattice, at.Monitor, dp=offset, XYStep=3e-6)
    orbit = places.closed_orbit
    read = simulate_orbits(tiny, beam, noise=0.0).measured.orbit[0]
    assert_allclose(read[:, 0], orbit[:, 0], rtol=0, atol=0.01 * np.abs(orbit[:, 0]).max())
    design = simulate_dispersion(tiny, noise=0.0).measured.orbits[0]
    at_offset = simulate_dispersion(tiny, beam, noise=0.0).measured.orbits[0]
    assert np.abs(at_offset - design).max() > 1e-6  # D depends on the energy
    tunes = simulate_tunes(tiny, beam, noise=(0.0, 0.0)).measured.tune[0]
    assert_allclose(tunes, there.tune[:2], rtol=0, atol=2e-5)
    turns = simulate_turns(tiny, beam, noise=0.0, turns=256, amplitude=1e-5).measured.readings
    assert_allclose(turns[0].mean(axis=0)[:, 0], read[:, 0], rtol=0, atol=5e-6)
    with pytest.raises(TmlatticeError, match="no energy offset"):
        simulate_turns(tiny, beam, turns=16, engine="network")


def test_tunes_and_chromaticities_are_ats(tiny):
    upright = UPRIGHT[:1]
    read = simulate_tunes(tiny, upright, noise=(0.0, 0.0)).measured
    lattice = AtEngine(tiny, upright).lattice()
    _, ring, _ = at.get_optics(lattice, get_chrom=True, XYStep=3e-6, DPStep=1e-3)
    assert_allclose(read.tune[0], ring.tune[:2], atol=1e-7)
    assert_allclose(read.chromaticity[0], ring.chromaticity[:2], rtol=2e-3)
    assert read.tune_error is None


def test_noise_of_tunes_is_stated(tiny):
    many = simulate_tunes(tiny, noise=(1e-4, 0.1), shots=300).measured
    assert_allclose(many.tune.std(axis=0), 1e-4, rtol=0.15)  # 4 % each
    assert_allclose(many.chromaticity.std(axis=0), 0.1, rtol=0.15)
    assert (many.tune_error == 1e-4).all()
    assert (many.chromaticity_error == 0.1).all()


def test_frozen_monitor_reads_its_first_turn(tiny):
    read = simulate_turns(tiny, [Cause("monitor_dead", "end_1", 2)], shots=2, turns=20).measured
    at_1 = read.monitors.index("end_1")
    assert np.ptp(read.readings[:, :, at_1], axis=(0, 1)).tolist() == [0.0, 0.0]


def test_beam_that_hits_the_wall_is_missing(tiny):
    read = simulate_turns(tiny, turns=20, kick=(0.05, 0.0), noise=0.0).measured.readings[0]
    assert np.isfinite(read[0, 0]).all()
    assert np.isnan(read[1:]).all()


def test_same_seed_same_readings_and_more_shots_keep_the_first(tiny):
    def readings(**options):
        return simulate_turns(tiny, turns=20, **options).measured.readings

    one = readings(shots=2, seed=4)
    assert np.array_equal(one, readings(shots=3, seed=4)[:2])
    assert not np.array_equal(one, readings(shots=2, seed=5))


def test_truth_states_what_was_done(tiny):
    simulation = simulate_turns(tiny, CAUSES, turns=20, particles=2, background={"all": None})
    truth = simulation.truth()
    assert [e["effect"] for e in truth["effects"]] == [c.effect for c in CAUSES]
    assert truth["background"]["particles"] == 2
    assert truth["background"]["quadrupole_gradient"] > 0
    assert truth["background"]["engine"] == "at"


@pytest.mark.parametrize(
    ("run", "error", "words"),
    [
        (
            lambda r: simulate_turns(r, [Cause("energy_spread", None, 1e-3)]),
            TmlatticeError, "one particle has no energy spread: give particles=",
        ),
        (lambda r: simulate_turns(r, turns=8), TmlatticeError, "8 turns are no turn-by-turn"),
        (
            lambda r: simulate_tunes(r, [Cause("quadrupole_gradient", "QF::1", 1.5)]),
            UnstableRingError, "no tune|no closed orbit",
        ),
        (lambda r: simulate_orbits(r, settings=[{}, {}]), TmlatticeError, "2 settings do not fit"),
        (
            lambda r: simulate_orbits(r, settings=[{"v1": {"k1_relative": 1.0}}]),
            LatticeError, "cannot be set",
        ),
        (lambda r: simulate_orbits(r, noise=-1.0), TmlatticeError, "it is an rms"),
    ],
)  # fmt: skip
def test_what_cannot_be_is_a_sentence(tiny, run, error, words):
    with pytest.raises(error, match=words):
        run(tiny)


@pytest.mark.parametrize(
    ("kind", "words", "table", "record"),
    [
        ("turn-by-turn", ["--turns", "32", "--shots", "2", "--amplitude", "1e-4"], "readings.csv",
         TurnByTurn),
        ("closed-orbit", ["--shots", "2", "--noise", "1e-6"], "readings.csv", ClosedOrbit),
        ("dispersion", [], "readings.csv", Dispersion),
        ("tunes", ["--noise", "1e-4"], "tunes.csv", TuneReading),
        ("orbit-response", ["--engine", "ocelot", "--corrector", "v1", "--corrector",
         "generated_a"], "response.csv", OrbitResponse),
    ],
)  # fmt: skip
def test_command_writes_each_kind(tmp_path, kind, words, table, record):
    folder, truth = tmp_path / "m", tmp_path / "truth.json"
    done = tmlattice("simulate", SMALL, "--kind", kind, *words, "--seed", 3, "--out", folder,
                     "--effect", "quadrupole_gradient QF::3 0.01", "--truth", truth, cwd=tmp_path,
                     check=0)  # fmt: skip
    assert table in done.stdout
    measured = read_measurement(folder)
    assert type(measured) is record
    if record is OrbitResponse:
        assert measured.correctors == ("v1", "generated_a")
        assert measured.planes == ("y", "x")
        assert measured.rf.orbit is not None
    assert read_truth(truth).effects[0]["amount"] == 0.01
    assert not any("QF" in file.read_text() for file in folder.iterdir())


def test_command_has_the_kinds_own_defaults(tmp_path, small_ring):
    tmlattice("simulate", SMALL, "--kind", "turn-by-turn", "--amplitude", "1e-4", "--out", "m",
              cwd=tmp_path, check=0)  # fmt: skip
    assert read_measurement(tmp_path / "m").readings.shape == (1, 1000, 35, 2)
    tmlattice("simulate", SMALL, "--kind", "tunes", "--noise", "3e-4", "--out", "t", cwd=tmp_path)
    measured = read_measurement(tmp_path / "t")
    assert measured.tune_error.tolist() == [[3e-4, 3e-4]]
    assert_allclose(
        measured.tune, simulate_tunes(small_ring, noise=(0, 0)).measured.tune, atol=2e-3
    )


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--kind", "tunes", "--turns", "30"], "--turns has no meaning for --kind tunes"),
        (["--kind", "closed-orbit", "--engine", "ocelot"], "--engine has no meaning"),
        (["--particles", "10"], "take it out, or give --kind turn-by-turn"),
        (["--kind", "dispersion", "--corrector", "v1"], "or give --kind orbit-response"),
        (["--kind", "orbit-response", "--shots", "3"], "--shots has no meaning"),
        (["--corrector", "v1"], "--corrector has no meaning for --kind trajectory"),
    ],
)
def test_options_of_other_kinds_are_refused(tmp_path, words, said):
    refused("simulate", SMALL, *words, "--out", "m", cwd=tmp_path, says=said)
