"""Labels of a response: channels that are not those of the table of names, and their correction.

Two cables, or two rows of a table of names, may be swapped; a corrector may be elsewhere than in
the lattice; a channel may read noise, or another step than the one that was asked for. A label is
one such hypothesis about correctors or BPMs. The readings of each channel are compared with the
orbits of all others (`_as_others`): a swap must explain both.

>>> found = labels_of(state, {"v5", "v9"})
>>> measured = corrected(measured, found)
"""

from collections import defaultdict
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, product

import numpy as np

from tmlattice.arrays import TINY, Array, Flags
from tmlattice.diagnosis.findings import located
from tmlattice.diagnosis.places import between
from tmlattice.diagnosis.response.state import State, begin
from tmlattice.diagnosis.result import Finding
from tmlattice.inference import chi2
from tmlattice.inference.alternatives import Detection
from tmlattice.inference.judgement import DEFAULT, FEW, WRONG
from tmlattice.lattice import Ring
from tmlattice.measurement import OrbitResponse
from tmlattice.observe.response_data import ResponseData
from tmlattice.observe.split import split_columns

SHARE = 0.25
"""Largest ratio of the mean square residuals with and without a label."""
NEAR = 0.25
"""Share of the ring within which two elements are one range."""
UNEXPLAINED, RATIO = 0.5, 9.0
"""Least unexplained share of a rejected channel's mean square; its least ratio to the typical."""
SILENT = 0.3
"""Share of the model's response below which a channel is weak, not rejected."""

MESSAGES = {
    **{
        f"swapped {what}": f"{what} that respond each as the other one should, taken as swapped: "
        "{}; look at their cables and at the table of names"
        for what in ("correctors", "BPMs")
    },
    "rejected BPM": "BPM channels that the model cannot describe, rejected: {}",
    "rejected corrector": "correctors that the model cannot describe, rejected: {}",
    "inconsistent": "inconsistent steps, at which neighbouring BPMs contradict one another as if "
    "some had been read before the orbit settled, rejected: {}; measure these correctors again, "
    "and wait longer after each step",
    "misplaced": "steps of misplaced correctors, rejected: {}",
    "spurious kick": "spurious kicks during the steps of correctors (their positions are known up "
    "to half betatron oscillations): {}; these steps are rejected; look for a power supply that "
    "jumps, and measure these correctors again",
}
"""The kinds of labels, and the message about each; that of swapped planes is their finding."""


@dataclass(frozen=True)
class Label:
    """What is wrong with a channel, or with two.

    Attributes:
        kind: of `MESSAGES`, or "swapped planes" of a BPM.
        elements: names of the correctors or BPMs.
        columns: of the response, that the label concerns.
        words: further description.
        statistic: fall of chi-square by the label.
        plane: of a rejected BPM.
    """

    kind: str
    elements: tuple[str, ...]
    columns: tuple[int, ...] = ()
    words: str = ""
    statistic: float = 0.0
    plane: str | None = None

    def __str__(self) -> str:
        names = " and ".join(self.elements) + (f" in {self.plane}" if self.plane else "")
        return f"{names} ({self.words})" if self.words else names

    def finding(self, ring: Ring, other: str = "should") -> Finding | None:
        """The finding of swapped or misplaced elements, of no effect of the catalogue.

        Args:
            ring: the design.
            other: the verb of the text: each of a pair responds as the other one "should" by the
                model, or "did" in the reference.
        """
        seen = Detection.among(self.statistic, len(ring.elements))
        found = replace(located(ring, ring[self.elements[0]], seen), elements=self.elements)
        if self.kind == "misplaced":
            return replace(
                found,
                words=f"corrector {self.elements[0]} responds like one {self.words}",
                to_check="Check its position in the lattice, its cable, and that its supply drives "
                "no other magnet.",
            )
        if not self.kind.startswith("swapped") or len(self.elements) < 2:
            return None
        words = f"{self.kind.split()[1]} {self} respond each as the other one {other}"
        check = "Check the cables of both, and the table of their names."
        found = replace(found, words=words, to_check=check, s=None)
        places = [ring[name].s for name in self.elements]
        if max(places) - min(places) > NEAR * ring.length:
            return found
        where, near = between(ring, places)
        return replace(found, where=where, near=near)


def label_messages(labels: Iterable[Label]) -> list[str]:
    """Return the messages about labels, one of each kind."""
    kinds: dict[str, list[str]] = defaultdict(list)
    for label in labels:
        kinds[label.kind].append(str(label))
    return [
        words.format(", ".join(kinds[kind])) for kind, words in MESSAGES.items() if kind in kinds
    ]


