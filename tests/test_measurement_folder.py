"""The folder format: bit-identical round trips, each kind of damage with its line, streaming."""

import json
import math
import tracemalloc

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from shared import measured_data, valid

from tmlattice import Measurement, OrbitResponse, read_measurement, write_measurement
from tmlattice.errors import MeasurementError
from tmlattice.measurement import RfStep, measurement_writer, read_truth, rows, write_truth


def same(a, b):
    for name in ("launches", "readings", "noise", "launch_sigma", "kicks", "response"):
        one, other = getattr(a, name, None), getattr(b, name, None)
        if one is None or other is None:
            assert one is other, name
        else:  # bit by bit but for NaN, whose sign and payload mean nothing
            assert one.shape == other.shape, name
            nan = np.isnan(one)
            assert (nan == np.isnan(other)).all(), name
            assert one[~nan].tobytes() == other[~nan].tobytes(), name
    for name in ("monitors", "shots", "lattice", "energy", "correctors", "planes"):
        assert getattr(a, name, None) == getattr(b, name, None), name
    if isinstance(a, Measurement):
        assert a.settings == b.settings


reading = st.one_of(st.just(math.nan), st.floats(-0.2, 0.2, allow_subnormal=True), st.just(-0.0))
positive = st.floats(min_value=5e-324, max_value=1.7e308, allow_subnormal=True)
anything = st.floats(allow_nan=False, allow_infinity=False)
name = st.text(
    st.characters(codec="utf-8", exclude_categories=("C", "Z"), include_characters=' ,"'),
    min_size=1, max_size=8,
).filter(lambda n: n == n.strip() and not n.endswith("::0"))  # fmt: skip


@st.composite
def measurements(draw):
    shots, turns = draw(st.integers(1, 3)), draw(st.integers(1, 3))
    monitors = draw(st.lists(name, min_size=1, max_size=3, unique_by=str.casefold))
    readings = draw(arrays(float, (shots, turns, len(monitors), 2), elements=reading))
    readings[0, 0, 0, 0] = draw(st.floats(-0.2, 0.2))
    known = st.one_of(st.floats(1e-15, 1.0), st.just(math.nan))
    sigma = st.one_of(st.just(math.inf), st.just(0.0), positive)
    setting = st.fixed_dictionaries({"kick": anything}, optional={"k1_relative": anything})
    return Measurement(
        launches=draw(arrays(float, (shots, 5), elements=anything)),
        readings=readings,
        monitors=tuple(monitors),
        noise=draw(st.none() | arrays(float, (len(monitors), 2), elements=known)),
        launch_sigma=draw(st.none() | arrays(float, (shots, 5), elements=sigma)),
        settings=tuple(
            draw(st.dictionaries(st.sampled_from(["c::1", "q"]), setting)) for _ in range(shots)
        ),
        shots=tuple(
            draw(st.lists(st.integers(0, 2**53), min_size=shots, max_size=shots, unique=True))
        ),
        lattice=draw(st.none() | st.text(st.characters(codec="utf-8"))),
        energy=draw(st.none() | st.floats(5e-324, 1e6, exclude_max=True, allow_subnormal=True)),
    )


@settings(max_examples=60, deadline=None, suppress_health_check=list(HealthCheck))
@given(measurements())
def test_trajectory_reads_back_bit_by_bit(tmp_path, measurement):
    write_measurement(tmp_path / "m", measurement, force=True)
    same(measurement, read_measurement(tmp_path / "m"))
    valid(tmp_path / "m" / "measurement.json", "measurement")


