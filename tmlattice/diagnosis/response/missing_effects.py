"""Effects missing from a fitted orbit response, by its log evidence.

>>> fit = fit_families(data, split)
>>> for row in weigh(fit.state): print(row.effect, row.amount, row.amount_sigma, row.judgement)

A hypothesis is a set of patterns, the derivatives of the readings by its numbers. They join the
numbers of the fit, linearised, and the marginal likelihood of the fitted readings decides, as on
families of errors. Held-out readings are predicted with each; numbers of their own columns, which
no fitted reading determines, are zero.

To add a hypothesis, add a row to `HYPOTHESES`, with a function that returns its patterns at the
fit. What is a family of the fit, or beam jitter, is none: every fit tests it.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.polynomial.legendre import legvander

from tmlattice.arrays import Array, rms
from tmlattice.diagnosis.families.fields import QuadrupoleGradient
from tmlattice.diagnosis.response.linear import Linear, linear, with_numbers
from tmlattice.diagnosis.response.rounds import REQUIRED, relearnt
from tmlattice.diagnosis.response.state import State, amplitudes, rms_of
from tmlattice.diagnosis.response.validation import held_out
from tmlattice.diagnosis.response.weights import weight
from tmlattice.effects import apply
from tmlattice.inference.judgement import ENOUGH
from tmlattice.inference.normal import Posterior
from tmlattice.observe.orbit_response import DELTA

BEND_GRADIENT = 1e-4
"""Step of finite differences, 1/m2."""
MILLIMETRE = 1e-3
ORDERS = 3
"""Order of the polynomial of a drift over all columns."""
PRIOR = "missing: "
"""Beginning of the names of their priors: families have such names, too."""
WAVES = 4
"""Number of leading closed orbits of random kicks in a plane."""


@dataclass(frozen=True)
class MissingEffect:
    """An effect that may be missing.

    Attributes:
        effect: its name.
        unit: of the amounts.
        expected: physically plausible amounts.
        most: largest plausible amount: the prior rms of a few numbers, and the largest one of many,
            whose scale is learnt.
        patterns: returns d reading / d amount in each column's own plane at the fit, m,
            [number, column, monitor]; no number where the ring does not have the effect.
    """

    effect: str
    unit: str
    expected: str
    most: float
    patterns: Callable[[State], Array]


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


def _one_sided(state: State) -> Array:
    return _readings(state, _orders(state)[0])[None]


def _third_order(state: State) -> Array:
    third = _orders(state)[1]
    third[-1] = 0
    return _readings(state, third)[None] / 4


def _corrector_energy(state: State) -> Array:
    model, names = state.at.model, state.data.measured.correctors
    own = model.rf_response() / model.rf_start[5]
    flat = model.response(names) - model.columns(names).start[:, 5, None, None] * own
    shift = state.at.orbits(model)
    shift[:-1] -= flat[:, state.data.at] * state.data.kicks[:-1, None, None]
    shift[-1] = 0
    return _readings(state, shift)[None]


def _each(patterns: Array) -> Array:
    """A number of its own for each column, [pattern x column, column, monitor]."""
    count, columns, monitors = patterns.shape
    rows = np.zeros((count, columns, columns, monitors))
    rows[:, np.arange(columns), np.arange(columns)] = patterns
    return rows.reshape(-1, columns, monitors)


def _position(state: State) -> Array:
    """The position of the field of each corrector."""
    rows = _readings(state, state.at.jumps) * state.data.kicks[:, None]
    return _each(rows[None])


def _in_time(state: State, patterns: Array, constant: bool = True) -> Array:
    """Patterns of a smooth drift over the columns in the order of time, without the RF's.

    Args:
        state: of the fit.
        patterns: of a drift in single columns, [pattern, column, monitor].
        constant: whether it includes a part that is equal in all columns.
    """
    orders = legvander(np.linspace(-1, 1, len(state.data.kicks) - 1), ORDERS).T
    orders = np.pad(orders[0 if constant else 1 :], ((0, 0), (0, 1)))
    rows = patterns[:, None] * orders[:, :, None]
    return np.asarray(rows.reshape(-1, *rows.shape[2:]))


def _energy_in_time(state: State) -> Array:
    """A drift of the energy during the steps."""
    rf = _readings(state, state.at.beam)[-1]
    pattern = np.where((state.data.plane == 0)[:, None], rf, 0.0)
    return _in_time(state, pattern[None])


def _orbit_in_time(state: State) -> Array:
    """Closed orbits between the readings of a step, as by random kicks."""
    orbits = _readings(state, state.at.orbits(state.at.model))
    waves = np.zeros((2, WAVES, *orbits.shape))
    for p in (0, 1):
        mine = state.data.plane == p
        mine[-1] = False
        per_kick = np.nan_to_num(orbits[mine]) / state.data.kicks[mine, None]
        found = np.linalg.svd(per_kick, full_matrices=False)[2][:WAVES]
        waves[p, : len(found), mine] = found * np.sqrt(found.shape[1])
    return _in_time(state, waves.reshape(-1, *orbits.shape))


def _gradients(state: State) -> Array:
    """Derivatives by all focusing, and by all defocusing, gradients, without the RF's."""
    total = np.zeros((2, len(state.data.plane), len(state.data.at)))
    single = QuadrupoleGradient()
    focusing = [int(state.data.ring[name].k1 < 0) for name in single.places(state.data)]
    np.add.at(total, focusing, single.rows(state.at, np.zeros(len(focusing))))
    total[:, -1] = 0
    return total


