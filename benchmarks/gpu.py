"""Networks on a graphics card: the CPU's values, and speed over a plain torch loop and Xsuite.

    python benchmarks/gpu.py [--out FOLDER] [--without-xsuite]

The ring is petra3, in four and in six dimensions, with a small random change of every coefficient:
none is zero, as after a training step. Times are medians, by CUDA events, in ms. Xsuite tracks the
same ring as `.xsuite.json` on the same card, with CuPy; its kernel takes minutes to compile.
"""

import argparse
import importlib
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
from tmlattice import TaylorNetwork, load_ring
from tmlattice.errors import BeamLostError
from tmlattice.fitting.adam import fit_adam
from tmlattice.harmonics import tunes
from tmlattice.lattice.write import save_ring
from tmlattice.machine.stored_beam import simulate_turns
from tmlattice.measurement import Measurement
from tmlattice.network import symplectic_penalty
from tmlattice.network.reference import packed, plain_pass

SHOTS = 200
DEVICE = "cuda"
SIZE = (3e-4, 1e-5, 3e-4, 1e-5, 1e-3, 1e-4)
"""Rms of a launch, of each coordinate: m, rad, m, rad, m, 1."""


def changed(design):
    """The design with a change of every coefficient."""
    network = design.copy()
    rng = np.random.default_rng(1)
    with torch.no_grad():
        for weight, size in zip(network.parameters(), (1e-9, 1e-7, 1e-3), strict=True):
            weight.add_(size * torch.from_numpy(rng.standard_normal(tuple(weight.shape))))
    return network


def launches(count, dimension, seed=2):
    rng = np.random.default_rng(seed)
    return torch.from_numpy(rng.standard_normal((count, dimension)) * SIZE[:dimension])


def everything(network, design):
    """What is compared, as arrays on the CPU."""
    device, n = network.W0.device, network.dimension
    launch = launches(SHOTS, n).to(device).requires_grad_()
    rng = np.random.default_rng(3)
    readings = network(launch, turns=2)
    pulls = torch.from_numpy(rng.standard_normal(tuple(readings.shape))).to(device)
    names = ("launch", "W0", "W1", "W2")
    wanted = [launch, *network.parameters()]
    gradients = torch.autograd.grad((readings * pulls).sum(), wanted)
    penalty = symplectic_penalty(network.W1, network.W2)
    by_penalty = torch.autograd.grad(penalty.sum(), wanted[2:])
    tensors = {
        "readings of two turns": readings,
        **{f"gradient by {n}": g for n, g in zip(names, gradients, strict=True)},
        "penalty": penalty,
        **{f"penalty's gradient by {n}": g for n, g in zip(names[2:], by_penalty, strict=True)},
    }
    found = {name: t.detach().cpu().numpy() for name, t in tensors.items()}
    found["one turn"] = network.track(launch, 1)[:, 1]
    still = launch.detach() * 0.1
    found["255 turns of the design"] = design.track(still[:20], 255)
    far = still[:5].clone()
    far[3, 0] = 0.5
    lost = network(far, on_lost="inf").detach().cpu().numpy()
    found["readings next to a lost beam"] = np.where(np.isfinite(lost), lost, 1e3)
    try:
        network.track(far, 3)
    except BeamLostError as error:
        found["the lost beam's message"] = np.array([len(str(error))])
    if n == 4:
        whole = np.zeros((5, 5))
        whole[:, :4] = launch[:5].detach().cpu().numpy()
        read = design.readings(launch[:5])
        read = np.asarray(read.detach().cpu() if isinstance(read, torch.Tensor) else read)
        measured = Measurement(whole, read[:, None], network.monitors)
        fit = fit_adam(network, measured, epochs=10, progress=False)
        found["losses of ten epochs of fine_tune"] = np.array(fit.loss)
    return found


def milliseconds(call, repeats=15):
    for _ in range(2):
        call()
    times = []
    for _ in range(repeats):
        a, b = (torch.cuda.Event(enable_timing=True) for _ in range(2))
        a.record()
        call()
        b.record()
        b.synchronize()
        times.append(a.elapsed_time(b))
    return float(np.median(times))


def relative(got, expected):
    return float(np.abs(got - expected).max() / np.abs(expected).max())


def plain_track(x, w):
    n = x.shape[1]
    i, j = torch.triu_indices(n, n).to(DEVICE)
    for layer in w:
        linear, second = layer[:, 1 : n + 1], layer[:, n + 1 :]
        x = layer[:, 0] + x @ linear.T + (x[:, i] * x[:, j]) @ second.T
    return x