@settings(max_examples=25, deadline=None, suppress_health_check=list(HealthCheck))
@given(
    arrays(float, (3, 2, 2), elements=reading),
    st.none() | arrays(float, (2, 2), elements=reading),
    arrays(float, 3, elements=anything.filter(lambda kick: 0 < abs(kick) < 1e6)),
    st.booleans(),
)
def test_orbit_response_reads_back_bit_by_bit(tmp_path, response, orbit, kicks, rf):
    response[0, 0, 0] = 1e-3
    step = RfStep(499664399.423, 3840, -3000.0, orbit) if rf else None
    given = OrbitResponse(("h,1", "v", "w::1"), tuple("xyx"), kicks, ("a", "b"), response,
                          ((1e-6, 2e-6)), step, "petra3", 6.0)  # fmt: skip
    write_measurement(tmp_path / "m", given, force=True)
    read = read_measurement(tmp_path / "m")
    same(given, read)
    if step is None:
        assert read.rf is None
    else:
        assert (read.rf.frequency, read.rf.harmonic, read.rf.step) == (499664399.423, 3840, -3000.0)
        if orbit is None:
            assert read.rf.orbit is None
        else:
            np.testing.assert_array_equal(read.rf.orbit, orbit)
    valid(tmp_path / "m" / "measurement.json", "measurement")


# The page's own example, and what may be absent in it.

DOCUMENT = {
    "format": "tmlattice-measurement",
    "version": 1,
    "kind": "trajectory",
    "lattice": "petra3",
    "energy_gev": 6.0,
    "noise": {"x": 2.0e-5, "y": 2.0e-5},
    "shots": [
        {
            "id": 0,
            "launch": {"x": 5.0e-4, "px": 1.0e-4, "y": -5.0e-4, "py": 1.0e-4, "delta": 0.0},
            "launch_sigma": {"x": 1.0e-4, "px": 2.0e-5, "y": 1.0e-4, "py": 2.0e-5, "delta": 1.0e-4},
            "settings": {"pch_swr_9::0": {"kick": 2.0e-5}, "qd::12": {"k1_relative": 0.01}},
        },
        {"id": 7},
    ],
}
TABLE = [
    "shot,turn,monitor,x,y",
    "0,0,bpm_swl_61,1.2345e-03,-4.321e-04",
    "0,0,bpm_swl_46,,",
    "7,1,BPM_swl_46::0,1e-3,",
    "7,0,bpm_swl_61,2e-3,1e-3",
]


@pytest.fixture
def folder(tmp_path):
    """Writes a folder: changes of the document by path, and the table's lines."""

    def make(changes=(), table=TABLE, document=DOCUMENT):
        document = json.loads(json.dumps(document))
        for path, value in dict(changes).items():
            *way, last = path.split(".")
            place = document
            for step in way:
                place = place[int(step)] if step.isdigit() else place[step]
            if value is ...:
                del place[last]
            else:
                place[last] = value
        there = tmp_path / "m"
        there.mkdir(exist_ok=True)
        (there / "measurement.json").write_text(json.dumps(document), encoding="utf-8")
        name = "readings.csv" if document.get("kind") == "trajectory" else "response.csv"
        (there / name).write_bytes("\n".join(table).encode() if isinstance(table, list) else table)
        return there

    return make


def test_example_of_the_page(folder):
    m = read_measurement(folder())
    assert m.monitors == ("bpm_swl_61", "bpm_swl_46")  # BPM_swl_46::0 is the same one
    assert m.shots == (0, 7)
    assert m.readings.shape == (2, 2, 2, 2)
    np.testing.assert_array_equal(m.readings[0, 0], [[1.2345e-3, -4.321e-4], [np.nan, np.nan]])
    np.testing.assert_array_equal(m.readings[1, 1], [[np.nan, np.nan], [1e-3, np.nan]])
    np.testing.assert_array_equal(m.launches, [[5e-4, 1e-4, -5e-4, 1e-4, 0.0], [0.0] * 5])
    np.testing.assert_array_equal(
        m.launch_sigma, [[1e-4, 2e-5, 1e-4, 2e-5, 1e-4], [np.inf] * 4 + [0.0]]
    )
    np.testing.assert_array_equal(m.noise, [[2e-5, 2e-5]] * 2)
    assert m.settings == (DOCUMENT["shots"][0]["settings"], {})
    assert (m.lattice, m.energy) == ("petra3", 6.0)


