"""What the default range of a supply costs: the expected gain with it and without limits.

`python benchmarks/supply_range.py LATTICE [LATTICE ...] [--size 0.2] [--out FILE.jsonl]`

In each ring four quadrupoles, evenly spaced, are wrong by `--size`, one at a time, and corrected by
all supplies towards the design.
"""

import argparse
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
from tables import commit

from tmlattice import correct, load_ring
from tmlattice.correction import default_knobs
from tmlattice.effects import Cause, apply
from tmlattice.errors import TmlatticeError

FREE = 1e3
"""Limit of a setting, in units of the present one, that is never reached."""
MAGNETS = 4


def case(ring, machine):
    """The gain, and the supply of the largest relative change; with the range, and without one."""
    knobs = default_knobs(ring, ["supplies", "skew_quadrupoles"])
    free = [replace(k, low=-FREE * abs(k.present), high=FREE * abs(k.present))
            if k.kind == "quadrupole" else k for k in knobs]  # fmt: skip
    found = {}
    for name, own in (("range", knobs), ("free", free)):
        done = correct(machine, goal=ring, knobs=own)
        supplies = [s for s in done.settings if s.knob.kind == "quadrupole"]
        most = max(supplies, key=lambda s: abs(s.amount), default=None)
        found[name] = {
            "gain": round(done.gain, 4), "at_limit": sum(s.at_limit for s in supplies),
            "supply": most and most.knob.name, "change": most and round(most.amount, 4),
            "its_gain": most and round(most.gain, 4),
        }  # fmt: skip
    return found


def main() -> None:
    """Measure, print and store."""
    arguments = argparse.ArgumentParser()
    arguments.add_argument("lattices", nargs="+")
    arguments.add_argument("--size", type=float, default=0.2)
    arguments.add_argument("--out", type=Path)
    options = arguments.parse_args()
    for lattice in options.lattices:
        ring, path = load_ring(lattice), Path(lattice)
        name = path.absolute().parent.name if path.stem == "lattice" else path.stem
        magnets = [e.name for e in ring.elements if e.kind == "quadrupole" and e.k1]
        for k in np.linspace(0, len(magnets), MAGNETS, endpoint=False).astype(int):
            machine = apply(ring, [Cause("quadrupole_gradient", magnets[k], options.size)])
            row = {"ring": name, "magnet": magnets[k], "size": options.size, "commit": commit()}
            try:
                row |= case(ring, machine)
            except TmlatticeError as error:
                row["refused"] = str(error)
            print(row, flush=True)
            if options.out:
                with options.out.open("a") as file:
                    file.write(json.dumps(row) + "\n")


if __name__ == "__main__":
    main()
