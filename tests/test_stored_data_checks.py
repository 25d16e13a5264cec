"""What is wrong everywhere in turns, orbits, dispersion and tunes is told; small errors are not."""

import re
from dataclasses import replace
from pathlib import Path

import machine_data
import numpy as np
import pytest
from shared import valid

from tmlattice import diagnose, load_ring
from tmlattice.challenge.kinds import measure
from tmlattice.diagnosis.data_checks import check_data
from tmlattice.errors import MeasurementError
from tmlattice.machine.stored_beam import simulate_orbits, simulate_turns
from tmlattice.measurement import TuneReading

KINDS = ("turn_by_turn", "closed_orbit", "dispersion", "tunes")


@pytest.fixture(scope="module")
def sound(small_ring):
    """Of a machine with all usual small errors."""
    own = {"background": {"all": None}, "seed": 3, "machine_seed": 3}
    made = {kind: measure(kind, small_ring, [], 1.0, 1, **own) for kind in KINDS[1:]}
    return {"turn_by_turn": simulate_turns(small_ring, turns=200, **own).measured, **made}


def wrong_in(ring, data):
    found = [check for check in check_data(ring, data).checks if check.status == "wrong"]
    assert len(found) == 1, [check.sentence for check in found]
    return found[0].sentence


def turns(data, change):
    return replace(data, readings=change(data.readings))


def step(data, change):
    return replace(data, steps=(replace(data.steps[0], orbit=change(data.steps[0].orbit)),))


@pytest.mark.parametrize("kind", KINDS)
def test_small_errors_are_nothing_global(small_ring, sound, kind):
    found = check_data(small_ring, sound[kind])
    assert found.kind == kind
    assert found.status != "wrong", [check.sentence for check in found.reported]
    valid(found.as_json(), "check")


def test_tunes_of_usual_errors_that_resemble_the_other_plane_are_not_swapped():
    """Qx = 0.157 and Qy = 0.228, where usual errors move each by 0.03; here by 0.07 and 0.06."""
    soleil = load_ring(Path(machine_data.__file__).parent / "soleil.m")
    read = TuneReading(tune=np.array([[0.2273, 0.1728]]))
    assert check_data(soleil, read).status != "wrong"


CHANGES = {
    "x and y are swapped": lambda values: values[..., ::-1],
    "1 place downstream": lambda values: np.roll(values, 1, axis=-2),
    "reverse order": lambda values: values[..., ::-1, :],
}


@pytest.mark.parametrize("said", CHANGES)
def test_turns_in_another_order(small_ring, sound, said):
    assert said in wrong_in(small_ring, turns(sound["turn_by_turn"], CHANGES[said]))


