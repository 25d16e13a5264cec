"""The compiled sweeps against a plain torch loop, and against finite differences."""

import numba
import numpy as np
import pytest
import torch

from tmlattice import TaylorNetwork
from tmlattice.errors import BeamLostError
from tmlattice.network import plain_readings


def dense(network, rng, size=1e-3):
    """A copy whose weights are all different from zero, as after fine-tuning."""
    copy = network.copy()
    with torch.no_grad():
        for weight in copy.parameters():
            weight.add_(size * torch.from_numpy(rng.standard_normal(tuple(weight.shape))))
    return copy


def assert_as_plain(network, launch, rng):
    """Readings, and gradients of a random sum of them, are those of the plain loop."""
    launch.requires_grad_()
    mine, plain = network(launch), plain_readings(network, launch)
    assert (mine - plain).abs().max() <= 1e-13 * plain.abs().max()
    pull = torch.from_numpy(rng.standard_normal(tuple(mine.shape)))
    wanted = [launch, *network.parameters()]
    got, expected = (torch.autograd.grad((x * pull).sum(), wanted) for x in (mine, plain))
    for one, other in zip(got, expected, strict=True):
        assert (one - other).abs().max() <= 1e-10 * other.abs().max()


@pytest.mark.parametrize("batch", [1, 2, 16, 17, 70, 130])  # every width of block, full and not
@pytest.mark.parametrize("dimension", [4, 6])
def test_values_and_gradients_match_the_plain_loop(short_ring, batch, dimension, rng):
    network = dense(TaylorNetwork.from_ring(short_ring, dimension), rng)
    assert_as_plain(network, torch.from_numpy(1e-4 * rng.standard_normal((batch, dimension))), rng)


def test_values_and_gradients_match_on_the_whole_ring(petra3_network, rng):
    launch = torch.from_numpy(1e-3 * rng.standard_normal((2, 4)) * [1, 0.05, 1, 0.05])
    assert_as_plain(petra3_network, launch, rng)


def test_a_layer_that_bends_only_slightly_is_not_skipped(small_network, rng):
    network = small_network.copy()
    with torch.no_grad():
        network.W2[40, 1, 0] += 5.0
    launch = torch.from_numpy(1e-3 * rng.standard_normal((1, 4)))
    plain = plain_readings(network, launch)
    assert (network(launch) - plain).abs().max() <= 1e-13 * plain.abs().max()
    assert (network(launch) - small_network(launch)).abs().max() > 1e-8


def test_tracking_repeats_the_one_turn_chain(small_network, rng):
    launch = 1e-4 * rng.standard_normal((40, 4)) * [1, 0.1, 1, 0.1]
    turns = small_network.track(launch, 3)
    assert turns.shape == (40, 4, 4)
    np.testing.assert_array_equal(turns[:, 0], launch)
    closing = small_network.maps.closing
    state = launch
    for turn in range(1, 4):
        state = closing(small_network.states(state)[:, -1])
        np.testing.assert_allclose(turns[:, turn], state, rtol=1e-12, atol=1e-18)


def test_jacobian_of_a_turn_matches_differences(small_network):
    x = np.array([2e-4, 1e-5, -1e-4, 2e-5])
    _, jacobian = small_network.one_turn_map(x)
    h = 1e-7
    shifted = small_network.track(np.concatenate([x + h * np.eye(4), x - h * np.eye(4)]), 1)[:, 1]
    np.testing.assert_allclose(
        jacobian, (shifted[:4] - shifted[4:]).T / (2 * h), rtol=1e-6, atol=1e-6
    )


def test_lost_beam_is_named_by_its_layer(small_network):
    network = small_network.copy()
    with torch.no_grad():
        network.W1[17] *= 1e9
    with pytest.raises(BeamLostError, match=rf"layer 17 \('{network.layers[17]}'\)"):
        network([[1e-4, 0, 0, 0]])
    with pytest.raises(BeamLostError, match=r"trajectory 1 .*turn 1.*layer 17"):
        network.track([[0, 0, 0, 0], [1e-4, 0, 0, 0]], 5)
    with pytest.raises(BeamLostError, match="at the launch"):
        small_network([[np.nan, 0, 0, 0]])


@pytest.mark.parametrize("launch", [[0, 0, 0, 0], [[0, 0, 0]], np.zeros((2, 6))])
def test_launch_of_another_shape_is_refused(small_network, launch):
    with pytest.raises(ValueError, match="should be"):
        small_network(launch)


def test_result_does_not_depend_on_the_number_of_threads(small_network, monkeypatch, rng):
    launch = torch.from_numpy(1e-4 * rng.standard_normal((300, 4)))
    results = []
    for number in (1, 2, 3):
        monkeypatch.setattr(numba.config, "NUMBA_NUM_THREADS", number)
        network = small_network.copy()
        readings = network(launch)
        readings.square().sum().backward()
        results.append([readings.detach(), *(p.grad for p in network.parameters())])
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))
