"""What took no part in a diagnosis, in words: monitors without a reading, rejected readings."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from tmlattice.diagnosis.kinds import Part
from tmlattice.diagnosis.result import Finding
from tmlattice.inference.search import Explanation
from tmlattice.inference.together import Together
from tmlattice.lattice import Ring
from tmlattice.observe.first_turns import FirstTurns
from tmlattice.speaks import micrometres


def with_silent(ring: Ring, part: Part, measured: Any) -> Part:
    """The part, saying which monitors of its measurement read nothing that can be used.

    Args:
        ring: with the monitors.
        part: made of the measurement; what it found dead becomes a finding, and is not said again.
        measured: of any kind; one without monitors has nothing to say.
    """
    problem = part.problem
    owners = problem.owner()
    heard = {
        ring[problem.monitors[m]].name for m in np.unique(owners[problem.valid & (owners >= 0)])
    }
    heard |= {ring.monitors[m].name for m, _ in part.dead}
    names = [ring[name].name for name in getattr(measured, "monitors", ())]
    silent = [name for name in names if name not in heard]
    if not silent:
        return part
    said = f"no reading that can be used of {', '.join(silent)}: left out"
    return replace(part, said=(*part.said, said))


def spikes(parts: Sequence[Part], problem: Together, found: Explanation) -> Iterator[str]:
    """A sentence for each measurement with single readings that the search left out."""
    ends = np.cumsum([part.valid.size for part in problem.parts])
    own: dict[int, list[int]] = {}
    for reading in found.spikes:
        flat = int(np.ravel(reading)[-1])
        own.setdefault(int(np.searchsorted(ends, flat, side="right")), []).append(flat)
    for index, (part, one) in enumerate(zip(parts, problem.parts, strict=False)):
        if index not in own:
            continue
        owners = one.owner().ravel()
        start = int(ends[index]) - one.valid.size
        count = Counter(one.monitors[owners[flat - start]] for flat in own[index])
        told = [name if many == 1 else f"{name} ({many})" for name, many in count.items()]
        yield f"{part.label}: single readings left out as spikes: {', '.join(told)}"


# --- of first turns -------------------------------------------------------------------------------
def rejected_readings(part: Part, found: Explanation) -> tuple[dict[str, Any], ...]:
    """Single readings that the search rejected, {"shot", "turn", "monitor", "plane"}; the shot of a
    reference is None."""
    rows: list[dict[str, Any]] = []
    names = part.problem.monitors
    for (flat,) in found.spikes:
        shot, reading, plane = np.unravel_index(flat, part.problem.valid.shape)
        turn, monitor = divmod(int(reading), len(names))
        rows.append({
            "shot": part.shots[0][shot], "turn": turn, "monitor": names[monitor],
            "plane": "xy"[plane],
        })  # fmt: skip
    return tuple(rows)


def noise_text(noise: tuple[float, float]) -> str:
    """That the noise of both planes, m, was estimated."""
    both = zip(noise, "xy", strict=True)
    levels = [f"{micrometres(own)} in {plane}" for own, plane in both if np.isfinite(own)]
    return f"the noise was estimated from the data: {', '.join(levels)}"


def about_launches(part: Part, findings: Sequence[Finding]) -> list[str]:
    """What the launches that were read leave open of the findings, in sentences."""
    assert isinstance(part.problem, FirstTurns)
    told, data = [], part.problem.data
    if not data.planes.all() and any(finding.effect is None for finding in findings):
        unread, other = ("x", "y") if data.planes[1] else ("y", "x")
        told.append(
            f"what is located may begin upstream in {unread}, which sextupoles pass on to {other}"
        )
    if data.active.sum() == 1 and findings:
        told.append(
            "one trajectory gives one kick at each place: it locates, but any single multipole "
            "explains it; two or more launches name the effect"
        )
    return told


SHOWN = 4
"""Readings left out that a warning names."""


def about_rejected(outliers: Sequence[Mapping[str, Any]]) -> list[str]:
    """A sentence about rejected readings, if there are any."""
    if not outliers:
        return []
    some = "; ".join(
        f"{row['monitor']} {row['plane']}, "
        + ("the reference" if row["shot"] is None else f"shot {row['shot']}")
        + (f", turn {row['turn']}" if row["turn"] else "")
        for row in outliers[:SHOWN]
    )
    more = f"; and {len(outliers) - SHOWN} more" if len(outliers) > SHOWN else ""
    return [f"{len(outliers)} single readings are wrong for once and were left out: {some}{more}"]
