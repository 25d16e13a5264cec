"""Whether stated errors hold: `python benchmarks/stated_errors.py --out FILE [--seeds 4]`.

Orbit responses of small rings with usual errors, AT as the machine. One quadrupole, at random,
has an error of 3 % where the others of its family scatter by 0.1 %. For every fitted number of the
hierarchical fit with a known truth the pull is (amount - truth) / stated error. A row of FILE (one
JSON object a line, a machine each) has all pulls by effect, each with its share from the data, the
faulty quadrupole's number, and the largest pulls; rows that FILE holds already are not measured
again. Errors that make a closed orbit are left out, for a machine corrects it; `--orbit` has them
too, uncorrected.

Rings come from the tests, from accelerator-toolbox, and from TMLATTICE_DATA if it is there.
"""

import argparse
import json
import logging
import os
import time
import warnings
from dataclasses import dataclass, field
from pathlib import Path

import machine_data
import numpy as np
from tables import markdown, of_stated_errors

from tmlattice import Cause, Ring, diagnose, load_ring
from tmlattice.diagnosis import Diagnosis
from tmlattice.effects import background_rms
from tmlattice.lattice.supplies import magnets
from tmlattice.machine import draw_background
from tmlattice.machine.response import rf_step_of, simulate_response

FAULT = 0.03
KICK, NOISE, RF = 2e-5, 4e-7, 0.1
"""rad, m, and a share of the usual RF step: steps that are linear, and BPMs of light sources."""
ORBIT = ("dipole", "quadrupole_offset", "sextupole_offset")
"""Errors that make a closed orbit, which a machine corrects: their effects begin so."""


@dataclass(frozen=True)
class Case:
    """A ring and how it is read."""

    name: str
    path: Path
    options: dict = field(default_factory=dict)


def cases() -> list[Case]:
    """Five small rings, those whose files are there."""
    at = Path(machine_data.__file__).parent
    decks = Path(os.environ.get("TMLATTICE_DATA", "nowhere")) / "public_decks"
    elena = {"monitors": "lnr.vv*,lnr.btv*,lnr.mmid*,lne.mar*"}
    rings = [
        Case("small", Path(__file__).parents[1] / "tests/lattices/small_ring.py"),
        Case("thomx", at / "thomx.m"),
        Case("dba", at / "dba.mat", {"monitors": "M,DR_03*", "correctors": "DR_04,SF"}),
        Case("elena", decks / "elena_m.madx", elena),
        Case("psb", decks / "psb_m.madx"),
    ]
    return [case for case in rings if case.path.is_file()]


def machine(ring: Ring, seed: int, orbit: bool = False) -> tuple[list[Cause], str]:
    """Usual errors with one faulty quadrupole, and its name."""
    sizes = background_rms({"all": None})
    if not orbit:
        sizes = {name: size for name, size in sizes.items() if not name.startswith(ORBIT)}
    rng = np.random.default_rng([seed, 47])
    powered = magnets(ring, ("quadrupole",), powered=True)
    faulty = powered[rng.integers(len(powered))]
    names = {piece.name for piece in faulty}
    of = {piece.name: own[0].name for own in powered for piece in own}
    drawn = draw_background(ring, sizes, seed)
    gradient = {c.element: c.amount for c in drawn if c.effect == "quadrupole_gradient"}
    sign = rng.choice([-1.0, 1.0])
    causes = []
    for cause in drawn:
        if cause.effect == "quadrupole_gradient" and cause.element in of:
            amount = sign * FAULT if cause.element in names else gradient[of[cause.element]]
            causes.append(Cause(cause.effect, cause.element, float(amount)))
        elif cause.effect != "quadrupole_gradient":
            causes.append(cause)
    return causes, faulty[0].name


def study(case: Case, seed: int, orbit: bool) -> dict:
    """The pulls of one machine."""
    ring = load_ring(case.path, **case.options)
    causes, faulty = machine(ring, seed, orbit)
    step = RF * rf_step_of(ring)
    measured = simulate_response(
        ring, causes, kick=KICK, rf_step=step, noise=NOISE, seed=seed, progress=False
    ).measured
    begun = time.process_time()
    found = diagnose(ring, measured, seed=seed)
    numbers = pulls(found, causes)
    by_effect: dict[str, list] = {}
    for own in numbers:
        pair = [round(own["pull"], 3), round(own.get("share_from_data", 1.0), 3)]
        by_effect.setdefault(own["effect"], []).append(pair)
    largest = sorted(numbers, key=lambda own: -abs(own["pull"]))[:3]
    gradients = [own for own in numbers if own["effect"] == "quadrupole_gradient"]
    return {
        "ring": case.name, "orbit": orbit, "seed": seed, "verdict": found.verdict,
        "findings": [f"{f.effect} {f.element}" for f in found.findings],
        "faulty": [short(own) for own in gradients if own["element"] == faulty],
        "largest": [short(own) for own in largest], "pulls": by_effect,
        "seconds": round(time.process_time() - begun, 1),
    }  # fmt: skip


def short(own: dict) -> dict:
    """A number's entries that a reader needs."""
    keys = ("effect", "element", "truth", "amount", "amount_sigma", "share_from_data", "pull")
    return {key: own.get(key) for key in keys}


def pulls(found: Diagnosis, causes: list[Cause]) -> list[dict]:
    """Of every number that was fitted (held-out correctors are not) and whose truth is known."""
    true = {(cause.effect, cause.element): cause.amount for cause in causes}
    heldout = {
        name for name, out in zip(found.response.measured.correctors, found.response.held,
                                  strict=False) if out
    }  # fmt: skip
    rows = []
    for own in found.as_json()["errors"]:
        at = own["effect"], own["element"]
        if at in true and own["amount_sigma"] > 0 and own["element"] not in heldout:
            pull = (own["amount"] - true[at]) / own["amount_sigma"]
            rows.append({**own, "truth": true[at], "pull": pull})
    return rows


def main() -> None:
    """Measure, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*")
    parser.add_argument("--seeds", type=int, default=4)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--orbit", action="store_true")
    parser.add_argument("--out", type=Path, required=True)
    chosen = parser.parse_args()
    logging.getLogger("tmlattice").setLevel(logging.ERROR)
    warnings.simplefilter("ignore")
    there = chosen.out.read_text(encoding="utf-8").splitlines() if chosen.out.is_file() else []
    rows = [json.loads(line) for line in there]
    done = {(row["ring"], row["orbit"], row["seed"]) for row in rows}
    for case in cases():
        if chosen.names and case.name not in chosen.names:
            continue
        for seed in range(chosen.first, chosen.first + chosen.seeds):
            if (case.name, chosen.orbit, seed) in done:
                continue
            row = study(case, seed, chosen.orbit)
            rows.append(row)
            with chosen.out.open("a", encoding="utf-8") as file:
                file.write(json.dumps(row) + "\n")
            print(json.dumps({key: row[key] for key in row if key != "pulls"}), flush=True)
    print(markdown(of_stated_errors(rows)))


if __name__ == "__main__":
    main()
