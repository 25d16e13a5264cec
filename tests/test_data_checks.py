"""The data checks: what is wrong everywhere is named, and healthy data of sick machines are not."""

import re
from dataclasses import replace
from pathlib import Path

import machine_data
import numpy as np
import pytest
from command import tmlattice
from conftest import SMALL
from shared import valid

from tmlattice.diagnosis import diagnose
from tmlattice.diagnosis.data_checks import check_data
from tmlattice.effects import Cause, background_rms
from tmlattice.errors import MeasurementError, UnknownNameError
from tmlattice.lattice import load_ring
from tmlattice.machine import simulate
from tmlattice.machine.response import simulate_response
from tmlattice.machine.shots import draw_background
from tmlattice.machine.stored_beam import simulate_turns
from tmlattice.measurement import Measurement, write_measurement
from tmlattice.measurement.assume import ASSUMPTIONS, assume
from tmlattice.observe.sections import Passes, Sections

FAULT = Cause("quadrupole_gradient", "QD::5", -0.2)


@pytest.fixture(scope="module")
def machine(small_ring):
    """First turns of a machine with correctors set and a strong quadrupole fault."""
    return simulate(small_ring, [FAULT], shots=6, seed=3, kicks=1e-4).measurement()


@pytest.fixture(scope="module")
def healthy(small_ring):
    return simulate(small_ring, shots=6, seed=3).measurement()


@pytest.fixture(scope="module")
def steps(small_ring):
    """An orbit response of a machine with the usual errors of monitors and correctors."""
    errors = {"monitor_gain_x": 0.02, "monitor_roll": 5e-3, "corrector_calibration": 0.03}
    return simulate_response(small_ring, background=errors, engine="ocelot", seed=1).measured


@pytest.fixture(scope="module")
def thomx():
    """The ring and a response with the usual errors."""
    ring = load_ring(Path(machine_data.__file__).parent / "thomx.m")
    steps = simulate_response(ring, background={"all": None}, progress=False, seed=1).measured
    return ring, steps


def reported(checkup, status="wrong"):
    return [check for check in checkup.checks if check.status == status]


def shifted(values, by):
    return np.roll(values, by, axis=-2)


def one_plane(values, others, plane):
    return np.where(np.arange(2) == plane, others, values)


WRONG = {
    "x-reversed": lambda m: {"readings": m.readings * [-1, 1]},
    "readings-reversed": lambda m: {"readings": -m.readings},
    "planes-swapped": lambda m: {"readings": m.readings[..., ::-1]},
    "readings-in-mm": lambda m: {"readings": 1e3 * m.readings, "noise": 1e3 * m.noise},
    "readings-in-inches": lambda m: {"readings": m.readings / 0.0254},
    "monitors-shifted=1": lambda m: {"readings": shifted(m.readings, 1)},
    "x-shifted=-1": lambda m: {"readings": one_plane(m.readings, shifted(m.readings, -1), 0)},
    "monitors-backwards": lambda m: {"readings": m.readings[:, :, ::-1]},
    "monitors-alphabetical": lambda m: {
        "readings": m.readings[:, :, np.argsort(np.char.lower(m.monitors), kind="stable")]
    },
    "launches-reversed": lambda m: {"launches": -m.launches},
    "slopes-reversed": lambda m: {"launches": m.launches * [1, -1, 1, -1, 1]},
    "launches-swapped": lambda m: {"launches": m.launches[:, [2, 3, 0, 1, 4]]},
    "launches-in-mm": lambda m: {"launches": 1e3 * m.launches},
    "slopes-in-mrad": lambda m: {"launches": m.launches * [1, 1e3, 1, 1e3, 1]},
    "settings-reversed": lambda m: {"settings": kicked(m, -1)},
    "settings-halved": lambda m: {"settings": kicked(m, 2)},
    "turns-from-1": lambda m: {
        "readings": np.concatenate([np.full_like(m.readings, np.nan), m.readings], axis=1)
    },
}


def kicked(data, factor):
    return tuple(
        {n: {"kick": factor * s["kick"]} for n, s in shot.items()} for shot in data.settings
    )


NATURES = (
    "x-reversed", "planes-swapped", "readings-in-mm", "monitors-shifted=1", "slopes-reversed",
    "settings-reversed", "settings-halved", "turns-from-1",
)  # fmt: skip


@pytest.mark.parametrize("name", WRONG)
def test_what_is_wrong_everywhere_is_named(small_ring, machine, healthy, name):
    """In three shots; eight of different natures in four, of a ring with a strong fault."""
    data = machine if name in NATURES or "settings" in name else healthy
    data = data.select(shots=data.shots[: 4 if name in NATURES else 3])
    data = replace(data, **WRONG[name](data))
    (check,) = reported(check_data(small_ring, data))
    assert name in check.assume or f"--assume {name}" in check.sentence
    if name in NATURES:
        assert check.before > (2 if "settings" in name else 10) * check.after
        assert check_data(small_ring, data, assumed=check.assume).status != "wrong"


