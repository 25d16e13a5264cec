"""Effects missing from a fitted orbit response: each hypothesis is scored on held-out readings.

>>> fit = fit_families(data, split)
>>> for row in weigh(fit.state): print(row.effect, row.amount, row.amount_sigma, row.judgement)

A hypothesis is a set of patterns, the derivatives of the readings by its parameters. They are
fitted together with the parameters of the fit, linearised, to the same correctors, and validated on
held-out ones. Parameters of single correctors (place, drift during the step) are estimated from
half of a held-out corrector's BPMs, like its kick.

To add a hypothesis, write a function that returns its patterns at the fit, and add it to
`HYPOTHESES`. What is a family of the fit is none: every fit tests it.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.polynomial.legendre import legvander
from scipy.linalg import cho_factor, cho_solve
from scipy.linalg.lapack import dpotri
from scipy.sparse import csr_array

from tmlattice.arrays import Array
from tmlattice.diagnosis.families.fields import QuadrupoleGradient
from tmlattice.diagnosis.response.linear import linear
from tmlattice.diagnosis.response.state import State, amplitudes, rms_of
from tmlattice.diagnosis.response.weights import weight
from tmlattice.effects import apply
from tmlattice.inference.judgement import ENOUGH
from tmlattice.inference.normal import solve
from tmlattice.inference.priors import Group
from tmlattice.lattice.alike import families
from tmlattice.observe.orbit_response import DELTA

BEND_GRADIENT = 1e-4
"""Step of finite differences, 1/m2."""
MILLIMETRE = 1e-3
ORDERS = 3
"""Order of the polynomial of a drift over all columns."""
WAVES = 4
"""Number of leading closed orbits of random kicks in a plane."""


@dataclass(frozen=True)
class MissingEffect:
    """An effect that may be missing.

    Attributes:
        effect: its name.
        unit: of the amounts.
        expected: physically plausible amounts.
        patterns: d reading / d amount in each column's own plane, m, [parameter, column, monitor].
        own: whether each column has its own amount of each pattern.
        most: largest plausible amount.
    """

    effect: str
    unit: str
    expected: str
    patterns: Array = field(repr=False)
    own: bool = False
    most: float = np.inf


def _readings(state: State, beam: Array) -> Array:
    """Own-plane readings [column, monitor] of the beam's orbit changes [column, monitor, 2]."""
    return state.data.pick(state.at.seen(beam))


def _kicks(state: State) -> Array:
    return np.asarray((state.data.kicks * (1 + state.at.errors.calibration))[:-1])


def _orders(state: State) -> tuple[Array, Array]:
    """Second and third order of the orbit changes for whole steps, [column, monitor, 2]."""
    model, kicks = state.at.model, _kicks(state)
    f = state.data.kicks[-1]
    up, down = (
        np.concatenate([
            model.closed_orbits(state.data.measured.correctors, side * kicks),
            model.at_frequency(model.frequency + side * f).readings[None],
        ])[:, state.data.at]
        for side in (1, -1)
    )  # fmt: skip
    steps = model.response(state.data.measured.correctors) * kicks[:, None, None]
    linear = np.concatenate([steps, model.rf_change(f)[None]])[:, state.data.at]
    return (up + down) / 2 - model.readings[state.data.at], (up - down) / 2 - linear


def _one_sided(state: State) -> MissingEffect:
    second, _ = _orders(state)
    return MissingEffect(
        "one-sided steps", "share", "0: two-sided, 1 or -1: one-sided",
        _readings(state, second)[None], most=1.1,
    )  # fmt: skip


def _third_order(state: State) -> MissingEffect:
    third = _orders(state)[1]
    third[-1] = 0
    return MissingEffect(
        "third order of two-sided steps", "beyond the model's", "0; -1: none",
        _readings(state, third)[None] / 4, most=2.0,
    )  # fmt: skip


def _corrector_energy(state: State) -> MissingEffect:
    model, names = state.at.model, state.data.measured.correctors
    own = model.rf_response() / model.rf_start[5]
    flat = model.response(names) - model.columns(names).start[:, 5, None, None] * own
    shift = state.at.orbits(model)
    shift[:-1] -= flat[:, state.data.at] * state.data.kicks[:-1, None, None]
    shift[-1] = 0
    return MissingEffect(
        "corrector's energy shift", "beyond the model's", "0; -1: the energy stays",
        _readings(state, shift)[None], most=1.1,
    )  # fmt: skip