def _chromatic_in_time(state: State) -> Array:
    """A drift of the beam's energy over all columns, which changes the tunes and the optics."""
    scale = (1 + state.at.errors.calibration)[:, None, None] * DELTA
    slope = _readings(state, state.at.chromatic * scale)[None]
    return _in_time(state, slope, constant=False)


def _hysteresis(state: State) -> Array:
    """Hysteresis: a corrector's iron keeps a share of its step in later columns, of the last step
    alone or of all earlier ones."""
    last = np.zeros_like(state.at.read)
    last[1:-1] = state.at.read[:-2]
    rows = np.stack([state.data.pick(stays) for stays in (last, np.cumsum(last, axis=0))])
    rows[:, -1] = 0  # the RF's
    return rows


def _nonlinear(state: State) -> Array:
    """Cubic BPMs with two-sided steps: x^3 / 4 of the whole change."""
    cubes = state.data.pick(state.at.read) ** 3 / 4 / MILLIMETRE**2
    return np.stack([np.where((state.data.plane == p)[:, None], cubes, 0.0) for p in (0, 1)])


def _radiation(state: State) -> Array:
    pairs = [
        (f"radiation_loss_{kind}s", None)
        for kind in ("bend", "wiggler")
        if any(e.kind == kind for e in state.data.ring.elements)
    ]
    return np.array([_readings(state, slope) for slope in state.at.slopes(pairs)])


def _monitor_position(state: State) -> Array:
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
    return rows


def _bend_gradient(state: State) -> Array:
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
    return np.array(rows)


def _second_order_coupling(state: State) -> Array:
    if not state.values.get("skew", np.zeros(1)).any():
        return np.zeros((0, *state.data.shape))
    causes = [c for c in state.at.errors.ring if c.effect != "skew_gradient"]
    flat = state.at.model.changed_to(apply(state.data.ring, causes))
    change = state.at.orbits(state.at.model) - state.at.orbits(flat)
    return _readings(state, change)[None]


HYPOTHESES: dict[str, MissingEffect] = {
    "one_sided_steps": MissingEffect(
        "one-sided steps", "share", "0: two-sided, 1 or -1: one-sided", 1.1, _one_sided
    ),
    "third_order": MissingEffect(
        "third order of two-sided steps", "beyond the model's", "0; -1: none", 2.0, _third_order
    ),
    "gradient_drift": MissingEffect(
        "drift of the gradients (focusing, defocusing)", "relative", "< 1e-4", 1e-4,
        lambda state: _each(_gradients(state)),
    ),
    "energy_in_time": MissingEffect(
        "drift of the energy in order of time", "RF step", "< 1e-3", 1e-3, _energy_in_time
    ),
    "orbit_in_time": MissingEffect(
        "drift of the orbit in order of time", "m", "< 1e-5", 1e-5, _orbit_in_time
    ),
    "gradients_in_time": MissingEffect(
        "drift of the gradients in order of time", "relative", "< 1e-4", 1e-4,
        lambda state: _in_time(state, _gradients(state), constant=False),
    ),
    "chromatic_in_time": MissingEffect(
        "drift of the beam's energy in order of time", "1e-3", "< 5", 5.0, _chromatic_in_time
    ),
    "hysteresis": MissingEffect(
        "hysteresis: a share of earlier steps", "share", "< 0.01", 0.01, _hysteresis
    ),
    "corrector_energy": MissingEffect(
        "corrector's energy shift", "beyond the model's", "0; -1: the energy stays", 1.1,
        _corrector_energy,
    ),
    "corrector_position": MissingEffect(
        "corrector's field displaced in s, each", "m", "< 0.05 m", 0.05, _position
    ),
    "monitor_nonlinearity": MissingEffect(
        "nonlinear BPMs (cubic)", "1/mm2", "< 1e-3", 1e-3, _nonlinear
    ),
    "monitor_position": MissingEffect(
        "BPMs displaced in s", "m", "< 0.01 m", 0.01, _monitor_position
    ),
    "bend_gradient": MissingEffect(
        "gradient of bends, by type", "1/m2", "< 1e-3", 1e-3, _bend_gradient
    ),
    "radiation": MissingEffect("radiation in bends, wigglers", "expected loss", "1", 3, _radiation),
    "second_order_coupling": MissingEffect(
        "coupling to second order", "beyond the model's", "0; -1: none", 1.1,
        _second_order_coupling,
    ),
}  # fmt: skip