def test_y_of_wrong_sign_is_named_with_its_mirror(small_ring, healthy):
    """Where no vertical kick is set, launches of wrong sign in y say the same."""
    (check,) = reported(
        check_data(small_ring, replace(healthy, readings=healthy.readings * [1, -1]))
    )
    assert check.assume == ("y-reversed",)
    assert "--assume launches-y-reversed" in check.sentence


def test_two_global_errors_are_named_together(small_ring, machine):
    data = replace(machine, readings=machine.readings * [-1e3, 1e3], noise=None)
    found = {name for check in reported(check_data(small_ring, data)) for name in check.assume}
    assert found == {"readings-in-mm", "x-reversed"}


def test_energies_in_per_cent_are_named(small_ring):
    """Each shot has its own. Correct ones are not reported."""
    made = simulate(small_ring, shots=4, seed=1, launch_sigma=(1e-5, 2e-6, 1e-5, 2e-6, 2e-3))
    data = made.measurement()
    launches, sigma = data.launches.copy(), data.launch_sigma.copy()
    launches[:, 4], sigma[:, 4] = made.shots.launches[:, 5], 1e-5
    for factor, wrong in ((1, []), (100, [("energies-in-percent",)])):
        stated = replace(data, launches=launches * [1, 1, 1, 1, factor], launch_sigma=sigma)
        assert [check.assume for check in reported(check_data(small_ring, stated))] == wrong


def test_a_beam_that_runs_backwards_is_told(small_ring, healthy):
    monitors = np.arange(len(small_ring.monitors))
    sections = Sections(small_ring, [{}] * 6, monitors)
    ends, _ = sections.carried(healthy.launches, np.arange(6), 1)
    data = replace(healthy, launches=ends * [1, -1, 1, -1, 1])
    (check,) = reported(check_data(small_ring, data))
    assert check.assume == ("beam-backwards",)


SICK = {
    "three monitors exchanged": (
        [Cause("monitor_swap", name, 1.0) for name in ("end_3", "end_4", "bpm::9")], {}),
    "another energy": ([Cause("energy_offset", None, 5e-3)], {}),
    "several": ([FAULT, Cause("monitor_swap", "end_3", 1.0), Cause("dipole_roll", "bend::9", 5e-3)],
                {}),
    "distributed errors": ([], {"background": {"all": None}}),
    "small errors, one shot": ([], {"background": {"all": None}, "shots": 1}),
    "three turns": ([FAULT], {"turns": 3}),
    "energies of their own": ([FAULT], {"launch_sigma": (1e-4, 2e-5, 1e-4, 2e-5, 1e-3)}),
    "correctors set": ([FAULT], {"kicks": 1e-4}),
}  # fmt: skip


@pytest.mark.parametrize("kind", SICK)
def test_healthy_data_of_a_sick_machine_tell_nothing(small_ring, kind):
    causes, options = SICK[kind]
    data = simulate(small_ring, causes, **{"shots": 6, "seed": 5, **options}).measurement()
    told = check_data(small_ring, data).reported
    assert [check.sentence for check in told if check.name != "noise"] == []
    assert all("shots do not show which" in check.sentence for check in told)  # small errors


def test_an_orbit_that_is_millimetres_off_is_no_global_error(small_ring):
    """Quadrupoles 3 mm off axis, and the beam is lost: x and y were said to be exchanged."""
    rms = background_rms({"all": None}) | {f"quadrupole_offset_{plane}": 3e-3 for plane in "xy"}
    causes = draw_background(small_ring, rms, 9)
    data = simulate(small_ring, causes, seed=9000).measurement()
    assert [check.sentence for check in reported(check_data(small_ring, data))] == []
    swapped = replace(data, readings=data.readings[..., ::-1])
    (check,) = reported(check_data(small_ring, swapped))
    assert check.assume == ("planes-swapped",)


def test_a_beam_lost_in_a_ring_far_from_its_design_is_not_in_another_order():
    """Offsets of three times the usual, a tenth of the BPMs read; in the order of the sorted names
    they would be all along the ring, each alone, and nothing would contradict that."""
    ring = load_ring(Path(machine_data.__file__).parent / "hmba.mat")
    rms = background_rms({"all": None})
    rms = {name: 3 * size if "offset" in name else size for name, size in rms.items()}
    data = simulate(ring, background=rms, amplitude=3e-4, seed=3).measurement()
    assert np.isfinite(data.readings).mean() < 0.15
    assert [check.sentence for check in reported(check_data(ring, data))] == []


