"""How many of several faults are named: `python benchmarks/several_faults.py LATTICE`.

Faults of kinds that eight first turns see well are drawn on a ring without small errors, AT as the
machine. It prints those named with their effect and element, all findings, and processor seconds.
The ring of the tests, seeds 10 to 13, default options:

    faults  named as they are   findings   seconds a case
         4           14 of 16         17               10
         6           21 of 24         24               19
         8           21 of 32         25               22

Missed ones are named as what does the same there (a quadrupole's offset as two kicks), but for one
case of eight, named as one fault and large distributed errors. Where three faults alone were
sought before distributed errors, 4 of 16 and 8 of 24 were named.
"""

import argparse
import time

import numpy as np

from tmlattice import Cause, Ring, diagnose, load_ring, simulate
from tmlattice.effects import find

SIZES = {
    "quadrupole_gradient": 0.05, "quadrupole_roll": 0.02,
    "corrector_kick_x": 1e-4, "corrector_kick_y": 1e-4,
    "monitor_gain_x": 0.3, "monitor_gain_y": 0.3,
    "monitor_offset_x": 1e-3, "monitor_offset_y": 1e-3,
    "dipole_field": 1e-3, "dipole_roll": 3e-3,
    "sextupole_offset_x": 2e-3, "sextupole_offset_y": 2e-3,
    "quadrupole_offset_x": 1e-3, "quadrupole_offset_y": 1e-3,
}  # fmt: skip
"""Amounts are drawn between a half and three halves of these, of both signs."""


def drawn(ring: Ring, number: int, rng: np.random.Generator) -> list[Cause]:
    """Faults at as many different elements."""
    faults: dict[str | None, Cause] = {}
    while len(faults) < number:
        name = list(SIZES)[rng.integers(len(SIZES))]
        places = find(name).places(ring)
        place = places[rng.integers(len(places))]
        if place not in faults:
            amount = SIZES[name] * rng.choice([-1, 1]) * rng.uniform(0.5, 1.5)
            faults[place] = Cause(name, place, float(amount))
    return list(faults.values())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("lattice")
    parser.add_argument("--faults", type=int, nargs="+", default=[4, 6, 8])
    parser.add_argument("--cases", type=int, default=4)
    parser.add_argument("--seed", type=int, default=10)
    options = parser.parse_args()
    ring = load_ring(options.lattice)
    for number in options.faults:
        named = findings = 0
        begun = time.process_time()
        for seed in range(options.seed, options.seed + options.cases):
            faults = drawn(ring, number, np.random.default_rng(seed))
            found = diagnose(ring, simulate(ring, faults, shots=8, seed=seed).measurement())
            own = {(f.effect, f.element) for f in found.findings}
            hit = sum((fault.effect, fault.element) in own for fault in faults)
            print(f"{number} faults, seed {seed}: {found.verdict}, {hit} of {number}", flush=True)
            named, findings = named + hit, findings + len(found.findings)
        seconds = (time.process_time() - begun) / options.cases
        of = number * options.cases
        print(
            f"{number} faults: {named} of {of} named, {findings} findings, {seconds:.0f} s a case"
        )


if __name__ == "__main__":
    main()
