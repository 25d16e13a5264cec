"""Each kind of measurement as a part of one diagnosis: its problem and its validation set.

A new kind is a record in `measurement`, a problem in `observe`, and a line in `KINDS`.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tmlattice.beam.model import Model
from tmlattice.diagnosis.data_checks import corrected_data, data_checks, raise_if_wrong
from tmlattice.diagnosis.prepare import batch, noise_of, prepare
from tmlattice.inference.combined import CombinedProblem
from tmlattice.inference.judgement import Judgement
from tmlattice.inference.problem import Hypothesis, Problem
from tmlattice.lattice import Ring
from tmlattice.measurement import (
    ClosedOrbit,
    Dispersion,
    Measurement,
    OrbitResponse,
    TuneReading,
    TurnByTurn,
)
from tmlattice.observe.data import of_measurement
from tmlattice.observe.first_turns import FirstTurns
from tmlattice.observe.noise import scatter
from tmlattice.observe.orbit_response import Errors, Predicted
from tmlattice.observe.orbits import closed_orbits, dispersion
from tmlattice.observe.response_data import response_data
from tmlattice.observe.response_problem import Response
from tmlattice.observe.split import split_columns
from tmlattice.observe.stored import ModelCache, Stored
from tmlattice.observe.tune_readings import tune_readings
from tmlattice.observe.turn_by_turn import ManyTurns, many_turns

Array = NDArray[np.float64]
Measured = Measurement | OrbitResponse | TurnByTurn | ClosedOrbit | Dispersion | TuneReading


@dataclass(frozen=True)
class How:
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


def part_of(label: str, measured: Measured, how: How) -> Part:
    """Return a measurement as a part of a diagnosis.

    Raises:
        MeasurementError: data that cannot be used; the sentence names the label.
        UnknownNameError: a monitor that the ring does not have.
    """
    for kind, (record, made) in KINDS.items():
        if isinstance(measured, record):
            return made(label, kind, measured, how)
    raise TypeError(f"{type(measured).__name__} is no measurement")


def stacked(parts: Sequence[Part], before: Sequence[Part], how: How) -> CombinedProblem:
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
    return replace(whole, places=how.places, judgement=how.judgement, starts=starts)


def kind_of(measured: Measured) -> str:
    """The kind of a measurement, as its folder has it."""
    return next(kind for kind, (record, _) in KINDS.items() if isinstance(measured, record))


# --- the kinds ----
def _first_turns(label: str, kind: str, measured: Any, how: How) -> Part:
    ring = how.ring
    measured = corrected_data(ring, measured, how.assume)
    before, held = (corrected_data(ring, own, how.assume) for own in (how.reference, how.heldout))
    messages = data_checks(ring, measured, how.radiation, before)
    measured = batch(ring, measured, messages)
    before, held = (own and batch(ring, own, messages) for own in (before, held))
    if held is None and how.holdout:
        measured, held = measured.split(how.holdout, how.seed)
        if held is None and not how.places:
            messages.append("one shot was measured, so none is held out")
    options = (how.radiation, how.effects, how.judgement)
    ready = prepare(ring, measured, before, *options)
    estimated = ready.estimated
    if before is not None and estimated:  # the same electronics: from all shots
        noise = scatter(ready.problem.data, ready.before.point.view)
        if np.isfinite(noise).all():
            measured, before = (_with_noise(own, noise) for own in (measured, before))
            ready = prepare(ring, measured, before, *options)
    other = None
    if held is not None:
        data = of_measurement(ring, held).with_sigma(np.array(noise_of(ready.problem.data)))
        known = ready.problem.model.assembly.known
        model = Model(ring, data.settings, data.turns, known, active=data.active)
        other = FirstTurns(model=model, data=data, places=how.places)
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


def _response(label: str, kind: str, measured: Any, how: How) -> Part:
    ring = how.ring
    measured = corrected_data(ring, measured, how.assume)
    messages = tuple(data_checks(ring, measured))
    data = response_data(ring, measured)
    there = np.isfinite(data.orbits)
    base = Predicted(data, Errors.none(data)).bend()
    if not how.holdout:
        whole = Response(base=base, used=there, places=how.places, judgement=how.judgement)
        return Part(label, kind, whole, messages=messages)
    split = split_columns(data, min(how.holdout, 0.2), np.random.default_rng(how.seed))
    held = np.append(split.held[:-1], False)[:, None]
    # half of a held-out corrector's BPMs is fitted, to determine its own kick
    fitted, judges = (
        Response(base=base, used=there & which[:, :, None], places=how.places,
                 judgement=how.judgement)
        for which in (~held | split.half, held & ~split.half)
    )  # fmt: skip
    return Part(label, kind, fitted, judges, messages=messages)


def _of_stored(
    make: Callable[..., Problem], shots: bool = False
) -> Callable[[str, str, Any, How], Part]:
    """A kind of a stored beam; with `shots`, some are held out if there are enough of them."""

    def made(label: str, kind: str, measured: Any, how: How) -> Part:
        measured = corrected_data(how.ring, measured, how.assume)
        held = None
        ids = list(measured.shots) if shots else []
        count = round(how.holdout * len(ids))
        if len(ids) > 2 and count:
            drawn = np.random.default_rng(how.seed).permutation(ids).tolist()
            held, measured = (
                measured.select(shots=sorted(some)) for some in (drawn[:count], drawn[count:])
            )
        problem = make(how.ring, measured, how.places)
        if isinstance(problem, Stored):
            raise_if_wrong(how.ring, measured, problem)
        messages = problem.warnings if isinstance(problem, ManyTurns) else ()
        return Part(
            label, kind, problem, held and make(how.ring, held, how.places), messages=messages
        )

    return made


KINDS: Mapping[str, tuple[type, Callable[[str, str, Any, How], Part]]] = {
    "trajectory": (Measurement, _first_turns),
    "orbit_response": (OrbitResponse, _response),
    "turn_by_turn": (TurnByTurn, _of_stored(many_turns, shots=True)),
    "closed_orbit": (ClosedOrbit, _of_stored(closed_orbits, shots=True)),
    "dispersion": (Dispersion, _of_stored(dispersion)),
    "tunes": (TuneReading, _of_stored(tune_readings)),
}
"""Records and their part functions, by the kind that a folder states."""
