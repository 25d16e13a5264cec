"""Steps of a corrector during which something else kicked the beam.

The two orbits of a step are read seconds apart. A supply that jumps in between, a feedback, or an
injection element that pulses adds an orbit of its own: a kick at another place, which has nothing
to do with the corrector. Such a step leaves many times what is usual, and half of the monitors tell
where one kick has to be for the other half to agree. (PETRA III: 0.1 mrad of pkhw_wr_5, and beside
it 3 urad in y, a kilometre away.) It teaches nothing of the ring, and would judge by what no model
can know.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tmlattice.beam.kicks import orbits_of_kicks
from tmlattice.diagnosis.response.inconsistent_steps import orbits_of
from tmlattice.diagnosis.response.misplaced import clear
from tmlattice.diagnosis.response.state import State, amplitudes, rms_of

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Flags = NDArray[np.bool_]

TIMES = 5.0
"""What a step leaves, its own kick apart, over what the typical one leaves in the same plane."""
ALSO = 2.0
"""The same of a step that had a kick in the other plane: one of both."""
SHARE = 0.15
"""Of the mean square of the far monitors, left at most beside one kick elsewhere."""
HERE = 0.5
"""Of the same beside a jump at the corrector's own place, at most: else it stands elsewhere."""
ENOUGH, COLUMNS = 12, 5
"""Readings of a column, and columns of a plane, that it takes to say so."""


@dataclass(frozen=True)
class SpuriousKick:
    """Something that kicked the beam while a corrector was stepped.

    Attributes:
        column: of the corrector.
        plane: 0 for x, 1 for y.
        layer: the magnet behind which one such kick explains most; others in the same phase of the
            betatron oscillation explain as much.
        amount: rad.
    """

    column: int
    plane: int
    layer: int
    amount: float


def spurious_kicks(state: State) -> list[SpuriousKick]:
    """Those that stand out.

    Args:
        state: with gains, rolls and gradients.
    """
    found = []
    for kicked in (0, 1):
        for plane in (0, 1):
            found += _of_planes(state, kicked, plane)
    return found


def left_in_plane(state: State, suspects: Sequence[int]) -> list[int]:
    """Of columns that something else kicked in the plane across, those that leave more than is
    usual in their own, too.

    Args:
        state: as in `spurious_kicks`.
        suspects: the columns.
    """
    found: list[int] = []
    for plane in (0, 1) if suspects else ():
        columns = _columns(state, plane, plane)
        usual = float(np.median([one.rms for one in columns])) if columns else 0.0
        found += [one.column for one in columns
                  if one.column in suspects and one.rms > ALSO * usual]  # fmt: skip
    return found


@dataclass(frozen=True)
class _Column:
    """What a column reads, and leaves, in one plane, m, and the pattern of its own amplitude,
    [reading]."""

    column: int
    seen: Indices
    own: Array
    orbit: Array
    left: Array

    @property
    def rms(self) -> float:
        """Beside its own amplitude."""
        every = np.ones(len(self.left), dtype=bool)
        return rms_of([amplitudes(self.own[:, None], self.left, every, every)[1]])

    @property
    def explained(self) -> float:
        """rms of the orbit that its own kick makes: of a corrector that is turned nearly all of it
        is in the plane across, m."""
        return float(np.sqrt(np.maximum(np.mean(self.orbit**2) - self.rms**2, 0.0)))


