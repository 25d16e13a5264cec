"""Time of `tmlattice correct` for PETRA III: `python benchmarks/speed_correction.py`.

The estimated ring has one quadrupole wrong by 2 % and, in one run, the posterior of all usual
errors at their places: a tenth of their usual sizes, of which 1500 random directions have lost
97 % of their variance. Times are of the whole process with start, import, reading and the report;
compiled sweeps and the maps of the design are cached.
"""

import resource
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from tmlattice import load_ring
from tmlattice.correction import default_knobs
from tmlattice.diagnosis.twin import ESTIMATED, knowledge_file, known_document
from tmlattice.effects import Cause, apply, background_rms, find
from tmlattice.files import write_json
from tmlattice.inference.distributed import DistributedErrors
from tmlattice.lattice import save_ring

DIRECTIONS, SHARE, SIZE = 1500, 0.97, 0.1


def posterior(ring):
    """Posterior of all usual errors; the gradients' mean is five of their standard deviations."""
    usual = {name: SIZE * rms for name, rms in background_rms({"all": None}).items()}
    every = [(name, place) for name in usual for place in find(name).places(ring)]
    known = DistributedErrors.usual(every, usual)
    random = np.random.default_rng(0)
    seen = np.linalg.qr(random.standard_normal((len(every), DIRECTIONS)))[0].T
    gradients = np.array([name == "quadrupole_gradient" for name, _ in every])
    mean = 5 * known.rms * random.standard_normal(len(every)) * gradients
    return known.updated(mean, np.full(DIRECTIONS, SHARE), seen)


def seconds(*words):
    """Clock and processor of a command, the faster of two runs: the first fills the caches."""
    times = []
    for _ in range(2):
        spent, begun = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
        subprocess.run([sys.executable, "-m", "tmlattice", *words], check=True,
                       stdout=subprocess.DEVNULL)  # fmt: skip
        now = resource.getrusage(resource.RUSAGE_CHILDREN)
        used = now.ru_utime + now.ru_stime - spent.ru_utime - spent.ru_stime
        times.append((used, time.perf_counter() - begun))
    return min(times)


def main() -> None:
    """Measure, and print the table."""
    ring = load_ring("petra3")
    quadrupoles = [e.name for e in ring.elements if e.kind == "quadrupole" and e.k1]
    knobs = default_knobs(ring)
    supplies = sum(knob.kind == "quadrupole" for knob in knobs)
    known = posterior(ring)
    print("| `tmlattice correct`, PETRA III | processor | clock |\n|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "estimated.json"
        wrong = apply(ring, [Cause("quadrupole_gradient", quadrupoles[100], 0.02)])
        save_ring(replace(wrong, model=ESTIMATED), path)
        for uncertain in (0, len(known.hypotheses)):
            if uncertain:
                write_json(knowledge_file(path), known_document(known, path))
            used, clock = seconds("correct", str(path), "--design", "petra3", "--out",
                                  f"{folder}/settings")  # fmt: skip
            print(f"| {len(quadrupoles)} quadrupoles in {supplies} supplies, {uncertain} uncertain "
                  f"errors | {used:.1f} s | {clock:.1f} s |", flush=True)  # fmt: skip


if __name__ == "__main__":
    main()
