"""Machines whose first turn is lost, steered until the beam circulates; AT is the machine.

`python benchmarks/threading_beam.py LATTICE [--cases 20] [--offset 3e-3] [--out FILE.jsonl]`

Each machine has all usual errors of the catalogue, and quadrupoles displaced by `--offset` rms, m.
Machines whose beam completes the first turn are not counted. Six shots are read as far as the beam
gets, diagnosed, and corrected with the target `first_turn`; then again from the estimated ring,
`--rounds` times at most.
The oracle knows all errors. A beam circulates if it is launched on the axis and read on 20 turns.
"""

import argparse
import json
import logging
import warnings
from pathlib import Path

import numpy as np

from tmlattice import correct, diagnose, load_ring
from tmlattice.correction.estimate import estimate_of
from tmlattice.effects import Cause, RingEffect, apply, background_rms, find
from tmlattice.errors import TmlatticeError
from tmlattice.machine.at_engine import AtEngine
from tmlattice.machine.shots import draw_background
from tmlattice.machine.simulate import simulate

TURNS = 20
TARGET = ["first_turn"]


def turns(ring, causes):
    """Turns that a beam on the axis completes."""
    readings = AtEngine(ring, causes).track(np.zeros((1, 6)), TURNS)[0]
    alive = np.isfinite(readings).all(axis=-1).ravel()
    return TURNS * float(np.mean(np.cumsum(~alive) == 0))


def set_to(ring, correction):
    """The ring with the new settings of its correctors."""
    return apply(ring, [Cause(f"corrector_kick_{'xy'['h' not in s.knob.kind[0]]}", s.knob.name,
                              s.new - s.knob.present) for s in correction.settings])  # fmt: skip


def case(ring, seed, options):
    """Turns before, by the oracle, and after each round; None: the first turn is completed."""
    usual = background_rms({"all": None})
    usual |= {f"quadrupole_offset_{plane}": options.offset for plane in "xy"}
    causes = draw_background(ring, usual, seed)
    on_ring = [c for c in causes if isinstance(find(c.effect), RingEffect)]
    before = turns(ring, on_ring)
    if before >= 1:
        return None
    best = correct(apply(ring, on_ring), goal=ring, targets=TARGET)
    found = {"seed": seed, "before": before, "rounds": [],
             "oracle": turns(set_to(ring, best), on_ring)}  # fmt: skip
    now = model = ring  # with the kicks that were set; and with the errors that were estimated
    for shift in range(options.rounds):
        try:
            data = simulate(now, causes, seed=1000 * seed + shift).measurement()
            estimate = estimate_of(diagnose(model, data))
            own = correct(estimate, goal=ring, targets=TARGET)
            now, model = set_to(now, own), set_to(estimate.ring, own)
        except TmlatticeError as error:
            found["stopped"] = str(error)
            break
        found["rounds"].append(turns(now, on_ring))
        if found["rounds"][-1] >= TURNS:
            break
    return found


def summary(rows):
    """Print how many circulate."""
    for who, ends in (
        ("oracle", [row["oracle"] for row in rows]),
        ("tmlattice", [max(row["rounds"], default=0) for row in rows]),
        ("tmlattice, one round", [(row["rounds"] or [0])[0] for row in rows]),
    ):
        print(f"{who}: {sum(end >= TURNS for end in ends)} of {len(rows)} circulate")


def main() -> None:
    """Measure, and print the summary."""
    arguments = argparse.ArgumentParser()
    arguments.add_argument("lattice")
    arguments.add_argument("--cases", type=int, default=20)
    arguments.add_argument("--offset", type=float, default=3e-3)
    arguments.add_argument("--rounds", type=int, default=3)
    arguments.add_argument("--out", type=Path)
    options = arguments.parse_args()
    warnings.simplefilter("ignore")
    logging.disable(logging.WARNING)
    ring, rows = load_ring(options.lattice), []
    for seed in range(options.cases):
        row = case(ring, seed, options)
        if row is None:
            continue
        rows.append(row)
        print(row, flush=True)
        if options.out:
            with options.out.open("a") as file:
                file.write(json.dumps(row) + "\n")
    summary(rows)


if __name__ == "__main__":
    main()
