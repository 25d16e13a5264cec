"""Which effect a fitted orbit response still lacks: each hypothesis weighed on held-out readings.

>>> run = ResponseRun(ring, measured)
>>> run.run()
>>> for row in weigh(run): print(row.effect, row.amount, row.amount_sigma, row.judgement)

A hypothesis is a set of patterns: what the readings would change by for one unit of each of its
parameters. Patterns are fitted together with everything that the fit already has, linearly about
it, to the same correctors; the held-out ones judge. What every corrector has of its own (its place,
the machine's drift while it was stepped) is taken from a held-out corrector's near monitors, as its
kick is.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.linalg.lapack import dpotri
from scipy.sparse import csr_array

from tmlattice.beam.closed_orbit import ResponseModel
from tmlattice.beam.response_derivatives import derivatives
from tmlattice.diagnosis.response import ResponseRun, families, rms_of
from tmlattice.diagnosis.response_result import pick
from tmlattice.effects import apply
from tmlattice.lattice import Ring

Array = NDArray[np.float64]
Patterns: TypeAlias = Array | csr_array

ENERGY_SPREAD = 1.2e-3
"""Relative rms energy spread of PETRA III's beam; the scale of the hypothesis."""
DELTA = 1e-3
"""Energy deviation of the differences."""
BEND_GRADIENT = 1e-4
"""1/m2, of the differences."""
MILLIMETRE = 1e-3
FREE = 30.0
"""Prior rms of a parameter that stands alone, of the largest sensible amount: none to speak of."""
FEW = 6
"""So many amounts stand alone."""
WAVES = 4
"""Of the leading closed orbits of random kicks in a plane."""
SPARSE = 0.1
"""Patterns are kept sparse where fewer of their readings are not zero."""


@dataclass(frozen=True)
class Hypothesis:
    """An effect that may be missing.

    Attributes:
        effect: its name.
        unit: of the amounts.
        expected: what physics would allow.
        patterns: d reading / d amount in each column's own plane, m, [parameter, column, monitor].
        own: each column has its own amount of each pattern.
        most: the largest physically sensible amount.
    """

    effect: str
    unit: str
    expected: str
    patterns: Array = field(repr=False)
    own: bool = False
    most: float = np.inf


