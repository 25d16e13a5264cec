"""What a command costs before it begins: `python benchmarks/start.py`.

Processor time is user + system of the process and its children, s: of the first call, with empty
caches (the package's and numba's), and the least of the later calls. The last column names the
heavy packages that were loaded.

`python benchmarks/start.py`, two cores, half of them busy; first / later; goal:

    --help              0.08 / 0.08   0.15
    info petra3         2.09 / 0.96   2.5    none of the heavy packages in the later calls
    simulate            2.69 / 1.98          ocelot, matplotlib, at
    diagnose            4.21 / 2.60   2.5    ocelot; 2.41 to 2.63 in seven calls by hand
    tune-fit --epochs 1 16.3 / 5.82   3.5    all three methods; the recipe alone was 4.62
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

HEAVY = ("torch", "torch._dynamo", "ocelot", "matplotlib", "scipy.stats", "pandas", "at")

COMMANDS = (
    ("--help",),
    ("info", "petra3"),
    (
        "simulate",
        "petra3",
        "--effect",
        "quadrupole_gradient qd::12 -0.2",
        "--out",
        "SHOTS",
        "--force",
    ),
    ("diagnose", "petra3", "SHOTS"),
    ("tune-fit", "--epochs", "1", "--out", "FIT"),
)

WATCHED = """
import atexit, os, sys
from pathlib import Path
loaded = Path(os.environ["LOADED"])
atexit.register(lambda: loaded.write_text(" ".join(sys.modules)))
from tmlattice.cli import main
main()
"""


def timed(arguments, environment):
    """Processor and wall time of one process, s."""
    begun = time.perf_counter()
    with subprocess.Popen(arguments, env=environment, stdout=subprocess.DEVNULL) as process:
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise SystemExit(f"{' '.join(arguments)} ended with {process.returncode}")
    return used.ru_utime + used.ru_stime, time.perf_counter() - begun


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeat", type=int, default=3, help="later calls of each command")
    repeat = parser.parse_args().repeat
    print(f"{'command':<64} {'first':>6} {'later':>6} {'wall':>6}  loaded")
    with tempfile.TemporaryDirectory() as folder:
        places = {name: str(Path(folder, name)) for name in ("SHOTS", "FIT", "LOADED")}
        environment = {
            **os.environ,
            "LOADED": places["LOADED"],
            "TMLATTICE_CACHE": str(Path(folder, "cache")),
            "NUMBA_CACHE_DIR": str(Path(folder, "numba")),
            "MPLBACKEND": "Agg",
        }
        for command in COMMANDS:
            arguments = [places.get(word, word) for word in command]
            plain = [sys.executable, "-m", "tmlattice", *arguments]
            first, _ = timed(plain, environment)
            later = [timed(plain, environment) for _ in range(repeat)]
            timed([sys.executable, "-c", WATCHED, *arguments], environment)
            modules = set(Path(places["LOADED"]).read_text().split())
            loaded = ", ".join(name for name in HEAVY if name in modules) or "-"
            processor, wall = (min(column) for column in zip(*later, strict=True))
            print(f"{' '.join(command):<64} {first:6.2f} {processor:6.2f} {wall:6.2f}  {loaded}")


if __name__ == "__main__":
    main()
