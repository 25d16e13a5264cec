"""Beam jitter: closed orbits that are in each step, with a random amplitude.

The two orbits of a step are read seconds or minutes apart. If a noisy supply, a pulsed element or
ground motion kicks the beam in between, all BPMs read the same additional closed orbit, in each
step with another amplitude. A drift of the energy does the same with the orbit of the RF step. So
jitter is a covariance of each column's readings, whose amplitudes are integrated out
(`inference.normal.common`), and not noise of single BPMs.

Jitter is sought in the plane that is not kicked, where errors of the ring have little effect, given
the roll of each corrector. Sources are added one by one by their evidence. Their positions are
known up to the phase of the betatron oscillation.

>>> found = sought(state)
>>> state = settle(replace(state, jitter=found.orbits))
"""

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from tmlattice.arrays import TINY, Array, Flags
from tmlattice.beam.kicks import orbits_of_kicks
from tmlattice.diagnosis.response.state import State
from tmlattice.diagnosis.response.weights import LEAST as NOISE_LEFT
from tmlattice.diagnosis.response.weights import independent, weight
from tmlattice.inference.judgement import DEFAULT, ENOUGH
from tmlattice.inference.newton import AGAIN
from tmlattice.inference.normal import amounts, common, times_precision

log = logging.getLogger(__name__)

MOST = 3
"""Most sources of a plane: two span all betatron phases, a third is for deviations from that."""
ENERGY = "energy"
"""Name of the source that changes the beam's energy."""
SIZES = np.geomspace(0.01, 3.0, 30)
"""Prior rms of the amplitudes that are tried, in units of the typical column's rms residual."""
FREE = 30.0
"""Prior rms of a corrector's roll, in units of the roll that makes the typical residual: flat."""
ROUNDS = 30
"""Iterations of EM for the prior rms of all sources together."""


@dataclass(frozen=True)
class Jitter:
    """Detected beam jitter.

    Attributes:
        orbits: of typical amplitude, m, [plane that is read, pattern, monitor], padded with zeros.
        places: magnets behind which a kick makes these orbits, or `ENERGY`, of each plane.
    """

    orbits: Array
    places: tuple[tuple[str, ...], tuple[str, ...]]

    @property
    def sentence(self) -> str:
        """The message about it."""
        sizes = " and ".join(
            f"{1e6 * np.sqrt(np.mean((own**2).sum(axis=0))):.2g} µm rms in {plane} "
            f"(as by {_sources(places)})"
            for own, places, plane in zip(self.orbits, self.places, "xy", strict=True)
            if places
        )
        return (
            f"beam jitter between the readings of a step, common to all BPMs: {sizes}; its "
            "amplitude in each step is integrated out (a kick is known up to the phase of the "
            "betatron oscillation)"
        )


def _sources(places: Sequence[str]) -> str:
    kicks = [place for place in places if place != ENERGY]
    energy = ["changes of the beam's energy"] * (ENERGY in places)
    return " and ".join([*energy, *([f"kicks behind {', '.join(kicks)}"] * bool(kicks))])


def sought(state: State) -> Jitter | None:
    """Return the detected jitter; None if there is none.

    Args:
        state: with gains, rolls and gradients; jitter in the state is ignored.
    """
    still = replace(state, jitter=None)
    orbits = np.zeros((2, MOST, len(state.data.at)))
    places: list[tuple[str, ...]] = [(), ()]
    for plane in (0, 1):
        found, places[plane] = _in_plane(still, plane)
        orbits[plane, : len(found)] = found
    most = max(len(own) for own in places)
    return Jitter(orbits[:, :most], (places[0], places[1])) if most else None