@pytest.mark.parametrize("size", [2e-5, 1e-3])
@pytest.mark.parametrize("ends", [[16] * 6, [10, 12, 14, 16, 16, 16], [16]])
def test_readings_behind_a_loss_that_are_noise(small_ring, size, ends):
    """In all shots, or in some, at one place or at several."""
    data = simulate(small_ring, background={"all": None}, shots=6, seed=1).measurement()
    readings, rng = data.readings.copy(), np.random.default_rng(0)
    for shot, read in enumerate(ends):
        readings[shot, :, read:] = size * rng.standard_normal(readings[shot, :, read:].shape)
    (check,) = check_data(small_ring, replace(data, readings=readings)).reported
    names = [monitor.name for monitor in small_ring.monitors]
    first = next(names.index(word) for word in check.sentence.split() if word in names)
    assert check.name == "lost beam"
    assert abs(first - ends[0]) <= (8 if len(ends) == 1 else 4)  # sections have eight readings
    assert check.status == "wrong" or len(ends) == 1
    assert ("in any shot" in check.sentence) == (ends == ends[:1] * 6)


def test_a_reading_that_no_beam_gives(small_ring, healthy):
    readings = healthy.readings.copy()
    readings[2, 0, 5, 1] = 3.0
    found = check_data(small_ring, replace(healthy, readings=readings))
    (check,) = reported(found, "note")
    assert reported(found) == []
    assert check.name == "recording"
    assert "1 reading is 3 m, which no beam reads, and is rejected, of" in check.sentence
    assert healthy.monitors[5] in check.sentence
    readings[2, 0, 5, 1] = 1e300
    with pytest.raises(MeasurementError, match="a reading is 1e\\+300 m"):
        replace(healthy, readings=readings)


def test_few_monitors_tell_nothing(small_ring, healthy):
    for names in (healthy.monitors[3:5], healthy.monitors[::9], healthy.monitors[::4]):
        data = healthy.select(monitors=names)
        assert check_data(small_ring, data).reported == ()


@pytest.mark.parametrize("factor", [0.1, 10.0])
def test_a_noise_that_is_not_the_readings_is_told(small_ring, healthy, factor):
    data = replace(healthy, noise=factor * healthy.noise)
    (check,) = reported(check_data(small_ring, data))
    assert (check.name, check.assume) == ("noise", ("noise-from-data",))
    assert check.before == pytest.approx(factor**-2, rel=0.5)  # of 200 readings, in few sections
    assert reported(check_data(small_ring, data, assumed=check.assume)) == []


def test_small_errors_everywhere_are_not_taken_for_noise(small_ring):
    """Noise of 2 um, errors of hundreds: alike from shot to shot, or in proportion to the orbit."""
    data = simulate(small_ring, background={"all": None}, noise=2e-6, shots=6, seed=2)
    assert reported(check_data(small_ring, data.measurement())) == []


def test_monitors_and_readings_of_their_own_are_noted(small_ring, healthy):
    readings = healthy.readings.copy()
    readings[:, :, 4] = readings[:, :, 8]
    readings[:, :, 11, 1] = 3e-4
    readings[:, :, 14] = np.nan
    readings[1, 0, 20, 0] += 2e-3
    readings[4, :, 28:] = np.nan
    found = {c.name: c.sentence for c in reported(
        check_data(small_ring, replace(healthy, readings=readings)), "note")}  # fmt: skip
    names = [monitor.name for monitor in small_ring.monitors]
    assert f"{names[4]} in x and {names[8]} in x" in found["copied BPMs"]
    assert f"{names[11]} in y" in found["frozen BPMs"]
    assert names[14] in found["silent BPMs"]
    assert f"{names[20]} in x, shot 1" in found["outliers"]
    assert f"shot 4 has no reading behind {names[27]} " in found["lost beam"]
    assert len(found) == 5


def test_shots_recorded_twice_and_clipped_readings_are_left_out(small_ring, healthy):
    few = healthy.select(shots=healthy.shots[:3])
    launches, readings = (np.repeat(own, 2, 0) for own in (few.launches, few.readings))
    twice = Measurement(launches, readings, few.monitors, few.noise)
    (found,) = reported(check_data(small_ring, twice), "note")
    assert (found.name, len(twice.shots)) == ("recording", 2 * len(few.shots))
    assert f"{len(few.shots)} of {len(twice.shots)} shots repeat another" in found.sentence
    end = np.quantile(np.abs(few.readings[..., 0]), 0.9)
    clipped = np.clip(few.readings, -end, end)
    count = np.count_nonzero(np.abs(clipped) == end)
    (found,) = reported(check_data(small_ring, replace(few, readings=clipped)), "note")
    assert found.sentence.startswith(f"{count} readings are clipped at {end:g} m")
    with pytest.raises(MeasurementError, match=r"clipped at"):
        diagnose(small_ring, replace(healthy, readings=np.clip(healthy.readings, -1e-5, 1e-5)))