# --- swaps ----------------------------------------------------------------------------------------
def swaps(state: State, rejected: Collection[Label]) -> list[Label]:
    """Return the swapped correctors of a state; if there are none, the swapped BPMs.

    Args:
        state: with the model's readings.
        rejected: channels; if the phase advance is wrong, other BPMs look shifted by one cell.
    """
    gone = {label.elements[0] for label in rejected}
    return swapped_correctors(state, gone) or swapped_monitors(state, gone)


def swapped_correctors(state: State, among: Collection[str]) -> list[Label]:
    """Return swapped correctors: neighbours of a plane, in beam order, any two of `among`, and any
    two of different planes whose orbits are larger in the other plane."""
    data, names = state.data, state.data.measured.correctors
    model = state.at.seen(state.at.beam)[:-1][:, state.good]
    read = data.orbits[:-1][:, state.good]
    pairs: list[tuple[int, int]] = []
    for p in (0, 1):
        mine = np.flatnonzero(data.plane[:-1] == p)
        order = mine[np.argsort([data.ring[names[c]].s for c in mine])]
        pairs += zip(order, np.roll(order, -1), strict=True)
        pairs += combinations([c for c in order if names[c] in among], 2)
    own, across = (np.nansum(data.pick(data.orbits, block)[:-1, state.good] ** 2, axis=1)
                   for block in (0, 1))  # fmt: skip
    turned = np.flatnonzero(across > own)
    pairs += product(*(turned[data.plane[turned] == p] for p in (0, 1)))
    left = _as_others(read.reshape(len(read), -1), model.reshape(len(read), -1))
    return _pairs("correctors", names, left, pairs, float(np.median(data.noise)))


def swapped_monitors(state: State, among: Collection[str]) -> list[Label]:
    """Return swapped pairs of some BPMs, in both planes, whatever their gains."""
    data, names = state.data, state.data.measured.monitors
    model, orbits = (data.pick(own)[:-1] for own in (state.at.seen(state.at.beam), data.orbits))
    left = sum(_as_others(orbits[rows].T, model[rows].T)
               for rows in (data.plane[:-1] == p for p in (0, 1)))  # fmt: skip
    pairs = combinations([m for m, name in enumerate(names) if name in among], 2)
    return _pairs("BPMs", names, np.asarray(left), pairs, float(np.median(data.noise)))


def swapped_planes(state: State) -> list[Label]:
    """Return the BPMs whose readings, whatever their gains, match the other plane of the model."""
    data, read = state.data, state.at.seen(state.at.beam)
    found = []
    for m, name in enumerate(data.measured.monitors):
        seen = np.isfinite(data.orbits[:-1, m]).all(axis=1)
        left = _as_others(data.orbits[:-1, m][seen].T, read[:-1, m][seen].T)
        if seen.any() and left[0, 1] + left[1, 0] < SHARE * np.trace(left):
            found.append(Label("swapped planes", (name,)))
    return found


def _as_others(read: Array, model: Array) -> Array:
    """Sums of squares of each channel's readings, given a multiple, not negative, of each channel
    of the model, [channel, channel of the model]; both [channel, reading]."""
    there = np.isfinite(read)
    d = np.where(there, read, 0.0)
    both, size = np.maximum(d @ model.T, 0.0), there.astype(float) @ model.T**2
    return np.asarray((d**2).sum(axis=1)[:, None] - both**2 / np.maximum(size, TINY))


def _pairs(
    what: str, names: Sequence[str], left: Array, pairs: Iterable[tuple[int, int]], noise: float
) -> list[Label]:
    """The pairs in which each channel is explained by the other; each is in one at most."""
    found: list[Label] = []
    for a, b in pairs:
        crossed = left[a, b] < SHARE * left[a, a] and left[b, a] < SHARE * left[b, b]
        pair = (names[a], names[b])
        if crossed and not any(set(pair) & set(label.elements) for label in found):
            gain = left[a, a] + left[b, b] - left[a, b] - left[b, a]
            columns = (int(a), int(b)) if what == "correctors" else ()
            found.append(Label(f"swapped {what}", pair, columns, statistic=float(gain / noise**2)))
    return found


def corrected(measured: OrbitResponse, labels: Iterable[Label]) -> OrbitResponse:
    """Return the measurement without the swaps, and without the rejected channels, of labels."""
    for label in labels:
        names = measured.correctors if "corrector" in label.kind else measured.monitors
        places = [list(names).index(name) for name in label.elements]
        rf, noise, response = measured.rf, measured.noise, measured.response
        orbit = None if rf is None else rf.orbit
        if label.kind == "rejected corrector":
            measured = measured.select([name for name in names if name not in label.elements])
            continue
        order = np.arange(len(names))
        order[places] = places[::-1]
        if label.kind == "swapped correctors":
            kicks = np.asarray(measured.kicks)[order]
            measured = replace(measured, response=response[order], kicks=kicks)
            continue
        response = response[:, order].copy()
        orbit = None if orbit is None else orbit[order].copy()
        noise = None if noise is None else noise[order]
        for readings in (response, *(() if orbit is None else (orbit,))):
            if label.kind == "swapped planes":
                readings[..., places, :] = readings[..., places, ::-1]
            elif label.plane is not None:
                readings[..., places, "xy".index(label.plane)] = np.nan
        rf = None if rf is None else replace(rf, orbit=orbit)
        measured = replace(measured, response=response, noise=noise, rf=rf)
    return measured


