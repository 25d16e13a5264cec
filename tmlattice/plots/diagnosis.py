"""Figures of a diagnosis."""

from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import partial
from textwrap import wrap

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from tmlattice.arrays import Array
from tmlattice.diagnosis.result import Diagnosis, Finding
from tmlattice.effects import find
from tmlattice.inference.judgement import DEFAULT
from tmlattice.inference.scan import free_threshold
from tmlattice.plots.plan import brief, plot_plan
from tmlattice.plots.readings import (
    AFTER,
    BEFORE,
    mark,
    parts_along,
    plot_parts,
    plot_readings,
    readings_caption,
)
from tmlattice.plots.response import response_figures
from tmlattice.plots.strip import GRID, Drawable, above_strip, lattice_strip, legend_above
from tmlattice.speaks import micrometres

STYLES: Mapping[str, tuple[str, str]] = {
    "quadrupoles": ("tab:red", "s"),
    "bends": ("tab:blue", "v"),
    "correctors": ("tab:orange", "^"),
    "sextupoles": ("tab:green", "D"),
    "insertion devices": ("tab:purple", "P"),
    "monitors": ("tab:cyan", "o"),
    "beam": ("tab:brown", "X"),
}
"""Colour and marker by the group of an effect."""

WIDE = 300.0
"""A finding whose place is wider than this is not drawn near by, m."""


def figures(diagnosis: Diagnosis) -> Iterator[tuple[str, str, Figure]]:
    """Every figure that a diagnosis has: (name, caption, figure); close each after use."""
    for name, caption, draw in drawable(diagnosis):
        yield name, caption, drawn(draw)


def drawn(draw: Callable[[], Figure | Axes]) -> Figure:
    """The figure that a function draws."""
    made = draw()
    figure = made if isinstance(made, Figure) else made.figure
    assert isinstance(figure, Figure)
    return figure


def drawable(diagnosis: Diagnosis) -> Iterator[Drawable]:
    """Every figure that a diagnosis has: (name, caption, function that draws it)."""
    yield "plan", "The ring from above, with the findings.", lambda: plot_plan(diagnosis)
    yield from (response_figures if diagnosis.by_families else _searched_figures)(diagnosis)
    for number, finding in enumerate(diagnosis.findings, 1):
        if len(finding.recommended_actions) > 1:
            yield (
                f"credible-set-{number}",
                f"Explanations of finding {number} that the data do not exclude.",
                partial(plot_credible_set, finding),
            )


def _searched_figures(diagnosis: Diagnosis) -> Iterator[Drawable]:
    first = None if diagnosis.stored else clearest(diagnosis)
    if not diagnosis.stored:
        if not diagnosis.parts:
            yield "readings", readings_caption(diagnosis), lambda: plot_readings(diagnosis)
        elif parts_along(diagnosis):
            yield (
                "readings",
                "Residual at each BPM in units of the noise, of each measurement, with the "
                "design and with the findings.",
                lambda: plot_parts(diagnosis),
            )
        yield (
            "scan",
            "How much better each hypothesis alone explains the data: the decrease of chi-square, "
            "before any finding. Above the dashed line it is no accident of the noise "
            "anywhere in the scan.",
            lambda: plot_scan(diagnosis),
        )
    if first is not None:
        yield (
            "scan-near",
            "The same scan around the clearest finding, linear, with the BPMs. Later findings "
            "show only once this one is in the model.",
            partial(plot_scan_near, diagnosis, first),
        )
    if diagnosis.heldout is not None:
        yield (
            "gap",
            "Readings of shots that the fit never saw less the model, as findings are added.",
            lambda: plot_gap(diagnosis),
        )


def clearest(diagnosis: Diagnosis) -> Finding | None:
    """The first finding that the scan saw, if its place is narrow enough to be drawn near by."""
    first = next((f for f in diagnosis.findings if np.isfinite(f.detection.statistic)), None)
    if first is None or first.where is None or np.ptp(first.where) >= WIDE:
        return None
    return first


# --- the scan -------------------------------------------------------------------------------------
FLOOR = 1.0
"""Statistics below are as noise has them, and are not drawn."""

ROOM = 60.0
"""m, on both sides of a finding that is drawn near by."""