def test_launches_far_from_the_stated_ones_are_noted(small_ring, healthy):
    data = replace(healthy, launches=healthy.launches + np.array([2e-3, 0, 0, 0, 0]))
    (check,) = reported(check_data(small_ring, data), "note")
    assert (check.name, check.assume) == ("launches", ("launches-unknown",))
    assert check_data(small_ring, data, assumed=check.assume).reported == ()


def test_another_energy_than_the_lattice_is_noted(small_ring, healthy):
    (check,) = reported(check_data(small_ring, replace(healthy, energy=6.0)), "note")
    assert "6 GeV" in check.sentence


def test_a_slip_in_the_turns_is_told_before_anything_is_laid_out(small_ring, healthy):
    readings = np.full((6, 1001, len(healthy.monitors), 2), np.nan)
    readings[:, :1], readings[0, 1000, 3] = healthy.readings, 1e-3
    (check,) = reported(check_data(small_ring, replace(healthy, readings=readings)))
    assert "turn 1000" in check.sentence


RESPONSE = {
    "y-reversed": "y-reversed",
    "planes-swapped": "planes-swapped",
    "readings-in-mm": "readings-in-km",
    "readings-halved": "readings-doubled",
    "kicks-reversed": "kicks-reversed",
    "kicks-in-mrad": None,
    "correctors-shifted=1": "correctors-shifted=-1",
    "monitors-shifted=1": "monitors-shifted=-1",
    "rf-reversed": "rf-reversed",
}


@pytest.mark.parametrize("name", RESPONSE)
def test_what_is_wrong_everywhere_in_an_orbit_response_is_named(small_ring, steps, name):
    monitors = [monitor.name for monitor in small_ring.monitors]
    compensated = RESPONSE[name]
    if compensated is None:
        data = replace(steps, kicks=1e3 * steps.kicks)
    else:
        data = assume(steps, [compensated], monitors)
    (check,) = reported(check_data(small_ring, data))
    assert name in check.assume or f"--assume {name}" in check.sentence
    assert check_data(small_ring, data, assumed=check.assume).reported == ()


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("kicks-halved", lambda d: replace(d, kicks=2 * d.kicks)),
        ("kicks-doubled", lambda d: replace(d, kicks=d.kicks / 2)),
        ("kicks-in-krad", lambda d: replace(d, kicks=1e-3 * d.kicks)),
        ("readings-in-mm", lambda d: replace(d, response=1e3 * d.response, noise=None)),
    ],
    ids=lambda own: own if isinstance(own, str) else "",
)
def test_a_scale_is_named_of_a_ring_far_from_its_design(small_ring, steps, name, change):
    """Columns of the Siam ring are 44 % off its design."""
    rng = np.random.default_rng(5)
    size = np.sqrt(np.nanmean(steps.response**2, axis=(1, 2)))[:, None, None]
    far = steps.response + 0.45 * size * rng.standard_normal(steps.response.shape)
    far = replace(steps, response=far, rf=None)
    assert reported(check_data(small_ring, far)) == []
    checks = reported(check_data(small_ring, change(far)))
    assert any(name in check.sentence for check in checks), checks


