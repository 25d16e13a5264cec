"""Changed supplies, magnets and devices: candidates compared by the marginal likelihood.

>>> findings, scatter, state = changed_supplies(state, judgement, undetermined(reference))

The magnets of a supply scatter in their change, which limits the precision of a supply's change. In
a hierarchical fit of every magnet this scatter includes changes of single magnets. So it is learnt
again given the candidates, and likewise that of undetermined changes of other supplies.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.linalg import block_diag

from tmlattice.arrays import Array
from tmlattice.diagnosis.families.family import Family
from tmlattice.diagnosis.families.fields import (
    REPRODUCED,
    USUAL,
    FamilyGradient,
    QuadrupoleGradient,
)
from tmlattice.diagnosis.findings import cause_of, finding_of
from tmlattice.diagnosis.response.linear import Linear, marginal, with_undetermined
from tmlattice.diagnosis.response.state import State
from tmlattice.diagnosis.response.undetermined import Blur, Undetermined, strongest
from tmlattice.diagnosis.result import Finding
from tmlattice.effects import Cause
from tmlattice.errors import UnstableRingError
from tmlattice.inference.alternatives import Detection
from tmlattice.inference.common_factors import MAX_CHOSEN, CommonFactor, FactorModel, GivenOthers
from tmlattice.inference.judgement import Judgement
from tmlattice.inference.newton import AGAIN
from tmlattice.lattice import Ring
from tmlattice.lattice.supplies import supplied_alike
from tmlattice.observe.orbit_response import Errors, Predicted
from tmlattice.observe.response_problem import Response

STRAY = 3e-5
"""Reproducibility of a gradient outside quadrupoles, 1/m: the orbit in a sextupole moves."""
ALONE = 2.0
"""Log odds of a changed supply against one of its magnets alone, or a field elsewhere."""
FINER = 0.5
"""Factor between the smaller scatters that are tried."""
OTHERS = tuple(float(own) for own in np.geomspace(1e-4, 1e-2, 9))
"""Rms of undetermined changes of supplies that are tried, relative."""


Causes = tuple[tuple[str, str], ...]
"""Candidates for a change, of amount one."""


def changed_supplies(
    state: State, judgement: Judgement, open_: Undetermined | None = None
) -> tuple[list[Finding], dict[str, float], State]:
    """Return findings on all supplies, magnets and devices that changed, and the remaining scatter.

    Args:
        state: of a fit of the change.
        judgement: of the sets of alternatives.
        open_: undetermined errors of the ring that changed; None: none.

    Returns:
        The findings; the rms scatter, relative, of magnets of a supply and of undetermined supplies
        (0: none), by the effects' names, empty if no quadrupoles were fitted; and the state with
        the effects of undetermined errors on the findings.
    """
    found, scatter = _found(state, judgement)
    if open_ is None or not found:
        return found, scatter, state
    base = Predicted(state.data, Errors.none(state.data)).bend()
    problem = Response(base=base, used=np.isfinite(state.data.orbits), places={})
    for _ in range(AGAIN):
        causes = [cause_of(own) for own in found]
        before = {(own.effect, own.element) for own in found}
        try:
            orbits = Blur(problem, strongest(problem, open_, causes)).of(causes)
        except UnstableRingError:  # the ring is unstable with the findings
            break
        state = replace(state, undetermined=orbits)
        found, scatter = _found(state, judgement)
        if not found or {(own.effect, own.element) for own in found} == before:
            break
    return found, scatter, state


def _found(state: State, judgement: Judgement) -> tuple[list[Finding], dict[str, float]]:
    found: list[Finding] = []
    of_magnets: dict[str, float] = {}
    for block in (0, 1):
        fitted = {f.variable: f for f in state.of_block(block) if f.per == "ring"}
        if not fitted:
            continue
        there = with_undetermined(state, block)
        scatter, causes, own = _by_evidence(state, block, there, fitted)
        if QuadrupoleGradient.name in scatter:
            of_magnets = {**scatter, FamilyGradient.name: own.rms}
        found += [
            _finding(state.data.ring, causes, reason, judgement)
            for reason in own.levels.reasons(own.chosen, own.over)
        ]
    return found, of_magnets


def _by_evidence(
    state: State, block: int, there: Linear, fitted: Mapping[str, Family]
) -> tuple[dict[str, float], Causes, GivenOthers]:
    """The scatter of each family, at most that of the fit; the candidates; those selected."""
    information, pull = marginal(there, list(fitted))
    wider = _widened(state, block, there)

    def weighed(scatter: Mapping[str, float]) -> tuple[float, Causes, GivenOthers]:
        causes, members, alone = _candidates(state, fitted.values(), scatter)
        odds = [0.0 if name == FamilyGradient.name else ALONE for name, _ in causes]
        levels = FactorModel(
            information / wider**2, pull / wider**2, members, alone,
            np.full(len(odds), USUAL), np.array(odds),
        )  # fmt: skip
        supplies = [i for i, (name, _) in enumerate(causes) if name == FamilyGradient.name]
        there = levels.given_others(levels.choose(MAX_CHOSEN), supplies, OTHERS)
        evidence = there.levels.background + there.levels.log_evidence(there.chosen)
        return evidence, causes, there

    least = {
        f.name: REPRODUCED if isinstance(f, QuadrupoleGradient) else STRAY for f in fitted.values()
    }
    known = {name: group.rms for name, group in state.groups.items()}
    scatter = {name: max(known.get(name, 0.0), lowest) for name, lowest in least.items()}
    best = weighed(scatter)
    for name, learnt in dict(scatter).items():
        finer = learnt
        while finer > least[name]:
            finer = max(FINER * finer, least[name])
            other = weighed({**scatter, name: finer})
            if other[0] > best[0]:
                best, scatter = other, {**scatter, name: finer}
    return scatter, *best[1:]


def _candidates(
    state: State, fitted: Iterable[Family], scatter: Mapping[str, float]
) -> tuple[Causes, Array, Array]:
    """The candidates, what each moves [number, candidate], and the covariance of the scatter of
    single numbers, [number, number]."""
    causes: list[tuple[str, str]] = []
    blocks: list[Array] = []
    covariance: list[Array] = []
    for family in fitted:
        places = family.places(state.data)  # type: ignore[attr-defined]
        own = np.eye(len(places))
        quadrupoles = isinstance(family, QuadrupoleGradient)
        name = QuadrupoleGradient.name if quadrupoles else family.name
        alone = scatter[family.name] ** 2 * own
        if quadrupoles:
            kinds, members = supplied_alike(state.data.ring)
            alone = alone + (REPRODUCED / 2) ** 2 * members @ members.T
            causes += [(FamilyGradient.name, kind) for kind in kinds]
            own = np.hstack([members, own])
        covariance.append(alone)
        causes += [(name, place) for place in places]
        blocks.append(own)
    return tuple(causes), block_diag(*blocks), block_diag(*covariance)


def _widened(state: State, block: int, there: Linear) -> float:
    """Factor on the errors, because the noise was learnt from fitted readings."""
    posterior = there.posterior
    fitted = float(np.sum(1 - np.diag(posterior.covariance)))
    count = int(np.isfinite(state.data.pick(state.at.left, block)[:, state.good]).sum())
    return float(np.sqrt(count / max(count - fitted, count / 4)))


def _finding(
    ring: Ring, names: Sequence[tuple[str, str]], own: CommonFactor, judgement: Judgement
) -> Finding:
    chance = np.array([p for _, p in own.alternatives])
    causes = [Cause(*names[c], own.amount) for c, _ in own.alternatives]
    seen = Detection.among(own.statistic, len(names))
    return finding_of(ring, causes, chance, own.sigma, seen, judgement.mass)
