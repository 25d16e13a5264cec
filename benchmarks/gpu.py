"""Networks on a graphics card: the CPU's values, and speed beside a plain torch loop.

    python benchmarks/gpu.py --reference FILE       # anywhere: what the CPU says, 5 MB
    python benchmarks/gpu.py FILE [--out FOLDER]    # on the card; OCELOT is not needed

The weights are PETRA III's with a small random change of every coefficient: none is zero, as after
a training step. Times are medians, by CUDA events, in ms. The whole takes a minute.
"""

import argparse
import json
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
from tmlattice.fitting.adam import fit_adam
from tmlattice.harmonics import tunes
from tmlattice.maps import RingMaps, TaylorMap
from tmlattice.measurement import Measurement
from tmlattice.network import TaylorNetwork, symplectic_penalty
from tmlattice.network.reference import packed, plain_pass

SHOTS = 200
DEVICE = "cuda"
ARRAYS = ("s", "W0", "W1", "W2", "s_monitors", "at", "R0", "R1", "R2")


def network_of(file):
    """The design in a reference file, and the change of every coefficient."""
    closing = TaylorMap([file[f"closing{i}"] for i in range(3)])
    names = {name: tuple(file[name].tolist()) for name in ("layers", "monitors")}
    design = TaylorNetwork(RingMaps(**{k: file[k] for k in ARRAYS}, **names, closing=closing))
    network = design.copy()
    rng = np.random.default_rng(1)
    with torch.no_grad():
        for weight, size in zip(network.parameters(), (1e-9, 1e-7, 1e-3), strict=True):
            weight.add_(size * torch.from_numpy(rng.standard_normal(tuple(weight.shape))))
    return design, network


def measurement_of(file, network):
    launch = np.zeros((5, 5))
    launch[:, :4] = file["launch"][:5]
    return Measurement(launch, file["read"][:, None], network.monitors)


def everything(network, file):
    """What is compared, as arrays on the CPU."""
    device = network.W0.device
    launch = torch.from_numpy(file["launch"]).to(device).requires_grad_()
    pulls = torch.from_numpy(file["pulls"]).to(device)
    readings = network(launch, turns=2)
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
    fit = fit_adam(network, measurement_of(file, network), epochs=10, progress=False)
    found["losses of ten epochs of fine_tune"] = np.array(fit.loss)
    return found


def reference(path):
    """Weights, launches, and what the CPU makes of them."""
    from tmlattice import load_ring

    maps = TaylorNetwork.from_ring(load_ring("petra3")).maps
    rng = np.random.default_rng(2)
    file = {name: getattr(maps, name) for name in ARRAYS}
    file |= {f"closing{i}": c for i, c in enumerate(maps.closing.coefficients)}
    file |= {"layers": np.array(maps.layers), "monitors": np.array(maps.monitors)}
    file["launch"] = rng.standard_normal((SHOTS, 4)) * [3e-4, 1e-5, 3e-4, 1e-5]
    file["pulls"] = rng.standard_normal((SHOTS, 2, len(maps.monitors), 2))
    design, network = network_of(file)
    file["read"] = design.readings(file["launch"][:5])
    file |= {f"expected {name}": value for name, value in everything(network, file).items()}
    still = design.track(file["launch"][:20] * 0.1, 255)
    file["expected tunes of the design"] = tunes(still, method="fft").fraction
    np.savez_compressed(path, **file)
    print(f"{path}: {path.stat().st_size / 1e6:.1f} MB")


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
    i, j = torch.triu_indices(4, 4).to(DEVICE)
    for layer in w:
        x = layer[:, 0] + x @ layer[:, 1:5].T + (x[:, i] * x[:, j]) @ layer[:, 5:].T
    return x


