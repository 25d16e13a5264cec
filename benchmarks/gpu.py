"""The kernels of a graphics card against the CPU's, and their speed.

    python benchmarks/gpu.py --reference FILE       # here: what the CPU says, 3 MB
    python benchmarks/gpu.py FILE [--out FOLDER]    # there: torch with CUDA is all it needs

The weights are PETRA III's with a small random change of every coefficient: none is zero, as after
a training step. Times are medians, with CUDA events, in ms.
"""

import argparse
import json
import os
import subprocess
import sys
import time
import types
from pathlib import Path

import numpy as np
import torch

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))
SHOTS = 200
DEVICE = "cuda"


def reference(path):
    """Weights, launches, and what the CPU makes of them."""
    from tmlattice import TaylorNetwork, load_ring
    from tmlattice.maps.taylor import symplectic_form
    from tmlattice.network import symplectic_penalty

    rng = np.random.default_rng(1)
    network = TaylorNetwork.from_ring(load_ring("petra3"))
    maps = network.maps
    design = network.turn().W
    with torch.no_grad():
        for weight, size in zip(network.parameters(), (1e-9, 1e-7, 1e-3), strict=True):
            weight.add_(size * torch.from_numpy(rng.standard_normal(tuple(weight.shape))))
    launch = torch.from_numpy(
        rng.standard_normal((SHOTS, 4)) * [3e-4, 1e-5, 3e-4, 1e-5]
    ).requires_grad_()
    readings = network(launch)
    pulls = torch.from_numpy(rng.standard_normal(tuple(readings.shape)))
    gradients = torch.autograd.grad((readings * pulls).sum(), [launch, *network.parameters()])
    penalty = symplectic_penalty(network.W1, network.W2)
    penalty_gradients = torch.autograd.grad(penalty.sum(), [network.W1, network.W2])
    turns = network.track(launch.detach(), 1)[:, 1]
    arrays = {
        **{f"W{i}": w.detach().numpy() for i, w in enumerate(network.parameters())},
        **{f"turn{i}": w for i, w in enumerate(network.turn().W)},
        **{f"design{i}": w for i, w in enumerate(design)},
        "R0": maps.R0, "R1": maps.R1, "R2": maps.R2, "start": maps.start,
        "form": symplectic_form(4), "launch": launch.detach().numpy(),
        "pulls": pulls.numpy(), "readings": readings.detach().numpy(), "turn": turns,
        **{f"gradient_{n}": g.numpy() for n, g in zip(("launch", "W0", "W1", "W2"), gradients,
                                                      strict=True)},
        "penalty": penalty.detach().numpy(),
        "penalty_W1": penalty_gradients[0].numpy(), "penalty_W2": penalty_gradients[1].numpy(),
    }  # fmt: skip
    np.savez_compressed(path, **arrays)
    print(
        f"{path}: {path.stat().st_size / 1e6:.1f} MB, largest reading {abs(readings).max():.2g} m"
    )


def kernels():
    """`tmlattice.network.cuda`; the rest of its package, with numba and OCELOT, stays outside."""
    package = types.ModuleType("tmlattice.network")
    package.__path__ = [str(ROOT / "tmlattice" / "network")]
    sys.modules["tmlattice.network"] = package
    from tmlattice.network import cuda

    return cuda


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
    expected = torch.as_tensor(expected).to(DEVICE)
    return float((got - expected).abs().max() / expected.abs().max())


def plain_track(x, W):
    i, j = torch.triu_indices(4, 4).to(DEVICE)
    for w0, w1, w2 in zip(*W, strict=True):
        x = w0 + x @ w1.T + (x[:, i] * x[:, j]) @ w2.T
    return x


def plain_readings(x, W, R, start):
    i, j = torch.triu_indices(4, 4).to(DEVICE)
    found = []
    for k in range(len(start) - 1):
        found += [
            R[0][m] + x @ R[1][m].T + (x[:, i] * x[:, j]) @ R[2][m].T
            for m in range(start[k], start[k + 1])
        ]
        if k < len(W[0]):
            x = W[0][k] + x @ W[1][k].T + (x[:, i] * x[:, j]) @ W[2][k].T
    return torch.stack(found, 1)


