"""The lattice strip under anything that is plotted against s."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.collections import PatchCollection
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.ticker import LogLocator, NullFormatter

from tmlattice.lattice import Element, Ring

COLOURS = {
    "bend": "tab:blue",
    "quadrupole": "tab:red",
    "sextupole": "tab:green",
    "wiggler": "tab:purple",
    "cavity": "tab:orange",
}


GRID = 0.25
"""Opacity of a grid."""
Drawable = tuple[str, str, Callable[[], Figure | Axes]]
"""Name and caption of a figure, and the function that draws it."""
METHOD_COLOURS = {"adam": "C3", "sparse": "C2", "map": "C1"}
"""Colours of the methods of a fit, in every figure."""


def above_strip(
    ring: Ring, size: tuple[float, float], heights: Sequence[float], figure: Figure | None = None
) -> tuple[Figure, list[Axes]]:
    """Panels of these heights with a grid and the lattice below, in an empty figure or in a new one
    of this size: the figure, and the panels."""
    figure = plt.figure(figsize=size, layout="constrained") if figure is None else figure
    *axes, strip = figure.subplots(len(heights) + 1, 1, sharex=True, height_ratios=[*heights, 0.8])
    lattice_strip(ring, strip)
    for ax in axes:
        ax.grid(alpha=GRID)
    return figure, axes


def save_figure(figure: Figure, path: Path) -> None:
    """Write a figure as PNG, and close it."""
    figure.savefig(path, dpi=150, format="png")
    plt.close(figure)


def text_at_top(ax: Axes, text: str, room: float) -> None:
    """A text in the upper left corner, the limits raised by this share of their span for it."""
    ax.annotate(text, (0.01, 0.95), xycoords="axes fraction", va="top", fontsize="small")
    low, high = ax.get_ylim()
    ax.set_ylim(low, high + room * (high - low))


def legend_above(ax: Axes, columns: int, **look: Any) -> None:
    """A legend without a frame above an axes, at its right."""
    ax.legend(loc="lower right", bbox_to_anchor=(1, 1), ncols=columns, frameon=False, **look)


def lattice_strip(ring: Ring, ax: Axes) -> Axes:
    """Draw the magnets of a ring along s into a low, wide axes: bends blue, quadrupoles red (up
    focuses in x), sextupoles green, wigglers purple."""
    widest = ring.length / 600  # so that a short magnet is still seen on a whole ring
    for kind, colour in COLOURS.items():
        boxes = []
        for element in (e for e in ring.elements if e.kind == kind and shown(e)):
            width = max(element.length, widest)
            bottom, top = extent(element)
            boxes.append(Rectangle((element.s - width / 2, bottom), width, top - bottom))
        ax.add_collection(PatchCollection(boxes, facecolor=colour, edgecolor="none"))
    ax.axhline(0, color="0.4", linewidth=0.5, zorder=0)
    ax.set_xlim(0, ring.length)
    ax.set_ylim(-1.2, 1.2)
    ax.set_yticks([])
    for side in ("left", "right", "top"):
        ax.spines[side].set_visible(False)
    ax.set_xlabel("s [m]")
    return ax


def shown(element: Element) -> bool:
    """Whether a magnet is drawn: no quadrupole or sextupole of zero strength."""
    return element.kind not in ("quadrupole", "sextupole") or _sign(element) != 0


def extent(element: Element) -> tuple[float, float]:
    """From where to where a magnet is drawn: what focuses in x above the axis."""
    if element.kind not in ("quadrupole", "sextupole"):
        return -0.3, 0.3
    return (0.0, 1.0) if _sign(element) > 0 else (-1.0, 0.0)


def _sign(element: Element) -> float:
    return element.k1 if element.kind == "quadrupole" else element.k2


def plain_log(axis: Axis) -> None:
    """A logarithmic scale with labels 1, 2, 5, 10 instead of powers."""
    axis.axes.set(**{"xscale" if axis is axis.axes.xaxis else "yscale": "log"})
    axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axis.set_major_formatter("{x:g}")
    axis.set_minor_formatter(NullFormatter())
