"""Steps of a corrector that include a spurious kick at another place.

The two orbits of a step are read seconds apart. A supply that jumps in between, a feedback or a
pulsed element adds a closed orbit unrelated to the corrector. The residual of such a step is many
times the usual one. A single kick is located by half of the BPMs, and must explain the residual at
the other half. Such a step has no information on the ring, and would distort validation scores.
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
"""Least ratio of a step's residual, given its own kick, to the typical one of the same planes."""
ALSO = 2.0
"""The same ratio for the corrector's own plane, given a spurious kick in the other one."""
SHARE = 0.15
"""Largest ratio of mean square residuals at the other BPMs, with and without the kick."""
HERE = 0.5
"""Largest ratio of that residual to the one with a jump at the corrector's place instead: above it,
the corrector is misplaced."""
ENOUGH, COLUMNS = 12, 5
"""Fewest readings of a column, and columns of a plane, for a detection."""


@dataclass(frozen=True)
class SpuriousKick:
    """A spurious kick during the step of a corrector.

    Attributes:
        column: of the corrector.
        plane: 0 for x, 1 for y.
        layer: the magnet behind which a kick explains most; any at its betatron phase is as likely.
        amount: rad.
    """

    column: int
    plane: int
    layer: int
    amount: float


def spurious_kicks(state: State) -> list[SpuriousKick]:
    """Return the detected kicks, by a state with gains, rolls and gradients."""
    found = []
    for kicked in (0, 1):
        for plane in (0, 1):
            found += _of_planes(state, kicked, plane)
    return found


def left_in_plane(state: State, suspects: Sequence[int]) -> list[int]:
    """Return those suspects whose residual in their own plane is also unusually large.

    Args:
        state: as in `spurious_kicks`.
        suspects: columns with a spurious kick in the other plane.
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
    """Readings and residuals of a column in one plane, m, and its own pattern, [reading]."""

    column: int
    seen: Indices
    own: Array
    orbit: Array
    left: Array

    @property
    def rms(self) -> float:
        """The rms residual given its own amplitude, m."""
        every = np.ones(len(self.left), dtype=bool)
        return rms_of([amplitudes(self.own[:, None], self.left, every, every)[1]])

    @property
    def explained(self) -> float:
        """The rms orbit by its own kick, m; for a rolled corrector mostly in the other plane."""
        return float(np.sqrt(np.maximum(np.mean(self.orbit**2) - self.rms**2, 0.0)))


def _columns(state: State, kicked: int, plane: int) -> list[_Column]:
    data, at = state.data, state.at
    rows = np.flatnonzero(data.plane[:-1] == kicked)
    if kicked != plane and not state.allows("corrector_roll"):
        return []  # the corrector's own roll is unknown
    pattern = at.seen(at.beam if kicked == plane else at.across)[..., plane]
    read, orbits = at.read[..., kicked], data.orbits[..., kicked]
    found = []
    for c in rows:
        near = np.isfinite(orbits[c]) & state.good  # determine its kick
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
    usual = float(np.median(shares))  # a larger step has a larger residual
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
    """The kick that explains the residual of a column; None if there is none.

    Args:
        state: of the fit.
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
    with_kick = missed(patterns[layer])
    if with_kick > SHARE * without or with_kick > HERE * here:
        return None
    return SpuriousKick(one.column, plane, layer, amount)


def _beside(state: State, one: _Column, jump: Array) -> Flags:
    """Readings that remain for a misplaced corrector, see `misplaced.clear`, [reading]."""
    monitors = state.data.shape[1]
    seen = np.zeros(monitors, dtype=bool)
    seen[one.seen] = True
    patterns, left = np.zeros((monitors, 2)), np.zeros(monitors)
    patterns[one.seen], left[one.seen] = np.column_stack([one.own, jump]), one.left
    return clear(state, one.column, patterns, left, seen, kick=1.0)[one.seen]
