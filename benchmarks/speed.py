"""Speeds as ratios in one run: `python benchmarks/speed.py`.

- one training step (forward, reverse, Adam) against a plain torch loop over 1519 pairs of
  parameters with torch's autograd and Adam;
- one turn of one and of 1000 particles against AT's default tracking of the same ring;
- symplectic layers against the truncated ones, one and 64 particles at 3 mm;
- the maps of the whole ring, and a fit of 1000 epochs.

Compilation is done before anything is timed. Medians; the machine's load shows in the spread.
"""

import time

import at
import numpy as np
import torch

import tmlattice
from tmlattice.machine.at_engine import AtEngine
from tmlattice.maps import ring_maps
from tmlattice.network import symplectic_penalty


def median_time(call, repeats):
    call()
    times = []
    for _ in range(repeats):
        begun = time.perf_counter()
        call()
        times.append(time.perf_counter() - begun)
    return float(np.median(times))


def plain_step(network, launch, target):
    """One Adam step of 1519 small modules, as one would first write it."""
    maps = network.maps
    i, j = torch.triu_indices(4, 4)
    linear = [torch.nn.Parameter(w.clone()) for w in network.W1.detach()]
    quadratic = [torch.nn.Parameter(w.clone()) for w in network.W2.detach()]
    optimiser = torch.optim.Adam([*linear, *quadratic], lr=1e-9)
    readouts = torch.from_numpy(maps.R1)

    def step():
        optimiser.zero_grad()
        state, readings = launch, []
        for k in range(len(linear) + 1):
            at_exit = range(maps.start[k], maps.start[k + 1])
            readings.extend(state @ readouts[m].T for m in at_exit)
            if k < len(linear):
                state = state @ linear[k].T + (state[:, i] * state[:, j]) @ quadratic[k].T
        (torch.stack(readings, 1) - target).square().sum().backward()
        optimiser.step()

    return step


def compiled_step(network, launch, target, penalty):
    network = network.copy()
    network.W0.requires_grad_(False)
    moving = [network.W1, network.W2]
    optimiser = torch.optim.Adam(moving, lr=1e-9, fused=True)

    def step():
        optimiser.zero_grad()
        loss = (network(launch) - target).square().sum()
        if penalty:
            loss = loss + 1e-10 * symplectic_penalty(network.W1, network.W2).sum()
        loss.backward()
        optimiser.step()

    return step


def default_at(ring):
    """The ring as AT's classes make it: ten slices, the usual bend, no apertures."""
    lattice = AtEngine(ring, steps=10).lattice()
    for element in lattice:
        vars(element).pop("RApertures", None)
        if isinstance(element, at.Dipole):
            element.PassMethod = "BndMPoleSymplectic4Pass"
    return lattice


def main():
    torch.set_num_threads(1)
    ring = tmlattice.load_ring("petra3")
    network = tmlattice.TaylorNetwork.from_ring(ring)
    referee = default_at(ring)
    launch = torch.tensor([[1e-3, 0.0, 1e-3, 0.0]], dtype=torch.float64)
    target = network(launch).detach() + 1e-4
    rows = []

    plain = median_time(plain_step(network, launch, target), 5)
    ours = median_time(compiled_step(network, launch, target, False), 100)
    rows.append(("training step, plain torch", plain, "without penalty", ours))
    with_penalty = median_time(compiled_step(network, launch, target, True), 100)
    rows.append(("training step, plain torch", plain, "with symplectic penalty", with_penalty))

    for particles, repeats in ((1, 20), (1000, 5)):
        states = 1e-5 * np.random.default_rng(0).standard_normal((particles, 4))
        six = np.zeros((6, particles), order="F")
        six[:4] = states.T
        turns = 50 if particles == 1 else 2
        mine = median_time(lambda s=states, t=turns: network.track(s, t), repeats) / turns
        for keep in (False, True):  # keep_lattice spares AT the conversion of its elements
            theirs = median_time(
                lambda six=six, keep=keep: referee.track(
                    six.copy(order="F"), nturns=1, keep_lattice=keep
                ),
                repeats,
            )
            name = f"AT, one turn of {particles}{', keep_lattice' if keep else ''}"
            rows.append((name, theirs, "compiled chain", mine))

    symplectic = network.symplectic()
    for particles, turns in ((1, 300), (64, 60)):
        states = np.outer(np.linspace(0.1, 1.0, particles), [3e-3, 0, 3e-3, 0])
        times = [
            median_time(lambda n=n, s=states, t=turns: n.track(s, t), 10) / turns
            for n in (symplectic, network)
        ]
        rows.append(
            (f"symplectic layers, one turn of {particles}", times[0], "truncated", times[1])
        )

    print("| what | ms | compared with | ms | ratio |\n|---|---|---|---|---|")
    for name, slow, other, fast in rows:
        ratio = f"{slow / fast:.{1 if slow < 10 * fast else 0}f}"
        print(f"| {name} | {1e3 * slow:.2f} | {other} | {1e3 * fast:.3f} | {ratio} |")
    print()
    print(f"maps of the whole ring: {median_time(lambda: ring_maps(ring), 5):.3f} s")
    measurement = tmlattice.Measurement(launch.numpy(), target.numpy()[:, None], network.monitors)
    fit = tmlattice.fine_tune(network, measurement, launch_sigma=0.0, patience=None, progress=False)
    print(f"fit of {len(fit.loss)} epochs with the symplectic penalty: {fit.seconds:.2f} s")
    print(f"at {at.__version__}, torch {torch.__version__}, numpy {np.__version__}")


if __name__ == "__main__":
    main()
