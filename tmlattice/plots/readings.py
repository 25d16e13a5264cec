"""Readings along the ring, and what models and corrections leave of them."""

from dataclasses import replace

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from tmlattice.arrays import Array, Flags
from tmlattice.correction.result import Correction
from tmlattice.correction.targets import TARGETS
from tmlattice.diagnosis.result import Diagnosis, Finding
from tmlattice.diagnosis.views import PartView
from tmlattice.effects import RingEffect, find
from tmlattice.inference.newton import fit
from tmlattice.plots.strip import above_strip, legend_above, plain_log, text_at_top

BEFORE, AFTER = "C0", "C3"

ENOUGH = 4
"""BPMs before a finding that determine the launch without it."""


def _starts(finding: Finding) -> float | None:
    """Where a finding begins to act on the trajectory; None where it does not, or everywhere."""
    if finding.effect is not None and not isinstance(find(finding.effect), RingEffect):
        return None
    if finding.s is not None:
        return finding.s
    return None if finding.where is None or finding.effect is not None else finding.where[0]


def before_findings(diagnosis: Diagnosis) -> Flags | None:
    """The BPMs before the first finding, [monitor]; None where there is no such place, or too
    few."""
    starts = [s for finding in diagnosis.findings if (s := _starts(finding)) is not None]
    if not starts:
        return None
    before = np.array([monitor.s for monitor in diagnosis.ring.monitors]) < min(starts)
    return before if before.sum() >= ENOUGH else None


def readings_caption(diagnosis: Diagnosis) -> str:
    """What the figure of the readings shows."""
    if before_findings(diagnosis) is None:
        return (
            "Readings of one shot of the fit, and what each model leaves of them, its launch "
            "fitted."
        )
    return (
        "Readings of one shot of the fit, and what each model leaves of them. The launch of the "
        "design is fitted to the BPMs before the first finding alone, so that the gap is seen "
        "to begin there."
    )


def design_readings(diagnosis: Diagnosis) -> Array:
    """What the design predicts of the shots of the fit, its launches fitted to the monitors before
    the first finding, else to all, [shot, reading, 2], m."""
    view = diagnosis.trajectories
    before = before_findings(diagnosis)
    if before is None:
        return view.before
    behind = np.ones(view.dropped.shape, dtype=bool)
    behind[:, : len(before)] = ~before[:, None]  # later turns are behind all of it
    alone = fit(view.problem.without(behind), (), view.problem.first)
    return view.before if alone.point.lost else np.asarray(alone.point.view.readings)


def models_of(diagnosis: Diagnosis) -> dict[str, tuple[Array, str]]:
    """The readings of the shots of the fit that design and estimated ring predict, [shot, reading,
    2], m, each with its colour."""
    models = {diagnosis.starting_model: (design_readings(diagnosis), BEFORE)}
    if diagnosis.verdict != "distributed":
        models["with the findings"] = (diagnosis.trajectories.after, AFTER)
    return models


def worst_shot(diagnosis: Diagnosis, model: Array) -> int:
    """The shot of the fit with the largest residual of a model, [shot, reading, 2], m."""
    data = diagnosis.trajectories.data
    left = np.where(data.valid, data.readings - model, 0.0) ** 2
    return int(np.nan_to_num(left).sum(axis=(1, 2)).argmax())


def plot_readings(diagnosis: Diagnosis, shot: int | None = None) -> Figure:
    """Draw first-turn readings of a shot of the fit (else of the one with the largest residual),
    and the residuals of the design and the estimated ring."""
    figure, grid = above_strip(diagnosis.ring, (11, 8.2), [3, 2, 3, 2])
    view = diagnosis.trajectories
    data = view.data
    models, before = models_of(diagnosis), before_findings(diagnosis)
    design = diagnosis.starting_model
    monitors = diagnosis.ring.monitors
    readings = np.where(data.valid, data.readings, np.nan)
    shot = worst_shot(diagnosis, models[design][0]) if shot is None else shot
    first = slice(0, len(monitors))
    s = np.array([monitor.s for monitor in monitors])
    read, dropped = readings[shot, first], view.dropped[shot, first]
    for plane, name in enumerate("xy"):
        orbit, residual = grid[2 * plane], grid[2 * plane + 1]
        orbit.plot(s, 1e3 * read[:, plane], "k.", ms=3, label="read by the BPMs")
        sigma = 1e3 * diagnosis.noise[plane]
        residual.axhspan(-2 * sigma, 2 * sigma, color="0.88", zorder=0, label="noise, 2 rms")
        texts = []
        for label, (model, colour) in models.items():
            predicted = model[shot, first, plane]
            orbit.plot(s, 1e3 * predicted, color=colour, linewidth=0.9, label=label)
            left = np.where(dropped[:, plane], np.nan, read[:, plane] - predicted)
            residual.plot(s, 1e3 * left, color=colour, linewidth=0.9)
            texts.append(_left_text(left, before if label == design else None))
        if dropped[:, plane].any():
            at = dropped[:, plane]
            orbit.plot(s[at], 1e3 * read[at, plane], "x", color="0.4", ms=5, label="rejected")
        orbit.set_ylabel(f"{name} [mm]")
        residual.set_ylabel(f"residual {name} [mm]")
        after = f"; with the findings {texts[1]}" if len(texts) > 1 else ""
        text = f"rms in µm: {design} {texts[0]}{after}; noise {1e3 * sigma:.1f} (grey: 2 rms)"
        text_at_top(residual, text, 0.3)
        for ax in (orbit, residual):
            mark(ax, diagnosis)
    legend_above(grid[0], 4, fontsize="small")
    title = f"Shot {shot + 1} of {len(readings)} in the fit"
    if before is not None:
        title += f"; {design}: launch fitted to the {int(before.sum())} BPMs before the finding"
    grid[0].set_title(title, loc="left", fontsize="medium")
    mark(figure.axes[-1], diagnosis)
    return figure


