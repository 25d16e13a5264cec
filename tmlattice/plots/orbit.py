"""Readings along the ring."""

from typing import TYPE_CHECKING

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from tmlattice.plots.strip import METHOD_COLOURS, lattice_strip

if TYPE_CHECKING:
    from tmlattice.fitting import TuneFit


def plot_orbit(
    s: ArrayLike, position: ArrayLike, ax: Axes | None = None, label: str = "", style: str = "-"
) -> Axes:
    """Position of the beam at the monitors.

    Args:
        s: [monitor], m.
        position: one plane, [monitor], m.
        ax: where to draw; else a new one.
        label, style: of the line.
    """
    if ax is None:
        _, ax = plt.subplots()
    ax.plot(np.asarray(s), 1e3 * np.asarray(position), style, label=label, linewidth=0.9, ms=2.5)
    ax.set_ylabel("position [mm]")
    return ax


def plot_orbit_fit(outcome: "TuneFit", figure: Figure | None = None) -> Figure:
    """What the monitors read, the design's orbit and each method's, their residuals, the lattice.

    Args:
        outcome: of `tune_fit`.
        figure: an empty one; else a new one.
    """
    figure = plt.figure(figsize=(11, 8.2), layout="constrained") if figure is None else figure
    noise = "" if outcome.noise is None else f", noise {1e6 * outcome.noise:.1f} µm"
    magnet = None if outcome.magnet is None else outcome.ring[outcome.magnet]
    grid = figure.subplots(5, 1, sharex=True, height_ratios=[3, 2, 3, 2, 0.8])
    for plane, name in enumerate("xy"):
        orbit, residual = grid[2 * plane], grid[2 * plane + 1]
        measured = outcome.measured[:, plane]
        plot_orbit(outcome.s, measured, orbit, "read by the monitors", "k.")
        plot_orbit(outcome.s, outcome.before[:, plane], orbit, "design network", "C0-")
        fitted = [m for m in reversed(outcome.methods) if m.fit is not None]  # the first on top
        for method in fitted:
            plot_orbit(outcome.s, method.after[:, plane], orbit, method.method)
            orbit.lines[-1].set_color(METHOD_COLOURS.get(method.method, "C4"))
        orbit.set_ylabel(f"{name} [mm]")
        rms = []
        models = [("before", outcome.before, "C0")]
        models += [(m.method, m.after, METHOD_COLOURS.get(m.method, "C4")) for m in fitted]
        for what, model, colour in models:
            left = measured - model[:, plane]
            if np.isfinite(left).any():
                rms.append(f"{what} {1e6 * np.sqrt(np.nanmean(left**2)):.1f} µm")
            residual.plot(outcome.s, 1e3 * left, color=colour, linewidth=0.8)
        residual.set_ylabel(f"residual {name} [mm]")
        residual.annotate(
            f"rms {', '.join(rms) or '-'}{noise}",
            (0.01, 0.95), xycoords="axes fraction", va="top", fontsize="small",
        )  # fmt: skip
        low, high = residual.get_ylim()
        residual.set_ylim(low, high + 0.25 * (high - low))  # space for the text
        for ax in (orbit, residual):
            if magnet is not None:
                ax.axvline(magnet.s, color="0.6", linestyle=":", linewidth=1)
            ax.grid(alpha=0.25)
    grid[0].legend(loc="upper right", ncols=5, fontsize="small", framealpha=0.9)
    if magnet is None or outcome.change is None:
        grid[0].set_title(f"First turn of {outcome.source or 'a measurement'}")
    else:
        grid[0].set_title(
            f"First turn with {outcome.magnet} changed by {100 * outcome.change:+g} % "
            f"(dotted, s = {magnet.s:.1f} m)"
        )
    lattice_strip(outcome.ring, grid[4])
    return figure
