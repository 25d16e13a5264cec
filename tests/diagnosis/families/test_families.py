"""What a family of errors is told as does to the readings what the family itself does."""

from types import SimpleNamespace

import numpy as np
import pytest

from tmlattice.diagnosis.families.fields import (
    EdgeFocusing,
    QuadrupoleGradient,
    SkewGradient,
    VerticalFocusing,
)
from tmlattice.diagnosis.families.magnets import straights
from tmlattice.diagnosis.families.steps import (
    CorrectorCalibration,
    CorrectorRoll,
    EnergySpread,
    MonitorGain,
    MonitorRoll,
)
from tmlattice.machine.response import simulate_response
from tmlattice.observe.orbit_response import Errors, Predicted, response_data

CALIBRATION, GAIN = CorrectorCalibration(), MonitorGain()
RMS = {
    CALIBRATION: 0.1,  # large, and beside the others: these two are exact
    GAIN: 0.1,
    QuadrupoleGradient(): 1e-3,
    VerticalFocusing(): 1e-3,
    EdgeFocusing(): 1e-3,
    EnergySpread(): 1.0,
    MonitorRoll(): 1e-3,
    CorrectorRoll(): 1e-3,
    SkewGradient(): 1e-3,
}


@pytest.fixture(scope="module")
def data(small_ring):
    measured = simulate_response(small_ring, engine="ocelot", progress=False).measured
    return response_data(small_ring, measured)


def drawn(family, data, rng):
    values = RMS[family] * rng.standard_normal(family.size(data))
    if family.per == "column":
        values[-1] = 0.0  # of the RF
    values = values + (RMS[family] if family.size(data) == 1 else 0)
    return np.maximum(values, family.lowest(data))


@pytest.mark.parametrize("family", RMS, ids=lambda family: family.name)
def test_causes_that_are_told_read_as_the_errors_that_were_fitted(data, rng, family):
    values = {one: drawn(one, data, rng) for one in dict.fromkeys((CALIBRATION, GAIN, family))}
    without = errors = Errors.none(data)
    for one, own in values.items():
        errors = one.put(errors, own, data)
        without = without if one is family else one.put(without, own, data)
    causes = [
        cause
        for one, own in values.items()
        for cause, _ in one.told(errors, own, np.ones_like(own), data)
    ]
    fitted = Predicted(data, errors).read
    told = Predicted(data, Errors.none(data).with_causes(data, causes)).read
    change = np.abs(fitted - Predicted(data, without).read).max()
    assert change > 1e-7
    # what is left: the second order of rolls and mixing, 1e-3 of them
    assert np.abs(told - fitted).max() < 5e-3 * change


def test_a_straight_beside_a_wiggler_in_bends_has_no_device_of_its_own():
    """LNLS: two drifts beside a wiggler at the ring's start ran to 0.13 and 0.19 1/m against it."""

    def one(name, kind, length, s, angle=0.0):
        is_magnet = kind not in ("drift", "marker")
        return SimpleNamespace(
            name=name, kind=kind, length=length, s=s, angle=angle, is_magnet=is_magnet
        )

    def ring(second):
        elements = [
            one("q1", "quadrupole", 0.2, 0.1), one("d1", "drift", 2.0, 1.2),
            one("w1", "bend", 0.1, 2.25, 0.01), one("w2", "bend", 0.1, 2.35, second),
            one("d2", "drift", 2.0, 3.4), one("q2", "quadrupole", 0.2, 4.5),
            one("d3", "drift", 2.0, 5.6), one("q3", "quadrupole", 0.2, 6.7),
        ]  # fmt: skip
        return SimpleNamespace(elements=elements, length=6.8)

    assert [own.name for own in straights(ring(0.01))] == ["d1", "d2", "d3"]
    assert [own.name for own in straights(ring(-0.01))] == ["d3"]
