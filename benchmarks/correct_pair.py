"""LNLS, 14 quadrupole supplies changed on purpose: are the settings from before given back?

`TMLATTICE_DATA=... python benchmarks/correct_pair.py`

The pair `lnls_2014-07-17_before` and `_after` is imported, the change diagnosed, and "after"
corrected towards "before" with the 14 supplies as knobs, in ampere by their excitation curves.
Printed for each supply: the change that is asked for, the change back in the control system's
record, and how far the asked strength is from the negative of the diagnosed change, in its errors.
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
    print(correction.words)
    rows = []
    print(f"{'supply':8s}{'asked, A':>10s}{'record, A':>11s}{'pull':>7s}")
    for setting in sorted(correction.settings, key=lambda own: own.knob.name):
        knob = setting.knob
        amount, sigma = diagnosis.error("family_gradient", knob.name)
        pull = (setting.amount - (1 / (1 + amount) - 1)) / sigma
        back = currents["before"][knob.name.upper()]
        rows.append((knob.amount(back), setting.amount, pull))
        print(f"{knob.name:8s}{setting.new - knob.present:+10.3f}{back - knob.present:+11.3f}"
              f"{pull:+7.2f}")  # fmt: skip
    record, asked, pull = np.array(rows).T
    print(f"{len(rows)} supplies; signs as in the record: {np.sum(record * asked > 0)}; asked over "
          f"recorded change of strength: {asked @ record / (record @ record):.3f}; pulls from the "
          f"diagnosed changes: rms {np.sqrt(np.mean(pull**2)):.2f}, largest "
          f"{np.abs(pull).max():.2f}")  # fmt: skip


if __name__ == "__main__":
    main()