def plot_scan(diagnosis: Diagnosis) -> Figure:
    """Draw the statistic of every hypothesis along the ring, before any finding."""
    figure, grid = plt.subplots(
        2, 2, figsize=(11, 6), layout="constrained", sharey="row", sharex="col",
        height_ratios=[6, 0.8], width_ratios=[8, 1],
    )  # fmt: skip
    ax, side, strip = grid[0, 0], grid[0, 1], grid[1, 0]
    grid[1, 1].axis("off")
    found = diagnosis.explanation.first
    ax.grid(alpha=GRID)
    _draw_scan(ax, diagnosis, 1.8)
    threshold = thresholds(diagnosis)[0]
    _whole_ring(side, diagnosis)
    ax.set_yscale("log")
    ax.set_ylim(FLOOR, 12 * max(float(found.statistic.max(initial=1.0)), threshold))
    _mark_findings(ax, diagnosis)
    _scan_legend(ax, 3)
    lattice_strip(diagnosis.ring, strip)
    mark(strip, diagnosis)
    return figure


def plot_scan_near(diagnosis: Diagnosis, finding: Finding, figure: Figure | None = None) -> Figure:
    """Draw the statistic around one finding that has a place, with the BPMs, on a linear scale."""
    assert finding.where is not None
    figure, (ax,) = above_strip(diagnosis.ring, (11, 5), [6], figure)
    low, high = around(diagnosis, finding)
    _draw_scan(ax, diagnosis, 4.0)
    drawn = [line.get_xydata() for line in ax.lines if line.get_linestyle() not in ("--", ":")]
    s, values = np.concatenate([np.asarray(points, dtype=float) for points in drawn]).T
    top = np.nanmax(values[(s >= low) & (s <= high)], initial=FLOOR)
    ax.set_ylim(0, 1.2 * max(float(top), thresholds(diagnosis)[0]))
    ax.yaxis.set_major_formatter("{x:,.0f}")
    labelled = -np.inf
    for monitor in diagnosis.ring.monitors:
        if not low <= monitor.s <= high:
            continue
        ax.axvline(monitor.s, color="0.8", linewidth=0.7, zorder=0)
        if monitor.s - labelled > 0.012 * (high - low):  # else the names would overlap
            labelled = monitor.s
            ax.annotate(
                brief(monitor.name), (monitor.s, 0), xytext=(2, 4), textcoords="offset points",
                rotation=90, fontsize="x-small", color="0.35", va="bottom",
            )  # fmt: skip
    _mark_findings(ax, diagnosis, (low, high))
    _scan_legend(ax, 1.3)
    mark(figure.axes[-1], diagnosis)
    ax.set_xlim(low, high)
    return figure


def around(diagnosis: Diagnosis, finding: Finding) -> tuple[float, float]:
    """The interval of s, m, in which a finding is drawn."""
    assert finding.where is not None
    low, high = finding.where
    return max(low - ROOM, 0.0), min(high + ROOM, diagnosis.ring.length)


def thresholds(diagnosis: Diagnosis) -> tuple[float, float]:
    """Detection thresholds of named effects and of free kicks."""
    explanation = diagnosis.explanation
    rate = diagnosis.provenance["options"]["false_alarm"]
    free = explanation.first_kicks
    named = explanation.first.threshold(rate * DEFAULT.shares["named"])
    if not len(free.gain):
        return named, named
    freedom = max(int(np.median(free.freedom)), 1)
    return named, free_threshold(rate * DEFAULT.shares["kick"], freedom, len(free.gain))


def _draw_scan(ax: Axes, diagnosis: Diagnosis, size: float) -> None:
    """Statistics at their places, a colour and a marker for each group, and both thresholds."""
    found, s = diagnosis.explanation.first, middles(diagnosis)
    groups = np.array([find(effect).group for effect, _ in found.hypotheses])
    layers, free = free_kicks(diagnosis)
    if len(layers):
        ax.plot(layers, free, color="0.65", linewidth=0.9, zorder=1,
                label="a free kick in each shot")  # fmt: skip
    for name, (colour, marker) in STYLES.items():
        own = (groups == name) & np.isfinite(s) & (found.statistic > FLOOR)
        if own.any():
            ax.plot(
                s[own], found.statistic[own], linestyle="none", marker=marker, color=colour,
                ms=size, mew=0, label=name.replace("monitors", "BPMs"), zorder=2,
            )  # fmt: skip
    named, kicks = thresholds(diagnosis)
    ax.axhline(
        named, color="k", linestyle="--", linewidth=1, zorder=3, label=f"threshold {named:.1f}"
    )
    if len(layers):
        label = f"threshold of free kicks {kicks:.1f}"
        ax.axhline(kicks, color="0.5", linestyle=":", linewidth=1.2, label=label)
    ax.set_ylabel("Δχ²")


