"""`map` and `sparse`: against faults that are known, dense algebra, and their own stated errors."""

import warnings
from dataclasses import replace

import numpy as np
import pytest

from tmlattice import Cause, Measurement, TaylorNetwork, fine_tune, one_turn_optics
from tmlattice.effects import apply
from tmlattice.errors import MeasurementError, TmlatticeError
from tmlattice.fitting.experiment import perturbed_ring
from tmlattice.fitting.study import run_case
from tmlattice.maps import ring_matrix
from tmlattice.optics import matrix_tunes

LAUNCH = np.array([[1e-4, 0, 1e-4, 0], [-1e-4, 1e-5, 5e-5, 0]])


def measured(ring, names, change, launches=LAUNCH, noise=1e-6, seed=0):
    machine = ring
    for name in names:
        machine = perturbed_ring(machine, name, change)
    network = TaylorNetwork.from_ring(machine)
    readings = network(launches).detach().numpy()
    readings = readings + noise * np.random.default_rng(seed).standard_normal(readings.shape)
    stated = (noise, noise) if noise else None
    exact = np.zeros_like(launches)
    return machine, Measurement(launches, readings[:, None], network.monitors, stated, exact)


# --- sparse ---


def test_sparse_names_the_magnet_and_its_change(small_ring, small_network):
    machine, measurement = measured(small_ring, ["QD::5"], -0.05)
    fit = fine_tune(small_network, measurement, method="sparse")
    assert set(fit.changes) == {"QD::5"}
    amount, error = fit.changes["QD::5"]
    assert abs(amount + 0.05) < 4 * error < 0.02
    true = matrix_tunes(ring_matrix(machine))
    assert (np.abs(fit.tunes - true) < 4 * fit.tune_sigma).all()
    np.testing.assert_allclose(fit.tunes, one_turn_optics(fit.network).tunes, atol=1e-9)


def test_sparse_finds_two_causes_and_none(small_ring, small_network):
    _, measurement = measured(small_ring, ["QD::3", "QF::11"], -0.03)
    fit = fine_tune(small_network, measurement, method="sparse")
    assert set(fit.changes) == {"QD::3", "QF::11"}
    _, quiet = measured(small_ring, [], 0)
    fit = fine_tune(small_network, quiet, method="sparse")
    assert fit.changes == {}
    assert fit.tune_sigma is None  # what cannot be seen has no known effect


@pytest.mark.parametrize("method", ["adam", "map", "sparse"])
def test_launches_are_as_exact_as_the_measurement_states(small_ring, small_network, method):
    """What is wrong with a launch beyond its error is reported, not fitted by magnets."""
    off = LAUNCH + np.array([5e-5, 1e-5, -5e-5, 1e-5])
    machine, shifted = measured(small_ring, ["QD::5"], -0.05, launches=off)
    options = {"method": method, "progress": False} | ({"epochs": 5} if method == "adam" else {})
    sigma = np.tile([5e-5, 1e-5], (2, 2))
    honest = Measurement(LAUNCH, shifted.readings, shifted.monitors, shifted.noise, sigma)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        fit = fine_tune(small_network, honest, **options)
    if method != "adam":
        true = matrix_tunes(ring_matrix(machine))
        assert (np.abs(fit.tunes - true) < 4 * fit.tune_sigma).all()
        np.testing.assert_allclose(fit.launches, off, atol=2e-6)
    with pytest.warns(UserWarning, match="the launches are not those stated.*give launch_sigma"):
        fine_tune(small_network, replace(honest, launch_sigma=0.1 * sigma), **options)


def test_sparse_states_how_far_explanations_are_apart(small_ring, small_network):
    """One reading: one of two magnets, at even odds, explains it; their tunes differ."""
    _, whole = measured(small_ring, ["QD::5"], -0.02, LAUNCH[:1], noise=2e-8)
    readings = np.full_like(whole.readings, np.nan)
    readings[0, 0, -4, 0] = whole.readings[0, 0, -4, 0]
    exact = np.zeros_like(LAUNCH[:1])
    one = Measurement(LAUNCH[:1], readings, whole.monitors, whole.noise, exact)
    options = {"method": "sparse", "kinds": ("quadrupole",), "largest_number": 1}
    first, second, both = (
        fine_tune(small_network, one, candidates=names, **options)
        for names in (["QD::5"], ["QD::4"], ["QD::5", "QD::4"])
    )
    assert (set(first.changes), set(second.changes)) == ({"QD::5"}, {"QD::4"})
    apart = np.abs(first.tunes - second.tunes)
    assert (first.tune_sigma < 0.03 * apart).all()
    assert (second.tune_sigma < 0.03 * apart).all()
    # about the likelier one: the root of a half, as nearly as the odds are even
    np.testing.assert_allclose(both.tune_sigma, apart / np.sqrt(2), rtol=0.05)


def test_sparse_reports_what_it_needs(small_ring, small_network):
    _, measurement = measured(small_ring, ["QD::5"], -0.05)
    bare = TaylorNetwork(small_network.maps)
    with pytest.raises(TmlatticeError, match="ring="):
        fine_tune(bare, measurement, method="sparse")
    assert fine_tune(bare, measurement, method="sparse", ring=small_ring).changes
    silent = Measurement(LAUNCH, measurement.readings, measurement.monitors)
    with pytest.raises(MeasurementError, match="noise"):
        fine_tune(small_network, silent, method="sparse")
    with pytest.raises(ValueError, match="candidates="):
        fine_tune(small_network, measurement, method="known")
    told = fine_tune(small_network, measurement, method="known", candidates=["QD::5"])
    assert set(told.changes) == {"QD::5"}
    with pytest.raises(ValueError, match="magic"):
        fine_tune(small_network, measurement, method="magic")


