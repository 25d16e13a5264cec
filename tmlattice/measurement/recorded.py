"""Readings that a recorder adds or cuts: shots recorded twice, turns or columns that repeat one
reading, readings that are clipped at the end of a range, and numbers that stand for no reading.

>>> data, sentences = recorded(data, [monitor.name for monitor in ring.monitors])
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np

from tmlattice.arrays import Array, Flags
from tmlattice.errors import MeasurementError, first_of
from tmlattice.measurement.assume import in_beam_order, read_of, with_read
from tmlattice.measurement.lost_beam import beam_lost, constant_or_none, exact
from tmlattice.measurement.monitors import LARGEST_READING
from tmlattice.measurement.orbit_response import OrbitResponse
from tmlattice.measurement.shots import ClosedOrbit, TurnByTurn
from tmlattice.measurement.trajectory import Measurement

Data = TypeVar("Data")

FEWEST = 8
"""Readings of a shot, from which another one of noise is not the same to the last digit."""
OFTEN = 5
"""Readings at exactly the largest value for each at another value above a fifth of it, from which
that is the end of a range: at the peaks of an oscillation there are at most 2.5."""
TURNS = 16
"""Successive turns with exactly one reading, from which a BPM has no signal in them."""
HALF = 0.5
"""Share of such readings of a plane, from which it is the beam that has none."""
FEW = 0.25
"""Share of the readings that are 0, or of the signals that are constant, up to which these are of
BPMs without a signal: above, it is the orbit."""
SENSIBLE = LARGEST_READING / 10
"""m; typical reading below which the readings are in metres, and larger ones are none."""
NO_MEAN = 1e-4
"""Mean of the rows at a typical BPM, over a typical reading, below which they were subtracted from
one another: the orbit, noise and launches of shots leave 1e-2, those of 100 shots 1e-3."""
FINE = 3.0
"""Step of rounded readings over their noise, up to which the noise covers it: it adds a third."""
EXACT, DIGITS = 1e-5, 0.01
"""Smallest step, over the largest reading, that is looked for, and its relative tolerance."""
SHOWN = 8
"""Names in a sentence at most."""


def recorded(data: Data, ring_monitors: Sequence[str]) -> tuple[Data, list[str]]:
    """The data without repeated shots, with readings NaN that repeat, are clipped or stand for
    none, and a sentence about each.

    Args:
        data: of any kind; only those with noise are changed.
        ring_monitors: names, in beam order.

    Raises:
        MeasurementError: turns that are not in metres, whose lines would not show it; differences
            from the mean.
    """
    own: Any = data
    if not hasattr(own, "monitors") or exact(own) or not ring_monitors:
        return data, []
    own = in_beam_order(own, ring_monitors)
    said: list[str] = []
    if isinstance(own, OrbitResponse):
        own, said = _each_column_once(own)
    elif getattr(own, "READ", "") == "readings":
        own, said = _each_shot_once(own)
    if said == [] and isinstance(own, Measurement | ClosedOrbit | OrbitResponse):
        _no_differences(read_of(own))

    def without(bad: Flags, what: str, correction: str) -> None:
        nonlocal own
        if bad.any():
            names = [own.monitors[m] for m in np.flatnonzero(bad.any(axis=(0, 2)))]
            number, be = ("1 reading", "is") if bad.sum() == 1 else (f"{bad.sum()} readings", "are")
            said.append(f"{number} {be} {what}, and {be} rejected, of {first_of(names, SHOWN)}; "
                        f"{correction}")  # fmt: skip
            left = np.where(bad, np.nan, _rows(own))

            def changed(values: Array) -> Array:
                nonlocal left
                count = values.size // left[0].size
                taken, left = left[:count], left[count:]
                return np.asarray(taken.reshape(values.shape))

            own = with_read(own, changed)

    if isinstance(own, TurnByTurn):
        typical = float(np.nanmedian(np.abs(own.readings)))
        if typical > SENSIBLE:
            raise MeasurementError(f"the typical reading is {typical:.2g} m, and no beam "
                                   "oscillates so far: give the readings in metres")  # fmt: skip
        again = _again(own.readings).reshape(_rows(own).shape)
        without(again, f"the same as those before for {TURNS} turns and more", "correct these BPMs")
    elif isinstance(own, OrbitResponse):
        stuck = _stuck(own.response)
        stuck &= (stuck.mean() < FEW) | (stuck.all(axis=0) & ~stuck.all())
        same = stuck & np.isfinite(_rows(own))
        without(same, "the same for every corrector", "correct these BPMs")
    lossy: Any = own
    signal = beam_lost(lossy).without if isinstance(own, Measurement | TurnByTurn) else own
    ends, none = _ends(_rows(signal))
    values = _rows(own)
    without(none, f"{_most(values[none])}, which no beam reads", "leave such fields empty")
    without(ends, f"clipped at {_most(np.abs(values[ends]))}, the end of a range",
            "widen the range")  # fmt: skip
    step = _step(_rows(own))
    if own.noise is not None and (own.noise < step / FINE).any():
        said.append(f"the readings are rounded to {1e6 * step:.3g} µm, more than the stated noise "
                    "allows, which is raised; read more digits")  # fmt: skip
        own = replace(own, noise=np.hypot(own.noise, step / np.sqrt(12)))
    return own, said


def _step(readings: Array) -> float:
    """The step of which all readings are multiples, m; 0 if there is none."""
    values = np.unique(np.abs(readings[np.isfinite(readings)]))
    steps = np.diff(values)
    if len(steps) < FEWEST or not steps.min() > EXACT * values[-1]:
        return 0.0
    step = float(steps.min())
    for _ in range(2):  # the second time with the rounding of the numbers averaged
        counts = np.round(values / step)
        if np.abs(values - counts * step).max() > DIGITS * step:
            return 0.0
        step = float(values @ counts / (counts @ counts))
    return step


def _rows(data: Any) -> Array:
    """All that was read, [row, monitor, 2]: of an orbit response the RF's orbit too."""
    parts: list[Array] = []

    def keep(values: Array) -> Array:
        parts.append(values.reshape(-1, *values.shape[-2:]))
        return values

    with_read(data, keep)
    return np.concatenate(parts)