def _scan_legend(ax: Axes, scale: float) -> None:
    ax.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=5, fontsize="small", frameon=False,
              markerscale=scale)  # fmt: skip


def free_kicks(diagnosis: Diagnosis) -> tuple[Array, Array]:
    """Places of free kicks along the ring, m, and their statistics as they are drawn."""
    free = diagnosis.explanation.first_kicks
    s = np.array([magnet.s for magnet in diagnosis.ring.magnets])[: len(free.gain)]
    order = np.argsort(s)
    return s[order], np.maximum(free.statistic[order], FLOOR)


def middles(diagnosis: Diagnosis) -> Array:
    """The place of each hypothesis of the first scan, m; NaN without one."""
    middles = {element.name: element.s for element in diagnosis.ring.elements}
    places = [place for _, place in diagnosis.explanation.first.hypotheses]
    return np.array([middles.get(place or "", np.nan) for place in places])


def _whole_ring(side: Axes, diagnosis: Diagnosis) -> None:
    """Draw hypotheses without a place, the best of each effect."""
    found = diagnosis.explanation.first
    best: dict[str, float] = {}
    places = middles(diagnosis)
    for (effect, _), s, value in zip(found.hypotheses, places, found.statistic, strict=True):
        if not np.isfinite(s):
            best[effect] = max(best.get(effect, FLOOR), float(value))
    if not best:
        side.axis("off")
        return
    side.grid(alpha=GRID)
    side.axhline(thresholds(diagnosis)[0], color="k", linestyle="--", linewidth=1, zorder=3)
    for i, (effect, value) in enumerate(best.items()):
        colour, marker = STYLES[find(effect).group]
        side.plot(i, value, marker, color=colour, ms=5, clip_on=False, zorder=4)
    side.set_xticks(range(len(best)), [find(effect).label for effect in best])
    side.tick_params(axis="x", labelrotation=90, labelsize="x-small", labelbottom=True)
    for label in side.get_xticklabels():
        label.set_in_layout(False)  # they hang into the empty corner next to the strip
    side.set_xlim(-0.7, max(len(best), 1) - 0.3)
    side.set_title("whole ring", fontsize="small")


def _mark_findings(ax: Axes, diagnosis: Diagnosis, span: tuple[float, float] | None = None) -> None:
    mark(ax, diagnosis)
    low, high = span or (0.0, diagnosis.ring.length)
    placed = [
        (finding.s if finding.s is not None else float(np.mean(finding.where)), finding)
        for finding in diagnosis.findings
        if finding.where is not None
    ]
    placed = [(s, finding) for s, finding in placed if low <= s <= high]
    for k, (s, finding) in enumerate(placed):
        name = finding.recommended_action.effect if finding.recommended_action is not None else ""
        own = finding.label if finding.element or not name else ""
        text = f"{name.replace('_', ' ')} {brief(own)}".strip()
        left = s > low + 0.6 * (high - low)
        ax.annotate(
            text, (s, 0.97 - 0.05 * (k % 6)), xycoords=("data", "axes fraction"),
            xytext=(-5 if left else 5, 0), textcoords="offset points",
            ha="right" if left else "left", va="top", fontsize="small",
        )  # fmt: skip


# --- the gap --------------------------------------------------------------------------------------
LABEL = 34
"""Letters of a line next to a bar."""


