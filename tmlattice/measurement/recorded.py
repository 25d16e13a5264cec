"""Readings that a recorder adds or cuts: shots recorded twice, turns that repeat one reading, and
readings that are clipped at the end of a range.

>>> data, sentences = recorded(data, [monitor.name for monitor in ring.monitors])
"""

from collections.abc import Sequence
from typing import Any, TypeVar

import numpy as np

from tmlattice.arrays import Array, Flags
from tmlattice.errors import first_of
from tmlattice.measurement.assume import in_beam_order, with_read
from tmlattice.measurement.lost_beam import beam_lost, exact
from tmlattice.measurement.shots import TurnByTurn
from tmlattice.measurement.trajectory import Measurement

Data = TypeVar("Data")

FEWEST = 8
"""Readings of a shot, from which another one of noise is not the same to the last digit."""
OFTEN = 5
"""Readings at exactly the largest value for each at another value of the upper half, from which
that is the end of a range: at the peaks of an oscillation there are at most 2.5."""
TURNS = 16
"""Successive turns with exactly one reading, from which a BPM has no signal in them."""
HALF = 0.5
"""Share of such readings of a plane, from which it is the beam that has none."""
SHOWN = 8
"""Names in a sentence at most."""


def recorded(data: Data, ring_monitors: Sequence[str]) -> tuple[Data, list[str]]:
    """The data without repeated shots, with repeated and clipped readings NaN, and a sentence about
    each.

    Args:
        data: of any kind; only readings of shots with noise are changed.
        ring_monitors: names, in beam order.
    """
    own: Any = data
    if getattr(own, "READ", "") != "readings" or exact(own) or not ring_monitors:
        return data, []
    own = in_beam_order(own, ring_monitors)
    said = []
    first: dict[Any, int] = {}
    read = []
    for k, (shot, readings) in enumerate(zip(own.shots, own.readings, strict=True)):
        there = np.isfinite(readings)
        if there.sum() >= FEWEST:
            read.append(shot)
            settings = str(own.settings[k]) if own.settings else ""
            first.setdefault((settings, np.where(there, readings, np.inf).tobytes()), shot)
    kept = [*first.values()]
    twice = [shot for shot in read if shot not in kept]
    if twice and len(kept) > 1:
        own = own.select(shots=[shot for shot in own.shots if shot not in twice])
        said.append(
            f"{len(twice)} of {len(read)} shots repeat another to the last digit, and are left "
            f"out: {first_of([str(shot) for shot in twice], SHOWN)}; record each shot once"
        )
    if isinstance(own, TurnByTurn):
        again = _again(own.readings)
        if again.any():
            names = [own.monitors[m] for m in np.unique(np.nonzero(again)[-2])]
            said.append(
                f"{again.sum()} readings are the same as those before for {TURNS} turns and more, "
                f"and are left out, of {first_of(names, SHOWN)}; correct these BPMs"
            )
            own = with_read(own, lambda values: np.where(again, np.nan, values))
    lossy: Any = own
    signal = beam_lost(lossy).without if isinstance(own, Measurement | TurnByTurn) else own
    ends = _ends(signal.readings)
    if ends.any():
        names = [own.monitors[m] for m in np.unique(np.nonzero(ends)[-2])]
        largest = np.unique(np.abs(own.readings[ends]))
        said.append(
            f"{ends.sum()} readings are clipped at {first_of([f'{v:g}' for v in largest], 4)} m, "
            f"the end of a range, and are left out, of {first_of(names, SHOWN)}; widen the range"
        )
        own = with_read(own, lambda values: np.where(ends, np.nan, values))
    return own, said


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


def _ends(readings: Array) -> Flags:
    """Which readings [.., monitor, 2] are at the largest or smallest value of their plane, where
    that is read again and again."""
    ends = np.zeros(readings.shape, dtype=bool)
    flat = readings.reshape(-1, *readings.shape[-2:])
    stuck = (len(flat) > 1) & ((flat == flat[:1]) | np.isnan(flat)).all(axis=0)
    for plane in range(2):
        for side in (1, -1):
            values = np.where(stuck[:, plane], np.nan, side * readings[..., plane])
            own, counts = np.unique(values[values > 0], return_counts=True)
            others = counts[:-1][own[:-1] > own[-1] / 2] if len(own) else counts
            if len(others) and counts[-1] >= OFTEN * others.max():
                ends[..., plane] |= values == own[-1]
    return ends
