"""Measurement and orbit response as classes: what they take, refuse, select, split and compare."""

import numpy as np
import pytest

from tmlattice import Measurement, OrbitResponse
from tmlattice.errors import MeasurementError, UnknownNameError
from tmlattice.measurement import RfStep

NAMES = ("bpm_a", "bpm_b", "bpm_c")


@pytest.fixture
def measurement(rng):
    return Measurement(
        launches=1e-4 * rng.standard_normal((5, 4)),
        readings=1e-3 * rng.standard_normal((5, 4, 3, 2)),
        monitors=NAMES,
        noise={"BPM_B": (3e-5, 2e-5), "bpm_a::0": (1e-5, np.nan)},
        launch_sigma=np.full((5, 4), 1e-5),
        settings=({}, {"c1": {"kick": 1e-5}}, {}, {}, {"rf": {"frequency_relative": 1e-7}}),
        shots=(10, 11, 12, 20, 30),
        energy=6.0,
    )


def test_four_coordinates_are_filled_with_the_nominal_energy(measurement):
    assert measurement.launches.shape == (5, 5)
    assert not measurement.launches[:, 4].any()
    assert not measurement.launch_sigma[:, 4].any()  # the energy is exactly the nominal one
    np.testing.assert_array_equal(measurement.states(4), measurement.launches[:, :4])


def test_noise_is_kept_by_monitor_and_nan_where_unknown(measurement):
    np.testing.assert_array_equal(
        measurement.noise, [[1e-5, np.nan], [3e-5, 2e-5], [np.nan, np.nan]]
    )
    pair = Measurement(measurement.launches, measurement.readings, NAMES, (1e-5, 2e-5))
    np.testing.assert_array_equal(pair.noise, [[1e-5, 2e-5]] * 3)
    nothing = Measurement(measurement.launches, measurement.readings, NAMES, (np.nan, np.nan))
    assert nothing.noise is None


def test_states_of_six_coordinates_put_delta_last_and_tau_zero(measurement):
    launches = measurement.launches.copy()
    launches[2, 4] = 1e-3
    off = Measurement(launches, measurement.readings, NAMES, shots=measurement.shots)
    states = off.states(6)
    np.testing.assert_array_equal(states[:, :4], launches[:, :4])
    np.testing.assert_array_equal(states[:, 4], 0.0)
    np.testing.assert_array_equal(states[:, 5], launches[:, 4])
    with pytest.raises(MeasurementError, match=r"shot 12 .*delta = 0.001.*six"):
        off.states(4)
    with pytest.raises(MeasurementError, match="4 or 6"):
        off.states(5)


def test_ring_order_puts_missing_monitors_back(measurement):
    ring = ("bpm_0", "BPM_C", "bpm_a", "bpm_b")
    full = measurement.in_order_of(ring)
    assert full.monitors == ring
    assert np.isnan(full.readings[:, :, 0]).all()
    np.testing.assert_array_equal(full.readings[:, :, 1:], measurement.readings[:, :, [2, 0, 1]])
    np.testing.assert_array_equal(full.noise[1:], measurement.noise[[2, 0, 1]])
    with pytest.raises(UnknownNameError, match="no BPM 'bpm_c'; did you mean"):
        measurement.in_order_of(("bpm_a", "bpm_b"))


def test_select_by_ids_and_names(measurement):
    part = measurement.select(shots=[30, 11], monitors=["bpm_c", "bpm_a::0"])
    assert part.shots == (30, 11)
    assert part.monitors == ("bpm_c", "bpm_a")
    np.testing.assert_array_equal(part.readings, measurement.readings[[4, 1]][:, :, [2, 0]])
    np.testing.assert_array_equal(part.launches, measurement.launches[[4, 1]])
    np.testing.assert_array_equal(part.noise[1], [1e-5, np.nan])
    assert part.settings == (measurement.settings[4], measurement.settings[1])
    with pytest.raises(MeasurementError, match="no shot 13; there are 10, 11"):
        measurement.select(shots=[10, 13])
    with pytest.raises(UnknownNameError, match="bpm_d"):
        measurement.select(monitors=["bpm_d"])


