"""Simulated responses and `predict`: files against the model and one another."""

import csv

import numpy as np
import pytest
from command import tmlattice
from conftest import SMALL
from numpy.testing import assert_allclose

from tmlattice import Cause, load_ring
from tmlattice.beam.closed_orbit import ResponseModel
from tmlattice.errors import EffectError, MeasurementError
from tmlattice.machine.response import simulate_response
from tmlattice.observe.calibration import (
    Calibration,
    calibrated_response,
    read_calibration,
    write_calibration,
)
from tmlattice.observe.compared import OfResponse

CAUSES = [
    Cause("monitor_gain_x", "last_a", 0.1),
    Cause("monitor_roll", "end_3", 0.05),
    Cause("corrector_calibration", "v5", -0.2),
    Cause("corrector_roll", "v6", 0.02),
]


@pytest.mark.parametrize("engine", ["at", "ocelot"])
def test_simulated_response_is_the_models(small_ring, engine):
    """Two-sided steps of a microradian: what is left is third order, or AT's own optics."""
    measured = simulate_response(
        small_ring, CAUSES, kick=1e-6, rf_step=1.0, noise=0.0, engine=engine, progress=False
    ).measured
    _, expected = calibrated_response(small_ring, CAUSES)
    scale = np.abs(expected).max()
    close = {"ocelot": 1e-6, "at": 1e-3}[engine]  # the tunes differ by 1e-4: matrix wiggler, edges
    assert_allclose(measured.response / 1e-6, expected, atol=close * scale)
    rf = OfResponse(small_ring, measured).pairs(measured)[1][-1]
    other = [i for i, m in enumerate(measured.monitors) if m not in ("last_a", "end_3")]
    assert_allclose(measured.rf.orbit[other], rf[other], atol=2e-3 * np.abs(rf).max())


def test_noise_and_seeds(small_ring):
    def response(**options):
        options = {"engine": "ocelot", "progress": False, "correctors": ["v1", "v2"], **options}
        return simulate_response(small_ring, **options).measured.response

    clean, noisy = response(noise=0.0), response(noise=(2e-6, 1e-6), seed=3)
    rms = np.std(noisy - clean, axis=(0, 1))
    assert_allclose(rms, [2e-6, 1e-6], rtol=0.35)  # 68 readings a plane: 9 % each, three sigma
    assert np.array_equal(noisy, response(noise=(2e-6, 1e-6), seed=3))
    assert not np.array_equal(noisy, response(noise=(2e-6, 1e-6), seed=4))


def test_one_sided_steps_have_a_second_order(small_ring):
    """It is even in the kick: the sum over both signs holds it alone, fourfold for twice."""

    def even(kick):
        both = [
            simulate_response(
                small_ring, correctors=["generated_a"], kick=side * kick, noise=0.0,
                engine="ocelot", one_sided=True, rf_step=0.0, progress=False,
            ).measured.response
            for side in (1, -1)
        ]  # fmt: skip
        return both[0] + both[1]

    assert np.abs(even(1e-5)).max() > 0
    assert_allclose(even(2e-5), 4 * even(1e-5), rtol=0.02, atol=1e-3 * np.abs(even(2e-5)).max())


def test_predict_with_a_calibration(tmp_path, small_ring):
    file, out = tmp_path / "ring.calibration.json", tmp_path / "predicted.csv"
    write_calibration(file, Calibration(CAUSES))
    assert read_calibration(file, small_ring).causes == CAUSES
    tmlattice("predict", SMALL, "--calibration", file, "--corrector", "v5", "--corrector", "v6",
              "--kick", "2e-5", "--out", out, cwd=tmp_path, check=0)  # fmt: skip
    with out.open(encoding="utf-8") as table:
        rows = list(csv.DictReader(table))
    assert list(rows[0]) == ["corrector", "monitor", "x", "y"]
    monitors = [m.name for m in load_ring(SMALL).monitors]
    assert [r["monitor"] for r in rows[: len(monitors)]] == monitors
    values = np.array([[float(r["x"]), float(r["y"])] for r in rows]).reshape(2, -1, 2)
    plain = ResponseModel(small_ring).response(["v5", "v6"])
    good = [i for i, m in enumerate(monitors) if m not in ("last_a", "end_3")]
    assert_allclose(values[0, good], 0.8 * 2e-5 * plain[0, good], rtol=1e-9, atol=1e-15)
    # a vertical corrector rolled from x towards y kicks by -sin(roll) in x
    other = np.abs(values[1, good, 0]).max() / np.abs(values[1, good, 1]).max()
    assert 0.002 < other < 0.2


def test_calibration_that_cannot_be(tmp_path, small_ring):
    own = Calibration([Cause("quadrupole_gradient", "QF::1", 0.1)])
    with pytest.raises(EffectError, match="is no calibration"):
        write_calibration(tmp_path / "c.json", own)
    (tmp_path / "c.json").write_text('{"format": "tmlattice-calibration", "version": 1}')
    with pytest.raises(MeasurementError, match="effects"):
        read_calibration(tmp_path / "c.json", small_ring)
