"""Residuals of each measurement for each model of a joint diagnosis, and their validation.

The models are the design, the design with distributed errors, and that with the findings.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from tmlattice.arrays import TINY, Array, rms
from tmlattice.diagnosis.prepare import Part
from tmlattice.diagnosis.result import Finding
from tmlattice.diagnosis.views import PartView, numbers_read
from tmlattice.effects import Cause, Hypothesis, find
from tmlattice.errors import MeasurementError
from tmlattice.inference.combined import CombinedProblem
from tmlattice.inference.distributed import (
    DistributedProblem,
    FittedErrors,
    as_readings,
    slopes_of,
)
from tmlattice.inference.newton import STEP_SHARES, Fit, fit_nuisances
from tmlattice.inference.problem import Point, Problem
from tmlattice.inference.search import Explanation
from tmlattice.inference.validation import Gap, Misfit, Residuals, held_out_gap, predicted
from tmlattice.inference.whitening import Blocks
from tmlattice.observe.first_turns import FirstTurns


@dataclass(frozen=True)
class Stage:
    """One model of the ring.

    Attributes:
        static: distributed errors, which a reference has too.
        causes: the findings.
        point: what they leave.
        share: of the step to the most probable distributed errors, from those of the fit, in
            `static`: 1, or less where no beam is stored with all of them.
    """

    static: tuple[Cause, ...]
    causes: tuple[Cause, ...]
    point: Point
    share: float = 1.0


def stages_of(
    problem: CombinedProblem,
    found: Explanation,
    small: FittedErrors | None,
    causes: tuple[Cause, ...],
) -> list[Stage]:
    """The models: the design; then with distributed errors and with the causes, or with one cause
    after another."""
    fitted = found.fit.nuisances
    models: list[tuple[tuple[Cause, ...], tuple[Cause, ...], Array]] = [((), (), problem.first)]
    about: dict[Hypothesis, float] = {}
    if small is not None:
        inner = found.problem
        assert isinstance(inner, DistributedProblem)
        about = dict(zip(inner.known.hypotheses, inner.linearised_at.tolist(), strict=True))
        for one in (found.before, found.fit)[: 1 + bool(causes)]:
            amounts = zip(inner.known.hypotheses, inner.estimate(one.clean).tolist(), strict=True)
            models.append((tuple(Cause(*h, a) for h, a in amounts), (), one.nuisances))
        if causes:
            models[-1] = (models[-1][0], causes, fitted)
    else:
        models += [((), causes[: i + 1], problem.first) for i in range(len(causes))]
    return [_settled(problem, *model, fitted, about) for model in models]


def _settled(
    problem: CombinedProblem,
    static: tuple[Cause, ...],
    own: tuple[Cause, ...],
    nuisances: Array,
    fitted: Array,
    about: Mapping[Hypothesis, float],
) -> Stage:
    """A model at its best nuisances; from those of the fit, or the first ones, where from the
    others no beam comes to the last BPM that read one."""
    for share in (*STEP_SHARES, 0.0):
        some = tuple(
            replace(c, amount=start + share * (c.amount - start))
            for c in static for start in [about[c.effect, c.element]]
        )  # fmt: skip
        there = replace(problem, fixed=(*problem.fixed, *some))
        for start in (nuisances, fitted, problem.first):
            point = fit_nuisances(there, own, start)
            if not point.lost:
                break
        if not point.lost or not static:
            break
    if point.lost:
        raise MeasurementError(f"{point.lost}, with the findings: the errors are too large")
    return Stage(some, own, point, share)


def _left(problem: Problem, point: Point) -> tuple[Array, Array]:
    """Residuals in units of the noise, and the noise, of all readings of a problem."""
    rows = problem.as_rows(problem.valid.astype(float))
    own = rows > 0
    return point.residual[own], 1 / rows[own]


def views_of(
    parts: Sequence[Part], problem: CombinedProblem, stages: Sequence[Stage]
) -> tuple[PartView, ...]:
    """Residuals of each measurement before and after."""
    views = []
    for i, (part, own) in enumerate(zip(parts, problem.parts, strict=False)):
        points = [stage.point.view[i] for stage in (stages[0], stages[-1])]
        owner = own.owner()[own.valid]
        by_monitor = np.full((2, len(own.monitors)), np.nan)
        for row, point in zip(by_monitor, points, strict=True):
            left, _ = _left(own, point)
            for m in np.unique(owner[owner >= 0]):
                row[m] = rms(left[owner == m])
        before, after = (misfit_of([(own, point)]) for point in points)
        count = int(own.valid.sum())
        views.append(
            PartView(part.label, part.kind, count, before, after, tuple(own.monitors), by_monitor,
                     numbers_read(own, *points))
        )  # fmt: skip
    return tuple(views)


def misfit_of(pairs: Sequence[tuple[Problem, Point]]) -> Misfit:
    """The misfit of all readings; the rms of those in metres."""
    left, sizes = [], []
    for problem, point in pairs:
        own, noise = _left(problem, point)
        left.append(own)
        metres = (problem.owner() >= 0)[problem.valid]
        sizes.append((own * noise)[metres])
    every = np.concatenate(left)
    chi2 = float(np.mean(every**2)) if len(every) else float("nan")
    return Misfit(rms(np.concatenate(sizes)), chi2)


def held_out(
    parts: Sequence[Part],
    problem: CombinedProblem,
    found: Explanation,
    small: FittedErrors | None,
    stages: Sequence[Stage],
    since: int,
) -> Gap | None:
    """The gap on the validation sets, at BPMs that the fit used; None without any.

    The model's uncertainty by distributed errors is included for first turns alone: covariances of
    other readings would be large.

    Args:
        parts: measurements.
        problem: their problem, without rejected readings.
        found: the explanation.
        small: distributed errors, if there are any.
        stages: the models.
        since: index of the model with which the last one is compared.
    """
    heldout = []
    for part, fitted in zip(parts, problem.parts, strict=False):
        if (unseen := part.heldout) is not None:
            never = ~np.asarray(fitted.valid.any(axis=0))[: unseen.valid.shape[1]]
            unused = np.zeros(unseen.valid.shape, dtype=bool)
            unused[:, : len(never)] = never
            heldout.append(unseen.without(unused))
    if not heldout:
        return None
    turns = len(parts) == 1 and isinstance(heldout[0], FirstTurns)
    models, residuals = list[list[Residuals]](), list[Array]()
    for i, stage in enumerate(stages):
        scored, left = list[Residuals](), list[Array]()
        for unseen in heldout:
            fixed, causes = (
                [cause for cause in some if unseen.sees((cause.effect, cause.element))]
                for some in ((*problem.fixed, *stage.static), stage.causes)
            )
            there, errors, known = unseen.with_fixed(fixed), None, 0
            if turns and small is not None and i:
                explained = found.fit if stage.causes or not found.fit.causes else found.before
                errors, known = _unknown(small, explained, there, stage)
            groups, residual = predicted(there.with_fixed(causes).near(()), errors, known)
            scored += groups
            left.append(residual)
        models.append(scored)
        residuals.append(left[0] if len(left) == 1 else np.concatenate([r.ravel() for r in left]))
    gap = held_out_gap(models, since, np.array(residuals))
    if small is None or turns:
        return gap
    design, *others = gap.misfits  # of these the uncertainty is not known
    return replace(gap, misfits=(design, *(replace(one, expected=None) for one in others)))


def _unknown(
    small: FittedErrors, explained: Fit, other: Problem, stage: Stage
) -> tuple[Array | None, int]:
    """The errors of the prediction of other readings, of size 1, m, [error, *shape of `valid`], of
    which the readings of the fit removed the last ones, so many; None where their beam is lost.

    Of the distributed errors their posterior covariance, and of the amounts of the causes: as in
    universal kriging (Matheron 1969), whose drift launches and amounts are. `explained` is the fit
    of the first readings; `other` has the distributed errors in its model.
    """
    among = small.problem
    point = other.at(stage.causes, other.first)
    if point.lost:
        return None, 0
    known = among.known
    amounts = np.array([cause.amount for cause in stage.static])
    there = known.rms[:, None] * slopes_of(other, point, known, amounts)
    there = known.correlated(there)
    here = explained.projection.out(among.white_rows)
    errors, removed = [there], here.T @ there
    slopes = [explained.slopes.get((c.effect, c.element)) for c in stage.causes]
    for_each = [i for i, slope in enumerate(slopes) if slope is not None]
    if for_each:
        seen = np.array([slope.row for slope in slopes if slope is not None])
        own = np.array([other.slope(point, i) for i in for_each])
        drift = as_readings(other, own) - seen @ removed
        values, vectors = np.linalg.eigh(explained.covariance[np.ix_(for_each, for_each)])
        errors.append((vectors * np.sqrt(np.maximum(values, 0.0))).T @ drift)
    rows = np.concatenate([*errors, removed])
    return rows.reshape(-1, *other.valid.shape), len(removed)


def seen_by(
    parts: Sequence[Part], problem: CombinedProblem, point: Point, finding: Finding
) -> dict[str, float] | None:
    """The share of each measurement in the information on a finding's amount."""
    own = [i for i, c in enumerate(point.causes)
           if (c.effect, c.element) == (finding.effect, finding.element)]  # fmt: skip
    if not own or point.projection is None or find(point.causes[own[0]].effect).discrete:
        return None
    row = point.projection.out(problem.slope(point, own[0]))
    assert isinstance(point.projection, Blocks)
    squares = [float(mine @ mine) for mine in point.projection.split(row)][: len(parts)]
    total = max(sum(squares), TINY)
    return {part.label: square / total for part, square in zip(parts, squares, strict=True)}
