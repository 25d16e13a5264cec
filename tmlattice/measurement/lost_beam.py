"""Readings without a signal: after the beam was lost electronics go on and write 0, or a constant.

>>> lost = beam_lost(measurement)
>>> lost.without                                  # the measurement, those readings NaN
>>> lost.first                                    # first reading without beam, [shot]
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from tmlattice.arrays import Array, Flags
from tmlattice.measurement.shots import TurnByTurn
from tmlattice.measurement.trajectory import Measurement

Places = NDArray[np.intp]
Data = TypeVar("Data", Measurement, TurnByTurn)

FEWEST = 3
"""BPMs without signal, the last ones, from which the beam is lost: one or two may be frozen."""
CHANCE = 1e-4
"""That successive BPMs read the same by chance, below which they have no signal."""
NO_BEAM = 0.05
"""Share of the BPMs' upstream, of their median, from which a sum signal is that of no beam."""
MANY = 200
"""Sum signals of which a median is taken: of those of many turns the first."""
REPEATED = 0.01
"""Share of successive readings that are equal in both planes, at least: few readings show none."""


@dataclass(frozen=True)
class LostBeam(Generic[Data]):
    """Where the signals of a measurement end.

    Attributes:
        without: the measurement with the readings after that NaN, and with those of a plane, or of
            a turn, that is one constant.
        first: the first reading without signal, turn * monitors + monitor, [shot]; the number of
            readings where the signal goes on to the end.
        last: the last reading with a signal before that, [shot]; -1 where there is none.
    """

    without: Data
    first: Places
    last: Places

    @property
    def shots(self) -> Places:
        """Indices of the shots in which the beam was lost."""
        return np.flatnonzero(self.first < self.without.readings[0].size // 2)


def beam_lost(data: Data) -> LostBeam[Data]:
    """Where the signals of each shot end in a constant.

    No signal is a run of the last BPMs of a shot that read the same, to the last digit in both
    planes; or of which each reads the same in all shots. The constant of one shot is no signal at
    the end of the others either, be it of one BPM. A run that begins at the first BPM of all shots
    is none.

    Args:
        data: first turns, or turns of a stored beam; monitors in beam order.
    """
    shots = len(data.readings)
    data = _planes(data)
    flat = data.readings.reshape(shots, -1, 2)
    there = np.isfinite(flat)
    count = flat.shape[1]
    first = np.full(shots, count, dtype=np.intp)
    for shot in range(shots):
        first[shot] = _constant_from(flat[shot], there[shot])
    if not first.any():
        first[:] = count
    lost = np.flatnonzero(first < count)
    for constant in np.unique(flat[lost, first[lost]], axis=0):
        same = ((flat == constant) | ~there).all(axis=2)
        start = count - np.logical_and.accumulate(same[:, ::-1], axis=1).sum(axis=1)
        read = (there.any(axis=2) & (np.arange(count) >= start[:, None])).any(axis=1)
        first = np.where(read, np.minimum(first, start), first)
    first = np.minimum(first, _frozen_from(flat, there))
    after = np.arange(count) >= first[:, None]
    if not (after[..., None] & there).any():
        none = np.full(shots, count, dtype=np.intp)
        return LostBeam(_turns(data), none, np.full(shots, count - 1))
    kept = there & ~after[..., None]
    last = np.where(kept.any(axis=2), np.arange(count), -1).max(axis=1)
    readings = np.where(kept, flat, np.nan).reshape(data.readings.shape)
    return LostBeam(_turns(replace(data, readings=readings)), first, last)


def _planes(data: Data) -> Data:
    """Without a plane that is one constant at all BPMs in all shots, where the other one is none.

    Readings without noise may be so: the orbit of a flat ring.
    """
    values = [own[np.isfinite(own)] for own in np.moveaxis(data.readings, 3, 0)]
    constant = [len(own) > 1 and not np.ptp(own) for own in values]
    if exact(data) or sum(constant) != 1 or not all(len(own) for own in values):
        return data
    return replace(data, readings=np.where(constant, np.nan, data.readings))


def _turns(data: Data) -> Data:
    """Without turns in which all BPMs read one constant, where other turns of the shot are none."""
    there = np.isfinite(data.readings)
    read = there.any(axis=(2, 3)) & (there.any(axis=3).sum(axis=2) >= FEWEST)
    constant = read & constant_or_none(data.readings, 2).all(axis=2)
    constant &= (read & ~constant).any(axis=1, keepdims=True)
    if exact(data) or not constant.any():
        return data
    return replace(data, readings=np.where(constant[..., None, None], np.nan, data.readings))


def constant_or_none(readings: Array, axis: int) -> Flags:
    """Where all that was read along an axis is one number, or nothing is."""
    there = np.isfinite(readings)
    high = np.where(there, readings, -np.inf).max(axis=axis)
    low = np.where(there, readings, np.inf).min(axis=axis)
    return np.asarray(high <= low)


def exact(data: Data) -> bool:
    """Whether readings have no noise, and so may repeat."""
    return data.noise is not None and not np.nan_to_num(data.noise, nan=1.0).all()


def _constant_from(readings: Array, there: Flags) -> int:
    """The first of the last readings [reading, 2] of a shot that are one constant."""
    count = len(readings)
    read = np.flatnonzero(there.any(axis=1))
    if not len(read):
        return count
    own = readings[read]
    same = ((own[1:] == own[:-1]) | ~there[read][1:]).all(axis=1)
    differ = np.flatnonzero(~same)
    start = int(differ[-1]) + 1 if len(differ) else 0
    number = len(read) - start
    usual = max(float(same[: max(start - 1, 0)].mean()) if start > 1 else 0.0, REPEATED)
    by_chance = usual ** (number - 1)
    return int(read[start]) if number >= FEWEST and by_chance <= CHANCE else count


def _frozen_from(readings: Array, there: Flags) -> int:
    """The first of the last readings [shot, reading, 2] that are each the same in all shots."""
    count = readings.shape[1]
    several = there.sum(axis=0) > 1  # [reading, plane]
    stuck = (several | ~there.any(axis=0)) & constant_or_none(readings, 0)
    signal = np.flatnonzero(~stuck.all(axis=1))
    start = int(signal[-1]) + 1 if len(signal) else 0
    number = int(several[start:].any(axis=1).sum())
    return start if start and number >= FEWEST else count


def no_beam(sums: Array) -> Flags:
    """Where a sum signal is next to nothing of that of the BPMs upstream, [shot, turn, monitor]."""
    none = np.zeros(sums.shape, dtype=bool)
    for signal, own in zip(np.abs(sums).reshape(len(sums), -1),
                           none.reshape(len(sums), -1), strict=True):  # fmt: skip
        upstream: list[float] = []
        read = np.flatnonzero(np.isfinite(signal))
        usual = float(np.median(signal[read])) if len(read) else 0.0
        for place in read:
            own[place] = signal[place] <= NO_BEAM * usual
            if not own[place] and len(upstream) < MANY:
                upstream.append(float(signal[place]))
                usual = float(np.median(upstream))
    return none


def about_sums(sums: Array, silent: Flags, read: Flags, names: Sequence[str]) -> list[str]:
    """Sentences about sum signals [shot, turn, monitor], and about readings that are left out."""
    if not np.isfinite(sums).any():
        return []
    lost = silent & read
    if not lost.any():
        return ["the sum signals are those of a beam at every BPM"]
    shots = np.flatnonzero(lost.any(axis=(1, 2)))
    first = names[int(lost[shots[0]].reshape(-1).argmax()) % len(names)]
    return [
        f"no beam by the sum signal at {lost.any(axis=(0, 1)).sum()} BPMs in {len(shots)} of "
        f"{len(sums)} shots, the first is {first}: their readings are left out"
    ]
