"""Inconsistent steps: readings of a corrector's step that are no single closed orbit.

Given two of three neighbouring BPMs, the reading of the third follows, wherever else the beam is
kicked: n1 x1 + n2 x2 + n3 x3 = 0, with n normal to their sensitivities to the two coordinates of a
launch. A misplaced corrector, or a second kick, violates that at one triple. If half of a column's
triples violate it by many times the usual, the BPMs did not read one orbit: some may have averaged
over the time before the step. Such a step has no information on any error. It is detected with the
gains of a fit, rejected, and reported.
"""

import numpy as np
from numpy.typing import NDArray

from tmlattice.diagnosis.response.state import State

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

INCONSISTENT = 5.0
"""Least ratio to the violation of the typical column's typical triple."""
NOISE = 2.0
"""Least ratio to the readings' noise."""
ENOUGH, COLUMNS = 8, 5
"""Least numbers of triples of a column, and of columns of a plane."""
MOST = 0.25
"""Largest share of inconsistent columns of a plane: more of them are model discrepancy."""
BLIND = 0.2
"""Gain below which a BPM does not read the beam."""
_MAD = 1.4826  # of a Gaussian


def inconsistent(state: State) -> Flags:
    """Return the columns whose readings are no single orbit, [column]; `state` has gains."""
    data = state.data
    out = np.zeros(len(data.plane), dtype=bool)
    for plane in (0, 1):
        rows = np.flatnonzero(data.plane[:-1] == plane)
        broken = np.array([_broken(state, int(c), plane) for c in rows])
        stray = np.isfinite(broken)
        if stray.sum() < COLUMNS:
            continue
        noise = float(np.median(data.noise[:, plane]))
        limit = max(INCONSISTENT * float(np.median(broken[stray])), NOISE * noise)
        share = broken / orbits_of(state, rows)  # a larger step violates more
        bad = stray & (np.where(stray, broken, 0.0) > limit)
        bad &= np.where(stray, share, 0.0) > INCONSISTENT * float(np.median(share[stray]))
        if bad.sum() <= MOST * stray.sum():
            out[rows[bad]] = True
    return out


def orbits_of(state: State, columns: NDArray[np.int64]) -> Array:
    """Return the rms of measured columns in their own plane, m, at least the noise, [column]."""
    read = state.data.pick(state.data.orbits)[columns][:, state.good]
    noise = float(np.median(state.data.noise))
    there = np.isfinite(read)
    squares = np.where(there, read, 0.0) ** 2
    return np.asarray(np.sqrt(squares.sum(axis=1) / np.maximum(there.sum(axis=1), 1) + noise**2))


def _broken(state: State, column: int, plane: int) -> float:
    """The violation of a column's typical triple, per reading, m; NaN with too few readings."""
    data, at = state.data, state.at
    gain = at.errors.monitors[:, plane, plane]
    read, orbit = at.read[column, :, plane], data.orbits[column, :, plane]
    seen = np.flatnonzero(np.isfinite(orbit) & state.good & (np.abs(gain) > BLIND))
    if len(seen) < ENOUGH + 2:
        return float("nan")
    read, orbit = read[seen], orbit[seen]
    left = (orbit - read * (read @ orbit) / max(float(read @ read), 1e-300)) / gain[seen]
    own = at.model.reading_slopes[data.at[seen], plane, 2 * plane : 2 * plane + 2].T
    first, second, third = (own[:, i : own.shape[1] - 2 + i] for i in range(3))
    normal = np.stack([_cross(second, third), _cross(third, first), _cross(first, second)])
    triples = np.stack([left[:-2], left[1:-1], left[2:]])
    size = np.sqrt((normal**2).sum(axis=0))
    there = size > 0
    return float(_MAD * np.median(np.abs((normal * triples).sum(axis=0)[there] / size[there])))


def _cross(a: Array, b: Array) -> Array:
    return np.asarray(a[0] * b[1] - a[1] * b[0])
