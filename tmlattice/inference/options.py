"""Next steps of a search without an effect of the catalogue: free kick, BPM or reading rejected."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from tmlattice.inference.alternatives import Alternative, Detection
from tmlattice.inference.problem import Point, Problem
from tmlattice.inference.scan import FreeScan, free_threshold, look_elsewhere

READINGS_PER_OUTLIER = 10
"""Readings per rejected one, at least: of a few readings, such as two tunes, none is rejected."""

Reading = tuple[int, ...]
"""Index among the problem's readings."""


@dataclass(frozen=True)
class Option:
    """Next step of a search: its gain in log evidence, and its significance."""

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
    """Free kick or rejected BPM that explains most, if significant.

    Args:
        problem: model and data.
        kind: "kick" or "monitor".
        free: the scan of all places.
        names: of the places.
        taken: places that have one.
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
    """Rejection of the reading with the largest residual, if significant.

    Args:
        problem: model and data.
        point: the model of the fit.
        already: number of rejected readings.
    """
    thresholds = problem.judgement
    if int(problem.valid.sum()) < READINGS_PER_OUTLIER * (already + 1):
        return []
    clean, size = problem.left(point)
    statistic = np.where(size > 1e-3, clean**2 / np.maximum(size, 1e-3), 0.0)
    worst = tuple(int(i) for i in np.unravel_index(int(statistic.argmax()), statistic.shape))
    value, count = float(statistic[worst]), float(problem.valid.sum())
    rate = thresholds.rate("reading")
    seen = Detection(value, free_threshold(rate, 1, count), look_elsewhere(value, 1, count))
    if not seen.p_value < rate:
        return []
    # a log-uniform amount, as for every other cause
    gain = 0.5 * value - 0.5 * np.log(max(value, 1.0)) - np.log(4.0) + thresholds.outlier_prior
    return [Option("reading", f"reading {worst}", float(gain), seen, reading=worst)]
