"""The errors of a ring by a network, along s."""

from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure

from tmlattice.plots.strip import above_strip

if TYPE_CHECKING:
    from tmlattice.fitting.weights import WeightReading

BINS = 120
"""Along s, in which the squares of layers' parts are added up for their shares."""

_COLOURS = ("tab:blue", "0.55", "tab:orange")


def plot_weights(reading: "WeightReading", mark: str | None = None) -> Figure:
    """Raw change, normalised score and shares of the parts of every layer, and the lattice; an
    element `mark` is dotted, such as the true cause."""
    from tmlattice.fitting.weight_parts import PARTS

    ring, split = reading.ring, reading.split
    figure, (raw, score, size, share) = above_strip(ring, (11, 8.2), [2, 2.6, 2, 2])
    s = np.array([magnet.s for magnet in ring.magnets])
    raw.vlines(s, 0, reading.raw, color="k", linewidth=0.6)
    raw.set_ylabel("raw change\n[m, rad, ...]")
    score.vlines(s, 0, reading.best, color="tab:red", linewidth=0.6)
    score.set_ylabel("normalised\nscore [sigma]")
    for ax, values in ((raw, reading.raw), (score, reading.best)):
        first = int(values.argmax())
        ax.plot(s[first], values[first], "o", ms=4, mfc="none", color="k")
        ax.annotate(
            f"{ring.magnets[first].name}, s = {s[first]:.1f} m", (s[first], values[first]),
            xytext=(6 if s[first] < 0.7 * ring.length else -6, -3), textcoords="offset points",
            ha="left" if s[first] < 0.7 * ring.length else "right", fontsize="small",
        )  # fmt: skip
        ax.set_ylim(0, 1.1 * values.max() if values.max() > 0 else 1.0)
    edges = np.linspace(0, ring.length, BINS + 1)
    squares = np.stack([np.histogram(s, edges, weights=w)[0] for w in (split.parts**2).T])
    whole = squares.sum(axis=0)
    below = np.zeros(BINS)
    for i, name in enumerate(PARTS):
        size.plot(s, split.parts[:, i], ".", ms=1.5, color=_COLOURS[i], label=name)
        top = below + squares[i] / np.where(whole > 0, whole, 1.0)
        share.stairs(top, edges, baseline=below, fill=True, color=_COLOURS[i])
        below = top
    largest = split.parts.max()
    if largest > 0:
        size.set_yscale("log")
        size.set_ylim(1e-3 * largest, 20 * largest)  # space for the text
    size.set_ylabel("parts [sigma]")
    size.legend(loc="upper right", ncols=3, fontsize="small", markerscale=5, framealpha=0.9)
    share.set_ylim(0, 1)
    share.set_ylabel("share of the\nsquare")
    for ax in (raw, score, size, share):
        if mark is not None:
            ax.axvline(ring[mark].s, color="0.4", linestyle=":", linewidth=1, zorder=0)
    dotted = "" if mark is None else f" (dotted: {mark}, s = {ring[mark].s:.1f} m)"
    raw.set_title(f"Weights after fine-tuning, layer by layer{dotted}")
    return figure