class Run:
    def __init__(self, out, dimension):
        self.out, self.dimension = out, dimension
        self.begun = time.perf_counter()
        self.result = {}
        self.on_cpu = TaylorNetwork.from_ring(load_ring("petra3"), dimension)
        self.design = self.on_cpu.copy().to(DEVICE)
        self.network = changed(self.on_cpu).to(DEVICE)

    def say(self, name, value):
        name = f"{self.dimension}-D: {name}"
        self.result[name] = value
        print(f"[{time.perf_counter() - self.begun:6.1f} s] {name}: {value}", flush=True)

    def card(self):
        query = "name,driver_version,clocks.sm,clocks.max.sm,clocks.mem,power.draw,memory.total"
        seen = subprocess.run(["nvidia-smi", f"--query-gpu={query}", "--format=csv,noheader"],
                              capture_output=True, text=True, check=False)  # fmt: skip
        self.say("card", seen.stdout.strip())

    def values(self):
        expected = everything(changed(self.on_cpu), self.on_cpu)
        self.say("devices", [str(n.W0.device) for n in (self.on_cpu, self.network, self.design)])
        found = [everything(self.network, self.design) for _ in range(2)]
        for name, value in found[0].items():
            self.say(f"{name}, relative to the CPU", relative(value, expected[name]))
        self.say("repeats bit by bit", all((found[1][k] == v).all() for k, v in found[0].items()))
        turns = "255 turns of the design"
        of_card, of_cpu = (tunes(x[turns], method="fft").fraction for x in (found[0], expected))
        self.say("tunes - CPU's", float(np.abs(of_card - of_cpu).max()))

    def launches(self, count):
        return launches(count, self.dimension, count).to(DEVICE)

    def turn(self, network):
        with torch.no_grad():
            weights = packed(network.W0, network.W1, network.W2)
            return torch.cat([weights, network._closing[None]])

    def tracking(self):
        from tmlattice.network import cuda

        w, design = self.turn(self.network), self.turn(self.design)
        for count in (100_000, 1_000_000):
            x = self.launches(count)
            for name, layers in (("", w), (", the design", design)):
                ten = milliseconds(lambda x=x, w=layers: cuda.track(x, w, 10), 3)
                self.say(f"track {count}{name}, a turn of ten", ten / 10)
            cuda.track(x, w, 20)
            self.card()
            plain = milliseconds(lambda x=x: plain_track(x, w), 3)
            self.say(f"torch loop {count}, one turn", plain)

    def training(self, count=100_000):
        x, network = self.launches(count), self.network
        generator = torch.Generator(DEVICE).manual_seed(4)
        target = 1e-4 * torch.randn(count, len(network.monitors), 2, dtype=torch.float64,
                                    device=DEVICE, generator=generator)  # fmt: skip

        def step(penalty):
            network.zero_grad()
            loss = (network(x) - target).square().sum()
            if penalty:
                loss = loss + 1e-10 * symplectic_penalty(network.W1, network.W2).sum()
            loss.backward()

        self.say(f"training step {count}, with penalty", milliseconds(lambda: step(True), 7))
        self.say(f"training step {count}", milliseconds(lambda: step(False), 7))
        self.say("memory, GB", round(torch.cuda.max_memory_allocated() / 1e9, 1))
        mine = [w.grad.clone() for w in network.parameters()]
        torch.cuda.empty_cache()
        sweep = network.sweep()

        def plain():
            network.zero_grad()
            found, _ = plain_pass(x, tuple(network.parameters()), sweep.r, sweep.start)
            (found - target).square().sum().backward()

        self.say(f"torch loop, training step {count}", milliseconds(plain, 2))
        for name, got, weight in zip(("W0", "W1", "W2"), mine, network.parameters(), strict=True):
            error = relative(got.cpu().numpy(), weight.grad.cpu().numpy())
            self.say(f"gradient by {name}, relative to the torch loop", error)

    def long(self):
        """As users meet it: the states come back to the host."""
        for count, turns in ((10_000, 1024), (100_000, 1000)):
            begun = time.perf_counter()
            self.design.track(self.launches(count) * 0.1, turns, keep_lost=True)
            self.say(f"network.track, {count} x {turns}, s", time.perf_counter() - begun)
        begun = time.perf_counter()
        simulate_turns(load_ring("petra3"), turns=1000, particles=100_000, engine="network")
        self.say("simulate_turns, 100000 x 1000, s", time.perf_counter() - begun)

    def xsuite(self, turns=3):
        """The design through Xsuite's own elements (exact drifts, thick magnets)."""
        os.environ["XSUITE_ALLOW_KERNEL_COMPILATION"] = "1"
        import xobjects
        import xtrack

        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "petra3.xsuite.json"
            save_ring(load_ring("petra3"), path)
            line = xtrack.load(str(path))
        begun = time.perf_counter()
        context = xobjects.ContextCupy()
        line.build_tracker(_context=context)
        reference = line.particle_ref
        for count in (100_000, 1_000_000):
            x = launches(count, 4, count).numpy().T
            at = dict(zip(("x", "px", "y", "py"), x, strict=True))
            particles = xtrack.Particles(
                _context=context, mass0=reference.mass0, p0c=reference.p0c[0],
                q0=reference.q0, **at,
            )  # fmt: skip
            if count == 100_000:
                few = self.design.track(launches(count, 4, count)[:1000], 1, keep_lost=True)[:, 1]
                line.track(particles, num_turns=1)
                order = particles.particle_id.get().argsort()
                got = np.stack([getattr(particles, c).get()[order][:1000] for c in at], axis=1)
                self.say("Xsuite, seconds to compile", round(time.perf_counter() - begun, 1))
                self.say("Xsuite, one turn, relative to the network's", relative(got, few))
            spent = milliseconds(lambda p=particles: line.track(p, num_turns=turns), 3) / turns
            self.say(f"Xsuite {count}, the design, one turn", spent)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path(os.environ.get("OUT", ".")))
    parser.add_argument("--without-xsuite", action="store_true")
    options = parser.parse_args()
    triton = importlib.import_module("triton").__version__
    result = {"versions": f"torch {torch.__version__}, triton {triton}"}
    for dimension in (4, 6):
        run = Run(options.out, dimension)
        parts = [run.card, run.values, run.tracking, run.training]
        if dimension == 4:
            parts += [run.long] if options.without_xsuite else [run.long, run.xsuite]
        for part in parts:
            try:
                part()
            except Exception as error:  # the others' figures are worth their time on the card
                run.say(f"{part.__name__} ended", repr(error))
            result |= run.result
            (options.out / "gpu.json").write_text(json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
