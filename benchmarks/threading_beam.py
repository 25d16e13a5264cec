"""Machines whose first turn is lost, steered until the beam circulates; AT is the machine.

`python benchmarks/threading_beam.py LATTICE [--machines 50] [--offset 2e-3] [--first-seed 0]
[--out FILE.jsonl]`

Each machine has all usual errors of the catalogue, and quadrupoles displaced by `--offset` rms, m.
Machines whose beam completes the first turn are not counted. Six shots of two turns are read as far
as the beam gets, and corrected with the target `first_turn`; then again with the posterior of all
rounds before, `--rounds` times at most. Where the readings are refused, the machine is measured
again, as a round.
The oracle knows all errors of the ring. A beam circulates if it is launched on the axis and read on
20 turns. Machines that FILE has already are not measured again.
"""

import argparse
import json
import logging
import time
import warnings
from pathlib import Path

import numpy as np
from tables import commit

from tmlattice import correct, load_ring
from tmlattice.correction.first_turn import estimate_of_turns
from tmlattice.effects import RingEffect, apply, background_rms, find
from tmlattice.errors import TmlatticeError
from tmlattice.machine.at_engine import AtEngine
from tmlattice.machine.shots import draw_background
from tmlattice.machine.simulate import simulate

TURNS, SHOTS = 20, 6
TARGET = ["first_turn"]
TRIED = 20
"""Seeds for each machine that is asked for: where no beam is lost the study ends."""


def turns(ring, causes, kicks):
    """Turns that a beam on the axis completes with these kicks of the correctors."""
    readings = AtEngine(ring, causes).track(np.zeros((1, 6)), TURNS, [settings(kicks)])[0]
    alive = np.isfinite(readings).all(axis=-1).ravel()
    return TURNS * float(np.mean(np.cumsum(~alive) == 0))


def settings(kicks):
    """Of a shot."""
    return {name: {"kick": kick} for name, kick in kicks.items()}


def changes(correction):
    """Change of each corrector's kick, rad."""
    return {s.knob.name: s.new - s.knob.present for s in correction.settings}


def case(ring, seed, options):
    """Turns before, by the oracle, and after each round; None: the first turn is completed."""
    usual = background_rms({"all": None})
    usual |= {f"quadrupole_offset_{plane}": options.offset for plane in "xy"}
    causes = draw_background(ring, usual, seed)
    on_ring = [c for c in causes if isinstance(find(c.effect), RingEffect)]
    before = turns(ring, on_ring, {})
    if before >= 1:
        return None
    best = changes(correct(apply(ring, on_ring), goal=ring, targets=TARGET))
    found = {"seed": seed, "before": round(before, 3), "rounds": [],
             "oracle": turns(ring, on_ring, best)}  # fmt: skip
    kicks, estimate = dict[str, float](), None
    for number in range(options.rounds):
        data = simulate(ring, causes, settings=[settings(kicks)] * SHOTS, shots=SHOTS, turns=2,
                        seed=1000 * seed + number).measurement()  # fmt: skip
        try:
            estimate = estimate_of_turns(ring, [data], estimate and estimate.known)
            own = correct(estimate, targets=TARGET)
        except TmlatticeError as error:
            found.setdefault("refused", {})[number] = str(error)
            continue  # and measure again
        kicks |= {s.knob.name: s.new for s in own.settings}
        found["rounds"].append(round(turns(ring, on_ring, kicks), 3))
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
    arguments.add_argument("lattice", type=Path)
    arguments.add_argument("--machines", type=int, default=50)
    arguments.add_argument("--offset", type=float, default=2e-3)
    arguments.add_argument("--rounds", type=int, default=8)
    arguments.add_argument("--first-seed", type=int, default=0)
    arguments.add_argument("--out", type=Path)
    options = arguments.parse_args()
    warnings.simplefilter("ignore")
    logging.disable(logging.WARNING)
    ring, rows = load_ring(options.lattice), []
    name = options.lattice.absolute()
    study = {"ring": name.parent.name if name.stem == "lattice" else name.stem,
             "offset": options.offset}  # fmt: skip
    if options.out and options.out.is_file():
        rows = [json.loads(line) for line in options.out.read_text().splitlines()]
        rows = [row for row in rows if study.items() <= row.items()]
    seed = max((row["seed"] for row in rows), default=options.first_seed - 1)
    last = options.first_seed + TRIED * options.machines
    while len(rows) < options.machines and seed < last:
        seed += 1
        begun = time.process_time()
        row = case(ring, seed, options)
        if row is None:
            continue
        row = {**study, **row, "seconds": round(time.process_time() - begun, 1),
               "commit": commit()}  # fmt: skip
        rows.append(row)
        print(row, flush=True)
        if options.out:
            with options.out.open("a") as file:
                file.write(json.dumps(row) + "\n")
    summary(rows)


if __name__ == "__main__":
    main()
