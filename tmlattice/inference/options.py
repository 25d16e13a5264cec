"""What could be done next without a name: a free kick, a monitor set aside, a reading left out."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from tmlattice.inference.alternatives import Alternative, Detection
from tmlattice.inference.problem import Point, Problem
from tmlattice.inference.scan import FreeScan, free_threshold, look_elsewhere

READINGS_PER_OUTLIER = 10
"""Readings for each one that is wrong for once: of a few, such as two tunes, none is."""

Reading = tuple[int, ...]
"""Where it stands among the problem's readings."""


@dataclass(frozen=True)
class Option:
    """What could be done next: by how much the log evidence grows, and how it was seen."""

    kind: str
    name: str
    gain: float
    detection: Detection
    where: int = -1
    reading: Reading = ()
    alternatives: tuple[Alternative, ...] = ()


def unnamed(
    problem: Problem,
    kind: str,
    free: FreeScan,
    names: Sequence[str],
    taken: Mapping[int, Detection],
) -> list[Option]:
    """Something without a name at the place where it explains most, if that is clear.

    Args:
        problem: model and data.
        kind: "kick" or "monitor".
        free: the scan of all places.
        names: of the places.
        taken: places that have one already.
    """
    rate = problem.judgement.rate(kind)
    place = int(free.gain.argmax())
    where = int(free.places[place])
    freedom = max(int(free.freedom[place]), 1)
    seen = Detection(
        float(free.statistic[place]),
        free_threshold(rate, freedom, len(names)),
        look_elsewhere(float(free.statistic[place]), freedom, len(names)),
    )
    if not seen.p_value < rate or where in taken:
        return []
    gain = float(free.gain[place]) + problem.unknown_prior(len(names))
    return [Option(kind, f"{kind} at {names[where]}", gain, seen, where=where)]


def outlier(problem: Problem, point: Point, already: int) -> list[Option]:
    """The reading that is least explained, left out, if that is clear.

    Args:
        problem: model and data.
        point: the model at what was found.
        already: readings that were left out.
    """
    judge = problem.judgement
    if int(problem.valid.sum()) < READINGS_PER_OUTLIER * (already + 1):
        return []
    clean, size = problem.left(point)
    statistic = np.where(size > 1e-3, clean**2 / np.maximum(size, 1e-3), 0.0)
    worst = tuple(int(i) for i in np.unravel_index(int(statistic.argmax()), statistic.shape))
    value, count = float(statistic[worst]), float(problem.valid.sum())
    rate = judge.rate("reading")
    seen = Detection(value, free_threshold(rate, 1, count), look_elsewhere(value, 1, count))
    if not seen.p_value < rate:
        return []
    # an amount even over its logarithm, as for every other cause
    gain = 0.5 * value - 0.5 * np.log(max(value, 1.0)) - np.log(4.0) + judge.outlier_prior
    return [Option("reading", f"reading {worst}", float(gain), seen, reading=worst)]
