"""The measurement that best separates two explanations.

Of first turns it is one more shot. Candidates are launches of other phases and amplitudes, another
energy, and a changed setting of a suspected magnet. For each the readings are predicted under both
explanations. The separation is the difference that neither the launch nor the amount can absorb.

Of other measurements it is one of another kind, which is predicted with the usual noise.
Distributed errors cannot absorb the difference either. Its square grows with machine time, so
kinds compare by that square per minute.
"""

import logging
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from tmlattice.arrays import TINY, Array
from tmlattice.beam.chain import Chain
from tmlattice.beam.model import LAUNCH, Model
from tmlattice.diagnosis.findings import credible
from tmlattice.diagnosis.kinds import KINDS
from tmlattice.diagnosis.options import Options
from tmlattice.diagnosis.recommended_actions import recommended_action
from tmlattice.diagnosis.result import NextMeasurement
from tmlattice.effects import Cause, Settings, find
from tmlattice.errors import TmlatticeError, UnstableRingError
from tmlattice.inference.alternatives import Alternative
from tmlattice.inference.distributed import MAX_ELEMENTS, DistributedProblem, fit_distributed_errors
from tmlattice.inference.newton import fit_nuisances
from tmlattice.inference.problem import Point, Problem
from tmlattice.inference.search import Explanation
from tmlattice.lattice import Ring
from tmlattice.observe.data import Data
from tmlattice.observe.first_turns import FirstTurns
from tmlattice.optics import one_turn_optics

log = logging.getLogger(__name__)

PHASES = 12
CHANGES = {
    "quadrupole": {"k1_relative": 0.02},
    "sextupole": {"k2_relative": -1.0},
    "hcorrector": {"kick": 5e-5},
    "vcorrector": {"kick": 5e-5},
}
"""Relative changes of a suspected magnet's setting."""

LEAST = 2.0
"""Least separation of a recommended shot, in standard deviations."""

AMPLITUDE = 1e-3
"""Amplitude of the proposed launches where those measured are on the axis, m."""


def next_measurement(
    ring: Ring,
    data: Data,
    first: Alternative,
    second: Alternative,
    known: Sequence[Cause] = (),
    seed: int = 0,
) -> NextMeasurement | None:
    """Return the shot with the largest separation of two alternatives; None where none reaches
    `LEAST`.

    Args:
        ring: the design.
        data: what was measured: its amplitudes, noise and knowledge of launches.
        first, second: refitted with everything else in place.
        known: causes that are in the model anyway.
        seed: of the candidates' phases.
    """
    launches, settings = _candidates(ring, data, (first, second), seed)
    if not settings:
        return None
    model = Model(ring, settings, data.turns, known)
    count = len(launches)
    shape = (count, data.turns * len(model.at), 2)
    sigma = np.nanmedian(data.sigma.reshape(-1, 2), axis=0)
    prior = data.launch_sigma[:1]
    shots = Data(
        readings=np.zeros(shape),
        valid=np.broadcast_to(data.valid.any(axis=0), shape).copy(),
        sigma=np.broadcast_to(sigma, shape).copy(),
        launches=launches,
        launch_sigma=np.repeat(prior, count, axis=0),
        settings=tuple(settings),
        turns=data.turns,
    )
    problem = FirstTurns(model=model, data=shots, places={})
    points = [problem.at(own.fit.causes, launches) for own in (first, second)]
    if points[0].lost:
        return None
    separation = separations(problem, (first, second), points, count)
    best = int(separation.argmax())
    if not separation[best] >= LEAST:
        return None
    launch = dict(zip(LAUNCH, map(float, launches[best]), strict=True))
    return NextMeasurement(launch, settings[best], _names((first, second)), float(separation[best]))


def _names(pair: tuple[Alternative, Alternative]) -> tuple[str, str]:
    first, second = (" ".join(word for word in one.hypothesis if word) for one in pair)
    return first, second


