"""Spectra of turn-by-turn signals."""

from typing import TYPE_CHECKING, Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes

from tmlattice.harmonics import levelled, normalised
from tmlattice.optics import Optics, one_turn_optics
from tmlattice.plots.strip import METHOD_COLOURS

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tmlattice.fitting import TuneFit


def plot_spectrum(
    states: "NDArray[np.float64]",
    plane: int,
    ax: Axes | None = None,
    optics: Optics | None = None,
    colour: str = "C0",
) -> Axes:
    """Amplitude of the lines of one trajectory in one plane, against the fractional tune.

    Args:
        states: at the start of each turn, [turns, n].
        plane: 0 for x, 1 for y.
        ax: where to draw; else a new one.
        optics: for the normalisation, which separates Q from 1 - Q.
        colour: of the line.
    """
    if ax is None:
        _, ax = plt.subplots()
    z = levelled(normalised(states, optics)[:, plane])
    turns = len(z)
    padded = 8 * turns
    spectrum = np.abs(np.fft.fft(z * np.hanning(turns), padded)) / turns * 2
    ax.semilogy(np.arange(padded) / padded, spectrum / spectrum.max(), color=colour, linewidth=0.8)
    ax.set_ylim(1e-6, 3)
    ax.set_xlim(0, 1)
    ax.set_ylabel(f"{'xy'[plane]}: amplitude [of the strongest line]")
    ax.set_xlabel("fractional tune")
    ax.grid(alpha=0.25)
    return ax


def plot_tune_fit_spectrum(outcome: "TuneFit", axes: "tuple[Axes, Axes]") -> None:
    """The spectra of each method's network, tracked, with the design's and the true tunes."""
    tunes: list[tuple[Any, str, str, str]] = [
        (outcome.design_tunes, "design", "C0", ":"),
        (outcome.true_tunes, "true", "k", "--"),
    ]
    for method in reversed(outcome.methods):  # the first on top
        colour = METHOD_COLOURS.get(method.method, "C4")
        tunes.append((method.tunes, method.method, colour, "-"))
        if method.signal is not None and method.fit is not None:
            optics = one_turn_optics(method.fit.network)
            for plane, ax in enumerate(axes):
                plot_spectrum(method.signal[0], plane, ax, optics, colour)
    for plane, ax in enumerate(axes):
        for tune, name, colour, style in tunes:
            if tune is not None:
                label = f"{name} {tune[plane]:.5f}"
                ax.axvline(
                    tune[plane], color=colour, linestyle=style, linewidth=1.1, label=label,
                    zorder=4 if name == "true" else 3,
                )  # fmt: skip
        ax.legend(loc="upper right", fontsize="small")
