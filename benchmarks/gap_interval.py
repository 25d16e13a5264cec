"""Does the stated interval of the closed gap hold what is closed of the orbit without noise?

`python benchmarks/gap_interval.py FOLDER [--cases 40]`, a challenge of tier A, B or C.

Each case is diagnosed twice, with held-out readings as they were read and without their noise: the
same fit. The second has closed 1 - (rms after / rms before)^2; the first states an interval.
"""

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np

from tmlattice.challenge.case import case_names, read_case, read_truth, ring_of
from tmlattice.challenge.figures import rate
from tmlattice.diagnosis import diagnose


def main() -> None:
    """Print the share of intervals that hold, and each that does not."""
    arguments = argparse.ArgumentParser()
    arguments.add_argument("folder", type=Path)
    arguments.add_argument("--cases", type=int, default=40)
    given = arguments.parse_args()
    holds, sides, widths = [], [], []
    for name in case_names(given.folder)[: given.cases]:
        case, truth = read_case(given.folder, name), read_truth(given.folder, name)
        ring = ring_of(case.lattice)
        clean = truth.clean["heldout"].reshape(case.heldout.readings.shape)
        quiet = replace(
            case.heldout, readings=np.where(np.isnan(case.heldout.readings), np.nan, clean)
        )
        told, true = (
            diagnose(
                ring, case.fit, heldout=heldout, reference=case.reference,
                background=case.options.get("background"), effects=case.options.get("effects"),
            ).heldout
            for heldout in (case.heldout, quiet)
        )  # fmt: skip
        if told is None or true is None or told.interval is None:
            continue
        before, after = true.misfits[told.since].rms, true.misfits[-1].rms
        explained, (low, high) = 1 - (after / before) ** 2, told.interval
        holds.append(bool(low <= explained <= high))
        sides.append(explained - told.explained)
        widths.append((high - low) / 2)
        if not holds[-1]:
            print(f"{name}: stated {low:.4f} to {high:.4f}, true {explained:.4f}", flush=True)
    low, high = rate(holds)["interval"]
    print(f"{given.folder}: {sum(holds)} of {len(holds)} hold; a share of {low:.2f} to {high:.2f}")
    print(f"half width {np.median(widths):.4f} in the median, "
          f"true less stated {np.median(sides):+.4f}")  # fmt: skip


if __name__ == "__main__":
    main()
