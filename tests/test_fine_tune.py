"""Fine-tuning: it learns what it is shown, leaves the rest alone, and repeats itself."""

import numpy as np
import pytest
import torch

from tmlattice import Measurement, TaylorNetwork, fine_tune
from tmlattice.errors import BeamLostError, TmlatticeError
from tmlattice.fitting import tune_fit
from tmlattice.fitting.experiment import perturbed_ring
from tmlattice.network import symplectic_penalty

LAUNCH = np.array([[1e-4, 0, 1e-4, 0], [-1e-4, 1e-5, 5e-5, 0]])
EXACT = np.zeros_like(LAUNCH)


@pytest.fixture(scope="module")
def weakened(small_ring):
    network = TaylorNetwork.from_ring(perturbed_ring(small_ring, "QD::5", -0.02))
    readings = network(LAUNCH).detach().numpy()
    return Measurement(LAUNCH, readings[:, None], network.monitors, launch_sigma=EXACT)


def fit(network, measurement, **options):
    return fine_tune(
        network, measurement, progress=False, **{"epochs": 150, "learning_rate": 1e-4, **options}
    )


def rms(network, measurement):
    left = (
        network(measurement.states(network.dimension)).detach().numpy() - measurement.readings[:, 0]
    )
    return np.sqrt(np.nanmean(left**2))


def test_residual_shrinks_and_the_given_network_stays(small_network, weakened):
    before = [p.detach().clone() for p in small_network.parameters()]
    result = fit(small_network, weakened)
    assert rms(result.network, weakened) < 0.1 * rms(small_network, weakened)
    for old, now in zip(before, small_network.parameters(), strict=True):
        assert torch.equal(old, now)
        assert now.grad is None


def test_loss_is_the_sum_of_squares_over_monitors_per_shot(small_network, weakened):
    result = fit(small_network, weakened, epochs=1)
    left = small_network(LAUNCH).detach().numpy() - weakened.readings[:, 0]
    np.testing.assert_allclose(result.loss[0], (left**2).sum() / 2, rtol=1e-12)
    expected = symplectic_penalty(small_network.W1, small_network.W2).sum().item()
    np.testing.assert_allclose(result.penalty[0], expected, rtol=1e-12)


def test_weights_kept_are_those_of_least_loss(small_network, weakened):
    result = fit(small_network, weakened, learning_rate=3e-3)  # it overshoots and oscillates
    assert result.best_epoch == int(np.argmin(result.loss))
    best = rms(result.network, weakened) ** 2 * weakened.readings[0].size
    np.testing.assert_allclose(best, min(result.loss), rtol=1e-9)


def test_early_stop_ends_a_fit_that_has_settled(small_network):
    settled = Measurement(
        LAUNCH, small_network(LAUNCH).detach().numpy()[:, None], small_network.monitors,
        launch_sigma=EXACT,
    )  # fmt: skip
    result = fit(small_network, settled, epochs=500, patience=20)
    assert result.stopped_early
    assert len(result.loss) <= 40
    assert not fit(small_network, settled, epochs=50, patience=None).stopped_early


def test_missing_readings_are_ignored(small_network, weakened):
    readings = weakened.readings.copy()
    readings[0, 0, 3:9, 0] = np.nan
    readings[1, 0, 20] = np.nan
    holes = Measurement(LAUNCH, readings, weakened.monitors, launch_sigma=EXACT)
    left = small_network(LAUNCH).detach().numpy() - readings[:, 0]
    result = fit(small_network, holes)
    np.testing.assert_allclose(result.loss[0], np.nansum(left**2) / 2, rtol=1e-12)
    assert all(torch.isfinite(p).all() for p in result.network.parameters())
    assert rms(result.network, holes) < 0.1 * rms(small_network, holes)


