"""LNLS, 14 quadrupole supplies changed on purpose: found, and corrected.

`TMLATTICE_DATA=... python benchmarks/correct_pair.py`

The pair `lnls_2014-07-17_before` and `_after` is imported, the change diagnosed, and "after"
corrected towards "before" with the 14 supplies as knobs, in ampere by their excitation curves.
The table has how many changed supplies are found, and compares the settings with the changes back
in the control system's record and with the diagnosed changes.
"""

import json
import os
import subprocess
import sys
import tempfile
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np

from tmlattice import correct, diagnose, load_ring, read_measurement
from tmlattice.correction import default_knobs

NAME = "lnls_2014-07-17"


def curve(path):
    """Points (current, integrated gradient) of an excitation curve."""
    points = {}
    for line in path.read_text(encoding="latin-1").splitlines():
        try:
            current, gradient = (float(word) for word in line.split()[:2])
        except ValueError:
            continue
        points[current] = gradient
    return tuple(sorted(points.items()))


def main() -> None:
    """Print the table."""
    warnings.simplefilter("ignore")
    data = Path(os.environ["TMLATTICE_DATA"]) / "real_rings"
    currents = {}
    with tempfile.TemporaryDirectory() as place:
        for when in ("before", "after"):
            subprocess.run(
                [sys.executable, "-m", "tmlattice", "import", data / f"{NAME}_{when}.loco.mat",
                 "--out", Path(place) / when], check=True, capture_output=True,
            )  # fmt: skip
            record = json.loads((data / f"{NAME}_{when}.setpoints.json").read_text())
            currents[when] = {k: float(np.mean(v["value"])) for k, v in record.items()}
        ring = load_ring(Path(place) / "before" / "lattice.json")
        before, after = (read_measurement(Path(place) / when) for when in ("before", "after"))
    diagnosis = diagnose(ring, after, reference=before)
    knobs = [
        replace(knob, unit="A", present=currents["after"][knob.name.upper()],
                curve=curve(data / "lnls_excitation_curves" / f"{knob.name.upper()}.TXT"))
        for knob in default_knobs(ring, ["supplies"]) if knob.name.upper() in currents["after"]
    ]  # fmt: skip
    correction = correct(diagnosis, knobs=knobs)
    rows = []
    for setting in correction.settings:
        amount, sigma = diagnosis.error("family_gradient", setting.knob.name)
        pull = (setting.amount - (1 / (1 + amount) - 1)) / sigma
        back = setting.knob.amount(currents["before"][setting.knob.name.upper()])
        rows.append((back, setting.amount, pull))
    record, asked, pull = np.array(rows).T
    known = {knob.name for knob in knobs}
    found = [f for f in diagnosis.findings if f.element in known]
    statistic = np.abs([f.amount / f.amount_sigma for f in found])
    print("| quantity | result |\n|---|---|")
    print(f"| changed supplies that are found | {len(statistic)} of {len(knobs)}, at "
          f"{statistic.min():.1f} to {statistic.max():.1f} standard errors |")  # fmt: skip
    print(f"| other findings | {len(diagnosis.findings) - len(statistic)} |")
    print(f"| settings with the sign of the record | {np.sum(record * asked > 0)} of {len(rows)} |")
    print("| setting over the recorded change of strength | "
          f"{asked @ record / (record @ record):.2f} |")  # fmt: skip
    print(f"| setting minus the diagnosed change, in standard errors, largest | "
          f"{np.abs(pull).max():.2f} |")  # fmt: skip
    for name, words, factor, unit in (("beta_beating", "beta beating", 100, "%"),
                                      ("dispersion", "dispersion error", 1e3, "mm")):  # fmt: skip
        now, (then, low, high) = correction.before[name][0][0], correction.after[name][0]
        print(f"| {words} in x, rms: now, expected | {factor * now:.3g} {unit}, "
              f"{factor * then:.2g} ± {factor * (high - low) / 2:.1g} {unit} |")  # fmt: skip


if __name__ == "__main__":
    main()