def _position(state: State, by_family: bool) -> MissingEffect:
    """The position of the field of each corrector; or one for all whose names begin alike."""
    rows = (_readings(state, state.at.jumps) * state.data.kicks[:, None])[None]
    if by_family:
        members = families([*state.data.measured.correctors, "\0"])[1]
        rows = members.T[:, :, None] * rows
    name = f"corrector's field displaced in s, {'by family' if by_family else 'each'}"
    return MissingEffect(name, "m", "< 0.05 m", rows, own=not by_family, most=0.05)


def _energy_drift(state: State) -> MissingEffect:
    rf = _readings(state, state.at.beam)[-1]
    pattern = np.where((state.data.plane == 0)[:, None], rf, 0.0)
    pattern[-1] = 0
    return MissingEffect(
        "drift of the energy", "RF step", "< 1e-3", pattern[None], own=True, most=1e-3
    )


def _orbit_drift(state: State) -> MissingEffect:
    """Closed orbits of random kicks between the readings of a step, different in each column."""
    orbits = _readings(state, state.at.orbits(state.at.model))
    waves = np.zeros((WAVES, *orbits.shape))
    for p in (0, 1):
        mine = state.data.plane == p
        mine[-1] = False
        per_kick = np.nan_to_num(orbits[mine]) / state.data.kicks[mine, None]
        found = np.linalg.svd(per_kick, full_matrices=False)[2][:WAVES]
        waves[: len(found), mine] = found[:, None] * np.sqrt(found.shape[1])
    return MissingEffect(
        "drift of the orbit (betatron waves)", "m", "< 1e-5", waves, own=True, most=1e-5
    )


def _tune_drift(state: State) -> MissingEffect:
    total = np.zeros((2, len(state.data.plane), len(state.data.at)))
    single = QuadrupoleGradient()
    focusing = [int(state.data.ring[name].k1 < 0) for name in single.places(state.data)]
    np.add.at(total, focusing, single.rows(state.at, np.zeros(len(focusing))))
    total[:, -1] = 0
    return MissingEffect(
        "drift of the gradients (focusing, defocusing)", "relative", "< 1e-4", total, own=True,
        most=1e-4,
    )  # fmt: skip


def _in_time(drift: MissingEffect, effect: str, constant: bool) -> MissingEffect:
    """A smooth drift over the columns in the order of time.

    Args:
        drift: its patterns of single columns.
        effect: its name.
        constant: whether it includes a part that is equal in all columns.
    """
    columns = drift.patterns.shape[1] - 1
    orders = legvander(np.linspace(-1, 1, columns), ORDERS).T[0 if constant else 1 :]
    rows = drift.patterns[:, None].copy() * np.ones((len(orders), 1, 1))
    rows[:, :, :-1] *= orders[:, :, None]
    rows[:, :, -1] = 0
    return replace(drift, effect=effect, patterns=rows.reshape(-1, *rows.shape[2:]), own=False)


def _orbit_in_time(state: State) -> MissingEffect:
    waves = _orbit_drift(state)
    planes = [(state.data.plane == p)[:, None] * waves.patterns for p in (0, 1)]
    each = replace(waves, patterns=np.concatenate(planes))
    return _in_time(each, "drift of the orbit in order of time", True)


def _chromatic_in_time(state: State) -> MissingEffect:
    """A drift of the energy of all columns, which changes the tunes and the optics."""
    return _in_time(_chromatic(state), "drift of the beam's energy in order of time", False)


def _hysteresis(state: State) -> MissingEffect:
    """Hysteresis: a corrector's iron keeps a share of its step in later columns, of the last step
    alone or of all earlier ones."""
    last = np.zeros_like(state.at.read)
    last[1:-1] = state.at.read[:-2]
    rows = np.stack([state.data.pick(stays) for stays in (last, np.cumsum(last, axis=0))])
    rows[:, -1] = 0  # the RF's
    return MissingEffect("hysteresis: a share of earlier steps", "share", "< 0.01", rows, most=0.01)


def _chromatic(state: State) -> MissingEffect:
    """An energy offset of the beam, which changes the effect of quadrupoles and sextupoles."""
    scale = (1 + state.at.errors.calibration)[:, None, None] * DELTA
    slope = _readings(state, state.at.chromatic * scale)
    return MissingEffect("energy offset of the beam", "1e-3", "< 5", slope[None], most=5.0)


def _nonlinear(state: State) -> MissingEffect:
    """Cubic BPMs with two-sided steps: x^3 / 4 of the whole change."""
    cubes = state.data.pick(state.at.read) ** 3 / 4 / MILLIMETRE**2
    rows = np.stack([np.where((state.data.plane == p)[:, None], cubes, 0.0) for p in (0, 1)])
    return MissingEffect("nonlinear BPMs (cubic)", "1/mm2", "< 1e-3", rows, most=1e-3)