def test_turns_of_a_monitor_without_signal_are_left_out(small_ring, sound):
    readings = sound["turn_by_turn"].readings.copy()
    readings[0, readings.shape[1] // 2 + 5 :, 3] = 0.0
    data = replace(sound["turn_by_turn"], readings=readings)
    found = {check.name: check.sentence for check in check_data(small_ring, data).reported}
    count = 2 * (readings.shape[1] - readings.shape[1] // 2 - 5)
    assert found["recording"].startswith(f"{count} readings are the same as those before")
    assert data.monitors[3] in found["recording"]


@pytest.mark.parametrize(("which", "late"), [(slice(1, None, 2), 1), (slice(16, None), -2)])
def test_bpms_that_count_turns_otherwise(small_ring, sound, which, late):
    readings = sound["turn_by_turn"].readings.copy()
    readings[:, :, which] = np.roll(readings[:, :, which], -late, axis=1)
    sentence = wrong_in(small_ring, replace(sound["turn_by_turn"], readings=readings))
    assert re.match(r"1[6-9] BPMs count turns otherwise", sentence)
    assert f"({late:+d})" in sentence or f"({-late:+d})" in sentence


def test_a_turn_that_is_off_at_every_bpm_is_rejected(small_ring, sound):
    readings = sound["turn_by_turn"].readings.copy()
    readings[:, readings.shape[1] // 2] += 5e-3
    data = replace(sound["turn_by_turn"], readings=readings)
    found = [check.sentence for check in check_data(small_ring, data).reported]
    assert any("the noise from the fit are rejected" in sentence for sentence in found)
    assert not any("residual noise" in sentence for sentence in found)


def test_turns_that_are_numbered_backwards(small_ring, sound):
    data = turns(sound["turn_by_turn"], lambda values: values[:, ::-1])
    assert "numbered backwards" in wrong_in(small_ring, data)


def test_a_sign_a_unit_and_the_planes_of_a_dispersion(small_ring, sound):
    data = sound["dispersion"]
    assert "swapped" in wrong_in(small_ring, step(data, lambda values: values[..., ::-1]))
    assert "wrong sign" in wrong_in(small_ring, step(data, lambda values: -values))
    assert "a thousand times too small" in wrong_in(small_ring, step(data, lambda v: 1e-3 * v))


def test_a_diagnosis_refuses_what_is_wrong_everywhere(small_ring, sound):
    exchanged = turns(sound["turn_by_turn"], CHANGES["x and y are swapped"])
    with pytest.raises(MeasurementError, match="x and y are swapped"):
        diagnose(small_ring, exchanged)
    flipped = step(sound["dispersion"], lambda values: -values)
    with pytest.raises(MeasurementError, match="dispersion: x has the wrong sign"):
        diagnose(small_ring, {"tunes": sound["tunes"], "dispersion": flipped})


@pytest.mark.parametrize("kind", KINDS)
def test_a_diagnosis_repeats_what_its_checks_noted(small_ring, sound, kind):
    data = replace(sound[kind], energy=1.2 * small_ring.energy)
    found = diagnose(small_ring, data, effects=["quadrupole_gradient"])
    note = next(one.sentence for one in check_data(small_ring, data).reported)
    assert "energy" in note
    assert any(note in warning for warning in found.warnings)


def test_another_ring(small_ring, sound):
    """Monitors in no order at all are those of no ring that is known here."""
    mixed = np.random.default_rng(1).permutation(len(small_ring.monitors))
    data = turns(sound["turn_by_turn"], lambda values: values[:, :, mixed])
    assert "not those of" in wrong_in(small_ring, data)
    other = np.random.default_rng(2).normal(0.0, 1e-3, (len(mixed), 2))
    data = step(sound["dispersion"], lambda values: other)
    assert "not those of" in wrong_in(small_ring, data)


def test_orbits_whose_correctors_were_set_tell_their_sign(small_ring):
    settings = [{"v6": {"kick": 1e-4}}, {"v6": {"kick": -1e-4}}, {}]
    data = simulate_orbits(small_ring, [], shots=3, settings=settings, seed=1).measured
    assert check_data(small_ring, data).status != "wrong"
    flipped = replace(data, orbit=-data.orbit)
    assert "sign" in wrong_in(small_ring, flipped)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda q: q[:, ::-1], "x and y are swapped"),
        (lambda q: 1 - q, "both tunes are 1 - Q"),
        (lambda q: np.array([[1 - q[0, 0], q[0, 1]]]), "Qx is 1 - Qx"),
        (lambda q: np.full((1, 2), 0.44), "not those of"),
    ],
)
def test_tunes(small_ring, sound, change, said):
    assert said in wrong_in(small_ring, TuneReading(tune=change(sound["tunes"].tune)))


def test_what_is_assumed_of_them_is_undone(small_ring, sound):
    exchanged = turns(sound["turn_by_turn"], lambda values: values[..., ::-1])
    assert check_data(small_ring, exchanged, assumed=["planes-swapped"]).status != "wrong"
    flipped = step(sound["dispersion"], lambda values: -values)
    assert check_data(small_ring, flipped, assumed=["rf-reversed"]).status != "wrong"
    folded = TuneReading(tune=1 - sound["tunes"].tune)
    assert check_data(small_ring, folded, assumed=["tunes-folded"]).status != "wrong"
    with pytest.raises(MeasurementError, match="no meaning for a dispersion measurement"):
        check_data(small_ring, sound["dispersion"], assumed=["turns-backwards"])