@dataclass(frozen=True)
class Weighed:
    """A hypothesis and what held-out readings say of it.

    Attributes:
        effect, unit, expected: see `Hypothesis`.
        parameters: how many.
        amount: the parameter, or the rms of several.
        amount_sigma: its posterior rms, or the median one of several.
        heldout_rms_in_plane, heldout_rms_position: with it, m; see `Step`.
        on_top_in_plane, on_top_position: with it and all others that are wanted together, m.
        judgement: "helps", on top of all that help more; "helps, not on top", where those leave it
            nothing; "unphysical" (it would help, by more than physics allows); "excluded"
            (held-out readings do not want it).
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
    on_top_position: float
    judgement: str

    def as_json(self) -> dict[str, Any]:
        """As it stands in the diagnosis."""
        return {k: v for k, v in vars(self).items() if k != "unit"}


HELPS = 0.98
"""Held-out rms falls to this share at least where a hypothesis helps."""


def weigh(
    run: ResponseRun,
    wanted: Iterable[str] | None = None,
    progress: Callable[[str], Any] = lambda stage: None,
) -> list[Weighed]:
    """Every hypothesis alone and on top of the others; the first row is the fit without any.

    Those that physics allows are taken together, the best first, as long as each lowers the
    held-out rms on top of those before it; then every other is weighed once more beside them.

    Args:
        run: after its fit.
        wanted: names of `HYPOTHESES`; None: all.
        progress: called with each name.
    """
    fitted = Fitted(run)
    base = fitted.weigh([])
    found: list[Hypothesis] = []
    for name in HYPOTHESES if wanted is None else wanted:
        progress(name)
        hypothesis = HYPOTHESES[name](run)
        # nothing where the ring has no such places, or no reading would move
        if hypothesis is not None and hypothesis.patterns.any():
            found.append(hypothesis)
    alone = [fitted.weigh([hypothesis]) for hypothesis in found]
    progress("hypotheses together")
    together, chosen = base, list[int]()

    def take(candidates: list[int]) -> None:
        """The best of them, as long as it helps on top of those that were taken."""
        nonlocal together
        left = list(candidates)
        while left:
            beside = [found[k] for k in chosen]
            answers = {i: fitted.weigh([*beside, found[i]]) for i in left}
            left = [i for i in left if _helps(found[i], answers[i], together)]
            if left:
                best = min(left, key=lambda i, said=answers: said[i].in_plane)  # type: ignore[misc]
                together = answers[best]
                chosen.append(best)
                left.remove(best)

    helpers = [i for i, answer in enumerate(alone) if _helps(found[i], answer, base)]
    take(helpers)
    first = [found[k] for k in chosen]
    on_top = {
        i: fitted.weigh([*first, hypothesis])
        for i, hypothesis in enumerate(found)
        if i not in chosen
    }
    before = together
    take([i for i, answer in on_top.items() if _helps(found[i], answer, before)])
    out = [Weighed("none", "", "", 0, 0.0, 0.0, *base[2:], *together[2:], "")]
    for i, hypothesis in enumerate(found):
        beside = together if i in chosen else on_top[i]
        if i in chosen:
            judgement = "helps"
        elif i in helpers:
            judgement = "helps, not on top"
        elif min(
            alone[i].in_plane / base.in_plane, beside.in_plane / before.in_plane
        ) < HELPS and not _sensible(hypothesis, beside):
            judgement = "unphysical"
        else:
            judgement = "excluded"
        amounts, sigma, in_plane, position = alone[i]
        out.append(
            Weighed(
                hypothesis.effect, hypothesis.unit, hypothesis.expected, len(amounts),
                _size(amounts), float(np.median(sigma)), in_plane, position, beside.in_plane,
                beside.position, judgement,
            )
        )  # fmt: skip
    return out


def _helps(hypothesis: Hypothesis, answer: "Answer", before: "Answer") -> bool:
    return answer.in_plane < HELPS * before.in_plane and _sensible(hypothesis, answer)


def _size(amounts: Array) -> float:
    return float(np.sqrt(np.mean(amounts**2))) if len(amounts) > 1 else float(amounts[0])


def _sensible(hypothesis: Hypothesis, answer: "Answer") -> bool:
    return abs(_size(answer.amounts)) < hypothesis.most


class Answer(NamedTuple):
    """Amounts of the last hypothesis, their errors, held-out rms without and with a jump, m."""

    amounts: Array
    sigma: Array
    in_plane: float
    position: float


class Fitted:
    """The linearised fit, to which patterns can be added."""

    def __init__(self, run: ResponseRun) -> None:
        self.run = run
        normal, self.start, _ = run.linear(0)
        groups = run.priors(0)
        self.slopes = np.asarray(run.slopes).reshape(-1, *run.data.shape[:2])
        # one that does nothing stands there where no family of errors was kept
        basis = np.zeros((len(self.start), 1))
        basis = np.concatenate([basis, *(g.basis for g in groups)], axis=1)
        scales = [np.full(g.basis.shape[1], g.rms) if g.each is None else g.each for g in groups]
        prior = np.concatenate([np.ones(1), *scales])
        self.spread = basis * prior
        A = self.spread.T @ normal.matrix @ self.spread
        self.factor = cho_factor(A + np.eye(len(A)), lower=True)
        self.vector = self.spread.T @ (normal.vector + normal.matrix @ self.start)
        self.weight = run.weight(0)
        own = run.plane
        gain = np.diagonal(run.state.monitors, axis1=1, axis2=2)[:, own].T
        self.by_monitor = pick(run.kicked(), own)
        self.by_column = gain * pick(run.beam, own)
        self.by_column[-1] = 0
        self.read = pick(run.read(), own)
        # readings by the monitors' and the columns' own parameters, [reading, parameter]
        columns, monitors = self.weight.shape
        reading = np.arange(self.weight.size)
        by_monitor = 2 * (reading % monitors) + np.repeat(own, monitors)
        by_column = 2 * monitors + reading // monitors
        self.own = csr_array(
            (
                np.concatenate([self.by_monitor.ravel(), self.by_column.ravel()]),
                (np.tile(reading, 2), np.concatenate([by_monitor, by_column])),
            ),
            shape=(len(reading), 2 * monitors + columns),
        )
        self._parts: dict[int, _Part] = {}
        residual = np.where(self.weight > 0, pick(run.data, own) - self.read, 0.0)
        self.target = residual + self.change(self.start)

    def change(self, values: Array) -> Array:
        """Readings [column, monitor] for a change of the base parameters."""
        run = self.run
        m, c = 2 * len(run.at), len(run.plane)
        out = values[:m].reshape(-1, 2)[:, run.plane].T * self.by_monitor
        out = out + values[m : m + c, None] * self.by_column
        if len(self.slopes):
            out = out + np.tensordot(values[m + c :], self.slopes, 1)
        return np.asarray(out)

    def across(self, flat: Patterns) -> Array:
        """J^T W H, [base parameter, pattern], of patterns [pattern, reading]."""
        weighted = _scaled(flat, self.weight.ravel())
        ring = self.slopes.reshape(len(self.slopes), self.weight.size).T
        own = _dense(weighted @ self.own)
        return np.concatenate([own, _dense(weighted @ ring)], axis=1).T

    def weigh(self, hypotheses: Sequence[Hypothesis]) -> Answer:
        """What held-out readings say of these hypotheses together."""
        if not hypotheses:  # the same linear step as with one: the fit itself may still move
            moved = cho_solve(self.factor, self.vector)
            in_plane, position = self._score(self.change(self.spread @ moved - self.start), None)
            return Answer(np.zeros(0), np.zeros(0), in_plane, position)
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
        # one or a few amounts are free; many have the scale that the evidence finds, within physics
        owner = np.repeat(np.arange(len(parts)), np.diff(edge))
        many = [len(part.across.T) > FEW for part in parts]
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
        change = self.change(self.spread @ moved - self.start)
        for i, (hypothesis, part) in enumerate(zip(hypotheses, parts, strict=True)):
            if not hypothesis.own:
                change = change + (amounts[owner == i] @ part.flat).reshape(change.shape)
        own = [hypothesis.patterns for hypothesis in hypotheses if hypothesis.own]
        last = owner == len(parts) - 1
        rms, jumped = self._score(change, np.concatenate(own) if own else None)
        return Answer(amounts[last], np.sqrt(variance[last]), rms, jumped)

    def _part(self, hypothesis: Hypothesis) -> "_Part":
        """Its patterns that fitted readings see."""
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
        run = self.run
        read = self.read + change
        data = pick(run.data, run.plane)
        jumps = pick(np.einsum("mij,cmj->cmi", run.state.monitors, run.jumps()), run.plane)
        inside: list[Array] = []
        jumped: list[Array] = []
        for c in np.flatnonzero(run.held):
            patterns = [read[c], *([] if own is None else own[:, c])]
            patterns = [p for p in patterns if np.abs(p).max() > 0]
            seen = np.isfinite(data[c]) & run.good
            near, far = seen & run.half[c], seen & ~run.half[c]
            for more, into in (([], inside), ([jumps[c]], jumped)):
                both = np.stack([*patterns, *more], axis=1)
                scale = np.abs(both[near]).max(axis=0)
                amounts = np.linalg.lstsq(both[near] / scale, data[c, near], rcond=None)[0]
                into.append(data[c, far] - (both[far] / scale) @ amounts)
        return rms_of(inside), rms_of(jumped)


@dataclass(frozen=True)
class _Part:
    """A hypothesis as rows of readings, and what they share with the fit."""

    hypothesis: Hypothesis
    flat: Patterns  # [pattern, reading]
    across: Array


def _scaled(flat: Patterns, by: Array) -> Patterns:
    """Every reading times a number of its own."""
    return csr_array(flat.multiply(by)) if isinstance(flat, csr_array) else flat * by


def _dense(values: Patterns) -> Array:
    return values.toarray() if isinstance(values, csr_array) else np.asarray(values)


def _by_column(patterns: Array) -> csr_array:
    """One parameter for each column that a pattern is not zero in, [parameter, reading]."""
    count, columns, monitors = patterns.shape
    rows = np.repeat(np.arange(count * columns), monitors)
    at = np.tile(np.arange(columns * monitors), count)
    whole = csr_array((patterns.ravel(), (rows, at)), shape=(count * columns, columns * monitors))
    return whole[np.flatnonzero(abs(patterns).max(axis=2).ravel() > 0)]


# --- the hypotheses -------------------------------------------------------------------------------
def _readings(run: ResponseRun, beam: Array) -> Array:
    """Own-plane readings [column, monitor] of the beam's orbit changes [column, monitor, 2]."""
    return pick(np.einsum("mij,cmj->cmi", run.state.monitors, beam), run.plane)


