"""Optical functions along the ring, and motion in phase space."""

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from tmlattice.lattice import Ring
from tmlattice.optics import OffMomentum, Optics, Twiss
from tmlattice.plots.strip import GRID, above_strip


def plot_betas(
    ring: Ring,
    twiss: Twiss,
    dispersion: OffMomentum | None = None,
    span: tuple[float, float] | None = None,
) -> Figure:
    """Betas, and the dispersion where it is given, with the lattice below.

    Args:
        ring: whose magnets are drawn.
        span: from and to which s, m; else the whole ring.
    """
    figure, (ax,) = above_strip(ring, (11, 4.2), [5])
    s, beta = twiss.along()
    for plane, colour in enumerate(("C0", "C3")):
        name = "xy"[plane]
        ax.plot(s, beta[:, plane], color=colour, linewidth=0.9, label=f"beta {name}")
    ax.set_ylabel("beta [m]")
    ax.set_ylim(bottom=0)
    lines = ax.get_lines()
    if dispersion is not None:
        side = ax.twinx()
        side.plot(
            dispersion.s, dispersion.dispersion[:, 0], color="0.4", linewidth=0.9,
            label="dispersion x",
        )  # fmt: skip
        side.set_ylabel("dispersion [m]")
        lines = [*lines, *side.get_lines()]
    ax.legend(handles=lines, loc="lower left", bbox_to_anchor=(0, 1), ncols=3, frameon=False)
    if span is not None:
        ax.set_xlim(*span)
    return figure


def plot_phase_space(
    states: ArrayLike, plane: int, ax: Axes | None = None, optics: Optics | None = None
) -> Axes:
    """Turn by turn, every trajectory in its own colour; a linear machine draws ellipses.

    Args:
        states: at the start of each turn, [batch, turns, n], m and rad.
        plane: 0 for x, 1 for y.
        ax: where to draw; else a new one.
        optics: where given, the ellipse of the linear motion through the first state of each
            trajectory is drawn (its invariant, alpha and beta).
    """
    if ax is None:
        _, ax = plt.subplots(layout="constrained")
    states = np.asarray(states, dtype=float)
    angle = np.linspace(0, 2 * np.pi, 181)
    for trajectory in states:
        q, p = 1e3 * trajectory[:, 2 * plane], 1e3 * trajectory[:, 2 * plane + 1]
        (line,) = ax.plot(q, p, ".", ms=2)
        if optics is not None:
            beta, alpha = optics.beta[plane], optics.alpha[plane]
            orbit = 1e3 * optics.closed_orbit[2 * plane : 2 * plane + 2]
            u, v = q[0] - orbit[0], p[0] - orbit[1]
            size = np.sqrt(u**2 + (alpha * u + beta * v) ** 2)  # sqrt(2 J beta)
            ellipse = size * np.cos(angle), -size * (np.sin(angle) + alpha * np.cos(angle)) / beta
            ax.plot(
                ellipse[0] + orbit[0], ellipse[1] + orbit[1], color=line.get_color(), linewidth=0.6
            )
    name = "xy"[plane]
    ax.set_xlabel(f"{name} [mm]")
    ax.set_ylabel(f"p{name} [mrad]")
    ax.grid(alpha=GRID)
    return ax
