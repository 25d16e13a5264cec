"""Data in and out of a notebook: arrays, data frames, xarray, values that are equal, pickles."""

import math
from copy import deepcopy
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from conftest import SMALL
from shared import ROOT, run_page

import tmlattice
from tmlattice.diagnosis.data_checks import check_data
from tmlattice.errors import MeasurementError, UnknownNameError
from tmlattice.importers import Options, bring_in
from tmlattice.machine.response import simulate_response
from tmlattice.measurement import (
    ClosedOrbit,
    Dispersion,
    Measurement,
    OrbitResponse,
    RfStep,
    TuneReading,
    TurnByTurn,
)

FAULT = tmlattice.Cause("quadrupole_gradient", "QD::5", -0.05)
NAMES = ("c", "a", 'b,"', "001", "NA")


def readings(*shape):
    values = np.random.default_rng(len(shape)).normal(scale=1e-3, size=(*shape, 5, 2))
    values[..., 1, 0] = np.nan
    values[..., 4, :] = np.nan  # a BPM that never reads
    return values


SETTINGS = ({"q": {"k1_relative": 0.01}}, {})
NOISE = {name: (1e-6 * (k + 1), 2e-6) for k, name in enumerate(NAMES)}
EVERY = [
    Measurement([[1e-3, 0, 1e-4, 0, 1e-3], [0, 1e-5, 0, 0, 0]], readings(2, 3), NAMES, NOISE,
                [[1e-5, 1e-6, np.inf, 0, 0]] * 2, SETTINGS, (7, 3), "petra3", 6.0, {"a": "SR:1"}),
    TurnByTurn(readings(2, 16), NAMES, (1e-6, 2e-6), SETTINGS, (3, 1), devices={"c": "SR:2"}),
    ClosedOrbit(readings(2), NAMES, NOISE, SETTINGS, (3, 1), "petra3", 6.0),
    Dispersion([RfStep(5e8, 3840, s, o) for s, o in zip((-300.0, 250.0), readings(2), strict=True)],
               NAMES, NOISE),
    TuneReading([[0.125, math.nan], [0.9, 0.1]], [[1e-4, 1e-5]] * 2, [[1.5, -2], [math.nan, 3]],
                settings=SETTINGS, shots=(4, 0)),
    OrbitResponse(("v", "h"), ("y", "x"), [1e-5, -2e-5], NAMES, readings(2), NOISE,
                  RfStep(5e8, 3840, 250.0, readings(1)[0]), "petra3", 6.0),
]  # fmt: skip
kinds = pytest.mark.parametrize("measured", EVERY, ids=lambda m: type(m).__name__)


@kinds
def test_a_frame_is_read_back_as_an_equal_measurement(measured):
    frame = measured.to_dataframe()
    again = type(measured).from_dataframe(frame)
    assert again == measured
    assert hash(again) == hash(measured)
    assert tmlattice.read_measurement(frame) == measured
    if frame.attrs["units"]:
        assert frame.attrs["units"]["x"] == "m"


@kinds
def test_a_dataset_is_read_back_as_an_equal_measurement(measured):
    pytest.importorskip("xarray")
    data = measured.to_xarray()
    assert type(measured).from_xarray(data) == measured
    if isinstance(measured, TurnByTurn):
        assert data.sizes["turn"] == 16
    if "x" in data:
        assert data["x"].attrs["units"] == "m"
        assert tuple(data["monitor"].values) == NAMES  # in the order of the readings


@kinds
def test_measurements_are_equal_by_value(measured):
    assert deepcopy(measured) == measured
    assert measured != replace(measured, energy=1.0)
    assert measured != "something else"
    if not isinstance(measured, TuneReading):
        assert measured != replace(measured, noise=None)


