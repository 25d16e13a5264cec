"""Labels of a response: channels that are not those of the table of names, and their correction.

Two cables, or two rows of a table of names, may be swapped; a corrector may be elsewhere than in
the lattice; a channel may read noise, or another step than the one that was asked for. A label is
one such hypothesis about correctors or BPMs. The readings of each channel are compared with the
orbits of all others (`_as_others`): a swap must explain both.

>>> found = labels_of(state, {"v5", "v9"})
>>> measured = corrected(measured, found)

A corrector's step is an outlier if its residual, given its own kick, is many times the typical one.
A table compares the hypotheses, each by the mean square that it leaves at readings which it does
not fit:

| label | orbit that the step has besides its own | weight |
|---|---|---|
| swapped | that of another corrector, instead of its own | 1 |
| misplaced | a position jump at the corrector | 1 |
| spurious kick | that of a kick at any other place | 2 |
| inconsistent | no single orbit | |

A kick at a distance d downstream is the same kick in the lattice's place and a jump of -d times the
kick. A spurious kick is that of a supply that jumps between the two readings of a step. A step is
inconsistent if some BPMs were read before the orbit settled. That needs no ring: given two of three
neighbouring BPMs, the reading of the third follows, wherever else the beam is kicked: n1 x1 + n2 x2
+ n3 x3 = 0, with n normal to their sensitivities to the coordinates of a launch. A kick violates
that at one triple; an inconsistent step at half of them.

A step with a label has no information on the ring. It is neither fitted nor used for validation.

>>> labels = outlier_steps(state)
>>> state = without_readings(state, rejected(state, labels))
"""

from collections import defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations, product

import numpy as np

from tmlattice.arrays import TINY, Array, Flags, Indices
from tmlattice.beam.kicks import orbits_of_kicks
from tmlattice.diagnosis.families.fields import FURTHEST
from tmlattice.diagnosis.findings import located
from tmlattice.diagnosis.places import between
from tmlattice.diagnosis.response.state import State, amplitudes, begin, rms_of
from tmlattice.diagnosis.response.weights import BLIND
from tmlattice.diagnosis.result import Finding
from tmlattice.inference import chi2
from tmlattice.inference.alternatives import Detection
from tmlattice.inference.judgement import DEFAULT, ENOUGH, FEW, OUTLIERS, SIGNIFICANT, WRONG
from tmlattice.lattice import Ring
from tmlattice.measurement import OrbitResponse
from tmlattice.observe.noise import SAME_PLACE
from tmlattice.observe.response_data import ResponseData, split_columns

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
        statistic = float(left[a, a] + left[b, b] - left[a, b] - left[b, a]) / noise**2
        pair, seen = (names[a], names[b]), statistic > SIGNIFICANT**2
        if crossed and seen and not any(set(pair) & set(label.elements) for label in found):
            columns = (int(a), int(b)) if what == "correctors" else ()
            found.append(Label(f"swapped {what}", pair, columns, statistic=statistic))
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


ANYWHERE = 2.0
"""Weight of the residual given a kick, whose place is free."""
MARGIN = 1.5
"""Margin beyond the estimated place, as a share of the distance, that counts as between."""
GAINS, ROLLS = "monitor_gain", "corrector_roll"
"""Families without which residuals look like kicks, and rolled correctors like spurious kicks."""


def outlying(sizes: Array, of: Array, least: float) -> Flags:
    """Return the outliers: absolutely, and as a share of what they belong to, because a larger step
    has a larger residual; none if they are many.

    Args:
        sizes: NaN is never an outlier, [column].
        of: rms orbit of each column, [column].
        least: typical size at least.
    """
    known = np.isfinite(sizes)
    if known.sum() < FEW:
        return np.zeros(len(sizes), dtype=bool)
    share = np.where(known, sizes, 0.0) / of
    out = np.nan_to_num(sizes) > SIGNIFICANT * max(float(np.median(sizes[known])), least)
    out &= share > SIGNIFICANT * float(np.median(share[known]))
    return out if out.sum() <= WRONG * known.sum() else np.zeros_like(out)


def outlier_steps(state: State) -> list[Label]:
    """Return the labels of outlier steps, held-out ones included, one of each step at most; none if
    too few columns would remain for the fit and its validation.

    Args:
        state: with all families. Without BPM gains, misplaced correctors alone are labelled.
    """
    found: dict[int, Label] = {}
    for kicked, read in ((0, 0), (1, 1), (0, 1), (1, 0)):
        for label in _labels(state, kicked, read):
            found.setdefault(label.columns[0], label)
    gone = rejected(state, list(found.values())).any(axis=(1, 2))
    split = state.split
    if not all((own & ~gone).any() for own in (split.held, state.fitted)):
        return []
    return list(found.values())


