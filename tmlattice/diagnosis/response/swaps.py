"""Swapped correctors: each responds as the other one should. Swapped BPMs, or planes of a BPM.

Two cables, or two rows of a table of names, may be swapped. The orbit of a swapped corrector still
resembles the model's, so it is not rejected, but looks misplaced by the distance to the other one.
"""

from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import combinations, product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tmlattice.diagnosis.response.state import State
from tmlattice.diagnosis.response.unlike_model import RejectedChannels
from tmlattice.measurement import OrbitResponse

Array = NDArray[np.float64]

SHARE = 0.25
"""Largest ratio of the mean square residuals, of each of two columns, after and before the swap."""

Pair = tuple[str, str]


class Swaps(NamedTuple):
    """Swaps: BPMs with swapped planes; pairs of correctors and of BPMs, with the fall of chi-square
    at the typical noise. And rejected channels: a BPM with its plane, or a corrector with None."""

    planes: list[str]
    correctors: dict[Pair, float]
    monitors: dict[Pair, float]
    rejected: list[tuple[str, str | None]]


def labels_corrected(
    state: State,
    measured: OrbitResponse,
    known: Swaps,
    odd: RejectedChannels,
    among: Collection[str],
) -> tuple[OrbitResponse, str] | None:
    """Return the measurement with new swaps corrected, and a message about them; None without any.

    Args:
        state: with the model's readings.
        measured: the measurement.
        known: pairs that were corrected before; new ones are added.
        odd: rejected channels.
        among: correctors that may be swapped with any other.
    """
    pairs = _new(swaps(state, {*odd.correctors, *among}), known.correctors)
    if pairs:
        return correctors_back(measured, pairs), swap_message(pairs)
    pairs = _new(swapped_monitors(state, {name for name, _ in odd.monitors}), known.monitors)
    return (monitors_back(measured, pairs), swap_message(pairs, "monitors")) if pairs else None


def _new(found: dict[Pair, float], known: dict[Pair, float]) -> list[Pair]:
    """New pairs, added to the known ones."""
    new = [pair for pair in found if pair not in known]
    known.update((pair, found[pair]) for pair in new)
    return new


def swaps(state: State, among: Collection[str] = ()) -> dict[Pair, float]:
    """Return swapped pairs with their fall of chi-square: neighbours of a plane, in beam order,
    then any two of `among`, and any two of different planes. Each corrector is in one pair at most.

    Args:
        state: with the model's readings.
        among: names of those that may be swapped anywhere in the ring.
    """
    data = state.data
    model, names = state.at.seen(state.at.beam), data.measured.correctors

    def left(column: int, as_one: int, planes: list[int]) -> float:
        own = data.orbits[column][:, planes]
        seen = np.isfinite(own) & state.good[:, None]
        u, d = model[as_one][:, planes][seen], own[seen]
        gain = max(float(u @ d) / max(float(u @ u), 1e-300), 0.0)
        return float(np.sum((d - gain * u) ** 2))

    found: dict[Pair, float] = {}
    for planes, pairs in _suspects(state, among):
        noise = float(np.median(data.noise[:, planes]))
        for a, b in pairs:
            if any(names[c] in pair for pair in found for c in (a, b)):
                continue
            stays = left(a, a, planes), left(b, b, planes)
            crossed = left(a, b, planes), left(b, a, planes)
            if all(one < SHARE * other for one, other in zip(crossed, stays, strict=True)):
                found[names[a], names[b]] = (sum(stays) - sum(crossed)) / noise**2
    return found


def _suspects(
    state: State, among: Collection[str]
) -> Iterator[tuple[list[int], Iterable[tuple[int, int]]]]:
    """Pairs of columns that may be swapped, and the planes to compare."""
    data, names = state.data, state.data.measured.correctors
    for p in (0, 1):
        mine = np.flatnonzero(data.plane[:-1] == p)
        order = mine[np.argsort([data.ring[names[c]].s for c in mine])]
        far = combinations([c for c in order if names[c] in among], 2)
        yield [p], (*zip(order, np.roll(order, -1), strict=True), *far)
    own, across = (
        np.nansum(data.pick(data.orbits, block)[:-1, state.good] ** 2, axis=1) for block in (0, 1)
    )
    turned = np.flatnonzero(across > own)
    yield [0, 1], product(*(turned[data.plane[turned] == p] for p in (0, 1)))


