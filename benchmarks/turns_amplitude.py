"""Turns of rings at several amplitudes: `python benchmarks/turns_amplitude.py --out FILE`.

A ring without errors is kicked, read turn by turn and diagnosed; whatever is found is a false
alarm, `distributed` too. The rings are the built-in PETRA III and those that accelerator-toolbox
ships. With --fault each ring has one quadrupole that is 0.5 % too strong, and the share whose first
finding is that quadrupole is counted. With --particles the beam has an energy spread of 1e-3 and
decoheres; the network tracks it. Rows are appended to FILE (one JSON object a line), and rows
that FILE holds already are not measured again.

    python benchmarks/turns_amplitude.py --rings petra3 dba --amplitudes 0.001 --seeds 25
"""

import argparse
import json
import logging
import time
import warnings
from pathlib import Path

from healthy import SHIPPED, ring_of
from tables import commit, markdown, of_turns

from tmlattice import diagnose
from tmlattice.effects import Cause
from tmlattice.errors import MeasurementError, TmlatticeError
from tmlattice.machine.stored_beam import simulate_turns

RINGS = ("petra3", *SHIPPED)
AMPLITUDES = (2e-4, 5e-4, 1e-3, 2e-3)
FAULT = 0.005
"""Of a quadrupole's strength."""


def one(ring, fault: float, particles: int, amplitude: float, seed: int) -> dict:
    """What is found in one measurement."""
    quadrupoles = [e.name for e in ring.elements if e.kind == "quadrupole" and e.k1 and e.length]
    place = quadrupoles[(97 * seed + 31) % len(quadrupoles)]
    causes = [Cause("quadrupole_gradient", place, fault)] if fault else []
    row = {"place": place} if fault else {}
    begun = time.process_time()
    try:
        beam = {"particles": particles, "engine": "network"} if particles > 1 else {}
        data = simulate_turns(ring, causes, amplitude=amplitude, seed=seed, **beam).measured
        result = diagnose(ring, data, seed=seed)
        row |= {
            "verdict": result.verdict,
            "found": [[f.effect, f.element, f.amount] for f in result.findings],
            "p_value": result.unexplained["p_value"],
        }
        if fault:
            row["right"] = bool(result.findings) and (
                result.findings[0].element in ring.pieces(place)
            )
    except MeasurementError as error:
        row |= {"verdict": "refused", "error": str(error)}
    except TmlatticeError as error:
        row |= {"verdict": "error", "error": str(error)}
    return row | {"seconds": round(time.process_time() - begun, 2)}


def main() -> None:
    """Measure, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rings", nargs="*", default=list(RINGS))
    parser.add_argument("--amplitudes", nargs="*", type=float, default=list(AMPLITUDES))
    parser.add_argument("--seeds", type=int, default=25)
    parser.add_argument("--fault", action="store_true")
    parser.add_argument("--particles", type=int, default=1)
    parser.add_argument("--out", type=Path, required=True)
    chosen = parser.parse_args()
    logging.getLogger("tmlattice").setLevel(logging.ERROR)
    warnings.simplefilter("ignore")
    there = chosen.out.read_text(encoding="utf-8").splitlines() if chosen.out.is_file() else []
    rows = [json.loads(line) for line in there]
    keys = ("ring", "fault", "particles", "amplitude", "seed")
    done = {tuple(({"particles": 1} | row)[key] for key in keys) for row in rows}
    fault = FAULT if chosen.fault else 0.0
    for name in chosen.rings:
        ring = ring_of(name)
        for amplitude in chosen.amplitudes:
            for seed in range(chosen.seeds):
                case = (name, fault, chosen.particles, amplitude, seed)
                if case in done:
                    continue
                row = (
                    dict(zip(keys, case, strict=True)) | one(ring, *case[1:]) | {"commit": commit()}
                )
                rows.append(row)
                with chosen.out.open("a", encoding="utf-8") as file:
                    file.write(json.dumps(row) + "\n")
                if row["verdict"] != "none":
                    print(json.dumps(row)[:400], flush=True)
    print(markdown(of_turns(rows)))


if __name__ == "__main__":
    main()
