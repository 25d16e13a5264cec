"""Turns of healthy rings at several amplitudes: `python benchmarks/turns_amplitude.py --out FILE`.

A faultless ring is kicked, read turn by turn and diagnosed; whatever is found is a false alarm, and
DISTRIBUTED is one too, for the ring has no errors. The rings are the built-in PETRA III and those
that accelerator-toolbox ships. With --fault each ring has one quadrupole that is 0.5 % too strong,
and the share that is named is counted; with --lines only chi-square of the lines is, in a tenth of
the time. Results are stored after each ring and amplitude (JSON), and continued where FILE has
some; seconds are those of this process.

    python benchmarks/turns_amplitude.py --rings petra3 dba.mat --amplitudes 0.001 --seeds 25
"""

import argparse
import json
import logging
import time
import warnings
from pathlib import Path

import machine_data
import numpy as np

from tmlattice import diagnose, load_ring
from tmlattice.effects import Cause
from tmlattice.errors import MeasurementError, TmlatticeError
from tmlattice.inference.newton import fit
from tmlattice.machine.stored_beam import simulate_turns
from tmlattice.observe.turn_by_turn import many_turns

RINGS = {
    "petra3": {},
    "dba.mat": {"monitors": "M,DR_03*", "correctors": "DR_04,SF"},
    "thomx.m": {},
    "australian_synchrotron.m": {},
    "soleil.m": {},
    "esrf.m": {"correctors": "S4,S6,S13,S19,S20,S22,S24"},
    "hmba.mat": {"correctors": "SH*"},
}
AMPLITUDES = (2e-4, 5e-4, 1e-3, 2e-3)
FAULT = 0.005
"""Of a quadrupole's strength."""


def ring_of(name):
    return load_ring(name if name == "petra3" else Path(machine_data.__file__).parent / name,
                     **RINGS[name])  # fmt: skip


def one(ring, amplitude: float, seed: int, faulty: bool, only_lines: bool) -> dict:
    """What is found in one measurement."""
    quadrupoles = [e.name for e in ring.elements if e.kind == "quadrupole" and e.k1 and e.length]
    place = quadrupoles[(97 * seed + 31) % len(quadrupoles)]
    causes = [Cause("quadrupole_gradient", place, FAULT)] if faulty else []
    begun = time.process_time()
    row = {"seed": seed, "place": place if faulty else None}
    try:
        data = simulate_turns(ring, causes, amplitude=amplitude, seed=seed).measured
        if only_lines:
            problem = many_turns(ring, data, {})
            found = fit(problem, (), problem.first)
            row |= {"verdict": "lines", "chi2": found.point.chi2, "freedom": problem.freedom}
        else:
            result = diagnose(ring, data, seed=seed)
            elements = [finding.element for finding in result.findings]
            row |= {
                "verdict": result.verdict,
                "found": [[f.effect, f.element, f.amount] for f in result.findings],
                "p_value": result.unexplained["p_value"],
                "right": bool(elements) and elements[0] in ring.pieces(place),
            }
    except MeasurementError as error:
        row |= {"verdict": "refused", "error": str(error)}
    except TmlatticeError as error:
        row |= {"verdict": "error", "error": str(error)}
    return row | {"seconds": time.process_time() - begun}


def counted(rows: list[dict], faulty: bool) -> dict:
    """Of the rows of one ring and amplitude."""
    verdicts = [row["verdict"] for row in rows]
    own = {"cases": len(rows), "refused": verdicts.count("refused")}
    if "lines" in verdicts:
        ratio = [row["chi2"] / row["freedom"] for row in rows if "chi2" in row]
        off = [(row["chi2"] - row["freedom"]) / np.sqrt(2 * row["freedom"]) for row in rows
               if "chi2" in row]  # fmt: skip
        return own | {"chi2_per_dof": float(np.mean(ratio)), "largest_z": float(np.max(off))}
    if faulty:
        return own | {"right": sum(row.get("right", False) for row in rows)}
    return own | {"false_alarms": sum(v not in ("none", "refused") for v in verdicts)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rings", nargs="*", default=list(RINGS))
    parser.add_argument("--amplitudes", nargs="*", type=float, default=list(AMPLITUDES))
    parser.add_argument("--seeds", type=int, default=25)
    parser.add_argument("--fault", action="store_true")
    parser.add_argument("--lines", action="store_true")
    parser.add_argument("--out", type=Path)
    chosen = parser.parse_args()
    logging.getLogger("tmlattice").setLevel(logging.ERROR)
    warnings.simplefilter("ignore")
    known = json.loads(chosen.out.read_text()) if chosen.out and chosen.out.is_file() else {}
    for name in chosen.rings:
        ring = ring_of(name)
        for amplitude in chosen.amplitudes:
            kind = "lines" if chosen.lines else "fault" if chosen.fault else "healthy"
            own = known.setdefault(f"{kind} {name} {amplitude:g}", {"rows": []})
            there = {row["seed"] for row in own["rows"]}
            for seed in range(chosen.seeds):
                if seed not in there:
                    own["rows"].append(one(ring, amplitude, seed, chosen.fault, chosen.lines))
            own["summary"] = counted(own["rows"], chosen.fault)
            print(f"{kind} {name} {1e3 * amplitude:g} mm: {own['summary']}", flush=True)
            if chosen.out:
                chosen.out.write_text(json.dumps(known, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
