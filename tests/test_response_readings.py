"""Readings of an orbit response that are not what others are: single ones, exchanged columns."""

from dataclasses import replace

import numpy as np
import pytest
from shared import parted, small_steps

from tests.scenarios import moved as jittery
from tests.scenarios import swapped_correctors, swapped_monitors
from tmlattice import diagnose
from tmlattice.diagnosis.families.steps import STEPS
from tmlattice.diagnosis.response.hierarchical import fit_families, taken_back
from tmlattice.diagnosis.response.linear import linear
from tmlattice.diagnosis.response.stated import fitted_causes
from tmlattice.effects import Cause
from tmlattice.inference.normal import solve
from tmlattice.observe.orbit_response import Errors, Predicted
from tmlattice.observe.response_data import response_data

WITH_ROLLS = {"corrector_calibration", "monitor_gain", "quadrupole_gradient", "monitor_roll",
              "corrector_roll"}  # fmt: skip
GRADIENTS = {"QD::5": 0.01, "QF::9": -0.008, "QF::3": 0.006, "QD::12": 0.005}


@pytest.fixture(scope="module")
def clean(small_ring):
    causes = [Cause("quadrupole_gradient", name, amount) for name, amount in GRADIENTS.items()]
    return small_steps(small_ring, [*causes, Cause("corrector_calibration", "v2", 0.1)], seed=3)


def fitted(ring, measured):
    return fit_families(*parted(ring, measured, 1), [STEPS[0], STEPS[2]]).state


def error(state):
    """rms of the gradients."""
    family = next(f for f in state.families if f.variable == "gradient")
    truth = {name.casefold(): amount for name, amount in GRADIENTS.items()}
    known = [truth.get(name.casefold(), 0.0) for name in family.places(state.data)]
    return float(np.sqrt(np.mean((state.values["gradient"] - known) ** 2)))


def test_neighbours_that_were_set_aside_are_taken_back_where_they_are_sound(small_ring, clean, rng):
    """Pohang: the magnet beside them was far off, and was not found without them."""
    state = fitted(small_ring, clean)
    monitor = np.arange(len(state.good))
    alone = replace(state, good=monitor != 12)
    assert taken_back(alone) is alone
    back = taken_back(replace(state, good=~np.isin(monitor, [6, 7])))
    assert back.good.all()
    assert error(back) < 1.1 * error(state)
    apart = 2e-7 * rng.standard_normal(clean.response[:, [6, 7]].shape)
    crate = apart[:, [0, 0]]  # one crate reads both
    for bad in (apart, crate):
        response = clean.response.copy()
        response[:, [6, 7]] += bad
        noisy = fitted(small_ring, replace(clean, response=response))
        assert np.flatnonzero(~noisy.good).tolist() == [6, 7]
        assert taken_back(noisy) is noisy


@pytest.mark.parametrize(("plane", "times"), [("x", 5), ("x", 200), ("y", 20)])
def test_a_jitter_of_the_beam_is_told_and_teaches_nothing(
    small_ring, ring_kicking_x, monkeypatch, plane, times
):
    """PETRA III: a closed orbit in every step, the RF's too, each time another amount of it."""
    noise = 2e-8
    ring = small_ring if plane == "x" else ring_kicking_x("i")
    causes = [Cause("quadrupole_gradient", name, amount) for name, amount in GRADIENTS.items()]
    measured = small_steps(ring, causes, noise=noise, seed=3)
    moves, rests = "xy".index(plane), "yx".index(plane)
    moved = jittery(moves, times)(measured, np.random.default_rng(5))
    orbits = (moved.response - measured.response)[..., moves]
    steps = [step for step in STEPS if step[0].name in WITH_ROLLS]

    def found(response):
        return fit_families(*parted(ring, response, 1), steps)

    still, told = found(measured), found(moved)
    assert still.state.jitter is None
    (said,) = (one for one in told.messages if "beam jitter" in one)
    assert f"rms in {plane} (as by kicks behind " in said
    assert f"rms in {'xy'[rests]}" not in said
    patterns = told.state.jitter[moves]
    assert not told.state.jitter[rests].any()
    # alike at all monitors, and as large: fifteen columns know their rms to a fifth
    missed = np.linalg.lstsq(patterns.T, orbits[0], rcond=None)[0] @ patterns - orbits[0]
    assert np.sqrt(np.mean(missed**2)) < 0.02 * np.sqrt(np.mean(orbits[0] ** 2))
    size = np.sqrt(np.mean((patterns**2).sum(axis=0)))
    assert size == pytest.approx(np.sqrt(np.mean(orbits**2)), rel=0.4)
    assert error(told.state) < 1.3 * error(still.state)
    # the RF's other BPMs are predicted with the jitter that its fitted ones show
    assert told.steps[-1].dispersion_rms < 3 * still.steps[-1].dispersion_rms
    if times > 100:
        monkeypatch.setattr("tmlattice.diagnosis.response.hierarchical.sought", lambda state: None)
        assert error(found(moved).state) > 10 * error(told.state)


