"""The network as a part of a user's own torch program."""

import numpy as np
import pytest
import torch

from tmlattice import TaylorNetwork, load_ring
from tmlattice.errors import BeamLostError, LatticeError
from tmlattice.network import FreeLayers, plain_readings


@pytest.fixture
def short(tmp_path, rng):
    """Three magnets with all weights different from zero, and a launch."""
    (tmp_path / "short.py").write_text(
        "from ocelot import *\nenergy = 1.0\n"
        "q = Quadrupole(l=0.3, k1=1.2, eid='q')\ns = Sextupole(l=0.1, k2=20.0, eid='s')\n"
        "p = Quadrupole(l=0.3, k1=-1.2, eid='p')\n"
        "cell = [Monitor(eid='a'), q, Drift(l=0.5, eid='d'), s, Monitor(eid='b'), p, "
        "Drift(l=1, eid='e'), Monitor(eid='c'), Drift(l=1, eid='f')]"
    )
    network = TaylorNetwork.from_ring(load_ring(tmp_path / "short.py"))
    with torch.no_grad():
        for weight in network.parameters():
            weight.add_(0.01 * torch.from_numpy(rng.standard_normal(tuple(weight.shape))))
    return network, torch.from_numpy(0.1 * rng.standard_normal((3, 4)))


@pytest.fixture
def network(small_ring):
    return TaylorNetwork.from_ring(small_ring)


@pytest.mark.parametrize("dimension", [4, 6])
def test_readings_of_several_turns_are_those_of_the_tracked_states(small_ring, dimension, rng):
    network = TaylorNetwork.from_ring(small_ring, dimension)
    launch = 1e-5 * rng.standard_normal((3, dimension))
    readings = network(launch, turns=3)
    assert readings.shape == (3, 3, len(network.monitors), 2)
    states = network.track(launch, turns=2)
    for turn in range(3):
        expected = network(states[:, turn])
        assert (readings[:, turn] - expected).abs().max() <= 1e-12 * expected.abs().max()


def test_gradients_of_several_turns_match_finite_differences(short):
    network, launch = short
    wanted = [(0.1 * launch).requires_grad_(), *network.parameters()]
    assert torch.autograd.gradcheck(lambda x, *_: network(x, turns=2), wanted)


def test_second_derivatives_match_finite_differences(short):
    network, launch = short
    wanted = [launch.requires_grad_(), *network.parameters()]
    assert torch.autograd.gradgradcheck(lambda x, *_: network(x), wanted)


def test_a_lost_trajectory_reads_inf_and_leaves_the_others_alone(network, rng):
    launch = 1e-5 * rng.standard_normal((3, 4))
    launch[1, 0] = 1e3
    with pytest.raises(BeamLostError, match="trajectory 1 is lost"):
        network(launch)
    readings = network(launch, turns=2, on_lost="inf")
    assert torch.isinf(readings[1]).all()
    others = network(launch[[0, 2]], turns=2)
    assert (readings[[0, 2]] == others).all()
    finite = torch.isfinite(readings)
    (readings[finite]).square().sum().backward()
    got = network.W1.grad.clone()
    network.zero_grad()
    others.square().sum().backward()
    assert (got - network.W1.grad).abs().max() <= 1e-12 * got.abs().max()


def test_all_trajectories_may_be_lost(network):
    loss = network([[1e3, 0, 0, 0]], turns=2, on_lost="inf").square().sum()
    loss.backward()
    assert torch.isinf(loss)
    assert not network.W1.grad.any()


def test_lbfgs_goes_on_where_a_step_loses_the_beam(network, rng):
    launch = 1e-4 * rng.standard_normal((2, 4))
    target = 1.1 * network(launch).detach()
    optimiser = torch.optim.LBFGS(
        network.parameters(), lr=1e6, max_iter=5, line_search_fn="strong_wolfe"
    )
    losses = []

    def closure():
        optimiser.zero_grad()
        loss = (network(launch, on_lost="inf") - target).square().sum()
        loss.backward()
        losses.append(loss.item())
        return loss

    optimiser.step(closure)
    assert np.isinf(losses).any()
    assert all(torch.isfinite(weight).all() for weight in network.parameters())
    assert closure().item() <= losses[0]


