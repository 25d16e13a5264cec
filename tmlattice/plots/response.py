"""Figures of an orbit response's diagnosis."""

from collections.abc import Iterator
from textwrap import wrap

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from tmlattice.arrays import Array
from tmlattice.diagnosis.result import Diagnosis
from tmlattice.effects import with_labels
from tmlattice.lattice import Element
from tmlattice.optics import Twiss, twiss
from tmlattice.plots.strip import GRID, Drawable, above_strip, plain_log

RESIDUALS = (
    ("heldout_rms_in_plane", "in-plane", "C0", "o"),
    ("heldout_rms_position", "in-plane, with position jump", "tab:cyan", "D"),
    ("heldout_rms_coupling", "coupling", "C3", "s"),
    ("dispersion_rms", "RF response", "C2", "^"),
)
"""Held-out residuals of a step: attribute, label, colour, marker."""


def step_labels(result: Diagnosis) -> list[list[str]]:
    """What is fitted in each step, and in each reversed decision, in lines."""
    steps = [result.starting_model, *(with_labels(step.effect) for step in result.steps[1:])]
    names = [*steps, *(own.reversed_decision for own in result.families)]
    return [wrap(name, 44) for name in names]


def gradient_errors(result: Diagnosis) -> list[tuple[Element, float, float]]:
    """Quadrupoles, their relative gradient errors and standard errors, %."""
    return [
        (result.ring[c.element or ""], 100 * c.amount, 100 * sigma)
        for c, sigma in zip(result.causes, result.errors, strict=True)
        if c.effect == "quadrupole_gradient"
    ]


def response_figures(result: Diagnosis) -> Iterator[Drawable]:
    """Every figure: (name, caption, function that draws it)."""
    if not result.stored:
        yield (
            "maps",
            "Orbit change by corrector and BPM, each corrector in its own plane: measured, and "
            f"residuals of the {result.starting_model} and the result. Grey: rejected or held out.",
            lambda: plot_maps(result),
        )
    yield (
        "steps",
        "The gap on held-out readings before and after, and with the decision on one family of "
        "errors reversed; vertical lines: of the hierarchical fit.",
        lambda: plot_steps(result),
    )
    if gradient_errors(result):
        yield (
            "gradients",
            "Gradient error of each quadrupole along the ring, with its posterior rms.",
            lambda: plot_gradients(result),
        )
        caption = "Beta of the result relative to the design's."
        yield "beta-beat", caption, lambda: plot_beta_beat(result)


def plot_maps(result: Diagnosis, figure: Figure | None = None) -> Figure:
    """Measured response, and what the design (or the reference) and the result leave of it; columns
    by plane and place."""
    figure = plt.figure(figsize=(11, 8), layout="constrained") if figure is None else figure
    view, ring = result.response, result.ring
    m = view.measured
    plane = np.array([int(p == "y") for p in m.planes])
    place = np.array([ring[name].s for name in m.correctors])
    order = np.lexsort((place, plane))
    rows = [
        ("measured", view.data),
        (f"measured - {result.starting_model}", view.data - view.design),
        ("measured - result", view.data - view.model),
    ]
    axes = figure.subplots(3, 1, sharex=True)
    for ax, (title, values) in zip(axes, rows, strict=True):
        image = 1e6 * np.take_along_axis(values[:-1], plane[:, None, None], 2)[order, :, 0]
        image[:, ~view.good] = np.nan
        if title.endswith("result"):
            image[view.held[:-1][order]] = np.nan
        limit = 4.0 * float(np.nanmedian(abs(image)))  # a plane of a single corrector sets no scale
        colours = plt.get_cmap("RdBu_r").with_extremes(bad="0.8")
        shown = ax.imshow(
            image.T, aspect="auto", cmap=colours, vmin=-limit, vmax=limit, origin="lower",
            interpolation="nearest",
        )  # fmt: skip
        ax.axvline(float((plane == 0).sum()) - 0.5, color="k", linewidth=0.8)
        ax.set_ylabel("BPM")
        ax.set_title(title, loc="left", fontsize=10)
        figure.colorbar(shown, ax=ax, label="µm")
    axes[-1].set_xlabel("corrector, along s: horizontal, then vertical")
    return figure


