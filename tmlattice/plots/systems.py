"""Figures of the paper's other systems, one function a figure; each returns its figure."""

from typing import TYPE_CHECKING

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from tmlattice.plots.strip import GRID, above_strip

if TYPE_CHECKING:
    from tmlattice.lattice.ring import Ring
    from tmlattice.systems.cavitation import CavitationStudy
    from tmlattice.systems.free_fall import MassErrors, StepErrors
    from tmlattice.systems.lotka_volterra import Race
    from tmlattice.systems.magnets import MagnetStudy
    from tmlattice.systems.pendulum import PendulumStudy


def _finish(ax: Axes, x: str, y: str, title: str = "", legend: str | None = "best") -> None:
    ax.set_xlabel(x)
    ax.set_ylabel(y)
    ax.grid(alpha=GRID)
    if title:
        ax.set_title(title, fontsize="medium")
    if legend:
        ax.legend(fontsize="small", loc=legend)  # type: ignore[call-overload]


def _room(ax: Axes, values: NDArray[np.float64]) -> None:
    """Limits that leave space for the legend above the curves."""
    size = np.abs(values).max()
    ax.set_ylim(-1.15 * size, 2.3 * size)


def plot_free_fall(errors: "StepErrors", masses: "MassErrors") -> Figure:
    """Error against step of Euler, maps and Runge-Kutta; falls of masses not learned from."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(12, 4.8), layout="constrained")
    left.loglog(errors.steps, errors.euler, "s-", label="Euler")
    for order, taylor in errors.taylor.items():
        left.loglog(errors.steps, taylor, "o-", label=f"map of order {order}")
    left.loglog(errors.steps, errors.runge_kutta, "k^--", label="Runge-Kutta 4")
    _finish(left, "step [s]", "largest error in 15 s [m/s]", "Fall of 100 kg from rest")
    for i, mass in enumerate(masses.masses):
        colour = f"C{i}"
        right.plot(masses.time, masses.truth[i], color=colour, label=f"{mass:g} kg")
        right.plot(masses.time, masses.taylor_falls[i], "o", color=colour, ms=3)
        if masses.forest_falls is not None:
            right.plot(masses.time, masses.forest_falls[i], "x", color=colour, ms=4, alpha=0.6)
    words = "Lines: truth, dots: map" + (
        "" if masses.forest_falls is None else ", crosses: random forest"
    )
    _finish(right, "time [s]", "velocity [m/s]", f"Learned from 100 and 80 kg\n{words}")
    return figure


def plot_lotka_volterra(done: "Race") -> Figure:
    """Free runs of every network in the plane, and their error against epochs."""
    names = list(done.runs)
    columns = 3
    rows = -(-(len(names) + 1) // columns)
    figure, grid = plt.subplots(
        rows, columns, figsize=(12, 4 * rows), layout="constrained", squeeze=False
    )
    axes = list(grid.flat)
    for ax, name in zip(axes, names, strict=False):
        for i, (run, truth) in enumerate(zip(done.runs[name], done.truth, strict=True)):
            point = "(0, 0)" if not truth.any() else ""
            ax.plot(*truth.T, color="0.75", linewidth=4, zorder=1)
            ax.plot(*run.T, color="k" if i == 0 else f"C{i}", linewidth=1.3, zorder=2)
            ax.plot(*truth[0], "o", color="k" if i == 0 else f"C{i}", ms=5, zorder=3,
                    label=["learned", "unseen", "unseen", f"unseen {point}"][i])  # fmt: skip
        ax.set_xlim(-0.85, 1.35)
        ax.set_ylim(-1.1, 2.3)
        _finish(ax, "x", "y", name, "upper right" if ax is axes[0] else None)
    last = axes[len(names)]
    for i, name in enumerate(dict.fromkeys(name for name, _ in done.curves)):
        curve = done.curves[name, "none"]
        last.loglog(done.epochs, np.clip(curve, 1e-12, 1e3), f"C{i}.-", label=name)
    truth, run = done.truth, done.runs[names[0]]
    last.axhline(np.mean((run[1:] - truth[1:]) ** 2), color="k", label=names[0])
    _finish(last, "epoch", "mean squared error", "Unseen starts, no regularization")
    for ax in axes[len(names) + 1 :]:
        ax.remove()
    return figure


def plot_pendulum(done: "PendulumStudy") -> Figure:
    """The swings that were learned from, and the others as the ideal and learned maps predict."""
    learned = [("simulated, learned from", done.angles, done.simulated)]
    if done.real is not None and done.real_angles is not None:
        learned.append(("filmed swing a, learned from", done.real_angles, done.real))
    panels = len(learned) + len(done.tests)
    figure, grid = plt.subplots(
        -(-panels // 2), 2, figsize=(12, 2.7 * -(-panels // 2)), layout="constrained"
    )
    axes = list(grid.flat)
    for ax, (name, angles, made) in zip(axes, learned, strict=False):
        time = 0.1 * np.arange(len(angles))
        _room(ax, 1e3 * angles)
        ax.plot(time, 1e3 * angles, "k.", label="camera")
        ax.plot(time, 1e3 * (angles - made.fit.residuals[:, 0]), "C3-", label="learned map")
        (length, dl), (damping, dd) = made.length, made.damping
        title = f"{name}: {length:.4f} ± {dl:.4f} m, {damping:.3f} ± {dd:.3f} /s"
        _finish(ax, "time [s]", "angle [mrad]", title, "upper right")
    for ax, test in zip(axes[len(learned) :], done.tests, strict=False):
        time = 0.1 * np.arange(len(test.angles))
        _room(ax, 1e3 * test.angles)
        ax.plot(time, 1e3 * test.angles, "k.", label="truth" if test.seen == 1 else "camera")
        ax.plot(time, 1e3 * test.ideal, "C0-", linewidth=1, label="ideal map")
        ax.plot(time, 1e3 * test.learned, "C3-", label="learned map")
        ours, ideal = test.rms()
        title = f"{test.source}: rms {1e3 * ours:.1f} mrad, ideal {1e3 * ideal:.0f}"
        _finish(ax, "time [s]", "angle [mrad]", title, "upper right")
    for ax in axes[panels:]:
        ax.remove()
    return figure


def plot_magnets(done: "MagnetStudy", ring: "Ring") -> Figure:
    """What third order adds to the first turn, along the ring."""
    figure, axes = above_strip(ring, (11, 7), [3, 3])
    for plane, name in enumerate("xy"):
        for i, turn in reversed(list(enumerate(done.turns))):
            difference = 1e6 * (turn.third - turn.second)[:, plane]
            label = f"{1e3 * turn.launch[0]:g} mm, rms {1e6 * turn.rms()[plane]:.3f} µm"
            axes[plane].plot(turn.s, difference, f"C{3 * i}-", linewidth=1, label=label)
        _finish(axes[plane], "", f"{name}: third less\nsecond order [µm]")
    axes[0].set_title("One turn launched at x = y: what third order adds")
    return figure


def plot_cavitation(done: "CavitationStudy") -> Figure:
    """The collapse by maps with its steps, and the oscillation learned from and predicted."""
    figure, grid = plt.subplots(2, 2, figsize=(12, 7.5), layout="constrained")
    (a, b), (c, d) = grid
    unit = 1e6 * done.bubble.time
    time = unit * done.run.times
    a.plot(time, done.truth[:, 0] + 1, color="0.75", linewidth=4, label="numerical solver")
    a.plot(time, done.run.radius, "C3-", linewidth=1, label="Taylor maps")
    _finish(a, "time [µs]", "R / R0", f"Drive {done.bubble.drive:g} p0", "upper right")
    b.semilogy(time[1:], unit * np.diff(done.run.times), "C0-", linewidth=1, label="step [µs]")
    error = np.abs(done.run.states - done.truth)[1:, 0]
    b.semilogy(time[1:], np.maximum(error, 1e-12), "C3-", linewidth=1, label="error of R / R0")
    _finish(b, "time [µs]", "step [µs], error", "The ladder's steps and the error", "lower right")
    wave = 1e6 * done.learned.bubble.time * done.learned.bubble.period
    t = np.linspace(0, 2 * wave, len(done.model))
    c.plot(t[: len(done.observed)], done.observed, "k.", ms=2.5, label="observed")
    c.plot(t, done.model, "C0-", linewidth=1, label="model of wrong viscosity")
    c.plot(t, done.learned.radii(2), "C3-", linewidth=1, label="learned")
    drive = done.learned.bubble.drive
    _finish(
        c, "time [µs]", "R / R0", f"Drive {drive:g} p0: learned from one oscillation", "upper left"
    )
    d.plot(t, done.stronger_truth, color="0.75", linewidth=4, label="truth")
    d.plot(t, done.stronger_model, "C0-", linewidth=1, label="model of wrong viscosity")
    d.plot(t, done.learned.radii(2, done.stronger), "C3-", linewidth=1, label="learned")
    _finish(d, "time [µs]", "R / R0", f"Drive {done.stronger:g} p0: predicted", "upper left")
    return figure
