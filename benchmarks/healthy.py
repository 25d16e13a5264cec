"""False alarms on healthy rings: `python benchmarks/healthy.py --out FILE [--rings NAME ...]`.

Each machine has no error at all (`none`), or the catalogue's usual errors everywhere (`usual`),
and no fault. AT measures it as four kinds: first turns; turns of a stored beam; closed orbit,
dispersion and tunes together; an orbit response. Each measurement is diagnosed with default
options. A false alarm is a finding of any kind; DISTRIBUTED on a machine without any error is one
as well.

The rings are the built-in one, the tests' small ring, those that accelerator-toolbox ships, and
with TMLATTICE_DATA public decks and the lattices of measured rings. A machine whose errors leave no
beam has no measurement and is not counted. Rows are appended to FILE (one JSON object a line), and
rows that FILE holds already are not measured again.

    python benchmarks/healthy.py --rings small thomx --seeds 0 1 2 --out healthy.jsonl
"""

import argparse
import json
import logging
import os
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
from pathlib import Path

import machine_data
from tables import false_alarm, markdown, of_healthy

from tmlattice import diagnose, load_ring, simulate
from tmlattice.challenge.make import evenly
from tmlattice.errors import BeamLostError, TmlatticeError, UnstableRingError
from tmlattice.machine import stored_beam
from tmlattice.machine.response import simulate_response

ROOT = Path(__file__).resolve().parents[1]
DATA = Path(os.environ.get("TMLATTICE_DATA", "nowhere"))
DECKS = DATA / "public_decks"
SHIPPED = {
    "dba": ("dba.mat", {"monitors": "M,DR_03*", "correctors": "DR_04,SF"}),
    "thomx": ("thomx.m", {}),
    "australian_synchrotron": ("australian_synchrotron.m", {}),
    "soleil": ("soleil.m", {}),
    "esrf": ("esrf.m", {"correctors": "S4,S6,S13,S19,S20,S22,S24"}),
    "hmba": ("hmba.mat", {"correctors": "SH*"}),
}
FILES = {
    "small": (ROOT / "tests" / "lattices" / "small_ring.py", {}),
    **{name: (Path(machine_data.__file__).parent / file, options)
       for name, (file, options) in SHIPPED.items()},
    "psb": (DECKS / "psb_m.madx", {}),
    "ps": (DECKS / "ps_m.madx", {}),
    # no monitor in the file: they are read in the first half of each corrector
    "elena": (DECKS / "elena_m.madx", {"monitors": "lnr.mccay.*_half::0"}),
    "sps": (DECKS / "sps_m.madx", {}),
    "sls2": (DECKS / "sls.madx", {}),
    "petra3_low_beta": (DATA / "petra3_orbit_response" / "p3_low_beta.mat", {}),
    "esrf_ebs": (DATA / "real_rings" / "esrf_ebs" / "betamodel.mat",
                 {"sequence": "betamodel", "correctors": "S[FIJ]2A*"}),
    "petra3": ("petra3", {}),
}  # fmt: skip
LOCO = {
    "als": "als_2005-06-13", "lnls": "lnls_2014-07-11_a", "pls": "pls_2009-03-01_0713",
    "siam": "siam_2007-09-25", "soleil_2012": "soleil_2012-01-20", "spear3": "spear3_2006-01-09",
}  # fmt: skip
AMPLITUDES = {"hmba": 3e-4, "esrf_ebs": 3e-4}
"""m; else 1 mm. Where third orders, which no map of the model has, exceed the noise at 1 mm."""
CORRECTORS = 24
"""That an orbit response steps at most, evenly along the ring."""
KINDS = ("first_turns", "turns", "orbit_dispersion_tunes", "orbit_response")
ERRORS = ("none", "usual")


def ring_of(name: str):
    """The ring; one of a measured response is imported from its file first."""
    if name not in LOCO:
        source, options = FILES[name]
        return load_ring(source, **options)
    path = DATA / "real_rings" / f"{LOCO[name]}.loco.mat"
    with tempfile.TemporaryDirectory() as place:
        command = [sys.executable, "-m", "tmlattice", "import", str(path), "--out", f"{place}/in"]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            raise TmlatticeError(done.stderr.strip())
        return load_ring(f"{place}/in/lattice.json")


def measured(ring, kind: str, errors: str, seed: int, amplitude: float):
    """What `diagnose` takes."""
    own = {"background": {"all": None} if errors == "usual" else None, "seed": seed}
    if kind == "first_turns":
        return simulate(ring, amplitude=amplitude, **own).measurement()
    if kind == "turns":
        return stored_beam.simulate_turns(ring, amplitude=amplitude, **own).measured
    if kind == "orbit_response":
        count = sum(e.kind in ("hcorrector", "vcorrector") for e in ring.elements)
        chosen = evenly(ring, min(CORRECTORS, count))
        return simulate_response(ring, correctors=chosen, progress=False, **own).measured
    return {
        "orbit": stored_beam.simulate_orbits(ring, **own).measured,
        "dispersion": stored_beam.simulate_dispersion(ring, **own).measured,
        "tunes": stored_beam.simulate_tunes(ring, **own).measured,
    }


def one(ring, name: str, kind: str, errors: str, seed: int) -> dict:
    """What is found in one measurement of one machine."""
    row = {"ring": name, "kind": kind, "errors": errors, "seed": seed}
    begun = time.process_time()
    try:
        try:
            data = measured(ring, kind, errors, seed, AMPLITUDES.get(name, 1e-3))
        except (BeamLostError, UnstableRingError) as error:
            return row | {"verdict": "no beam", "error": str(error)}
        result = diagnose(ring, data)
        row["verdict"] = result.verdict
        row["found"] = [[f.effect, f.element, f.amount] for f in result.findings]
        row["p_value"] = result.unexplained["p_value"]
    except TmlatticeError as error:
        row |= {"verdict": "refused", "error": str(error)}
    except Exception as error:  # a defect, which must not end the count
        row |= {"verdict": "traceback", "error": f"{error!r} {traceback.format_exc()[-600:]}"}
    return row | {"seconds": round(time.process_time() - begun, 1)}


def main() -> None:
    """Measure, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rings", nargs="*", default=[*FILES, *LOCO])
    parser.add_argument("--kinds", nargs="*", default=KINDS, choices=KINDS)
    parser.add_argument("--errors", nargs="*", default=ERRORS, choices=ERRORS)
    parser.add_argument("--seeds", nargs="*", type=int, default=[0])
    parser.add_argument("--out", type=Path, required=True)
    chosen = parser.parse_args()
    logging.getLogger("tmlattice").setLevel(logging.ERROR)
    warnings.simplefilter("ignore")
    there = chosen.out.read_text(encoding="utf-8").splitlines() if chosen.out.is_file() else []
    rows = [json.loads(line) for line in there]
    done = {(r["ring"], r["kind"], r["errors"], r["seed"]) for r in rows}
    for name in chosen.rings:
        asked = [(name, kind, errors, seed) for kind in chosen.kinds for errors in chosen.errors
                 for seed in chosen.seeds]  # fmt: skip
        todo = [case for case in asked if case not in done]
        if not todo:
            continue
        try:
            ring = ring_of(name)
        except TmlatticeError as error:
            print(f"{name}: {error}", flush=True)
            continue
        for case in todo:
            row = one(ring, *case)
            rows.append(row)
            with chosen.out.open("a", encoding="utf-8") as file:
                file.write(json.dumps(row) + "\n")
            print(("ALARM " if false_alarm(row) else "") + json.dumps(row)[:400], flush=True)
    print(markdown(of_healthy(rows)))


if __name__ == "__main__":
    main()