@pytest.mark.parametrize(
    ("sigma", "expected"),
    [
        (None, None),
        (..., None),
        ({}, [np.inf] * 4 + [0.0]),
        ({"x": 1e-4}, [1e-4, np.inf, np.inf, np.inf, 0.0]),
        ({"x": None, "py": 0.0}, [np.inf, np.inf, np.inf, 0.0, 0.0]),
        ({"delta": None}, [np.inf] * 5),
        ({"delta": 1e-4}, [np.inf] * 4 + [1e-4]),
    ],
)
def test_launch_sigma_missing_is_unknown_but_missing_delta_is_exact(folder, sigma, expected):
    m = read_measurement(folder({"shots.0.launch_sigma": sigma}))
    if expected is None:
        assert m.launch_sigma is None
    else:
        np.testing.assert_array_equal(m.launch_sigma[0], expected)


@pytest.mark.parametrize(
    ("noise", "expected"),
    [
        (..., None),
        (None, None),
        ({}, None),
        ({"x": None, "y": None}, None),
        ({"x": 1e-5}, [[1e-5, np.nan]] * 2),
        ({"BPM_SWL_46": {"x": 3e-5, "y": 2e-5}}, [[np.nan] * 2, [3e-5, 2e-5]]),
        ({"bpm_swl_46": {"y": 2e-5}, "bpm_swl_61": None}, [[np.nan] * 2, [np.nan, 2e-5]]),
        ({"bpm_dead": {"x": 1e-5, "y": 1e-5}}, None),
    ],
)
@pytest.mark.filterwarnings("ignore:the noise names")  # a monitor without rows is told of
def test_noise_as_a_pair_a_table_or_nothing(folder, noise, expected):
    m = read_measurement(folder({"noise": noise}))
    if expected is None:
        assert m.noise is None
    else:
        np.testing.assert_array_equal(m.noise, expected)


def test_missing_launch_keys_are_zero(folder):
    m = read_measurement(folder({"shots.0.launch": {"py": 2e-4}}))
    np.testing.assert_array_equal(m.launches[0], [0, 0, 0, 2e-4, 0])


def test_ring_gives_names_and_order(folder):
    ring = ("BPM_SWL_46", "bpm_other", "bpm_swl_61")
    m = read_measurement(folder(), ring)
    assert m.monitors == ("BPM_SWL_46", "bpm_swl_61")
    assert m.readings[0, 0, 1, 0] == 1.2345e-3


def test_windows_table_with_blank_lines_and_quotes(folder):
    text = b'\xef\xbb\xbfshot,turn,monitor,x,y\r\n\r\n0,0,"a,b",1e-3, 2e-3\r\n7,0,c,,\r\n\r\n'
    m = read_measurement(folder(table=text))
    assert m.monitors == ("a,b", "c")
    np.testing.assert_array_equal(m.readings[0, 0, 0], [1e-3, 2e-3])


HEADER = TABLE[0]
GOOD = "0,0,bpm_swl_61,1e-3,1e-3"


