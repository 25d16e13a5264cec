"""Effects that may be missing from a fitted orbit response, as patterns of readings.

To add one, write a function that returns its patterns at the fit, and add it to `HYPOTHESES`. What
is a family of the fit is none: every fit tests it.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.polynomial.legendre import legvander

from tmlattice.arrays import Array
from tmlattice.diagnosis.families.fields import QuadrupoleGradient
from tmlattice.diagnosis.response.state import State
from tmlattice.effects import apply
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
