"""What a new user waits for: `python benchmarks/first_minute.py`.

A fresh virtual environment, the package's own install with `constraints.txt`, first without extras
and then with PyTorch, sizes and seconds, the largest packages; after each what it can do of the
README's first commands, in an empty folder with an empty cache, and again. Packages come from the
registry or from pip's cache; the clock's seconds are those of the machine as it is, shared or not.
Prints the table of docs/results/speed.md.
"""

import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parent.parent
PLAIN = (
    ("tmlattice --help",),
    (
        'tmlattice simulate petra3 --effect "quadrupole_gradient qd::12 -0.2" --out day_1 --force',
        "tmlattice diagnose petra3 day_1 --out diagnosis_1",
    ),
)
WITH_TORCH = (("tmlattice tune-fit",),)


def timed(command, **options):
    """Seconds of the clock, and of the processor."""
    begun = np.array([time.perf_counter(), processor()])
    done = subprocess.run(
        command, shell=isinstance(command, str), capture_output=True, text=True, check=False,
        **options,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-2000:]
    return np.array([time.perf_counter(), processor()]) - begun


def processor():
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def told(seconds):
    return f"{seconds[0]:.1f} s ({seconds[1]:.1f} of the processor)"


def megabytes(folder):
    return sum(p.stat().st_size for p in folder.rglob("*") if p.is_file()) / 1e6


def install(place, extra):
    """Rows of the table of one more install, the commands that it makes possible included."""
    python = str(place / "venv/bin/python")
    site = next((place / "venv").glob("lib/python*/site-packages"))
    before = megabytes(site)
    taken = timed([python, "-m", "pip", "install", "--quiet", "--constraint",
                   str(ROOT / "constraints.txt"), f"{ROOT}{extra}"])  # fmt: skip
    print(f"| `pip install .{extra}` | {told(taken)}, {megabytes(site) - before:.0f} MB |")
    sizes = {p.name: megabytes(p) for p in site.iterdir() if p.is_dir()}
    largest = sorted(sizes.items(), key=lambda item: -item[1])[:7]
    print(f"| largest | {', '.join(f'{name} {size:.0f}' for name, size in largest)} MB |")
    print(f"| tmlattice itself | {sizes['tmlattice']:.1f} MB |")


def main():
    with tempfile.TemporaryDirectory() as scratch:
        place = Path(scratch)
        print("| what | measured |\n|---|---|")
        print(
            f"| environment | {told(timed([sys.executable, '-m', 'venv', str(place / 'venv')]))} |"
        )
        empty = place / "empty"
        empty.mkdir()
        environment = {
            **{k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "VIRTUAL_ENV")},
            "PATH": f"{place / 'venv/bin'}:{os.environ['PATH']}",
            "XDG_CACHE_HOME": str(place / "cache"),
        }
        for extra, group in (("", PLAIN), ("[network]", WITH_TORCH)):
            install(place, extra)
            for commands in group:
                first, again = (
                    sum(timed(one, cwd=empty, env=environment) for one in commands)
                    for _ in range(2)
                )
                print(f"| `{'`, `'.join(commands)}` | {told(first)}, again {told(again)} |")
    lines = len((ROOT / "README.md").read_text(encoding="utf-8").splitlines())
    print(f"| lines of the README | {lines} |")


if __name__ == "__main__":
    main()
