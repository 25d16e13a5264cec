"""Measured responses of real rings: `TMLATTICE_DATA=... python benchmarks/real_rings.py [NAME]`.

Each file of `$TMLATTICE_DATA/real_rings` is imported to a temporary folder and diagnosed, with
default options, one after another; PETRA III's folder is diagnosed as it is. It prints the rms
residuals of held-out correctors, in plane (with a position jump of their own), in the other plane
(with their own roll where that was weighed) and of the RF's orbit, in micrometres, of the lattice
and of the result; and that of the experts' own LOCO fit (its last model, in the file), of all the
data that it was fitted to. Then the steps, accepted and rejected.

The lattice of a LOCO file is the model before its fit; `--iteration last` takes the fitted one.
`--seed N` is another split, `--seeds N` that many of them: at the end their median, the worst, and
the scatter of the results between them in units of their stated errors (0.5 is expected, as two
seeds share four fifths of the readings). `--families` seeks no single faults among distributed
errors, which takes most of the time; `--missing` adds a table of effects that the result lacks;
`--pictures FOLDER` draws the residual before and after, and the gradients, of each ring. `--into
FOLDER` writes a file of each ring and seed; those of the same options and code are not measured
again, so that a long study can be stopped. `--table` prints the table of FOLDER, of whatever code:
`python benchmarks/tables.py --store real_rings python benchmarks/real_rings.py --into FOLDER
--table` makes it that of the page.
"""

import argparse
import hashlib
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
from tmlattice.diagnosis.records import record_of
from tmlattice.diagnosis.response import procedure
from tmlattice.errors import TmlatticeError
from tmlattice.files import output_file, write_json
from tmlattice.lattice.mat_file import read_mat
from tmlattice.plots.response import plot_gradients, plot_left

MICRO = 1e6
SCATTER = ("quadrupole_gradient", "bend_gradient", "vertical_focusing", "energy_offset",
           "energy_spread", "skew_gradient")  # fmt: skip
"""Effects whose amounts are held against one another between seeds; and shared gradients."""
FEWEST = 3
"""Seeds that must have a number."""


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