@pytest.mark.parametrize(
    ("factor", "words"),
    [
        (1e3, "--assume rf-in-mm"),
        (1e-3, "--assume rf-in-km"),
        (30.0, "the RF's orbit is 30 times the design's for its step"),
    ],
)
def test_an_rf_orbit_in_another_unit_is_told(small_ring, factor, words):
    """`no closed orbit` had been all that was said."""
    steps = simulate_response(small_ring, rf_step=-3000.0, engine="ocelot", seed=1).measured
    assert reported(check_data(small_ring, steps)) == []
    scaled = replace(steps, rf=replace(steps.rf, orbit=factor * steps.rf.orbit))
    (check,) = reported(check_data(small_ring, scaled))
    assert words in check.sentence
    if check.assume:
        assert check_data(small_ring, scaled, assumed=check.assume).reported == ()
    repeated = np.tile(scaled.rf.orbit[:5], (len(steps.monitors) // 5, 1))  # no monitor read that
    copied = replace(scaled, rf=replace(scaled.rf, orbit=repeated))
    assert reported(check_data(small_ring, copied)) == []


def test_a_bad_corrector_or_monitor_is_no_global_error(small_ring, steps):
    assert check_data(small_ring, steps).reported == ()
    response = steps.response.copy()
    response[4] *= -1
    response[:, 7, 0] *= -1
    assert check_data(small_ring, replace(steps, response=response)).reported == ()


def test_diagnose_stops_and_goes_on_with_what_is_assumed(small_ring, machine):
    data = replace(machine, readings=machine.readings * [-1, 1])
    with pytest.raises(MeasurementError, match=r"x has the wrong sign.*--assume x-reversed"):
        diagnose(small_ring, data)
    effects = ["quadrupole_gradient", "quadrupole_offset_x", "monitor_gain_x"]
    found = diagnose(small_ring, data, assume=["x-reversed"], effects=effects)
    assert found.findings[0].element == FAULT.element
    assert found.as_json()["provenance"]["options"]["assume"] == ["x-reversed"]


def test_a_reference_is_looked_at_too(small_ring, healthy):
    """What is wrong in one of the two alone no assumption of both corrects."""
    healthy = healthy.select(shots=healthy.shots[:3])
    wrong = replace(healthy, readings=healthy.readings * [-1, 1])
    for which, data, reference, one in (
        ("the reference", healthy, wrong, True), ("the second measurement", wrong, healthy, True),
        ("", wrong, wrong, False),
    ):  # fmt: skip
        with pytest.raises(MeasurementError, match="x has the wrong sign") as raised:
            diagnose(small_ring, data, reference=reference)
        said = str(raised.value)
        assert said.startswith(f"{which} alone (correct its file") == one
        assert "--assume x-reversed" in said


def test_a_response_stops_and_goes_on_with_what_is_assumed(small_ring, steps):
    data = replace(steps, kicks=-steps.kicks)
    with pytest.raises(MeasurementError, match="--assume kicks-reversed"):
        diagnose(small_ring, data)
    options = {"effects": ["corrector_calibration"], "max_effects": 1}
    found = diagnose(small_ring, data, assume=["kicks-reversed"], **options)
    same = diagnose(small_ring, steps, **options)
    assert found.fit_before == same.fit_before


@pytest.mark.parametrize(("causes", "amplitude"), [([], 3e-3), ([FAULT], 1e-3)])
def test_readings_without_noise_are_the_easiest(small_ring, causes, amplitude):
    """What second-order maps leave of a thick machine is no fault, however small the noise."""
    data = simulate(small_ring, causes, shots=6, seed=1, noise=0, amplitude=amplitude).measurement()
    found = diagnose(small_ring, data)
    assert [finding.element for finding in found.findings] == [c.element for c in causes]
    # two at one place that read the same count once, and those left see the fault between them
    said = "noise was estimated" if causes else "second-order maps"
    assert any(said in warning for warning in found.warnings)


def test_a_beam_that_is_lost_is_used_up_to_there(small_ring):
    data = simulate(small_ring, [Cause("quadrupole_gradient", "QD::0", -0.2)], shots=6, seed=3)
    data = data.measurement()
    readings = data.readings.copy()
    readings[:, :, 3:] = np.nan
    found = diagnose(small_ring, replace(data, readings=readings))
    assert any("the beam was lost there" in warning for warning in found.warnings)


def test_one_monitor_and_unknown_assumptions_are_one_sentence(small_ring, healthy):
    with pytest.raises(MeasurementError, match="two BPMs at least"):
        diagnose(small_ring, healthy.select(monitors=healthy.monitors[:1]))
    with pytest.raises(UnknownNameError, match="did you mean 'x-reversed'"):
        diagnose(small_ring, healthy, assume=["x-revers"])
    with pytest.raises(MeasurementError, match="'x-reversed' is named twice"):
        check_data(small_ring, healthy, assumed=["x-reversed", "y-reversed", "x-reversed"])
    with pytest.raises(MeasurementError, match="no meaning for first turns"):
        check_data(small_ring, healthy, assumed=["rf-reversed"])
    with pytest.raises(MeasurementError, match="there are readings of turn 0"):
        check_data(small_ring, healthy, assumed=["turns-from-1"])


def test_a_lattice_without_monitors_is_told(small_ring, healthy):
    bare = small_ring.with_elements({})
    bare = replace(bare, elements=tuple(e for e in bare.elements if e.kind != "monitor"))
    with pytest.raises(MeasurementError, match="has no BPM"):
        diagnose(bare, healthy)


@pytest.mark.parametrize("name", [n for n, a in ASSUMPTIONS.items() if Measurement in a.kinds])
def test_an_assumption_undoes_itself_and_touches_nothing_else(small_ring, machine, name):
    """The given measurement stays as it is, and what comes out is a measurement still."""
    monitors = [monitor.name for monitor in small_ring.monitors]
    if name == "turns-from-1":
        machine = replace(machine, **WRONG[name](machine))
    before = machine.readings.copy(), machine.launches.copy()
    made = assume(machine, [name], monitors)
    assert np.array_equal(before[0], machine.readings, equal_nan=True)
    assert np.array_equal(before[1], machine.launches)
    replace(made)  # all checks of a measurement
    assert made.monitors == machine.monitors


def test_sections_follow_a_trajectory_that_the_machine_made(small_ring):
    """Thick tracking of AT as referee: nothing is off by more than 0.1 um at 1 mm."""
    data = simulate(
        small_ring, shots=4, seed=1, kicks=2e-5, noise=1e-12, launch_sigma=[0] * 5
    ).measurement()
    count = len(small_ring.monitors)
    sections = Sections(small_ring, data.settings, np.arange(count))
    sigma = np.full((count, 2), 1e-7)
    passes = Passes(data.readings[:, 0], sigma, np.zeros(4), np.arange(4), np.zeros(4, dtype=int))
    (found,) = sections.fit([passes])
    assert np.abs(found.left).max() < 1
    assert np.abs(found.start[:, 0] - data.launches[:, :4]).max() < 2e-7


def test_measurements_fitted_together_are_those_of_each_alone(small_ring, machine):
    """Some follow no trajectory, and take more steps."""
    count = len(machine.monitors)
    sections = Sections(small_ring, machine.settings, np.arange(count))
    shots, order = np.arange(len(machine.shots)), np.random.default_rng(1).permutation(count)
    read = machine.readings[:, 0]
    several = [
        Passes(own, machine.noise, machine.launches[:, 4], shots, 0 * shots, alone)
        for own in (read, read * [-1, 1], read[:, order], 1e3 * read) for alone in (True, False)
    ]  # fmt: skip
    for together, own in zip(sections.fit(several), several, strict=True):
        (alone,) = sections.fit([own])
        for name in ("start", "delta", "misfit", "energy", "kicked"):
            np.testing.assert_allclose(
                getattr(together, name), getattr(alone, name), rtol=1e-9, atol=1e-12
            )


def test_check_prints_a_table_and_writes_its_schema(tmp_path, machine):
    write_measurement(tmp_path / "good", machine)
    write_measurement(tmp_path / "bad", replace(machine, readings=machine.readings * [-1, 1]))
    done = tmlattice("check", SMALL, "good", "--json", "c.json", cwd=tmp_path, check=0)
    assert "no global error" in done.stdout
    valid(tmp_path / "c.json", "check")
    done = tmlattice("check", SMALL, "bad", "--json", "c.json", cwd=tmp_path, check=1)
    assert "--assume x-reversed" in " ".join(done.stdout.split())
    assert valid(tmp_path / "c.json", "check")["status"] == "wrong"
    tmlattice("check", SMALL, "bad", "--assume", "x-reversed", "-q", cwd=tmp_path, check=0)
    done = tmlattice("diagnose", SMALL, "bad", cwd=tmp_path, check=2)
    assert "x has the wrong sign at every BPM" in done.stderr


def where(data, share=0.03):
    """Places of a share of the readings, [shot, turn, monitor]."""
    return np.random.default_rng(7).random(data.readings.shape[:-1]) < share


@pytest.mark.parametrize("fill", [-9999.0, -0.1, 0.0])
def test_numbers_that_stand_for_no_reading_are_left_out(small_ring, machine, fill):
    there = where(machine)
    data = replace(machine, readings=np.where(there[..., None], fill, machine.readings))
    (found,) = reported(check_data(small_ring, data), "note")
    assert found.sentence.startswith(f"{2 * there.sum()} readings are {fill:g} m")
    (finding,) = diagnose(small_ring, data).findings
    assert finding.element == "QD::5"


def test_outliers_are_left_out_before_a_fault_is_sought(small_ring, machine):
    there = np.random.default_rng(5).random(machine.readings.shape) < 0.01
    data = replace(machine, readings=machine.readings + 5e-3 * there)
    result = diagnose(small_ring, data)
    assert [own.element for own in result.findings] == ["QD::5"]
    assert any(sentence.startswith("outliers, rejected") for sentence in result.warnings)


UNLIKE = {
    "another unit": lambda shot: 1e3 * shot,
    "planes swapped": lambda shot: shot[..., ::-1],
    "noise": lambda shot: 1e-3 * np.random.default_rng(2).standard_normal(shot.shape),
}


@pytest.mark.parametrize("kind", UNLIKE)
def test_a_shot_unlike_the_others_is_left_out(small_ring, machine, kind):
    readings = machine.readings.copy()
    readings[2] = UNLIKE[kind](readings[2])
    data = replace(machine, readings=readings)
    (found,) = reported(check_data(small_ring, data), "note")
    assert found.name == "shots"
    assert found.sentence.startswith("shot 2 is rejected")
    if kind == "noise":
        assert [own.element for own in diagnose(small_ring, data).findings] == ["QD::5"]


LAUNCHES = {
    "rms ten times too small": lambda m: {"launch_sigma": m.launch_sigma / 10},
    "in another order": lambda m: {"launches": m.launches[::-1]},
    "none": lambda m: {"launches": 0 * m.launches},
    "exact": lambda m: {"launch_sigma": 0 * m.launch_sigma},
}


@pytest.mark.parametrize("kind", LAUNCHES)
def test_launches_that_are_not_those_of_the_shots(small_ring, healthy, kind):
    data = replace(healthy, **LAUNCHES[kind](healthy))
    (check,) = reported(check_data(small_ring, data))
    assert (check.name, check.assume) == ("launches", ("launches-unknown",))
    assert "of every shot" in check.sentence
    assert reported(check_data(small_ring, data, assumed=check.assume)) == []


def test_launches_of_two_shots_that_are_exchanged(small_ring, healthy):
    launches = healthy.launches[[1, 0, *range(2, len(healthy.shots))]]
    (check,) = reported(check_data(small_ring, replace(healthy, launches=launches)))
    assert "of shot 0, 1 differ" in check.sentence


def test_readings_of_twice_the_size_contradict_the_launches(small_ring, healthy):
    (check,) = reported(check_data(small_ring, replace(healthy, readings=2 * healthy.readings)))
    assert "being 2 times these" in check.sentence


def test_a_unit_that_is_not_known_leaves_launches_of_another_size(small_ring, healthy):
    data = replace(healthy, readings=1e4 * healthy.readings)
    units, size = reported(check_data(small_ring, data))
    assert units.assume == ("readings-in-um",)
    ratios = [float(own) for own in re.findall(r"([.\d]+) times these in", size.sentence)]
    assert ratios == pytest.approx([0.01, 0.01], rel=0.1)


@pytest.mark.parametrize("of", [np.mean, lambda rows, axis: rows[0]], ids=["mean", "first"])
def test_differences_of_rows_are_not_their_readings(small_ring, healthy, steps, of):
    turns = replace(healthy, readings=healthy.readings - of(healthy.readings, axis=0))
    response = replace(steps, response=steps.response - of(steps.response, axis=0))
    if of is np.mean:
        for data in (turns, response):
            with pytest.raises(MeasurementError, match=r"are differences from their mean"):
                diagnose(small_ring, data)
        return
    found = reported(check_data(small_ring, turns), "note")
    assert "1 of 6 shots (or the other shots are differences from this one)" in found[0].sentence
    found = reported(check_data(small_ring, response), "note")
    text = f"rejected: 1 of {len(steps.correctors)} columns, 0 or the same as another"
    assert found[0].sentence.startswith(text)


def test_planes_in_different_units(small_ring, healthy):
    data = replace(healthy, readings=healthy.readings * [1e3, 1])
    (check,) = reported(check_data(small_ring, data))
    assert "x and y are in different units" in check.sentence


def block(data):
    """Two blocks of six BPMs with each other's readings."""
    order = np.arange(len(data.monitors))
    order[10:16], order[18:24] = np.arange(18, 24), np.arange(10, 16)
    return order


def test_blocks_of_bpms_that_are_exchanged(small_ring, healthy, steps):
    order = block(healthy)
    (check,) = reported(
        check_data(small_ring, replace(healthy, readings=healthy.readings[:, :, order]))
    )
    assert (check.name, check.assume) == ("order", ())
    assert "BPMs have the names of others" in check.sentence
    (check,) = reported(check_data(small_ring, replace(steps, response=steps.response[:, order])))
    assert check.sentence.startswith("12 BPMs have the names of others")
    assert f"{steps.monitors[10]} has what {steps.monitors[18]} should have" in check.sentence


@pytest.mark.parametrize(("plane", "factor"), [(0, 2.0), (1, 0.5)])
def test_one_plane_of_another_size(small_ring, thomx, plane, factor):
    """First turns of usual errors contradict the launches; a response contradicts the design."""
    turns = simulate(small_ring, background={"all": None}, shots=6, seed=3).measurement()
    times = np.where(np.arange(2) == plane, factor, 1.0)
    (check,) = reported(check_data(small_ring, replace(turns, readings=times * turns.readings)))
    ratio, where = check.sentence.partition("being ")[2].split(" times these in ")
    assert (check.name, where[0]) == ("launches", "xy"[plane])
    assert float(ratio) == pytest.approx(factor, rel=0.2)
    ring, steps = thomx
    assert reported(check_data(ring, steps)) == []
    for data in (
        replace(steps, response=times * steps.response),
        replace(steps, kicks=steps.kicks / times[["xy".index(p) for p in steps.planes]]),
    ):
        (check,) = reported(check_data(ring, data))
        assert f"times the design's in {'xy'[plane]}: " in check.sentence
        assert f"in {'yx'[plane]}" not in check.sentence


def test_columns_that_repeat_another_are_left_out(small_ring, steps):
    response = steps.response.copy()
    response[5] = response[3]
    (check,) = reported(check_data(small_ring, replace(steps, response=response)), "note")
    assert f"{steps.correctors[3]}, {steps.correctors[5]}" in check.sentence


def test_the_sign_of_a_plane_with_one_corrector(small_ring, steps):
    (check,) = reported(check_data(small_ring, replace(steps, response=steps.response * [-1, 1])))
    assert re.search(r"are -(0.9|1)\S* times the design's in x: ", check.sentence)


def test_correctors_of_both_planes_in_another_order(thomx):
    ring, steps = thomx
    (check,) = reported(check_data(ring, replace(steps, response=steps.response[::-1])))
    assert f"{len(steps.correctors)} correctors have the names of others" in check.sentence


def test_one_corrector_of_a_plane_shows_no_order_of_bpms(small_ring):
    """The design is far off: by 8 % in one family."""
    causes = [Cause("family_gradient", "QF", 0.08)]
    data = simulate_response(small_ring, causes, progress=False, engine="ocelot").measured
    assert "order" not in [check.name for check in reported(check_data(small_ring, data))]


def test_correctors_in_another_order(small_ring, steps):
    """Those of y, the other way round; of x there is one."""
    order = np.arange(len(steps.planes))
    vertical = np.flatnonzero(np.array(steps.planes) == "y")
    order[vertical] = vertical[np.random.default_rng(0).permutation(len(vertical))]
    (check,) = reported(check_data(small_ring, replace(steps, response=steps.response[order])))
    assert "correctors have the names of others" in check.sentence


def test_a_bpm_whose_signal_is_constant_in_a_response(small_ring, steps):
    response = steps.response.copy()
    response[:, 14] = [1.2e-3, -4e-4]
    found = check_data(small_ring, replace(steps, response=response))
    assert reported(found) == []
    assert f"the same for every corrector, and are rejected, of {steps.monitors[14]}" in (
        next(check for check in found.checks if check.name == "recording").sentence
    )


def test_outliers_of_a_response_are_no_other_ring(small_ring, steps):
    there = np.random.default_rng(5).random(steps.response.shape) < 0.01
    data = replace(steps, response=steps.response + 5e-3 * there)
    assert reported(check_data(small_ring, data)) == []


def test_rounded_readings_have_a_larger_noise(small_ring, machine):
    data = replace(machine, readings=np.round(machine.readings, 4))
    found = check_data(small_ring, data)
    assert reported(found) == []
    assert "rounded to 100 µm" in reported(found, "note")[0].sentence
    (finding,) = diagnose(small_ring, data).findings
    assert finding.element == "QD::5"
    found = check_data(small_ring, replace(machine, readings=np.round(machine.readings, 3)))
    assert "no beam reads" not in str(found.checks)


def test_bpms_in_no_order_are_no_known_order(small_ring, healthy):
    """By chance another order explains those of seed 2 somewhat better."""
    for seed, wrong in ((1, [("lattice", ())]), (2, [])):
        order = np.random.default_rng(seed).permutation(len(healthy.monitors))
        data = replace(healthy, readings=healthy.readings[:, :, order])
        checks = reported(check_data(small_ring, data))
        assert [(check.name, check.assume) for check in checks] == wrong


@pytest.mark.parametrize("factor", [1.01, 1e-6])
def test_an_rf_that_is_not_this_rings(small_ring, steps, factor):
    rf = replace(steps.rf, frequency=factor * steps.rf.frequency, step=factor * steps.rf.step)
    checks = reported(check_data(small_ring, replace(steps, rf=rf)))
    assert "belongs to a circumference of" in checks[0].sentence


def test_turns_in_which_half_of_the_bpms_are_silent(small_ring, machine):
    data = replace(machine, readings=machine.readings * np.where(
        np.arange(len(machine.monitors)) % 2, 1, np.nan)[:, None])  # fmt: skip
    assert [own.element for own in diagnose(small_ring, data).findings] == ["QD::5"]


def test_missing_readings_do_not_hide_the_order(small_ring, healthy):
    readings = np.where(where(healthy, 0.05)[..., None], np.nan, healthy.readings)
    assert reported(check_data(small_ring, replace(healthy, readings=readings))) == []
    (check,) = reported(
        check_data(small_ring, replace(healthy, readings=readings[:, :, block(healthy)]))
    )
    assert check.name == "order"


def test_turns_of_a_healthy_ring_next_to_an_integer_are_its_own():
    """Its lines are those of the design to 100 %; those of BPMs in another order to 139 %."""
    path = Path(machine_data.__file__).parent / "dba.mat"
    ring = load_ring(path, monitors="M,DR_03*", correctors="DR_04,SF")
    own = simulate_turns(ring, background={"all": None}, seed=5).measured
    assert [c for c in check_data(ring, own).checks if c.status == "wrong"] == []
    names = np.random.default_rng(0).permutation(own.monitors)
    (check,) = reported(check_data(ring, replace(own, monitors=tuple(names))))
    assert check.sentence.startswith("the data are not those of")
