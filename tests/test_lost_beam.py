"""After the beam is lost the electronics go on: these readings are no signal, and no fault."""

import csv
from dataclasses import replace

import h5py
import numpy as np
import pytest

from tmlattice import Cause, diagnose, simulate
from tmlattice.beam.model import Model
from tmlattice.diagnosis import signals
from tmlattice.diagnosis.data_checks import check_data
from tmlattice.importers import Options, bring_in
from tmlattice.measurement import TurnByTurn
from tmlattice.measurement.lost_beam import beam_lost

pytestmark = pytest.mark.usefixtures("forked_readers")

FAULT = Cause("quadrupole_gradient", "QD::5", -0.2)
SOME = ["monitor_dead", "monitor_gain_x", "quadrupole_gradient", "quadrupole_offset_x"]
LOST = 20
"""BPMs that have a signal."""


@pytest.fixture(scope="module")
def data(small_ring):
    return simulate(small_ring, [FAULT], shots=6, seed=1).measurement()


def constant(data, value=0.0, shots=slice(None), after=LOST):
    readings = data.readings.copy()
    readings[shots, :, after:] = value
    return replace(data, readings=readings)


def lost_in(found):
    return {check.name: check for check in found.checks}["lost beam"]


def the_fault_alone(ring, data, effects=SOME):
    """The diagnosis, which finds no dead BPM."""
    result = diagnose(ring, data, effects=effects)
    (finding,) = result.findings
    assert (finding.effect, finding.element) == (FAULT.effect, FAULT.element)
    assert finding.amount == pytest.approx(FAULT.amount, abs=4 * finding.amount_sigma + 1e-3)
    return result


def test_shots_that_are_lost_at_different_places(small_ring, data):
    """Two zeros at the end of one shot are no readings where another shot ends in many."""
    readings = data.readings.copy()
    for shot, after in enumerate((10, 14, 18, 22, 26, len(data.monitors) - 2)):
        readings[shot, :, after:] = 0.0
    lost = beam_lost(replace(data, readings=readings))
    assert lost.first.tolist() == [10, 14, 18, 22, 26, len(data.monitors) - 2]
    assert not (lost.without.readings == 0).any()
    the_fault_alone(small_ring, replace(data, readings=readings), effects=None)


def test_a_fault_by_which_no_beam_comes_round_from_the_stated_launch(small_ring):
    """The launch is known to its stated error: from that of the fit the beam comes round."""
    fault = Cause("quadrupole_gradient", "QD::5", -0.8)
    own = {"shots": 4, "turns": 2, "amplitude": 3e-3, "seed": 0}
    found = diagnose(small_ring, simulate(small_ring, [fault], **own).measurement())
    assert [f.element for f in found.findings] == ["QD::5"]
    assert found.findings[0].amount == pytest.approx(-0.8, abs=0.01)


def test_one_shot_or_one_plane_that_stands_for_all_is_refused(small_ring, data):
    """Also where no launch is stated: noise is another in each shot."""
    for readings, words in (
        (np.repeat(data.readings[:1], 6, axis=0), "one reading was copied over the others"),
        (np.repeat(data.readings[..., :1], 2, axis=3), "x and y are the same to the last digit"),
    ):
        unknown = {"launches": np.zeros((6, 5)), "launch_sigma": np.full((6, 5), np.inf)}
        found = check_data(small_ring, replace(data, readings=readings, **unknown))
        assert any(c.status == "wrong" and words in c.sentence for c in found.checks)


OWN = np.random.default_rng(0).normal(0, 1e-3, (35 - LOST, 2))
"""Constants, each BPM's."""


@pytest.mark.parametrize("value", [0.0, OWN], ids=["zero", "each its own"])
def test_constants_after_a_bpm_in_all_shots_are_a_lost_beam(small_ring, data, value):
    lost = constant(data, value)
    check = lost_in(check_data(small_ring, lost))
    assert check.status == "note"
    assert f"no signal: beam lost after {data.monitors[LOST - 1]} " in check.sentence
    assert "every shot" in check.sentence
    result = the_fault_alone(small_ring, lost)
    assert [w for w in result.warnings if "no signal" in w] == [check.sentence]
    assert not any("35 BPMs" in w or "they are ignored" in w for w in result.warnings)


