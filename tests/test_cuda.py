"""Networks on a graphics card against the CPU's; the kernels' logic in Triton's interpreter."""

import importlib.util
import os
import subprocess
import sys

import numpy as np
import pytest
import torch
from conftest import SMALL
from shared import SHORT

from tmlattice import TaylorNetwork
from tmlattice.errors import BeamLostError
from tmlattice.fitting import fine_tune
from tmlattice.measurement import Measurement
from tmlattice.network import symplectic_penalty

card = pytest.mark.skipif(not torch.cuda.is_available(), reason="no graphics card")

INTERPRETED = """
import sys
import torch
from tmlattice import TaylorNetwork, load_ring
from tmlattice.network import cuda
from tmlattice.network.reference import packed, plain_pass

cuda.parts = lambda launch, layers: [slice(0, 3), slice(3, len(launch))]
cuda.multiprocessors = lambda tensor: 1
cuda.CONFIGURATION["track"]["UNROLL"] = 2
torch.manual_seed(1)
network = TaylorNetwork.from_ring(load_ring(sys.argv[1]), int(sys.argv[2]))
n, layers = network.dimension, len(network.layers)
weights = [w.detach() for w in network.parameters()]
for w in weights:
    w[1:] += 0.01 * torch.randn_like(w[1:])  # the first magnet stays linear
launch = 0.1 * torch.randn(5, n, dtype=torch.float64)
maps = network.maps
read_outs = packed(*map(torch.from_numpy, (maps.R0, maps.R1, maps.R2)))
sweep = cuda.TritonSweep(read_outs, torch.from_numpy(maps.start))


def differ(got, expected):
    assert got.shape == expected.shape
    assert (got - expected).abs().max() <= 1e-13 * expected.abs().max()


given = [x.clone().requires_grad_() for x in (launch, *weights)]
expected = plain_pass(given[0], given[1:], sweep.r, sweep.start)
readings, end, kept = sweep.forward(launch, weights)
differ(readings, expected[0])
differ(end, expected[1])
pulls = [torch.randn_like(x) for x in (readings.contiguous(), end)]
slopes = torch.autograd.grad(expected, given, pulls)
for wanted in (True, False):
    first, others = sweep.backward(launch, weights, kept, pulls, wanted)
    differ(first, slopes[0])
    for got, slope in zip(others, slopes[1:]):
        if wanted:
            differ(got, slope)
        else:
            assert got is None
for order in ([0, 1], [0, 1, 0], [1, 1, 1]):  # some layers linear, an odd number, all curved
    chain = [w[order] for w in weights]
    start = torch.zeros(len(order) + 2, dtype=torch.int64)
    start[-1] = 1
    first = plain_pass(launch, chain, sweep.r[:1], start)[1]
    second = plain_pass(first, chain, sweep.r[:1], start)[1]
    turns = cuda.track(launch, packed(*chain), 2)
    differ(turns, torch.stack([launch, first, second], dim=1))
"""


@pytest.mark.skipif(importlib.util.find_spec("triton") is None, reason="Triton is not installed")
@pytest.mark.parametrize("dimension", [4, 6])
def test_kernels_match_the_plain_loop(tmp_path, dimension):
    (tmp_path / "short.py").write_text(SHORT)
    done = subprocess.run(
        [sys.executable, "-c", INTERPRETED, str(tmp_path / "short.py"), str(dimension)],
        env={**os.environ, "TRITON_INTERPRET": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    if "only 0-dimensional arrays can be converted" in done.stderr:
        pytest.skip("this Triton's interpreter needs an older numpy")
    assert done.returncode == 0, done.stderr[-2000:]


@pytest.fixture(params=[4, 6])
def pair(small_ring, request, rng):
    """A network whose weights are all different from zero, on the CPU and on the card, launches."""
    network = TaylorNetwork.from_ring(small_ring, request.param)
    with torch.no_grad():
        for weight, size in zip(network.parameters(), (1e-7, 1e-5, 1e-1), strict=True):
            weight.add_(size * torch.from_numpy(rng.standard_normal(tuple(weight.shape))))
    launch = torch.from_numpy(1e-4 * rng.standard_normal((300, request.param)))
    return network, network.copy().to("cuda"), launch


def near(got, expected, tolerance):
    got, expected = (torch.as_tensor(x).detach().cpu() for x in (got, expected))
    assert (got - expected).abs().max() <= tolerance * expected.abs().max()


@card
def test_values_and_gradients_match_the_cpu(pair, rng):
    on_cpu, on_card, launch = pair
    launch.requires_grad_()
    pulls = torch.from_numpy(rng.standard_normal((len(launch), 2, len(on_cpu.monitors), 2)))
    found = []
    for network in (on_cpu, on_card):
        readings = network(launch, turns=2)
        assert readings.device == network.W0.device
        loss = (readings * pulls.to(readings.device)).sum()
        wanted = [launch, *network.parameters()]
        found.append([readings, *torch.autograd.grad(loss, wanted)])
    for expected, got, tolerance in zip(*found, (1e-12, 1e-10, 1e-10, 1e-10, 1e-10), strict=True):
        near(got, expected, tolerance)
    near(on_card.track(launch, 3), on_cpu.track(launch, 3), 1e-12)


@card
def test_results_repeat_bit_by_bit(pair):
    _, network, launch = pair
    gradients = [
        torch.autograd.grad(network(launch).square().sum(), network.parameters()) for _ in range(2)
    ]
    assert all((a == b).all() for a, b in zip(*gradients, strict=True))


@card
def test_penalty_matches_the_cpu(pair):
    found = []
    for network in pair[:2]:
        penalty = symplectic_penalty(network.W1, network.W2)
        found.append([penalty, *torch.autograd.grad(penalty.sum(), [network.W1, network.W2])])
    for expected, got in zip(*found, strict=True):
        near(got, expected, 1e-10)


@card
def test_lost_trajectories_are_named_or_inf(small_ring):
    network = TaylorNetwork.from_ring(small_ring).to("cuda")
    launch = [[1e-5, 0, 0, 0], [1e3, 0, 0, 0]]
    with pytest.raises(BeamLostError, match="trajectory 1 is lost"):
        network(launch)
    assert torch.isinf(network(launch, on_lost="inf"))[:, 0, 0].tolist() == [False, True]
    with pytest.raises(BeamLostError, match="trajectory 1 is lost in turn"):
        network.track([[1e-5, 0, 0, 0], [0.5, 0, 0, 0]], 3)


@card
def test_fine_tune_on_the_card_follows_the_cpu(small_ring):
    network = TaylorNetwork.from_ring(small_ring)
    launch = np.zeros((2, 5))
    launch[:, 0] = 1e-4, 2e-4
    readings = 1.01 * network.readings(launch[:, :4])[:, None]
    measurement = Measurement(launch, readings, network.monitors)
    fits = [
        fine_tune(n, measurement, method="adam", epochs=20, progress=False)
        for n in (network, network.copy().to("cuda"))
    ]
    assert fits[1].network.W0.is_cuda
    assert fits[1].loss == pytest.approx(fits[0].loss, rel=1e-6)


@card
def test_the_extra_that_brings_the_kernels_is_named_without_triton():
    done = subprocess.run(
        [sys.executable, "-c", "import sys; sys.modules['triton'] = None\n"
         "from tmlattice import TaylorNetwork, load_ring\n"
         f"TaylorNetwork.from_ring(load_ring({str(SMALL)!r})).to('cuda')([[1e-4, 0, 0, 0]])"],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert "pip install 'tmlattice[cuda]'" in done.stderr