def test_arrays_make_each_kind_in_one_line(small_ring):
    monitors = small_ring.monitors
    names = tuple(m.name for m in monitors)
    x = np.arange(len(monitors), dtype=float)
    one = Measurement.from_arrays(x, 2 * x, monitors, unit="um")
    assert one.monitors == names
    np.testing.assert_allclose(one.readings[0, 0], np.stack([x, 2 * x], 1) * 1e-6, rtol=1e-15)
    assert np.isinf(one.launch_sigma[:, :4]).all()  # nothing is known of the launch
    assert Measurement.from_arrays(x, None, names).readings.shape == (1, 1, len(x), 2)
    assert np.isnan(ClosedOrbit.from_arrays(None, x, names).orbit[..., 0]).all()
    turns = TurnByTurn.from_arrays(
        np.tile(x, (20, 1)), np.tile(x, (20, 1)), names, noise=(1e-6,) * 2
    )
    assert turns.readings.shape == (1, 20, len(x), 2)
    step = Dispersion.from_arrays(x, x, names, step=-200.0, frequency=5e8, harmonic=100, unit="mm")
    assert step.steps[0].step == -200.0
    np.testing.assert_allclose(step.orbits[0, :, 0], 1e-3 * x)
    steered = [e for e in small_ring.elements if e.kind in ("hcorrector", "vcorrector")][:3]
    matrix = np.outer([1, 2, 3], x)
    response = OrbitResponse.from_arrays(matrix, matrix, names, steered, 1e-5, unit="um")
    assert response.planes == tuple("xy"[e.kind == "vcorrector"] for e in steered)
    assert response.response[1, 3, 0] == pytest.approx(6e-6)
    assert TuneReading([0.2, 0.3]) == TuneReading([[0.2, 0.3]])


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda x: Measurement.from_arrays(x, x[:-1], "abcde"), r"y has the shape \(4,\)"),
        (lambda x: Measurement.from_arrays(None, None, "abcde"), "neither x nor y"),
        (lambda x: ClosedOrbit.from_arrays([[x, x]], x, "abcde"), "should be .shot, 5 BPMs"),
        (lambda x: ClosedOrbit.from_arrays(x, x, "abcde", unit="inch"), "no unit 'inch'"),
        (lambda x: OrbitResponse.from_arrays([x], [x], "abcde", ["h"], 1e-5), "give planes="),
        (lambda x: Dispersion.from_arrays([x, x], None, "abcde", step=1.0, frequency=5e8,
                                          harmonic=9), "1 steps of the RF for 2"),
    ],
)  # fmt: skip
def test_arrays_that_do_not_fit_get_a_sentence(call, message):
    with pytest.raises(MeasurementError, match=message):
        call(np.zeros(5) + 1e-6)


@pytest.fixture(scope="module")
def measured(small_ring):
    return tmlattice.simulate(
        small_ring, [FAULT], shots=3, amplitude=1e-4, noise=1e-6, engine="ocelot", seed=2
    ).measurement()


def forms(measured):
    """The same readings in mm as control rooms have them."""
    x, y = np.moveaxis(1e3 * measured.readings[:, 0], -1, 0)
    names = list(measured.monitors)
    long = pd.DataFrame({
        "shot": np.repeat(range(len(x)), len(names)), "monitor": names * len(x),
        "x [mm]": x.ravel(), "y [mm]": y.ravel(),
    })  # fmt: skip
    wide = pd.concat({"x": pd.DataFrame(x, columns=names), "y": pd.DataFrame(y, columns=names)},
                     axis=1).swaplevel(axis=1)  # fmt: skip
    wide.index = pd.date_range("2026-01-01", periods=len(x), freq="s")
    one = pd.DataFrame({"x": x[0], "y": y[0]}, index=names)
    one.attrs["units"] = {"x": "mm", "y": "mm"}
    plain = long.melt(["shot", "monitor"], ["x [mm]", "y [mm]"], "plane", "value [mm]")
    plain["plane"] = plain["plane"].str[0]
    return {"long": long, "wide": wide, "indexed": long.set_index(["shot", "monitor"]),
            "one": one, "value": plain}  # fmt: skip


