"""The ring from above, with the findings."""

from typing import NamedTuple

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection

from tmlattice.arrays import Array
from tmlattice.diagnosis.result import Diagnosis, Finding
from tmlattice.lattice.survey import Survey, survey
from tmlattice.plots.strip import COLOURS


class Small(NamedTuple):
    """Small symbols next to the orbit, and their offset as a share of the ring's size, outside
    positive."""

    marker: str
    colour: str
    beside: float


SMALL = {"monitor": Small("o", "tab:cyan", 0.02), "corrector": Small("^", "tab:orange", -0.02)}
"""By kind."""

LETTER, LINE, BESIDE = 0.022, 0.06, 0.06
"""Width of a letter and height of a line of a name, and its distance, as shares of the ring's
size."""

CULPRIT, SUSPECT = "#d1105a", "#c58a00"


LONGEST = 22
"""Letters of a name that fit."""


def brief(name: str) -> str:
    """A name; of a long one the end, which is where names differ."""
    return name if len(name) <= LONGEST else f"…{name[-LONGEST:]}"


def plural(kind: str) -> str:
    """Of a kind of elements."""
    kind = "BPM" if kind == "monitor" else kind
    return f"{kind[:-1]}ies" if kind.endswith("y") else f"{kind}s"


def groups(diagnosis: Diagnosis) -> dict[str, list[int]]:
    """The elements that are drawn, by kind: their places in the ring's order."""
    drawn: dict[str, list[int]] = {}
    for i, element in enumerate(diagnosis.ring.elements):
        kind = "corrector" if element.is_corrector else element.kind
        if kind in COLOURS or kind in SMALL:
            drawn.setdefault(kind, []).append(i)
    return drawn


def beside(plan: Survey, kind: str, places: list[int]) -> Array:
    """Where elements are drawn, [element, (x, y)], m: bends turn right, so outside is left."""
    off = SMALL[kind].beside * float(np.ptp(plan.ends, axis=0).max()) if kind in SMALL else 0.0
    heading = plan.heading[places]
    return plan.middle[places] + off * np.stack([-np.sin(heading), np.cos(heading)], axis=-1)


def place_of(finding: Finding, diagnosis: Diagnosis, plan: Survey) -> Array | None:
    """The place of a finding, (x, y), m; None where it has none."""
    if finding.s is not None:
        return plan.along(finding.s, diagnosis.ring)
    if finding.elements:
        return plan.along(diagnosis.ring[finding.elements[0]].s, diagnosis.ring)
    if finding.where is None or finding.effect is not None:
        return None
    return plan.along(float(np.mean(finding.where)), diagnosis.ring)


def inwards(place: Array, plan: Survey) -> tuple[str, str]:
    """The side of a place with space for its name: towards the middle of the ring."""
    away = place - plan.ends.mean(axis=0)
    side = "left" if away[0] > 0 else "right"
    if abs(away[1]) > abs(away[0]):
        return ("bottom" if away[1] > 0 else "top"), side
    return "middle", side


def placed(diagnosis: Diagnosis, plan: Survey) -> list[tuple[int, Finding, Array, int]]:
    """Findings that have a place: number, finding, (x, y), m, and by how many lines its name steps
    aside for the names of those near it."""
    found: list[tuple[int, Finding, Array, int]] = []
    boxes: list[Array] = []
    for number, finding in enumerate(diagnosis.findings, 1):
        at = place_of(finding, diagnosis, plan)
        if at is None:
            continue
        asides = ((n, _box(at, label(number, finding), n, plan)) for n in range(99))
        lines, box = next((n, b) for n, b in asides if not any(_meet(b, own) for own in boxes))
        boxes.append(box)
        found.append((number, finding, at, lines))
    return found


def _box(at: Array, name: str, lines: int, plan: Survey) -> Array:
    """What a name takes up that steps aside by so many lines, [(low, high), (x, y)], m."""
    size = float(np.ptp(plan.ends, axis=0).max())
    high, side = inwards(at, plan)
    off, width = BESIDE * size, LETTER * size * len(name)
    left = at[0] - off - width if side == "left" else at[0] + off
    away = -1.0 if high == "bottom" else 1.0
    middle = at[1] + away * (LINE * size * lines + (off if high != "middle" else 0.0))
    half = LINE * size / 2
    return np.array([[left, middle - half], [left + width, middle + half]])


def _meet(one: Array, other: Array) -> bool:
    return bool((one[0] < other[1]).all() and (other[0] < one[1]).all())


def label(number: int, finding: Finding) -> str:
    """A finding's number and name."""
    return f"{number}. {brief(finding.label)}"


def plot_plan(diagnosis: Diagnosis, ax: Axes | None = None) -> Axes:
    """Draw the ring from above: magnets along the orbit, BPMs and correctors small, findings
    marked."""
    if ax is None:
        _, ax = plt.subplots(figsize=(6.5, 6.5), layout="constrained")
    plan = survey(diagnosis.ring)
    ax.plot(*plan.ends.T, color="0.7", linewidth=0.8, zorder=1)
    for kind, places in groups(diagnosis).items():
        if kind in SMALL:
            look, at = SMALL[kind], beside(plan, kind, places)
            ax.plot(*at.T, look.marker, color=look.colour, ms=1.5, zorder=3, label=plural(kind))
            continue
        arcs = [(plan.ends[i], plan.middle[i], plan.ends[i + 1]) for i in places]
        short = kind in ("quadrupole", "sextupole")  # ticks across the bends
        lines = LineCollection(
            arcs, colors=COLOURS[kind], linewidths=7 if short else 3, zorder=2 + 0.5 * short,
            label=plural(kind),
        )  # fmt: skip
        ax.add_collection(lines)
    for number, finding, place, lines_off in placed(diagnosis, plan):
        ax.plot(*place, "o", ms=16, mfc="none", mec=CULPRIT, mew=2.2, zorder=5)
        name = label(number, finding)
        (left, low), (right, high) = _box(place, name, lines_off, plan)
        to_left = inwards(place, plan)[1] == "left"
        ax.text(
            right if to_left else left, (low + high) / 2, name, va="center",
            ha="right" if to_left else "left", color=CULPRIT, fontweight="bold", zorder=6,
        )  # fmt: skip
    for suspect in diagnosis.suspects:
        at = plan.at([suspect.element])[0]
        ax.plot(*at, "o", ms=12, mfc="none", mec=SUSPECT, mew=1.5, zorder=4)
    ax.set_aspect("equal")
    ax.margins(0.06)
    ax.set_xlabel("x [m]")
    ax.set_ylabel("y [m]")
    ax.legend(fontsize="x-small", frameon=False, loc="center")
    return ax
