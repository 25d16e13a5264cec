"""Outlier steps of a response, and the label of each: what is wrong with that step.

A step is an outlier if its residual, given its own kick, is many times the typical one. A table
compares the hypotheses, each by the mean square that it leaves at readings which it does not fit:

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

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from tmlattice.arrays import TINY, Array, Flags, Indices
from tmlattice.beam.kicks import orbits_of_kicks
from tmlattice.diagnosis.families.fields import FURTHEST
from tmlattice.diagnosis.response.labels import SHARE, Label, swapped_correctors
from tmlattice.diagnosis.response.state import State, amplitudes, rms_of
from tmlattice.diagnosis.response.weights import BLIND
from tmlattice.inference import chi2
from tmlattice.inference.judgement import ENOUGH, FEW, OUTLIERS, SIGNIFICANT, WRONG
from tmlattice.observe.noise import SAME_PLACE

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
    if not all((own & ~gone).any() for own in (split.held, split.inner, state.fitted)):
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
    split = replace(state.split, held=state.split.held & ~gone, inner=state.split.inner & ~gone)
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
        return rms_of([amplitudes(patterns, self.left, near, far)[1]]) ** 2

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
        every = np.ones(len(self.left), dtype=bool)
        (kick, jump), missed = amplitudes(patterns, self.left, among, every)
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
