"""The kind of measurement, of those that were not taken, that best parts two explanations.

For each kind the readings are predicted under both, in a noise that such measurements usually have;
what of their difference neither nuisances, nor the amounts, nor small errors can absorb is the
separation. Its square grows with the time that a measurement is given, so the kinds compare by that
square a minute.
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
from tmlattice.diagnosis.next_measurement import LEAST, NextMeasurement
from tmlattice.diagnosis.recommended_actions import recommended_action
from tmlattice.effects import Cause, find
from tmlattice.errors import TmlatticeError
from tmlattice.inference.among import Among, small_errors_of
from tmlattice.inference.newton import settled
from tmlattice.inference.problem import Problem
from tmlattice.inference.rivals import Rival
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

MINUTES: Mapping[str, float] = {
    "closed_orbit": 0.5, "tunes": 2.0, "turn_by_turn": 2.0, "dispersion": 3.0,
}  # fmt: skip
"""Machine time of one measurement: an averaged orbit; a few kicks; a step of the RF up and down."""
A_CORRECTOR = 0.2
"""Minutes of an orbit response for each of its correctors: two settings and their orbits."""

NOISE, TURN_NOISE = 2e-6, 2e-5
"""rms of an averaged reading of a stored beam, and of one of one turn, m."""
TUNE, CHROMATICITY = 1e-4, 0.1
"""rms of what is read of them."""
TURNS, AMPLITUDE = 1000, 3e-4
"""Of a kicked beam, and m at the monitors where it is largest."""
KICK, ENERGY_ORBIT = 1e-4, 1.3e-3
"""Of each corrector, rad; orbit change by the RF's step, m rms."""

ROOM = 2**26
"""Numbers of the signatures of all small errors: where there are more, nothing is proposed."""


def leading(ring: Ring, explanation: Explanation, mass: float) -> tuple[Rival, Rival] | None:
    """The first finding's likeliest explanation, and the likeliest one that another action takes
    away: which of two mechanisms with one recommended action it is changes nothing."""
    for named in explanation.named:
        first, *others = credible(named.rivals, mass)[0]
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
    """What to measure next; None where nothing is open, or no kind parts it by `LEAST`.

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
    for kind, make in KINDS.items():
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
    if kind == "orbit_response":
        return A_CORRECTOR * sum(e.kind in ("hcorrector", "vcorrector") for e in ring.elements)
    return MINUTES[kind]


def _among(problem: Problem, explanation: Explanation, first: Rival) -> Problem:
    """Among the small errors that are left open."""
    among = explanation.problem
    if not isinstance(among, Among):
        return problem
    rows = int(problem.valid.sum())
    if rows * len(among.known.hypotheses) > ROOM:
        raise TmlatticeError("too many readings among small errors")
    known = among.learnt(explanation.fit)
    causes = [c for c in first.fit.causes if problem.sees((c.effect, c.element))]
    return small_errors_of(problem, known, problem.first, causes, learn=False).problem


def _separation(problem: Problem, pair: tuple[Rival, Rival]) -> float:
    """In standard deviations; 0 where one of them has no stored beam."""
    each = [
        [c for c in one.fit.causes if problem.sees((c.effect, c.element))] for one in pair
    ]  # fmt: skip
    first = settled(problem, each[0], problem.first)
    second = problem.at(each[1], first.nuisances)
    if first.projection is None or second.projection is None:
        return 0.0
    clean = first.projection.out(second.residual - first.residual)
    square = float(clean @ clean)
    for rival, causes, point in zip(pair, each, (first, second), strict=True):
        if find(rival.cause.effect).discrete or rival.cause not in causes:
            continue
        # another amount would explain some of it, as far as it is not known
        row = first.projection.out(problem.slope(point, causes.index(rival.cause)))
        known = 1 / max(float(rival.fit.covariance[-1, -1]), 1e-300)
        square -= float(row @ clean) ** 2 / (float(row @ row) + known) / 2
    return float(np.sqrt(max(square, 0.0)))


# --- what would be measured: only its noise counts, and how far a beam is kicked ------------------
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


KINDS: Mapping[str, Callable[[Ring, How], Problem]] = {
    "closed_orbit": _orbit,
    "tunes": _tunes,
    "turn_by_turn": _turns,
    "dispersion": _dispersion,
    "orbit_response": _response,
}