def test_monitors_are_matched_by_name_not_by_place(small_network, weakened):
    order = np.random.default_rng(1).permutation(len(weakened.monitors))
    shuffled = Measurement(
        LAUNCH, weakened.readings[:, :, order], tuple(weakened.monitors[i].upper() for i in order),
        launch_sigma=EXACT,
    )  # fmt: skip
    assert (
        fit(small_network, shuffled, epochs=5).loss == fit(small_network, weakened, epochs=5).loss
    )


def test_strong_symplectic_penalty_keeps_layers_symplectic(small_network, weakened):
    free = fit(small_network, weakened, regularization="none")
    held = fit(small_network, weakened, regularization_rate=1.0)

    def departure(network):
        W1 = network.W1.detach()
        return symplectic_penalty(W1, torch.zeros_like(network.W2)).sum().item()

    assert departure(held.network) < 0.1 * departure(free.network)
    assert free.penalty == [0.0] * len(free.penalty)


@pytest.mark.parametrize("kind", ["l1", "l2"])
def test_norm_penalties_pull_towards_the_design(small_network, weakened, kind):
    def moved(result):
        pairs = zip(result.network.parameters(), small_network.parameters(), strict=True)
        return sum((a - b).abs().sum().item() for a, b in pairs)

    weak = fit(small_network, weakened, regularization=kind, regularization_rate=1e-12)
    strong = fit(small_network, weakened, regularization=kind, regularization_rate=1e3)
    assert moved(strong) < 0.5 * moved(weak)
    assert weak.penalty[0] == 0.0
    assert weak.penalty[-1] > 0.0


def test_penalty_relative_to_the_design_starts_at_zero(small_network, weakened):
    result = fit(small_network, weakened, relative_to_design=True, epochs=5)
    assert result.penalty[0] == pytest.approx(0.0, abs=1e-25)
    assert result.penalty[-1] > 0


def test_diverging_fit_reports_what_to_change(small_network, weakened):
    with pytest.raises(BeamLostError, match=r"diverged in epoch .*lower the learning rate"):
        fit(small_network, weakened, learning_rate=10.0)


def test_a_penalty_that_is_not_there_is_refused(small_network, weakened):
    with pytest.raises(ValueError, match="l3"):
        fit(small_network, weakened, regularization="l3")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"noise": float("nan")}, "zero or more"),
        ({"turns": 3}, "too few"),
    ],
)
def test_experiment_refuses_what_it_cannot_do(small_ring, arguments, message):
    """The command states other such arguments: `test_cli`."""
    with pytest.raises(TmlatticeError, match=message):
        tune_fit(small_ring, progress=False, epochs=3, **arguments)


def test_experiment_is_repeated_by_its_seed(small_ring):
    options = {"progress": False, "epochs": 20, "launch": (1e-4, 0, 1e-4, 0), "change": -0.02}
    one, same, other = (tune_fit(small_ring, seed=s, **options) for s in (1, 1, 2))
    assert one.fit.loss == same.fit.loss
    np.testing.assert_array_equal(one.network_tunes, same.network_tunes)
    assert one.fit.loss != other.fit.loss
    assert 1e-5 < (one.measured - other.measured).std() < 4e-5  # two draws of 20 micrometres


def test_experiment_perturbs_the_magnet_that_it_names(small_ring):
    """A weak defocusing quadrupole: the orbit differs behind it alone, and Qy falls."""
    options = {"progress": False, "epochs": 2, "noise": 0.0, "launch": (1e-4, 0, 1e-4, 0)}
    found = tune_fit(small_ring, "QD::6", -0.02, **options)
    behind = found.s > small_ring["QD::6"].s
    gap = np.abs(found.measured - found.before)
    assert gap[~behind].max() == 0.0
    assert (gap[behind][:4].max(axis=0) > 1e-8).all()  # in both planes
    # dQ = -+ beta dk L / (4 pi): less defocusing raises Qx and lowers Qy
    shift = found.true_tunes - found.design_tunes
    assert shift[0] > 0 > shift[1]
