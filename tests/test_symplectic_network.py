"""Symplectic layers: against S, finite differences, the second-order layers, and AT."""

import numpy as np
import pytest
import torch
from at_ring import at_lattice

from tmlattice import TaylorNetwork, one_turn_optics
from tmlattice.errors import BeamLostError
from tmlattice.maps.taylor import symplectic_form
from tmlattice.network.generators import exponents


def disturbed(network, rng, size=1e-2):
    """Random generators of all degrees in every layer, and random kicks."""
    copy = network.copy()
    with torch.no_grad():
        drawn = size * rng.standard_normal(tuple(copy.generator.shape))
        degree = np.array([sum(row) for row in exponents(copy.dimension)])
        drawn[:, degree == 1] *= 1e-4  # kicks move the beam: the others act on where it is
        copy.generator += torch.from_numpy(drawn)
        copy.W0 += 1e-6 * torch.from_numpy(rng.standard_normal(tuple(copy.W0.shape)))
    return copy


@pytest.mark.parametrize("dimension", [4, 6])
def test_jacobian_is_symplectic_whatever_the_parameters(small_ring, dimension, rng):
    design = TaylorNetwork.from_ring(small_ring, dimension).symplectic()
    network = disturbed(design, rng)
    x = 1e-4 * rng.standard_normal(dimension)
    S = symplectic_form(dimension)
    _, steps = network.jacobians(x)
    defect = np.abs(steps.swapaxes(1, 2) @ S @ steps - S).max()
    assert defect < 2e-13 * np.abs(steps).max() ** 2  # rounding of 6 x 6 products
    assert np.abs(network.generator.detach().numpy()).min() > 0
    # The same Jacobian by differences of the compiled sweep itself, one layer after another.
    h = 1e-6
    shifted = np.concatenate([x + h * np.eye(dimension), x - h * np.eye(dimension)])
    first = network.states(shifted)[:, 1]
    differences = (first[:dimension] - first[dimension:]).T / (2 * h)
    np.testing.assert_allclose(differences, steps[0], rtol=1e-8, atol=1e-8)


def test_agrees_with_the_second_order_layers_to_second_order(petra3_network):
    """Half the amplitude, an eighth of the difference: it is of third order."""
    network = petra3_network.symplectic()
    launch = np.array([[1e-3, 2e-5, 8e-4, -3e-5]])
    difference = []
    for size in (1.0, 0.5):
        mine, theirs = (n.states(size * launch)[0] for n in (network, petra3_network))
        difference.append(np.sqrt(np.mean((mine - theirs) ** 2)))
    assert 7.0 < difference[0] / difference[1] < 9.0
    assert difference[0] < 1e-6


def test_first_turn_vs_at(petra3, petra3_network):
    """Thick AT elements; 3 mm, where OCELOT's own second order is good to 0.3 micrometres."""
    launch = np.array([3e-3, 0, 3e-3, 0])
    mine = petra3_network.symplectic().track(launch[None], 1)[0, 1]
    six = np.zeros((6, 1), order="F")
    six[:4, 0] = launch
    theirs = at_lattice(petra3).track(six)[0].reshape(6)[:4]
    assert np.abs(mine - theirs)[[0, 2]].max() < 2e-5
    assert np.abs(mine - theirs)[[1, 3]].max() < 2e-6


def test_tunes_are_those_of_the_design(petra3_network):
    mine, theirs = (one_turn_optics(n) for n in (petra3_network.symplectic(), petra3_network))
    np.testing.assert_allclose(mine.tunes, theirs.tunes, atol=1e-11)


def drift(network, turns):
    """Change of the mean action from the first tenth of the turns to the last, relative, (x, y)."""
    launch = np.array([[3e-3, 0, 0, 0], [0, 0, 3e-3, 0]])
    states = network.track(launch, turns)
    tenth = turns // 10
    changes = []
    for plane in range(2):
        action = np.abs(one_turn_optics(network).normalised(states[plane])[:, plane]) ** 2
        changes.append(abs(action[-tenth:].mean() / action[1 : tenth + 1].mean() - 1))
    return np.array(changes)


@pytest.mark.slow
def test_action_does_not_drift_in_5000_turns(petra3_network):
    assert drift(petra3_network.symplectic(), 5000).max() < 5e-5
    assert drift(petra3_network, 5000).max() > 1e-3


def test_gradients_match_finite_differences(short_ring, rng):
    network = disturbed(TaylorNetwork.from_ring(short_ring).symplectic(), rng)
    launch = torch.from_numpy(0.1 * rng.standard_normal((3, 4))).requires_grad_()

    def readings(launch, W0, generator):
        weights = {"W0": W0, "generator": generator}
        return torch.func.functional_call(network, weights, launch)

    weights = [w.detach().clone().requires_grad_() for w in (network.W0, network.generator)]
    assert torch.autograd.gradcheck(readings, (launch, *weights), eps=1e-6, atol=1e-7)


def test_generator_reads_as_a_gradient(small_ring, small_network):
    """A thin gradient at the exit of a layer kicks as a quadrupole: px -= k1L x, py += k1L y."""
    network = small_network.symplectic()
    place = {row: i for i, row in enumerate(exponents(4))}
    layer = int(np.flatnonzero(~network.design.numpy().any(axis=1))[20])  # of no field of its own
    strength = 1e-3
    with torch.no_grad():
        network.generator[layer, place[2, 0, 0, 0]] += strength / 2
        network.generator[layer, place[0, 0, 2, 0]] -= strength / 2
        network.generator[layer, place[3, 0, 0, 0]] += 0.5 / 6
        network.generator[layer, place[1, 0, 2, 0]] -= 0.5 / 2
    read = network.multipoles()
    assert read["gradient"][layer] == pytest.approx(strength)
    assert read["sextupole"][layer] == pytest.approx(0.5)
    for name in ("kick_x", "kick_y", "skew_gradient", "skew_sextupole"):
        assert not read[name].any()
    launch = np.array([[1e-4, 0, 2e-4, 0]])
    before, after = (n.states(launch)[0, layer + 1] for n in (small_network.symplectic(), network))
    x, y = before[0], before[2]
    kick = [-strength * x - 0.25 * (x**2 - y**2), strength * y + 0.5 * x * y]
    np.testing.assert_allclose((after - before)[[1, 3]], kick, rtol=1e-6, atol=1e-14)
    np.testing.assert_allclose((after - before)[[0, 2]], 0, atol=1e-18)


def test_too_strong_a_generator_is_named(small_network):
    network = small_network.symplectic()
    with torch.no_grad():
        network.generator[17] += 1e3
    with pytest.raises(BeamLostError, match="in layer 17"):
        network([[1e-4, 0, 1e-4, 0]])


def test_a_layer_far_from_symplectic_is_refused(small_network):
    network = small_network.copy()
    with torch.no_grad():
        network.W1[5] *= 3.0
    with pytest.raises(ValueError, match="layer 5"):
        network.symplectic()
