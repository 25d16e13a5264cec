"""Measured responses of real rings: `TMLATTICE_DATA=... python benchmarks/real_rings.py [NAME]`.

Each file of `$TMLATTICE_DATA/real_rings` is imported to a temporary folder and diagnosed, with
default options, one after another; PETRA III's folder is diagnosed as it is. Told
are the rms of held-out correctors, in plane, in the other plane (with a roll of their own where
that was weighed) and of the RF's orbit, in micrometres: of the lattice and of the result; beside
them what the experts' own LOCO fit leaves of all the data that it was fitted to (its last model,
in the file). Then the steps, kept and refused. `--iteration first` takes the model as it was
before that fit; `--seed N` another split, `--seeds N` that many of them; `--json FILE` writes the
table, `--pictures FOLDER` a picture a ring: what is left before and after, and the gradients.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import matplotlib as mpl

mpl.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

import tmlattice
from tmlattice import read_measurement
from tmlattice.errors import TmlatticeError
from tmlattice.lattice.mat_file import read_mat
from tmlattice.plots.response import plot_gradients, plot_left
from tmlattice.report.page import shrink

MICRO = 1e6


def sources(data):
    """Names of the rings, and the files of each."""
    rings = data / "real_rings"
    found = {path.name.split(".")[0]: [path] for path in sorted(rings.glob("*.loco.mat"))}
    esrf = rings / "esrf_ebs"
    if esrf.is_dir():
        found["esrf_ebs"] = [*sorted(esrf.glob("*.h5")), esrf / "name_mapping.json",
                             esrf / "betamodel.mat"]  # fmt: skip
    if (data / "petra3_orbit_response").is_dir():
        found["petra3"] = []
    return found


def command(*words):
    """A command's end: its exit code, what it printed, its seconds."""
    begun = time.perf_counter()
    done = subprocess.run(
        [sys.executable, "-m", "tmlattice", *map(str, words)],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    return done, time.perf_counter() - begun


def experts(path):
    """What LOCO's last model leaves, in plane and across, micrometres, of what it was fitted to."""
    content = read_mat(path, ["LocoMeasData", "LocoModel", "BPMData", "CMData"])
    last = {name: content[name][-1] for name in ("LocoModel", "BPMData", "CMData")}

    def good(structure, kind):
        first = len(np.atleast_1d(structure[f"H{kind}Index"]))
        h, v = (np.atleast_1d(structure[f"{p}{kind}GoodDataIndex"]).astype(int) - 1 for p in "HV")
        return np.concatenate([h, first + v]), len(h)

    rows, x = good(last["BPMData"], "BPM")
    columns, horizontal = good(last["CMData"], "CM")
    model = last["LocoModel"]["M"]
    left = content["LocoMeasData"]["M"][np.ix_(rows, columns)] - model
    own = np.zeros(left.shape, dtype=bool)
    own[:x, :horizontal] = own[x:, horizontal:] = True
    return [1e3 * float(np.sqrt(np.mean(left[part] ** 2))) for part in (own, ~own)]


def ring(name, files, data, place, options):
    """One ring: a row of the table."""
    if files:
        folder = place / name
        done, seconds = command("import", *files, "--out", folder, "--iteration", options.iteration)
        if done.returncode:
            return {"ring": name, "error": done.stderr.strip(), "seconds": seconds}
        lattice = folder / "lattice.json"
        told = [line for line in done.stdout.splitlines() if line.startswith("!")]
    else:
        folder, told = data / "petra3_orbit_response", []
        lattice = folder / "p3_low_beta.mat"
    row = {"ring": name, "contradicted": told}
    if files and files[0].name.endswith(".loco.mat"):
        row["experts"] = experts(files[0])
    row["noise"] = MICRO * float(np.nanmedian(read_measurement(folder).noise))
    every = []
    for seed in range(options.seed, options.seed + options.seeds):
        every.append(_diagnosed(lattice, folder, seed, None if every else options.pictures, name))
    row["seeds"] = [one.get("error") or one["steps"][-1] for one in every]
    return row | every[0]


def _diagnosed(lattice, folder, seed, pictures, name):
    begun = time.process_time()
    try:
        ring = tmlattice.load_ring(lattice)
        found = tmlattice.diagnose(ring, read_measurement(folder), seed=seed)
    except TmlatticeError as error:
        return {"error": str(error), "seconds": time.process_time() - begun}
    seconds = time.process_time() - begun
    if pictures:
        picture(found, pictures / f"real-{name}.png")
    return {
        "verdict": found.verdict,
        "seconds": seconds,
        "fit": MICRO * found.fit_after.rms,
        "steps": [_step(step.as_json()) for step in found.steps],
        "refused": [_step(step.as_json()) for step in found.refused],
        "warnings": list(found.warnings),
    }


def picture(result, path):
    """What is left before and after, and below it the gradients' errors along the ring."""
    figure = plt.figure(figsize=(10, 6.4), layout="constrained")
    above, below = figure.subfigures(2, 1, height_ratios=[6, 4])
    plot_left(result, above)
    if any(cause.effect == "quadrupole_gradient" for cause in result.causes):
        plot_gradients(result, below)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=80)
    plt.close(figure)
    shrink(path)


