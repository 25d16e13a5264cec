"""The virtual machine: random streams, monitors, background, processes, memory, the truth."""

import json
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest

from tmlattice.beam import Model
from tmlattice.effects import CATALOGUE, Cause, background_rms, find
from tmlattice.errors import EffectError, TmlatticeError
from tmlattice.machine import Machine, Simulation, draw_background, draw_shots, simulate
from tmlattice.machine.machine import CHUNK
from tmlattice.measurement import read_measurement, read_truth, write_truth

EXACT = (0.0,) * 5
FAULT = Cause("quadrupole_gradient", "QD::5", -0.02)
MONITOR = "bpm::4"


def readings(simulation: Simulation, jobs: int = 1):
    measured = simulation.machine.measure(simulation.shots, simulation.turns, simulation.seed, jobs)
    return np.stack([reading for _, reading in measured])


def read_with(ring, *causes, **options):
    """What the faulty monitor, and what a good one, read of the same shots."""
    at = [m.name for m in ring.monitors].index(MONITOR)
    options = {"engine": "ocelot", "shots": 4, "amplitude": 1e-4, "seed": 2, **options}
    bad = readings(simulate(ring, list(causes), **options))
    good = readings(simulate(ring, [], **options))
    others = np.arange(good.shape[2]) != at
    np.testing.assert_array_equal(bad[:, :, others], good[:, :, others])
    return bad[:, :, at], good[:, :, at]


# --- random streams


def test_seed_gives_the_same_launches_with_either_engine_and_any_machine(small_ring):
    options = {"shots": 5, "amplitude": 1e-4, "kicks": 1e-5, "seed": 7}
    one = simulate(small_ring, engine="ocelot", **options).shots
    for other in (
        simulate(small_ring, engine="at", **options),
        simulate(small_ring, [FAULT], engine="ocelot", **options),
        simulate(small_ring, engine="ocelot", background="all", **options),
        simulate(small_ring, engine="ocelot", noise=0.0, turns=3, radiation=True, **options),
    ):
        np.testing.assert_array_equal(other.shots.nominal, one.nominal)
        np.testing.assert_array_equal(other.shots.launches, one.launches)
        assert other.shots.settings == one.settings
    another = simulate(small_ring, engine="ocelot", **{**options, "seed": 8}).shots
    assert not np.isclose(another.nominal[:, :4], one.nominal[:, :4]).any()


def test_noise_is_the_same_whatever_the_engine_and_the_fault(small_ring):
    options = {"engine": "ocelot", "shots": 3, "amplitude": 1e-4, "seed": 4}
    noise = []
    for causes in ([], [FAULT]):
        loud, silent = (simulate(small_ring, causes, noise=n, **options) for n in (2e-5, 0.0))
        noise.append(readings(loud) - readings(silent))
    np.testing.assert_allclose(noise[0], noise[1], rtol=0, atol=1e-15)
    assert not np.isclose(noise[0][0], noise[0][1]).any()  # each shot its own


def test_background_of_one_effect_does_not_depend_on_the_others(small_ring):
    alone = draw_background(small_ring, {"monitor_roll": 5e-3}, seed=1)
    rms = background_rms("all")
    assert rms == background_rms({"all": None})
    among = [c for c in draw_background(small_ring, rms, seed=1) if c.effect == "monitor_roll"]
    assert among == alone
    assert draw_background(small_ring, {"monitor_roll": 5e-3}, seed=2) != alone


def test_same_machine_measured_twice_has_other_shots(small_ring):
    options = {"engine": "ocelot", "background": {"all": None}, "amplitude": 1e-4}
    before, after = (
        simulate(small_ring, causes, seed=seed, machine_seed=1, **options)
        for causes, seed in (([], 5), ([FAULT], 6))
    )
    assert after.machine.causes == (*before.machine.causes, FAULT)
    assert not np.isclose(before.shots.launches[:, :4], after.shots.launches[:, :4]).any()
    assert simulate(small_ring, seed=5, **options).machine.causes != before.machine.causes


# --- sizes


def test_amplitude_is_the_rms_orbit_of_each_shot(petra3, petra3_network):
    shots = draw_shots(petra3, 20, 1e-3, seed=1)
    orbits = petra3_network(shots.nominal[:, :4]).detach().numpy()
    rms = np.sqrt((orbits**2).mean(axis=(1, 2)))
    np.testing.assert_allclose(rms, 1e-3, rtol=1e-6)
    planes = np.sqrt((orbits**2).mean(axis=(0, 1)))  # both are there, to coupling by sextupoles
    np.testing.assert_allclose(planes, 1e-3, rtol=0.1)


def test_launches_jitter_by_the_stated_rms(small_ring):
    sigma = (1e-4, 2e-5, 3e-4, 4e-5, 1e-3)
    shots = draw_shots(small_ring, 4000, 1e-4, sigma=sigma, seed=1)
    assert (shots.launches[:, 4] == 0).all()  # tau
    jitter = shots.launches[:, [0, 1, 2, 3, 5]] - shots.nominal
    np.testing.assert_allclose(jitter.std(axis=0), sigma, rtol=0.05)  # 4.5 sigma of 4000
    assert np.abs(jitter.mean(axis=0) / sigma).max() < 4.5 / np.sqrt(4000)
    exact = draw_shots(small_ring, 5, 1e-4, sigma=EXACT, seed=1)
    np.testing.assert_array_equal(exact.launches[:, :4], exact.nominal[:, :4])