def _kicks(run: ResponseRun) -> Array:
    return np.asarray((run.kicks * (1 + run.state.calibration))[:-1])


def _orders(run: ResponseRun) -> tuple[Array, Array]:
    """Second and third order of the orbit changes for whole steps, [column, monitor, 2]."""
    model, kicks = run.model, _kicks(run)
    f = run.kicks[-1]
    up, down = (
        np.concatenate([
            model.closed_orbits(run.m.correctors, side * kicks),
            model.at_frequency(side * f).readings[None],
        ])[:, run.at]
        for side in (1, -1)
    )  # fmt: skip
    linear = (run.orbits(model) - run.bent) * np.append(1 + run.state.calibration[:-1], 1)[
        :, None, None
    ]
    return (up + down) / 2 - model.readings[run.at], (up - down) / 2 - linear


def _one_sided(run: ResponseRun) -> Hypothesis:
    second, _ = _orders(run)
    return Hypothesis(
        "one-sided steps", "share", "0: two-sided, 1 or -1: one-sided",
        _readings(run, second)[None], most=1.1,
    )  # fmt: skip


def _third_order(run: ResponseRun) -> Hypothesis:
    third = _orders(run)[1]
    third[-1] = 0
    return Hypothesis(
        "third order of two-sided steps", "beyond the model's", "0; -1: none",
        _readings(run, third)[None] / 4, most=2.0,
    )  # fmt: skip


