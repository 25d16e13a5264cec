"""Scans that need no signatures, against the signatures written out."""

from dataclasses import replace

import numpy as np
import pytest

from tmlattice.effects import Cause, find, modelled
from tmlattice.inference.newton import fit
from tmlattice.inference.problem import Metric
from tmlattice.machine.response import simulate_response
from tmlattice.machine.stored_beam import simulate_turns
from tmlattice.observe.orbit_response import Errors, Predicted
from tmlattice.observe.response_data import response_data
from tmlattice.observe.response_problem import Response, single_causes
from tmlattice.observe.stored import SteadyMetric
from tmlattice.observe.turn_by_turn import many_turns

SICK = [
    Cause("quadrupole_gradient", "QD::5", 0.01), Cause("corrector_kick_y", "v3", 1e-4),
    Cause("quadrupole_offset_x", "QF::9", 1e-4), Cause("corrector_calibration", "v5", 0.2),
    Cause("monitor_gain_x", "end_3", 0.1), Cause("monitor_roll", "end_4", 0.1),
]  # fmt: skip


class Written(SteadyMetric):
    """Products of every signature."""

    quick = Metric.quick


@pytest.fixture(scope="module")
def measured(small_ring):
    return simulate_response(small_ring, engine="ocelot", progress=False).measured


@pytest.mark.parametrize("causes", [[], SICK], ids=["design", "sick"])
def test_products_through_factors_equal_those_of_signatures(
    small_ring, measured, causes, rng, monkeypatch
):
    """About an orbit, with wrong monitors and correctors and missing readings; kicks too."""
    monitors = [m for m in measured.monitors if m not in ("bpm::2", "last_a")]
    data = response_data(small_ring, measured.select(monitors=monitors if causes else None))
    base = Predicted(data, Errors.none(data)).with_causes(causes)
    used = np.isfinite(data.orbits)
    used &= rng.uniform(size=used.shape) >= 0.2 * bool(causes)
    problem = Response(base=base, used=used, places={})
    start = fit(problem, (), problem.first)
    rows = rng.standard_normal((3, len(start.residual)))
    hypotheses = single_causes(data)
    about = problem.metric(start.point)
    written = []
    make = about.rows
    monkeypatch.setattr(about, "rows", lambda some: written.extend(some) or make(some))
    mine = about.products(hypotheses, rows)
    theirs = Written(problem, start.point).products(hypotheses, rows)

    assert written == [("energy_offset", None), ("energy_spread", None)]
    alike(mine, theirs)
    assert not mine.inside.any()


def alike(mine, theirs):
    size = np.sqrt(theirs.whole)
    assert (size > 0).mean() > 0.8
    assert (np.abs(mine.whole - theirs.whole) <= 1e-12 * theirs.whole).all()
    assert (np.abs(mine.inside - theirs.inside) <= 1e-12 * theirs.whole).all()
    assert (np.abs(mine.inner - theirs.inner) <= 1e-12 * size[:, None]).all()


def test_products_through_modes_equal_those_of_signatures(small_ring, rng):
    """Two beams, one monitor a turn late, one with a wrong gain, lines that are not used."""
    settings = ({}, {}, {"v3": {"kick": 2e-4}})
    turns = simulate_turns(small_ring, SICK, shots=3, turns=64, seed=1, settings=settings).measured
    late = Cause("monitor_turn_offset", "end_2", 1.0)
    problem = replace(many_turns(small_ring, turns, {}), fixed=(*SICK, late))
    problem = problem.without(rng.uniform(size=problem.used.shape) < 0.2)
    start = fit(problem, (), problem.first)
    rows = start.projection.out(rng.standard_normal((3, len(start.residual))))
    names = modelled(None, turns=True)
    every = [(name, place) for name in names for place in find(name).places(small_ring)]
    hypotheses = [h for h in every if problem.sees(h)]
    mine = problem.metric(start.point).products(hypotheses, rows)
    alike(mine, Written(problem, start.point).products(hypotheses, rows))
