"""The beta beating of a ring now, and what is expected of it after a correction."""

import matplotlib.pyplot as plt
from matplotlib.figure import Figure

from tmlattice.correction.result import Correction
from tmlattice.plots.readings import AFTER, BEFORE
from tmlattice.plots.strip import lattice_strip

CAPTION = "Beta beating at the BPMs now, and expected after the correction, with 68 % bands."


def plot_correction(correction: Correction, figure: Figure | None = None) -> Figure:
    """Beta beating at the BPMs now and expected, a panel a plane, the lattice below.

    Args:
        correction: of `correct`.
        figure: an empty one; else a new one.
    """
    if figure is None:
        figure = plt.figure(figsize=(11, 5.2), layout="constrained")
    *axes, strip = figure.subplots(3, 1, sharex=True, height_ratios=[3, 3, 1])
    shown = [(correction.beating[0], BEFORE, "now")]
    if not correction.refused:
        shown.append((correction.beating[1], AFTER, "expected"))
    for plane, ax in enumerate(axes):
        for values, colour, label in shown:
            middle, low, high = 100 * values[:, plane].T
            ax.plot(correction.s, middle, ".-", color=colour, lw=0.9, ms=4, label=label)
            ax.fill_between(correction.s, low, high, color=colour, alpha=0.25, lw=0)
        ax.axhline(0.0, color="k", lw=0.7)
        ax.set_ylabel(f"beta beating {'xy'[plane]} [%]")
        ax.grid(alpha=0.25)
    axes[0].legend(loc="lower right", bbox_to_anchor=(1, 1), ncols=2, frameon=False)
    lattice_strip(correction.ring, strip)
    return figure
