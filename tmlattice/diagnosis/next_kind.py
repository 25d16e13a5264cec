"""The kind of measurement that best separates two explanations.

For each kind that was not taken, the readings are predicted under both explanations, with the usual
noise. The separation is the difference that neither nuisances, nor amounts, nor distributed errors
can absorb. Its square grows with machine time, so kinds compare by that square per minute.
"""

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from tmlattice.beam.closed_orbit import ResponseModel
from tmlattice.beam.rf import rf_of
from tmlattice.beam.stored import StoredBeam
from tmlattice.diagnosis.findings import credible
from tmlattice.diagnosis.kinds import How
from tmlattice.diagnosis.next_measurement import LEAST, NextMeasurement, separations
from tmlattice.diagnosis.recommended_actions import recommended_action
from tmlattice.effects import Cause
from tmlattice.errors import TmlatticeError
from tmlattice.inference.alternatives import Alternative
from tmlattice.inference.distributed import DistributedProblem, fit_distributed_errors
from tmlattice.inference.newton import fit_nuisances
from tmlattice.inference.problem import Problem
from tmlattice.inference.search import Explanation
from tmlattice.lattice import Ring
from tmlattice.measurement import ClosedOrbit, Dispersion, OrbitResponse, RfStep, TuneReading
from tmlattice.measurement import TurnByTurn as Turns
from tmlattice.observe.orbit_response import Errors, Predicted
from tmlattice.observe.orbits import closed_orbits, dispersion
from tmlattice.observe.response_data import response_data
from tmlattice.observe.response_problem import Response
from tmlattice.observe.spectra import Lines
from tmlattice.observe.tune_readings import tune_readings
from tmlattice.observe.turn_by_turn import many_turns

log = logging.getLogger(__name__)

Array = NDArray[np.float64]

A_CORRECTOR = 0.2
"""Minutes of an orbit response for each of its correctors: two settings and their orbits."""

NOISE, TURN_NOISE = 2e-6, 2e-5
"""rms of an averaged reading of a stored beam, and of one of one turn, m."""
TUNE, CHROMATICITY = 1e-4, 0.1
"""rms of what is read of them."""
TURNS, AMPLITUDE = 1000, 3e-4
"""Amplitude of a kicked beam, m, at the BPMs where it is largest."""
KICK, ENERGY_ORBIT = 1e-4, 1.3e-3
"""Kick of each corrector, rad; orbit change by the RF's step, m rms."""

ROOM = 2**26
"""Most signatures of distributed errors: with more, nothing is proposed."""


def leading(
    ring: Ring, explanation: Explanation, mass: float
) -> tuple[Alternative, Alternative] | None:
    """The first finding's most probable explanation, and the most probable one with another
    action."""
    for named in explanation.named:
        first, *others = credible(named.alternatives, mass)[0]
        done = recommended_action(ring, first.cause)
        other = next(
            (rival for rival in others if recommended_action(ring, rival.cause) != done), None
        )
        if other is not None:
            return first, other
    return None


def next_kind(
    ring: Ring, explanation: Explanation, taken: Sequence[str], how: How, fixed: tuple[Cause, ...]
) -> NextMeasurement | None:
    """Recommend the next measurement; None where nothing is ambiguous or no kind separates it by
    `LEAST`.

    Args:
        ring: the design.
        explanation: of what was measured.
        taken: kinds that were measured.
        how: of the diagnosis.
        fixed: causes that are known.
    """
    pair = leading(ring, explanation, how.judgement.mass)
    if pair is None:
        return None
    found, best = None, 0.0
    for kind, (make, _) in KINDS.items():
        if kind in taken:
            continue
        try:
            problem = replace(make(ring, how), fixed=fixed)
            separation = _separation(_among(problem, explanation, pair[0]), pair)
        except TmlatticeError:  # no cavity, no corrector, no beam
            log.info("no %s can be proposed", kind, exc_info=True)
            continue
        minutes = minutes_of(ring, kind)
        if separation >= LEAST and separation**2 / minutes > best:
            best = separation**2 / minutes
            first, second = (" ".join(w for w in one.hypothesis if w) for one in pair)
            found = NextMeasurement(None, {}, (first, second), separation, kind, minutes)
    return found


def minutes_of(ring: Ring, kind: str) -> float:
    """Machine time of one measurement."""
    correctors = sum(e.kind in ("hcorrector", "vcorrector") for e in ring.elements)
    return A_CORRECTOR * correctors if kind == "orbit_response" else KINDS[kind][1]