def _corrector_energy(run: ResponseRun) -> Hypothesis:
    ring = run.model.ring
    flat = ResponseModel(ring, 4).response(run.m.correctors)[:, run.at]
    shift = run.orbits(run.model)
    shift[:-1] -= flat * run.kicks[:-1, None, None]
    shift[-1] = 0
    return Hypothesis(
        "corrector's energy shift", "beyond the model's", "0; -1: the energy stays",
        _readings(run, shift)[None], most=1.1,
    )  # fmt: skip


def _position(run: ResponseRun, by_family: bool) -> Hypothesis:
    jumps = _readings(run, run.jumps()) * run.kicks[:, None]
    name = "corrector's field displaced in s"
    if not by_family:
        return Hypothesis(name + ", each", "m", "< 0.05 m", jumps[None], own=True, most=0.05)
    _, members = families([*run.m.correctors, "\0"])
    return Hypothesis(
        name + ", by family", "m", "< 0.05 m", members.T[:, :, None] * jumps[None], most=0.05
    )


def _energy_drift(run: ResponseRun) -> Hypothesis:
    rf = _readings(run, run.beam)[-1]
    pattern = np.where((run.plane == 0)[:, None], rf, 0.0)
    pattern[-1] = 0
    return Hypothesis(
        "drift of the energy", "RF step", "< 1e-3", pattern[None], own=True, most=1e-3
    )