def _columns(state: State, kicked: int, plane: int) -> list[_Column]:
    data, at = state.data, state.at
    rows = np.flatnonzero(data.plane[:-1] == kicked)
    if kicked != plane and not state.allows("corrector_roll"):
        return []  # what its own roll makes of it is not known yet
    pattern = at.seen(at.beam if kicked == plane else at.across)[..., plane]
    read, orbits = at.read[..., kicked], data.orbits[..., kicked]
    found = []
    for c in rows:
        near = np.isfinite(orbits[c]) & state.good  # what tells its kick
        size = float(read[c, near] @ read[c, near])
        kick = float(read[c, near] @ orbits[c, near]) / size if size else 1.0
        left = data.orbits[c, :, plane] - kick * at.read[c, :, plane]
        seen = np.flatnonzero(np.isfinite(left) & state.good)
        if len(seen) >= ENOUGH:
            orbit = data.orbits[c, seen, plane]
            found.append(_Column(int(c), seen, pattern[c, seen], orbit, left[seen]))
    return found


def _of_planes(state: State, kicked: int, plane: int) -> list[SpuriousKick]:
    columns = _columns(state, kicked, plane)
    if len(columns) < COLUMNS:
        return []
    data, model = state.data, state.at.model
    sizes = np.array([one.rms for one in columns])
    typical = max(float(np.median(sizes)), float(np.median(data.noise[:, plane])))
    orbits = orbits_of(state, np.array([one.column for one in columns]))
    explained = np.array([one.explained for one in columns])
    shares = sizes / np.maximum(orbits, explained)
    usual = float(np.median(shares))  # a larger step leaves more
    odd = [
        one
        for one, size, share in zip(columns, sizes, shares, strict=True)
        if size > TIMES * typical and share > TIMES * usual
    ]
    if not odd:
        return []
    exits, rows = model.maps.at[data.at], model.reading_slopes[data.at, plane]
    layers = np.arange(len(model.maps.layers))
    kicks = orbits_of_kicks(model, layers, exits, rows, plane).T
    kicks = kicks * state.at.errors.monitors[:, plane, plane]
    found = []
    for one in odd:
        kick = _elsewhere(state, one, plane, kicks)
        if kick is not None:
            found.append(kick)
    return found


def _elsewhere(state: State, one: _Column, plane: int, kicks: Array) -> SpuriousKick | None:
    """The kick that explains a column, if one does; see the module.

    Args:
        state: that it is left by.
        one: the column.
        plane: that is read.
        kicks: readings by a kick behind each layer, m/rad, [layer, monitor].
    """
    far = np.arange(len(one.seen)) % 2 == 1
    near, patterns = ~far, kicks[:, one.seen]
    every = np.ones(len(far), dtype=bool)
    own = one.own / max(float(np.abs(one.own).max()), 1e-300)
    size = max(float(own[near] @ own[near]), 1e-300)
    across = patterns[:, near] - np.outer(patterns[:, near] @ own[near], own[near]) / size
    rest = amplitudes(own[:, None], one.left, near, near)[1]
    squares = np.maximum((across**2).sum(axis=1), 1e-300)
    layer = int(np.argmax((across @ rest) ** 2 / squares))
    amount = float(across[layer] @ rest / squares[layer])

    def missed(*more: Array, among: Flags = every) -> float:
        patterns = np.column_stack([own, *more])
        left = amplitudes(patterns, one.left, near & among, far & among)[1]
        return float(np.mean(left**2))

    jump = state.at.jumps[one.column, one.seen, plane]
    kicked = state.data.plane[one.column] == plane
    without, here = missed(), missed(jump, among=_beside(state, one, jump) if kicked else every)
    beside_it = missed(patterns[layer])
    if beside_it > SHARE * without or beside_it > HERE * here:
        return None
    return SpuriousKick(one.column, plane, layer, amount)


def _beside(state: State, one: _Column, jump: Array) -> Flags:
    """Readings that a corrector may be asked for if it stands elsewhere, [reading]."""
    monitors = state.data.shape[1]
    seen = np.zeros(monitors, dtype=bool)
    seen[one.seen] = True
    patterns, left = np.zeros((monitors, 2)), np.zeros(monitors)
    patterns[one.seen], left[one.seen] = np.column_stack([one.own, jump]), one.left
    return clear(state, one.column, patterns, left, seen, kick=1.0)[one.seen]