def test_a_selected_turn_stays_that_turn(measurement):
    part = measurement.select(turns=[2])
    assert part.readings.shape[1] == 3
    assert np.isnan(part.readings[:, :2]).all()
    np.testing.assert_array_equal(part.readings[:, 2], measurement.readings[:, 2])
    assert np.isfinite(measurement.readings).all()  # the whole is left as it was
    with pytest.raises(MeasurementError, match="no turn 4; there are 0 to 3"):
        measurement.select(turns=[0, 4])


@pytest.mark.parametrize(("holdout", "held"), [(0.0, 0), (0.01, 1), (0.4, 2), (0.99, 4)])
def test_split_parts_the_shots_and_leaves_one_to_fit(measurement, holdout, held):
    fit, out = measurement.split(holdout, seed=3)
    outside = () if out is None else out.shots
    assert len(outside) == held
    assert len(fit.shots) >= 1
    assert sorted((*fit.shots, *outside)) == list(measurement.shots)
    again, _ = measurement.split(holdout, seed=3)
    assert again.shots == fit.shots


def test_split_holds_out_no_shot_without_readings(measurement):
    readings = measurement.readings.copy()
    readings[:4] = np.nan
    one = Measurement(measurement.launches, readings, NAMES)
    assert one.split(0.5)[1] is None
    with pytest.raises(MeasurementError, match=r"in \[0, 1\)"):
        measurement.split(1.0)


def test_comparison_counts_only_what_was_read(measurement, rng):
    """Referee: a loop over the readings."""
    readings = measurement.readings.copy()
    readings[0, 1, 2] = np.nan
    readings[3, :, 0, 1] = np.nan
    readings[4] = np.nan
    holes = Measurement(measurement.launches, readings, NAMES, measurement.noise)
    model = 1e-3 * rng.standard_normal(readings.shape)
    found = holes.compare(model)
    squares, pulls = [], []
    for place in np.ndindex(readings.shape):
        left = readings[place] - model[place]
        if np.isnan(left):
            continue
        squares.append(left**2)
        noise = holes.noise[place[2], place[3]]
        if not np.isnan(noise):
            pulls.append((left / noise) ** 2)
    assert found.readings == len(squares)
    assert found.rms == pytest.approx(np.sqrt(np.mean(squares)), rel=1e-12)
    assert found.chi2_per_dof == pytest.approx(np.mean(pulls), rel=1e-12)
    np.testing.assert_allclose(
        found.rms_by_monitor, np.sqrt(np.nanmean((readings - model) ** 2, axis=(0, 1)))
    )
    assert np.isnan(found.rms_by_shot[4]).all()
    assert np.isfinite(found.rms_by_plane).all()
    with pytest.raises(MeasurementError, match="cannot be compared"):
        holes.compare(model[:, :2])