@pytest.mark.parametrize(
    ("table", "line", "words"),
    [
        ([], 1, "empty"),
        (["", ""], 1, "empty"),
        (["shot,turn,monitor,x", "0,0,a,1e-3"], 1, "no column 'y'"),
        (["shot,turn,monitor,y,x", GOOD], 1, "another order"),
        ([f"{HEADER},z", GOOD], 1, "other columns"),
        ([HEADER, GOOD, "0,0,bpm_swl_46,1e-3"], 3, "4 fields where the header has 5"),
        ([HEADER, GOOD, "", "0,0,bpm_swl_46,1e-3,1,1"], 4, "6 fields"),
        ([HEADER, GOOD, "0,0,bpm_swl_46,abc,1e-3"], 3, "x is 'abc'; it should be a number"),
        ([HEADER, GOOD, "0,0,bpm_swl_46,1e-3,nan"], 3, "y is 'nan'"),
        ([HEADER, GOOD, "0,0,bpm_swl_46,-inf,"], 3, "x is '-inf'"),
        ([HEADER, GOOD, "0,0,bpm_swl_46,1_0,"], 3, "x is '1_0'"),
        ([HEADER, GOOD, "0,0.5,bpm_swl_46,,"], 3, "turn is '0.5'"),
        ([HEADER, GOOD, "99999999999999999999,0,bpm_swl_46,,"], 3, "whole number"),
        ([HEADER, GOOD, "0,0,,1e-3,1e-3"], 3, "name of a monitor"),
        ([HEADER, GOOD, "0,-1,bpm_swl_46,1e-3,1e-3"], 3, "turn -1 is negative"),
        ([HEADER, GOOD, "0,1000000000,bpm_swl_46,1e-3,1e-3"], 3, "far behind"),
        ([HEADER, GOOD, "3,0,bpm_swl_46,1e-3,1e-3"], 3, "shot 3 is not among"),
        ([HEADER, GOOD, "0,0,bpm_swl_46,1e-3,-1.5"], 3, "y = -1.5 m is above 0.2 m.*divide milli"),
        ([HEADER, GOOD, "0,0,bpm_swl_46,,", "0,0,BPM_SWL_61::0,,"], 4, "stands in the table"),
        ([HEADER, GOOD, "7,0,bpm_swl_46,,", "7,0,bpm_sw_46,1e-3,1e-3"], 4,
         "no BPM 'bpm_sw_46'; did you mean 'bpm_swl_46'"),
        ([HEADER, GOOD, '0,0,"bpm', "2,0,a,,"], 3, "name|fields"),
        ("\n".join([HEADER, GOOD, "7,0,bpm_µ,,"]).encode("latin-1"), 3, "not UTF-8"),
    ],
)  # fmt: skip
def test_damaged_table_names_its_line(folder, table, line, words):
    there = folder(table=table)
    with pytest.raises(MeasurementError, match=words) as found:
        read_measurement(there, ("bpm_swl_61", "bpm_swl_46"))
    assert str(found.value).startswith(f"{there / 'readings.csv'}, line {line}: ")
    assert "\n" not in str(found.value)


def test_damage_behind_the_first_chunk_names_its_line(folder, monkeypatch):
    monkeypatch.setattr(rows, "_CHUNK", 3)
    table = [HEADER, *(f"0,{t},bpm_swl_61,1e-3,1e-3" for t in range(10))]
    assert read_measurement(folder(table=table)).readings.shape[1] == 10
    table[9] += "x"
    with pytest.raises(MeasurementError, match="line 10: y is '1e-3x'"):
        read_measurement(folder(table=table))