@pytest.mark.parametrize("convert", ["float", "half", "bfloat16"])
def test_another_type_is_refused_in_a_sentence(network, convert):
    with pytest.raises(TypeError, match="computes in float64, not"):
        getattr(network, convert)()
    assert network.W0.dtype == torch.float64
    assert network.double().to("cpu") is network


def test_a_device_without_sweeps_is_refused_in_a_sentence(network):
    with pytest.raises(TypeError, match="TaylorNetwork does not run on 'meta'; it runs on cpu"):
        network.to("meta")
    with pytest.raises(TypeError, match="SymplecticNetwork does not run on 'meta'"):
        network.symplectic().to("meta")


def test_a_launch_of_float32_gives_readings_of_float64(network):
    assert network(torch.full((1, 4), 1e-5)).dtype == torch.float64


def test_func_grad_and_vjp_work_and_what_does_not_is_named(short):
    network, launch = short
    weights = dict(network.named_parameters())

    def loss(weights):
        return torch.func.functional_call(network, weights, (launch,)).square().sum()

    got = torch.func.grad(loss)(weights)
    network(launch).square().sum().backward()
    for name, weight in weights.items():
        assert torch.allclose(got[name], weight.grad, rtol=1e-12, atol=0)
    with pytest.raises(NotImplementedError, match="plain_readings"):
        torch.func.vmap(lambda x: network(x[None]))(launch)
    with pytest.raises(NotImplementedError, match="no forward-mode derivative"):
        torch.func.jvp(network, (launch,), (launch,))


def test_any_transform_works_on_the_plain_loop(short):
    network, launch = short

    def square(x):
        return plain_readings(network, x[None]).square().sum()

    hessian = torch.func.hessian(square)(launch[0])
    assert torch.allclose(hessian, hessian.T)
    slope = torch.func.grad(square)
    step = 1e-6 * torch.eye(4, dtype=torch.float64)
    for i in range(4):
        moved = (slope(launch[0] + step[i]) - slope(launch[0] - step[i])) / 2e-6
        assert torch.allclose(moved, hessian[i], rtol=1e-6, atol=1e-8)


def test_only_the_layers_of_a_group_move(small_ring, network, rng):
    quadrupoles = [m.kind == "quadrupole" for m in small_ring.magnets]
    part = FreeLayers(network, {"quadrupoles": "quadrupole"}, weights=("W1",))
    assert [tuple(p.shape) for p in part.parameters() if p.requires_grad] == [
        (sum(quadrupoles), 4, 4)
    ]
    launch = 1e-5 * rng.standard_normal((4, 4))
    assert (part(launch) == network(launch)).all()
    target = 1.01 * network(launch).detach()
    before = (part(launch) - target).square().sum().item()
    free = part.groups["quadrupoles"].parameters()
    optimiser = torch.optim.Adam([{"params": free, "lr": 1e-6}])
    for _ in range(20):
        optimiser.zero_grad()
        loss = (part(launch) - target).square().sum()
        loss.backward()
        optimiser.step()
    assert loss.item() < before
    moved = (part.merged().W1 != network.W1).any(dim=(1, 2)).tolist()
    assert moved == quadrupoles
    assert (part.merged().W2 == network.W2).all()


def test_the_gradient_of_a_group_is_that_of_its_layers(network, rng):
    names = network.layers[3], network.layers[10]
    part = FreeLayers(network, {"two": names})
    launch = 1e-5 * rng.standard_normal((4, 4))
    for model in (part, network):
        model(launch, turns=2).square().sum().backward()
    for name in ("W1", "W2"):
        got = part.groups["two"][name].grad
        assert (got == getattr(network, name).grad[[3, 10]]).all()


def test_groups_that_are_empty_or_share_a_layer_are_refused(network):
    with pytest.raises(LatticeError, match="group 'a': no layer is a 'qx' or has such a name"):
        FreeLayers(network, {"a": "qx"})
    with pytest.raises(LatticeError, match="groups 'a' and 'b' share the layer"):
        FreeLayers(network, {"a": "*", "b": "quadrupole"})