@pytest.mark.parametrize("form", ["long", "wide", "indexed", "one", "value"])
def test_frames_of_any_form_hold_the_readings(small_ring, measured, form):
    frame = forms(measured)[form]
    before = frame.copy()
    unit = "mm" if form == "wide" else None
    read = Measurement.from_dataframe(frame, ring=small_ring, unit=unit, noise=(1e-6, 1e-6))
    pd.testing.assert_frame_equal(frame, before)
    wanted = measured.readings[: len(read.shots)]
    np.testing.assert_allclose(read.select(monitors=measured.monitors).readings, wanted, rtol=1e-12)
    assert np.isinf(read.launch_sigma[:, :4]).all()
    assert (read.noise == 1e-6).all()
    orbit = ClosedOrbit.from_dataframe(frame, ring=small_ring, unit=unit)
    np.testing.assert_allclose(orbit.select(monitors=measured.monitors).orbit, wanted[:, 0])


def test_a_dataarray_holds_the_readings(small_ring, measured):
    xarray = pytest.importorskip("xarray")
    data = xarray.DataArray(
        1e6 * measured.readings[:, 0], dims=("shot", "monitor", "plane"),
        coords={"monitor": list(measured.monitors), "plane": ["x", "y"]}, attrs={"units": "um"},
    )  # fmt: skip
    read = Measurement.from_xarray(data)
    assert read.monitors == measured.monitors
    np.testing.assert_allclose(read.readings, measured.readings, rtol=1e-12)
    found = tmlattice.diagnose(small_ring, data)
    assert [f.element for f in found.findings] == ["QD::5"]


def test_frames_go_where_a_measurement_does(small_ring, measured, tmp_path):
    """As good as the same table in a file."""
    frame = forms(measured)["long"]
    frame.to_csv(tmp_path / "a.csv", index=False)
    of_file = bring_in([tmp_path / "a.csv"], Options(ring=small_ring))
    of_frame = tmlattice.import_data(frame, ring=small_ring)
    assert of_frame.measurement == of_file.measurement
    assert of_frame.assumed == of_file.assumed
    assert tmlattice.import_data([tmp_path / "a.csv"], lattice=str(SMALL)).measurement == (
        of_file.measurement
    )
    found = tmlattice.diagnose(small_ring, frame)
    assert (
        found.as_json()["findings"]
        == (tmlattice.diagnose(small_ring, tmp_path / "a.csv").as_json()["findings"])
    )
    assert [f.element for f in found.findings] == ["QD::5"]
    assert check_data(small_ring, frame).status != "wrong"
    both = tmlattice.diagnose(str(SMALL), {"turns": frame, "tunes": TuneReading([0.1326, 0.6238])},
                              effects=["quadrupole_gradient"])  # fmt: skip
    assert {part.label for part in both.parts} == {"turns", "tunes"}
    network = tmlattice.TaylorNetwork.from_ring(small_ring)
    assert set(tmlattice.fine_tune(network, frame, method="sparse", noise=1e-6).changes) == {
        "QD::5"
    }


def test_the_page_runs_as_written(tmp_path, monkeypatch):
    """With petra3, as it stands; what it says of its magnet is true."""
    monkeypatch.chdir(tmp_path)
    names = run_page("frames.md")
    text = (ROOT / "docs" / "frames.md").read_text(encoding="utf-8")
    errors = names["errors"].set_index("element")
    assert abs(errors.amount["qd::12"] + 0.2) < 4 * errors.sigma["qd::12"]
    for name in names["diagnosis"].tables:
        assert f"`{name}`" in text


