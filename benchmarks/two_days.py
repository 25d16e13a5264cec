"""What changed between two days of a known machine: `python benchmarks/two_days.py RING ...`.

RING is a lattice file, a built-in name, or a file of AT's `machine_data`. The machine has errors of
gradients, gains, kicks and rolls, the same ones on both days, and AT tracks it; its changes are
drawn as those of measured rings are (`pairs.py`). It prints what was found of them, what else
was named, and by how many of their stated errors the amounts are off. `--cases N` that many of each
ring, `--few` with one supply and one magnet, `--null` with no change.
"""

import argparse
import time
from pathlib import Path

import machine_data
import numpy as np
import pairs

import tmlattice
from tmlattice.machine.response import simulate_response

BACKGROUND = {
    "quadrupole_gradient": 2e-3,
    "monitor_gain_x": 0.02,
    "monitor_gain_y": 0.02,
    "corrector_calibration": 0.03,
    "monitor_roll": 3e-3,
}
KICK, NOISE, RF_STEP = 3e-5, 2e-7, -500.0
"""rad, m, Hz."""


def loaded(name):
    """The ring, wherever it is."""
    shipped = Path(machine_data.__file__).parent / name
    return tmlattice.load_ring(str(shipped) if shipped.exists() else name)


def day(ring, causes, machine, seed):
    """The machine of a number, changed, as it is measured on one day."""
    return simulate_response(
        ring, causes, kick=KICK, noise=NOISE, rf_step=RF_STEP, background=BACKGROUND,
        machine_seed=machine, seed=seed, progress=False,
    ).measured  # fmt: skip


def case(ring, number, null):
    """Changes of one number, and the diagnosis."""
    changes = pairs.drawn(ring, np.random.default_rng(number), null)
    before = day(ring, [], number, 1)
    after = day(ring, pairs.causes_of(changes), number, 2)
    return changes, tmlattice.diagnose(ring, after, reference=before)


def main():
    """Each ring, case by case."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("rings", nargs="+")
    parser.add_argument("--cases", type=int, default=5)
    parser.add_argument("--few", action="store_true")
    parser.add_argument("--null", action="store_true")
    options = parser.parse_args()
    if options.few:
        pairs.SUPPLIES = pairs.SINGLE = 1
    for name in options.rings:
        ring, every, count = loaded(name), [], np.zeros(3, dtype=int)
        for number in range(options.cases):
            begun = time.process_time()
            changes, result = case(ring, number, options.null)
            spent = time.process_time() - begun
            counts, pulls = pairs.weighed(name, number, ring, result, changes, spent)
            every += pulls
            count += counts
        print(f"| {name} | {count[0]} of {count[1]} | {count[2]} | {pairs.rms(every):.2f} |")


if __name__ == "__main__":
    main()
