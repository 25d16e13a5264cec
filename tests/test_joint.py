"""Several measurements of one machine, and those of a stored beam, in one diagnosis."""

import json
from dataclasses import replace

import numpy as np
import pytest

from tests.command import tmlattice
from tmlattice import Cause, correct, diagnose, simulate, write_measurement
from tmlattice.effects import apply, background_rms
from tmlattice.errors import EffectError, MeasurementError
from tmlattice.lattice import save_ring
from tmlattice.machine import draw_background
from tmlattice.machine.response import simulate_response
from tmlattice.machine.stored_beam import (
    simulate_dispersion,
    simulate_orbits,
    simulate_tunes,
    simulate_turns,
)
from tmlattice.maps import ring_matrix
from tmlattice.measurement import ClosedOrbit
from tmlattice.optics import matrix_tunes, ring_tunes

KICK = Cause("corrector_kick_x", "v6", 3e-5)
WEAK = Cause("quadrupole_gradient", "QD::3", -0.01)
NOISE = 2e-6


def _orbit(ring, causes, seed=1):
    return simulate_orbits(ring, causes, noise=NOISE, seed=seed).measured


def _dispersion(ring, causes, seed=2):
    return simulate_dispersion(ring, causes, noise=NOISE, seed=seed).measured


def _tunes(ring, causes, seed=103):
    read = simulate_tunes(ring, causes, chromaticity=False, noise=(1e-4, 1e-2), seed=seed)
    return read.measured


def _turns(ring, causes, seed=4):
    return simulate_turns(ring, causes, shots=2, turns=300, noise=1e-5, seed=seed).measured


def _found(diagnosis):
    return {
        (f.recommended_action.effect, f.element) for f in diagnosis.findings if f.recommended_action
    }


def test_each_sees_its_part_and_both_are_named(small_ring):
    truth = [KICK, WEAK]
    whole = {
        "orbit": _orbit(small_ring, truth),
        "dispersion": _dispersion(small_ring, truth),
        "tunes": _tunes(small_ring, truth),
        "turns": _turns(small_ring, truth),
        "injection": simulate(small_ring, truth, shots=3, seed=1).measurement(),
    }
    effects = ["quadrupole_gradient", "quadrupole_offset_x", KICK.effect, "monitor_gain_x"]
    diagnosis = diagnose(small_ring, whole, effects=effects)
    assert diagnosis.verdict in ("identified", "ambiguous")
    assert _found(diagnosis) == {(KICK.effect, KICK.element), (WEAK.effect, WEAK.element)}
    amount, sigma = diagnosis.error(WEAK.effect, WEAK.element)
    assert abs(amount - WEAK.amount) < 4 * sigma
    assert sigma < 2e-4
    shares = {f.recommended_action.effect: f.seen_by for f in diagnosis.findings}
    for share in shares.values():
        assert sum(share.values()) == pytest.approx(1.0)
    assert shares[KICK.effect]["orbit"] > 0.9
    assert shares[WEAK.effect]["turns"] > shares[WEAK.effect]["injection"]
    assert diagnosis.fit_after.chi2_per_dof == pytest.approx(1.0, abs=0.1)
    assert diagnosis.gap["heldout"]["after"]["chi2_per_dof"] < 1.3
    assert [p.kind for p in diagnosis.parts] == [
        "closed_orbit", "dispersion", "tunes", "turn_by_turn", "trajectory",
    ]  # fmt: skip


def test_the_energy_of_a_launch_and_that_of_a_stored_beam_are_two(small_ring):
    launched = simulate(small_ring, shots=2, seed=2).measurement()
    whole = {"orbit": _orbit(small_ring, [KICK]), "injection": launched}
    with pytest.raises(EffectError, match="none of these effects can be looked for here"):
        diagnose(small_ring, whole, effects=["energy_offset"])


def test_what_takes_no_part_is_told(small_ring):
    read = simulate_orbits(small_ring, [KICK], shots=6, noise=NOISE).measured
    orbits = read.orbit.copy()
    orbits[:, 12] = np.nan
    orbits[2, 7, 0] += 3e-4
    told = diagnose(small_ring, replace(read, orbit=orbits), holdout=0).warnings
    silent, spiked = read.monitors[12], read.monitors[7]
    assert any("no usable reading" in one and f" {silent}:" in one for one in told)
    assert any("outliers" in one and one.endswith(f" {spiked}") for one in told)


def test_held_out_orbits_state_how_much_is_explained(small_ring):
    read = simulate_orbits(small_ring, [KICK], shots=6, noise=NOISE).measured
    found = diagnose(small_ring, read)
    assert found.heldout.readings == 2 * read.orbit[0].size  # all, without nuisances
    low, high = found.heldout.interval
    assert 0.98 < low <= found.heldout.explained <= high
    assert found.heldout.misfits[-1].chi2_per_dof == pytest.approx(1.0, abs=0.25)  # 136 readings
    assert found.heldout.misfits[-1].expected == pytest.approx(NOISE, rel=0.05)


