"""Machines with distributed errors and no fault, default options: how often is one found?

`python benchmarks/small_errors.py LATTICE [--cases 100] [--scale 1] [--seed 0] [--shots 6]`

Each case is a machine of its own, with the catalogue's usual errors times the scale. It prints
the false alarms, the verdicts, the ratios of the learnt sizes to the drawn ones, whether the
held-out readings have the expected residual, and the seconds of a case.
"""

import argparse
import time
from collections import Counter

import numpy as np

from tmlattice.diagnosis import diagnose
from tmlattice.effects import CATALOGUE
from tmlattice.lattice import load_ring
from tmlattice.machine import simulate


def main() -> None:
    """Print the table."""
    arguments = argparse.ArgumentParser()
    arguments.add_argument("lattice")
    arguments.add_argument("--cases", type=int, default=100)
    arguments.add_argument("--scale", type=float, default=1.0)
    arguments.add_argument("--seed", type=int, default=0)
    arguments.add_argument("--shots", type=int, default=6)
    given = arguments.parse_args()
    ring = load_ring(given.lattice)
    verdicts: Counter[str] = Counter()
    alarms, chi2, ratios, seconds = [], [], [], []
    pulls: dict[str, list[float]] = {}
    for case in range(given.cases):
        seed = 10_000 * given.seed + case
        machine = simulate(ring, [], background={"all": given.scale}, shots=given.shots, seed=seed)
        begun = time.process_time()
        found = diagnose(ring, machine.measurement())
        seconds.append(time.process_time() - begun)
        verdicts[found.verdict] += 1
        if found.findings:
            alarms.append((seed, [(f.effect, f.element) for f in found.findings]))
        last = found.heldout.misfits[-1]
        chi2.append(last.chi2_per_dof)
        ratios.append(last.rms**2 / last.expected**2)
        for name, error in found.prior_errors.items():
            drawn = given.scale * CATALOGUE[name].background
            pulls.setdefault(name, []).append(np.log(found.priors[name] / drawn) / error)
    print(f"{given.lattice}: {given.cases} machines, errors {given.scale:g} times the usual ones")
    print(f"false alarms {len(alarms)}: {alarms}")
    print(f"verdicts {dict(verdicts)}; {np.median(seconds):.2f} s in the median")
    print(f"held out: chi2 per reading {np.mean(chi2):.3f}, "
          f"square over the expected one {np.mean(ratios):.3f}")  # fmt: skip
    for name, values in pulls.items():
        print(f"  {name:24s} pull {np.mean(values):+.2f}, width {np.std(values):.2f}")


if __name__ == "__main__":
    main()
