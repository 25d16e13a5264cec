"""Each kind of measurement as a part of one diagnosis: its problem and its validation set.

A new kind is a record in `measurement`, a problem in `observe`, and a line in `KINDS`.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from tmlattice.arrays import Array, rms
from tmlattice.beam.closed_orbit import ResponseModel
from tmlattice.beam.model import Model
from tmlattice.beam.rf import rf_of
from tmlattice.beam.stored import StoredBeam
from tmlattice.diagnosis.data_checks import corrected_data, data_checks, raise_if_wrong
from tmlattice.diagnosis.prepare import batch, noise_of, prepare
from tmlattice.effects import Hypothesis
from tmlattice.errors import TmlatticeError
from tmlattice.inference.combined import CombinedProblem
from tmlattice.inference.judgement import Judgement
from tmlattice.inference.problem import Problem
from tmlattice.lattice import Ring
from tmlattice.measurement import (
    AnyMeasurement,
    ClosedOrbit,
    Dispersion,
    Measurement,
    OrbitResponse,
    RfStep,
    TuneReading,
    TurnByTurn,
)
from tmlattice.observe.data import of_measurement
from tmlattice.observe.first_turns import FirstTurns
from tmlattice.observe.noise import scatter
from tmlattice.observe.orbit_response import Errors, Predicted
from tmlattice.observe.orbits import closed_orbits, dispersion
from tmlattice.observe.response_data import HELD, ResponseData, response_data, split_columns
from tmlattice.observe.response_problem import Response
from tmlattice.observe.spectra import Lines
from tmlattice.observe.stored import ModelCache, Stored
from tmlattice.observe.tune_readings import CHROMATICITY, TUNE, tune_readings
from tmlattice.observe.turn_by_turn import ManyTurns, many_turns

NOISE, TURN_NOISE = 2e-6, 2e-5
"""rms of an averaged reading of a stored beam, and of one of one turn, m."""
TURNS, AMPLITUDE = 1000, 3e-4
"""Amplitude of a kicked beam, m, at the BPMs where it is largest."""
KICK, ENERGY_ORBIT = 1e-4, 1.3e-3
"""Kick of each corrector, rad; orbit change by the RF's step, m rms."""


@dataclass(frozen=True)
class PartOptions:
    """Options of the diagnosis that a part needs.

    Attributes:
        ring: the design.
        places: number of places of each effect, for the prior.
        judgement: thresholds.
        holdout: share of shots, or of correctors, that the fit does not see.
        assume: what was written down wrongly everywhere.
        seed: of the split.
        effects: names of those that may be the cause; None: all usual ones.
        radiation: the model of first turns radiates as expected.
        reference: of first turns alone: shots from before, which share the errors of the machine.
        heldout: of first turns alone: the shots that validate, instead of a share.
    """

    ring: Ring
    places: Mapping[str, float]
    judgement: Judgement
    holdout: float = 0.0
    assume: Sequence[str] = ()
    seed: int = 0
    effects: Sequence[str] | None = None
    radiation: bool = False
    reference: Measurement | None = None
    heldout: Measurement | None = None


@dataclass(frozen=True)
class Part:
    """One measurement of several.

    Attributes:
        label: what the user calls it.
        kind: as its folder has it.
        problem: what is fitted.
        heldout: the validation set; None where nothing is held out.
        estimated: whether its noise comes from the data.
        dead: monitors without a signal (1) or with a frozen one (2), (index, which).
        messages: about the data.
        hypotheses: what its readings can determine; None: what the problem sees.
        start: nuisances to start at; None: the problem's own first guess.
        shots: numbers of those of the fit, those of a reference first (None), and of those that
            are held out.
    """

    label: str
    kind: str
    problem: Problem = field(repr=False)
    heldout: Problem | None = field(default=None, repr=False)
    estimated: bool = False
    dead: tuple[tuple[int, float], ...] = ()
    messages: tuple[str, ...] = ()
    hypotheses: tuple[Hypothesis, ...] | None = None
    start: Array | None = field(default=None, repr=False)
    shots: tuple[tuple[int | None, ...], tuple[int, ...]] = ((), ())


def part_of(label: str, measured: AnyMeasurement, options: PartOptions) -> Part:
    """Return a measurement as a part of a diagnosis.

    Raises:
        MeasurementError: data that cannot be used; the sentence names the label.
        UnknownNameError: a monitor that the ring does not have.
    """
    name = kind_of(measured)
    measured = corrected_data(options.ring, measured, options.assume)
    return KINDS[name].part(label, name, measured, options)