def separations(
    problem: Problem, pair: Sequence[Alternative], points: Sequence[Point], parts: int = 1
) -> Array:
    """Return the separation of two explanations in standard deviations, [part].

    Args:
        problem: of the proposed readings.
        pair: the explanations.
        points: of each, at the same nuisances; the first is not lost.
        parts: equal parts of the rows, such as shots.
    """
    projection = points[0].projection
    assert projection is not None
    clean = projection.out(np.nan_to_num(points[1].residual - points[0].residual))
    clean = clean.reshape(parts, -1)
    square = (clean**2).sum(axis=1)
    for own, point in zip(pair, points, strict=True):
        if find(own.cause.effect).discrete or own.cause not in point.causes:
            continue
        # another amount, given its prior, would explain a part of it
        row = projection.out(problem.slope(point, point.causes.index(own.cause)))
        row = row.reshape(parts, -1)
        known = 1 / max(float(own.fit.covariance[-1, -1]), TINY)
        square -= (row * clean).sum(axis=1) ** 2 / ((row**2).sum(axis=1) + known) / 2
    return np.asarray(np.sqrt(np.maximum(square, 0.0)))


def _candidates(
    ring: Ring, data: Data, rivals: Sequence[Alternative], seed: int
) -> tuple[Array, list[Settings]]:
    """Candidate launches [shot, 5] and settings; no launch starts on the axis."""
    measured = data.launches
    launches = [row for row in measured[:2] if np.any(row[:4])]
    try:
        modes = one_turn_optics(Chain.from_ring(ring)).modes
        random = np.random.default_rng([seed, 3])
        size = np.linalg.norm(measured[:, :4] / np.abs(modes).max(axis=1), axis=1).mean()
        size = size or AMPLITUDE / float(np.abs(modes[[0, 2]]).max())
        for scale in (1.0, 2.0):
            for _ in range(PHASES):
                turn = np.exp(2j * np.pi * random.uniform(size=2))
                row = np.zeros(5)
                row[:4] = scale * size / 2 * np.real(modes @ turn)
                launches.append(row)
    except UnstableRingError:
        pass
    if not launches:
        return np.zeros((0, 5)), []
    usual = launches[0]
    launches += [usual + np.array([0, 0, 0, 0, delta]) for delta in (1e-3, -1e-3)]
    settings: list[Settings] = [{} for _ in launches]
    elements = {element.name: element for element in ring.elements}
    for rival in rivals:
        element = elements.get(rival.hypothesis[1] or "")
        if element is None or element.kind not in CHANGES:
            continue
        if element.kind != "quadrupole" or element.k1 != 0:
            launches.append(usual.copy())
            settings.append({element.name: CHANGES[element.kind]})
    return np.array(launches), settings


# --- another kind ---
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
    ring: Ring,
    explanation: Explanation,
    taken: Sequence[str],
    options: Options,
    fixed: tuple[Cause, ...],
) -> NextMeasurement | None:
    """Recommend a kind of measurement that was not taken; None where nothing is ambiguous or no
    kind separates it by `LEAST`. `fixed` are known causes."""
    pair = leading(ring, explanation, options.judgement.mass)
    if pair is None:
        return None
    found, best = None, 0.0
    for name, kind in KINDS.items():
        if name in taken or kind.proposal is None:
            continue
        try:
            problem = replace(kind.proposal(ring, options), fixed=fixed)
            apart = separation(_among(problem, explanation, pair[0]), pair)
        except TmlatticeError:  # no cavity, no corrector, no beam
            log.info("no %s can be proposed", name, exc_info=True)
            continue
        minutes = kind.minutes(ring)
        if apart >= LEAST and apart**2 / minutes > best:
            best = apart**2 / minutes
            found = NextMeasurement(None, {}, _names(pair), apart, name, minutes)
    return found


def _among(problem: Problem, explanation: Explanation, first: Alternative) -> Problem:
    """The separation given the undetermined distributed errors."""
    among = explanation.problem
    if not isinstance(among, DistributedProblem):
        return problem
    rows = int(problem.valid.sum())
    if rows * len(among.known.hypotheses) > MAX_ELEMENTS:
        raise TmlatticeError("too many readings for the distributed errors")
    known = among.learnt(explanation.fit)
    causes = _seen(problem, first)
    return fit_distributed_errors(problem, known, problem.first, causes, learn=False).problem


def _seen(problem: Problem, one: Alternative) -> list[Cause]:
    """The causes of an explanation to which a problem is sensitive."""
    return [c for c in one.fit.causes if problem.sees((c.effect, c.element))]


def separation(problem: Problem, pair: tuple[Alternative, Alternative]) -> float:
    """The separation in standard deviations; 0 where one of the explanations has no stored beam."""
    first = fit_nuisances(problem, _seen(problem, pair[0]), problem.first)
    second = problem.at(_seen(problem, pair[1]), first.nuisances)
    if first.lost or second.lost:
        return 0.0
    return float(separations(problem, pair, (first, second))[0])
