"""`tune-fit`: its default change, launches that are not known, and what it advises."""

import numpy as np
import pytest

from tmlattice import Cause, TaylorNetwork, simulate, tune_fit
from tmlattice.errors import ChoiceError, TmlatticeError, UnstableRingError
from tmlattice.fitting import tune_fit_measurement
from tmlattice.fitting.experiment import changed_ring, perturbed_ring
from tmlattice.fitting.launches import FreeLaunches
from tmlattice.maps import ring_matrix
from tmlattice.optics import matrix_tunes

QUICK = {"progress": False, "epochs": 20}


def test_the_default_change_leaves_the_ring_stable(small_ring):
    """At each step down the ring is unstable until it is taken."""
    stiff = small_ring
    for name in ("QD::5", "QD::6"):  # two together leave less room
        stiff = perturbed_ring(stiff, name, -0.25)
    _, tunes, change = changed_ring(stiff, "QD::7", None)
    assert (tunes > 0).all()
    steps = (-0.2, -0.1, -0.05, -0.02, -0.01, -0.005, -0.002)
    unstable = []
    for amount in steps:
        try:
            matrix_tunes(ring_matrix(perturbed_ring(stiff, "QD::7", amount)))
            unstable.append(False)
        except UnstableRingError:
            unstable.append(True)
    assert any(unstable)
    assert change == steps[unstable.index(False)]


def test_an_unstable_change_names_the_options_that_fix_it(small_ring):
    with pytest.raises(UnstableRingError, match=r"'QD::5' changed by -300 %.*--change.*--magnet"):
        tune_fit(small_ring, "QD::5", -3.0, **QUICK)


def test_a_method_that_is_not_there_is_answered_with_those_that_are(small_ring):
    with pytest.raises(ChoiceError, match="no method 'magic'; there are adam, sparse, map"):
        tune_fit(small_ring, methods=["magic"], **QUICK)
    with pytest.raises(TmlatticeError, match="no method is named"):
        tune_fit(small_ring, methods=[], **QUICK)


def test_free_launches_find_those_that_made_the_readings(small_network, rng):
    """Off by 1e-4 m and rad; where one coordinate is exact it stays."""
    launches = 1e-4 * rng.standard_normal((2, 4))
    readings = small_network(launches).detach().numpy()
    readings[0, 3] = np.nan
    noise = np.full((len(small_network.monitors), 2), 1e-6)
    unknown = FreeLaunches(np.zeros((2, 4)), np.full((2, 4), np.inf), readings, noise)
    np.testing.assert_allclose(unknown.fitted(small_network), launches, atol=1e-12)
    sigma = np.array([[0.0, np.inf, np.inf, np.inf]] * 2)
    nominal = np.where(sigma > 0, 0.0, launches)
    known = FreeLaunches(nominal, sigma, readings, noise).fitted(small_network)
    np.testing.assert_allclose(known, launches, atol=1e-12)


def test_what_is_known_of_a_launch_weighs_as_much_as_its_readings(small_network):
    """One reading of noise s and a launch of rms s L / (d reading / d x): the middle of the two."""
    at = np.zeros((1, 4))
    slope = small_network([[1e-6, 0, 0, 0]]).detach().numpy()[0, -1, 0] * 1e6
    readings = np.full((1, len(small_network.monitors), 2), np.nan)
    readings[0, -1, 0] = small_network(at).detach().numpy()[0, -1, 0] + 1e-6 * slope
    noise = np.full(readings.shape[1:], 1e-6)
    sigma = np.array([[1e-6 / abs(slope), 0.0, 0.0, 0.0]])
    fitted = FreeLaunches(at, sigma, readings, noise).fitted(small_network)
    np.testing.assert_allclose(fitted[0], [5e-7, 0, 0, 0], rtol=1e-3, atol=1e-15)


@pytest.fixture(scope="module")
def weak(small_ring):
    """Six shots whose launches are off by far more than the noise, and stated with that error."""
    return simulate(
        small_ring, [Cause("quadrupole_gradient", "QD::5", -0.03)], shots=4, amplitude=3e-4,
        noise=1e-6, launch_sigma=(3e-5, 1e-5, 3e-5, 1e-5, 0), engine="ocelot", seed=5,
    ).measurement()  # fmt: skip


def test_every_method_fits_launches_that_are_off(small_ring, weak):
    nominal = TaylorNetwork.from_ring(perturbed_ring(small_ring, "QD::5", -0.03))
    held = weak.readings[:, 0] - nominal(weak.states(4)).detach().numpy()
    assert np.sqrt(np.mean(held**2)) > 10e-6  # what nominal launches leave of the true ring
    outcome = tune_fit_measurement(small_ring, weak, progress=False, epochs=600)
    true = matrix_tunes(ring_matrix(perturbed_ring(small_ring, "QD::5", -0.03)))
    sparse, most = outcome.method("sparse"), outcome.method("map")
    assert set(sparse.named) == {"QD::5"}
    for method in (sparse, most):
        assert method.explains
        assert method.rms < 1.1e-6
        assert (np.abs(method.tunes - true) < 4 * method.tune_sigma).all()
    assert outcome.method("adam").rms < 0.2 * np.sqrt(np.mean(held**2))
    assert outcome.rms_before > 2e-6  # the design, with its own launches
    assert outcome.best is outcome.trusted is sparse


def test_a_residual_above_the_noise_is_reported(small_ring):
    """A tilted quadrupole is no change of strength: no method explains it."""
    tilted = simulate(
        small_ring, [Cause("quadrupole_roll", "QD::5", 0.05)], shots=3, amplitude=3e-4,
        noise=1e-6, engine="ocelot", seed=2,
    ).measurement()  # fmt: skip
    outcome = tune_fit_measurement(small_ring, tilted, methods=["sparse"], progress=False)
    assert outcome.trusted is None
    assert outcome.as_json()["trusted"] is None
    assert "Trust none" in outcome.advice
    assert "more than the noise of 1 µm" in outcome.advice
    assert "tmlattice diagnose" in outcome.advice


def test_one_method_alone_takes_its_own_options(small_ring):
    """`told` knows which magnets may have changed, which no other method asks for."""
    outcome = tune_fit(
        small_ring, "QD::5", -0.03, launch=(1e-4, 0, 1e-4, 0), noise=1e-6, methods=["known"],
        candidates=["QD::5", "QD::6"], progress=False,
    )  # fmt: skip
    assert [m.method for m in outcome.methods] == ["known"]
    assert set(outcome.best.named) == {"QD::5"}
    assert outcome.fit.options["candidates"] == ["QD::5", "QD::6"]
    assert outcome.advice.startswith("Trust known")
