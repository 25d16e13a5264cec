#!/usr/bin/env bash
# packaging/check.sh PYTHON...: render the conda recipe, build sdist and wheel, check them, install
# the wheel into an empty environment of each PYTHON (outside the source), and use it there.
set -euo pipefail
cd "$(dirname "$0")/.."
root=$(pwd) scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT

"${1:-python3}" -m venv "$scratch/build"
"$scratch/build/bin/pip" install --quiet build twine py-rattler-build
"$scratch/build/bin/python" - << 'END'
import rattler_build as conda

recipe = conda.Stage0Recipe.from_file("packaging/conda/recipe.yaml")
print(*(str(one.recipe.to_dict()["package"]) for one in recipe.render(conda.VariantConfig())))
END
"$scratch/build/bin/python" -m build --outdir "$scratch/dist" .
"$scratch/build/bin/twine" check --strict "$scratch"/dist/*

for python in "${@:-python3}"; do
  rm -rf "$scratch/empty"
  "$python" -m venv "$scratch/empty"
  "$scratch/empty/bin/pip" install --quiet "$scratch"/dist/*.whl
  cd "$scratch"
  "$scratch/empty/bin/pip" check
  "$scratch/empty/bin/tmlattice" --version
  "$scratch/empty/bin/tmlattice" simulate petra3 --effect "quadrupole_gradient qd::12 -0.05" --out day --force
  "$scratch/empty/bin/tmlattice" diagnose petra3 day --out report | grep "IDENTIFIED: quadrupole qd::12"
  echo "$("$python" --version): installed from the wheel, a fault identified"
  cd "$root"
done
