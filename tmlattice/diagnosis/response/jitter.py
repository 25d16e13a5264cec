"""A jitter of the beam: closed orbits that every step has in it, each as much as chance has it.

The orbits of a step are read seconds or minutes apart, and something kicks the beam meanwhile: a
noisy supply, an injection element, the ground. All monitors read the same closed orbit then, in
each step another amount of it. That is no noise of a monitor's own: hundreds of readings tell one
amount. It is a covariance of each column's readings, whose amounts are integrated out
(`inference.common`).

It is sought where the ring's own errors hardly show, in the plane that is not kicked, beside the
roll of each corrector: place by place, the one first that explains most, as long as evidence wants
more. Which places these are is known up to the phase of the betatron oscillation.

>>> found = sought(state)
>>> state = settle(replace(state, jitter=found.orbits))
"""

import logging
from collections.abc import Collection
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tmlattice.beam.kicks import orbits_of_kicks
from tmlattice.diagnosis.response.independent import independent
from tmlattice.diagnosis.response.state import State
from tmlattice.diagnosis.response.weights import LEAST as NOISE_LEFT
from tmlattice.diagnosis.response.weights import weight
from tmlattice.inference.normal import amounts, common, times_precision

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

log = logging.getLogger(__name__)

MOST = 3
"""Places that kick, in a plane: two make every phase, a third is for what is not quite a wave."""
LEAST = 5.0
"""Log evidence of one, beyond that of as many places as there are."""
SHARE = 0.25
"""Of what a typical column has left beside its own roll, in the mean square, that a jitter is at
least: less is not worth a covariance."""
SIZES = np.geomspace(0.01, 3.0, 30)
"""That are tried, in units of what a typical column has left."""
PASSES = 3
"""Through all places: how well each is told depends on what the others leave."""
FREE = 30.0
"""Size of a corrector's own roll, in units of what its column has left: all but free."""
ROUNDS = 30
"""Of EM, for the sizes of all places together."""
ENOUGH, COLUMNS = 12, 8
"""Readings of a column, and columns, that it takes to say so."""


@dataclass(frozen=True)
class Jitter:
    """What was found.

    Attributes:
        orbits: as large as they typically are, m, [plane that is read, pattern, monitor]; a plane
            with fewer of them has zeros.
        places: magnets behind which a kick makes them, of each plane.
    """

    orbits: Array
    places: tuple[tuple[str, ...], tuple[str, ...]]

    @property
    def planes(self) -> tuple[int, ...]:
        """In which it was found."""
        return tuple(plane for plane, own in enumerate(self.places) if own)

    @property
    def sentence(self) -> str:
        """In words."""
        told = " and ".join(
            f"{1e6 * np.sqrt(np.mean((own**2).sum(axis=0))):.2g} µm rms in {plane} "
            f"(as from {', '.join(places)})"
            for own, places, plane in zip(self.orbits, self.places, "xy", strict=True)
            if places
        )
        return (
            "the beam moved between the readings of a step, all monitors together, by another "
            f"amount in each: {told}; which amount is taken for unknown (where it comes from is "
            "known up to the phase of the betatron oscillation)"
        )


def sought(state: State, planes: Collection[int] = (0, 1)) -> Jitter | None:
    """The jitter that stands out, if any does.

    Args:
        state: with gains, rolls and gradients; a jitter that it has is not looked at.
        planes: that are looked at.
    """
    still = replace(state, jitter=None)
    x, y = (_in_plane(still, plane) if plane in planes else _nothing(state) for plane in (0, 1))
    if not (x.places or y.places):
        return None
    orbits = np.zeros((2, max(len(x.places), len(y.places)), len(state.data.at)))
    for plane, own in enumerate((x, y)):
        orbits[plane, : len(own.places)] = own.orbits
    return Jitter(orbits, (x.places, y.places))


class _OfPlane(NamedTuple):
    """Orbits [pattern, monitor] of one plane, and where they come from."""

    orbits: Array
    places: tuple[str, ...]


def _nothing(state: State) -> _OfPlane:
    return _OfPlane(np.zeros((0, len(state.data.at))), ())