def test_told_states_the_cramer_rao_bound(small_ring, small_network):
    """What the readings hold of one known magnet, by differences of whole rings."""
    case = run_case(
        small_ring, "QD::5", "known", change=-0.02, noise=1e-6, launch=(1e-4, 0.0, 1e-4, 0.0)
    )
    step, ends = 1e-4, []
    for sign in (1, -1):
        ring = perturbed_ring(small_ring, "QD::5", -0.02 + sign * step)
        readings = TaylorNetwork.from_ring(ring)([[1e-4, 0.0, 1e-4, 0.0]]).detach().numpy()
        ends.append((readings, matrix_tunes(ring_matrix(ring))))
    slope = np.linalg.norm(ends[0][0] - ends[1][0])
    bound = np.abs(ends[0][1] - ends[1][1]) * 1e-6 / slope
    np.testing.assert_allclose(case.tune_sigma, bound, rtol=0.02)  # it is taken at the fit


# --- map ---


def test_map_is_ridge_regression_where_all_is_linear(small_ring, small_network):
    """Against slopes by differences of whole rings, and normal equations."""
    _, measurement = measured(small_ring, ["QD::5"], -0.002)
    names = [e.name for e in small_ring.magnets if e.kind == "quadrupole" and e.k1]
    slopes = [
        np.ravel([perturbed(small_ring, name, side)(LAUNCH).detach().numpy() for side in (1, -1)])
        for name in names
    ]
    J = np.array([row[: len(row) // 2] - row[len(row) // 2 :] for row in slopes]).T / 2e-3 / 1e-6
    left = (measurement.readings[:, 0] - small_network(LAUNCH).detach().numpy()).ravel() / 1e-6
    options = {"method": "map", "prior": "strengths", "scale": 0.1, "kinds": ("quadrupole",)}
    fit = fine_tune(small_network, measurement, **options)
    inverse = np.linalg.inv(J.T @ J + np.eye(len(names)) / 1e-3**2)
    found = np.array([fit.changes[name] for name in names])
    np.testing.assert_allclose(found[:, 0], inverse @ J.T @ left, atol=1e-6)
    np.testing.assert_allclose(found[:, 1], np.sqrt(np.diag(inverse)), rtol=5e-3)


def perturbed(ring, name, side):
    return TaylorNetwork.from_ring(perturbed_ring(ring, name, 1e-3 * side))


@pytest.mark.parametrize("prior", ["faults", "strengths"])
def test_map_fits_and_stays_symplectic(small_ring, small_network, prior):
    machine, measurement = measured(small_ring, ["QD::5"], -0.02, noise=1e-7)
    fit = fine_tune(small_network, measurement, method="map", prior=prior)
    left = fit.network(LAUNCH).detach().numpy() - measurement.readings[:, 0]
    before = small_network(LAUNCH).detach().numpy() - measurement.readings[:, 0]
    assert np.sqrt(np.mean(left**2)) < 1.5e-7 < 0.2 * np.sqrt(np.mean(before**2))
    assert one_turn_optics(fit.network).growth == pytest.approx(1.0, abs=1e-9)
    away = fit.tunes - matrix_tunes(ring_matrix(machine))
    assert (np.abs(away) < 4 * fit.tune_sigma).all()


def test_map_with_tails_gives_one_magnet_the_fault(small_ring, small_network):
    """A Gaussian prior shares a fault among neighbours; tails leave it where it is."""
    machine, measurement = measured(small_ring, ["QD::5"], -0.1)
    true = matrix_tunes(ring_matrix(machine))
    away = {}
    for prior in ("faults", "strengths"):
        fit = fine_tune(small_network, measurement, method="map", prior=prior)
        away[prior] = np.abs(fit.tunes - true).max()
        if prior == "faults":
            assert abs(fit.changes["QD::5"][0] + 0.1) < 0.01
            assert sum(abs(amount) > 0.01 for amount, _ in fit.changes.values()) == 1
    assert away["faults"] < 0.3 * away["strengths"]


@pytest.mark.slow
def test_map_states_its_error_where_its_prior_is_true(small_ring, small_network):
    """Faults drawn from the prior itself: the pulls have the width 1."""
    rng = np.random.default_rng(3)
    names = [e.name for e in small_ring.magnets if e.kind == "quadrupole" and e.k1]
    pulls = []
    for _ in range(7):
        drawn = [Cause("quadrupole_gradient", n, 2e-3 * rng.standard_normal()) for n in names]
        network = TaylorNetwork.from_ring(apply(small_ring, drawn))
        readings = network(LAUNCH).detach().numpy()
        readings = readings + 1e-6 * rng.standard_normal(readings.shape)
        exact = np.zeros_like(LAUNCH)
        measurement = Measurement(LAUNCH, readings[:, None], network.monitors, (1e-6, 1e-6), exact)
        wanted = {"prior": "strengths", "kinds": ("quadrupole",), "scale": 0.2}  # of 1 %
        fit = fine_tune(small_network, measurement, method="map", **wanted)
        pulls.append((fit.tunes - one_turn_optics(network).tunes) / fit.tune_sigma)
    width = np.sqrt(np.mean(np.square(pulls)))
    assert 0.6 < width < 1.5  # 14 pulls, not all independent: 1 +- 0.25


def test_adam_on_a_symplectic_network_moves_generators(small_ring, small_network):
    _, measurement = measured(small_ring, ["QD::5"], -0.02, noise=1e-7)
    network = small_network.symplectic()
    fit = fine_tune(network, measurement, epochs=60, learning_rate=1e-8, progress=False)
    assert min(fit.loss) < 0.5 * fit.loss[0]
    assert one_turn_optics(fit.network).growth == pytest.approx(1.0, abs=1e-9)
    assert network.correction().any() == np.False_
