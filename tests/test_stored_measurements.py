"""Folders of turns, closed orbits, dispersion and tunes: round trips, damage, order, parts."""

import json
import math

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from shared import valid

from tmlattice import read_measurement, write_measurement
from tmlattice.errors import MeasurementError, UnknownNameError
from tmlattice.measurement import ClosedOrbit, Dispersion, RfStep, TuneReading, TurnByTurn

SETTINGS = ({"q": {"k1_relative": 0.01}}, {})
MONITORS = ("a", 'b,"', "C")
reading = st.one_of(st.just(math.nan), st.floats(-0.2, 0.2), st.just(-0.0))
known = st.one_of(st.just(math.nan), st.floats(1e-9, 1e-3))
noises = st.none() | arrays(float, (3, 2), elements=known)
hints = {"lattice": "petra3", "energy": 6.0}


def turns_of(shape=(2, 16, 3, 2), **more):
    readings = np.arange(np.prod(shape), dtype=float).reshape(shape) * 1e-6
    return TurnByTurn(readings, ("a", "b", "c"), **more)


def round_trip(tmp_path, measured):
    write_measurement(tmp_path / "m", measured, force=True)
    read = read_measurement(tmp_path / "m")
    assert (type(read), read) == (type(measured), measured)  # to the last bit, NaN for NaN
    valid(tmp_path / "m" / "measurement.json", "measurement")


quick = settings(max_examples=25, deadline=None, suppress_health_check=list(HealthCheck))


def dispersion(orbits, noise):
    steps = [RfStep(499664399.423, 3840, *own) for own in zip((-300.0, 250.0), orbits, strict=True)]
    return Dispersion(tuple(steps), MONITORS, noise, **hints)


@pytest.mark.parametrize(
    ("shape", "make"),
    [
        ((2, 16, 3, 2), lambda *r: TurnByTurn(r[0], MONITORS, r[1], SETTINGS, (3, 1), **hints)),
        ((2, 3, 2), lambda *r: ClosedOrbit(r[0], MONITORS, r[1], SETTINGS, (3, 1), **hints)),
        ((2, 3, 2), dispersion),
    ],
    ids=["turns", "closed orbits", "dispersion"],
)
@quick
@given(st.data())
def test_readings_are_read_back_bit_by_bit(tmp_path, shape, make, data):
    readings = data.draw(arrays(float, shape, elements=reading))
    readings.flat[-1] = 1e-3
    round_trip(tmp_path, make(readings, data.draw(noises)))


@pytest.mark.parametrize("chromaticity", [None, [[1.5, -2.0], [math.nan, 3.0]]])
@pytest.mark.parametrize("error", [None, [[1e-4, math.nan], [1e-5, 1e-3]]])
def test_tunes_read_back_bit_by_bit(tmp_path, chromaticity, error):
    of_chromaticity = None if chromaticity is None else error
    tune = [[0.1234567890123456, 0.0], [math.nan, 0.9]]
    round_trip(
        tmp_path, TuneReading(tune, error, chromaticity, of_chromaticity, SETTINGS, (0, 4), **hints)
    )


def test_ring_gives_names_and_order(tmp_path):
    write_measurement(tmp_path / "m", turns_of(noise={"a": (1e-6, 2e-6)}))
    read = read_measurement(tmp_path / "m", ["C", "other", "A", "b"])
    assert read.monitors == ("C", "A", "b")
    np.testing.assert_array_equal(read.readings, turns_of().readings[:, :, [2, 0, 1]])
    np.testing.assert_array_equal(read.noise[1], [1e-6, 2e-6])
    with pytest.raises(MeasurementError, match=r"line 2: no BPM 'a'"):
        read_measurement(tmp_path / "m", ["b", "c", "d"])


def stored():
    orbit = np.arange(12, dtype=float).reshape(2, 3, 2) * 1e-6
    names = ("a", "b", "c")
    steps = tuple(RfStep(5e8, 100, 200.0, o) for o in orbit)
    return [
        (turns_of(noise=(1e-6, 2e-6)), lambda m: np.moveaxis(m.readings, 2, 0)),
        (ClosedOrbit(orbit, names, (1e-6, 2e-6)), lambda m: np.moveaxis(m.orbit, 1, 0)),
        (Dispersion(steps, names, (1e-6, 2e-6)), lambda m: np.moveaxis(m.orbits, 1, 0)),
    ]