def test_what_is_left_where_nothing_is_explained_is_what_was_there(small_ring):
    """One cause more than may be named: neither is in the model that is shown."""
    faint = Cause("corrector_kick_y", "v9", 1.4e-6)
    both = {"orbit": _orbit(small_ring, [KICK, faint]), "turns": _turns(small_ring, [])}
    found = diagnose(small_ring, both, background={}, max_effects=1)
    assert found.verdict == "distributed"
    assert not found.causes
    assert found.unexplained["p_value"] < 1e-12
    assert found.assessment.remainder in ("above_noise", "effect_missing")


def test_a_beam_that_is_lost_early_is_told(small_ring):
    turns = _turns(small_ring, [WEAK])
    readings = turns.readings.copy()
    readings[1, 120:] = np.nan
    diagnosis = diagnose(small_ring, replace(turns, readings=readings))
    assert any("shot 1" in said and "turn" in said for said in diagnosis.warnings)
    assert (WEAK.effect, WEAK.element) in _found(diagnosis)


def test_what_is_sought_beside_a_doubt_makes_the_readings_likelier(small_ring):
    """Small errors fitted together with a supply that a scan doubted left it to be found."""
    orbit = simulate_orbits(
        small_ring, [], noise=(2.53e-6, 2.53e-6), background={"all": None}, seed=758855874,
        machine_seed=758855873,
    ).measured  # fmt: skip
    assert not diagnose(small_ring, orbit).findings


@pytest.mark.parametrize("make", [_orbit, _dispersion, _tunes, _turns])
def test_what_was_there_before_is_nothing_now(small_ring, make):
    """The same faulty machine measured twice; of turns, which take longest, the folder itself."""
    fault = Cause("quadrupole_gradient", "QD::4", -0.05)
    before, after = (make(small_ring, [fault], seed=seed) for seed in (70, 71))
    found = diagnose(small_ring, after, reference=after if make is _turns else before)
    assert (found.verdict, found.findings) == ("none", ())


def test_a_corrector_that_is_held_out_is_named_too(small_ring):
    """It was `nothing`, with 69 times the noise's square in the held-out readings."""
    wrong = [Cause("corrector_calibration", "v3", 0.2)]
    made = {"engine": "ocelot", "progress": False, "seed": 1}
    response = simulate_response(small_ring, wrong, **made).measured
    both = {"response": response, "dispersion": _dispersion(small_ring, wrong)}
    (found,) = diagnose(small_ring, both, seed=0).findings  # which holds v3 out
    assert (found.effect, found.element) == ("corrector_calibration", "v3")
    assert abs(found.amount - 0.2) < 4 * found.amount_sigma


def test_the_command_takes_many_folders(small_ring, tmp_path):
    save_ring(small_ring, tmp_path / "ring.json")
    write_measurement(tmp_path / "turns", _turns(small_ring, [WEAK]))
    write_measurement(tmp_path / "tunes", _tunes(small_ring, [WEAK]))
    told = tmlattice(
        "diagnose", "ring.json", "turns", "tunes", "--json", "d.json", "--out", "page",
        "--effects", "quadrupole_gradient,quadrupole_roll", cwd=tmp_path, check=0,
    )  # fmt: skip
    assert "QD::3" in told.stdout
    assert "seen by" in told.stdout
    document = json.loads((tmp_path / "d.json").read_text())
    assert document["kind"] == "together"
    assert [m["name"] for m in document["measurements"]] == ["turns", "tunes"]
    assert set(document["findings"][0]["seen_by"]) == {"turns", "tunes"}
    numbers = {n["quantity"]: n for n in document["measurements"][1]["numbers"]}
    assert list(numbers) == ["tune_x", "tune_y"]
    for plane, own in enumerate(numbers.values()):  # by the product of OCELOT's matrices
        for ring, said in ((small_ring, "before"), (apply(small_ring, [WEAK]), "after")):
            assert abs(own[said] - matrix_tunes(ring_matrix(ring))[plane]) < 3e-4
        assert f"{own['read']:.5f} ± 0.00010" in told.stdout
    assert "no reading in x" not in tmlattice("diagnose", "ring.json", "tunes", cwd=tmp_path).stdout
    assert (tmp_path / "page" / "report.html").stat().st_size > 1000
    assert (tmp_path / "page" / "readings.png").exists()


def test_what_has_no_meaning_is_a_sentence(small_ring):
    with pytest.raises(MeasurementError, match="'missing' has no meaning"):
        diagnose(small_ring, _turns(small_ring, []), missing=True)
    orbit = _orbit(small_ring, [])
    unknown = ClosedOrbit(orbit=orbit.orbit, monitors=orbit.monitors)
    with pytest.raises(MeasurementError, match="noise of a closed orbit is unknown"):
        diagnose(small_ring, unknown)


