"""Figures of tune fits: the readings along the ring, the loss, the spectra; errors of many."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from tmlattice.harmonics import levelled, normalised
from tmlattice.optics import Optics, one_turn_optics
from tmlattice.plots.strip import GRID, METHOD_COLOURS, above_strip, legend_above, text_at_top

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tmlattice.fitting import FitResult, TuneFit
    from tmlattice.fitting.study import Case
    from tmlattice.lattice import Ring


def plot_orbit(
    s: ArrayLike, position: ArrayLike, ax: Axes | None = None, label: str = "", style: str = "-"
) -> Axes:
    """Position of the beam at the monitors in one plane: `s` and `position` [monitor], m."""
    if ax is None:
        _, ax = plt.subplots()
    ax.plot(np.asarray(s), 1e3 * np.asarray(position), style, label=label, linewidth=0.9, ms=2.5)
    ax.set_ylabel("position [mm]")
    return ax


def plot_orbit_fit(outcome: "TuneFit") -> Figure:
    """What the monitors read, the design's orbit and each method's, their residuals, the
    lattice."""
    figure, grid = above_strip(outcome.ring, (11, 8.2), [3, 2, 3, 2])
    noise = "" if outcome.noise is None else f", noise {1e6 * outcome.noise:.1f} µm"
    magnet = None if outcome.magnet is None else outcome.ring[outcome.magnet]
    for plane, name in enumerate("xy"):
        orbit, residual = grid[2 * plane], grid[2 * plane + 1]
        measured = outcome.measured[:, plane]
        plot_orbit(outcome.s, measured, orbit, "read by the BPMs", "k.")
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
        text_at_top(residual, f"rms {', '.join(rms) or '-'}{noise}", 0.25)
        for ax in (orbit, residual):
            if magnet is not None:
                ax.axvline(magnet.s, color="0.6", linestyle=":", linewidth=1)
    legend_above(grid[0], 5, fontsize="small")
    title = f"First turn of {outcome.source or 'a measurement'}"
    if magnet is not None and outcome.change is not None:
        title = (
            f"First turn with {outcome.magnet} changed by {100 * outcome.change:+g} % "
            f"(dotted, s = {magnet.s:.1f} m)"
        )
    grid[0].set_title(title, loc="left", fontsize="medium")
    return figure


def plot_loss(
    fit: "FitResult",
    ax: Axes | None = None,
    floor: float | None = None,
    others: Mapping[str, float] | None = None,
) -> Axes:
    """Loss and weighted penalty of every epoch.

    Args:
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
        ax.semilogy(np.where(penalty > 0, penalty, np.nan), color="C0", label=label)
    if floor:
        ax.axhline(floor, color="k", linestyle="--", linewidth=0.9, label="noise alone")
    for name, loss in (others or {}).items():
        ax.axhline(loss, color=METHOD_COLOURS.get(name, "0.3"), linewidth=0.9, label=name)
    ax.axvline(fit.best_epoch, color="0.6", linestyle=":", label="weights kept from here")
    ax.set_xlabel("epoch")
    ax.set_ylabel("loss [m²]")
    ax.grid(alpha=GRID)
    ax.legend(fontsize="small", loc="center right")
    return ax


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
        optics: for the normalisation, which separates Q from 1 - Q.
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
    ax.grid(alpha=GRID)
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


SMALLEST = 1e-9
"""Errors below are drawn here: the axis is logarithmic."""


def plot_study(ring: "Ring", cases: "Sequence[Case]", figure: Figure | None = None) -> Figure:
    """|dQx| and |dQy| of every case against the place of its magnet, a colour and a marker a
    method.

    Cases with an unstable ring, or without a prediction, are crosses at the foot.
    """
    figure, grid = above_strip(ring, (11, 7), [3, 3], figure)
    methods = list(dict.fromkeys(case.method for case in cases))
    without = sorted({c.s for c in cases if c.absolute_error is None and np.isfinite(c.s)})
    for plane, name in enumerate("xy"):
        ax = grid[plane]
        for k, (method, marker) in enumerate(zip(methods, "os^Dv<>", strict=False)):
            colour = METHOD_COLOURS.get(method, f"C{4 + k}")
            good = [c for c in cases if c.method == method and c.absolute_error is not None]
            errors = [max(c.absolute_error[plane], SMALLEST) for c in good if c.absolute_error]
            label = method
            if errors:
                label += f", median {np.median(errors):.1e}"
                ax.axhline(float(np.median(errors)), color=colour, linewidth=0.8, alpha=0.6)
            ax.plot([c.s for c in good], errors, marker, color=colour, ms=3, label=label)
        if without:
            ax.plot(without, np.full(len(without), 0.03), "x", color="0.5", ms=4,
                    transform=ax.get_xaxis_transform(), label="no tune")  # fmt: skip
        ax.set_yscale("log")
        ax.set_ylabel(f"|dQ{name}|")
        ax.legend(loc="lower right", bbox_to_anchor=(1, 1), ncols=5, fontsize="small")
    figure.suptitle("Tune error after fine-tuning, by the place of the changed magnet")
    return figure