def _left_text(left: Array, before: Flags | None) -> str:
    """The rms residual, m, as µm: of all, or before and behind the first finding."""

    def rms(values: Array) -> str:
        seen = values[np.isfinite(values)]
        return f"{1e6 * np.sqrt(np.mean(seen**2)):.1f}" if len(seen) else "-"

    if before is None:
        return rms(left)
    return f"{rms(left[before])} before the finding, {rms(left[~before])} behind"


def mark(ax: Axes, diagnosis: Diagnosis) -> None:
    """A dotted line, or a band, where the findings sit."""
    for finding in diagnosis.findings:
        if finding.effect is None and finding.where is not None:
            ax.axvspan(*finding.where, color="gold", alpha=0.4, linewidth=0, zorder=0)
        elif finding.s is not None:
            ax.axvline(finding.s, color="0.45", linestyle=":", linewidth=1.1, zorder=0.5)


def parts_along(diagnosis: Diagnosis) -> list[tuple[PartView, Array]]:
    """Measurements with readings at BPMs, these and the residuals as they are drawn along the ring,
    and their s, m."""
    found = []
    for part in diagnosis.parts:
        s = np.array([diagnosis.ring[name].s for name in part.monitors])
        order = np.argsort(s)
        monitors = tuple(part.monitors[i] for i in order)
        if np.isfinite(part.left).any():
            left = np.maximum(part.left[:, order], 1e-2)
            found.append((replace(part, monitors=monitors, left=left), s[order]))
    return found


def plot_parts(diagnosis: Diagnosis) -> Figure:
    """Draw the rms residual at each BPM in units of the noise, a panel a measurement."""
    shown = parts_along(diagnosis)
    count = len(shown)
    figure, axes = above_strip(diagnosis.ring, (11, 1.6 + 1.8 * count), [3.0] * count)
    for ax, (part, s) in zip(axes, shown, strict=True):
        before, after = part.left
        ax.plot(s, before, ".-", color=BEFORE, lw=0.8, ms=4, label=diagnosis.starting_model)
        ax.plot(s, after, ".-", color=AFTER, lw=0.8, ms=4, label="with the findings")
        ax.axhline(1.0, color="k", linestyle="--", linewidth=1)
        plain_log(ax.yaxis)
        ax.set_ylabel("residual / noise")
        ax.set_title(part.label, loc="left", fontsize="medium")
        mark(ax, diagnosis)
    legend_above(axes[0], 2)
    return figure


CAPTION = "At the BPMs now, and expected after the correction, with 68 % intervals."


def plot_correction(correction: Correction) -> Figure:
    """The errors of the shown target at the BPMs now and expected, a panel a plane, the lattice
    below."""
    figure, axes = above_strip(correction.ring, (11, 5.2), [3, 3])
    target = TARGETS[correction.shown]
    scale, unit = (100.0, "%") if target.unit == "relative" else (1e3, "mm")
    shown = [(correction.profile[0], BEFORE, "now")]
    if not correction.refused:
        shown.append((correction.profile[1], AFTER, "expected"))
    for plane, ax in enumerate(axes):
        for values, colour, label in shown:
            middle, low, high = scale * np.array(values)[:, plane].T
            ax.errorbar(
                correction.s, middle, (middle - low, high - middle), color=colour, label=label,
                fmt="o" if label == "now" else "s", ms=4, elinewidth=1, alpha=0.8,
            )  # fmt: skip
        ax.axhline(0.0, color="k", lw=0.7)
        ax.set_ylabel(f"{target.words} {'xy'[plane]} [{unit}]", fontsize="small")
    legend_above(axes[0], 2)
    return figure
