"""A fit of the orbit response of a known machine: `python benchmarks/known_response.py`.

The built-in ring with errors of gradients, gains, calibrations and rolls everywhere, 330 of its
correctors, finite steps, OCELOT's maps as the machine. The table has the rms of
(amount - truth) / stated error for each effect, without held-out correctors, and the beta beating
of the machine with the error of the estimated one. Some three minutes; `--seed N` another machine.
"""

import argparse

import numpy as np

import tmlattice
from tmlattice.effects import apply, background_rms
from tmlattice.machine import draw_background
from tmlattice.machine.response import simulate_response
from tmlattice.network import TaylorNetwork
from tmlattice.optics import twiss

BACKGROUND = {
    "quadrupole_gradient": 2e-3,
    "monitor_gain_x": 1e-2,
    "monitor_gain_y": 1e-2,
    "corrector_calibration": 2e-2,
    "monitor_roll": 5e-3,
    "corrector_roll": 5e-3,
}
CORRECTORS = 330
NOISE = (1.9e-6, 1.2e-6)


def main(seed=1):
    ring = tmlattice.load_ring("petra3")
    names = [e.name for e in ring.elements if e.kind in ("hcorrector", "vcorrector")]
    some = [names[i] for i in np.linspace(0, len(names) - 1, CORRECTORS).round().astype(int)]
    measured = simulate_response(
        ring, background=BACKGROUND, correctors=some, noise=NOISE, engine="ocelot", seed=seed
    ).measured
    found = tmlattice.diagnose(ring, measured, seed=1)
    drawn = draw_background(ring, background_rms(BACKGROUND), seed)
    true = {(cause.effect, cause.element): cause.amount for cause in drawn}
    held = {
        name for name, out in zip(measured.correctors, found.response.held, strict=False) if out
    }
    pulls = {}
    for cause, sigma in zip(found.causes, found.errors, strict=True):
        at = (cause.effect, cause.element)
        if at in true and cause.element not in held:
            pulls.setdefault(cause.effect, []).append((cause.amount - true[at]) / sigma)
    print("| quantity | number | result |\n|---|---|---|")
    for effect, own in pulls.items():
        print(f"| `{effect}` | {len(own)} | pulls of {np.sqrt(np.mean(np.square(own))):.2f} rms |")
    faulty = apply(ring, [c for c in drawn if c.effect == "quadrupole_gradient"])
    beta, expected, design = (
        twiss(TaylorNetwork.from_ring(one)).beta for one in (found.corrected, faulty, ring)
    )
    for plane, name in enumerate("xy"):
        beat, left = (
            100 * np.std(one[:, plane] / other[:, plane] - 1)
            for one, other in ((expected, design), (beta, expected))
        )
        print(f"| beta beating in {name}, rms | {len(beta)} | {beat:.2f} %, estimated with an "
              f"error of {left:.3f} % |")  # fmt: skip


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seed", type=int, default=1)
    main(parser.parse_args().seed)
