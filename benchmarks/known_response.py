"""How well an orbit response tells a machine that is known: `python benchmarks/known_response.py`.

The built-in ring with gradients, gains, calibrations and rolls wrong everywhere, 330 of its
correctors, finite steps, OCELOT's maps as the machine: only the fit is judged, and not the maps.
Written out: held-out rms step by step; of each effect the error over the stated one (held-out
correctors left out, nobody fitted them); the beta beat's error. Some three minutes.
"""

import sys

import numpy as np

import tmlattice
from tmlattice.effects import apply, background_rms
from tmlattice.machine import draw_background
from tmlattice.machine.response import simulate_response
from tmlattice.network import TaylorNetwork
from tmlattice.optics import twiss
from tmlattice.report.plain import report_text

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
    print(report_text(found))
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
    print()
    for effect, own in pulls.items():
        size = np.sqrt(np.mean(np.square(own)))
        print(f"{effect}: {len(own)}, rms error over the stated one {size:.2f}")
    sick = apply(ring, [c for c in drawn if c.effect == "quadrupole_gradient"])
    beta, expected, design = (
        twiss(TaylorNetwork.from_ring(one)).beta for one in (found.corrected, sick, ring)
    )
    for plane, name in enumerate("xy"):
        beat, left = (
            100 * np.std(one[:, plane] / other[:, plane] - 1)
            for one, other in ((expected, design), (beta, expected))
        )
        print(f"beta beat in {name}: {beat:.2f} % rms, known to {left:.3f} %")
    print(f"{found.provenance['seconds']:.0f} s")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