def _among(problem: Problem, explanation: Explanation, first: Alternative) -> Problem:
    """The separation given the undetermined distributed errors."""
    among = explanation.problem
    if not isinstance(among, DistributedProblem):
        return problem
    rows = int(problem.valid.sum())
    if rows * len(among.known.hypotheses) > ROOM:
        raise TmlatticeError("too many readings for the distributed errors")
    known = among.learnt(explanation.fit)
    causes = [c for c in first.fit.causes if problem.sees((c.effect, c.element))]
    return fit_distributed_errors(problem, known, problem.first, causes, learn=False).problem


def _separation(problem: Problem, pair: tuple[Alternative, Alternative]) -> float:
    """The separation in standard deviations; 0 where one of the explanations has no stored beam."""
    each = [
        [c for c in one.fit.causes if problem.sees((c.effect, c.element))] for one in pair
    ]  # fmt: skip
    first = fit_nuisances(problem, each[0], problem.first)
    second = problem.at(each[1], first.nuisances)
    if first.lost or second.lost:
        return 0.0
    return float(separations(problem, pair, (first, second))[0])


# --- simulated measurements: their noise and the amplitude of kicks count ------------------
def _monitors(ring: Ring) -> tuple[tuple[str, ...], Array]:
    names = tuple(monitor.name for monitor in ring.monitors)
    return names, np.zeros((len(names), 2))


def _orbit(ring: Ring, how: How) -> Problem:
    names, nothing = _monitors(ring)
    orbit = ClosedOrbit(orbit=nothing[None], monitors=names, noise=nothing + NOISE)
    return closed_orbits(ring, orbit, how.places)


def _dispersion(ring: Ring, how: How) -> Problem:
    names, nothing = _monitors(ring)
    model, rf = ResponseModel(ring), rf_of(ring)
    size = float(np.sqrt(np.mean(model.rf_response()[:, 0] ** 2)))
    if not size:
        raise TmlatticeError("no dispersion")
    step = RfStep(
        rf.frequency(ring), rf.harmonic, ENERGY_ORBIT / size * rf.frequency(ring), nothing
    )
    proposed = Dispersion(steps=(step,), monitors=names, noise=nothing + NOISE)
    return dispersion(ring, proposed, how.places)


def _tunes(ring: Ring, how: How) -> Problem:
    two = np.ones((1, 2))
    reading = TuneReading(
        tune=0.25 * two, tune_error=TUNE * two, chromaticity=two,
        chromaticity_error=CHROMATICITY * two,
    )  # fmt: skip
    return tune_readings(ring, reading, how.places)


def _turns(ring: Ring, how: How) -> Problem:
    names, nothing = _monitors(ring)
    beam = StoredBeam(ResponseModel(ring))
    lines = AMPLITUDE * beam.modes / np.abs(beam.modes).max(axis=(0, 1))
    noise = np.full(lines.shape, TURN_NOISE * np.sqrt(2 / TURNS))
    found = Lines(
        names, (0,), beam.tunes[None] % 1, np.full((1, 2), 1e-6), lines[None], noise[None],
        nothing + TURN_NOISE, np.array([TURNS]), np.ones((1, 2, 1), dtype=complex), (),
    )  # fmt: skip
    kicked = Turns(readings=np.zeros((1, 16, len(names), 2)), monitors=names)
    return many_turns(ring, kicked, how.places, found)


def _response(ring: Ring, how: How) -> Problem:
    names, nothing = _monitors(ring)
    columns = ResponseModel(ring).columns(None)
    count = len(columns.names)
    if not count:
        raise TmlatticeError("no corrector")
    response = OrbitResponse(
        correctors=columns.names, planes=columns.planes, kicks=np.full(count, KICK),
        monitors=names, response=np.broadcast_to(nothing, (count, *nothing.shape)).copy(),
        noise=nothing + NOISE,
    )  # fmt: skip
    data = response_data(ring, response)
    base = Predicted(data, Errors.none(data)).bend()
    return Response(
        base=base, used=np.isfinite(data.orbits), places=how.places,
        judgement=how.judgement,
    )  # fmt: skip


KINDS: Mapping[str, tuple[Callable[[Ring, How], Problem], float]] = {
    "closed_orbit": (_orbit, 0.5),
    "tunes": (_tunes, 2.0),
    "turn_by_turn": (_turns, 2.0),
    "dispersion": (_dispersion, 3.0),
    "orbit_response": (_response, np.nan),
}
"""Simulated measurement by kind, and machine time, minutes: an averaged orbit; a few kicks; a step
of the RF up and down. See `minutes_of` for a response."""