def _step(step):
    def micro(key):
        return None if step.get(key) is None or np.isnan(step[key]) else MICRO * step[key]

    return {
        "effect": step["effect"],
        "parameters": step["parameters"],
        "in_plane": micro("heldout_rms_in_plane"),
        "coupling": micro("heldout_rms_coupling"),
        "with_roll": micro("heldout_rms_roll"),
        "rf": micro("dispersion_rms"),
        "chi2": step["heldout_chi2_per_dof"],
    }


def table(rows):
    """The table, as Markdown."""
    yield ("| ring | noise | lattice: in-plane / coupling / RF | result: in-plane / coupling "
           "(with roll) / RF | chi² held out | fitted | experts' fit: in-plane / coupling | "
           "verdict | s |")  # fmt: skip
    yield "|" + "---|" * 9
    for row in rows:
        if "error" in row:
            yield f"| {row['ring']} | | {row['error']} | | | | | error | {row['seconds']:.0f} |"
            continue
        first, last = row["steps"][0], row["steps"][-1]
        roll = "" if last["with_roll"] is None else f" ({last['with_roll']:.2f})"
        own = " / ".join(f"{v:.2f}" for v in row.get("experts", ()))
        yield (
            f"| {row['ring']} | {row['noise']:.2f} | {first['in_plane']:.2f} / "
            f"{first['coupling']:.2f} / {first['rf']:.1f} | **{last['in_plane']:.2f}** / "
            f"{last['coupling']:.2f}{roll} / {last['rf']:.1f} | {last['chi2']:.1f} | "
            f"{row['fit']:.2f} | {own} | {row['verdict']} | {row['seconds']:.0f} |"
        )


def scatter(rows):
    """Median and worst of the seeds: held-out in-plane, coupling and RF, micrometres."""
    for row in rows:
        good = [step for step in row.get("seeds", ()) if isinstance(step, dict)]
        for key in ("in_plane", "coupling", "rf") if len(good) > 1 else ():
            values = [step[key] for step in good]
            yield (f"{row['ring']}, {len(good)} seeds, {key}: {np.median(values):.2f}, at worst "
                   f"{max(values):.2f}")  # fmt: skip


def steps(row):
    """Where the steps of a ring went."""
    for what in ("steps", "refused"):
        for step in row.get(what, ()):
            mark = "kept   " if what == "steps" else "refused"
            roll = "" if step["with_roll"] is None else f" ({step['with_roll']:.2f})"
            yield (
                f"  {mark} {step['effect']}: {step['in_plane']:.2f} / {step['coupling']:.2f}{roll} "
                f"/ {step['rf']:.1f}, chi² {step['chi2']:.1f}, {step['parameters']} parameters"
            )


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*")
    parser.add_argument("--iteration", default="last", choices=["first", "last"])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--pictures", type=Path)
    options = parser.parse_args()
    if not os.environ.get("TMLATTICE_DATA"):
        sys.exit("TMLATTICE_DATA names no folder of measured data")
    data = Path(os.environ["TMLATTICE_DATA"])
    rows = []
    with tempfile.TemporaryDirectory() as place:
        for name, files in sources(data).items():
            if options.names and not any(part in name for part in options.names):
                continue
            rows.append(ring(name, files, data, Path(place), options))
            print(name, rows[-1].get("error", ""), flush=True)
            print(*steps(rows[-1]), sep="\n", flush=True)
            if options.json:
                options.json.write_text(json.dumps(rows, indent=2), encoding="utf-8")
    print(*table(rows), *scatter(rows), sep="\n")


if __name__ == "__main__":
    main()
