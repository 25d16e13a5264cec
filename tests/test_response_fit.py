"""The block solver of the response's fit against dense normal equations, and known errors."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.optimize import lsq_linear
from shared import gradients, parted, small_steps

from tmlattice.diagnosis.families.fields import FocusingChange, VerticalFocusing
from tmlattice.diagnosis.families.steps import STEPS
from tmlattice.diagnosis.response import hierarchical, rounds
from tmlattice.diagnosis.response.hierarchical import rough_fit
from tmlattice.diagnosis.response.linear import Linear
from tmlattice.diagnosis.response.state import begin
from tmlattice.diagnosis.response.stated import fitted_causes
from tmlattice.effects import Cause
from tmlattice.inference import normal as blocks
from tmlattice.inference.normal import Normal, Slopes, normal_equations, solve
from tmlattice.inference.priors import Group
from tmlattice.machine.response import simulate_response


@pytest.fixture
def problem(rng):
    columns, monitors, errors = 12, 9, 7
    plane = rng.integers(0, 2, columns)
    weight = rng.uniform(0.5, 2, (columns, monitors)) / 1e-4
    weight[3, 4] = 0  # a missing reading
    u, v = rng.standard_normal((2, columns, monitors))
    v[-1] = 0  # a column without a parameter of its own
    J = rng.standard_normal((errors, columns, monitors))
    residual = 0.1 * rng.standard_normal((columns, monitors))
    residual[3, 4] = np.nan
    return residual, weight, plane, u, v, [Slopes(J)]


def written_out(residual, weight, plane, u, v, ring):
    """The whole design matrix, [reading, parameter]."""
    (columns, monitors), J = residual.shape, ring[0].rows
    rows = []
    for c in range(columns):
        for m in range(monitors):
            row = np.zeros(2 * monitors + columns + len(J))
            row[2 * m + plane[c]] = u[c, m]
            row[2 * monitors + c] = v[c, m]
            row[2 * monitors + columns :] = J[:, c, m]
            rows.append(row)
    return np.array(rows)


def test_normal_equations_of_several_families_in_several_pieces(problem, rng, monkeypatch):
    """Two or five columns at once, the last piece shorter; slopes of one family are old ones."""
    residual, weight, plane, u, v, [whole] = problem
    J = whole.rows
    X, w = written_out(*problem), weight.ravel()
    now = rng.uniform(0.5, 2, residual.shape)
    ring = (Slopes(J[:3]), Slopes(J[3:3]), Slopes(J[3:] / now, now))
    for columns in (2, 5):
        monkeypatch.setattr(blocks, "AT_ONCE", columns * residual.shape[1])
        normal = normal_equations(residual, weight, plane, u, v, ring)
        assert_allclose(normal.matrix, X.T @ (w[:, None] * X), rtol=1e-12, atol=1e-7)
        right = X.T @ (w * np.nan_to_num(residual.ravel()))
        assert_allclose(normal.vector, right, rtol=1e-12, atol=1e-8)


def test_fit_vs_dense_least_squares_with_a_correlated_prior(problem, rng):
    """Members, each of its own rms, and their family: the covariance is D + t^2 of ones."""
    X = written_out(*problem)
    residual, weight, *_ = problem
    size = X.shape[1]
    start = 0.05 * rng.standard_normal(size)
    rms = np.concatenate([np.full(18, 0.3), np.full(12, 0.2), np.full(7, 0.1)])
    own = Group("own", np.eye(size), 1.0, each=rms)
    family = np.zeros((size, 1))
    family[-7:] = 1
    groups = [own, Group("family", family, 0.5)]
    found = solve(normal_equations(*problem), groups, start, rounds=0)
    prior = np.diag(rms**2) + 0.5**2 * family @ family.T
    matrix = X.T @ (weight.ravel()[:, None] * X) + np.linalg.inv(prior)
    right = X.T @ (weight.ravel() * (np.nan_to_num(residual.ravel()) + X @ start))
    assert_allclose(found.values, np.linalg.solve(matrix, right), atol=1e-9)
    assert_allclose(found.sigma, np.sqrt(np.diag(np.linalg.inv(matrix))), rtol=1e-6)


@pytest.mark.parametrize("freedom", [np.inf, 4.0])
def test_scale_of_the_prior_is_that_of_the_truth(rng, freedom):
    """200 errors of rms 0.003, one of them 50 times as large where the prior is heavy."""
    columns, monitors, errors = 40, 30, 200
    J = rng.standard_normal((errors, columns, monitors))
    truth = 3e-3 * rng.standard_normal(errors)
    rms, heavy = truth.std(), freedom < np.inf
    if heavy:
        truth[7] = 0.15
    noise = 1e-3
    residual = np.tensordot(truth, J, 1) + noise * rng.standard_normal((columns, monitors))
    flat, nothing = np.full((columns, monitors), noise**-2), np.zeros((columns, monitors))
    plane = np.zeros(columns, dtype=int)
    basis = np.zeros((2 * monitors + columns + errors, errors))
    basis[-errors:] = np.eye(errors)
    group = Group("ring", basis, 0.1, freedom=freedom)
    normal = normal_equations(residual, flat, plane, nothing, nothing, [Slopes(J)])
    found = solve(normal, [group], rounds=40)
    # Student's scale of normal numbers is some 0.75 of their rms
    assert_allclose(found.groups[0].rms, rms, rtol=0.35 if heavy else 0.1)
    pull = (found.values[-errors:] - truth) / found.sigma[-errors:]
    assert 0.8 < pull.std() < 1.2


def test_a_scale_that_one_number_teaches_does_not_say_that_it_is_zero():
    """The scale of correctors against that of monitors was held known for a small number."""
    alike = np.array([[1.0], [1.0]])  # only the sum of two numbers is read
    there = Normal(1e8 * alike @ alike.T, 1e8 * 0.02 * alike[:, 0])
    groups = [
        Group("gain", np.eye(2)[:, :1], 0.03, fixed=True),
        Group("calibration", np.eye(2)[:, 1:], 0.05),
    ]
    assert 0.015 < solve(there, groups, rounds=60).sigma[1] < 0.03


def test_a_scale_that_fell_is_found_again(rng):
    """40 numbers known no better than they are large: EM stood still at a hundredth of that."""
    truth = 0.01 * rng.standard_normal(40)
    there = Normal(1e4 * np.eye(40), 1e4 * truth + 1e2 * rng.standard_normal(40))
    found = [
        solve(there, [Group("ring", np.eye(40), rms, first=0.01)], rounds=12).groups[0].rms
        for rms in (1e-4, 0.01, 0.3)
    ]
    assert_allclose(found, 0.01, rtol=0.4)
    assert_allclose(found, found[1], rtol=0.15)


def test_gains_of_little_information_come_in(small_ring):
    """Gains of 10 %, gradients of 1 %: the gains' scale had fallen before the gradients came."""
    rng = np.random.default_rng(5)
    causes = gradients(small_ring, 0.01, rng)
    causes += [
        Cause(f"monitor_gain_{plane}", own.name, 0.1 * float(rng.standard_normal()))
        for own in small_ring.monitors
        for plane in "xy"
    ]
    measured = small_steps(small_ring, causes, noise=4e-6, seed=3)
    fit = hierarchical.fit_families(*parted(small_ring, measured, 1), STEPS[:3])
    assert {own.effect.split(",")[0] for own in fit.families if own.kept} == {
        "monitor_gain_x", "quadrupole_gradient"
    }  # fmt: skip
    first, last = fit.steps[0], fit.steps[-1]
    assert last.dispersion_rms < 0.7 * first.dispersion_rms
    assert last.heldout_chi2_per_dof < first.heldout_chi2_per_dof
    found = {(own.effect, own.element): own.amount for own, _ in fitted_causes(fit.state)[0]}
    gains = np.array([(found[own.effect, own.element], own.amount) for own in causes
                      if "gain" in own.effect])  # fmt: skip
    assert np.std(gains[:, 0] - gains[:, 1]) < 0.8 * np.std(gains[:, 1])