class Run:
    def __init__(self, path, out):
        from tmlattice.network import cuda

        self.cuda, self.out = cuda, out
        self.begun = time.perf_counter()
        self.result = {}
        self.file = dict(np.load(path))
        self.design, self.network = (n.to(DEVICE) for n in network_of(self.file))

    def say(self, name, value):
        self.result[name] = value
        print(f"[{time.perf_counter() - self.begun:6.1f} s] {name}: {value}", flush=True)
        (self.out / "gpu.json").write_text(json.dumps(self.result, indent=1))

    def choose(self, kernel, what, options, call):
        """Each configuration's time; the fastest is kept."""
        times = {}
        for option in options:
            self.cuda.CONFIGURATION[kernel] = option
            try:
                times[json.dumps(option)] = round(milliseconds(call, 7), 3)
            except Exception as error:
                times[json.dumps(option)] = str(error)[:80]
        numbers = {k: v for k, v in times.items() if isinstance(v, float)}
        best = min(numbers, key=numbers.get)
        self.cuda.CONFIGURATION[kernel] = json.loads(best)
        self.say(f"{kernel}, {what}", times)

    def state(self):
        query = "name,driver_version,clocks.sm,clocks.max.sm,clocks.mem,power.draw,memory.total"
        seen = subprocess.run(["nvidia-smi", f"--query-gpu={query}", "--format=csv,noheader"],
                              capture_output=True, text=True, check=False)  # fmt: skip
        return seen.stdout.strip()

    def card(self):
        import triton

        self.say("card", self.state())
        self.say("versions", f"torch {torch.__version__}, triton {triton.__version__}")

    def values(self):
        before = everything(self.network, self.file)
        for name, value in before.items():
            self.say(f"{name}, relative to the CPU", relative(value, self.file["expected " + name]))
        again = everything(self.network, self.file)
        same = all((again[name] == value).all() for name, value in before.items())
        self.say("repeats bit by bit", same)
        still = self.design.track(self.file["launch"][:20] * 0.1, 255)
        found = tunes(still, method="fft").fraction
        self.say("tunes - CPU's", np.abs(found - self.file["expected tunes of the design"]).max())

    def launches(self, count):
        torch.manual_seed(count)
        size = torch.tensor([3e-4, 1e-5, 3e-4, 1e-5], dtype=torch.float64, device=DEVICE)
        return torch.randn(count, 4, dtype=torch.float64, device=DEVICE) * size

    def turn(self, network):
        with torch.no_grad():
            weights = packed(network.W0, network.W1, network.W2)
            return torch.cat([weights, network._closing[None]])

    def tracking(self):
        w, design = self.turn(self.network), self.turn(self.design)
        options = [
            {"BLOCK": b, "num_warps": n, "UNROLL": u, **({"maxnreg": r} if r else {})}
            for b, n, u, r in TRACK
        ]
        for count in (100_000, 1_000_000):
            x = self.launches(count)

            def ten(layers, x=x):
                return milliseconds(lambda: self.cuda.track(x, layers, 10), 3) / 10

            self.choose("track", count, options, lambda x=x: self.cuda.track(x, w, 1))
            self.say(f"track {count}, a turn of ten", ten(w))
            self.cuda.track(x, w, 20)
            self.say("card, at work", self.state())
            self.say(f"track {count}, the design, a turn of ten", ten(design))
            plain = milliseconds(lambda x=x: plain_track(x, w), 3)
            self.say(f"torch loop {count}, one turn", plain)

    def parts(self, count=100_000):
        """The parts of a training step, each alone."""
        x, w = self.launches(count), self.turn(self.network)[:-1]
        sweep = self.network.sweep()
        curved = torch.ones(len(w), dtype=torch.int32, device=DEVICE)
        readings = x.new_empty(len(sweep.r), 2, count)
        states = x.new_empty(len(w) + 1, 4, count)
        states[0] = x.T
        adjoint = torch.randn_like(states)
        ones = [{"BLOCK": b, "num_warps": n} for b, n in PASS]
        self.choose("readings", count, ones, lambda: sweep.fill(w, curved, x.T.clone(), readings))
        self.choose("states", count, ones, lambda: sweep.fill(w, curved, states))
        pulls = readings.permute(2, 0, 1)
        self.choose(
            "reverse", count, ones, lambda: sweep.reverse(w, curved, states, pulls, adjoint)
        )
        options = [{"BLOCK": b, "num_warps": n, "PART": p} for b, n, p in SUMS]
        self.choose("sums", count, options, lambda: self.cuda.sums(states, adjoint))

    def training(self, count=100_000):
        x, network = self.launches(count), self.network
        target = 1e-4 * torch.randn(count, len(network.monitors), 2, dtype=torch.float64,
                                    device=DEVICE)  # fmt: skip

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


TRACK = (
    (128, 1, 1, 0), (128, 1, 2, 0), (128, 1, 4, 0), (256, 1, 1, 0), (256, 1, 2, 0),
    (256, 1, 4, 0), (256, 1, 2, 168), (256, 2, 2, 0), (512, 2, 2, 0),
)  # fmt: skip
PASS = ((32, 1), (64, 1), (128, 1), (64, 2))
SUMS = ((32, 1, 8192), (32, 1, 16384), (64, 2, 16384))


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("file", type=Path)
    parser.add_argument("--reference", action="store_true", help="write the file")
    parser.add_argument("--out", type=Path, default=Path(os.environ.get("OUT", ".")))
    options = parser.parse_args()
    if options.reference:
        reference(options.file)
        return
    run = Run(options.file, options.out)
    for part in (run.card, run.values, run.tracking, run.parts, run.training, run.long):
        part()
    print(json.dumps(run.result))


if __name__ == "__main__":
    main()
