"""The default figures of objects: `ring.plot()`, `diagnosis.plot()`, ..."""

from collections.abc import Iterator
from os import PathLike
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from tmlattice.arrays import Array
from tmlattice.diagnosis.result import Diagnosis
from tmlattice.errors import unknown_choice
from tmlattice.lattice import Ring, load_ring
from tmlattice.measurement import (
    ClosedOrbit,
    Dispersion,
    Measurement,
    OrbitResponse,
    TuneReading,
    TurnByTurn,
    in_words,
)
from tmlattice.optics import twiss
from tmlattice.plots.diagnosis import drawable, drawn
from tmlattice.plots.optics import plot_betas
from tmlattice.plots.strip import GRID, above_strip, legend_above

MOST = 8
"""Shots that are drawn."""


def plot_ring(ring: Ring, span: tuple[float, float] | None = None) -> Figure:
    """Draw betas along the ring, with its lattice below (span: from and to which s, m; else the
    whole ring)."""
    figure = plot_betas(ring, twiss(ring), span=span)
    figure.axes[0].set_title(ring.name, loc="right", fontsize="medium")
    return figure


def plot_diagnosis(diagnosis: Diagnosis, name: str | None = None) -> Figure:
    """Draw one of the figures of the report.

    Args:
        name: of the figure, such as "scan", "readings" or "gap"; else the scan along the ring, or
            the maps of an orbit response.

    Raises:
        ChoiceError: no such figure; names those that there are.
    """
    known = [own for own, *_ in drawable(diagnosis)]
    if name is None:  # of a kind without a scan: its first
        usual = "maps" if diagnosis.by_families else "scan"
        name = usual if usual in known else known[0]
    if name not in known:
        raise unknown_choice("figure", name, known)
    return drawn(next(draw for own, _, draw in drawable(diagnosis) if own == name))


def plot_measurement(measured: Any, ring: Ring | str | PathLike[str] | None = None) -> Figure:
    """Draw the readings, x above y (ring: along which, with its lattice below (all that `load_ring`
    takes); else by the number of the monitor)."""
    known = None if ring is None else load_ring(ring)
    if isinstance(measured, TuneReading):
        return _tunes(measured, known)
    if known is None:
        figure, axes = plt.subplots(2, 1, figsize=(11, 6), sharex=True, layout="constrained")
        s = np.arange(len(measured.monitors), dtype=float)
        axes[1].set_xlabel("BPM")
    else:
        figure, axes = above_strip(known, (11, 6), [3, 3])
        s = np.array([known[name].s for name in measured.monitors])
    order = np.argsort(s)
    for label, values in _lines(measured):
        for plane in range(2):
            axes[plane].plot(
                s[order], 1e3 * values[order, plane], ".-", linewidth=0.8, markersize=3, label=label
            )
    for plane in range(2):
        axes[plane].set_ylabel(f"{'xy'[plane]} [mm]")
        axes[plane].grid(alpha=GRID)
    if len(axes[0].lines) <= MOST:
        legend_above(axes[0], 4, fontsize="small")
    axes[0].set_title(in_words(measured), loc="left", fontsize="medium")
    return figure


def _lines(measured: Any) -> Iterator[tuple[str, Array]]:
    """Label and values [monitor, 2], m."""
    if isinstance(measured, Measurement | TurnByTurn):
        for shot, readings in list(zip(measured.shots, measured.readings, strict=True))[:MOST]:
            if isinstance(measured, TurnByTurn):
                yield f"shot {shot}, rms over turns", np.sqrt(np.nanmean(readings**2, axis=0))
            else:
                yield f"shot {shot}", readings[0]
    elif isinstance(measured, ClosedOrbit):
        for shot, orbit in list(zip(measured.shots, measured.orbit, strict=True))[:MOST]:
            yield f"shot {shot}", orbit
    elif isinstance(measured, Dispersion):
        for step in measured.steps:
            if step.orbit is not None:
                yield f"RF {step.step:+g} Hz", step.orbit
    elif isinstance(measured, OrbitResponse):
        rows = zip(measured.correctors, measured.planes, measured.response, strict=True)
        for name, plane, orbit in rows:
            yield f"{name} ({plane})", orbit


def _tunes(measured: TuneReading, ring: Ring | None) -> Figure:
    """Draw tunes, and chromaticities where there are any, by shot, with the ring's own."""
    told = [("Q{}", measured.tune, measured.tune_error)]
    if measured.chromaticity is not None:
        told.append(("chromaticity {}", measured.chromaticity, measured.chromaticity_error))
    figure, axes = plt.subplots(
        2, len(told), figsize=(4.5 + 3.5 * len(told), 5), sharex=True, squeeze=False,
        layout="constrained",
    )  # fmt: skip
    design = None if ring is None else np.mod(twiss(ring).total_tunes, 1.0)
    shots = np.arange(len(measured.tune))
    for column, (name, values, error) in enumerate(told):
        for plane, ax in enumerate(axes[:, column]):
            bars = None if error is None else error[:, plane]
            ax.errorbar(shots, values[:, plane], bars, fmt="o", capsize=3, label="read")
            if design is not None and not column:
                ax.axhline(design[plane], color="0.4", linestyle="--", label="design")
                ax.legend(fontsize="small")
            ax.set_ylabel(name.format("xy"[plane]))
            ax.ticklabel_format(axis="y", useOffset=False)
            ax.grid(alpha=GRID)
        axes[1, column].set_xlabel("shot")
        if len(shots) <= MOST:
            axes[1, column].set_xticks(shots, [str(shot) for shot in measured.shots])
            axes[1, column].set_xlim(-0.5, len(shots) - 0.5)
    figure.suptitle(in_words(measured), x=0.01, ha="left", fontsize="medium")
    return figure