class Run:
    def __init__(self, path, out):
        self.cuda = kernels()
        self.given = dict(np.load(path))
        self.out = out
        self.begun = time.perf_counter()
        self.result = {}

    def on_card(self, *names):
        return [torch.from_numpy(self.given[name]).to(DEVICE) for name in names]

    def say(self, name, value):
        self.result[name] = value
        print(f"[{time.perf_counter() - self.begun:6.1f} s] {name}: {value}", flush=True)
        (self.out / "gpu.json").write_text(json.dumps(self.result, indent=1))

    def choose(self, kernel, options, call):
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
        return times

    def state(self):
        query = "name,driver_version,clocks.sm,clocks.max.sm,clocks.mem,power.draw,memory.total"
        seen = subprocess.run(["nvidia-smi", f"--query-gpu={query}", "--format=csv,noheader"],
                              capture_output=True, text=True, check=False)  # fmt: skip
        return seen.stdout.strip()

    def card(self):
        self.say("card", self.state())
        import triton

        self.say("versions", f"torch {torch.__version__}, triton {triton.__version__}")
        absent = []
        for name in ("numba", "ocelot", "at", "nafflib", "scipy", "jsonschema", "threadpoolctl"):
            try:
                __import__(name)
            except ImportError:
                absent.append(name)
        self.say("not installed here", absent)
        a = torch.rand(2**28, dtype=torch.float64, device=DEVICE)
        b = torch.empty_like(a)
        self.say("copy, TB/s", round(2 * a.nbytes / milliseconds(lambda: b.copy_(a)) / 1e9, 2))

    def values(self):
        cuda = self.cuda
        W, launch, pulls = self.on_card("W0", "W1", "W2"), *self.on_card("launch", "pulls")
        *R, start, form = self.on_card("R0", "R1", "R2", "start", "form")
        self.monitors, self.form = cuda.read_outs(tuple(R), start), form
        self.w = cuda.packed(*W)
        self.turn = cuda.packed(*self.on_card("turn0", "turn1", "turn2"))
        self.design = cuda.packed(*self.on_card("design0", "design1", "design2"))
        turns = cuda.track(launch, self.turn, 1)
        self.say("one turn, relative to the CPU", relative(turns[:, 1], self.given["turn"]))
        readings, end = cuda.forward(launch, self.w, self.monitors)
        self.say("readings, relative to the CPU", relative(readings, self.given["readings"]))
        plain = plain_readings(launch, W, R, self.given["start"])
        self.say("torch loop, relative to the CPU", relative(plain, self.given["readings"]))
        g, gw = cuda.backward(launch, self.w, self.monitors, pulls, torch.zeros_like(end), True)
        for name, got in zip(("launch", "W0", "W1", "W2"), (g, *cuda.unpacked(gw)), strict=True):
            expected = self.given[f"gradient_{name}"]
            self.say(f"gradient by {name}, relative to the CPU", relative(got, expected))
        again = cuda.backward(launch, self.w, self.monitors, pulls, torch.zeros_like(end), True)
        self.say("gradients repeat bit by bit", bool((again[1] == gw).all()))
        W1, W2 = (w.clone().requires_grad_() for w in W[1:])
        penalty = cuda.penalty_parts(W1, W2, form).sum(dim=1)
        self.say("penalty, relative to the CPU", relative(penalty.detach(), self.given["penalty"]))
        for name, got in zip(("W1", "W2"), torch.autograd.grad(penalty.sum(), (W1, W2)),
                             strict=True):  # fmt: skip
            expected = self.given[f"penalty_{name}"]
            self.say(f"penalty's gradient by {name}", relative(got, expected))

    def launches(self, count):
        torch.manual_seed(count)
        size = torch.tensor([3e-4, 1e-5, 3e-4, 1e-5], dtype=torch.float64, device=DEVICE)
        return torch.randn(count, 4, dtype=torch.float64, device=DEVICE) * size

    def tracking(self):
        options = [
            {"BLOCK": b, "num_warps": w}
            for b, w in ((64, 1), (128, 1), (256, 1), (128, 2), (256, 2), (512, 2), (1024, 4))
        ] + [{"BLOCK": 256, "num_warps": 1, "maxnreg": 160}]
        for count in (100_000, 1_000_000):
            x = self.launches(count)
            call = lambda x=x: self.cuda.track(x, self.turn, 1)  # noqa: E731
            self.say(f"track {count}, one turn", self.choose("track", options, call))
            call = lambda x=x: self.cuda.track(x, self.turn, 10)  # noqa: E731
            self.say(f"track {count}, a turn of ten", milliseconds(call, 3) / 10)
            call()
            self.say("card, at work", self.state())
            call = lambda x=x: self.cuda.track(x, self.design, 10)  # noqa: E731
            self.say(f"track {count}, the design, a turn of ten", milliseconds(call, 3) / 10)
            W = self.on_card("turn0", "turn1", "turn2")
            call = lambda x=x, W=W: plain_track(x, W)  # noqa: E731
            self.say(f"torch loop {count}, one turn", milliseconds(call, 3))

    def sweeps(self, x, pulls, options):
        """The parts of a gradient, each alone."""
        cuda = self.cuda
        chosen = cuda.CONFIGURATION["forward"]
        states = x.new_empty(len(self.w) + 1, 4, len(x))
        states[0] = x.T
        adjoint = torch.randn_like(states)
        curved = torch.ones(len(self.w), dtype=torch.int32, device=DEVICE)

        def forward():
            cuda._pass(self.w, curved, self.monitors, states, None)

        def reverse():
            cuda._back(self.w, curved, self.monitors, states, pulls, adjoint)

        self.say("forward, states kept", self.choose("forward", options, forward))
        cuda.CONFIGURATION["forward"] = chosen
        self.say("reverse", self.choose("reverse", options, reverse))
        parts = [(32, 1, 2048), (32, 1, 8192), (64, 2, 8192), (128, 4, 8192), (32, 1, 16384),
                 (64, 1, 8192)]  # fmt: skip
        options = [{"BLOCK": b, "num_warps": w, "PART": p} for b, w, p in parts]
        self.say("sums", self.choose("sums", options, lambda: cuda._weights(states, adjoint)))

    def training(self, count=100_000):
        cuda = self.cuda
        x = self.launches(count)
        ones = [(32, 1), (64, 1), (128, 1), (64, 2), (128, 2)]
        options = [{"BLOCK": b, "num_warps": w} for b, w in ones]
        call = lambda: cuda.forward(x, self.w, self.monitors)  # noqa: E731
        self.say(f"forward {count}", self.choose("forward", options, call))
        pulls = torch.randn(count, len(self.monitors.r), 2, dtype=torch.float64, device=DEVICE)
        self.sweeps(x, pulls, options)
        target = 1e-4 * pulls
        W = [w.requires_grad_() for w in self.on_card("W0", "W1", "W2")]

        class Sweep(torch.autograd.Function):
            @staticmethod
            def forward(ctx, x, w, monitors):
                ctx.save_for_backward(x, w)
                ctx.monitors = monitors
                return cuda.forward(x, w, monitors)[0]

            @staticmethod
            def backward(ctx, pulls):
                x, w = ctx.saved_tensors
                return *cuda.backward(x, w, ctx.monitors, pulls, torch.zeros_like(x), True), None

        def step(penalty):
            for w in W:
                w.grad = None
            loss = (Sweep.apply(x, cuda.packed(*W), self.monitors) - target).square().sum()
            if penalty:
                loss = loss + 1e-10 * cuda.penalty_parts(W[1], W[2], self.form).sum()
            loss.backward()

        self.say(f"training step {count}", milliseconds(lambda: step(False), 7))
        self.say(f"training step {count}, with penalty", milliseconds(lambda: step(True), 7))
        self.say("memory, GB", round(torch.cuda.max_memory_allocated() / 1e9, 1))
        mine = [w.grad.clone() for w in W]
        penalty = [torch.zeros_like(W[0]), *torch.autograd.grad(
            1e-10 * cuda.penalty_parts(W[1], W[2], self.form).sum(), W[1:])]  # fmt: skip
        torch.cuda.empty_cache()
        R = self.on_card("R0", "R1", "R2")

        def plain():
            for w in W:
                w.grad = None
            found = plain_readings(x, W, R, self.given["start"])
            (found - target).square().sum().backward()

        try:
            self.say(f"torch loop, training step {count}", milliseconds(plain, 2))
            for name, a, b, c in zip(("W0", "W1", "W2"), mine, penalty, W, strict=True):
                self.say(f"gradient by {name}, relative to the torch loop", relative(a - b, c.grad))
        except torch.OutOfMemoryError as error:
            self.say("torch loop, training step", str(error)[:80])


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
    for part in (run.card, run.values, run.tracking, run.training):
        part()
    print(json.dumps(run.result))


if __name__ == "__main__":
    main()