@dataclass(frozen=True)
class Weighed:
    """A hypothesis and its scores.

    Attributes:
        effect, unit, expected: see `MissingEffect`.
        parameters: the number of its numbers that fitted readings depend on.
        amount: with it alone; of several, their rms.
        amount_sigma: its posterior rms; of several, the median one.
        heldout_rms_in_plane: with it alone, m; see `Step`. Numbers of single held-out columns are
            zero.
        evidence: gain of log evidence with it alone.
        evidence_on_top: and given the others that help.
        judgement: "helps": gains log evidence given the others that help, with a plausible amount;
            "helps, not on top": alone; "unphysical": with an implausible amount; "excluded".
    """

    effect: str
    unit: str
    expected: str
    parameters: int
    amount: float
    amount_sigma: float
    heldout_rms_in_plane: float
    evidence: float
    evidence_on_top: float
    judgement: str


def weigh(
    state: State,
    wanted: Iterable[str] | None = None,
    progress: Callable[[str], Any] = lambda stage: None,
) -> list[Weighed]:
    """Return the scores of every hypothesis alone and given the others. The first row is the fit;
    its `evidence_on_top` is of all that help, together.

    Plausible ones are accepted one by one, that with the most evidence first, as long as each gains
    enough given those before; those that no longer do are left out again.

    Args:
        state: of the fit.
        wanted: names of `HYPOTHESES`; None: all.
        progress: called with each name.
    """
    there, found = linear(state, 0), dict[str, MissingEffect]()
    used = weight(state, 0)
    for name in HYPOTHESES if wanted is None else wanted:
        progress(name)
        own = HYPOTHESES[name]
        patterns = own.patterns(state)
        sensitive = [bool(np.any(row * used)) for row in patterns]
        if not any(sensitive):  # no such places, or no sensitive fitted readings
            continue
        rows, many = own.most * patterns[sensitive], sum(sensitive) > ENOUGH
        there = with_numbers(there, state, 0, PRIOR + name, rows, learnt=many)
        found[name] = own

    def with_these(*names: str) -> tuple[float, Posterior]:
        return relearnt(there, {PRIOR + name for name in found.keys() - names})

    def amount(fit: Posterior, name: str) -> float:
        own = found[name].most * fit.values[there.where[PRIOR + name]]
        return float(own[0]) if len(own) == 1 else rms(own)

    without, fit = with_these()
    first = Weighed("none", "", "", 0, 0.0, 0.0, _heldout(state, there, fit), 0.0, 0.0, "")
    alone, on_top = dict[str, Weighed](), dict[str, float]()
    for name, own in found.items():
        progress(own.effect)
        evidence, fit = with_these(name)
        sigma = own.most * fit.sigma[there.where[PRIOR + name]]
        on_top[name] = evidence - without
        alone[name] = Weighed(
            own.effect, own.unit, own.expected, len(sigma), amount(fit, name),
            float(np.median(sigma)), _heldout(state, there, fit), on_top[name], on_top[name], "",
        )  # fmt: skip
    physical = {name for name, row in alone.items() if abs(row.amount) < found[name].most}
    plausible, chosen, together = physical, list[str](), without
    for _ in found:
        best = max(plausible - {*chosen}, key=on_top.__getitem__, default=None)
        if best is None or on_top[best] <= REQUIRED:
            break
        chosen.append(best)
        while chosen:  # without those that it replaces
            together = with_these(*chosen)[0]
            for name in chosen:
                on_top[name] = together - with_these(*{*chosen} - {name})[0]
            least = min(chosen, key=on_top.__getitem__)
            if on_top[least] > REQUIRED:
                break
            chosen.remove(least)
        else:
            together = without
        plausible = set()
        for name in found.keys() - chosen:
            progress(found[name].effect)
            evidence, fit = with_these(*chosen, name)
            on_top[name] = evidence - together
            if abs(amount(fit, name)) < found[name].most:
                plausible.add(name)
    out = [replace(first, evidence_on_top=together - without)]
    for name, row in alone.items():
        judgement = "excluded"
        if name in chosen:
            judgement = "helps"
        elif on_top[name] > REQUIRED:
            judgement = "unphysical"
        elif row.evidence > REQUIRED:
            judgement = "helps, not on top" if name in physical else "unphysical"
        out.append(replace(row, evidence_on_top=on_top[name], judgement=judgement))
    return out


def _heldout(state: State, there: Linear, fit: Posterior) -> float:
    """The rms residual of held-out correctors in plane, m, see `validation.score`."""
    data = state.data
    columns, near, far = held_out(state)
    read = data.pick(state.at.read) + there.readings(data.plane, fit.values - there.start)
    orbits = data.pick(data.orbits)[columns]
    return rms_of(amplitudes(read[columns, :, None], orbits, near)[1][far])
