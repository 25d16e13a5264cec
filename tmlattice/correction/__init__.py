"""Power-supply settings that bring a diagnosed ring to its goal, with the expected gain.

>>> correction = correct(diagnosis)                  # or of the files of `diagnose --lattice-out`
>>> print(correction.report())
"""

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tmlattice.arrays import TINY, Array, Indices, pair
from tmlattice.correction.estimate import Estimate, estimate_of
from tmlattice.correction.first_turn import Threading, estimate_of_turns
from tmlattice.correction.knobs import Knob, chosen_knobs, default_knobs, read_knobs
from tmlattice.correction.result import Correction, Setting
from tmlattice.correction.solve import COUNTS, SIGMAS, Point, drawn, fewest, safest
from tmlattice.correction.targets import OPTICS, THREADING, Targets, rms_of
from tmlattice.diagnosis import Diagnosis
from tmlattice.errors import TmlatticeError, UnstableRingError
from tmlattice.lattice import Ring, load_ring
from tmlattice.measurement import Measurement

__all__ = ["Correction", "Knob", "Setting", "correct", "default_knobs", "read_knobs"]

DRAWS = 200
"""Draws from the posterior: the ends of an interval scatter by a tenth of its half width."""
INTERVAL = (50.0, 15.87, 84.13)
"""Percentiles: the median and the central 68.27 %."""


def correct(
    diagnosis: Diagnosis | Estimate | Ring | Measurement | Sequence[Measurement] | Any,
    *,
    goal: Ring | Any | None = None,
    knobs: Sequence[Knob | str] | str | Path | None = None,
    targets: Iterable[str] | Mapping[str, float | None] | None = None,
    seed: int = 0,
    progress: Callable[[str], Any] = lambda stage: None,
) -> Correction:
    """Return settings of knobs that bring the estimated ring closest to a goal.

    Args:
        diagnosis: of any measurement; or an `Estimate`; or a ring that is taken as certain, as all
            that `load_ring` takes; or measured first turns of a beam that is lost, one measurement
            or several in the order of time, with their kicks in the shots' settings.
        goal: the ring whose optics are wanted, and whose strengths are the present settings of a
            ring that is given as one; None: the diagnosis's design.
        knobs: devices; kinds of `default_knobs`; or the path of a table. None: quadrupole supplies
            and skew quadrupoles, and correctors if the closed orbit is a target.
        targets: names of `TARGETS`, optionally with tolerances. None: the optics, and the closed
            orbit if it was measured.
        seed: of the draws from the posterior.
        progress: called with the name of each stage.

    Raises:
        TmlatticeError: a ring without a goal, or no effective knob.
        ChoiceError, MeasurementError, UnknownNameError: targets or knobs that cannot be used.
        UnstableRingError: the estimated ring, or the goal, stores no beam.
    """
    begun = time.perf_counter()
    goal = None if goal is None else load_ring(goal)
    if targets is None:
        orbit = isinstance(diagnosis, Diagnosis) and "closed_orbit" in diagnosis.measured
        targets = (*OPTICS, "closed_orbit") if orbit else OPTICS
    progress("posterior")
    estimate = _estimate(diagnosis, goal)
    wanted = estimate.settings if goal is None else goal
    compared: Targets | Threading
    if [*targets] == [THREADING]:
        compared = Threading(wanted, targets[THREADING] if isinstance(targets, Mapping) else None)
    else:
        compared = Targets(wanted, targets)
        estimate = estimate.storing()
    devices = chosen_knobs(knobs, estimate.settings, compared.names)
    progress("correction")
    problem = drawn(estimate, devices, compared, DRAWS, seed)
    try:
        begin = problem.begin
    except UnstableRingError as error:
        raise UnstableRingError(f"the estimated ring stores no beam: {error}") from error
    if not begin.slopes.any():
        raise TmlatticeError("no knob changes a target; name others (--knobs, --target)")
    whole, order = fewest(problem)
    end, aversion = safest(begin, whole, order)
    found = _fields(begin, whole, end, aversion, order)
    made = {"lattice": estimate.settings.name, "seed": seed, "draws": DRAWS,
            "knobs": len(devices), "seconds": time.perf_counter() - begun}  # fmt: skip
    return Correction(**found, ring=estimate.settings, provenance=made)


def _estimate(diagnosis: Any, goal: Ring | None) -> Estimate:
    if isinstance(diagnosis, Estimate):
        return diagnosis
    if isinstance(diagnosis, Diagnosis):
        return estimate_of(diagnosis)
    if goal is None:
        raise TmlatticeError("a lattice alone has no goal; give the design (goal=, --design)")
    if isinstance(diagnosis, Measurement):
        diagnosis = [diagnosis]
    if isinstance(diagnosis, list | tuple):
        return estimate_of_turns(goal, diagnosis)
    return Estimate(load_ring(diagnosis), goal)