def plot_gap(diagnosis: Diagnosis, ax: Axes | None = None) -> Axes:
    """Draw the rms residual of held-out readings against the number of findings; a ValueError if
    no shot was held out."""
    if diagnosis.heldout is None:
        raise ValueError("no shot was held out")
    ax = gap_axes(diagnosis) if ax is None else ax
    rms = np.array([1e6 * step.rms for step in diagnosis.heldout.misfits])
    noise = noise_rms(diagnosis)
    rows = np.arange(len(rms))
    ax.barh(rows, rms, height=0.55, color=[BEFORE] + [AFTER] * (len(rms) - 1))
    for row, value in zip(rows, rms, strict=True):
        ax.annotate(micrometres(1e-6 * value).removesuffix(" µm"), (value, row), xytext=(4, 0),
                    textcoords="offset points", va="center")  # fmt: skip
    label = f"noise {micrometres(1e-6 * noise)}"
    ax.axvline(noise, color="k", linestyle="--", linewidth=1, label=label)
    ax.set_yticks(rows, ["\n".join(wrap(label, LABEL)) for label in gap_labels(diagnosis)])
    ax.set_ylim(max(len(rms), 2) - 0.4, -0.6)  # the design on top
    there = np.append(rms[np.isfinite(rms)], noise)  # a model may lose a beam
    if over_decades(rms):
        ax.set_xscale("log")
        ax.set_xlim(0.4 * there.min(), 2.5 * there.max())
    else:
        ax.set_xlim(0, 1.18 * there.max())
    shots = ", ".join(map(str, diagnosis.heldout_shots))
    title = f"Held-out shots {shots}" if shots else "Held-out readings"
    ax.set_xlabel("held-out readings less model, rms [µm]")
    ax.set_title(title, loc="left", fontsize="medium")
    legend_above(ax, 1, fontsize="small")
    ax.grid(axis="x", alpha=GRID)
    ax.set_axisbelow(True)
    return ax


def gap_axes(diagnosis: Diagnosis) -> Axes:
    """Axes of a height for all names next to the bars."""
    labels = gap_labels(diagnosis)
    lines = max(len(wrap(label, LABEL)) for label in labels)
    height = 1.3 + max(0.5, 0.1 + 0.17 * lines) * max(len(labels), 2)
    _, ax = plt.subplots(figsize=(8, height), layout="constrained")
    return ax


def over_decades(rms: Iterable[float]) -> bool:
    """Whether bars of these lengths need a logarithmic axis; a model that loses a beam has none."""
    there = [value for value in rms if np.isfinite(value)]
    return bool(there) and max(there) > 20 * max(min(there), 1e-9)


def noise_rms(diagnosis: Diagnosis) -> float:
    """Noise rms of a reading, both planes together, µm."""
    return 1e6 * float(np.sqrt(np.nanmean(np.square(diagnosis.noise))))


def gap_labels(diagnosis: Diagnosis) -> list[str]:
    """Labels of the held-out residuals: the design, then the errors added by each model."""
    steps = 0 if diagnosis.heldout is None else len(diagnosis.heldout.misfits)
    if diagnosis.priors:
        return [diagnosis.starting_model, "+ distributed errors", "+ findings"][:steps]
    faults = (f"+ {find(c.effect).words} {c.element or ''}".rstrip() for c in diagnosis.faults)
    return [diagnosis.starting_model, *faults][:steps]


# --- credible set ---------------------------------------------------------------------------------
MOST = 15
"""Members of a credible set that are drawn."""


def plot_credible_set(finding: Finding, ax: Axes | None = None) -> Axes:
    """Draw the probabilities of the explanations of one finding."""
    members = finding.credible_set[:MOST]
    if ax is None:
        size = 9, 1.4 + 0.32 * len(members)
        _, ax = plt.subplots(figsize=size, layout="constrained")
    rows = np.arange(len(members))
    colours = [STYLES[find(member.effect).group][0] for member in members]
    ax.barh(rows, [100 * member.probability for member in members], color=colours, height=0.6)
    for row, member in zip(rows, members, strict=True):
        ax.annotate(
            f"{100 * member.probability:.1f} %", (100 * member.probability, row),
            xytext=(4, 0), textcoords="offset points", va="center", fontsize="small",
        )  # fmt: skip
    ax.set_yticks(
        rows, [f"{m.effect.replace('_', ' ')}  {m.element or ''}".rstrip() for m in members]
    )
    ax.invert_yaxis()
    ax.set_xlim(0, 112)
    ax.set_xticks(range(0, 101, 20))
    ax.set_xlabel("probability [%]")
    rest = len(finding.credible_set) - len(members)
    if rest:
        ax.set_title(f"{rest} less probable ones not drawn", loc="right", fontsize="small")
    ax.grid(axis="x", alpha=GRID)
    ax.set_axisbelow(True)
    return ax
