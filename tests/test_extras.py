"""What works in a plain install, and what is said where an extra is missing."""

import os
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
SMALL = ROOT / "tests" / "lattices" / "small_ring.py"
PLAIN = (
    "import sys\n"
    "class Missing:\n"
    "    def find_spec(self, name, path=None, target=None):\n"
    "        if name.partition('.')[0] in ('torch', 'distributed', 'dask', 'sklearn'):\n"
    "            raise ModuleNotFoundError(f'No module named {name!r}', name=name)\n"
    "sys.meta_path.insert(0, Missing())\n"
)
"""A process in which the packages of the extras are as if they were not installed."""


def plain(code, folder, *arguments):
    return subprocess.run(
        [sys.executable, "-c", PLAIN + code, *map(str, arguments)],
        env={**os.environ, "TMLATTICE_CACHE": str(folder / "cache")},
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
    )


def test_a_plain_install_simulates_diagnoses_and_reports(tmp_path):
    done = plain(
        "import tmlattice\n"
        "from pathlib import Path\n"
        "ring = tmlattice.load_ring(sys.argv[1])\n"
        "weak = [tmlattice.Cause('quadrupole_gradient', 'QD::5', -0.05)]\n"
        "made = tmlattice.simulate(ring, weak, shots=4, seed=1, engine='ocelot')\n"
        "tmlattice.write_measurement(Path('day'), made.measurement())\n"
        "from tmlattice.cli import main\n"
        "sys.argv = ['tmlattice', 'diagnose', sys.argv[1], 'day', '--out', 'out']\n"
        "main()\n",
        tmp_path,
        SMALL,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    assert "IDENTIFIED: quadrupole QD::5" in done.stdout
    assert (tmp_path / "out" / "report.html").exists()


@pytest.mark.parametrize(
    ("command", "package", "extra"),
    [
        (["tune-fit", SMALL], "torch", "network"),
        (["study", "tune-fit", SMALL, "--workers", "1"], "torch", "network"),
        (["reproduce", "lotka-volterra"], "torch", "reproduce"),
    ],
)
def test_a_command_that_needs_an_extra_names_it(tmp_path, command, package, extra):
    done = plain("from tmlattice.cli import main\nmain()\n", tmp_path, *command)
    assert done.returncode == 2, done.stderr[-3000:]
    (line,) = done.stderr.splitlines()
    assert f"'{package}', which is not installed" in line
    assert f"pip install 'tmlattice[{extra}]'" in line


def test_python_names_the_extra_too(tmp_path):
    done = plain(
        "import tmlattice\n"
        "from tmlattice.batch import run_batch\n"
        "def one(): tmlattice.TaylorNetwork\n"
        "def two(): from tmlattice.fitting import fine_tune\n"
        "from pathlib import Path\n"
        "def three(): run_batch(str, {'a': str}, Path('x'), scheduler='tcp://x:1')\n"
        "for wanted in (one, two, three):\n"
        "    try:\n"
        "        wanted()\n"
        "    except (tmlattice.errors.MissingPackageError, ImportError) as error:\n"
        "        print(error)\n",
        tmp_path,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    first, second, third = done.stdout.splitlines()
    assert "'torch'" in first
    assert "'tmlattice[network]'" in first
    assert second == first
    assert "'tmlattice[dask]'" in third
    assert "local processes" in third


def test_every_extra_brings_what_its_message_says():
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"][
        "optional-dependencies"
    ]
    brings = {
        name: {wanted.partition(">=")[0] for wanted in wants} for name, wants in extras.items()
    }
    assert "torch" in brings["network"]
    assert "distributed" in brings["dask"]
    assert {"torch", "scikit-learn"} <= brings["challenge"] & brings["reproduce"]
    assert set().union(*(brings[n] for n in ("network", "dask", "challenge"))) <= brings["test"]
