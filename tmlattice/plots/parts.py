"""What several measurements of one machine leave, monitor by monitor."""

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from tmlattice.diagnosis.result import Diagnosis
from tmlattice.plots.readings import AFTER, BEFORE, mark
from tmlattice.plots.strip import lattice_strip, plain_log


def plot_parts(diagnosis: Diagnosis, figure: Figure | None = None) -> Figure:
    """Draw the rms residual at each BPM in units of the noise, a panel a measurement.

    Args:
        figure: an empty one; else a new one.
    """
    shown = [part for part in diagnosis.parts if np.isfinite(part.left).any()]
    count = len(shown)
    if figure is None:
        figure = plt.figure(figsize=(11, 1.6 + 1.8 * count), layout="constrained")
    axes = figure.subplots(count + 1, 1, sharex=True, height_ratios=[*[3.0] * count, 1.0])
    places = {monitor.name: monitor.s for monitor in diagnosis.ring.monitors}
    for ax, part in zip(axes, shown, strict=False):
        s = np.array([places[diagnosis.ring[name].name] for name in part.monitors])
        order = np.argsort(s)
        before, after = np.maximum(part.left[:, order], 1e-2)
        ax.plot(s[order], before, ".-", color=BEFORE, lw=0.8, ms=4, label=diagnosis.starting_model)
        ax.plot(s[order], after, ".-", color=AFTER, lw=0.8, ms=4, label="with the findings")
        ax.axhline(1.0, color="k", linestyle="--", linewidth=1)
        plain_log(ax)
        ax.set_ylabel("residual / noise")
        ax.set_title(part.label, loc="left", fontsize="medium")
        ax.grid(alpha=0.25)
        mark(ax, diagnosis)
    axes[0].legend(loc="lower right", bbox_to_anchor=(1, 1), ncols=2, frameon=False)
    lattice_strip(diagnosis.ring, axes[-1])
    return figure