def test_chi2_of_pure_noise_is_one(rng):
    noise = np.array([[1e-5, 3e-5], [2e-5, 5e-6]])
    model = 1e-3 * rng.standard_normal((400, 1, 2, 2))
    read = model + noise * rng.standard_normal(model.shape)
    m = Measurement(np.zeros((400, 4)), read, ("a", "b"), noise)
    # 1600 readings: the mean of chi2 has an rms of sqrt(2 / 1600) = 0.035
    assert m.compare(model[:, 0]).chi2_per_dof == pytest.approx(1.0, abs=0.14)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"noise": (0.0, 1e-5)}, "noise of BPM 'bpm_a' in x is 0 m"),
        ({"noise": (1e-5, -1e-5)}, "above zero"),
        ({"noise": (1e-5, np.inf)}, "no BPM has"),
        ({"noise": (1e-5, 1e-5, 1e-5)}, "neither a pair"),
        ({"noise": {"bpm_x": (1e-5, 1e-5)}}, "no BPM 'bpm_x'"),
        ({"monitors": ("bpm_a", "bpm_b", "BPM_A")}, "stands twice"),
        ({"monitors": ("bpm_a", "bpm_b", "bpm_a::0")}, "stands twice"),
        ({"monitors": ("bpm_a", "bpm_b", "bpm\n")}, "no name"),
        ({"monitors": ("bpm_a", "bpm_b")}, "need"),
        ({"launches": np.zeros((5, 3))}, "5, 4"),
        ({"launches": [["a"] * 4] * 5}, "numbers"),
        ({"launches": np.full((5, 4), np.inf)}, "not finite"),
        ({"launch_sigma": np.full((5, 5), -1.0)}, "negative"),
        ({"launch_sigma": np.full((5, 5), np.nan)}, "NaN"),
        ({"readings": np.where(np.arange(2) == 0, np.inf, np.zeros((5, 4, 3, 2)))}, "infinite"),
        ({"shots": (1, 2, 3, 4, 4)}, "each once"),
        ({"settings": ({},)}, "one a shot"),
        (
            {"settings": ({"q": {"k1": 1.0}}, {}, {}, {}, {})},
            "no setting 'k1'; did you mean 'k1_relative'",
        ),
        ({"settings": ({"q": {"kick": np.nan}}, {}, {}, {}, {})}, "finite"),
        ({"settings": ({"q": {"frequency_relative": 1.0}}, {}, {}, {}, {})}, "the name 'rf'"),
        ({"settings": ({"rf": {"kick": 1.0}}, {}, {}, {}, {})}, "the name 'rf'"),
        ({"energy": 0.0}, "above zero"),
    ],
)
def test_what_cannot_be_is_refused(measurement, change, words):
    given = {
        "launches": measurement.launches, "readings": measurement.readings, "monitors": NAMES,
        **change,
    }  # fmt: skip
    with pytest.raises((MeasurementError, UnknownNameError), match=words):
        Measurement(**given)


@pytest.fixture
def response(rng):
    return OrbitResponse(
        correctors=("h1", "v1"),
        planes=("x", "y"),
        kicks=np.array([1e-4, -1e-4]),
        monitors=NAMES,
        response=1e-3 * rng.standard_normal((2, 3, 2)),
        noise=(2e-6, 1e-6),
        rf=RfStep(5e8, 3840, -3000.0, 1e-3 * rng.standard_normal((3, 2))),
    )


def test_orbit_response_selects_and_reorders(response):
    part = response.select(["V1"], ["bpm_c", "bpm_a"])
    assert part.correctors == ("v1",)
    assert part.planes == ("y",)
    np.testing.assert_array_equal(part.response, response.response[1:, [2, 0]])
    np.testing.assert_array_equal(part.rf.orbit, response.rf.orbit[[2, 0]])
    full = part.in_order_of(NAMES)
    np.testing.assert_array_equal(full.response[0, [0, 2]], response.response[1, [0, 2]])
    assert np.isnan(full.response[:, 1]).all()
    assert np.isnan(full.rf.orbit[1]).all()
    with pytest.raises(UnknownNameError, match="no corrector 'v2'"):
        response.select(["v2"])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"planes": ("x", "z")}, "'z'"),
        ({"kicks": np.array([1e-4, 0.0])}, "not zero"),
        ({"correctors": ("h1", "H1")}, "stands twice"),
        ({"correctors": ("h1", "rf")}, "the RF step's"),
        ({"response": np.zeros((2, 2, 2))}, "need"),
        ({"noise": (0.0, 0.0)}, "above zero"),
        ({"rf": RfStep(0.0, 3840, 1.0)}, "RF"),
        ({"rf": RfStep(5e8, 3840, 0.0, np.zeros((3, 2)))}, "step of 0 Hz"),
        ({"rf": RfStep(5e8, 3840, 1.0, np.zeros((2, 2)))}, "shape"),
    ],
)
def test_orbit_response_refuses_what_cannot_be(response, change, words):
    given = {
        "correctors": response.correctors, "planes": response.planes, "kicks": response.kicks,
        "monitors": NAMES, "response": response.response, **change,
    }  # fmt: skip
    with pytest.raises(MeasurementError, match=words):
        OrbitResponse(**given)