def test_table_without_rows_or_readings(folder):
    with pytest.raises(MeasurementError, match=r"readings.csv: no rows below the header"):
        read_measurement(folder(table=[HEADER]))
    with pytest.raises(MeasurementError, match=r"measurement.json: every reading is missing"):
        read_measurement(folder(table=[HEADER, "0,0,a,,"]))


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"format": "tmlattice-truth"}, '"format" is "tmlattice-truth"'),
        ({"format": ...}, '"format" is null; it should be "tmlattice-measurement"'),
        ({"version": 2}, '"version" is 2; this package reads 1'),
        ({"version": "1"}, '"version" is "1"'),
        ({"kind": "tracks"}, 'kind is "tracks"; it should be one of "trajectory", "orbit_resp'),
        ({"kind": ...}, 'no "kind"; add it'),
        ({"shots": ...}, 'no "shots"; add it'),
        ({"shots": []}, "should not be empty"),
        ({"shots.0.id": ...}, r'shots\[0\] has no "id"'),
        ({"shots.0.id": "a"}, r'shots\[0\].id is "a"; it should be a whole number'),
        ({"shots.1.id": 0}, "shot 0 stands twice"),
        ({"shots.0.launch.px": None}, "launch.px is null; it should be a number"),
        ({"shots.0.launch": {"X": 1e-3}}, r'shots\[0\].launch has the key "X"; known are x, px'),
        ({"shots.0.launch_sigma.x": -1e-3}, "launch_sigma.x is -0.001; it should be 0 or more"),
        ({"shots.0.settings": {"q": {"k1": 1}}}, 'the key "k1"; known are kick, k1_relative'),
        ({"shots.0.settings": {"q": {"kick": None}}}, "kick is null; it should be a number"),
        ({"shots.0.settings": {"q": {"frequency_relative": 1e-6}}}, "the name 'rf'"),
        ({"shots.0.settings": {"q": {"kick": 1}, "Q": {"kick": 2}}}, "element 'Q' stands twice"),
        ({"noise": {"x": 0, "y": 1e-5}}, "noise.x is 0; it should be above 0"),
        ({"noise": {"x": "small", "y": 1e-5}}, "noise.x is .small.; it should be a number or null"),
        ({"noise": {"a": {"x": -1e-5}}}, "noise.a.x is -1e-05; it should be above 0"),
        ({"noise": 2e-5}, "noise is 2e-05; it should be an object"),
        ({"noise": {"bpm_dead": {"x": 1e-5, "y": 1e-5}}}, "no BPM 'bpm_dead'"),
        ({"energy_gev": 0}, "energy_gev is 0; it should be above 0"),
        ({"lattice": 3}, "lattice is 3; it should be a text or null"),
    ],
)
def test_damaged_document_names_its_place(folder, changes, words):
    there = folder()
    folder(changes)
    (there / "readings.csv").write_text("\n".join(TABLE))
    with pytest.raises(MeasurementError, match=words) as found:
        read_measurement(there, ("bpm_swl_61", "bpm_swl_46"))
    assert str(found.value).startswith(f"{there / 'measurement.json'}: ")
    assert "\n" not in str(found.value)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (b'{\n"format": "tmlattice-measurement",\n,}', "line 3: not JSON"),
        (b'\n{"format": 1,\n"b": "\xff"}', "line 3: not UTF-8"),
        (b"[]", '"format" is null'),
        (b'{"version": NaN}', "NaN is not JSON"),
        (b'{"version": 1, "version": 1}', "stands twice"),
        (b"[" * 100_000, "measurement.json"),
        (
            json.dumps(DOCUMENT).replace("0.0005", "1e999", 1).encode(),
            r"shots\[0\].launch.x is not finite",
        ),
    ],
)
def test_document_that_is_no_document(folder, text, words):
    there = folder()
    (there / "measurement.json").write_bytes(text)
    with pytest.raises(MeasurementError, match=words):
        read_measurement(there)


def test_missing_files_are_named(folder, tmp_path):
    with pytest.raises(MeasurementError, match=r"no measurement folder '.*nowhere'"):
        read_measurement(tmp_path / "nowhere")
    there = folder()
    (there / "readings.csv").unlink()
    with pytest.raises(MeasurementError, match=r"cannot read '.*readings.csv'"):
        read_measurement(there)
    (there / "measurement.json").unlink()
    with pytest.raises(MeasurementError, match=r"no '.*measurement.json'"):
        read_measurement(there)


RESPONSE = {
    "format": "tmlattice-measurement",
    "version": 1,
    "kind": "orbit_response",
    "columns": [
        {"corrector": "pch_swr_9", "plane": "x", "kick": 9.87e-5},
        {"corrector": "pcv", "plane": "y", "kick": 1e-4},
    ],
    "rf": {"frequency_hz": 499664399.4, "harmonic": 3840, "step_hz": -3000.0},
    "dispersion": True,
}
ORBITS = ["corrector,monitor,x,y", "pch_swr_9,a,1e-3,2e-3", "PCV::0,A,,1e-4", "rf,a,1e-4,"]


def test_orbit_response_of_the_page(folder):
    r = read_measurement(folder(document=RESPONSE, table=ORBITS))
    np.testing.assert_array_equal(r.response, [[[1e-3, 2e-3]], [[np.nan, 1e-4]]])
    np.testing.assert_array_equal(r.rf.orbit, [[1e-4, np.nan]])
    assert r.rf.harmonic == 3840
    assert r.planes == ("x", "y")