def _radiation(state: State) -> MissingEffect | None:
    pairs = [
        (f"radiation_loss_{kind}s", None)
        for kind in ("bend", "wiggler")
        if any(e.kind == kind for e in state.data.ring.elements)
    ]
    rows = [_readings(state, slope) for slope in state.at.slopes(pairs)]
    return MissingEffect(
        "radiation in bends, wigglers", "expected loss", "1", np.array(rows), most=3
    )


def _monitor_position(state: State) -> MissingEffect:
    model = state.at.model
    columns = model.columns(state.data.measured.correctors)
    start = np.vstack([columns.start, model.rf_start])
    behind = np.vstack([columns.launch_kick * 1.0, np.zeros(model.dimension)])
    after = np.vstack([model.downstream(columns), np.zeros((1, len(model.monitors)), bool)])
    slopes = model.tangents[model.maps.at][:, [1, 3]]
    angle = np.einsum("mai,ci->cma", slopes, start)
    angle = angle + after[:, :, None] * np.einsum("mai,ci->cma", slopes, behind)
    kicks = np.append(_kicks(state), state.data.kicks[-1])
    flat = _readings(state, angle[:, state.data.at] * kicks[:, None, None])
    rows = np.zeros((len(state.data.at), *flat.shape))
    for i in range(len(rows)):
        rows[i, :, i] = flat[:, i]
    return MissingEffect("BPMs displaced in s", "m", "< 0.01 m", rows, most=0.01)


def _bend_gradient(state: State) -> MissingEffect:
    """Gradients of bends; magnets of one length are one type."""
    ring = state.at.model.ring
    bends = [i for i, e in enumerate(ring.elements) if e.kind == "bend"]
    kinds = sorted({round(ring.elements[i].length, 3) for i in bends})
    rows = []
    for kind in kinds:
        changed = {
            i: ring.elements[i].changed(k1=ring.elements[i].k1 + BEND_GRADIENT)
            for i in bends
            if round(ring.elements[i].length, 3) == kind
        }
        model = state.at.model.changed_to(ring.with_elements(changed))
        slope = (state.at.orbits(model) - state.at.orbits(state.at.model)) / BEND_GRADIENT
        scale = np.append(1 + state.at.errors.calibration[:-1], 1)[:, None, None]
        rows.append(_readings(state, slope * scale))
    return MissingEffect("gradient of bends, by type", "1/m2", "< 1e-3", np.array(rows), most=1e-3)


def _second_order_coupling(state: State) -> MissingEffect | None:
    if not state.values.get("skew", np.zeros(1)).any():
        return None
    causes = [c for c in state.at.errors.ring if c.effect != "skew_gradient"]
    flat = state.at.model.changed_to(apply(state.data.ring, causes))
    change = state.at.orbits(state.at.model) - state.at.orbits(flat)
    return MissingEffect(
        "coupling to second order", "beyond the model's", "0; -1: none",
        _readings(state, change)[None], most=1.1,
    )  # fmt: skip


HYPOTHESES: dict[str, Callable[[State], MissingEffect | None]] = {
    "one_sided_steps": _one_sided,
    "third_order": _third_order,
    "energy_drift": _energy_drift,
    "orbit_drift": _orbit_drift,
    "gradient_drift": _tune_drift,
    "energy_in_time": lambda state: _in_time(
        _energy_drift(state), "drift of the energy in order of time", True
    ),
    "orbit_in_time": _orbit_in_time,
    "gradients_in_time": lambda state: _in_time(
        _tune_drift(state), "drift of the gradients in order of time", False
    ),
    "chromatic_in_time": _chromatic_in_time,
    "hysteresis": _hysteresis,
    "corrector_energy": _corrector_energy,
    "corrector_position_family": lambda state: _position(state, True),
    "corrector_position": lambda state: _position(state, False),
    "monitor_nonlinearity": _nonlinear,
    "monitor_position": _monitor_position,
    "bend_gradient": _bend_gradient,
    "radiation": _radiation,
    "second_order_coupling": _second_order_coupling,
}


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
        columns = np.flatnonzero(split.held)
        data = state.data.pick(state.data.orbits)[columns]
        seen = np.isfinite(data) & state.good
        near, far = seen & split.half[columns], seen & ~split.half[columns]
        patterns = (
            (self.read + change)[None] if own is None else np.stack([self.read + change, *own])
        )
        jumps = state.data.pick(state.at.seen(state.at.jumps))[None]
        inside, jumped = (
            rms_of(amplitudes(np.moveaxis(some[:, columns], 0, 2), data, near)[1][far])
            for some in (patterns, np.concatenate([patterns, jumps]))
        )
        return inside, jumped


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