def test_a_beam_lost_near_the_end_leaves_no_dead_bpms(small_ring, data):
    """Few BPMs without a reading would else be a finding each."""
    the_fault_alone(small_ring, constant(data, after=31))
    the_fault_alone(small_ring, constant(data, np.nan, after=31))


def test_one_shot_shows_a_lost_beam_too(small_ring, data):
    one = constant(data.select(shots=[0]))
    said = lost_in(check_data(small_ring, one)).sentence
    assert f"beam lost after {data.monitors[LOST - 1]} " in said
    result = diagnose(small_ring, one)
    assert "QD::5" in {m.element for m in result.findings[0].credible_set}
    assert len(result.findings) == 1


def test_shots_that_end_at_different_bpms(small_ring, data):
    lost = constant(constant(data, 0.0, slice(0, 2)), 0.0, slice(2, 4), after=25)
    said = lost_in(check_data(small_ring, lost)).sentence
    assert f"between {data.monitors[LOST - 1]} " in said
    assert f"and {data.monitors[24]} " in said
    assert "in 4 of 6 shots" in said


def test_the_last_bpm_alone_is_frozen(small_ring, data):
    """A beam is lost for all that follow."""
    at = len(data.monitors) - 1
    readings = data.readings.copy()
    readings[:, :, at] = 1e-3, -2e-4
    frozen = replace(data, readings=readings)
    checks = {check.name: check for check in check_data(small_ring, frozen).checks}
    assert checks["lost beam"].status == "fine"
    assert data.monitors[at] in checks["frozen BPMs"].sentence
    found = {(f.effect, f.element) for f in diagnose(small_ring, frozen).findings}
    assert found == {("monitor_dead", data.monitors[at]), (FAULT.effect, FAULT.element)}


def test_coarse_readings_are_no_lost_beam(small_ring):
    """Neighbours read the same digit now and then: three in a row prove nothing."""
    coarse = simulate(small_ring, shots=4, seed=2, amplitude=2e-5, noise=5e-6).measurement()
    readings = np.round(coarse.readings / 5e-5) * 5e-5
    checks = check_data(small_ring, replace(coarse, readings=readings, noise=None))
    assert lost_in(checks).status == "fine"


def test_a_plane_of_zeros_was_not_read(small_ring, data):
    readings = data.readings.copy()
    readings[..., 1] = 0.0
    found = check_data(small_ring, replace(data, readings=readings))
    assert next(check.sentence for check in found.reported).startswith("no BPM reads y")
    the_fault_alone(small_ring, replace(data, readings=readings))


# --- sum signals ----------------------------------------------------------------------------------
def with_sums(data, rng):
    """Readings of noise after the loss, and sum signals of BPMs whose gains differ."""
    readings = data.readings.copy()
    readings[:, :, LOST:] = rng.normal(0, 3e-4, readings[:, :, LOST:].shape)
    sums = rng.uniform(600, 1400, (len(readings), len(data.monitors)))
    sums[:, LOST:] *= 0.01
    return readings[:, 0], sums


def long_table(path, data, readings, sums, name):
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["shot", "bpm", "x [mm]", "y [mm]", name])
        for shot, (values, own) in enumerate(zip(readings, sums, strict=True)):
            for monitor, (x, y), s in zip(data.monitors, values, own, strict=True):
                writer.writerow([shot, monitor, 1e3 * x, 1e3 * y, s])
    return path


def wide_table(path, data, readings, sums, name):
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        kinds = ("x [mm]", "y [mm]", name)
        writer.writerow(["shot", *(f"{m} {kind}" for m in data.monitors for kind in kinds)])
        for shot, (values, own) in enumerate(zip(readings, sums, strict=True)):
            row = np.column_stack([1e3 * values, own])
            writer.writerow([shot, *row.ravel()])
    return path