def test_a_reversed_decision_is_felt_in_its_own_plane(small_ring, rng):
    """Gradients act in plane, rolls of BPMs across; what the machine lacks changes nothing."""
    causes = gradients(small_ring, 6e-3, rng)
    causes += [Cause("monitor_roll", own.name, 0.02 * float(rng.standard_normal()))
               for own in small_ring.monitors]  # fmt: skip
    data, split = parted(small_ring, small_steps(small_ring, causes, seed=3))
    trials = [own for own in STEPS if own[0].name in ("quadrupole_gradient", "monitor_roll",
                                                      "corrector_position")]  # fmt: skip
    fit = hierarchical.reversed_decisions(hierarchical.fit_families(data, split, trials))
    last = fit.steps[-1]
    rows = {own.effect.split(",")[0]: own for own in fit.families}
    ratio = {
        name: (own.heldout_rms_in_plane / last.heldout_rms_in_plane,
               own.heldout_rms_coupling / last.heldout_rms_coupling)
        for name, own in rows.items()
    }  # fmt: skip
    assert rows["quadrupole_gradient"].kept
    assert rows["monitor_roll"].kept
    assert ratio["quadrupole_gradient"][0] > 5
    assert ratio["quadrupole_gradient"][1] < 2
    assert ratio["monitor_roll"][0] < 1.2
    assert ratio["monitor_roll"][1] > 5
    assert min(rows[name].log_evidence for name in ("quadrupole_gradient", "monitor_roll")) > 100
    idle = rows["corrector_position"]
    assert not idle.kept
    assert idle.log_evidence < rounds.REQUIRED
    assert ratio["corrector_position"] == pytest.approx((1, 1), abs=0.1)


