"""Cases of any kinds of measurement: faults, measurements by AT, problems, and signal to noise.

A signal to noise is the norm of the finite change of all rows over their noise, nuisances projected
out. With distributed errors the noise is that of both (Mahalanobis).
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from tmlattice.arrays import Array
from tmlattice.beam.model import Model
from tmlattice.challenge.case import BEFORE, Case, Truth, ring_of
from tmlattice.challenge.draw import Draw
from tmlattice.diagnosis.kinds import part_of, stacked
from tmlattice.diagnosis.options import Options
from tmlattice.effects import Cause, Effect, LaunchEffect, Settings, find, modelled
from tmlattice.errors import TmlatticeError
from tmlattice.inference.combined import CombinedProblem
from tmlattice.inference.distributed import DistributedErrors, fit_distributed_errors
from tmlattice.inference.judgement import DEFAULT
from tmlattice.inference.newton import fit
from tmlattice.inference.problem import Problem
from tmlattice.lattice import Ring
from tmlattice.machine import simulate, stored_beam
from tmlattice.machine.machine import StoredSimulation
from tmlattice.machine.response import NOISE, simulate_response
from tmlattice.machine.shots import stream
from tmlattice.measurement import AnyMeasurement
from tmlattice.observe.data import Data, of_measurement
from tmlattice.observe.first_turns import FirstTurns

TIER_KINDS: Mapping[str, tuple[str, ...]] = {
    "R": ("orbit_response",),
    "T": ("turn_by_turn",),
    "P": ("orbit_response",),
    "M": ("trajectory", "turn_by_turn", "closed_orbit", "dispersion", "tunes"),
}
"""Measurements of a tier; M draws two or three of several for each case."""

FAINTER, LOUDER = 0.5, 2.0
"""Range of a case's noise in units of the kind's usual noise, log-uniform."""

TURNS = 500
"""Turns of a stored beam."""

UNKNOWN_LAUNCH = (np.inf, np.inf, np.inf, np.inf, 0.0)

READING_NOISE = 2e-5
"""m; noise of a first turn."""

CHANGES = (
    ("quadrupole_gradient",), ("family_gradient",), ("insertion_device_focusing",),
    ("family_sextupole",), ("corrector_calibration",), ("monitor_gain_x", "monitor_gain_y"),
)  # fmt: skip
"""Possible differences of a pair, drawn uniformly."""


@dataclass(frozen=True)
class CaseSettings:
    """Settings of every case of a challenge.

    Attributes:
        kinds: see `TIER_KINDS`.
        effects: drawn from these; None: from all usual ones.
        signal, amount: see `Draw`.
    """

    tier: str
    lattice: str
    ring: Ring
    seed: int
    kinds: tuple[str, ...]
    effects: tuple[str, ...] | None
    shots: int
    signal: tuple[float, float]
    amount: float | None
    background: Mapping[str, float]
    known_rms: bool


# --- the machine ----------------------------------------------------------------------------------
def measure(
    kind: str, ring: Ring, causes: Sequence[Cause], noise: float, shots: int, **own: Any
) -> AnyMeasurement:
    """Return one measurement of a machine by AT."""
    if kind == "trajectory":
        own |= {"shots": shots, "noise": noise * READING_NOISE}
        return simulate(ring, causes, **own).measurement()
    usual: Mapping[str, tuple[Callable[..., StoredSimulation], Any]] = {
        "turn_by_turn": (stored_beam.simulate_turns, stored_beam.TURN_NOISE),
        "closed_orbit": (stored_beam.simulate_orbits, NOISE),
        "dispersion": (stored_beam.simulate_dispersion, NOISE),
        "tunes": (stored_beam.simulate_tunes, stored_beam.TUNE_NOISE),
        "orbit_response": (partial(simulate_response, progress=False), NOISE),
    }
    simulated, rms = usual[kind]
    if kind == "turn_by_turn":
        own |= {"shots": shots, "turns": TURNS}
    measured: AnyMeasurement = simulated(ring, causes, noise=noise * np.array(rms), **own).measured
    return measured


# --- rows -----------------------------------------------------------------------------------------
def problem_of(
    ring: Ring,
    measured: Mapping[str, AnyMeasurement],
    before: Mapping[str, AnyMeasurement],
    background: Mapping[str, float],
) -> Problem:
    """Return measurements as a problem, with distributed errors of known sizes if there are any."""
    options = Options(ring, _places(ring, turns=True), DEFAULT)
    first, then = (
        [part_of(label, one, options) for label, one in some.items()] for some in (measured, before)
    )
    return _among(stacked(first, then, options), ring, background)


def problem_of_case(
    case: Case, background: Mapping[str, float], given: Sequence[Cause] = ()
) -> Problem:
    """Return the measurements of a case as a problem; see `problem_of`."""
    ring = ring_of(case.lattice)
    if case.kinds:
        return problem_of(ring, case.measured, case.before, background)
    first = of_measurement(ring, case.fit)
    then = [] if case.reference is None else [of_measurement(ring, case.reference)]
    return _among(_first_turns(ring, first, then).with_fixed(given), ring, background)


def quiet_problem(
    ring: Ring,
    launches: Array,
    settings: Sequence[Settings],
    noise: float,
    background: Mapping[str, float],
    reference: int,
) -> Problem:
    """Return the problem of first turns that agree with the design.

    Args:
        launches: true ones, those of a reference first, [shot, 5].
        noise: rms of a reading, m.
    """
    some = []
    for shots in (slice(reference, None), slice(reference))[: 1 + bool(reference)]:
        own = tuple(settings[shots])
        readings = Model(ring, own).readings(launches[shots])
        unknown = np.tile(UNKNOWN_LAUNCH, (len(own), 1))
        some.append(Data(
            np.nan_to_num(readings), np.isfinite(readings), np.full(readings.shape, noise),
            launches[shots], unknown, own, 1,
        ))  # fmt: skip
    first, *then = some
    return _among(_first_turns(ring, first, then), ring, background)


def _first_turns(ring: Ring, first: Data, then: Sequence[Data]) -> CombinedProblem:
    """First turns, and those of a reference."""
    own, *before = (
        FirstTurns(model=Model(ring, data.settings), data=data, places=_places(ring))
        for data in (first, *then)
    )
    return CombinedProblem.of([own], before)


def _places(ring: Ring, turns: bool = False) -> dict[str, float]:
    return {name: float(max(len(find(name).places(ring)), 1)) for name in modelled(turns=turns)}


def _among(problem: Problem, ring: Ring, background: Mapping[str, float]) -> Problem:
    """The problem with distributed errors of known sizes."""
    if not background:
        return problem
    everywhere = [
        (name, place) for name in background for place in find(name).places(ring)
        if problem.sees((name, place))
    ]  # fmt: skip
    known = DistributedErrors.usual(everywhere, background)
    return fit_distributed_errors(problem, known, problem.first, learn=False).problem


class Ruler:
    """Signal to noise by the model."""

    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        self.start = fit(problem, (), problem.first)

    def of(self, causes: Sequence[Cause]) -> float:
        """Return that of causes by the model; NaN if the beam does not survive them."""
        seen = [c for c in causes if self.problem.sees((c.effect, c.element))]
        point = self.problem.at(seen, self.start.nuisances)
        if point.lost:
            return float("nan")
        return self._norm(self.start.residual - point.residual)

    def size(self, change: Array) -> float:
        """Return that of a change of the readings, of the first ones of the problem, m."""
        whole = np.zeros(self.problem.valid.size)
        whole[: change.size] = np.nan_to_num(change).ravel()
        return self._norm(self.problem.as_rows(whole))

    def _norm(self, rows: Array) -> float:
        return float(np.linalg.norm(self.start.projection.out(rows)))


# --- a case ---------------------------------------------------------------------------------------
def kinds_case(asked: CaseSettings, number: int, name: str) -> tuple[Case, Truth, Draw]:
    """Return the public and the secret part of a case, and the rejected draws."""
    random = stream(asked.seed, "challenge", asked.tier, number)
    seed = int(random.integers(2**31))
    noise = float(np.exp(random.uniform(np.log(FAINTER), np.log(LOUDER))))
    kinds = asked.kinds
    if asked.tier == "M" and len(kinds) > 2:
        some = random.permutation(len(kinds))[: int(random.integers(2, 4))]
        kinds = tuple(kinds[i] for i in sorted(some))
    ring, background = asked.ring, dict(asked.background)
    pair = asked.tier == "P"

    def machine(causes: Sequence[Cause], again: int) -> dict[str, AnyMeasurement]:
        own: dict[str, Any] = {"seed": seed + again, "machine_seed": seed}
        if background:
            own["background"] = background
        return {kind: measure(kind, ring, causes, noise, asked.shots, **own) for kind in kinds}

    healthy = machine((), 1)
    draw = Draw(random, asked.signal, asked.amount)
    causes: tuple[Cause, ...] = ()
    alone: dict[str, float] = {}
    total, measured = 0.0, healthy
    if asked.tier != "E":
        ruler = Ruler(problem_of(ring, healthy, healthy if pair else {}, background))
        causes, measured = _drawn(
            replace(asked, kinds=kinds), draw, ruler, lambda some: machine(some, 0)
        )
        total = ruler.of(causes)
        if len(kinds) > 1:
            for kind in kinds:
                own = Ruler(problem_of(ring, {kind: healthy[kind]}, {}, background))
                alone[kind] = own.of(causes)
    parts = {**measured, **({BEFORE + kind: healthy[kind] for kind in kinds} if pair else {})}
    options = {"background": background} if background and asked.known_rms else {}
    case = Case(name, asked.lattice, parts, options, kinds)
    truth = Truth(
        name, asked.tier, causes, None, (total,) * len(causes), total, background, 0.0, noise, seed,
        {}, {}, alone,
    )  # fmt: skip
    return case, truth, draw


def _drawn(
    asked: CaseSettings,
    draw: Draw,
    ruler: Ruler,
    machine: Callable[[Sequence[Cause]], dict[str, AnyMeasurement]],
) -> tuple[tuple[Cause, ...], dict[str, AnyMeasurement]]:
    """Draw a fault, and measure it."""
    for _ in range(100):
        causes = _pair(asked, draw, ruler) if asked.tier == "P" else _single(asked, draw, ruler)
        if causes is None:
            continue
        try:
            return causes, machine(causes)
        except TmlatticeError:  # no beam survives it in AT
            draw.unreachable.append((causes[0].effect, causes[0].element, float("nan")))
    raise TmlatticeError("no fault leaves a beam that can be measured; take a smaller signal")


def _single(asked: CaseSettings, draw: Draw, ruler: Ruler) -> tuple[Cause, ...]:
    def places(effect: Effect) -> Sequence[str | None]:
        return [p for p in effect.places(asked.ring) if ruler.problem.sees((effect.name, p))]

    chosen = modelled(asked.effects, "turn_by_turn" in asked.kinds)
    usual = [name for name in chosen if not isinstance(find(name), LaunchEffect)]
    return (draw.one(ruler, usual, places),)


def _pair(asked: CaseSettings, draw: Draw, ruler: Ruler) -> tuple[Cause, ...] | None:
    random, ring = draw.random, asked.ring
    names = CHANGES[int(random.integers(len(CHANGES)))]
    effect = find(names[int(random.integers(len(names)))])
    places: list[str | None] = list(effect.places(ring))
    if effect.name not in (asked.effects or names) or not places:
        return None
    place = places[int(random.integers(len(places)))]
    cap = effect.largest * float(random.choice([-1.0, 1.0]))
    return draw.sized(ruler, [Cause(effect.name, place, cap)], draw.target())