@pytest.mark.parametrize(
    ("changes", "table", "words"),
    [
        ({}, [*ORBITS, "pch_swr_9,a,,"], "line 5: corrector pch_swr_9, monitor a stands in the"),
        ({}, [*ORBITS, "pch_swr_8,a,,"], "line 5: no corrector 'pch_swr_8'; did you mean"),
        ({}, [*ORBITS, "pcv,b,,"], "line 5: no BPM 'b'"),
        ({}, [*ORBITS[:3], "rf,a,0.5,"], "line 4: x = 0.5 m is above"),
        ({}, ORBITS[:3], 'no row of "rf"'),
        ({"dispersion": False}, ORBITS, "line 4: a row of the RF step"),
        ({"rf": None}, ORBITS, '"rf" does not state'),
        ({"rf.harmonic": 0.5}, ORBITS, "rf.harmonic is 0.5; it should be a whole number"),
        ({"columns": []}, ORBITS, "columns is .*empty"),
        ({"columns.1.plane": "z"}, ORBITS, r'columns\[1\].plane is "z"'),
        ({"columns.1.kick": 0}, ORBITS, "step of 0 rad"),
        ({"columns.1.corrector": "PCH_SWR_9"}, ORBITS, "'PCH_SWR_9' stands twice"),
    ],
)
def test_damaged_orbit_response(folder, changes, table, words):
    there = folder(changes, table, RESPONSE)
    with pytest.raises(MeasurementError, match=words) as found:
        read_measurement(there, ["a"])
    assert str(found.value).startswith(str(there))


def test_real_orbit_response_reads_and_reads_back(tmp_path):
    real = read_measurement(measured_data("petra3_orbit_response"))
    assert isinstance(real, OrbitResponse)
    assert real.response.shape == (330, 246, 2)
    assert [real.planes.count(p) for p in "xy"] == [175, 155]
    assert (real.rf.harmonic, real.rf.step) == (3840, -3000.0)
    assert real.rf.orbit.shape == (246, 2)
    # the first row of the table, and the RF row of the same monitor, as the files have them
    np.testing.assert_array_equal(real.response[0, 0], [2.264705e-03, 6.964684e-05])
    np.testing.assert_array_equal(real.rf.orbit[0], [-1.453703e-04, 4.181311e-05])
    assert real.kicks[0] == 9.868774243e-05
    np.testing.assert_array_equal(real.noise[0], [3.3013e-06, 1.2194e-06])
    write_measurement(tmp_path / "copy", real)
    same(real, read_measurement(tmp_path / "copy"))


# Writing shot by shot


def test_writer_streams_what_write_measurement_writes(tmp_path, rng):
    names = ("a", "b")
    readings = 1e-3 * rng.standard_normal((3, 2, 2, 2))
    whole = Measurement(np.full((3, 4), 1e-4), readings, names, (1e-5, 2e-5), energy=6.0)
    write_measurement(tmp_path / "whole", whole)
    with measurement_writer(tmp_path / "parts", names, noise=(1e-5, 2e-5), energy=6.0) as writer:
        for shot in range(3):
            writer.add(shot, [1e-4] * 4, None, {}, readings[shot])
    for file in ("measurement.json", "readings.csv"):
        assert (tmp_path / "whole" / file).read_bytes() == (tmp_path / "parts" / file).read_bytes()


@pytest.mark.parametrize("error", [KeyboardInterrupt, RuntimeError])
def test_stopped_writer_leaves_nothing(tmp_path, error):
    def stop_half_way():
        with measurement_writer(tmp_path / "new" / "m", ["a"]) as writer:
            writer.add(0, np.zeros(5), None, None, np.zeros((1, 1, 2)))
            raise error

    with pytest.raises(error):
        stop_half_way()
    assert list(tmp_path.iterdir()) == []


