"""Builds the recipe and runs its tests where conda-forge cannot be reached: `python stand_in.py`.

With `pip install py-rattler-build pyyaml`, beside a Python in a folder of its own (pyenv's, say)
that the argument names. The channel is a stand-in in a temporary folder: that Python, and every
requirement of the recipe from PyPI. What it cannot show is whether conda-forge has them all.
"""

import subprocess
import sys
import tempfile
from importlib.metadata import distributions
from pathlib import Path

import rattler_build
import yaml

HERE = Path(__file__).parent
ROOT = HERE.parent.parent
ON_PYPI = {"matplotlib-base": "matplotlib"}


def recipe(folder, name, version, script, needs=(), noarch=False):
    """A package of the stand-in channel."""
    build = {"script": script}
    build |= {"noarch": "generic"} if noarch else {"dynamic_linking": {"binary_relocation": False}}
    path = folder / f"{name}.yaml"
    path.write_text(
        yaml.safe_dump({
            "package": {"name": name, "version": version},
            "build": build,
            "requirements": {"run": list(needs)},
        })
    )  # fmt: skip
    return path


def build(path, channel, **options):
    """One package into the channel."""
    there = [channel.as_uri()] if channel.exists() else []
    rattler_build.build_recipes([str(path)], channel=there, output_dir=str(channel), **options)


def main(prefix):
    """Build the stand-ins, then the recipe with its tests."""
    python = Path(prefix) / "bin" / "python3"
    asked = "import sys; print('%d.%d.%d' % sys.version_info[:3])"
    version = subprocess.run(
        [python, "-c", asked], capture_output=True, text=True, check=True
    ).stdout.strip()
    minor = version.rpartition(".")[0]
    packages = f"lib/python{minor}/site-packages"
    needs = yaml.safe_load((HERE / "recipe.yaml").read_text())["requirements"]
    wanted = [w.replace(" ", "") for w in needs["host"] + needs["run"] if "python " not in w]
    with tempfile.TemporaryDirectory() as scratch:
        place, channel = Path(scratch), Path(scratch) / "channel"
        own = [w.replace(name, pypi) for w in wanted for name, pypi in ON_PYPI.items()]
        subprocess.run(
            [python, "-m", "pip", "install", "--quiet", "--target", place / "site",
             "--constraint", ROOT / "constraints.txt", *own],
            check=True,
        )  # fmt: skip
        known = {
            found.metadata["Name"].lower().replace("_", "-"): found.version
            for found in distributions(path=[str(place / "site")])
        }
        copied = [
            f"cp -r {prefix}/. $PREFIX/",
            f"rm -rf $PREFIX/{packages}/*",
            f"ln -sf python{minor} $PREFIX/bin/python",
        ]
        build(recipe(place, "python", version, copied), channel, test="skip")
        filled = [f"mkdir -p $PREFIX/{packages}", f"cp -r {place}/site/. $PREFIX/{packages}/"]
        wheels = recipe(place, "wheels", "1.0", filled, [f"python =={version}"])
        build(wheels, channel, test="skip")
        for name in (w.partition(">")[0] for w in wanted):
            there = known[ON_PYPI.get(name, name).lower().replace("_", "-")]
            build(recipe(place, name, there, ["true"], ["wheels"], True), channel, test="skip")
        build(HERE / "recipe.yaml", channel, test="native")
        (made,) = channel.glob("noarch/tmlattice-*.conda")
        for test in rattler_build.Package.from_file(str(made)).run_tests([channel.as_uri()]):
            print("passed" if test.success else "\n".join(test.output))


if __name__ == "__main__":
    main(sys.argv[1])