def rejected(state: State, labels: Sequence[Label]) -> Flags:
    """Return the readings of labelled steps, [column, monitor, plane that is read]."""
    out = np.zeros(state.data.orbits.shape, dtype=bool)
    for label in labels:
        out[list(label.columns)] = True
    return out


def without_readings(state: State, flags: Flags) -> State:
    """Return the state without some readings, [column, monitor, 2]. Columns without readings are
    neither fitted nor used for validation, and their own numbers are zero."""
    if not flags.any():
        return state
    data = state.data
    orbits = np.where(flags, np.nan, data.orbits)
    measured = replace(data.measured, response=orbits[:-1].copy())
    data = replace(data, orbits=orbits, measured=measured)
    gone = flags.all(axis=(1, 2))
    split = replace(state.split, held=state.split.held & ~gone)
    values = dict(state.values)
    for family in state.families:
        if family.per == "column":
            values[family.variable] = np.where(gone, 0.0, values[family.variable])
    return replace(state, data=data, split=split).moved(values)


@dataclass(frozen=True, eq=False)
class _Step:
    """One column in one plane that is read, with what its own kick leaves.

    Attributes:
        state, column, plane: of the fit; the plane is that of the readings.
        seen: valid BPMs.
        own: pattern of its kick, or of its roll in the other plane, m, [reading].
        left: the residual given the kick by its own plane, m, [reading].
        kick: that kick, rad.
    """

    state: State
    column: int
    plane: int
    seen: Indices
    own: Array
    left: Array
    kick: float

    @property
    def rms(self) -> float:
        """The rms residual given its own amplitude, m."""
        return float(np.sqrt(self.missed()))

    def missed(self, *more: Array, among: Flags | None = None, half: bool = False) -> float:
        """The mean square residual of some readings given its own amplitude, and those of more
        patterns; if `half`, these are by every second reading, and the residual is that of the
        others."""
        odd = np.arange(len(self.left)) % 2 == 1
        among = np.ones(len(odd), dtype=bool) if among is None else among
        near, far = (among & ~odd, among & odd) if half else (among, among)
        patterns = np.column_stack([self.own, *more])
        return rms_of(amplitudes(patterns, self.left, near)[1][far]) ** 2

    @cached_property
    def jump(self) -> Array:
        """Readings by a position jump of the corrector, [reading]."""
        at = self.state.at
        return np.asarray(at.seen(at.jumps[self.column])[self.seen, self.plane])

    @cached_property
    def clear(self) -> Flags:
        """Readings except those of BPMs between the corrector's place and its estimated place, on
        the other side of the kick. Elsewhere a kick at any place is a kick here and a jump."""
        data = self.state.data
        every = np.ones(len(self.left), dtype=bool)
        by, missed = self._displaced(every)
        by, _ = self._displaced(missed <= np.quantile(missed, 1 - OUTLIERS))
        way = np.array([data.ring[data.measured.monitors[m]].s for m in self.seen])
        way -= data.ring[data.measured.correctors[self.column]].s
        beyond = (np.sign(by) * way + SAME_PLACE) % data.ring.length - SAME_PLACE
        between = beyond <= MARGIN * abs(by)
        return ~between if between.sum() <= max(OUTLIERS * len(every), 1) else every

    def _displaced(self, among: Flags) -> tuple[float, Array]:
        patterns = np.column_stack([self.own, self.jump])
        (kick, jump), missed = amplitudes(patterns, self.left, among)
        whole = self.kick + kick * self.state.data.kicks[self.column]
        return -jump / whole if whole else 0.0, np.abs(missed)

    @cached_property
    def by(self) -> float:
        """Distance downstream at which its kick explains most, m."""
        return self._displaced(self.clear)[0]

    @property
    def broken(self) -> float:
        """The violation of the typical triple of neighbouring BPMs, per reading, m; NaN with too
        few readings."""
        data, at = self.state.data, self.state.at
        gain = at.errors.monitors[self.seen, self.plane, self.plane]
        reads = np.abs(gain) > BLIND
        if reads.sum() < ENOUGH:
            return float("nan")
        left, seen = self.left[reads] / gain[reads], self.seen[reads]
        first = 2 * self.plane
        own = at.model.reading_slopes[data.at[seen], self.plane, first : first + 2].T
        a, b, c = (own[:, i : own.shape[1] - 2 + i] for i in range(3))
        normal = np.stack([_cross(b, c), _cross(c, a), _cross(a, b)])
        size = np.sqrt((normal**2).sum(axis=0))
        triples = (normal * np.stack([left[:-2], left[1:-1], left[2:]])).sum(axis=0)
        return float(chi2.typical(triples[size > 0] / size[size > 0]))


def _cross(a: Array, b: Array) -> Array:
    return np.asarray(a[0] * b[1] - a[1] * b[0])


