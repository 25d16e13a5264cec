"""Whether stated errors hold: `python benchmarks/stated_errors.py [--seeds 4] [--out FILE]`.

Orbit responses of small rings with usual errors, AT as the machine. One quadrupole, at random,
has an error of 3 % where the others of its family scatter by 0.1 %. For every fitted number of the
hierarchical fit with a known truth the pull is (amount - truth) / stated error. The JSON has, for
each ring, the rms pull of all numbers, of those that the data determine and of the others, the
pulls of the faulty quadrupole, and the largest pulls. Errors that make a closed orbit are left out,
for a machine corrects it; `--orbit` has them too: of the gradients that an orbit of millimetres
makes in sextupoles the hierarchical fit has no model.

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
    row = pulls(found, causes)
    return {
        "ring": case.name, "seed": seed, "faulty": faulty, "verdict": found.verdict,
        "findings": [f"{f.effect} {f.element}" for f in found.findings],
        "seconds": time.process_time() - begun, "numbers": row,
    }  # fmt: skip


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


def rms(values: list[float]) -> float | None:
    return float(np.sqrt(np.mean(np.square(values)))) if values else None


def summary(rows: list[dict]) -> dict:
    """Over the machines of one ring."""
    numbers = [own for row in rows for own in row["numbers"]]
    faulty = [
        own for row in rows for own in row["numbers"]
        if own["element"] == row["faulty"] and own["effect"] == "quadrupole_gradient"
    ]  # fmt: skip
    gradients = [own for own in numbers if own["effect"] == "quadrupole_gradient"]

    def of(some: list[dict], clear: bool | None = None) -> float | None:
        return rms([
            own["pull"] for own in some
            if clear is None or (own.get("share_from_data", 1.0) >= 0.5) == clear
        ])  # fmt: skip

    return {
        "machines": len(rows),
        "numbers": len(numbers),
        "rms_pull": of(numbers),
        "rms_pull_determined": of(numbers, True),
        "rms_pull_not_determined": of(numbers, False),
        "rms_pull_gradients": of(gradients),
        "rms_pull_by_effect": {
            name: of([own for own in numbers if own["effect"] == name])
            for name in dict.fromkeys(own["effect"] for own in numbers)
        },
        "faulty": [
            {key: own.get(key) for key in
             ("element", "truth", "amount", "amount_sigma", "share_from_data", "pull")}
            for own in faulty
        ],
        "largest_pull": max((abs(own["pull"]) for own in numbers), default=None),
        "largest_pulls": [
            {key: own.get(key) for key in ("effect", "element", "truth", "amount", "amount_sigma",
                                           "share_from_data", "pull")}
            for own in sorted(numbers, key=lambda own: -abs(own["pull"]))[:5]
        ],
        "seconds": float(np.median([row["seconds"] for row in rows])),
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*")
    parser.add_argument("--seeds", type=int, default=4)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--orbit", action="store_true")
    parser.add_argument("--out", type=Path)
    chosen = parser.parse_args()
    logging.getLogger("tmlattice").setLevel(logging.ERROR)
    warnings.simplefilter("ignore")
    found = {}
    for case in cases():
        if chosen.names and case.name not in chosen.names:
            continue
        seeds = range(chosen.first, chosen.first + chosen.seeds)
        rows = [study(case, seed, chosen.orbit) for seed in seeds]
        found[case.name] = summary(rows) | {
            "verdicts": [row["verdict"] for row in rows],
            "findings": [row["findings"] for row in rows],
        }
        print(case.name, json.dumps(found[case.name]), flush=True)
        if chosen.out:
            chosen.out.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
