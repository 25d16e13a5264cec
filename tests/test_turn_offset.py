"""A monitor whose turns are counted off by one or more: made by both engines, and named."""

from dataclasses import replace

import numpy as np
import pytest

from tmlattice import Cause, diagnose, simulate
from tmlattice.effects import background_rms, find
from tmlattice.errors import EffectError
from tmlattice.inference.alternatives import best_start
from tmlattice.inference.distributed import DistributedErrors, fit_distributed_errors
from tmlattice.inference.newton import fit, fit_nuisances
from tmlattice.machine.stored_beam import simulate_turns
from tmlattice.observe.turn_by_turn import many_turns

MONITOR = "end_9"


def offset(turns):
    return Cause("monitor_turn_offset", MONITOR, float(turns))


def at(measured):
    return measured.monitors.index(MONITOR)


@pytest.mark.parametrize("engine", ["at", "ocelot"])
def test_its_first_turns_are_those_of_later_ones(small_ring, engine):
    own = {"shots": 2, "seed": 1, "noise": 0.0, "engine": engine}
    right = simulate(small_ring, [], turns=4, **own).measurement().readings
    for late in (1, -1):
        measured = simulate(small_ring, [offset(late)], turns=3, **own).measurement()
        wrong, m = measured.readings, at(measured)
        if late > 0:
            np.testing.assert_array_equal(wrong[:, :, m], right[:, 1:, m])
        else:  # nothing was there before the injection
            assert np.isnan(wrong[:, 0, m]).all()
            np.testing.assert_array_equal(wrong[:, 1:, m], right[:, :2, m])
        others = np.arange(wrong.shape[2]) != m
        np.testing.assert_array_equal(wrong[:, :, others], right[:, :3, others])


def test_before_its_kick_a_stored_beam_is_on_its_orbit(small_ring):
    bump = Cause("corrector_kick_x", "v6", 3e-5)
    own = {"turns": 20, "seed": 1, "noise": 0.0}
    right = simulate_turns(small_ring, [bump], **own).measured
    wrong = simulate_turns(small_ring, [bump, offset(-2)], **own).measured
    quiet = simulate_turns(small_ring, [bump], kick=(0.0, 0.0), **own).measured
    m = at(right)
    np.testing.assert_array_equal(wrong.readings[:, 2:, m], right.readings[:, :-2, m])
    # the orbit is a fixed point to what AT's search leaves of it
    np.testing.assert_allclose(wrong.readings[:, :2, m], quiet.readings[:, :2, m], atol=1e-9)


def test_a_part_of_a_turn_is_a_sentence(small_ring):
    with pytest.raises(EffectError, match="whole number of turns"):
        simulate_turns(small_ring, [offset(0.5)], turns=20)


def test_lines_of_the_model_are_those_that_are_read(small_ring):
    """The model at the truth leaves noise; a count that is off by one more leaves far more."""
    late = -2
    measured = simulate_turns(small_ring, [offset(late)], shots=2, turns=400, seed=2).measured
    problem = many_turns(small_ring, measured, {})
    left = [fit_nuisances(problem, [offset(n)], problem.first).chi2 for n in (late, late + 1, 0)]
    assert left[0] < 1.5 * problem.freedom
    assert min(left[1:]) > 100 * left[0]


def test_the_derivative_is_that_of_the_model(small_ring):
    measured = simulate_turns(small_ring, [offset(1)], shots=2, turns=400, seed=2).measured
    problem = many_turns(small_ring, measured, {})
    gain = Cause("monitor_gain_x", MONITOR, 0.1)
    point = problem.at([offset(0.9), gain], problem.first)
    h = 1e-5
    up, down = (problem.at([offset(0.9 + a), gain], problem.first).residual for a in (h, -h))
    slope = problem.slope(point, 0)
    # differences err by (2 pi Q h)^2
    assert np.abs(slope - (down - up) / (2 * h)).max() < 1e-8 * np.abs(slope).max()
    magnet = Cause("quadrupole_gradient", "QD::3", 0.0)
    own = [offset(0.9), gain, magnet]
    point = problem.at(own, problem.first)
    up, down = (
        problem.at([*own[:2], replace(magnet, amount=a)], problem.first).residual
        for a in (1e-6, -1e-6)
    )
    # a mode has one complex factor free, which the nuisances take
    out = point.projection.out(problem.slope(point, 2) - (down - up) / 2e-6)
    assert np.abs(out).max() < 1e-4 * np.abs(problem.slope(point, 2)).max()


def test_it_is_named(small_ring):
    late = -3
    weak = Cause("quadrupole_gradient", "QD::3", -0.02)
    measured = simulate_turns(small_ring, [offset(late), weak], shots=2, turns=200, seed=3).measured
    effects = ["monitor_turn_offset", "monitor_gain_x", "quadrupole_gradient", "quadrupole_roll"]
    diagnosis = diagnose(small_ring, measured, effects=effects)
    named = {(f.recommended_action.effect, f.element) for f in diagnosis.findings}
    assert named == {("monitor_turn_offset", MONITOR), ("quadrupole_gradient", "QD::3")}
    amount, sigma = diagnosis.error("monitor_turn_offset", MONITOR)
    assert abs(amount - late) < 4 * sigma < 0.02


def test_a_monitor_that_counts_late_is_not_dead_as_well(small_ring):
    """Of one turn it reads nothing."""
    late = [offset(-2)]
    turns = simulate_turns(small_ring, late, shots=2, turns=200, seed=3).measured
    first = simulate(small_ring, late, shots=3, seed=1).measurement()
    alone = diagnose(small_ring, first).findings
    assert [(one.effect, one.element) for one in alone] == [("monitor_dead", MONITOR)]
    (found,) = diagnose(small_ring, {"turns": turns, "first": first}).findings
    assert (found.effect, found.element) == ("monitor_turn_offset", MONITOR)


def test_among_small_errors_a_first_guess_is_the_right_turn(small_ring):
    """A wrong count drags the amplitudes of all monitors along: they have to follow each guess."""
    rms = background_rms({"all": None})
    measured = simulate_turns(
        small_ring, [offset(1)], shots=2, turns=200, seed=3, background=rms
    ).measured
    turns = many_turns(small_ring, measured, {})
    everywhere = [(n, p) for n in rms for p in find(n).places(small_ring) if turns.sees((n, p))]
    known = DistributedErrors.usual(everywhere, rms)
    among = fit_distributed_errors(turns, known, turns.first, [offset(1)], learn=False).problem
    start = fit(among, (), among.first)
    assert best_start(among, start, ("monitor_turn_offset", MONITOR)).amount == 1


def test_first_turns_know_nothing_of_it(small_ring):
    first = simulate(small_ring, [], shots=3, seed=1).measurement()
    with pytest.raises(EffectError, match="turns of a stored beam"):
        diagnose(small_ring, first, effects=["monitor_turn_offset"])
    assert not find("monitor_turn_offset").usual
