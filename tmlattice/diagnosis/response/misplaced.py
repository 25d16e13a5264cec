"""Single correctors that respond as if they were at another place than in the lattice.

Seen from its place in the lattice, a kick at a distance d downstream is the same kick and a
position jump of -d times the kick. All correctors have a small jump, because their fields have a
length. An outlier whose residual vanishes at another place has a wrong place, or a wrong name.

>>> found = misplaced(state)
>>> [(own.name, own.by) for own in found]
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tmlattice.diagnosis.response.state import State, amplitudes

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

FAR = 5.0
"""Least ratio of the residual, and of the displacement, to the usual ones of the plane."""
AGREES = 0.3
"""Largest ratio of the residuals at the new place and at the lattice's."""
SPARED = 0.1
"""Largest share of readings that are omitted because they are between the two places."""
MARGIN = 1.5
"""Margin beyond the estimated place, as a share of the distance, that counts as between."""
SAME = 1e-6
"""Distance, m, below which elements have one place."""
LEAST = 0.05
"""Displacement, m, that the shape of any field explains."""
FEWEST = 8
"""Fewest readings, and correctors of a plane."""
_MAD = 1.4826  # of a Gaussian


class Misplaced(NamedTuple):
    """A misplaced corrector.

    Attributes:
        name, column: of the corrector, and of the response.
        left, moved: rms residual at its place in the lattice, and at the other place, m.
        by: distance of the other place downstream, m.
        gain: fall of chi-square.
    """

    name: str
    column: int
    left: float
    moved: float
    by: float
    gain: float


def misplaced(state: State) -> list[Misplaced]:
    """Return the misplaced correctors by the state of a fit, held-out ones included."""
    data, at = state.data, state.at
    beam, jumps = (data.pick(at.seen(own)) for own in (at.beam, at.jumps))
    orbits = data.pick(data.orbits)
    far: list[Misplaced] = []
    for plane in (0, 1):
        found: list[Misplaced] = []
        for c in np.flatnonzero(data.plane[:-1] == plane):
            seen = np.isfinite(orbits[c]) & state.good
            if seen.sum() < FEWEST or not jumps[c, seen].any():
                continue
            both = np.stack([beam[c], jumps[c]], axis=1)
            seen = clear(state, int(c), both, orbits[c], seen)
            (kick, jump), moved = amplitudes(both, orbits[c], seen, seen)
            _, left = amplitudes(beam[c][:, None], orbits[c], seen, seen)
            size, less = (float(np.sqrt(np.mean(own**2))) for own in (left, moved))
            by = -jump / (kick * data.kicks[c]) if kick else 0.0
            noise = data.noise_of(0)[c, seen]
            gain = float(np.sum((left**2 - moved**2) / noise**2))
            name = data.measured.correctors[c]
            found.append(Misplaced(name, int(c), size, less, float(by), gain))
        if len(found) < FEWEST:
            continue
        usual = float(np.median([own.left for own in found]))
        away = max(_MAD * float(np.median([abs(own.by) for own in found])), LEAST / FAR)
        far += [
            own
            for own in found
            if own.left > FAR * usual and own.moved < AGREES * own.left and abs(own.by) > FAR * away
        ]
    return far


def clear(
    state: State, column: int, patterns: Array, orbit: Array, seen: Flags, kick: float = 0.0
) -> Flags:
    """Return the readings except those of BPMs between the corrector's place and its estimated
    place, on the other side of the kick. Elsewhere a kick at any place is a kick here and a jump.

    Args:
        state: of the fit.
        column: of the corrector.
        patterns: of kick and jump, [monitor, 2].
        orbit: to be explained, [monitor].
        seen: valid readings, [monitor].
        kick: that `orbit` no longer includes, in units of its pattern.
    """
    data = state.data
    missed = np.abs(amplitudes(patterns, orbit, seen, seen)[1])
    most = seen.copy()
    most[seen] = missed <= np.quantile(missed, 1 - SPARED)
    (more, jump), _ = amplitudes(patterns, orbit, most, most)
    if not kick + more:
        return seen
    by = -jump / ((kick + more) * data.kicks[column])
    place = data.ring[data.measured.correctors[column]].s
    way = np.array([data.ring[name].s for name in data.measured.monitors]) - place
    beyond = (np.sign(by) * way + SAME) % data.ring.length - SAME
    between = beyond <= MARGIN * abs(by)
    few = (between & seen).sum() <= max(SPARED * seen.sum(), 1)
    return seen & ~between if few else seen


def moved_text(own: Misplaced) -> str:
    """Return the displacement, and the residuals with and without it, as a text."""
    return (
        f"{abs(own.by):.2g} m {'down' if own.by > 0 else 'up'}stream ({1e6 * own.left:.2g} µm rms "
        f"residual in the lattice's place, {1e6 * own.moved:.2g} there)"
    )
