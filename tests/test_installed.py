"""The package away from its repository: wheel, editable, plain install, missing extras."""

import tomllib
from pathlib import Path

import pytest
from command import printed, python
from conftest import SMALL

ROOT = Path(__file__).parent.parent
CHECK = (
    "import sys; sys.path.insert(0, {place!r})\n"
    "import tmlattice\n"
    "assert {place!r} in tmlattice.__file__, tmlattice.__file__\n"
    "ring = tmlattice.load_ring('petra3')\n"
    "print(len(ring.magnets), len(ring.monitors), tmlattice.__version__)\n"
)


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    folder = tmp_path_factory.mktemp("wheel")
    # the sdist, and the wheel from that
    printed("-m", "build", "--no-isolation", "--outdir", str(folder), str(ROOT), cwd=folder)
    (built,) = folder.glob("*.whl")
    return built


def test_wheel_in_an_empty_folder_brings_the_ring(wheel, tmp_path):
    place = tmp_path / "site"
    printed("-m", "pip", "install", "--quiet", "--no-deps", "--target", place, wheel, cwd=tmp_path)
    empty = tmp_path / "empty"
    empty.mkdir()
    said = printed("-I", "-c", CHECK.format(place=str(place)), cwd=empty)
    assert said.split()[:2] == ["1519", "246"]
    for name in ("py.typed", "schemas/tune-fit.schema.json", "lattices/match_petra3.py",
                 "report/page.js", "report/style.css", "report/vendor/plotly-LICENSE"):  # fmt: skip
        assert (place / "tmlattice" / name).exists(), name
    assert not (place / "tests").exists()


def test_installed_command_is_there(tmp_path):
    from importlib.metadata import entry_points

    (command,) = entry_points(group="console_scripts", name="tmlattice")
    assert command.value == "tmlattice.cli:main"
    assert printed(
        "-I", "-c", "import tmlattice; print(tmlattice.load_ring('petra3').name)", cwd=tmp_path
    )


def test_the_conda_recipe_asks_for_what_pip_does():
    """Names that differ between the two stand here; versions and the rest are the same."""
    import yaml

    from tmlattice import __version__

    recipe = yaml.safe_load((ROOT / "packaging" / "conda" / "recipe.yaml").read_text())
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    names = {"torch": "pytorch", "matplotlib": "matplotlib-base"}
    ours = {f"python{project['requires-python']}"}
    for wanted in project["dependencies"]:
        name, _, least = wanted.partition(">=")
        ours.add(f"{names.get(name, name)}>={least}")
    assert {wanted.replace(" ", "") for wanted in recipe["requirements"]["run"]} == ours
    assert recipe["context"]["version"] == __version__
    command = project["scripts"]["tmlattice"]
    assert recipe["build"]["python"]["entry_points"] == [f"tmlattice = {command}"]


# --- what works in a plain install, and what is said where an extra is missing --------------------
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
    cache = folder / "cache"
    return python("-c", PLAIN + code, *arguments, cwd=folder, TMLATTICE_CACHE=cache)


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
        (["dev", "study", "tune-fit", SMALL, "--jobs", "1"], "torch", "network"),
        (["dev", "reproduce", "lotka-volterra"], "torch", "reproduce"),
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


def test_every_extra_brings_what_its_message_says_and_a_plain_install_nothing_of_it():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"] | {"plain": project["dependencies"]}
    brings = {
        name: {wanted.partition(">=")[0] for wanted in wants} for name, wants in extras.items()
    }
    assert not brings["plain"] & {"distributed", "dask", "scikit-learn", "torch"}
    assert "torch" in brings["network"]
    assert "distributed" in brings["dask"]
    assert {"torch", "scikit-learn"} <= brings["challenge"] & brings["reproduce"]
    assert set().union(*(brings[n] for n in ("network", "dask", "challenge"))) <= brings["test"]
