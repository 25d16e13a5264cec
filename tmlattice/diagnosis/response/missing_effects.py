"""Effects missing from a fitted orbit response: each hypothesis is scored on held-out readings.

>>> fit = fit_steps(data, split)
>>> for row in weigh(fit.state): print(row.effect, row.amount, row.amount_sigma, row.judgement)

A hypothesis is a set of patterns, the derivatives of the readings by its parameters. They are
fitted together with the parameters of the fit, linearised, to the same correctors, and validated on
held-out ones. Parameters of single correctors (place, drift during the step) are estimated from
half of a held-out corrector's BPMs, like its kick.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.linalg.lapack import dpotri
from scipy.sparse import csr_array

from tmlattice.arrays import Array
from tmlattice.diagnosis.response.hypotheses import HYPOTHESES, MissingEffect
from tmlattice.diagnosis.response.linear import linear
from tmlattice.diagnosis.response.state import State, amplitudes, rms_of
from tmlattice.diagnosis.response.weights import weight
from tmlattice.inference.judgement import ENOUGH
from tmlattice.inference.normal import solve
from tmlattice.inference.priors import Group

Patterns: TypeAlias = Array | csr_array

FREE = 30.0
"""Prior rms of a single parameter, in units of the largest plausible amount: nearly flat."""
SPARSE = 0.1
"""Share of non-zero readings below which patterns are sparse."""


@dataclass(frozen=True)
class Weighed:
    """A hypothesis and its scores on held-out readings.

    Attributes:
        effect, unit, expected: see `MissingEffect`.
        parameters: their number.
        amount: the parameter, or the rms of several.
        amount_sigma: its posterior rms, or the median one of several.
        heldout_rms_in_plane, heldout_rms_position: with it, m; see `Step`.
        on_top_in_plane: with it and all accepted ones, m.
        evidence: gain of log evidence of the fitted readings with it alone: the misfit that it
            explains, less the cost of its parameters.
        control_in_plane: with as many random parameters instead, m; None unless columns have
            amounts of their own. See `control`.
        judgement: "helps" (on top of all better ones); "helps, not on top"; "as random ones do" (no
            more than its control); "unphysical" (improves with an implausible amount); "excluded"
            (does not improve held-out readings).
    """

    effect: str
    unit: str
    expected: str
    parameters: int
    amount: float
    amount_sigma: float
    heldout_rms_in_plane: float
    heldout_rms_position: float
    on_top_in_plane: float
    evidence: float
    control_in_plane: float | None
    judgement: str


HELPS = 0.98
"""Ratio of held-out rms, with and without a hypothesis, below which it improves the prediction."""


def weigh(
    state: State,
    wanted: Iterable[str] | None = None,
    progress: Callable[[str], Any] = lambda stage: None,
) -> list[Weighed]:
    """Return the scores of every hypothesis alone and given the others; the first row is the fit.

    Plausible ones are accepted one by one, the best first, as long as each lowers the held-out rms
    given those before; then every other one is scored again given them.

    Args:
        state: of the fit.
        wanted: names of `HYPOTHESES`; None: all.
        progress: called with each name.
    """
    fitted = Fitted(state)
    base = fitted.weigh([])
    found: list[MissingEffect] = []
    for name in HYPOTHESES if wanted is None else wanted:
        progress(name)
        hypothesis = HYPOTHESES[name](state)
        # nothing without such places, or without sensitive fitted readings
        if hypothesis is not None and fitted.sees(hypothesis):
            found.append(hypothesis)
    alone = [fitted.weigh([hypothesis]) for hypothesis in found]
    random = [fitted.weigh([control(own)]).in_plane if own.own else None for own in found]
    progress("hypotheses together")
    together, chosen = base, list[int]()

    def take(candidates: list[int]) -> None:
        """The best hypotheses, as long as each improves given those before."""
        nonlocal together
        left = list(candidates)
        while left:
            given = [found[k] for k in chosen]
            answers = {i: fitted.weigh([*given, found[i]]) for i in left}
            left = [i for i in left if _helps(found[i], answers[i], together)]
            if left:
                best = min(left, key=lambda i, scores=answers: scores[i].in_plane)  # type: ignore[misc]
                together = answers[best]
                chosen.append(best)
                left.remove(best)

    helpful = [
        i for i, (answer, rms) in enumerate(zip(alone, random, strict=True))
        if rms is None or answer.in_plane < HELPS * rms
    ]  # fmt: skip
    helpers = [i for i in helpful if _helps(found[i], alone[i], base)]
    take(helpers)
    first = [found[k] for k in chosen]
    on_top = {
        i: fitted.weigh([*first, hypothesis])
        for i, hypothesis in enumerate(found)
        if i not in chosen
    }
    before = together
    take([i for i, answer in on_top.items() if i in helpful and _helps(found[i], answer, before)])
    rms = base.in_plane, base.position, together.in_plane
    out = [Weighed("none", "", "", 0, 0.0, 0.0, *rms, 0.0, None, "")]
    for i, hypothesis in enumerate(found):
        given = together if i in chosen else on_top[i]
        if i in chosen:
            judgement = "helps"
        elif i in helpers:
            judgement = "helps, not on top"
        elif i not in helpful and _helps(hypothesis, alone[i], base):
            judgement = "as random ones do"
        else:
            best = min(alone[i].in_plane / base.in_plane, given.in_plane / before.in_plane)
            sensible = best >= HELPS or _sensible(hypothesis, given)
            judgement = "excluded" if sensible else "unphysical"
        amounts, sigma, in_plane, position, evidence = alone[i]
        out.append(
            Weighed(
                hypothesis.effect, hypothesis.unit, hypothesis.expected, len(amounts),
                _size(amounts), float(np.median(sigma)), in_plane, position, given.in_plane,
                evidence, random[i], judgement,
            )
        )  # fmt: skip
    return out


def _helps(hypothesis: MissingEffect, answer: "Answer", before: "Answer") -> bool:
    gains = answer.in_plane < HELPS * before.in_plane and answer.evidence > before.evidence
    return gains and _sensible(hypothesis, answer)


def control(hypothesis: MissingEffect) -> MissingEffect:
    """Return random parameters of the same number, size and smoothness, unrelated to their columns.

    Parameters of single columns are estimated from half of a held-out corrector's BPMs, so any
    smooth orbit improves the other half.
    """
    rng = np.random.default_rng(17)
    patterns = hypothesis.patterns.copy()
    monitors = patterns.shape[2]
    for c in range(patterns.shape[1]):
        by = int(rng.integers(monitors // 4, monitors - monitors // 4))
        patterns[:, c] = np.roll(patterns[:, c], by, axis=1)
    return replace(hypothesis, patterns=patterns)


def _size(amounts: Array) -> float:
    return float(np.sqrt(np.mean(amounts**2))) if len(amounts) > 1 else float(amounts[0])


def _sensible(hypothesis: MissingEffect, answer: "Answer") -> bool:
    return abs(_size(answer.amounts)) < hypothesis.most


class Answer(NamedTuple):
    """Amounts of the last hypothesis, their errors, held-out rms without and with a jump, m, and
    the log evidence of all."""

    amounts: Array
    sigma: Array
    in_plane: float
    position: float
    evidence: float


class Fitted:
    """The linearised fit, to which patterns can be added."""

    def __init__(self, state: State) -> None:
        state = replace(state, jitter=None)  # a hypothesis among the others here
        self.state, data = state, state.data
        self.there = there = linear(state, 0)
        # a dummy without effect where no family was accepted
        dummy = Group("none", np.zeros((len(there.start), 1)), 1.0)
        found = solve(there.normal, (dummy, *there.groups), there.start, rounds=0)
        self.spread, self.factor = found.spread, (found.factor, True)
        self.vector = self.spread.T @ (there.normal.vector + there.normal.matrix @ there.start)
        self.weight = weight(state, 0)
        self.read = data.pick(state.at.read)
        # readings by the monitors' and the columns' own parameters, [reading, parameter]
        columns, monitors = self.weight.shape
        reading = np.arange(self.weight.size)
        by_monitor = 2 * (reading % monitors) + np.repeat(data.plane, monitors)
        by_column = 2 * monitors + reading // monitors
        self.own = csr_array(
            (
                np.concatenate([there.by_monitor.ravel(), there.by_column.ravel()]),
                (np.tile(reading, 2), np.concatenate([by_monitor, by_column])),
            ),
            shape=(len(reading), 2 * monitors + columns),
        )
        self._parts: dict[int, _Part] = {}
        residual = np.where(self.weight > 0, data.pick(state.at.left), 0.0)
        self.target = residual + self.change(there.start)

    def change(self, values: Array) -> Array:
        """Readings [column, monitor] for a change of the base parameters."""
        return self.there.readings(self.state.data.plane, values)

    def across(self, flat: Patterns) -> Array:
        """J^T W H, [base parameter, pattern], of patterns [pattern, reading]."""
        weighted = _scaled(flat, self.weight.ravel())
        ring = self.there.by_ring.reshape(-1, self.weight.size).T
        own = _dense(weighted @ self.own)
        return np.concatenate([own, _dense(weighted @ ring)], axis=1).T

    def sees(self, hypothesis: MissingEffect) -> bool:
        """Whether any fitted reading is sensitive to it."""
        return bool(hypothesis.patterns.any() and self._part(hypothesis).flat.shape[0])

    def weigh(self, hypotheses: Sequence[MissingEffect]) -> Answer:
        """The scores of these hypotheses together on held-out readings."""
        if not hypotheses:  # the same linear step as with one: the fit itself may still move
            moved = cho_solve(self.factor, self.vector)
            in_plane, position = self._score(
                self.change(self.spread @ moved - self.there.start), None
            )
            return Answer(np.zeros(0), np.zeros(0), in_plane, position, 0.0)
        parts = [self._part(hypothesis) for hypothesis in hypotheses]
        edge = np.cumsum([0, *(part.across.shape[1] for part in parts)])
        B = np.concatenate([part.across for part in parts], axis=1)
        half = cho_solve(self.factor, B)
        weight = self.weight.ravel()
        C = np.empty((edge[-1],) * 2)
        for i, one in enumerate(parts):
            for k, other in enumerate(parts[: i + 1]):
                both = _dense(_scaled(one.flat, weight) @ other.flat.T)
                C[edge[i] : edge[i + 1], edge[k] : edge[k + 1]] = both
                C[edge[k] : edge[k + 1], edge[i] : edge[i + 1]] = both.T
        C -= B.T @ half
        target = weight * self.target.ravel()
        r = np.concatenate([part.flat @ target for part in parts]) - half.T @ self.vector
        # single amounts are free; many have the most probable scale, within physics
        owner = np.repeat(np.arange(len(parts)), np.diff(edge))
        many = [len(part.across.T) > ENOUGH for part in parts]
        most = [one.most if m else FREE * min(one.most, 1e3)
                for one, m in zip(hypotheses, many, strict=True)]  # fmt: skip
        spread = np.array(most)[owner]
        for _ in range(12 if any(many) else 1):
            # in units of the priors, so that the matrix is well scaled
            root = cho_factor(C * np.outer(spread, spread) + np.eye(len(C)), lower=True)
            amounts = spread * cho_solve(root, spread * r)
            variance = np.diag(dpotri(root[0], lower=1)[0]) * spread**2
            for i in (i for i, m in enumerate(many) if m):
                mine = owner == i
                scale = float(np.sqrt(np.mean(amounts[mine] ** 2 + variance[mine])))
                spread[mine] = min(scale, most[i])
        moved = cho_solve(self.factor, self.vector - B @ amounts)
        change = self.change(self.spread @ moved - self.there.start)
        for i, (hypothesis, part) in enumerate(zip(hypotheses, parts, strict=True)):
            if not hypothesis.own:
                change = change + (amounts[owner == i] @ part.flat).reshape(change.shape)
        own = [hypothesis.patterns for hypothesis in hypotheses if hypothesis.own]
        last = owner == len(parts) - 1
        rms, jumped = self._score(change, np.concatenate(own) if own else None)
        evidence = 0.5 * float(r @ amounts) - float(np.log(np.diag(root[0])).sum())
        return Answer(amounts[last], np.sqrt(variance[last]), rms, jumped, evidence)

    def _part(self, hypothesis: MissingEffect) -> "_Part":
        """Patterns to which fitted readings are sensitive."""
        key = id(hypothesis)
        if key not in self._parts:
            flat = hypothesis.patterns.reshape(len(hypothesis.patterns), -1)
            if hypothesis.own:
                flat = _by_column(hypothesis.patterns)
            elif np.count_nonzero(flat) < SPARSE * flat.size:
                flat = csr_array(flat)
            flat = flat[np.flatnonzero(abs(flat) @ self.weight.ravel() > 0)]
            self._parts[key] = _Part(hypothesis, flat, self.spread.T @ self.across(flat))
        return self._parts[key]

    def _score(self, change: Array, own: Array | None) -> tuple[float, float]:
        state, split = self.state, self.state.split
        read = self.read + change
        data = state.data.pick(state.data.orbits)
        jumps = state.data.pick(state.at.seen(state.at.jumps))
        inside: list[Array] = []
        jumped: list[Array] = []
        for c in np.flatnonzero(split.held):
            patterns = [read[c], *([] if own is None else own[:, c])]
            patterns = [p for p in patterns if np.abs(p).max() > 0]
            seen = np.isfinite(data[c]) & state.good
            near, far = seen & split.half[c], seen & ~split.half[c]
            for more, into in (([], inside), ([jumps[c]], jumped)):
                both = np.stack([*patterns, *more], axis=1)
                into.append(amplitudes(both, data[c], near, far)[1])
        return rms_of(inside), rms_of(jumped)


@dataclass(frozen=True)
class _Part:
    """A hypothesis as derivatives of readings, and its products with the fit."""

    hypothesis: MissingEffect
    flat: Patterns  # [pattern, reading]
    across: Array


def _scaled(flat: Patterns, by: Array) -> Patterns:
    """Patterns with a factor on each reading."""
    return csr_array(flat.multiply(by)) if isinstance(flat, csr_array) else flat * by


def _dense(values: Patterns) -> Array:
    return values.toarray() if isinstance(values, csr_array) else np.asarray(values)


def _by_column(patterns: Array) -> csr_array:
    """One parameter for each column in which a pattern is not zero, [parameter, reading]."""
    count, columns, monitors = patterns.shape
    rows = np.repeat(np.arange(count * columns), monitors)
    at = np.tile(np.arange(columns * monitors), count)
    whole = csr_array((patterns.ravel(), (rows, at)), shape=(count * columns, columns * monitors))
    return whole[np.flatnonzero(abs(patterns).max(axis=2).ravel() > 0)]