@pytest.mark.parametrize(
    ("what", "swapped", "pair"),
    [
        ("correctors", swapped_correctors, ("v5", "v6")),  # neighbours
        ("BPMs", swapped_monitors, ("end_1", "end_14")),
    ],
)
def test_what_is_exchanged_is_the_finding(small_ring, rng, what, swapped, pair):
    """A ring without another fault had been told to have no error; whatever effects are asked."""
    wrong = swapped(*pair)(small_steps(small_ring, seed=3), rng)
    found = diagnose(small_ring, wrong, effects=["quadrupole_gradient"])
    assert found.verdict == "localised"
    (one,) = found.findings
    assert set(one.elements) == set(pair)
    assert one.words == f"{what} {' and '.join(one.elements)} respond each as the other one should"
    # chi-square as it was read, less that of sound readings: a free gain has taken some of it
    own = response_data(small_ring, wrong)
    model = Predicted(own, Errors.none(own)).read
    noise = 2e-8
    gain = np.nansum((own.orbits - model) ** 2) / noise**2 - 2 * np.isfinite(own.orbits).sum()
    assert 0.2 * gain < one.detection.statistic < 1.1 * gain
    places = [small_ring[name].s for name in pair]
    if what == "correctors":
        assert one.where[0] < min(places) < max(places) < one.where[1]
    else:
        assert any(one.where[0] <= s <= one.where[1] for s in places)
        assert one.where[1] - one.where[0] < 0.4 * small_ring.length
    assert f"LOCALISED: {what[0].upper()}{what[1:]} {one.elements[0]} and" in found.report()
    assert one.to_check in " ".join(found.report().split())
    assert repr(one).startswith(f"<Finding {one.words}")


@pytest.mark.parametrize("waves", [0.0, 3.0])
def test_stated_errors_hold_where_every_column_has_a_wave_of_its_own(small_ring, clean, waves):
    """Real rings: gradients scattered by two of their stated errors between seeds."""
    rng = np.random.default_rng(5)
    response, planes = clean.response.copy(), np.array(clean.planes)
    for c, plane in enumerate(planes):
        own = int(plane == "y")
        alike = clean.response[planes == plane, :, own]
        wave = rng.standard_normal(len(alike)) @ alike
        response[c, :, own] += waves * 2e-8 * wave / wave.std()
    state = fitted(small_ring, replace(clean, response=response))
    truth = {name.casefold(): amount for name, amount in GRADIENTS.items()}
    found = [(own.amount - truth.get(own.element.casefold(), 0.0), sigma)
             for own, sigma in fitted_causes(state)[0]
             if own.effect == "quadrupole_gradient"]  # fmt: skip
    off, sigma = np.transpose(found)
    there = linear(state, 0)
    plain = solve(there.normal, there.groups, there.start, rounds=0).sigma[there.where["gradient"]]
    size, without = (np.sqrt(np.mean((off / own) ** 2)) for own in (sigma, plain))
    assert 0.6 < size < 1.4  # 32 gradients, which pull against one another
    assert without > 1.5 or not waves