def _fields(
    begin: Point, whole: Point, end: Point, aversion: float, order: Indices
) -> dict[str, Any]:
    """Fields of the result: the whole correction, and the safe one where all ends."""
    problem, targets = end.problem, end.problem.targets
    now = begin.squares(whole.weights)
    gain = now - (whole if end is begin else end).squares(whole.weights)
    gain /= max(float(now.mean()), TINY)
    refused = _refusal(float(gain.mean()), float(gain.std())) if end is begin else ""
    order = order[:0] if refused else order
    gains = end.gains(order, aversion)
    gains /= max(float(gains.sum()), TINY)
    settings = [
        Setting(knob, amount, knob.setting(amount), own)
        for knob, amount, own in zip(
            (problem.knobs[k] for k in order), end.amounts[order].tolist(), gains.tolist(),
            strict=True,
        )
        if amount
    ]  # fmt: skip
    settings.sort(key=lambda own: -own.gain)
    stays = {
        name: (pair(rms_of(end.errors)[name]), pair(np.median(own, axis=0)))
        for name, own in rms_of(end.open).items()
    }
    shown = targets.names[0] if "beta_beating" not in end.errors else "beta_beating"
    profile = tuple(
        np.moveaxis(
            np.percentile(p.errors[shown] + p.open[shown], INTERVAL, axis=0), 0, -1
        ).tolist()
        for p in (begin, end)
    )
    tunes = {}
    if isinstance(targets, Targets):
        tunes = {"goal": targets.goal["tunes"], "now": begin.shown.values["tunes"],
                 "expected": end.shown.values["tunes"]}  # fmt: skip
    return {
        "settings": tuple(settings),
        "refused": refused,
        "before": _intervals(begin),
        "after": _intervals(end),
        "stays": stays,
        "gains": tuple(
            (n, _expected(end.step(order[:n], aversion)[0], end))
            for n in sorted({*COUNTS, len(order)}) if 0 < n <= len(order)
        ),
        "gain": float(gain.mean()),
        "gain_error": float(gain.std()),
        "tunes": {name: pair(value % 1.0) for name, value in tunes.items()},
        "shown": shown,
        "profile": profile,
        "s": tuple(targets.s.tolist()),
        "targets": targets.tolerance,
        "iterations": 2 if aversion or end.dominated else 1,
        "warnings": tuple(_warnings(begin, whole, end, aversion, settings)),
    }  # fmt: skip


def _refusal(gain: float, error: float) -> str:
    """Why nothing is changed."""
    if gain <= 0:
        return "No setting is changed: these knobs do not bring the ring closer to the goal."
    return (
        f"No setting is changed: the expected gain, {100 * gain:.2g} ± {100 * error:.2g} % of the "
        "squared errors, is too uncertain. Measure more, or name fewer targets (--target)."
    )


def _intervals(point: Point) -> dict[str, Any]:
    """Of the rms of each target over the draws."""
    drawn = {name: errors + point.open[name] for name, errors in point.errors.items()}
    return {name: tuple(map(tuple, np.percentile(rms, INTERVAL, axis=0).T.tolist()))
            for name, rms in rms_of(drawn).items()}  # fmt: skip


def _expected(amounts: Array, end: Point) -> dict[str, tuple[float, float]]:
    """Median rms of the targets with these amounts, linear about the end."""
    change = amounts - end.amounts
    drawn = {name: end.errors[name] + np.tensordot(change, end.by_knobs[name], 1) + end.open[name]
             for name in end.problem.targets.names}  # fmt: skip
    return {name: pair(np.median(rms, axis=0)) for name, rms in rms_of(drawn).items()}


def _warnings(
    begin: Point, whole: Point, end: Point, aversion: float, settings: Sequence[Setting]
) -> Iterable[str]:
    if 0 < aversion < np.inf:
        share = (begin.cost - end.cost) / (begin.cost - whole.cost)
        yield (
            f"the settings have {100 * share:.0f} % of the gain of the most probable correction, "
            "since larger ones may make the ring worse; measure again, and correct the rest"
        )
    elif end.dominated:
        yield "most of what stays are errors of the changes; measure again, and correct them"
    held = [setting.knob.name for setting in settings if setting.at_limit]
    if held:
        yield f"held by their limits: {', '.join(held)}"
    if "tunes" not in end.errors:
        return
    tunes = end.shown.values["tunes"] + end.open["tunes"][:, 0]
    mean, sigma = tunes.mean(axis=0), tunes.std(axis=0)
    for plane, (q, s) in enumerate(zip(mean, sigma, strict=True)):
        near = abs(2 * q - round(2 * q)) / 2
        if near < SIGMAS * s:
            kind = "an integer" if round(2 * q) % 2 == 0 else "a half integer"
            yield f"the expected tune in {'xy'[plane]}, {q % 1:.4f} ± {s:.1g}, may be {kind}"