def imported(name, files, data, place, iteration):
    """Lattice and folder of a ring, and the messages of its import about conventions."""
    if not files:
        folder = data / "petra3_orbit_response"
        return folder / "p3_low_beta.mat", folder, []
    folder = place / name
    command = [sys.executable, "-m", "tmlattice", "import", *files]
    done = subprocess.run(
        [*command, "--out", folder, "--iteration", iteration],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    if done.returncode:
        raise TmlatticeError(done.stderr.strip())
    told = [line for line in done.stdout.splitlines() if line.startswith("!")]
    return folder / "lattice.json", folder, told


def stands(path, made_with):
    """What a file of an earlier run has; None where there is none, or one of other options."""
    if path is None:
        return None
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (FileNotFoundError, ValueError):
        return None
    return found if found.items() >= made_with.items() else None


def code():
    """What stands for the package's code: a digest of its files."""
    digest = hashlib.sha256()
    for path in sorted(Path(tmlattice.__file__).parent.rglob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def ring(name, files, data, place, options):
    """One ring: what each seed found."""
    found = []
    source = None
    made_with = {"code": code(), "iteration": options.iteration, "no_faults": options.families,
                 "missing": options.missing}  # fmt: skip
    for seed in range(options.seed, options.seed + options.seeds):
        path = options.into and options.into / f"{name}-{seed}.json"
        one = stands(path, made_with)
        if one is None:
            one = {"ring": name, "seed": seed, **made_with}
            try:
                source = source or imported(name, files, data, place, options.iteration)
                picture_of = None if seed > options.seed else options.pictures
                one |= _diagnosed(source, seed, options.missing, picture_of, name)
            except (TmlatticeError, np.linalg.LinAlgError) as error:
                one |= {"error": str(error), "seconds": 0.0}
            if files and files[0].name.endswith(".loco.mat"):
                one["experts"] = experts(files[0])
            if path and "error" not in one:
                with output_file(path) as made:
                    write_json(made, one)
        found.append(one)
        print(_as_it_comes(found[-1]), flush=True)
    return found


def _kept(found):
    """Families in the result."""
    return [own["effect"] for own in found["families"] if own["kept"]]


def _as_it_comes(found):
    """A line of one seed."""
    name, seed = found["ring"], found["seed"]
    if "error" in found:
        return f"{name}, seed {seed}: {found['error']}"
    last = found["steps"][-1]
    rejected = ", ".join(own["effect"] for own in found["families"] if not own["kept"])
    return (f"{name}, seed {seed}: {_figures(last)}, {found['verdict']}, "
            f"{found['seconds']:.0f} s; kept: {', '.join(_kept(found))}; "
            f"rejected: {rejected or 'none'}")  # fmt: skip


def _figures(step):
    """In plane (with a jump) / across (with a roll) / RF, chi²."""
    if step["in_plane"] is None:
        return "nothing better than the model"
    jump = "" if step["with_jump"] is None else f" ({step['with_jump']:.2f})"
    roll = "" if step["with_roll"] is None else f" ({step['with_roll']:.2f})"
    rf = "-" if step["rf"] is None else f"{step['rf']:.1f}"
    chi2 = f"chi² {step['chi2']:.1f}"
    return f"{step['in_plane']:.2f}{jump} / {step['coupling']:.2f}{roll} / {rf}, {chi2}"


def _diagnosed(source, seed, missing, pictures, name):
    lattice, folder, told = source
    begun = time.process_time()
    ring, measurement = tmlattice.load_ring(lattice), read_measurement(folder)
    found = tmlattice.diagnose(ring, measurement, seed=seed, missing=missing)
    seconds = time.process_time() - begun
    if pictures:
        picture(found, pictures / f"real-{name}.png")
    return {
        "contradicted": told,
        "noise": MICRO * float(np.nanmedian(measurement.noise)),
        "verdict": found.verdict,
        "seconds": seconds,
        "fit": MICRO * found.fit_after.rms,
        "steps": [_step(record_of(step)) for step in found.steps],
        "families": [_step(record_of(own)) for own in found.families],
        "findings": [own.words or f"{own.effect} {own.element}" for own in found.findings],
        "hypotheses": [record_of(row) for row in found.hypotheses or ()],
        "warnings": list(found.warnings),
        "amounts": _amounts(found),
    }


def _amounts(found):
    """Of what is well known: amounts and stated errors, by effect and place."""
    out = {effect: {} for effect in SCATTER}
    numbers = set()  # a magnet in pieces is one, and so are all of a type
    for cause, error in zip(found.causes, found.errors, strict=True):
        if cause.effect in SCATTER and error > 0:
            number = (cause.effect, round(cause.amount / error, 9))
            if number not in numbers:
                numbers.add(number)
                out[cause.effect][str(cause.element)] = (cause.amount, error)
    reasons = () if found.common_factors is None else found.common_factors.common_factors
    out["shared gradient"] = {
        own.name: (own.amount, own.amount_sigma) for own in reasons if own.kind != "magnet"
    }
    return out


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


def _step(step):
    def known(key, factor=1):
        return None if step.get(key) is None or np.isnan(step[key]) else factor * step[key]

    def micro(key):
        return known(key, MICRO)

    return {
        "effect": step["effect"],
        "kept": step["kept"],
        "log_evidence": known("log_evidence"),
        "parameters": step["parameters"],
        "in_plane": micro("heldout_rms_in_plane"),
        "coupling": micro("heldout_rms_coupling"),
        "with_roll": micro("heldout_rms_roll"),
        "with_jump": micro("heldout_rms_position"),
        "rf": micro("dispersion_rms"),
        "chi2": known("heldout_chi2_per_dof"),
    }


def table(rings):
    """The first seed of each ring, as Markdown."""
    yield ("| ring | noise | lattice: in-plane (with jump) / coupling / RF, chi² per reading | "
           "result: in-plane (with jump) / coupling (with roll) / RF, chi² | fitted | experts: "
           "in-plane / coupling | verdict | s |")  # fmt: skip
    yield "|" + "---|" * 8
    for found in rings:
        row = next((one for one in found if "error" not in one), found[0])
        if "error" in row:
            yield f"| {row['ring']} | | {row['error']} | | | | error | |"
            continue
        first, last = row["steps"][0], row["steps"][-1]
        own = " / ".join(f"{v:.2f}" for v in row.get("experts", ()))
        yield (
            f"| {row['ring']} | {row['noise']:.2f} | {_figures(first)} | {_figures(last)} | "
            f"{row['fit']:.2f} | {own} | {row['verdict']} | {row['seconds']:.0f} |"
        )


def table_of_missing(rings):
    """What the first seed of each ring still lacks: those that help, or would."""
    yield "| ring | hypothesis | numbers | amount | sensible | in plane | evidence | on top | so |"
    yield "|" + "---|" * 9
    for found in rings:
        for row in found[0].get("hypotheses") or ():
            if row["judgement"] != "excluded":
                yield (
                    f"| {found[0]['ring']} | {row['effect']} | {row['parameters']} | "
                    f"{row['amount']:.2g} ± {row['amount_sigma']:.1g} | {row['expected']} | "
                    f"{MICRO * row['heldout_rms_in_plane']:.2f} | {row['evidence']:.0f} | "
                    f"{row['evidence_on_top']:.0f} | {row['judgement']} |"
                )


def table_of_seeds(rings):
    """Medians over the seeds of each ring, and the worst: the table of the page."""
    yield "| ring | lattice | experts | in plane | worst | $\\chi^2$ | across | RF | s |"
    yield "|" + "---|" * 9
    for found in rings:
        good = [one for one in found if "error" not in one]
        if not good:
            continue

        def over(key, how=np.median, good=good, step=-1):
            values = [one["steps"][step][key] for one in good]
            values = [value for value in values if value is not None]
            return f"{how(values):.3g}" if values else "-"

        def worst(key, before="", good=good, over=over):
            return before + over(key, max) if len(good) > 1 else ""

        experts = good[0].get("experts")
        cells = [
            found[0]["ring"], over("in_plane", step=0), f"{experts[0]:.3g}" if experts else "",
            f"{over('in_plane')} ({over('with_jump')})", worst("in_plane"), over("chi2"),
            f"{over('coupling')} ({over('with_roll')})", over("rf") + worst("rf", " / "),
            f"{np.median([one['seconds'] for one in good]):.0f}",
        ]  # fmt: skip
        yield f"| {' | '.join(cells)} |"


def scatter(found):
    """By effect: how many numbers, and by how much they and the worst of them scatter between
    seeds, in units of their stated errors."""
    out = {}
    for effect in found[0]["amounts"]:
        told = {}
        for one in found:
            for place, pair in one["amounts"][effect].items():
                told.setdefault(place, []).append(pair)
        pulls = [
            np.var(amounts, ddof=1) / np.mean(np.square(errors))
            for amounts, errors in (np.transpose(pairs) for pairs in told.values())
            if len(amounts) >= FEWEST
        ]
        if pulls:
            out[effect] = len(pulls), float(np.sqrt(np.mean(pulls))), float(np.sqrt(max(pulls)))
    return out


def steps(row):
    """Scores of the steps, and with the decision on each family reversed."""
    for what in ("steps", "families"):
        for step in row.get(what, ()):
            mark = "" if what == "steps" else "without " if step["kept"] else "with "
            yield (f"  {mark}{step['effect']}: {_figures(step)}, "
                   f"{step['parameters']} parameters")  # fmt: skip


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*")
    parser.add_argument("--iteration", default="first", choices=["first", "last"])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--families", action="store_true")
    parser.add_argument("--missing", action="store_true")
    parser.add_argument("--into", type=Path)
    parser.add_argument("--table", action="store_true")
    parser.add_argument("--pictures", type=Path)
    options = parser.parse_args()
    if options.table:
        stored = [json.loads(path.read_text()) for path in sorted(options.into.glob("*.json"))]
        for one in stored:
            print(
                *(f"{key} {one[key]}" for key in ("ring", "seed", "code", "iteration", "no_faults"))
            )
        names = dict.fromkeys(one["ring"] for one in stored)
        rings = [[one for one in stored if one["ring"] == name] for name in names]
        print(*table_of_seeds(rings), sep="\n")
        return
    if options.families:
        procedure.detected_faults = lambda *args: ((), [], [])
    if not os.environ.get("TMLATTICE_DATA"):
        sys.exit("TMLATTICE_DATA names no folder of measured data")
    if options.into:
        options.into.mkdir(parents=True, exist_ok=True)
    data = Path(os.environ["TMLATTICE_DATA"])
    rings = []
    with tempfile.TemporaryDirectory() as place:
        for name, files in sources(data).items():
            if options.names and not any(part in name for part in options.names):
                continue
            rings.append(ring(name, files, data, Path(place), options))
            print(*steps(rings[-1][0]), sep="\n", flush=True)
    print(*table(rings), "", *table_of_seeds(rings), sep="\n")
    if options.missing:
        print("", *table_of_missing(rings), sep="\n")
    for found in rings:
        good = [one for one in found if "error" not in one]
        for effect, (count, all_of_them, worst) in (scatter(good) if good else {}).items():
            print(f"{found[0]['ring']}, {effect}: {count} numbers scatter by {all_of_them:.2f} of "
                  f"their stated errors, one by {worst:.2f}")  # fmt: skip


if __name__ == "__main__":
    main()
