"""Each kind of measurement as a part of one diagnosis: its problem and its validation set.

A new kind is a record in `measurement`, a problem in `observe`, and a line in `KINDS`.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from tmlattice.arrays import Array, rms
from tmlattice.beam.closed_orbit import ResponseModel
from tmlattice.beam.model import Model, Paths
from tmlattice.beam.rf import rf_of
from tmlattice.beam.stored import StoredBeam
from tmlattice.diagnosis.data_checks import corrected_data, data_checks
from tmlattice.diagnosis.options import Options
from tmlattice.diagnosis.prepare import Part, batch, noise_of, prepare
from tmlattice.errors import TmlatticeError
from tmlattice.inference.combined import CombinedProblem
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
from tmlattice.observe.data import Data, of_measurement
from tmlattice.observe.first_turns import FirstTurns
from tmlattice.observe.noise import estimate, scatter
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


def part_of(label: str, measured: AnyMeasurement, options: Options) -> Part:
    """Return a measurement as a part of a diagnosis.

    Raises:
        MeasurementError: data that cannot be used; the sentence names the label.
        UnknownNameError: a monitor that the ring does not have.
    """
    name = kind_of(measured)
    measured = corrected_data(options.ring, measured, options.assume)
    return KINDS[name].part(label, name, measured, options)


def stacked(parts: Sequence[Part], before: Sequence[Part], options: Options) -> CombinedProblem:
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
def _first_turns(label: str, kind: str, measured: Any, options: Options) -> Part:
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
    both = [prepare(ring, own, *chosen) for own in (measured, before) if own is not None]
    estimated = any(own.estimated for own in both)
    if before is not None and estimated:  # the same electronics: from all shots
        ways = [_data_and_paths(own) for own in both]
        noise = scatter(ways)
        noise = noise if np.isfinite(noise).all() else estimate(ways)
        both = [prepare(ring, _with_noise(own, noise), *chosen) for own in (measured, before)]
    ready, *earlier = both
    turns = ready.problem
    assert isinstance(turns, FirstTurns)
    other = None
    if held is not None:
        data = of_measurement(ring, held).with_sigma(np.array(noise_of(turns.data)))
        known = turns.model.assembly.known
        model = Model(ring, data.settings, data.turns, known)
        other = FirstTurns(model=model, data=data, places=options.places)
    for own in earlier:
        more = [one for one in own.messages if one not in ready.messages]
        more += [
            f"BPM '{ring.monitors[m].name}' has no signal or a frozen one, and is not used"
            for m, _ in own.dead if m not in dict(ready.dead)
        ]  # fmt: skip
        messages += [f"of the reference: {one}" for one in more]
    return replace(
        ready, label=label, heldout=other, estimated=estimated, reference=next(iter(earlier), None),
        messages=(*messages, *ready.messages),
        shots=(tuple(measured.shots), () if held is None else tuple(held.shots)),
    )  # fmt: skip


def _data_and_paths(part: Part) -> tuple[Data, Paths]:
    """The readings of first turns, and the trajectories of their fitted launches."""
    assert isinstance(part.problem, FirstTurns)
    assert part.start is not None
    return part.problem.data, part.problem.at((), part.start).view


def _with_noise(measured: Measurement, noise: Array) -> Measurement:
    """The measurement with this noise, m, [2], where none is stated."""
    stated = np.full((len(measured.monitors), 2), np.nan)
    stated = stated if measured.noise is None else np.asarray(measured.noise)
    return replace(measured, noise=np.where(np.isfinite(stated), stated, noise))


def _response(label: str, kind: str, measured: Any, options: Options) -> Part:
    messages = tuple(data_checks(options.ring, measured))
    data = response_data(options.ring, measured)
    whole = _problem(data, options)
    if not options.holdout:
        return Part(label, kind, whole, messages=messages)
    split = split_columns(data, min(options.holdout, HELD), np.random.default_rng(options.seed))
    held = np.append(split.held[:-1], False)[:, None]
    # half of a held-out corrector's BPMs is fitted, to determine its own kick
    fitted, heldout = (
        replace(whole, used=whole.used & which[:, :, None])
        for which in (~held | split.half, held & ~split.half)
    )
    return Part(label, kind, fitted, heldout, messages=messages)


def _problem(data: ResponseData, options: Options) -> Response:
    """All readings of a response as a problem."""
    return Response(
        base=Predicted(data, Errors.none(data)).bend(), used=np.isfinite(data.orbits),
        places=options.places, judgement=options.judgement,
    )  # fmt: skip


def _of_stored(
    make: Callable[..., Stored], shots: bool = False
) -> Callable[[str, str, Any, Options], Part]:
    """A kind of a stored beam; with `shots`, some are held out if there are enough of them."""

    def made(label: str, kind: str, measured: Any, options: Options) -> Part:
        held = None
        ids = list(measured.shots) if shots else []
        count = round(options.holdout * len(ids))
        if len(ids) > 2 and count:
            drawn = np.random.default_rng(options.seed).permutation(ids).tolist()
            held, measured = (
                measured.select(shots=sorted(some)) for some in (drawn[:count], drawn[count:])
            )
        problem = make(options.ring, measured, options.places)
        messages = data_checks(options.ring, measured, problem=problem)
        messages += problem.warnings if isinstance(problem, ManyTurns) else ()
        heldout = held and make(options.ring, held, options.places)
        return Part(label, kind, problem, heldout, messages=tuple(messages))

    return made


# --- simulated measurements: their noise and the amplitude of kicks count ------------------
def _no_orbit(ring: Ring) -> tuple[tuple[str, ...], Array]:
    names = tuple(monitor.name for monitor in ring.monitors)
    return names, np.zeros((len(names), 2))


def _propose_orbit(ring: Ring, options: Options) -> Problem:
    names, nothing = _no_orbit(ring)
    orbit = ClosedOrbit(orbit=nothing[None], monitors=names, noise=nothing + NOISE)
    return closed_orbits(ring, orbit, options.places)


def _propose_dispersion(ring: Ring, options: Options) -> Problem:
    names, nothing = _no_orbit(ring)
    model, rf = ResponseModel.of(ring), rf_of(ring)
    size = rms(model.rf_response()[:, 0])
    if not size:
        raise TmlatticeError("no dispersion")
    step = RfStep(
        rf.frequency(ring), rf.harmonic, ENERGY_ORBIT / size * rf.frequency(ring), nothing
    )
    proposed = Dispersion(steps=(step,), monitors=names, noise=nothing + NOISE)
    return dispersion(ring, proposed, options.places)


def _propose_tunes(ring: Ring, options: Options) -> Problem:
    two = np.ones((1, 2))
    reading = TuneReading(
        tune=0.25 * two, tune_error=TUNE * two, chromaticity=two,
        chromaticity_error=CHROMATICITY * two,
    )  # fmt: skip
    return tune_readings(ring, reading, options.places)


def _propose_turns(ring: Ring, options: Options) -> Problem:
    names, nothing = _no_orbit(ring)
    beam = StoredBeam(ResponseModel.of(ring))
    lines = AMPLITUDE * beam.modes / np.abs(beam.modes).max(axis=(0, 1))
    noise = np.full(lines.shape, TURN_NOISE * np.sqrt(2 / TURNS))
    found = Lines(
        names, (0,), beam.tunes[None] % 1, np.full((1, 2), 1e-6), lines[None], noise[None],
        nothing + TURN_NOISE, np.array([TURNS]), np.ones((1, 2, 1), dtype=complex), (),
    )  # fmt: skip
    kicked = TurnByTurn(readings=np.zeros((1, 16, len(names), 2)), monitors=names)
    return many_turns(ring, kicked, options.places, found)


def _propose_response(ring: Ring, options: Options) -> Problem:
    names, nothing = _no_orbit(ring)
    columns = ResponseModel.of(ring).columns(None)
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
    part: Callable[[str, str, Any, Options], Part]
    quantities: tuple[str, ...] = ()
    words: str = ""
    proposal: Callable[[Ring, Options], Problem] | None = None
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