@pytest.mark.parametrize(("measured", "values"), stored())
def test_monitors_in_another_order_keep_their_own_readings(measured, values):
    ring = ("x", "c", "b", "y", "a")
    spread = measured.in_order_of(ring)
    assert spread.monitors == ring
    for name in ring:
        own = values(spread)[ring.index(name)]
        if name in "xy":
            assert np.isnan(own).all()
            assert np.isnan(spread.noise[ring.index(name)]).all()
        else:
            np.testing.assert_array_equal(own, values(measured)["abc".index(name)])
    part = spread.select(monitors=["b", "c"])
    np.testing.assert_array_equal(values(part), values(measured)[1:][[0, 1]])
    np.testing.assert_array_equal(part.noise, [[1e-6, 2e-6]] * 2)
    with pytest.raises(UnknownNameError, match="no BPM 'a'"):
        part.select(monitors=["a"])
    with pytest.raises(UnknownNameError, match="no BPM 'c'"):
        part.in_order_of(["b"])


def test_shots_in_another_order_keep_their_settings():
    measured = turns_of(settings=SETTINGS, shots=(7, 2))
    part = measured.select(shots=[2, 7])
    assert part.shots == (2, 7)
    assert part.settings == SETTINGS[::-1]
    np.testing.assert_array_equal(part.readings, measured.readings[::-1])
    with pytest.raises(MeasurementError, match="no shot 3; there are 7, 2"):
        measured.select(shots=[3])


NAN = math.nan


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: turns_of((1, 15, 3, 2)), "15 turns are no turn-by-turn .* 'trajectory'"),
        (lambda: turns_of((1, 16, 2, 2)), "turns at 3 BPMs need"),
        (lambda: turns_of(shots=(1, 1)), "2 shots need 2 shot ids"),
        (lambda: turns_of(settings=({},)), "1 settings for 2 shots"),
        (lambda: turns_of(settings=({"q": {"k3": 1.0}}, {})), "no setting 'k3'"),
        (lambda: turns_of(energy=-1.0), "above zero"),
        (lambda: turns_of(noise=(0.0, 1.0)), "it is an rms"),
        (lambda: TurnByTurn(np.full((1, 10_001, 1, 2), 0.0), ("a",)), "16 to 10000; give fewer"),
        (lambda: TurnByTurn(np.full((1, 16, 1, 2), NAN), ("a",)), "every reading is missing"),
        (lambda: TurnByTurn(np.full((1, 16, 1, 2), math.inf), ("a",)), "a reading is infinite"),
        (lambda: ClosedOrbit(np.zeros((1, 2)), ("a",)), r"need \[shots, 1, 2\]"),
        (lambda: ClosedOrbit(np.full((1, 1, 2), NAN), ("a",)), "every reading is missing"),
        (lambda: Dispersion((), ("a",)), "no step of the RF"),
        (lambda: Dispersion((RfStep(5e8, 10, 0.0, [[0, 0]]),), ("a",)), "step of 0 Hz"),
        (lambda: Dispersion((RfStep(-5e8, 10, 1.0, [[0, 0]]),), ("a",)), "cannot be"),
        (lambda: Dispersion((RfStep(5e8, 10, 1.0),), ("a",)), r"orbit has the shape \(\)"),
        (
            lambda: Dispersion((RfStep(5e8, 10, 1.0, [[math.inf, 0]]),), ("a",)),
            "an orbit change is infinite",
        ),
        (lambda: TuneReading([0.1, 0.2, 0.3]), r"it should be \[shots, 2\]"),
        (lambda: TuneReading([[37.12, 0.2]]), r"37.12 is no fraction of the full tune"),
        (lambda: TuneReading([[0.1, 0.2]], [[0.0, 1e-3]]), "error of the tune is 0"),
        (lambda: TuneReading([[NAN, NAN]]), "every tune is missing"),
        (lambda: TuneReading([[0.1, 0.2]], None, [[1.0]]), "chromaticities have the shape"),
        (lambda: TuneReading([[0.1, 0.2]], None, [[math.inf, 1]]), "chromaticity is infinite"),
        (lambda: TuneReading([[0.1, 0.2]], None, None, [[0.1, 0.1]]), "need chromaticities"),
    ],
)
def test_impossible_records_are_errors_with_a_reason(make, words):
    with pytest.raises((MeasurementError, UnknownNameError), match=words):
        make()


def folder_of(tmp_path, kind, more, table):
    there = tmp_path / "m"
    there.mkdir()
    stated = {"format": "tmlattice-measurement", "version": 1, "kind": kind, **more}
    (there / "measurement.json").write_text(json.dumps(stated))
    name = "tunes.csv" if kind == "tunes" else "readings.csv"
    (there / name).write_text("\n".join(table) + "\n")
    return there


