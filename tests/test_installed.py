"""The package away from its repository: as a wheel, and as an editable install."""

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
CHECK = (
    "import sys; sys.path.insert(0, {place!r})\n"
    "import tmlattice\n"
    "assert {place!r} in tmlattice.__file__, tmlattice.__file__\n"
    "ring = tmlattice.load_ring('petra3')\n"
    "print(len(ring.magnets), len(ring.monitors), tmlattice.__version__)\n"
)


def run(*arguments, cwd):
    done = subprocess.run(
        [sys.executable, *arguments], cwd=cwd, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    folder = tmp_path_factory.mktemp("wheel")
    # the sdist, and the wheel from that
    run("-m", "build", "--no-isolation", "--outdir", str(folder), str(ROOT), cwd=folder)
    (built,) = folder.glob("*.whl")
    return built


def test_wheel_in_an_empty_folder_brings_the_ring(wheel, tmp_path):
    place = tmp_path / "site"
    run(
        "-m",
        "pip",
        "install",
        "--quiet",
        "--no-deps",
        "--target",
        str(place),
        str(wheel),
        cwd=tmp_path,
    )
    empty = tmp_path / "empty"
    empty.mkdir()
    assert run("-I", "-c", CHECK.format(place=str(place)), cwd=empty).split()[:2] == ["1519", "246"]
    for name in (
        "py.typed",
        "schemas/tune-fit.schema.json",
        "lattices/match_petra3.py",
        "report/page.js",
        "report/style.css",
        "report/vendor/plotly-LICENSE",
    ):
        assert (place / "tmlattice" / name).exists(), name
    assert not (place / "tests").exists()


def test_installed_command_is_there(tmp_path):
    from importlib.metadata import entry_points

    (command,) = entry_points(group="console_scripts", name="tmlattice")
    assert command.value == "tmlattice.cli:main"
    assert run(
        "-I", "-c", "import tmlattice; print(tmlattice.load_ring('petra3').name)", cwd=tmp_path
    )


def test_the_conda_recipe_asks_for_what_pip_does():
    """Names that differ between the two stand here; versions and the rest are the same."""
    import tomllib

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


def test_a_plain_install_takes_nothing_that_only_studies_need():
    import tomllib

    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    plain = {wanted.partition(">=")[0] for wanted in project["dependencies"]}
    assert not plain & {"distributed", "dask", "scikit-learn", "torch"}
    assert any("distributed" in wanted for wanted in project["optional-dependencies"]["dask"])
