"""Outliers of first turns, and shots unlike the others, before any search for faults.

>>> measurement, sentences = without_spoilt(ring, measurement)

A fault of the machine or of a BPM is in every shot. A reading that does not follow the trajectory
of its neighbours in one shot, where the same ones of other shots do, is an outlier. So is a shot
that follows no trajectory where the others do: one with swapped planes, in another unit, or of
another machine.
"""

from dataclasses import replace

import numpy as np

from tmlattice.errors import MeasurementError, first_of
from tmlattice.inference.judgement import GROSS, MISSTATED
from tmlattice.lattice import Ring
from tmlattice.measurement import Measurement
from tmlattice.measurement.assume import in_beam_order
from tmlattice.observe.global_errors import SHOTS, OfTurns
from tmlattice.observe.sections import Passes, SectionFits

SPOILT = 3.0
"""Misfit of a section over the typical one above which it is not used."""
HALF = 0.5
"""Share of the orbit that typical sections leave, from which nothing can be concluded."""
ROUNDS = 4
"""Readings of one section and shot that may be outliers."""
Place = tuple[int, int, int, int]
FEWEST = 3
"""Shots, of which one may be unlike the others."""


def without_spoilt(ring: Ring, data: Measurement) -> tuple[Measurement, dict[str, str]]:
    """Return the data without outliers and without shots unlike the others, and a sentence about
    each kind, by the name of its check.

    Args:
        ring: the design.
        data: first turns, their monitors those of the ring.
    """
    count = len(data.shots)
    said: dict[str, str] = {}
    if count < FEWEST or not ring.monitors:
        return data, said
    data = in_beam_order(data, [monitor.name for monitor in ring.monitors])
    outliers: list[Place] = []
    unlike: list[int] = []
    for shots in np.array_split(np.arange(count), -(-count // SHOTS)):
        try:
            search = OfTurns(ring, data.select(shots=[data.shots[i] for i in shots]))
            own = _unlike(search)
            left = [i for i in range(len(shots)) if i not in own]
            if own:
                search = OfTurns(ring, data.select(shots=[data.shots[shots[i]] for i in left]))
            found = _outliers(search)
        except MeasurementError:  # nothing can be fitted; reported elsewhere
            continue
        unlike += [int(shots[i]) for i in own]
        outliers += [(int(shots[left[i]]), turn, m, plane) for i, turn, m, plane in found]
    if outliers:
        bad = np.zeros(data.readings.shape, dtype=bool)
        bad[tuple(np.transpose(outliers))] = True
        names = [
            f"{data.monitors[m]} in {'xy'[plane]}, shot {data.shots[i]}, turn {turn}"
            for i, turn, m, plane in sorted(outliers)
        ]
        said["outliers"] = f"outliers, rejected: {first_of(names)}; leave them empty"
        data = replace(data, readings=np.where(bad, np.nan, data.readings))
    if unlike:
        ids = [data.shots[i] for i in unlike]
        said["shots"] = (
            f"shot {', '.join(map(str, ids))} is rejected: it follows no trajectory of "
            f"'{ring.name}', and the others do; record it again, or correct its readings or "
            "settings"
        )
        data = data.select(shots=[shot for shot in data.shots if shot not in ids])
    return data, said


def _unlike(search: OfTurns) -> list[int]:
    """Shots of which sections leave more of the orbit than those of all others."""
    passes, found = search.found(search.data)
    number = len(search.data.shots)
    there = found.freedom > 0
    if number < FEWEST or not found.share(passes) < HALF:
        return []  # nothing follows a trajectory: signs, units or order are wrong, or the lattice
    left = np.full(number, np.nan)
    for shot in range(number):
        own = there & (passes.shot == shot)[:, None]
        left[shot] = np.sqrt(np.median(found.misfit[own])) if own.any() else np.nan
    if not np.isfinite(left).any():
        return []
    size = np.sqrt(np.nanmean(search.data.readings**2, axis=(1, 2, 3)))
    size = np.minimum(size, MISSTATED * np.nanmedian(size))
    unlike = [own > MISSTATED * np.nanmedian(own) for own in (left, left / size)]
    shots = np.flatnonzero(np.logical_and(*unlike) & (left > MISSTATED))
    return shots.tolist() if 2 * len(shots) < number else []


def _outliers(search: OfTurns) -> list[Place]:
    """Outliers (shot, turn, monitor, plane), where the same section of other shots agrees."""
    data = search.data
    passes, fits = search.found(data)
    if not fits.share(passes) < HALF:
        return []
    most = SPOILT * fits.level
    bad = (fits.freedom > 2) & (fits.misfit > most) & (np.median(fits.misfit, axis=0) < most)
    taken: dict[tuple[int, int], list[Place]] = {}
    readings = data.readings.copy()
    for _ in range(ROUNDS):
        each = {(int(p), int(w)): _worst(passes, fits, p, w) for p, w in np.argwhere(bad)}
        worst = {own: place for own, place in each.items() if place is not None}
        for own, place in worst.items():
            taken.setdefault(own, []).append(place)
            readings[place] = np.nan
        if not worst:
            break
        passes, fits = search.found(replace(data, readings=readings.copy()))
        if fits.misfit.shape != bad.shape:  # nothing is left of a turn
            return []
        bad &= (fits.freedom > 2) & (fits.misfit > most)
    good = fits.misfit < most
    return [place for own, places in taken.items() if good[own] for place in places]


def _worst(passes: Passes, fits: SectionFits, p: int, w: int) -> Place | None:
    """The reading of a section of a pass that its others contradict most, if grossly."""
    alone = fits.left[p, w] ** 2 / np.maximum(fits.free[p, w], 0.05)
    worst = int(alone.argmax())
    if not alone[worst] > GROSS**2 * fits.level:
        return None
    return int(passes.shot[p]), int(passes.turn[p]), int(fits.owner[w, worst]), worst % 2
