"""How a fit went."""

from collections.abc import Mapping
from typing import TYPE_CHECKING

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes

from tmlattice.plots.strip import METHOD_COLOURS

if TYPE_CHECKING:
    from tmlattice.fitting import FitResult


def plot_loss(
    fit: "FitResult",
    ax: Axes | None = None,
    floor: float | None = None,
    others: Mapping[str, float] | None = None,
) -> Axes:
    """Loss and weighted penalty of every epoch.

    Args:
        fit: of `fine_tune`.
        ax: where to draw; else a new one.
        floor: the loss that noise alone would leave, m^2.
        others: the loss of other methods, m^2, by name.
    """
    if ax is None:
        _, ax = plt.subplots()
    ax.semilogy(fit.loss, color="C3", label="loss (sum of squared residuals)")
    rate = fit.options["regularization_rate"]
    penalty = rate * np.asarray(fit.penalty)
    if (penalty > 0).any():
        label = f"{rate:g} x {fit.options['regularization']} penalty"
        ax.semilogy(np.where(penalty > 0, penalty, np.nan), color="C2", label=label)
    if floor:
        ax.axhline(floor, color="k", linestyle="--", linewidth=0.9, label="noise alone")
    for name, loss in (others or {}).items():
        ax.axhline(loss, color=METHOD_COLOURS.get(name, "0.3"), linewidth=0.9, label=name)
    ax.axvline(fit.best_epoch, color="0.6", linestyle=":", label="weights kept from here")
    ax.set_xlabel("epoch")
    ax.set_ylabel("loss [m²]")
    ax.grid(alpha=0.25)
    ax.legend(fontsize="small")
    return ax