def _in_plane(state: State, plane: int) -> _OfPlane:
    """What is found in one plane."""
    data, at, model = state.data, state.at, state.at.model
    nothing = _nothing(state)
    weights = weight(state, 1)
    read = (data.plane_of(1) == plane) & ((weights > 0).sum(axis=1) >= ENOUGH)
    read[-1] = False
    if read.sum() < COLUMNS or not state.allows("corrector_roll"):
        return nothing
    weights, left = weights[read], np.where(weights > 0, data.pick(at.left, 1), 0.0)[read]
    rolls = data.pick(at.seen(at.across), 1)[read]
    rolls *= FREE * _rms(left) / np.maximum(_rms(rolls), 1e-300)
    without = rest = _rest(weights, left, _patterns(rolls, nothing.orbits))
    exits, rows = model.maps.at[data.at], model.reading_slopes[data.at, plane]
    layers = np.arange(len(model.maps.layers))
    orbits = orbits_of_kicks(model, layers, exits, rows, plane).T
    orbits *= at.errors.monitors[:, plane, plane]
    orbits *= np.median(_rms(without)) / np.maximum(_rms(orbits), 1e-300)
    least = (NOISE_LEFT * data.noise_of(1)[read]) ** 2
    count = 1.0  # what makes few readings independent is what is sought
    for _ in range(PASSES):
        weights = count * _weights(weights > 0, rest, least)
        found, which = _places(weights, left, rolls, orbits)
        rest = _rest(weights, left, _patterns(rolls, found))
        count = independent(np.where(weights > 0, rest, np.nan), np.sqrt(least))
    places = tuple(model.maps.layers[i] for i in which)
    before, after = np.median(_rms(without)), np.median(_rms(rest))
    if not before > 0:
        return nothing
    log.info("plane %d: %s leave %.3g of %.3g m", plane, places, after, before)
    share = 1 - float((after / before) ** 2)
    return nothing if share < SHARE else _OfPlane(found, places)


def _weights(seen: Flags, rest: Array, least: Array) -> Array:
    """1 / variance of what is left, of each column at least that of the typical one, [column,
    monitor]."""
    squares = np.sum(rest**2, axis=1, keepdims=True) / seen.sum(axis=1, keepdims=True)
    return np.where(seen, 1 / (np.maximum(squares, np.median(squares)) + least), 0.0)


def _places(weights: Array, left: Array, rolls: Array, orbits: Array) -> tuple[Array, list[int]]:
    """Orbits that columns have in common beside their rolls, as large as they typically are; and
    which these are."""
    found, which = orbits[:0], list[int]()
    while len(which) < MOST:
        gained, sizes = _gains(weights, left, _patterns(rolls, found), orbits)
        best = int(np.argmax(gained))
        if gained[best] < LEAST + np.log(len(orbits)):
            break
        found = np.concatenate([found, sizes[best] * orbits[[best]]])
        found = _sized(weights, left, rolls, found)
        which.append(best)
    return found, which


def _rest(weights: Array, left: Array, patterns: Array) -> Array:
    """What is left beside the likeliest amounts of patterns, [column, monitor]."""
    likely = amounts(weights, patterns, left)[0]
    return np.where(weights > 0, left - np.einsum("ck,ckm->cm", likely, patterns), 0.0)


def _rms(values: Array) -> Array:
    """Of each row, [row, 1]."""
    return np.asarray(np.sqrt(np.mean(values**2, axis=1, keepdims=True)))


def _patterns(rolls: Array, orbits: Array) -> Array:
    """Of each column its own roll, and the orbits that all have, [column, pattern, monitor]."""
    shared = np.broadcast_to(orbits, (len(rolls), *orbits.shape))
    return np.concatenate([rolls[:, None], shared], axis=1)


def _gains(weights: Array, left: Array, patterns: Array, orbits: Array) -> tuple[Array, Array]:
    """Log evidence of each orbit beside patterns that are there, at its likeliest size; and that
    size, [orbit].

    A column knows the amount of an orbit with information d, and its likeliest one is n / d: with
    a size s of all amounts the log evidence is the sum of s^2 n^2 / 2 (1 + s^2 d) - log(1 + s^2 d)
    / 2.
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
    """Orbits as large as all columns together make each likely, those whose amounts go together
    combined, by EM."""
    for _ in range(ROUNDS):
        likely, covariance = amounts(weights, _patterns(rolls, orbits), left)
        squares = np.mean(likely[:, :, None] * likely[:, None] + covariance, axis=0)[1:, 1:]
        orbits = np.linalg.cholesky(squares).T @ orbits
    return orbits