def _most(values: Array) -> str:
    """Some values, the most frequent first."""
    each, counts = np.unique(values, return_counts=True)
    return first_of([f"{v:g}" for v in each[np.argsort(-counts, kind="stable")]], 4) + " m"


def _each_shot_once(data: Any) -> tuple[Any, list[str]]:
    first: dict[Any, int] = {}
    read = []
    for k, (shot, readings) in enumerate(zip(data.shots, data.readings, strict=True)):
        there = np.isfinite(readings)
        if there.sum() >= FEWEST:
            read.append(shot)
            settings = str(data.settings[k]) if data.settings else ""
            first.setdefault((settings, np.where(there, readings, np.inf).tobytes()), shot)
    kept = [*first.values()]
    twice = [shot for shot in read if shot not in kept]
    if not twice or len(kept) < 2:
        return data, []
    return data.select(shots=[shot for shot in data.shots if shot not in twice]), [
        f"{len(twice)} of {len(read)} shots {'repeat' if len(twice) > 1 else 'repeats'} another to "
        f"the last digit, left out: {first_of([str(shot) for shot in twice], SHOWN)}; record each "
        "shot once"
    ]


def _each_column_once(data: OrbitResponse) -> tuple[OrbitResponse, list[str]]:
    """Without columns that are those of another corrector, or 0."""
    columns = [np.nan_to_num(own).tobytes() for own in data.response]
    bad = [name for name, own, read in zip(data.correctors, columns, data.response, strict=True)
           if columns.count(own) > 1 or not np.nan_to_num(read).any()]  # fmt: skip
    if not bad or len(bad) == len(columns):
        return data, []
    kept = [name for name in data.correctors if name not in bad]
    return data.select(correctors=kept), [
        f"rejected: {len(bad)} of {len(columns)} columns, 0 or the same as another to the last "
        f"digit, of {first_of(bad, SHOWN)}; give the orbit change by each corrector"
    ]


def _no_differences(rows: Array) -> None:
    """Raise an error if the mean over all rows [row, .., monitor, 2] was subtracted from them."""
    if np.isfinite(rows).any(axis=0).all() and len(rows) > 2:
        size, mean = (np.sqrt(np.nanmean(v**2)) for v in (rows, np.nanmean(rows, axis=0)))
        if mean < NO_MEAN * size:
            raise MeasurementError(
                "the readings of every BPM average to 0: they are differences from their mean; "
                "give the readings themselves"
            )


def _again(readings: Array) -> Flags:
    """Which readings [shot, turn, monitor, 2] are of a run of the same, where other BPMs read."""
    again = np.zeros(readings.shape, dtype=bool)
    if readings.shape[1] < TURNS:
        return again
    same = readings[:, 1:] == readings[:, :-1]
    runs = np.lib.stride_tricks.sliding_window_view(same, TURNS - 1, axis=1).all(axis=-1)
    for turn in range(TURNS):
        again[:, turn : turn + runs.shape[1]] |= runs
    most = again.mean(axis=(1, 2), keepdims=True) > HALF  # the beam was lost, or not there
    return np.asarray(again & ~most)


def _stuck(readings: Array) -> Flags:
    """Which signals [monitor, 2] of readings [.., monitor, 2] are always the same."""
    flat = readings.reshape(-1, *readings.shape[-2:])
    return np.asarray((np.isfinite(flat).sum(axis=0) > 2) & constant_or_none(flat, 0))


def _ends(readings: Array) -> tuple[Flags, Flags]:
    """Which readings [.., monitor, 2] are at the largest or smallest value of their plane, where
    that is read again and again; and which are none of a beam: too large, or such values far above
    all others, or 0."""
    ends, none = np.zeros((2, *readings.shape), dtype=bool)
    values = np.where(_stuck(readings), np.nan, readings)
    size = np.abs(values)
    other, counts = np.unique(size[size > 0], return_counts=True)
    if not len(other):
        return ends, none
    if (size == 0).sum() >= OFTEN * counts.max() and (size == 0).mean() < FEW:
        none |= size == 0
    large = size > LARGEST_READING
    if np.nanmedian(size) < SENSIBLE and large.mean() < FEW:  # else the unit of all is wrong
        usual = np.nanquantile(np.where(np.isfinite(size), size, 0.0), 1 - FEW, axis=(1, 2))
        none |= large & (size > OFTEN * usual[:, None, None])  # else the unit of the row is wrong
    for plane in range(2):
        for side in (1, -1):
            signed = np.where(none[..., plane], np.nan, side * values[..., plane])
            own, counts = np.unique(signed[signed > 0], return_counts=True)
            upper = counts[:-1][own[:-1] > own[-1:] / OFTEN]
            if len(own) > 1 and counts[-1] >= OFTEN * upper.max(initial=1):
                (ends if len(upper) else none)[..., plane] |= signed == own[-1]
    return ends, none