def plot_left(result: Diagnosis, figure: Figure | None = None) -> Figure:
    """Draw the residual of each fitted corrector in its own plane before and after, each in its own
    scale."""
    figure = plt.figure(figsize=(11, 4.2), layout="constrained") if figure is None else figure
    view = result.response
    plane = np.array([int(p == "y") for p in view.measured.planes])
    shown = [k for k in np.argsort(plane, kind="stable") if not view.held[k]]
    axes = figure.subplots(1, 2, sharey=True)
    models = {result.starting_model: view.design, "result": view.model}
    for ax, (name, model) in zip(axes, models.items(), strict=True):
        left = 1e6 * (view.data - model)[shown][:, view.good]
        left = left[np.arange(len(shown)), :, plane[shown]]
        limit = float(np.nanpercentile(abs(left), 98))
        image = ax.imshow(left.T, aspect="auto", cmap="RdBu_r", vmin=-limit, vmax=limit)
        rms = float(np.sqrt(np.nanmean(left**2)))
        ax.set_title(f"{name}: {rms:.3g} µm rms", loc="left", fontsize="medium")
        ax.set_xlabel("corrector: horizontal, then vertical")
        ax.locator_params(integer=True)
        figure.colorbar(image, ax=ax, label="measured less model [µm]")
    axes[0].set_ylabel("BPM, along the ring")
    return figure


def plot_steps(result: Diagnosis, ax: Axes | None = None) -> Axes:
    """Held-out rms of each step, and with the decision on each family reversed; thin lines: of the
    fit with the decisions as they are."""
    labels = step_labels(result)
    height = np.maximum([len(lines) for lines in labels], 2) / 2  # a long label takes more room
    at = np.cumsum(height) - height / 2
    if ax is None:
        ax = plt.subplots(figsize=(9, 1.5 + 0.25 * sum(height)), layout="constrained")[1]
    for name, label, colour, marker in RESIDUALS:
        values = [1e6 * getattr(step, name) for step in (*result.steps, *result.families)]
        ax.plot(values, at, marker, color=colour, ms=5, label=label)
        if result.families:
            ax.axvline(values[min(1, len(result.steps) - 1)], color=colour, linewidth=0.5)
    sigma = 1e6 * result.gap["noise"]
    ax.axvline(sigma, color="0.5", linestyle=":", label="noise of a reading")
    plain_log(ax.xaxis)
    ax.set_xlabel("held-out rms [µm]")
    ax.set_yticks(at, ["\n".join(lines) for lines in labels], fontsize=7)
    ax.axhline(sum(height[: len(result.steps)]), color="0.4", linewidth=0.8)
    ax.invert_yaxis()
    ax.grid(alpha=GRID)
    ax.legend(frameon=False, fontsize=8)
    return ax


def plot_gradients(result: Diagnosis, figure: Figure | None = None) -> Figure:
    """Relative gradient errors with their errors; findings and suspects have their names."""
    figure, (ax,) = above_strip(result.ring, (11, 4), [5], figure)
    s, amount, sigma = np.array([(e.s, a, sigma) for e, a, sigma in gradient_errors(result)]).T
    ax.errorbar(
        s, amount, sigma, fmt="s", color="tab:red", ecolor="0.6", markersize=3, elinewidth=0.8
    )
    named = {found.element for found in result.findings} | {s.element for s in result.suspects}
    for element, value, _ in gradient_errors(result):
        if element.name in named:
            ax.annotate(element.name, (element.s, value), xytext=(5, 0), va="center",
                        textcoords="offset points", fontsize="small")  # fmt: skip
    ax.axhline(0, color="0.4", linewidth=0.5)
    ax.set_ylabel("gradient error [%]")
    return figure


def beta_beats(result: Diagnosis) -> tuple[Twiss, Array, Array]:
    """The design's optics, and beta of the estimated ring relative to the design's: s, m, and
    beating in per cent, [place, 2]."""
    design = twiss(result.ring)
    (s, before), (_, after) = design.along(), twiss(result.corrected).along()
    return design, s, 100 * (after / before - 1)


def plot_beta_beat(result: Diagnosis) -> Figure:
    """Beta of the result relative to the design, above the lattice."""
    figure, (ax,) = above_strip(result.ring, (11, 4), [5])
    _, s, beats = beta_beats(result)
    for plane, colour in enumerate(("C0", "C3")):
        ax.plot(s, beats[:, plane], color=colour, linewidth=0.8, label="xy"[plane])
    ax.set_ylabel(f"beta / {result.starting_model} - 1 [%]")
    ax.legend(frameon=False)
    return figure