def _orbit_drift(run: ResponseRun) -> Hypothesis:
    """The orbit moves between the readings of a step: whatever kicks it, in each column anew."""
    orbits = _readings(run, run.orbits(run.model))
    waves = np.zeros((WAVES, *orbits.shape))
    for p in (0, 1):
        mine = run.plane == p
        mine[-1] = False
        per_kick = np.nan_to_num(orbits[mine]) / run.kicks[mine, None]
        found = np.linalg.svd(per_kick, full_matrices=False)[2][:WAVES]
        waves[: len(found), mine] = found[:, None] * np.sqrt(found.shape[1])
    return Hypothesis(
        "drift of the orbit (betatron waves)", "m", "< 1e-5", waves, own=True, most=1e-5
    )


def _tune_drift(run: ResponseRun) -> Hypothesis:
    total = np.zeros((2, len(run.plane), len(run.at)))
    focusing = [int(run.ring[name].k1 < 0) for name in run.quadrupoles]
    np.add.at(total, focusing, run.slopes_of("quadrupole_gradient", run.quadrupoles, run.plane))
    total[:, -1] = 0
    return Hypothesis(
        "drift of the gradients (focusing, defocusing)", "relative", "< 1e-4", total, own=True,
        most=1e-4,
    )  # fmt: skip


def _energy_spread(run: ResponseRun) -> Hypothesis | None:
    if "energy_spread" in run.allowed:
        return None  # it is in the fit
    kicks = run.kicks[:-1, None, None]
    per_step = run.model.rf_start[5]
    f = DELTA / per_step
    up, down = (
        run.model.at_frequency(side * f).response(run.m.correctors)[:, run.at] * kicks
        for side in (1, -1)
    )
    curved = np.zeros_like(run.beam)
    curved[:-1] = (up + down - 2 * run.beam[:-1]) / 2 * (ENERGY_SPREAD / DELTA) ** 2
    return Hypothesis(
        "energy spread of the beam", "(1.2e-3)^2", "1", _readings(run, curved)[None], most=3.0
    )


def _energy_offset(run: ResponseRun) -> Hypothesis:
    """The beam's energy is not the magnets': quadrupoles and sextupoles act otherwise."""
    f = DELTA / run.model.rf_start[5]
    up, down = (run.orbits(run.model.at_frequency(side * f)) for side in (1, -1))
    scale = np.append(1 + run.state.calibration[:-1], 1)[:, None, None]
    slope = _readings(run, (up - down) / 2 * scale)
    return Hypothesis("energy offset of the beam", "1e-3", "< 5", slope[None], most=5.0)


def _nonlinear(run: ResponseRun) -> Hypothesis:
    """Two-sided steps: x^3 / 4 of the whole change is left of a cubic reading."""
    cubes = pick(run.read(), run.plane) ** 3 / 4 / MILLIMETRE**2
    rows = np.stack([np.where((run.plane == p)[:, None], cubes, 0.0) for p in (0, 1)])
    return Hypothesis("nonlinear monitors (cubic)", "1/mm2", "< 1e-3", rows, most=1e-3)


def _gradients(
    run: ResponseRun, name: str, effect: str, kind: str, most: float
) -> Hypothesis | None:
    places = [e.name for e in run.ring.elements if e.kind == kind]
    if not places:
        return None
    slopes = run.slopes_of(effect, places, run.plane)
    return Hypothesis(name, "1/m", f"< {most:g}", slopes, most=most)


def _radiation(run: ResponseRun) -> Hypothesis | None:
    pairs = [
        (f"radiation_loss_{kind}s", None)
        for kind in ("bend", "wiggler")
        if any(e.kind == kind for e in run.ring.elements)
    ]
    kicks = _kicks(run)
    rows = []
    for slope in derivatives(run.model, pairs, run.m.correctors):
        beam = slope[:, run.at] * np.append(kicks, run.kicks[-1])[:, None, None]
        rows.append(_readings(run, beam))
    return Hypothesis("radiation in bends, wigglers", "expected loss", "1", np.array(rows), most=3)