def test_a_step_in_one_plane_that_spoils_the_other_does_not_end_the_fit(small_ring):
    """Skew gradients of 0.015 1/m rms change in-plane readings, too: both reach their noise."""
    rng = np.random.default_rng(2)
    causes = gradients(small_ring, 5e-3, rng)
    causes += [
        Cause("skew_gradient", own.name, 0.015 * float(rng.standard_normal()))
        for own in small_ring.elements
        if own.kind == "quadrupole"
    ]
    data, split = parted(small_ring, small_steps(small_ring, causes, seed=3, engine="at"))
    names = ("corrector_calibration", "monitor_gain", "quadrupole_gradient", "monitor_roll",
             "corrector_roll", "skew_gradient")  # fmt: skip
    fit = hierarchical.fit_families(data, split, [own for own in STEPS if own[0].name in names])
    assert {block.name: block.ratio for block in fit.blocks if block.ratio > 1.15} == {}
    found = {(own.effect, own.element): (own.amount, error)
             for own, error in fitted_causes(fit.state)[0]}  # fmt: skip
    for own in causes:  # of the right sign, at the right magnet
        amount, error = found[own.effect, own.element]
        assert abs(amount - own.amount) < 4 * error
        assert error < 2e-3


def test_numbers_that_have_a_lowest_value_vs_bounded_least_squares(rng):
    """Two that pull against one another: to hold the one that went too low is not enough."""
    size = 8
    jacobian = rng.standard_normal((30, size)) + 3 * rng.standard_normal((30, 1))
    data = jacobian @ np.where(np.arange(size) % 2, 0.5, -0.5) + 0.1 * rng.standard_normal(30)
    lowest = np.where(np.arange(size) < 5, 0.0, -np.inf)
    start, none = np.zeros(size), np.zeros((0, 0))
    normal = Normal(jacobian.T @ jacobian, jacobian.T @ data)
    group = Group("all", np.eye(size), 1.0, fixed=True)
    there = Linear(normal, start, np.full(size, 1e9), none, none, none, {}, (group,), lowest)
    found = rounds.bounded_step(there, 1.0).values
    referee = lsq_linear(
        np.vstack([jacobian, np.eye(size)]), np.append(data, np.zeros(size)), (lowest, np.inf),
        method="bvls",
    ).x  # fmt: skip
    held = referee <= lowest
    assert 0 < held.sum() < 5
    assert_allclose(found[held], 0.0, atol=1e-12)
    assert_allclose(found, referee, atol=1e-6)


def test_a_device_focuses_and_a_change_of_one_may_do_less(small_ring):
    """PETRA III: -0.010 1/m in a straight without a device, and a quadrupole beside it +7 %."""
    amounts = []
    for true, family in (
        (-0.01, VerticalFocusing()), (-0.01, FocusingChange()), (0.01, VerticalFocusing())
    ):  # fmt: skip
        measured = simulate_response(
            small_ring, [Cause("vertical_focusing", "d::95", true)], kick=1e-5, noise=2e-8,
            engine="ocelot", progress=False,
        ).measured  # fmt: skip
        data, split = parted(small_ring, measured, 1)
        design = begin(data, split)
        state = rough_fit(design, [STEPS[0], (family,)])
        amounts.append(state.values["device"][family.places(data).index("d::95")])
    assert amounts == pytest.approx([0.0, -0.01, 0.01], rel=0.02, abs=0.0)