def swap_message(pairs: Iterable[Pair], what: str = "correctors") -> str:
    """The message about swapped pairs."""
    both = ", ".join(f"{a} and {b}" for a, b in pairs)
    return (
        f"{what} that respond each as the other one should, taken as swapped: {both}; look at "
        "their cables and at the table of names"
    )


def correctors_back(measured: OrbitResponse, pairs: Iterable[Pair]) -> OrbitResponse:
    """The measurement with their columns swapped."""
    order = np.arange(len(measured.correctors))
    for pair in pairs:
        a, b = (measured.correctors.index(name) for name in pair)
        order[[a, b]] = b, a
    return replace(
        measured, response=measured.response[order], kicks=np.asarray(measured.kicks)[order]
    )


def swapped_monitors(state: State, among: Collection[str]) -> dict[Pair, float]:
    """Return swapped pairs of some BPMs, anywhere in the ring, in both planes, whatever their
    gains, with the fall of chi-square; each BPM is in one pair at most.

    Args:
        state: with the model's readings.
        among: rejected channels; if the phase advance is wrong, others look shifted by one cell.
    """
    data, read = state.data, state.at.seen(state.at.beam)
    model, orbits = data.pick(read)[:-1], data.pick(data.orbits)[:-1]
    left = np.zeros((data.shape[1],) * 2)  # of a's readings as b's, [a, b]
    for p in (0, 1):
        rows = data.plane[:-1] == p
        there = np.isfinite(orbits[rows])
        d, u = np.where(there, orbits[rows], 0.0), model[rows]
        both, size = np.maximum(d.T @ u, 0.0), there.T.astype(float) @ u**2
        left += (d**2).sum(axis=0)[:, None] - both**2 / np.maximum(size, 1e-300)
    names = data.measured.monitors
    odd = [m for m, name in enumerate(names) if name in among]
    stays = np.diagonal(left)
    found: dict[Pair, float] = {}
    for a, b in combinations(odd, 2):
        crossed = left[a, b] < SHARE * stays[a] and left[b, a] < SHARE * stays[b]
        if crossed and not any(names[own] in pair for own in (a, b) for pair in found):
            gain = stays[a] + stays[b] - left[a, b] - left[b, a]
            found[names[a], names[b]] = float(gain / np.median(data.noise) ** 2)
    return found


def monitors_back(measured: OrbitResponse, pairs: Iterable[Pair]) -> OrbitResponse:
    """The measurement with the readings of BPMs swapped, their noise and the RF's too."""
    order = np.arange(len(measured.monitors))
    for pair in pairs:
        a, b = (measured.monitors.index(name) for name in pair)
        order[[a, b]] = b, a
    rf = measured.rf
    if rf is not None and rf.orbit is not None:
        rf = replace(rf, orbit=rf.orbit[order])
    noise = None if measured.noise is None else measured.noise[order]
    return replace(measured, response=measured.response[:, order], noise=noise, rf=rf)


def swapped_planes(state: State) -> list[str]:
    """Return the BPMs whose readings, whatever their gain, match the other plane of the model."""
    data, read = state.data, state.at.seen(state.at.beam)
    found = []
    for m, name in enumerate(data.measured.monitors):
        seen = np.isfinite(data.orbits[:-1, m]).all(axis=1)
        d, u = data.orbits[:-1, m][seen], read[:-1, m][seen]
        if len(d) and _left(d, u[:, ::-1]) < SHARE * _left(d, u):
            found.append(name)
    return found


def _left(measured: Array, model: Array) -> float:
    """The chi-square of readings [column, 2], with a non-negative gain of each plane."""
    gain = np.maximum((measured * model).sum(axis=0), 0.0)
    gain = gain / np.maximum((model**2).sum(axis=0), 1e-300)
    return float(np.sum((measured - gain * model) ** 2))


def planes_back(measured: OrbitResponse, monitors: Sequence[str]) -> OrbitResponse:
    """The measurement with the planes of some BPMs swapped."""
    at = [measured.monitors.index(name) for name in monitors]
    response, rf = measured.response.copy(), measured.rf
    response[:, at] = response[:, at, ::-1]
    if rf is not None and rf.orbit is not None:
        orbit = rf.orbit.copy()
        orbit[at] = orbit[at, ::-1]
        rf = replace(rf, orbit=orbit)
    return replace(measured, response=response, rf=rf)