def _in_plane(state: State, plane: int) -> tuple[Array, tuple[str, ...]]:
    """The orbits of one plane, [pattern, monitor], and their sources."""
    data, at, model = state.data, state.at, state.at.model
    none = np.zeros((0, len(data.at)))
    weights = weight(state, 1)
    read = (data.plane_of(1) == plane) & ((weights > 0).sum(axis=1) >= ENOUGH)
    read[-1] = False
    if not read.any() or not state.allows("corrector_roll"):
        return none, ()
    weights, left = weights[read], np.where(weights > 0, data.pick(at.left, 1), 0.0)[read]
    rolls = data.pick(at.seen(at.across), 1)[read]
    rolls *= FREE * _rms(left) / np.maximum(_rms(rolls), TINY)
    without = rest = _rest(weights, left, _patterns(rolls, none))
    exits, rows = model.maps.at[data.at], model.reading_slopes[data.at, plane]
    layers = np.arange(len(model.maps.layers))
    kicked = orbits_of_kicks(model, layers, exits, rows, plane).T
    kicked *= at.errors.monitors[:, plane, plane]
    rf = at.read[-1:, :, plane] * (plane == 0)  # in y the BPMs' rolls read it
    orbits = np.concatenate([kicked, rf])
    orbits *= np.median(_rms(without)) / np.maximum(_rms(orbits), TINY)
    least = (NOISE_LEFT * data.noise_of(1)[read]) ** 2
    count = 1.0  # jitter itself would reduce the effective sample size
    for _ in range(AGAIN):
        weights = count * _weights(weights > 0, rest, least)
        found, which = _places(weights, left, rolls, orbits)
        rest = _rest(weights, left, _patterns(rolls, found))
        count = independent(np.where(weights > 0, rest, np.nan), np.sqrt(least))
    names = [*model.maps.layers, ENERGY]
    sources = tuple(names[i] for i in which)
    log.info("plane %d: jitter from %s, residual %.3g of %.3g m", plane, sources,
             np.median(_rms(rest)), np.median(_rms(without)))  # fmt: skip
    return found, sources


def _weights(seen: Flags, rest: Array, least: Array) -> Array:
    """Inverse variances by the mean square residual of each column, at least that of the typical
    column, [column, monitor]."""
    squares = np.sum(rest**2, axis=1, keepdims=True) / seen.sum(axis=1, keepdims=True)
    return np.where(seen, 1 / (np.maximum(squares, np.median(squares)) + least), 0.0)


def _places(weights: Array, left: Array, rolls: Array, orbits: Array) -> tuple[Array, list[int]]:
    """Orbits of typical amplitude that the columns share, given their rolls; and their indices."""
    found, which = orbits[:0], list[int]()
    while len(which) < MOST:
        gained, sizes = _gains(weights, left, _patterns(rolls, found), orbits)
        best = int(np.argmax(gained))
        if gained[best] < DEFAULT.log_odds + np.log(len(orbits)):
            break
        found = np.concatenate([found, sizes[best] * orbits[[best]]])
        found = _sized(weights, left, rolls, found)
        which.append(best)
    return found, which


def _rest(weights: Array, left: Array, patterns: Array) -> Array:
    """The residual given the most probable amplitudes of the patterns, [column, monitor]."""
    likely = amounts(weights, patterns, left)[0]
    return np.where(weights > 0, left - np.einsum("ck,ckm->cm", likely, patterns), 0.0)


def _rms(values: Array) -> Array:
    """The rms of each row, [row, 1]."""
    return np.asarray(np.sqrt(np.mean(values**2, axis=1, keepdims=True)))


def _patterns(rolls: Array, orbits: Array) -> Array:
    """A column's own roll, and the shared orbits, [column, pattern, monitor]."""
    shared = np.broadcast_to(orbits, (len(rolls), *orbits.shape))
    return np.concatenate([rolls[:, None], shared], axis=1)


def _gains(weights: Array, left: Array, patterns: Array, orbits: Array) -> tuple[Array, Array]:
    """Log evidence of each further orbit, given present patterns, at its most probable prior rms;
    and that rms, [orbit].

    A column with score n and information d of an orbit's amplitude contributes s^2 n^2 / 2 (1 + s^2
    d) - log(1 + s^2 d) / 2 at the prior rms s.
    """
    taken = common(weights, patterns)[0]
    score = orbits @ times_precision(weights, taken, left).T
    known = orbits**2 @ weights.T
    for k in range(taken.shape[2]):
        known -= (orbits @ taken[..., k].T) ** 2
    gained, size = np.full(len(orbits), -np.inf), np.zeros(len(orbits))
    for s in SIZES:
        spread = 1 + s**2 * known
        now = 0.5 * (s**2 * score**2 / spread - np.log(spread)).sum(axis=1)
        size = np.where(now > gained, s, size)
        gained = np.maximum(gained, now)
    return gained, size


def _sized(weights: Array, left: Array, rolls: Array, orbits: Array) -> Array:
    """The orbits combined and scaled to independent amplitudes of rms 1, by EM over all columns."""
    for _ in range(ROUNDS):
        likely, covariance = amounts(weights, _patterns(rolls, orbits), left)
        squares = np.mean(likely[:, :, None] * likely[:, None] + covariance, axis=0)[1:, 1:]
        orbits = np.linalg.cholesky(squares).T @ orbits
    return orbits