def hdf5_file(path, data, readings, sums, name):
    path = path.with_suffix(".h5")
    with h5py.File(path, "w") as file:
        file["names"] = [name.encode() for name in data.monitors]
        for plane, key in enumerate("xy"):
            file[key] = 1e3 * readings[..., plane]
            file[key].attrs["unit"] = "mm"
        file[name] = sums
    return path


@pytest.mark.parametrize(
    ("write", "name"), [(long_table, "sum"), (wide_table, "Intensity"), (hdf5_file, "sum")]
)
def test_sum_signals_say_where_the_beam_was(small_ring, data, tmp_path, rng, write, name):
    path = write(tmp_path / "readings.csv", data, *with_sums(data, rng), name)
    brought = bring_in([path], Options(ring=small_ring, noise=2e-5))
    read = np.isfinite(brought.measurement.readings).any(axis=(0, 1, 3))
    assert read.sum() == LOST
    (said,) = [text for text in brought.assumed if "sum signal" in text]
    assert f"at {35 - LOST} BPMs in 6 of 6 shots, the first is {data.monitors[LOST]}" in said
    if write is hdf5_file:
        the_fault_alone(small_ring, brought.measurement)
    assert lost_in(check_data(small_ring, brought.measurement)).status == "note"


def test_sum_signals_of_a_beam_change_nothing(small_ring, data, tmp_path, rng):
    sums = rng.uniform(0.3, 1.4, (6, 35))
    path = wide_table(tmp_path / "r.csv", data, data.readings[:, 0], sums, "charge [nC]")
    brought = bring_in([path], Options(ring=small_ring)).measurement
    np.testing.assert_allclose(brought.readings, data.readings, rtol=1e-9)


def test_a_sum_without_numbers_is_passed_over(small_ring, data, tmp_path):
    path = long_table(tmp_path / "r.csv", data, data.readings[:, 0], [["ok"] * 35] * 6, "sum")
    brought = bring_in([path], Options(ring=small_ring)).measurement
    np.testing.assert_allclose(brought.readings, data.readings, rtol=1e-9)


def test_turns_of_a_stored_beam_that_was_lost(small_ring):
    """Zeros behind a loss and in a gap are no readings; a BPM that repeats itself is frozen."""
    names = [monitor.name for monitor in small_ring.monitors]
    read = 1e-3 * np.random.default_rng(1).standard_normal((2, 64, len(names), 2))
    read[1, 40, 11:], read[1, 41:] = 0.0, 0.0
    read[0, 20:23] = 0.0
    turns = TurnByTurn(read, names, noise=2e-5)
    lost = beam_lost(turns)
    assert lost.shots.tolist() == [1]
    assert divmod(int(lost.first[1]), len(names)) == (40, 11)
    gone = np.isnan(lost.without.readings)
    assert gone[0, 20:23].all()
    assert gone.sum() == 2 * (3 * len(names) + 24 * len(names) - 11)
    frozen = 1e-3 * np.random.default_rng(2).standard_normal((1, 64, len(names), 2))
    frozen[0, 20:, 5] = 0.0
    found = {c.name: c for c in signals.monitors(small_ring, names, frozen[0])}
    assert found["frozen BPMs"].status == "note"
    assert names[5] in found["frozen BPMs"].sentence


def test_the_model_behind_a_lost_beam_stays_finite(small_ring):
    """Maps of second order overflow on the third turn; what was read before still has slopes."""
    launches = np.array([[0.3, 0.05, 0.3, 0.0, 0.0]])
    model = Model(small_ring, [{}], 3)
    paths = model.paths(launches)
    assert np.isnan(paths.beam[0, -1]).all()
    assert np.isfinite(paths.launch).all()
    found = model.signatures(paths, [("quadrupole_gradient", "QF::1")], launches)
    assert np.isfinite(found).all()
