"""Measurements stacked to one problem, and any problem among small errors."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from tmlattice import Cause, simulate
from tmlattice.beam.model import Model
from tmlattice.diagnosis.prepare import prepare
from tmlattice.effects import background_rms, find, modelled
from tmlattice.inference.alternatives import best_start
from tmlattice.inference.combined import CombinedProblem
from tmlattice.inference.distributed import DistributedErrors, fit_distributed_errors
from tmlattice.inference.judgement import DEFAULT
from tmlattice.inference.newton import fit
from tmlattice.inference.search import outlier
from tmlattice.machine.stored_beam import simulate_orbits, simulate_turns
from tmlattice.observe.data import of_measurement
from tmlattice.observe.first_turns import FirstTurns
from tmlattice.observe.orbits import closed_orbits
from tmlattice.observe.turn_by_turn import many_turns

WEAK = Cause("quadrupole_gradient", "QD::3", -0.02)
NOISE = 1e-6


@pytest.fixture(scope="module")
def turns(small_ring):
    measured = simulate(small_ring, [WEAK], shots=3, seed=3).measurement()
    return prepare(small_ring, measured, False, None, DEFAULT).problem


@pytest.fixture(scope="module")
def orbit(small_ring):
    kick = Cause("corrector_kick_x", "v6", 2e-5)
    measured = simulate_orbits(small_ring, [WEAK, kick], noise=NOISE, seed=1).measured
    return closed_orbits(small_ring, measured, {})


def test_rows_of_both_are_the_rows_of_each(turns, orbit):
    both = CombinedProblem.of([turns, orbit])
    point = both.at([WEAK], both.first)
    alone = [part.at([WEAK], part.first) for part in (turns, orbit)]
    assert_allclose(point.chi2, sum(one.chi2 for one in alone))
    some = [(WEAK.effect, WEAK.element), ("monitor_gain_x", "end_1"), ("energy_spread", None)]
    rng = np.random.default_rng(0)
    data = rng.standard_normal((2, len(point.residual)))
    found = both.metric(point).products(some, data)
    rows = both.metric(point).rows(some)
    assert_allclose(found.whole, np.einsum("hr,hr->h", rows, rows), rtol=1e-9)
    assert_allclose(found.inner, rows @ data.T, rtol=1e-9, atol=1e-9)
    assert (rows[2, len(alone[0].residual) :] == 0).all()  # a closed orbit has no launch


def test_slopes_of_both_are_the_scans(turns, orbit):
    both = CombinedProblem.of([turns, orbit])
    point = both.at([WEAK], both.first)
    h = 1e-5
    up, down = (
        both.at([replace(WEAK, amount=WEAK.amount + side * h)], both.first).residual
        for side in (1, -1)
    )
    slope = both.slope(point, 0)
    assert_allclose(slope, (down - up) / (2 * h), atol=2e-4 * np.abs(slope).max())


def test_many_fixed_causes_act_as_ones_that_are_sought(turns, orbit):
    """They stand in the model, or are put on each trajectory: of magnets, monitors and the beam."""
    rng = np.random.default_rng(2)
    fixed = tuple(
        Cause(effect, f"{name}::{i}", size * rng.standard_normal())
        for i in range(1, 8)
        for effect, name, size in (
            ("quadrupole_gradient", "QF", 1e-2), ("quadrupole_offset_x", "QD", 3e-4),
            ("monitor_gain_y", "bpm", 0.05), ("monitor_offset_x", "bpm", 1e-4),
        )
    )  # fmt: skip
    fixed += (Cause("energy_offset", None, 1e-4),)
    both = CombinedProblem.of([turns, orbit])
    with_fixed = replace(both, fixed=fixed).at([WEAK], both.first)
    assert_allclose(
        with_fixed.residual, both.at([*fixed, WEAK], both.first).residual, rtol=1e-9, atol=1e-6
    )
    assert np.abs(with_fixed.residual - both.at([WEAK], both.first).residual).max() > 10
    slope = replace(both, fixed=fixed).slope(with_fixed, 0)
    point = both.at([*fixed, WEAK], both.first)
    assert_allclose(slope, both.slope(point, len(fixed)), rtol=1e-6, atol=1e-4)


def test_a_reference_has_what_is_fixed_and_not_what_is_sought(orbit):
    both = CombinedProblem.of([orbit], [orbit])
    cause = Cause("corrector_kick_x", "v6", 2e-5)
    count = len(orbit.at((), orbit.first).residual)
    sought = both.at([cause], both.first).residual
    fixed = replace(both, fixed=(cause,)).at((), both.first).residual
    assert_allclose(sought[:count], fixed[:count])
    assert np.abs(sought[count:] - fixed[count:]).max() > 1


@pytest.mark.parametrize("since", [False, True], ids=["alone", "since a reference"])
def test_fast_products_among_small_errors_are_those_of_all_signatures(small_ring, turns, since):
    """Two ways to the same scan: sums over readings, and signatures that are whitened."""
    measured = turns
    if since:
        earlier = simulate(small_ring, [], shots=2, seed=4).measurement()
        before = prepare(small_ring, earlier, False, None, DEFAULT).problem
        measured = CombinedProblem.of([turns], [before])
    rms = {name: find(name).background for name in ("quadrupole_gradient", "monitor_gain_x")}
    everywhere = [(name, place) for name in rms for place in find(name).places(turns.model.ring)]
    start = fit(measured, (), measured.first)
    among = fit_distributed_errors(
        measured, DistributedErrors.usual(everywhere, rms), start.nuisances, learn=False
    )
    assert among.before.chi2 < 0.9 * start.chi2
    problem = among.problem
    some = [(WEAK.effect, WEAK.element), ("monitor_offset_y", "end_1"), ("energy_spread", None),
            ("quadrupole_offset_x", "QF::3"), ("monitor_swap", "bpm::4")]  # fmt: skip
    data = among.before.residual[None]
    metric, out = problem.metric(among.before.point), among.before.projection.out
    found = metric.products(some, data)
    rows = out(problem.white(problem.inner.metric(among.before.point.view).rows(some)))
    assert_allclose(found.whole - found.inside, np.einsum("hr,hr->h", rows, rows), rtol=1e-6)
    assert_allclose(found.inner, rows @ out(data).T, rtol=1e-6, atol=1e-6)
    places = [3, 20]
    gram, inner = metric.free_kicks(np.array(places), out(data[0]))
    for place, own_gram, own_inner in zip(places, gram, inner, strict=True):
        rows = out(problem.kick_rows(among.before.point, place))
        assert len(rows) == 2 * turns.data.shots
        size = np.sqrt(np.einsum("pr,pr->p", rows, rows))
        assert_allclose(own_gram[0], rows @ rows.T, atol=1e-6 * size.max() ** 2)
        assert_allclose(own_inner[0], rows @ data[0], atol=1e-6 * size.max())


@pytest.mark.parametrize("shots", [1, 4], ids=["more errors than readings", "fewer"])
def test_an_outlier_among_small_errors_is_the_reading_without_which_chi_square_falls(
    small_ring, shots
):
    rms = {"quadrupole_offset_x": 1e-4, "quadrupole_offset_y": 1e-4, "quadrupole_gradient": 2e-3}
    everywhere = [(name, place) for name in rms for place in find(name).places(small_ring)]
    data = of_measurement(small_ring, simulate(small_ring, shots=shots, seed=3).measurement())
    model = Model(small_ring, data.settings)
    for where in [(0, 3, 1), (0, 10, 0), (0, 17, 1)]:
        readings = data.readings.copy()
        readings[where] += 20 * data.sigma[where]
        turns = FirstTurns(model=model, data=replace(data, readings=readings), places={})
        usual = DistributedErrors.usual(everywhere, rms)
        among = fit_distributed_errors(turns, usual, turns.first, learn=False)
        (found,) = outlier(among.problem, among.before.point, 0)
        assert found.reading == where
        dropped = np.zeros(readings.shape, dtype=bool)
        dropped[where] = True
        without = fit(among.problem.without(dropped), (), among.before.nuisances)
        fell = among.before.chi2 - without.chi2
        assert found.detection.statistic == pytest.approx(fell, rel=1e-3)


def test_small_errors_leave_a_chi_square_of_one_and_hide_no_fault(small_ring):
    """Sizes learnt from closed orbits; a corrector that is far off stands out among them."""
    usual = background_rms({"all": None})
    everywhere = [(name, place) for name in usual for place in find(name).places(small_ring)]
    measured = simulate_orbits(small_ring, noise=NOISE, background=usual, seed=2).measured
    problem = closed_orbits(small_ring, measured, {})
    learnt = fit_distributed_errors(
        problem, DistributedErrors.usual(everywhere, usual), problem.first
    )
    assert learnt.log_evidence > 1e3
    assert 0.5 < learnt.before.chi2 / problem.valid.sum() < 1.5  # 70 readings: +- 0.17
    assert 0.5 < learnt.sizes["quadrupole_offset_x"] / usual["quadrupole_offset_x"] < 2


def test_a_start_at_which_no_beam_is_stored_is_none(small_ring):
    fault = Cause("family_gradient", "QF", 0.01)
    measured = simulate_turns(small_ring, [fault], turns=64, noise=1e-6, seed=1).measured
    turns = many_turns(small_ring, measured, dict.fromkeys(modelled(turns=True), 1.0))
    problem = CombinedProblem.of([turns])
    nuisances = fit(problem, (), problem.first)
    largest = find("family_gradient").largest
    unstable = replace(fault, amount=-0.5 * largest)
    assert problem.at((unstable,), nuisances.nuisances).lost
    found = best_start(problem, nuisances, ("family_gradient", "QF"))
    assert found.amount == pytest.approx(fault.amount)  # of shares of the largest