def test_noise_has_the_stated_rms_in_each_plane(small_ring):
    options = {"engine": "ocelot", "shots": 40, "turns": 3, "amplitude": 1e-4, "seed": 1}
    loud = readings(simulate(small_ring, noise=(2e-5, 5e-5), **options))
    noise = loud - readings(simulate(small_ring, noise=0.0, **options))
    number = noise[..., 0].size
    np.testing.assert_allclose(
        noise.std(axis=(0, 1, 2)), (2e-5, 5e-5), rtol=4.5 / np.sqrt(2 * number)
    )


def test_kicks_have_the_stated_rms_and_leave_given_settings_alone(small_ring):
    given = [{"v3": {"kick": 1e-3}}] * 200
    shots = draw_shots(small_ring, 200, 1e-4, kicks=1e-5, settings=given, seed=1)
    assert all(s["v3"] == {"kick": 1e-3} for s in shots.settings)
    kicks = [v["kick"] for s in shots.settings for name, v in s.items() if name != "v3"]
    np.testing.assert_allclose(np.std(kicks), 1e-5, rtol=4.5 / np.sqrt(2 * len(kicks)))


# --- monitors, read through the machine; the referee is the good monitor of the same shots


def test_monitor_gain_multiplies_the_beam_and_not_the_noise(small_ring):
    bad, good = read_with(small_ring, Cause("monitor_gain_x", MONITOR, 0.1), noise=0.0)
    np.testing.assert_allclose(bad, good * [1.1, 1], rtol=1e-12)
    loud, _ = read_with(small_ring, Cause("monitor_gain_x", MONITOR, 0.1))
    _, loud_good = read_with(small_ring)
    np.testing.assert_allclose(loud - bad, loud_good - good, atol=1e-15)


def test_frozen_monitor_stays_at_its_first_reading_over_shots_turns_and_chunks(small_ring):
    bad, good = read_with(small_ring, Cause("monitor_dead", MONITOR, 2), shots=CHUNK + 2, turns=2)
    np.testing.assert_array_equal(bad, np.broadcast_to(good[0, 0], bad.shape))


# --- background


def test_background_has_the_catalogue_rms_at_every_place(petra3):
    rms = background_rms({"all": None})
    usual = {n: e.background for n, e in CATALOGUE.items() if e.background is not None}
    assert rms == usual
    causes = draw_background(petra3, rms, seed=1)
    for name, size in rms.items():
        own = [c for c in causes if c.effect == name]
        assert [c.element for c in own] == find(name).places(petra3)
        amounts = np.array([c.amount for c in own])
        np.testing.assert_allclose(
            np.sqrt((amounts**2).mean()), size, rtol=4.5 / np.sqrt(2 * len(own)), err_msg=name
        )


def test_background_is_scaled_and_named_effects_win(small_ring):
    rms = background_rms({"all": 0.5, "monitor_roll": 1e-2, "energy_offset": 1e-4})
    assert rms["quadrupole_gradient"] == 0.5 * CATALOGUE["quadrupole_gradient"].background
    assert rms["monitor_roll"] == 1e-2
    assert rms["energy_offset"] == 1e-4
    assert background_rms({"all": 0.0}) == {}
    causes = [draw_background(small_ring, {"monitor_roll": r}, seed=1) for r in (1e-3, 2e-3)]
    for small, large in zip(*causes, strict=True):
        assert large.amount == pytest.approx(2 * small.amount, rel=1e-12)


@pytest.mark.parametrize(
    ("wanted", "words"),
    [
        ({"energy_offset": None}, "no usual size; give energy_offset=RMS"),
        ({"monitor_roll": -1.0}, "zero or more"),
        ({"all": float("nan")}, "zero or more"),
    ],
)
def test_background_that_cannot_be_is_refused(wanted, words):
    with pytest.raises(EffectError, match=words):
        background_rms(wanted)


# --- refusals


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"shots": 0}, "give at least one"),
        ({"amplitude": 0.0}, "above 0 m"),
        ({"amplitude": 1.0}, "smaller amplitude"),
        ({"engine": "madx"}, "no engine 'madx'; there are at and ocelot"),
        ({"noise": -1e-5}, "zero or more"),
        ({"noise": (1e-5, 1e-5, 1e-5)}, "or two"),
        ({"launch_sigma": (1e-4, 1e-4)}, "five numbers"),
        ({"launch_sigma": (-1e-4, 0, 0, 0, 0)}, "five numbers"),
    ],
)
def test_simulation_that_cannot_be_is_refused(small_ring, options, words):
    with pytest.raises(TmlatticeError, match=words):
        simulate(small_ring, **{"engine": "ocelot", "amplitude": 1e-4, **options})


# --- writing