def stacked(parts: Sequence[Part], before: Sequence[Part], options: PartOptions) -> CombinedProblem:
    """Measurements with those of a reference as one problem; stored beams of one machine share its
    models."""
    cache = ModelCache()
    first, then = (
        [
            replace(own, cache=cache) if isinstance(own := part.problem, Stored) else own
            for part in some
        ]
        for some in (parts, before)
    )
    starts = tuple(
        own.first if part.start is None else part.start
        for part, own in zip((*parts, *before), (*first, *then), strict=True)
    )
    whole = CombinedProblem.of(first, then)
    return replace(whole, places=options.places, judgement=options.judgement, starts=starts)


def kind_of(measured: AnyMeasurement) -> str:
    """The kind of a measurement, as its folder has it."""
    for name, kind in KINDS.items():
        if isinstance(measured, kind.record):
            return name
    raise TypeError(f"{type(measured).__name__} is no measurement")


# --- the kinds ----
def _first_turns(label: str, kind: str, measured: Any, options: PartOptions) -> Part:
    ring = options.ring
    before, held = (
        corrected_data(ring, own, options.assume) for own in (options.reference, options.heldout)
    )
    messages = data_checks(ring, measured, options.radiation, before)
    measured = batch(ring, measured, messages)
    before, held = (own and batch(ring, own, messages) for own in (before, held))
    if held is None and options.holdout:
        measured, held = measured.split(options.holdout, options.seed)
        if held is None and not options.places:
            messages.append("one shot was measured, so none is held out")
    chosen = (options.radiation, options.effects, options.judgement)
    ready = prepare(ring, measured, before, *chosen)
    estimated = ready.estimated
    if before is not None and estimated:  # the same electronics: from all shots
        noise = scatter(ready.problem.data, ready.before.point.view)
        if np.isfinite(noise).all():
            measured, before = (_with_noise(own, noise) for own in (measured, before))
            ready = prepare(ring, measured, before, *chosen)
    other = None
    if held is not None:
        data = of_measurement(ring, held).with_sigma(np.array(noise_of(ready.problem.data)))
        known = ready.problem.model.assembly.known
        model = Model(ring, data.settings, data.turns, known, active=data.active)
        other = FirstTurns(model=model, data=data, places=options.places)
    earlier: tuple[int | None, ...] = (None,) * (0 if before is None else len(before.shots))
    return Part(
        label, kind, ready.problem, other, estimated, ready.dead, (*messages, *ready.messages),
        ready.hypotheses, ready.before.nuisances,
        ((*earlier, *measured.shots), () if held is None else tuple(held.shots)),
    )  # fmt: skip


def _with_noise(measured: Measurement, noise: Array) -> Measurement:
    """The measurement with this noise, m, [2], where none is stated."""
    stated = np.full((len(measured.monitors), 2), np.nan)
    stated = stated if measured.noise is None else np.asarray(measured.noise)
    return replace(measured, noise=np.where(np.isfinite(stated), stated, noise))


def _response(label: str, kind: str, measured: Any, options: PartOptions) -> Part:
    messages = tuple(data_checks(options.ring, measured))
    data = response_data(options.ring, measured)
    whole = _problem(data, options)
    if not options.holdout:
        return Part(label, kind, whole, messages=messages)
    split = split_columns(data, min(options.holdout, HELD), np.random.default_rng(options.seed))
    held = np.append(split.held[:-1], False)[:, None]
    # half of a held-out corrector's BPMs is fitted, to determine its own kick
    fitted, judges = (
        replace(whole, used=whole.used & which[:, :, None])
        for which in (~held | split.half, held & ~split.half)
    )
    return Part(label, kind, fitted, judges, messages=messages)


def _problem(data: ResponseData, options: PartOptions) -> Response:
    """All readings of a response as a problem."""
    return Response(
        base=Predicted(data, Errors.none(data)).bend(), used=np.isfinite(data.orbits),
        places=options.places, judgement=options.judgement,
    )  # fmt: skip


def _of_stored(
    make: Callable[..., Stored], shots: bool = False
) -> Callable[[str, str, Any, PartOptions], Part]:
    """A kind of a stored beam; with `shots`, some are held out if there are enough of them."""

    def made(label: str, kind: str, measured: Any, options: PartOptions) -> Part:
        held = None
        ids = list(measured.shots) if shots else []
        count = round(options.holdout * len(ids))
        if len(ids) > 2 and count:
            drawn = np.random.default_rng(options.seed).permutation(ids).tolist()
            held, measured = (
                measured.select(shots=sorted(some)) for some in (drawn[:count], drawn[count:])
            )
        problem = make(options.ring, measured, options.places)
        raise_if_wrong(options.ring, measured, problem)
        messages = problem.warnings if isinstance(problem, ManyTurns) else ()
        judges = held and make(options.ring, held, options.places)
        return Part(label, kind, problem, judges, messages=messages)

    return made


# --- simulated measurements: their noise and the amplitude of kicks count ------------------
def _no_orbit(ring: Ring) -> tuple[tuple[str, ...], Array]:
    names = tuple(monitor.name for monitor in ring.monitors)
    return names, np.zeros((len(names), 2))


