"""The beta beating, or the first turns, of a ring now and after a correction."""

import numpy as np
from matplotlib.figure import Figure

from tmlattice.correction.result import Correction
from tmlattice.correction.targets import TARGETS
from tmlattice.plots.readings import AFTER, BEFORE
from tmlattice.plots.strip import above_strip

CAPTION = "At the BPMs now, and expected after the correction, with 68 % intervals."


def plot_correction(correction: Correction) -> Figure:
    """The errors of the shown target at the BPMs now and expected, a panel a plane, the lattice
    below."""
    figure, axes = above_strip(correction.ring, (11, 5.2), [3, 3])
    target = TARGETS[correction.shown]
    scale, unit = (100.0, "%") if target.unit == "relative" else (1e3, "mm")
    shown = [(correction.profile[0], BEFORE, "now")]
    if not correction.refused:
        shown.append((correction.profile[1], AFTER, "expected"))
    for plane, ax in enumerate(axes):
        for values, colour, label in shown:
            middle, low, high = scale * np.array(values)[:, plane].T
            ax.errorbar(
                correction.s, middle, (middle - low, high - middle), color=colour, label=label,
                fmt="o" if label == "now" else "s", ms=4, elinewidth=1, alpha=0.8,
            )  # fmt: skip
        ax.axhline(0.0, color="k", lw=0.7)
        ax.set_ylabel(f"{target.words} {'xy'[plane]} [{unit}]", fontsize="small")
        ax.grid(alpha=0.25)
    axes[0].legend(loc="lower right", bbox_to_anchor=(1, 1), ncols=2, frameon=False)
    return figure