@pytest.fixture
def simulation(small_ring):
    return simulate(
        small_ring, [FAULT, Cause("energy_offset", None, 1e-4)], background={"monitor_roll": 1e-3},
        engine="ocelot", shots=3, turns=4, amplitude=1e-4, kicks=1e-5, seed=9, machine_seed=2,
    )  # fmt: skip


def test_written_folder_reads_back_as_the_measurement(simulation, tmp_path):
    simulation.write(tmp_path / "day", progress=False)
    back, direct = read_measurement(tmp_path / "day"), simulation.measurement()
    assert back.readings.shape[:2] == (3, 4)
    for name in ("readings", "launches", "launch_sigma", "noise"):
        np.testing.assert_array_equal(getattr(back, name), getattr(direct, name))
    assert back.settings == direct.settings
    assert (back.lattice, back.energy, back.monitors) == (
        direct.lattice, direct.energy, direct.monitors
    )  # fmt: skip


def test_folder_contains_nothing_of_the_truth(simulation, tmp_path):
    simulation.write(tmp_path / "day", progress=False)
    files = sorted(path.name for path in (tmp_path / "day").iterdir())
    assert files == ["measurement.json", "readings.csv"]
    document = json.loads((tmp_path / "day" / "measurement.json").read_text())
    for shot, launch in zip(document["shots"], simulation.shots.launches, strict=True):
        assert shot["launch"]["x"] != launch[0]
    text = (tmp_path / "day" / "measurement.json").read_text()
    for word in ("effect", "seed", "background", "amount", "energy_offset", "truth", repr(-0.02)):
        assert word not in text, word


def test_truth_is_what_was_put_in(simulation, small_ring, tmp_path):
    write_truth(tmp_path / "truth.json", **simulation.truth())
    truth = read_truth(tmp_path / "truth.json")
    assert [dict(e) for e in truth.effects] == [
        {"effect": "quadrupole_gradient", "element": "QD::5", "s": small_ring["QD::5"].s,
         "amount": -0.02},
        {"effect": "energy_offset", "element": None, "s": None, "amount": 1e-4},
    ]  # fmt: skip
    np.testing.assert_array_equal(truth.launches, simulation.shots.launches[:, [0, 1, 2, 3, 5]])
    assert truth.seed == 9
    assert truth.background == {
        "monitor_roll": 1e-3, "radiation": False, "engine": "ocelot", "machine_seed": 2
    }  # fmt: skip


def test_turns_follow_each_other(small_ring):
    """The first of four turns is the only one of one; the others are those of the machine."""
    one, four = (
        simulate(small_ring, engine="ocelot", shots=2, turns=n, amplitude=1e-4, noise=0.0, seed=1)
        for n in (1, 4)
    )
    several = readings(four)
    np.testing.assert_allclose(several[:, :1], readings(one), rtol=0, atol=1e-15)
    np.testing.assert_array_equal(several, four.machine.beam(four.shots.launches, 4))
    assert np.abs(several[:, 1] - several[:, 0]).max() > 1e-5


def test_memory_is_flat_in_the_number_of_shots(small_ring, tmp_path):
    """10 turns: the readings of 256 shots would be 1.5 MB."""
    peaks = []
    for shots in (2 * CHUNK, 4 * CHUNK):
        simulation = simulate(
            small_ring, engine="ocelot", shots=shots, turns=10, amplitude=1e-4, seed=1
        )
        if not peaks:
            simulation.write(tmp_path / "warm", progress=False)
        short = replace(simulation, seed=2)
        tracemalloc.start()
        short.write(tmp_path / str(shots), progress=False)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    more = len(small_ring.monitors) * 10 * 2 * 8 * 2 * CHUNK  # bytes of the shots that are more
    assert peaks[1] - peaks[0] < 0.2 * more, peaks


@pytest.mark.slow
def test_processes_do_not_change_a_digit(small_ring):
    """Frozen monitors too: they stay at the first reading of all processes."""
    simulation = simulate(
        small_ring, [Cause("monitor_dead", MONITOR, 2), FAULT], engine="ocelot",
        shots=2 * CHUNK + 5, amplitude=1e-4, seed=1,
    )  # fmt: skip
    np.testing.assert_array_equal(readings(simulation, jobs=2), readings(simulation))


def test_calibration_errors_that_are_known_act_on_what_is_set(small_ring):
    """The kick of a shot replaces the design's: what is known of the corrector stays."""
    setting = {"v5": {"kick": 1e-4}}
    calibration = [Cause("corrector_calibration", "v5", 0.5)]
    launch = np.zeros((1, 5))
    seen = Model(small_ring, [setting], known=calibration).readings(launch)
    there = Machine(small_ring, calibration, noise=0).beam(np.zeros((1, 6)), 1, [setting])
    stronger = Model(small_ring, [{"v5": {"kick": 1.5e-4}}]).readings(launch)
    assert np.abs(stronger).max() > 1e-4
    np.testing.assert_allclose(seen, stronger, atol=1e-15)
    np.testing.assert_allclose(seen[0], there[0, 0], atol=1e-9)  # AT's thick elements
