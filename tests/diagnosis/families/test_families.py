"""What a family of errors is told as does to the readings what the family itself does."""

import numpy as np
import pytest
from shared import parted, small_steps

from tmlattice.diagnosis.families.fields import (
    CorrectorPosition,
    EdgeFocusing,
    QuadrupoleGradient,
    SkewGradient,
    VerticalFocusing,
    straights,
)
from tmlattice.diagnosis.families.steps import (
    CorrectorCalibration,
    CorrectorRoll,
    EnergyOffset,
    EnergySpread,
    MonitorGain,
    MonitorRoll,
)
from tmlattice.diagnosis.response.rounds import settle
from tmlattice.diagnosis.response.state import allow, begin, jump
from tmlattice.effects import Cause
from tmlattice.lattice.ring import Element, Ring
from tmlattice.machine.response import simulate_response
from tmlattice.observe.orbit_response import Errors, Predicted
from tmlattice.observe.response_data import response_data

CALIBRATION, GAIN = CorrectorCalibration(), MonitorGain()
RMS = {
    CALIBRATION: 0.1,  # large, and beside the others: these two are exact
    GAIN: 0.1,
    QuadrupoleGradient(): 1e-3,
    VerticalFocusing(): 1e-3,
    EdgeFocusing(): 1e-3,
    EnergyOffset(): 1e-3,
    EnergySpread(): 1.0,
    CorrectorPosition(): 0.01,
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
        for cause, _ in one.causes_of(errors, own, np.ones_like(own), data)
    ]
    fitted = Predicted(data, errors).read
    told = Predicted(data, Errors.none(data).with_causes(data, causes)).read
    change = np.abs(fitted - Predicted(data, without).read).max()
    assert change > 1e-7
    # what is left: the second order of rolls and mixing, 1e-3 of them
    assert np.abs(told - fitted).max() < 5e-3 * change


def ring_of(*elements):
    """Of (name, kind, length) and, of bends, the angle, one behind the other."""
    placed, end = [], 0.0
    for name, kind, length, *angle in elements:
        numbers = (end + length / 2, length, 0.0, 0.0, sum(angle), 0.0)
        placed.append(Element(name, name, kind, *numbers, source=None))
        end += length
    return Ring("line", tuple(placed), 1.0)


def wiggler(second):
    return [
        ("q1", "quadrupole", 0.2), ("d1", "drift", 2.0), ("w1", "bend", 0.1, 0.01),
        ("w2", "bend", 0.1, second), ("d2", "drift", 2.0), ("q2", "quadrupole", 0.2),
        ("d3", "drift", 2.0), ("q3", "quadrupole", 0.2),
    ]  # fmt: skip


def named(ring):
    return [own.name for own in straights(ring)]


def test_a_straight_beside_a_wiggler_in_bends_has_no_device_of_its_own():
    """LNLS: two drifts beside a wiggler at the ring's start ran to 0.13 and 0.19 1/m against it."""
    assert named(ring_of(*wiggler(0.01))) == ["d1", "d2", "d3"]
    assert named(ring_of(*wiggler(-0.01))) == ["d3"]


def test_straights_are_the_same_wherever_the_lattice_begins():
    """ALS begins in the middle of one, which had two numbers: 6.8 m with a marker at both ends."""
    for second in (0.01, -0.01):
        line = wiggler(second)
        whole = sorted(named(ring_of(*line)))
        for i in range(len(line)):
            assert sorted(named(ring_of(*line[i:], *line[:i]))) == whole
    cut = [("d1", "drift", 0.7), ("h", "hcorrector", 0.0), ("q", "quadrupole", 0.2),
           ("d2", "drift", 0.9), ("q2", "quadrupole", 0.2), ("d3", "drift", 0.4)]  # fmt: skip
    assert named(ring_of(*cut)) == ["d1"]  # 1.1 m in all
    assert len(named(ring_of(("a", "marker", 0.0), *cut, ("b", "marker", 0.0)))) == 1


def test_fields_that_the_iron_beside_them_draws_away_come_out_where_at_has_them(small_ring):
    """v1 to v15, between a bend and QF, are moved by 15 mm in AT; v0 stands alone and stays."""
    family, names = CorrectorPosition(), [f"v{i}" for i in range(1, 16)]
    for by in (0.015, -0.015):
        causes = [Cause("corrector_position", name, by) for name in names]
        measured = small_steps(small_ring, causes, seed=2, engine="at")
        data, split = parted(small_ring, measured)
        assert [list(own) for own in family.shares(data)] == [names]
        state = begin(data, split)
        (found,) = settle(jump(allow(state, [family]))).values[family.variable]
        assert abs(found - by) < 1e-3


@pytest.mark.parametrize("by", [1.5e-3, -1.5e-3])
def test_the_beams_energy_comes_out_as_at_has_it(small_ring, by):
    """AT's closed orbits at the RF frequency of that energy."""
    measured = small_steps(small_ring, [Cause("energy_offset", None, by)], seed=2, engine="at")
    state = begin(*parted(small_ring, measured))
    (found,) = settle(allow(state, [EnergyOffset()])).values["energy"]
    assert abs(found - by) < 0.01 * abs(by)


@pytest.mark.parametrize("own", [0.0, 0.6, -0.6, -0.9])
def test_a_corrector_that_kicks_across_is_turned(data, own):
    """By a right angle where nothing is left in its plane, by more where the sign is reversed."""
    turned = CorrectorRoll()
    values = {CALIBRATION: np.zeros(18), turned: np.zeros(18)}
    values[CALIBRATION][4], values[turned][4] = own - 1, 0.8
    errors = Errors.none(data)
    for family, numbers in values.items():
        errors = family.put(errors, numbers, data)
    (kick, roll) = (
        family.causes_of(errors, numbers, np.full(18, 0.01), data)[4]
        for family, numbers in values.items()
    )
    size = np.hypot(own, 0.8)
    sign = -1 if own < -0.8 else 1
    assert np.isclose(kick[0].amount, sign * size - 1)
    assert np.isclose(roll[0].amount, np.arctan2(sign * 0.8, sign * own))
    assert np.isclose(roll[1], 0.01 / size)
    fitted = Predicted(data, errors).read
    told = Predicted(data, Errors.none(data).with_causes(data, [kick[0], roll[0]])).read
    change = np.abs(fitted - Predicted(data, Errors.none(data)).read).max()
    assert np.abs(told - fitted).max() < 1e-5 * change
