"""What a new user waits for: `python benchmarks/first_minute.py`.

A fresh virtual environment, the package's own install with `constraints.txt` and without extras,
its size and seconds, the largest packages; then the README's first commands in an empty folder with
an empty cache, and again. Seconds of the clock: packages come from the registry or from pip's
cache, and the machine may be shared. Prints the table of docs/results/first_minute.md.
"""

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).parent.parent
COMMANDS = (
    ("tmlattice --help",),
    ("tmlattice tune-fit",),
    (
        'tmlattice simulate petra3 --effect "quadrupole_gradient qd::12 -0.2" --out day_1 --force',
        "tmlattice diagnose petra3 day_1 --out diagnosis_1",
    ),
)


def timed(command, **options):
    begun = time.perf_counter()
    done = subprocess.run(
        command, shell=isinstance(command, str), capture_output=True, text=True, check=False,
        **options,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-2000:]
    return time.perf_counter() - begun


def megabytes(folder):
    return sum(p.stat().st_size for p in folder.rglob("*") if p.is_file()) / 1e6


def main():
    with tempfile.TemporaryDirectory() as scratch:
        place = Path(scratch)
        made = timed([sys.executable, "-m", "venv", str(place / "venv")])
        site = next((place / "venv").glob("lib/python*/site-packages"))
        pip = megabytes(site)
        installed = timed(
            [str(place / "venv/bin/python"), "-m", "pip", "install", "--quiet", "--constraint",
             str(ROOT / "constraints.txt"), str(ROOT)]
        )  # fmt: skip
        print("| what | measured |\n|---|---|")
        print(f"| environment, install | {made:.0f} s, {installed:.0f} s |")
        print(f"| size of the install | {megabytes(site) - pip:.0f} MB |")
        sizes = {p.name: megabytes(p) for p in site.iterdir() if p.is_dir()}
        largest = sorted(sizes.items(), key=lambda item: -item[1])[:6]
        print(f"| largest | {', '.join(f'{name} {size:.0f}' for name, size in largest)} MB |")
        print(f"| tmlattice itself | {sizes['tmlattice']:.1f} MB |")
        empty = place / "empty"
        empty.mkdir()
        environment = {
            **{k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "VIRTUAL_ENV")},
            "PATH": f"{place / 'venv/bin'}:{os.environ['PATH']}",
            "XDG_CACHE_HOME": str(place / "cache"),
        }
        for commands in COMMANDS:
            first, again = (
                sum(timed(one, cwd=empty, env=environment) for one in commands) for _ in range(2)
            )
            print(f"| `{'`, `'.join(commands)}` | {first:.1f} s, again {again:.1f} s |")
    lines = len((ROOT / "README.md").read_text(encoding="utf-8").splitlines())
    print(f"| lines of the README | {lines} |")


if __name__ == "__main__":
    main()
