"""The posterior of small errors from sums over rows, as with all signatures written out."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from tmlattice import Cause, simulate
from tmlattice.diagnosis.prepare import prepare
from tmlattice.effects import background_rms, find
from tmlattice.inference.distributed import DistributedErrors, fit_distributed_errors, posterior
from tmlattice.inference.judgement import DEFAULT
from tmlattice.inference.newton import fit_nuisances
from tmlattice.machine.response import simulate_response
from tmlattice.observe import response_problem
from tmlattice.observe.orbit_response import Errors, Predicted
from tmlattice.observe.response_data import response_data
from tmlattice.observe.response_problem import Response

USUAL = background_rms({"all": None})
PIECE = 200_000
"""Numbers of signatures at a time: two or three monitors of the small ring."""


@pytest.fixture(scope="module")
def response(small_ring):
    """Six columns and the RF's, one reading missing, one monitor not used."""
    correctors = [e.name for e in small_ring.elements if e.kind.endswith("corrector")][::3]
    measured = simulate_response(
        small_ring, background=USUAL, machine_seed=5, seed=1, correctors=correctors, progress=False
    ).measured
    data = response_data(small_ring, measured)
    used = np.isfinite(data.orbits)
    used[2, 7, 1], used[:, 11] = False, False
    return Response(base=Predicted(data, Errors.none(data)).bend(), used=used, places={})


@pytest.fixture(scope="module")
def everywhere(small_ring):
    return [(name, place) for name in USUAL for place in find(name).places(small_ring)]


def covariance(known):
    inside = np.eye(len(known.rms)) - (known.seen.T * known.share) @ known.seen
    return known.rms[:, None] * inside * known.rms


def same(one, other, tolerance):
    sigma = other.errors
    assert_allclose((one.amounts - other.amounts) / sigma, 0, atol=tolerance)
    off = (covariance(one) - covariance(other)) / sigma / sigma[:, None]
    assert np.abs(off).max() < tolerance


def chi2_of(turns, found):
    """Of the model with the most probable errors, the launches fitted."""
    pairs = zip(found.before.hypotheses, found.amounts.tolist(), strict=True)
    fixed = turns.with_fixed([Cause(*h, a) for h, a in pairs])
    return fit_nuisances(fixed, (), turns.first).chi2


def test_pieces_are_the_signatures(response, everywhere, monkeypatch):
    monkeypatch.setattr(response_problem, "AT_ONCE", PIECE)
    point = response.at((Cause("monitor_roll", "end_1", 0.02),), response.first)
    some = [*everywhere[::3], ("energy_spread", None), ("skew_gradient", "QF::5")]
    metric = response.metric(point)
    rows, seen = metric.rows(some), []
    for which, piece in metric.pieces(some):
        assert piece.size <= PIECE
        assert_allclose(piece, rows[:, which], rtol=1e-9, atol=1e-10 * np.abs(rows).max())
        seen += which.tolist()
    assert sorted(seen) == list(range(rows.shape[1]))
    assert len(seen) > 2


def test_sums_give_the_posterior_of_all_signatures(response, everywhere, monkeypatch):
    monkeypatch.setattr(response_problem, "AT_ONCE", PIECE)
    usual = DistributedErrors.usual(everywhere, USUAL)
    direct = fit_distributed_errors(response, usual, response.first)
    sums_at = posterior(response, usual)
    assert sums_at.sizes == pytest.approx(direct.sizes, rel=1e-8)
    scales = np.sqrt(np.diag(sums_at.before.scales))
    assert_allclose(scales, [*direct.errors.values()], rtol=1e-8)
    known = direct.problem.learnt(direct.before)
    same(sums_at.known, known, 0.02)  # its amounts have followed the scales
    # and once more, from what is known
    again = fit_distributed_errors(response, known, response.first, learn=False)
    twice = posterior(response, known, learn=False)
    same(twice.known, again.problem.learnt(again.before), 1e-7)


def test_nuisances_are_projected_out(small_ring, everywhere):
    """First turns have a launch each, which the two ways settle each in its own noise."""
    measured = simulate(small_ring, background=USUAL, machine_seed=5, shots=3, seed=3).measurement()
    turns = prepare(small_ring, measured, False, None, DEFAULT).problem
    usual = DistributedErrors.usual(everywhere, USUAL)
    direct = fit_distributed_errors(turns, usual, turns.first, learn=False)
    sums_at = posterior(turns, usual, learn=False).known
    known = direct.problem.learnt(direct.before)
    assert_allclose(sums_at.errors, known.errors, rtol=0.02)
    assert_allclose((sums_at.amounts - known.amounts) / known.errors, 0, atol=0.1)


def test_first_turns_far_from_the_design_are_followed_along_the_way(small_ring):
    """Orbits of 5 mm in sextupoles 20 times as strong, as those of rings of low emittance: no step
    from the design has a beam, and readings behind the first ones follow given these."""
    sextupoles = {i: e.changed(k2=20 * e.k2) for i, e in enumerate(small_ring.elements)
                  if e.kind == "sextupole"}  # fmt: skip
    strong = small_ring.with_elements(sextupoles)
    twice = {name: 2 * rms for name, rms in USUAL.items()}
    measured = simulate(
        strong, background=twice, machine_seed=2, shots=3, turns=4, amplitude=3e-4, seed=3
    ).measurement()
    assert np.sqrt(np.nanmean(measured.readings**2)) > 4e-3
    turns = prepare(strong, measured, False, None, DEFAULT).problem
    seen = [(n, p) for n in USUAL for p in find(n).places(strong) if turns.sees((n, p))]
    found = posterior(turns, DistributedErrors.usual(seen, twice), learn=False)
    assert chi2_of(turns, found) < turns.valid.sum()


def test_amounts_follow_the_estimated_scales(small_ring):
    """Quadrupoles displaced by thirty times the usual, with the usual ones as prior: one step to
    the estimated scales, from amounts of the usual ones, explains the readings half."""
    usual = {f"quadrupole_offset_{plane}": USUAL[f"quadrupole_offset_{plane}"] for plane in "xy"}
    machine = {name: 30 * rms for name, rms in usual.items()}
    measured = simulate(
        small_ring, background=machine, machine_seed=2, shots=3, turns=2, seed=3
    ).measurement()
    turns = prepare(small_ring, measured, False, None, DEFAULT).problem
    seen = [(n, p) for n in usual for p in find(n).places(small_ring) if turns.sees((n, p))]
    found = posterior(turns, DistributedErrors.usual(seen, usual))
    assert all(10 < rms / usual[name] < 90 for name, rms in found.sizes.items())
    assert chi2_of(turns, found) < turns.valid.sum()
