"""`make fuzz`: as many damaged inputs as are asked for, and a table of what became of them.

python tests/fuzz/run.py [INPUTS] [FIRST SEED] [FILE.json]
"""

import os
import sys
import tempfile
from pathlib import Path

import numpy as np

sys.path[:0] = [str(Path(__file__).parent), str(Path(__file__).parent.parent)]

from contract import dumped, limit_memory, made, report, tried  # noqa: E402


def main(count=10_000, first=0, file=None):
    """Exit code 1 where the contract was broken."""
    with tempfile.TemporaryDirectory() as place:
        os.environ["TMLATTICE_CACHE"] = "off"
        os.environ.setdefault("NUMBA_NUM_THREADS", "1")
        folder = Path(place)
        inputs = made(folder)
        limit_memory()
        for seed in range(first, first + count):
            name, said = tried(seed, folder, inputs, np.random.default_rng([19, seed]))
            if said is not None:
                print(f"--- {name}, seed {seed}: {said}", flush=True)
        print(report(inputs))
        if file:
            dumped(inputs, Path(file))
        return any(tally.broken for tally in inputs.tallies.values())


if __name__ == "__main__":
    numbers = [int(word) for word in sys.argv[1:3]]
    sys.exit(main(*numbers, file=sys.argv[3] if len(sys.argv) > 3 else None))