def test_stopped_writer_leaves_the_old_folder(folder):
    there = folder()
    before = {p.name: p.read_bytes() for p in there.iterdir()}

    def fail():
        with measurement_writer(there, ["a"], force=True) as writer:
            writer.add(0, np.zeros(5), None, None, np.zeros((1, 1, 2)))
            writer.add(0, np.zeros(5), None, None, np.zeros((1, 1, 2)))

    with pytest.raises(MeasurementError, match="shot 0 is written already"):
        fail()
    assert {p.name: p.read_bytes() for p in there.iterdir()} == before


@pytest.mark.parametrize(
    ("shot", "words"),
    [
        ((0, np.zeros(5), None, {}, np.full((1, 1, 2), 0.5)), "BPM 'a' reads 0.5 m in x"),
        ((0, np.zeros(5), None, {}, np.full((1, 1, 2), np.inf)), "reads inf"),
        ((0, np.zeros(5), None, {}, np.zeros((1, 2, 2))), "shape"),
        ((0, [np.nan] * 5, None, {}, np.zeros((1, 1, 2))), "launch of shot 0 is not finite"),
        ((0, np.zeros(3), None, {}, np.zeros((1, 1, 2))), "x, px, y, py"),
        ((0, np.zeros(5), [-1.0] * 5, {}, np.zeros((1, 1, 2))), "negative"),
        ((0, np.zeros(5), None, {"q": {"kick": np.nan}}, np.zeros((1, 1, 2))), "finite"),
        ((0, np.zeros(5), None, {}, np.full((1, 1, 2), np.nan)), "no reading was written"),
    ],
)
def test_writer_refuses_what_no_reader_takes(tmp_path, shot, words):
    def write():
        with measurement_writer(tmp_path / "m", ["a"]) as writer:
            writer.add(*shot)

    with pytest.raises(MeasurementError, match=words):
        write()
    assert list(tmp_path.iterdir()) == []


def peak_memory(folder, shots, rng):
    names = [f"bpm_{i}" for i in range(100)]
    one = 1e-3 * rng.standard_normal((20, 100, 2))  # 32 kB a shot
    tracemalloc.start()
    with measurement_writer(folder, names, noise=(1e-5, 1e-5)) as writer:
        for shot in range(shots):
            writer.add(shot, np.full(5, 1e-4), np.full(5, 1e-5), {"c": {"kick": 1e-5}}, one.copy())
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return peak


def test_memory_of_the_writer_is_flat_in_the_number_of_shots(tmp_path, rng):
    peak_memory(tmp_path / "warm", 2, rng)
    few, many = (peak_memory(tmp_path / f"m{n}", n, rng) for n in (10, 50))
    assert many - few < 50_000  # the set of ids, 0.01 MB; 40 shots of 32 kB would be 1.3 MB


# The truth


def test_truth_reads_back_and_stays_out_of_the_folder(folder, tmp_path):
    effects = [
        {"effect": "quadrupole_gradient", "element": "qd::12", "s": 103.4, "amount": -0.2},
        {"effect": "energy_offset", "element": None, "s": None, "amount": np.float64(1e-4)},
    ]
    launches = np.array([[1e-3, 0, 1e-3, 0, 1e-4 / 3]])
    path = tmp_path / "truth.json"
    write_truth(path, effects, launches, {"quadrupole_gradient": 1e-3}, seed=5)
    valid(path, "truth")
    truth = read_truth(path)
    assert list(truth.effects) == effects
    np.testing.assert_array_equal(truth.launches, launches)
    assert truth.background == {"quadrupole_gradient": 1e-3}
    assert truth.seed == 5
    assert truth.package
    with pytest.raises(MeasurementError, match="no truth may lie"):
        write_truth(folder() / "truth.json", effects, launches)
    with pytest.raises(MeasurementError, match="keys effect, element, s, amount"):
        write_truth(path, [{"effect": "a"}], launches)
    with pytest.raises(MeasurementError, match='"format" is "tmlattice-measurement"'):
        read_truth(folder() / "measurement.json")