def test_readings_that_are_given_twice_are_refused(small_ring):
    data = {"monday": _orbit(small_ring, [KICK]), "again": _orbit(small_ring, [KICK])}
    with pytest.raises(MeasurementError, match="'monday' and 'again' contain the same readings"):
        diagnose(small_ring, data)
    data["again"] = _orbit(small_ring, [KICK], seed=5)
    assert diagnose(small_ring, data).verdict in {"identified", "ambiguous"}


# --- a model that learns --------------------------------------------------------------------------


def test_what_was_known_of_another_ring_goes_with_it(small_ring, tmp_path):
    save_ring(small_ring, tmp_path / "ring.json")
    write_measurement(tmp_path / "sound", _tunes(small_ring, []))
    for name in ("twin.json.known.json", "twin.json.calibration.json"):
        (tmp_path / name).write_text("of the ring before")
    words = ["diagnose", "ring.json", "sound", "--lattice-out", "twin.json", "-q"]
    tmlattice(*words, cwd=tmp_path, check=0)
    assert [path.name for path in tmp_path.glob("twin.json*")] == ["twin.json"]


def test_what_is_known_is_written_beside_the_lattice(small_ring, tmp_path):
    small = draw_background(small_ring, background_rms({"all": None}), 21)
    save_ring(small_ring, tmp_path / "ring.json")
    write_measurement(tmp_path / "monday", _orbit(small_ring, small))
    write_measurement(tmp_path / "tuesday", _orbit(small_ring, small, seed=99))
    tmlattice(
        "diagnose", "ring.json", "monday", "--lattice-out", "twin.json", "-q", cwd=tmp_path, check=0
    )
    assert (tmp_path / "twin.json.known.json").is_file()
    told = tmlattice("diagnose", "twin.json", "tuesday", cwd=tmp_path, check=0)
    assert told.stdout.startswith("NONE")
    assert "is not there" not in told.stderr
    (tmp_path / "twin.json").rename(tmp_path / "moved.json")
    moved = tmlattice("diagnose", "moved.json", "tuesday", "--effects", "monitor_gain_x",
                      cwd=tmp_path, check=0)  # fmt: skip
    assert "'moved.json.known.json' is not there" in moved.stderr
    (tmp_path / "moved.json").rename(tmp_path / "twin.json")
    tmlattice("diagnose", "twin.json", "tuesday", "--json", "twin.json.known.json",
              cwd=tmp_path, check=2)  # fmt: skip
    lattice = (tmp_path / "twin.json").read_text()
    (tmp_path / "twin.json").write_text(lattice.replace("0.9", "0.91", 1))
    told = tmlattice("diagnose", "twin.json", "tuesday", cwd=tmp_path, check=2)
    assert "is not the file any more that it was written with" in told.stderr
    (tmp_path / "twin.json").write_text(lattice)
    file = tmp_path / "twin.json.known.json"
    document = json.loads(file.read_text())
    document["small_errors"][0]["element"] = "nowhere"
    file.write_text(json.dumps(document))
    told = tmlattice("diagnose", "twin.json", "tuesday", cwd=tmp_path, check=2)
    assert "it is of another ring" in told.stderr
    document["seen"]["float32"] = "AAAA"
    file.write_text(json.dumps(document).replace("nowhere", small_ring.monitors[0].name))
    tmlattice("diagnose", "twin.json", "tuesday", cwd=tmp_path, check=2)


def test_what_both_days_have_is_in_the_model_of_each(small_ring):
    """An energy and a strong kick in both, of which neither day's readings keep a residual."""
    both = [Cause("energy_offset", None, 2e-3), Cause("corrector_kick_y", "v2", 1e-4)]
    before, after = (
        simulate_orbits(small_ring, causes, shots=6, noise=NOISE, seed=seed).measured
        for seed, causes in enumerate((both, [*both, KICK]))
    )
    result = diagnose(small_ring, after, reference=before)
    assert _found(result) == {(KICK.effect, KICK.element)}
    assert result.fit_after.chi2_per_dof == pytest.approx(1.0, abs=0.2)
    assert result.heldout.misfits[-1].chi2_per_dof < 1.5
    assert result.heldout.explained > 0.99


def test_an_energy_is_matched_by_the_rf_and_not_by_magnets(small_ring):
    energy = Cause("energy_offset", None, 1e-3)
    result = diagnose(small_ring, _orbit(small_ring, [energy]))
    assert _found(result) == {("energy_offset", None)}
    assert result.tunes["after"] == pytest.approx(ring_tunes(small_ring, energy.amount), abs=1e-4)
    assert correct(result).settings == ()
