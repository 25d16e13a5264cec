"""`make fuzz`: as many damaged inputs as are asked for, and a table of what became of them.

python tests/fuzz/run.py [INPUTS] [FIRST SEED] [SECONDS AT MOST] [FILE.json]
"""

import json
import os
import resource
import sys
import tempfile
import time
from pathlib import Path
from unittest import mock

import numpy as np

sys.path[:0] = [str(Path(__file__).parent), str(Path(__file__).parent.parent)]

from contract import Inputs, forked, limit_memory, report, tried  # noqa: E402


def main(count=10_000, first=0, seconds=10**9, file=None):
    """Exit code 1 where the contract was broken."""
    with tempfile.TemporaryDirectory() as place:
        os.environ["TMLATTICE_CACHE"] = "off"
        os.environ.setdefault("NUMBA_NUM_THREADS", "1")
        inputs = Inputs(Path(place))
        inputs.check_accepted()  # whatever the commands import is the package's own memory
        limit_memory()
        end = time.monotonic() + seconds
        begun = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        for seed in range(first, first + count):
            if time.monotonic() > end:
                break
            with mock.patch("tmlattice.lattice.mat_file.subprocess.run", forked):
                name, said = tried(seed, inputs, np.random.default_rng([19, seed]))
            if seed % 500 == 499:
                print(f"{seed + 1 - first} inputs", flush=True)
            if said is not None:
                print(f"--- {name}, seed {seed}: {said}", flush=True)
        print(report(inputs))
        most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        print(f"memory: {begun >> 10} MB with every format read once, {most >> 10} MB at the end")
        if file:
            tallies = {name: vars(tally) for name, tally in inputs.tallies.items()}
            Path(file).write_text(json.dumps(tallies, indent=1))
        return any(tally.broken for tally in inputs.tallies.values())


if __name__ == "__main__":
    numbers = [int(word) for word in sys.argv[1:4]]
    sys.exit(main(*numbers, file=sys.argv[4] if len(sys.argv) > 4 else None))
