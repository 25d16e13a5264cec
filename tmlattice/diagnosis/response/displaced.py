"""Single correctors that answer as if they stood elsewhere than in the lattice.

A kick at a place d further along is, seen from where the lattice has it, the same kick and a
position jump of -d times the kick. All correctors have some of that (their fields are no points);
one that is far beyond the others, and agrees once it is moved, has a wrong place, or name.

>>> displaced(state)
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tmlattice.diagnosis.response.state import State, amplitudes

Array = NDArray[np.float64]

FAR = 5.0
"""So many times the usual of a plane's correctors one is left with, and displaced by."""
AGREES = 0.3
"""Share of what it was left with, at most, that is left once it is moved."""
SPARED = 0.1
"""Share of the readings, those that are missed most, that do not count."""
LEAST = 0.05
"""m: what is nearer is in any field's shape."""
FEWEST = 8
"""Readings, and correctors of a plane, that it takes."""
_MAD = 1.4826  # of a Gaussian


class _Column(NamedTuple):
    column: int
    left: float
    moved: float
    by: float


def displaced(state: State) -> list[str]:
    """A sentence of those that are, where there are any.

    Args:
        state: a fit's; held-out correctors are looked at too.
    """
    data, at = state.data, state.at
    beam, jumps = (data.pick(at.seen(own)) for own in (at.beam, at.jumps))
    orbits = data.pick(data.orbits)
    told = []
    for plane in (0, 1):
        found = []
        for c in np.flatnonzero(data.plane[:-1] == plane):
            seen = np.isfinite(orbits[c]) & state.good
            if seen.sum() < FEWEST or not jumps[c, seen].any():
                continue
            both = np.stack([beam[c], jumps[c]], axis=1)
            _, moved = amplitudes(both, orbits[c], seen, seen)
            # a monitor between the two places has the kick on its other side
            seen[seen] = np.abs(moved) <= np.quantile(np.abs(moved), 1 - SPARED)
            (kick, jump), moved = amplitudes(both, orbits[c], seen, seen)
            _, left = amplitudes(beam[c][:, None], orbits[c], seen, seen)
            size, less = (float(np.sqrt(np.mean(own**2))) for own in (left, moved))
            by = -jump / (kick * data.kicks[c]) if kick else 0.0
            found.append(_Column(int(c), size, less, float(by)))
        if len(found) < FEWEST:
            continue
        usual = float(np.median([own.left for own in found]))
        away = max(_MAD * float(np.median([abs(own.by) for own in found])), LEAST / FAR)
        told += [
            f"{data.measured.correctors[own.column]} {abs(own.by):.2g} m "
            f"{'down' if own.by > 0 else 'up'}stream ({1e6 * own.left:.2g} µm are left where it "
            f"stands, {1e6 * own.moved:.2g} there)"
            for own in found
            if own.left > FAR * usual and own.moved < AGREES * own.left and abs(own.by) > FAR * away
        ]
    if not told:
        return []
    return [
        "correctors that answer as if they stood elsewhere than in the lattice: "
        f"{'; '.join(told)}; check their places, which magnet each name is, and that no other one "
        "is driven with them"
    ]
