"""The kind of measurement that best separates two explanations.

For each kind that was not taken, the readings are predicted under both explanations, with the usual
noise. The separation is the difference that neither nuisances, nor amounts, nor distributed errors
can absorb. Its square grows with machine time, so kinds compare by that square per minute.
"""

import logging
from collections.abc import Sequence
from dataclasses import replace

from tmlattice.diagnosis.findings import credible
from tmlattice.diagnosis.kinds import KINDS, PartOptions
from tmlattice.diagnosis.next_measurement import LEAST, NextMeasurement, separations
from tmlattice.diagnosis.recommended_actions import recommended_action
from tmlattice.effects import Cause
from tmlattice.errors import TmlatticeError
from tmlattice.inference.alternatives import Alternative
from tmlattice.inference.distributed import MAX_ELEMENTS, DistributedProblem, fit_distributed_errors
from tmlattice.inference.newton import fit_nuisances
from tmlattice.inference.problem import Problem
from tmlattice.inference.search import Explanation
from tmlattice.lattice import Ring

log = logging.getLogger(__name__)


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
    options: PartOptions,
    fixed: tuple[Cause, ...],
) -> NextMeasurement | None:
    """Recommend the next measurement; None where nothing is ambiguous or no kind separates it by
    `LEAST`.

    Args:
        ring: the design.
        explanation: of what was measured.
        taken: kinds that were measured.
        options: of the diagnosis.
        fixed: causes that are known.
    """
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
            first, second = (" ".join(w for w in one.hypothesis if w) for one in pair)
            found = NextMeasurement(None, {}, (first, second), apart, name, minutes)
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
    causes = [c for c in first.fit.causes if problem.sees((c.effect, c.element))]
    return fit_distributed_errors(problem, known, problem.first, causes, learn=False).problem


def separation(problem: Problem, pair: tuple[Alternative, Alternative]) -> float:
    """The separation in standard deviations; 0 where one of the explanations has no stored beam."""
    each = [
        [c for c in one.fit.causes if problem.sees((c.effect, c.element))] for one in pair
    ]  # fmt: skip
    first = fit_nuisances(problem, each[0], problem.first)
    second = problem.at(each[1], first.nuisances)
    if first.lost or second.lost:
        return 0.0
    return float(separations(problem, pair, (first, second))[0])
