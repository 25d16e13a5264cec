"""Results of the blind challenge: confusion, calibration, detection."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes

from tmlattice.plots.strip import GRID, save_figure

LAST = ("ambiguous", "unknown", "none")


def plot_confusion(result: Mapping[str, Any], ax: Axes | None = None) -> Axes:
    """Draw the confusion matrix: the share of each first effect of the diagnosis, by true
    effect."""
    table = result["confusion"]
    rows = list(table)
    wrong = {name for entry in table.values() for name in entry} - set(LAST)
    columns = [*rows, *sorted(wrong - set(rows)), *LAST]
    if ax is None:
        size = (0.32 * len(columns) + 3.2, 0.28 * len(rows) + 2.6)
        _, ax = plt.subplots(figsize=size, layout="constrained")
    counts = np.array([[table[r].get(c, 0) for c in columns] for r in rows], dtype=float)
    shares = counts / np.maximum(counts.sum(axis=1, keepdims=True), 1)
    ax.imshow(np.where(counts > 0, shares, np.nan), cmap="Blues", vmin=0, vmax=1, aspect="auto")
    for i, j in np.argwhere(counts > 0):
        color = "white" if shares[i, j] > 0.6 else "black"
        ax.text(j, i, f"{counts[i, j]:.0f}", ha="center", va="center", fontsize=6, color=color)
    ax.axvline(len(columns) - len(LAST) - 0.5, color="0.4", linewidth=0.8)
    ax.set_xticks(range(len(columns)), columns, rotation=90, fontsize=7)
    ax.set_yticks(range(len(rows)), rows, fontsize=7)
    ax.set_xlabel("stated first (ambiguous: true effect in the stated class)")
    ax.set_ylabel("true effect")
    ax.set_title(f"tier {result['tier']}: number of cases, shade by share of the row", fontsize=9)
    return ax


def _rates(entries: Any) -> tuple[np.ndarray, np.ndarray]:
    share = np.array([e["share"] for e in entries])
    return share, np.abs(np.array([e["interval"] for e in entries]).T - share)


def plot_calibration(result: Mapping[str, Any], ax: Axes | None = None) -> Axes:
    """Stated probabilities of the members of credible sets, and how many are true."""
    if ax is None:
        _, ax = plt.subplots(figsize=(5, 4.5), layout="constrained")
    bins = [b for b in result["calibration"] if b["true"]["cases"]]
    ax.plot([0, 1], [0, 1], color="0.6", linestyle="--", linewidth=0.9, label="calibrated")
    if bins:
        share, error = _rates([b["true"] for b in bins])
        ax.errorbar([b["stated"] for b in bins], share, error, fmt="o", color="C0", capsize=2,
                    label="members of credible sets (95 % interval)")  # fmt: skip
        for b, y in zip(bins, share, strict=True):
            left = b["stated"] > 0.95
            ax.annotate(str(b["true"]["cases"]), (b["stated"], y), xytext=(-5 if left else 5, -10),
                        ha="right" if left else "left", textcoords="offset points", fontsize=7,
                        color="0.35")  # fmt: skip
    ax.set(xlabel="stated probability", ylabel="share that is true", xlim=(-0.02, 1.02),
           ylim=(-0.02, 1.02))  # fmt: skip
    ax.grid(alpha=GRID)
    ax.legend(fontsize="small", loc="lower right")
    return ax


def plot_detection(result: Mapping[str, Any], ax: Axes | None = None) -> Axes:
    """Share of faults that are seen, against signal to noise, diagnosis and oracle."""
    if ax is None:
        _, ax = plt.subplots(figsize=(6, 4), layout="constrained")
    for name, label, color, shift in (
        ("tool", "diagnose", "C0", 0.985),
        ("oracle", "oracle", "C1", 1.015),
    ):
        some = [e for e in result["detection"] if e[name]["cases"]]
        if some:
            share, error = _rates([e[name] for e in some])
            middle = [shift * np.sqrt(e["from"] * e["to"]) for e in some]
            ax.errorbar(middle, share, error, fmt="o-", color=color, capsize=2, label=label)
    ax.set_xscale("log")
    ax.set_xticks([5, 10, 20, 50, 100], ["5", "10", "20", "50", "100"])
    ax.minorticks_off()
    ax.set(xlabel="signal to noise", ylabel="share detected", ylim=(-0.02, 1.04))
    ax.grid(alpha=GRID)
    ax.legend(fontsize="small", loc="lower right")
    return ax


def save_challenge(result: Mapping[str, Any], folder: Path) -> None:
    """All figures that the tier has, as PNG."""
    plots = {
        "confusion": plot_confusion,
        "calibration": plot_calibration,
        "detection": plot_detection,
    }
    for name, plot in plots.items():
        if result.get(name):
            figure = plot(result).get_figure(root=True)
            assert figure is not None
            save_figure(figure, folder / f"{name}.png")