# --- rejected channels ----------------------------------------------------------------------------
def rejected_channels(state: State) -> list[Label]:
    """Return the channels that no multiple of the model explains, among the readings in each
    column's own plane: BPM planes, with another one's signal or noise, and correctors.

    Args:
        state: with the model's readings.
    """
    data = state.data
    read, orbits = data.pick(state.at.read)[:-1], data.pick(data.orbits)[:-1]
    monitors: list[Label] = []
    correctors: list[Label] = []
    for p in (0, 1):
        rows = np.flatnonzero(data.plane[:-1] == p)
        if not len(rows):
            continue
        there = np.isfinite(orbits[rows]) & state.good
        noise = np.broadcast_to(data.noise[:, p], there.shape)
        bad = _unlike(read[rows], orbits[rows], noise, there)
        monitors += [Label("rejected BPM", (data.measured.monitors[m],), plane="xy"[p])
                     for m in np.flatnonzero(bad)]  # fmt: skip
        odd = _unlike(read[rows].T, orbits[rows].T, noise.T, (there & ~bad).T)
        correctors += [Label("rejected corrector", (data.measured.correctors[rows[c]],))
                       for c in np.flatnonzero(odd)]  # fmt: skip
    return [*monitors, *correctors]


def _unlike(model: Array, read: Array, noise: Array, there: Flags) -> Flags:
    """Of each column of [reading, one]: whether no multiple of the model explains it."""
    u, d = np.where(there, model, 0.0), np.where(there, read, 0.0)
    size = (d**2).sum(axis=0)
    gain = (u * d).sum(axis=0) / np.maximum((u**2).sum(axis=0), TINY)
    left = (d - gain * u) ** 2
    share = left.sum(axis=0) / np.maximum(size, TINY)
    # a weak response, or one of noise alone, is described by a calibration or a gain
    seen = (there.sum(axis=0) >= FEW) & (size > SILENT**2 * (u**2).sum(axis=0))
    chance = chi2.sf((left / noise**2).sum(axis=0), there.sum(axis=0))
    if seen.sum() < FEW:
        return np.zeros(len(share), dtype=bool)
    strange = seen & (share > max(UNEXPLAINED, RATIO * float(np.median(share[seen]))))
    strange &= chance < DEFAULT.false_alarm
    return strange if strange.sum() <= WRONG * seen.sum() else np.zeros_like(strange)


def reversed_ones(state: State) -> list[str]:
    """A message about BPMs and correctors with the wrong sign by the fit."""
    errors, measured = state.at.errors, state.data.measured
    gains = np.diagonal(errors.monitors, axis1=1, axis2=2)
    found = []
    for what, names in (
        ("BPMs that read", [
            f"{measured.monitors[m]} in {'xy'[p]}"
            for m, p in np.argwhere((gains < 0) & state.good[:, None])
        ]),
        ("correctors that kick", [
            measured.correctors[c] for c in np.flatnonzero(errors.kick[:-1] < 0)
        ]),
    ):  # fmt: skip
        if names:
            found.append(f"{what} with the wrong sign: {', '.join(names)}")
    return found


# --- two measurements -----------------------------------------------------------------------------
def without_swaps(
    made: Callable[[OrbitResponse], ResponseData], measured: OrbitResponse, holdout: float
) -> tuple[OrbitResponse, ResponseData, list[Label]]:
    """Return a measurement with swapped pairs corrected, its data, and these pairs.

    Args:
        made: returns the data of a measurement, with the model to compare with.
        measured: the measurement.
        holdout: share of the correctors that are held out.
    """
    known: list[Label] = []
    while True:
        data = made(measured)
        state = begin(data, split_columns(data, holdout, np.random.default_rng(0)))
        found = new(swaps(state, rejected_channels(state)), known)
        if not found:
            return measured, data, known
        measured, known = corrected(measured, found), known + found


def new(labels: Iterable[Label], known: Iterable[Label]) -> list[Label]:
    """Return the labels of pairs that are unknown."""
    before = {label.elements for label in known}
    return [label for label in labels if label.elements not in before]


def since(first: Sequence[Label], second: Sequence[Label]) -> tuple[list[Label], list[Label]]:
    """Return the pairs swapped on one of two days, and those on both."""
    before, now = ({frozenset(label.elements) for label in labels} for labels in (first, second))
    both = [label for label in second if frozenset(label.elements) in before & now]
    return [label for label in (*first, *second) if frozenset(label.elements) in before ^ now], both