def _propose_orbit(ring: Ring, options: PartOptions) -> Problem:
    names, nothing = _no_orbit(ring)
    orbit = ClosedOrbit(orbit=nothing[None], monitors=names, noise=nothing + NOISE)
    return closed_orbits(ring, orbit, options.places)


def _propose_dispersion(ring: Ring, options: PartOptions) -> Problem:
    names, nothing = _no_orbit(ring)
    model, rf = ResponseModel(ring), rf_of(ring)
    size = rms(model.rf_response()[:, 0])
    if not size:
        raise TmlatticeError("no dispersion")
    step = RfStep(
        rf.frequency(ring), rf.harmonic, ENERGY_ORBIT / size * rf.frequency(ring), nothing
    )
    proposed = Dispersion(steps=(step,), monitors=names, noise=nothing + NOISE)
    return dispersion(ring, proposed, options.places)


def _propose_tunes(ring: Ring, options: PartOptions) -> Problem:
    two = np.ones((1, 2))
    reading = TuneReading(
        tune=0.25 * two, tune_error=TUNE * two, chromaticity=two,
        chromaticity_error=CHROMATICITY * two,
    )  # fmt: skip
    return tune_readings(ring, reading, options.places)


def _propose_turns(ring: Ring, options: PartOptions) -> Problem:
    names, nothing = _no_orbit(ring)
    beam = StoredBeam(ResponseModel(ring))
    lines = AMPLITUDE * beam.modes / np.abs(beam.modes).max(axis=(0, 1))
    noise = np.full(lines.shape, TURN_NOISE * np.sqrt(2 / TURNS))
    found = Lines(
        names, (0,), beam.tunes[None] % 1, np.full((1, 2), 1e-6), lines[None], noise[None],
        nothing + TURN_NOISE, np.array([TURNS]), np.ones((1, 2, 1), dtype=complex), (),
    )  # fmt: skip
    kicked = TurnByTurn(readings=np.zeros((1, 16, len(names), 2)), monitors=names)
    return many_turns(ring, kicked, options.places, found)


def _propose_response(ring: Ring, options: PartOptions) -> Problem:
    names, nothing = _no_orbit(ring)
    columns = ResponseModel(ring).columns(None)
    count = len(columns.names)
    if not count:
        raise TmlatticeError("no corrector")
    response = OrbitResponse(
        correctors=columns.names, planes=columns.planes, kicks=np.full(count, KICK),
        monitors=names, response=np.broadcast_to(nothing, (count, *nothing.shape)).copy(),
        noise=nothing + NOISE,
    )  # fmt: skip
    return _problem(response_data(ring, response), options)


@dataclass(frozen=True)
class Kind:
    """A kind of measurement.

    Attributes:
        record: its class.
        part: makes it a part of a diagnosis, of its label, kind, record and options; assumed errors
            of the record are corrected.
        quantities: of the stored beam that it contains.
        words: what to measure, as a sentence begins with it.
        proposal: problem of a simulated measurement with the usual noise; None: it is never
            recommended as the next one.
        per_measurement, per_corrector: machine time, minutes: of the whole, and of each corrector.
    """

    record: type
    part: Callable[[str, str, Any, PartOptions], Part]
    quantities: tuple[str, ...] = ()
    words: str = ""
    proposal: Callable[[Ring, PartOptions], Problem] | None = None
    per_measurement: float = 0.0
    per_corrector: float = 0.0

    def minutes(self, ring: Ring) -> float:
        """Machine time of one measurement."""
        correctors = sum(e.is_corrector for e in ring.elements)
        return self.per_measurement + self.per_corrector * correctors


KINDS: Mapping[str, Kind] = {
    "trajectory": Kind(Measurement, _first_turns),
    "closed_orbit": Kind(
        ClosedOrbit, _of_stored(closed_orbits, shots=True), ("closed_orbit",),
        "A closed orbit", _propose_orbit, 0.5,
    ),
    "tunes": Kind(
        TuneReading, _of_stored(tune_readings), ("tunes",),
        "Tunes and chromaticities", _propose_tunes, 2.0,
    ),
    "turn_by_turn": Kind(
        TurnByTurn, _of_stored(many_turns, shots=True), ("closed_orbit", "tunes"),
        "Turns of the stored beam after a kick", _propose_turns, 2.0,
    ),
    "dispersion": Kind(
        Dispersion, _of_stored(dispersion), ("dispersion",),
        "The dispersion", _propose_dispersion, 3.0,
    ),
    "orbit_response": Kind(
        OrbitResponse, _response, (), "An orbit response", _propose_response,
        per_corrector=0.2,  # two settings and their orbits
    ),
}  # fmt: skip
"""Every kind, by the name that a folder states."""
