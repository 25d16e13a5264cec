"""Readings of monitors with errors."""

from dataclasses import dataclass, replace

import numpy as np

from tmlattice.arrays import Array, Flags
from tmlattice.errors import EffectError


@dataclass
class Monitors:
    """Monitors with all their errors.

    reading = diag(1 + gain) C Rot(roll) beam + offset, C = [[1, c], [c, 1]], then the swap, then
    noise; Rot: x_read = x cos + y sin, y_read = -x sin + y cos.

    Attributes:
        gain, offset: [monitor, 2], relative and m.
        roll, coupling: [monitor], rad and 1.
        late: turns by which the monitor's turn t is later than the beam's turn t, [monitor].
        swapped, silent, frozen: [monitor], true or false.
    """

    gain: Array
    offset: Array
    roll: Array
    coupling: Array
    late: Array
    swapped: Flags
    silent: Flags
    frozen: Flags

    @classmethod
    def perfect(cls, count: int) -> "Monitors":
        """Return monitors without errors."""
        plane, flag = np.zeros((count, 2)), np.zeros(count, dtype=bool)
        one = np.zeros(count)
        return cls(plane, plane.copy(), one, one.copy(), one.copy(), flag, flag.copy(), flag.copy())

    @classmethod
    def of(cls, matrix: Array) -> "Monitors":
        """Return monitors with d reading / d beam [monitor, 2, 2], none swapped: the inverse of
        `matrix`. One that reads nothing of a plane has a gain of -1 there."""
        found = cls.perfect(len(matrix))
        own, other = matrix[:, [0, 1], [0, 1]], matrix[:, [0, 1], [1, 0]]
        angle = np.arctan(np.divide(other, own, out=np.zeros_like(own), where=own != 0))
        found.roll = (angle[:, 0] - angle[:, 1]) / 2
        found.coupling = np.tan((angle[:, 0] + angle[:, 1]) / 2)
        # rows of C Rot(roll) and of C have the same norm
        longer = np.hypot(1, found.coupling)[:, None]
        found.gain = np.sign(own) * np.hypot(own, other) / longer - 1
        return found

    def copy(self) -> "Monitors":
        """Return a copy with the same errors."""
        return replace(self, **{name: value.copy() for name, value in vars(self).items()})

    def matrix(self) -> Array:
        """Return d reading / d beam, diag(1 + gain) C Rot(roll), then the swap, [monitor, 2, 2]."""
        cos, sin, c = np.cos(self.roll), np.sin(self.roll), self.coupling
        turned = np.array([[cos + -c * sin, sin + c * cos], [c * cos - sin, c * sin + cos]])
        matrix = (1 + self.gain)[:, :, None] * np.moveaxis(turned, -1, 0)
        matrix[self.swapped] = matrix[self.swapped][:, ::-1]
        return np.asarray(matrix)

    def constant(self) -> Array:
        """Return the readings without a beam, [monitor, 2], m."""
        return np.where(self.swapped[:, None], self.offset[:, ::-1], self.offset)

    @property
    def ahead(self) -> int:
        """Number of later turns of the beam that some monitor reads."""
        return int(max(np.ceil(self.late.max(initial=0.0)), 0))

    def counted(self, beam: Array, turns: int, before: Array | float = np.nan) -> Array:
        """Return the beam on the turns that each monitor counts, [shot, turn, monitor, 2].

        Args:
            beam: on turns from 0 on, `ahead` more than `turns`.
            before: position before turn 0, broadcastable to [shot, turn, monitor, 2].

        Raises:
            EffectError: a turn offset is not a whole number.
        """
        if not self.late.any():
            return beam[:, :turns]
        if (self.late != np.round(self.late)).any():
            raise EffectError("monitor_turn_offset is a whole number of turns, as 1 or -2")
        seen = beam[:, :turns].copy()
        for monitor in np.flatnonzero(self.late):
            at = np.arange(turns) + round(self.late[monitor])
            own = beam[:, np.maximum(at, 0), monitor]
            outside = np.broadcast_to(before, seen.shape)[:, :, monitor]
            seen[:, :, monitor] = np.where((at < 0)[None, :, None], outside, own)
        return seen

    def read(self, beam: Array) -> Array:
        """Return readings without noise of the beam [..., monitor, 2] (x, y), m; NaN if silent.

        A frozen monitor reads on here: see `machine`.
        """
        readings = np.einsum("mij,...mj->...mi", self.matrix(), beam) + self.constant()
        readings[..., self.silent, :] = np.nan
        return np.asarray(readings)