SHOT = {"shots": [{"id": 0}]}
STEP = {"frequency_hz": 5e8, "harmonic": 100, "step_hz": 100.0}
HEADERS = {
    "turn_by_turn": "shot,turn,monitor,x,y",
    "closed_orbit": "shot,monitor,x,y",
    "dispersion": "step,monitor,x,y",
    "tunes": "shot,quantity,value,error",
}
LAUNCHED = {"shots": [{"id": 0, "launch": {"x": 0.0}}]}


@pytest.mark.parametrize(
    ("kind", "more", "rows", "words"),
    [
        ("turn_by_turn", {}, [], 'it has no "shots"'),
        ("turn_by_turn", LAUNCHED, [], r'shots\[0\] has the key "launch"; known are id, settings'),
        ("turn_by_turn", SHOT, ["0,0,a,0,0", "1,0,a,0,0"], "line 3: shot 1 is not among the shots"),
        ("turn_by_turn", SHOT, ["0,0,a,0,0"], "json: 1 turns are no turn-by-turn measurement"),
        ("closed_orbit", SHOT, ["0,a,1.5,0"], "line 2: x = 1.5 m is above 0.2 m"),
        ("closed_orbit", SHOT, ["0,a,0,0", "0,A,0,0"],
         "line 3: shot 0, monitor a stands in the table already"),
        ("closed_orbit", {"shots": 2 * SHOT["shots"]}, [], "shot 0 stands twice"),
        ("dispersion", {"steps": [STEP]}, ["1,a,0,0"], "line 2: step 1 is not among the steps"),
        ("dispersion", {}, [], 'it has no "steps"'),
        ("dispersion", {"steps": [{**STEP, "step_hz": 0.0}]}, ["0,a,0,0"],
         "measurement.json: an RF step of 0 Hz"),
        ("tunes", SHOT, ["0,tune_z,0.1,"], "line 2: no quantity 'tune_z'; did you mean 'tune_"),
        ("tunes", SHOT, ["0,tune_x,a,"], "line 2: value is 'a'; it should be a number, or empty"),
        ("tunes", SHOT, ["0,tune_x,1.1,"], "measurement.json: a tune of 1.1 is no fraction"),
    ],
)  # fmt: skip
def test_damaged_folder_names_its_place(tmp_path, kind, more, rows, words):
    with pytest.raises(MeasurementError, match=words):
        read_measurement(folder_of(tmp_path, kind, more, [HEADERS[kind], *rows]))


def test_the_header_of_another_kind_is_named(tmp_path):
    table = [HEADERS["turn_by_turn"], "0,0,a,0,0"]
    with pytest.raises(MeasurementError, match="its first line is shot,monitor,x,y"):
        read_measurement(folder_of(tmp_path, "closed_orbit", SHOT, table))


def test_chromaticity_may_be_larger_than_any_reading(tmp_path):
    table = [HEADERS["tunes"], "0,tune_x,0.25,1e-4", "0,chromaticity_y,-80,0.5"]
    read = read_measurement(folder_of(tmp_path, "tunes", SHOT, table))
    np.testing.assert_array_equal(read.tune, [[0.25, np.nan]])
    np.testing.assert_array_equal(read.chromaticity, [[np.nan, -80.0]])
    np.testing.assert_array_equal(read.chromaticity_error, [[np.nan, 0.5]])


def test_old_data_are_kept_without_force(tmp_path):
    write_measurement(tmp_path / "m", TuneReading([[0.1, 0.2]]))
    (tmp_path / "m" / "measurement.json").unlink()
    with pytest.raises(MeasurementError, match=r"holds a measurement already \(tunes.csv\)"):
        write_measurement(tmp_path / "m", turns_of())
    write_measurement(tmp_path / "m", turns_of(), force=True)


def test_too_large_readings_are_not_written(tmp_path):
    for measured in (
        TurnByTurn(np.full((1, 16, 1, 2), 0.3), ("a",)),
        ClosedOrbit(np.full((1, 1, 2), 0.3), ("a",)),
        Dispersion((RfStep(5e8, 100, 1.0, np.full((1, 2), 0.3)),), ("a",)),
    ):
        with pytest.raises(MeasurementError, match=r"BPM 'a' reads 0.3 m in x"):
            write_measurement(tmp_path / "m", measured)
    assert not (tmp_path / "m").exists()