def _monitor_position(run: ResponseRun) -> Hypothesis:
    model = run.model
    columns = model.columns(run.m.correctors)
    start = np.vstack([columns.start, model.rf_start])
    behind = np.vstack([columns.pulled * 1.0, np.zeros(model.dimension)])
    after = np.vstack([model.downstream(columns), np.zeros((1, len(model.monitors)), bool)])
    slopes = model.tangents[model.maps.at][:, [1, 3]]
    angle = np.einsum("mai,ci->cma", slopes, start)
    angle = angle + after[:, :, None] * np.einsum("mai,ci->cma", slopes, behind)
    kicks = np.append(_kicks(run), run.kicks[-1])
    flat = _readings(run, angle[:, run.at] * kicks[:, None, None])
    rows = np.zeros((len(run.at), *flat.shape))
    for i in range(len(rows)):
        rows[i, :, i] = flat[:, i]
    return Hypothesis("monitors displaced in s", "m", "< 0.01 m", rows, most=0.01)


def _bend_gradient(run: ResponseRun) -> Hypothesis:
    """By length, for magnets of one length are one type."""
    ring: Ring = run.model.ring
    bends = [i for i, e in enumerate(ring.elements) if e.kind == "bend"]
    kinds = sorted({round(ring.elements[i].length, 3) for i in bends})
    rows = []
    for kind in kinds:
        changed = {
            i: ring.elements[i].changed(k1=ring.elements[i].k1 + BEND_GRADIENT)
            for i in bends
            if round(ring.elements[i].length, 3) == kind
        }
        model = ResponseModel(ring.with_elements(changed))
        slope = (run.orbits(model) - run.orbits(run.model)) / BEND_GRADIENT
        scale = np.append(1 + run.state.calibration[:-1], 1)[:, None, None]
        rows.append(_readings(run, slope * scale))
    return Hypothesis("gradient of bends, by type", "1/m2", "< 1e-3", np.array(rows), most=1e-3)


def _second_order_coupling(run: ResponseRun) -> Hypothesis | None:
    if not run.state.skew.any():
        return None
    causes = [c for c in run.ring_causes() if c.effect != "skew_gradient"]
    change = run.orbits(run.model) - run.orbits(ResponseModel(apply(run.ring, causes)))
    return Hypothesis(
        "coupling to second order", "beyond the model's", "0; -1: none",
        _readings(run, change)[None], most=1.1,
    )  # fmt: skip


HYPOTHESES: dict[str, Callable[[ResponseRun], Hypothesis | None]] = {
    "one_sided_steps": _one_sided,
    "third_order": _third_order,
    "energy_drift": _energy_drift,
    "orbit_drift": _orbit_drift,
    "gradient_drift": _tune_drift,
    "corrector_energy": _corrector_energy,
    "corrector_position_family": lambda run: _position(run, True),
    "corrector_position": lambda run: _position(run, False),
    "energy_spread": _energy_spread,
    "energy_offset": _energy_offset,
    "monitor_nonlinearity": _nonlinear,
    "monitor_position": _monitor_position,
    "wiggler_gradient": lambda run: _gradients(
        run, "gradients of damping wigglers", "insertion_device_focusing", "wiggler", 3e-3
    ),
    "straight_gradient": lambda run: _gradients(
        run, "gradients in straights (markers)", "gradient_absolute", "marker", 2e-3
    ),
    "sextupole_gradient": lambda run: _gradients(
        run, "gradients at sextupoles (orbit)", "gradient_absolute", "sextupole", 2e-3
    ),
    "bend_gradient": _bend_gradient,
    "radiation": _radiation,
    "second_order_coupling": _second_order_coupling,
}