def test_frames_of_a_response(small_ring):
    made = simulate_response(small_ring, noise=1e-7, seed=3).measured
    long = made.to_dataframe().query("corrector != 'rf'")  # the ring has no cavity
    long.attrs = {}
    wanted = made.response
    read = OrbitResponse.from_dataframe(long, ring=small_ring)
    assert read.correctors == made.correctors
    assert read.planes == made.planes
    np.testing.assert_array_equal(read.kicks, made.kicks)
    np.testing.assert_array_equal(read.select(monitors=made.monitors).response, wanted)
    per_kick = {c: (wanted[i] / made.kicks[i]).ravel() for i, c in enumerate(made.correctors)}
    rows = pd.MultiIndex.from_product([made.monitors, ["x", "y"]], names=["monitor", "plane"])
    wide = OrbitResponse.from_dataframe(pd.DataFrame(per_kick, index=rows), ring=small_ring)
    np.testing.assert_allclose(
        wide.response / wide.kicks[:, None, None], wanted / made.kicks[:, None, None], rtol=1e-9
    )
    with pytest.raises(MeasurementError, match=r"is an orbit response: name its lattice.*ring="):
        OrbitResponse.from_dataframe(long)
    with pytest.raises(MeasurementError, match="no column 'kick'"):
        OrbitResponse.from_dataframe(long.drop(columns="kick"), ring=small_ring)


def test_frames_of_dispersion_and_tunes(small_ring, measured):
    frame = forms(measured)["one"]
    rf = {"step": 100.0, "frequency": 5e8, "harmonic": 100}
    read = Dispersion.from_dataframe(frame, ring=small_ring, **rf)
    np.testing.assert_allclose(read.orbits[0], measured.readings[0, 0], rtol=1e-12)
    with pytest.raises(MeasurementError, match="give step=, frequency= and harmonic="):
        Dispersion.from_dataframe(frame)
    with pytest.raises(MeasurementError, match="are of a dispersion measurement"):
        ClosedOrbit.from_dataframe(frame, **rf)
    tunes = pd.DataFrame({"tune_x": [0.1, 0.2], "tune_y": [0.3, None], "tune_x_error": 1e-4})
    read = TuneReading.from_dataframe(tunes)
    assert read == TuneReading([[0.1, 0.3], [0.2, math.nan]], [[1e-4, math.nan]] * 2)
    with pytest.raises(MeasurementError, match="no columns 'tune_x' and 'tune_y'"):
        TuneReading.from_dataframe(frame)


def test_a_frame_that_lacks_a_column_names_it(small_ring, measured):
    frame = forms(measured)["long"]
    for call in (
        lambda own: tmlattice.diagnose(small_ring, own),
        Measurement.from_dataframe,
        lambda own: tmlattice.import_data(own, ring=small_ring),
    ):
        with pytest.raises(MeasurementError, match="DataFrame: no column 'monitor' next to 'x'"):
            call(frame.drop(columns="monitor"))
    with pytest.raises(MeasurementError, match="give columns x and y"):
        Measurement.from_dataframe(frame[["shot", "monitor"]])
    with pytest.raises(MeasurementError, match="no rows; nothing was read"):
        Measurement.from_dataframe(frame.iloc[:0])
    with pytest.raises(MeasurementError, match="'wet' of 'x' is no number"):
        Measurement.from_dataframe(frame.assign(**{"x [mm]": "wet"}))
    with pytest.raises(MeasurementError, match="stands twice in one shot"):
        Measurement.from_dataframe(frame.drop(columns="shot"))
    with pytest.raises(MeasurementError, match="holds first turns, and not an orbit response"):
        OrbitResponse.from_dataframe(frame, ring=small_ring)
    with pytest.raises((MeasurementError, UnknownNameError), match="no BPM 'nowhere'"):
        tmlattice.diagnose(small_ring, frame.assign(monitor="nowhere").iloc[:1])
    frame.attrs["units"] = "mm"
    with pytest.raises(MeasurementError, match="give the unit of each column"):
        Measurement.from_dataframe(frame)
    frame.attrs = {"measurement": "{"}
    with pytest.raises(MeasurementError, match="is no JSON"):
        Measurement.from_dataframe(frame)
    changed = measured.to_dataframe()
    changed.loc[3, "x"] = 5.0
    with pytest.raises(MeasurementError, match=r"DataFrame.*line 5: x = 5 m is above"):
        Measurement.from_dataframe(changed)