def _steps(state: State, kicked: int, read: int) -> list[_Step]:
    data, at = state.data, state.at
    patterns = at.seen(at.beam if kicked == read else at.across)[..., read]
    found = []
    for c in np.flatnonzero(data.plane[:-1] == kicked).tolist():
        own, orbit = at.read[c, :, kicked], data.orbits[c, :, kicked]
        near = np.isfinite(orbit) & state.good
        size = float(own[near] @ own[near])
        kick = float(own[near] @ orbit[near]) / size if size else 1.0
        left = data.orbits[c, :, read] - kick * at.read[c, :, read]
        seen = np.flatnonzero(np.isfinite(left) & state.good)
        if len(seen) >= ENOUGH and patterns[c, seen].any():
            stepped = kick * (1 + at.errors.calibration[c]) * data.kicks[c]
            found.append(_Step(state, c, read, seen, patterns[c, seen], left[seen], stepped))
    return found


def _labels(state: State, kicked: int, read: int) -> Iterator[Label]:
    """Labels of the steps in a plane by their readings in a plane."""
    steps = _steps(state, kicked, read)
    data, names, gains = state.data, state.data.measured.correctors, state.allows(GAINS)
    if not steps or (kicked != read and not (gains and state.allows(ROLLS))):
        return
    noise = float(np.median(data.noise[:, read]))
    orbits = np.array([np.sqrt(np.nanmean(data.orbits[s.column] ** 2)) for s in steps])
    odd = outlying(np.array([s.rms for s in steps]), orbits, noise)
    if kicked == read and gains:
        broken = outlying(np.array([s.broken for s in steps]), orbits, noise)
        for column in (steps[i].column for i in np.flatnonzero(broken)):
            yield Label("inconsistent", (names[column],), (column,))
    if not odd.any():
        return
    pairs, usual = list[Label](), np.inf
    if kicked == read:
        pairs = swapped_correctors(state, {names[steps[i].column] for i in np.flatnonzero(odd)})
        usual = max(SIGNIFICANT * float(chi2.typical([s.by for s in steps])), FURTHEST)
    kicks = _kicks(state, read) if gains else np.zeros((0, data.shape[1]))
    for step in (steps[i] for i in np.flatnonzero(odd)):
        least, label = SHARE * step.missed(half=True), None
        for left, own in _table(step, pairs, usual, kicks):
            if left < least:
                least, label = left, own
        if label is not None:
            yield label


def _kicks(state: State, read: int) -> Array:
    """Readings in a plane by a kick behind each layer, m/rad, [layer, monitor]."""
    model, at = state.at.model, state.data.at
    layers, slopes = np.arange(len(model.maps.layers)), model.reading_slopes[at, read]
    kicks = orbits_of_kicks(model, layers, model.maps.at[at], slopes, read)
    return np.asarray(kicks.T * state.at.errors.monitors[:, read, read])


def _table(
    step: _Step, pairs: Sequence[Label], usual: float, kicks: Array
) -> Iterator[tuple[float, Label]]:
    """Hypotheses of an outlier step: weighted mean square residual at the other readings, label.

    Args:
        step: the step.
        pairs: swapped correctors.
        usual: displacement of a corrector that is no error, m.
        kicks: readings by a kick behind each layer, m/rad, [layer, monitor].
    """
    yield from ((0.0, pair) for pair in pairs if step.column in pair.columns)
    data, at = step.state.data, step.state.at
    name = data.measured.correctors[step.column]
    if abs(step.by) > usual:
        before, after = step.missed(among=step.clear), step.missed(step.jump, among=step.clear)
        noise = data.noise_of(0)[step.column, step.seen[step.clear]]
        gain = (before - after) * float(np.sum(noise**-2.0))
        words = (
            f"{abs(step.by):.2g} m {'down' if step.by > 0 else 'up'}stream "
            f"({1e6 * np.sqrt(before):.2g} µm rms residual in the lattice's place, "
            f"{1e6 * np.sqrt(after):.2g} there)"
        )
        label = Label("misplaced", (name,), (step.column,), words, gain)
        yield step.missed(step.jump, among=step.clear, half=True), label
    if len(kicks):
        near = np.arange(len(step.left)) % 2 == 0
        own, patterns = step.own[near], kicks[:, step.seen]
        own = own / max(float(np.sqrt(own @ own)), TINY)
        across = patterns[:, near] - np.outer(patterns[:, near] @ own, own)
        squares = np.maximum((across**2).sum(axis=1), TINY)
        score = across @ step.left[near]
        layer = int(np.argmax(score**2 / squares))
        words = (
            f"{1e6 * score[layer] / squares[layer]:+.2g} µrad in {'xy'[step.plane]}, as behind "
            f"{at.model.maps.layers[layer]}"
        )
        label = Label("spurious kick", (name,), (step.column,), words)
        yield ANYWHERE * step.missed(patterns[layer], half=True), label
