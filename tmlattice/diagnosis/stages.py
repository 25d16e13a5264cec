"""Residuals of each measurement for each model of a joint diagnosis, and their validation.

The models are the design, the design with distributed errors, and that with the findings.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from tmlattice.arrays import TINY, Array, Flags, rms
from tmlattice.diagnosis.kinds import Part
from tmlattice.diagnosis.prepare import same_monitors
from tmlattice.diagnosis.result import Finding
from tmlattice.diagnosis.views import PartView, numbers_read
from tmlattice.effects import Cause, Hypothesis, find
from tmlattice.errors import MeasurementError
from tmlattice.inference.combined import CombinedProblem
from tmlattice.inference.distributed import DistributedProblem, FittedErrors, slopes_of
from tmlattice.inference.judgement import SIGNIFICANT
from tmlattice.inference.newton import STEP_SHARES, Fit, fit_nuisances
from tmlattice.inference.problem import Point, Problem
from tmlattice.inference.search import Explanation
from tmlattice.inference.validation import Gap, Misfit, held_out_gap
from tmlattice.inference.whitening import Blocks
from tmlattice.observe.first_turns import FirstTurns, held_out_residuals


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


def _left(problem: Problem, point: Point, among: Flags | None = None) -> tuple[Array, Array]:
    """Residuals in units of the noise, and the noise, of all or some readings of a problem."""
    there = problem.valid if among is None else problem.valid & among
    rows = problem.as_rows(there.astype(float))
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


def misfit_of(pairs: Sequence[tuple[Problem, Point]], among: Sequence[Flags] = ()) -> Misfit:
    """The misfit of all readings; the rms of those in metres."""
    left, sizes = [], []
    for i, (problem, point) in enumerate(pairs):
        some = among[i] if among else problem.valid
        own, noise = _left(problem, point, some)
        left.append(own)
        metres = (problem.owner() >= 0)[problem.valid & some]
        sizes.append((own * noise)[metres])
    every = np.concatenate(left)
    chi2 = float(np.mean(every**2)) if len(every) else float("nan")
    return Misfit(rms(np.concatenate(sizes)), chi2)


def held_out(
    parts: Sequence[Part],
    fixed: tuple[Cause, ...],
    stages: Sequence[Stage],
    aside: set[str],
    since: int,
) -> Gap | None:
    """Held-out shots: half of the BPMs determines the nuisances, the other half is the validation
    set. Rejected BPMs are in neither."""
    judges = []
    for part in parts:
        if (judge := part.heldout) is not None:
            lost = [i for i, name in enumerate(judge.monitors) if name in aside]
            judges.append(judge.without(np.isin(judge.owner(), lost)))
    if not judges:
        return None
    misfits = []
    for stage in stages:
        pairs, among = [], []
        for judge in judges:
            causes = (*fixed, *stage.static, *stage.causes)
            seen = tuple(c for c in causes if judge.sees((c.effect, c.element)))
            there = replace(judge, fixed=seen)
            scored = there.owner() % 2 == 1
            gives = fit_nuisances(there.without(scored), (), there.first)
            pairs.append((there, there.at((), gives.nuisances)))
            among.append(scored)
        misfits.append(misfit_of(pairs, among))
    readings = sum(int((judge.valid & own).sum()) for judge, own in zip(judges, among, strict=True))
    gap = Gap(tuple(misfits), np.zeros((0, 0, 0)), None, None, since, readings)
    before, after = (max(misfits[i].chi2_per_dof - 1, 0.0) for i in (since, -1))
    if readings and before > SIGNIFICANT * np.sqrt(2 / readings) and since < len(misfits) - 1:
        return replace(gap, explained=1 - after / before)
    return gap


def held_out_shots(
    part: Part,
    problem: CombinedProblem,
    found: Explanation,
    small: FittedErrors | None,
    stages: Sequence[Stage],
    since: int,
) -> Gap | None:
    """Return the gap on held-out first turns, in the covariance of their prediction.

    Of the design; with the distributed errors, as in the fit without causes; with the findings,
    one by one where there are no distributed errors.
    """
    judge = part.heldout
    if judge is None:
        return None
    assert isinstance(judge, FirstTurns)
    assert isinstance(part.problem, FirstTurns)
    dropped = found.dropped.reshape(part.problem.valid.shape)
    judge = replace(judge, data=same_monitors(judge.data, part.problem.data, dropped))
    scored = []
    for i, stage in enumerate(stages):
        model = judge.model
        if problem.fixed or stage.static:
            model = model.knowing([*problem.fixed, *stage.static])
        unknown = None
        if small is not None and i:
            explained = found.fit if stage.causes or not found.fit.causes else found.before
            about = replace(judge, model=model)
            unknown = _unknown(small, explained, about, stage)
        scored.append(held_out_residuals(replace(judge, model=model, fixed=stage.causes), unknown))
    return held_out_gap(scored, since)


def _unknown(small: FittedErrors, explained: Fit, other: FirstTurns, stage: Stage) -> Array | None:
    """The covariance of the prediction of other shots, [shot * reading * 2] twice, m^2; None where
    their beam is lost.

    Of the distributed errors their posterior covariance, and of the amounts of the causes: as in
    universal kriging (Matheron 1969), whose drift launches and amounts are. `explained` is the fit
    of the first shots; `other` has the distributed errors in its model.
    """
    among = small.problem
    point = other.at(stage.causes, other.data.launches)
    if point.lost:
        return None
    known = among.known
    amounts = np.array([cause.amount for cause in stage.static])
    there = known.rms[:, None] * slopes_of(other, point, known, amounts)
    there = known.correlated(there)
    here = explained.projection.out(among.white_rows)
    rows = there.T @ here
    unknown = there.T @ there - rows @ rows.T
    slopes = [explained.slopes.get((c.effect, c.element)) for c in stage.causes]
    for_each = [i for i, slope in enumerate(slopes) if slope is not None]
    if for_each:
        seen = np.array([slope.row for slope in slopes if slope is not None])
        drift = np.array([other.metres(other.slope(point, i)) for i in for_each]) - seen @ (
            here.T @ there
        )
        unknown += drift.T @ explained.covariance[np.ix_(for_each, for_each)] @ drift
    return np.asarray(unknown)


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
