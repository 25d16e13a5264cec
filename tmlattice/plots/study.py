"""Tune errors over the ring."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from tmlattice.lattice import Ring
from tmlattice.plots.strip import lattice_strip

if TYPE_CHECKING:
    from tmlattice.fitting.study import Case

SMALLEST = 1e-9
"""Errors below are drawn here: the axis is logarithmic."""


def plot_study(ring: Ring, cases: "Sequence[Case]", figure: Figure | None = None) -> Figure:
    """|dQx| and |dQy| of every case against the place of its magnet, one colour a method.

    Cases with an unstable ring, or without a prediction, are crosses at the foot.

    Args:
        ring: the design.
        cases: of `study_tune_fit`.
        figure: an empty one; else a new one.
    """
    figure = plt.figure(figsize=(11, 7), layout="constrained") if figure is None else figure
    grid = figure.subplots(3, 1, sharex=True, height_ratios=[3, 3, 0.7])
    methods = list(dict.fromkeys(case.method for case in cases))
    without = sorted({c.s for c in cases if c.absolute_error is None and np.isfinite(c.s)})
    for plane, name in enumerate("xy"):
        ax = grid[plane]
        for colour, method in enumerate(methods):
            good = [c for c in cases if c.method == method and c.absolute_error is not None]
            errors = [max(c.absolute_error[plane], SMALLEST) for c in good if c.absolute_error]
            label = method
            if errors:
                label += f", median {np.median(errors):.1e}"
                ax.axhline(float(np.median(errors)), color=f"C{colour}", linewidth=0.8, alpha=0.6)
            ax.plot([c.s for c in good], errors, ".", color=f"C{colour}", ms=4, label=label)
        if without:
            ax.plot(without, np.full(len(without), 0.03), "x", color="0.5", ms=4,
                    transform=ax.get_xaxis_transform(), label="no tune")  # fmt: skip
        ax.set_yscale("log")
        ax.set_ylabel(f"|dQ{name}|")
        ax.grid(alpha=0.25)
        ax.legend(loc="lower right", bbox_to_anchor=(1, 1), ncols=5, fontsize="small")
    figure.suptitle("Tune error after fine-tuning, by the place of the changed magnet")
    lattice_strip(ring, grid[2])
    return figure
