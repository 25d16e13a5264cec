"""A sparse solution of an orbit response's gap: the search of trajectories, on the response's rows.

A single faulty magnet, corrector or BPM is identified before families of distributed errors are
fitted. If a sparse set of causes leaves more than noise, the hierarchical fit follows.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from tmlattice.arrays import AT_ONCE, Array, Flags
from tmlattice.diagnosis.assessment import MISSING
from tmlattice.diagnosis.families.family import StatedCause
from tmlattice.diagnosis.findings import findings_of, finished, verdict_of
from tmlattice.diagnosis.options import Options
from tmlattice.diagnosis.response.hierarchical import HierarchicalFit
from tmlattice.diagnosis.response.state import State, begin
from tmlattice.diagnosis.response.undetermined import Blur, SingleChange, Undetermined
from tmlattice.diagnosis.response.validation import HELPS, score
from tmlattice.diagnosis.result import Finding
from tmlattice.effects import Hypothesis, LaunchEffect, find, rare
from tmlattice.effects.effect import FamilyEffect
from tmlattice.errors import UnstableRingError
from tmlattice.inference import chi2
from tmlattice.inference.alternatives import Detection, leading
from tmlattice.inference.judgement import BEYOND, Judgement
from tmlattice.inference.newton import AGAIN, ITERATIONS, Fit, fit
from tmlattice.inference.problem import Problem
from tmlattice.inference.scan import scan
from tmlattice.inference.search import Explanation, Identified, Search, explain
from tmlattice.observe.orbit_response import Predicted
from tmlattice.observe.response_data import ResponseData, Split
from tmlattice.observe.response_problem import Response, single_causes

MOST = 3
"""Most causes of a sparse solution: each costs a search of its own."""

RARER = 100.0
"""Log prior odds of each further cause: the residual of an inexact cause looks like one more."""

REST = 0.01
"""Share of the gap below which a sparse solution is accepted although
it leaves more than noise. Understated noise leaves as much, distributed errors leave more."""


PATTERNS, SPARE = 2, 2
"""Patterns of a cause: a thin error at one place changes each plane's response by a product of a
column and a row. Spare patterns are for a magnet's length and sextupoles."""

SETTLED = 0.99
"""Least gain of chi-square in a round of filling in missing readings."""


NEAR = 12
"""Hypotheses that are tried once one of them explains the readings; before, as many as causes."""


@dataclass(frozen=True)
class SparseFit:
    """A sparse solution.

    Attributes:
        fit: the design, the same with the causes, and each of them as a step.
        findings: by falling statistic.
        verdict: the least certain of theirs.
        fitted_causes: the causes with their errors.
        covariance: of these errors, [cause, cause].
        messages: about the findings.
        noise: whether the residual is noise of the stated size, neither more nor less, in each of
            its blocks.
    """

    fit: HierarchicalFit
    findings: tuple[Finding, ...]
    verdict: str
    fitted_causes: list[StatedCause]
    covariance: Array
    messages: tuple[str, ...]
    noise: bool


def sparse_fit(
    data: ResponseData,
    split: Split,
    effects: Sequence[str] | None,
    options: Options,
    open_: Undetermined | None = None,
) -> SparseFit | None:
    """Return the sparse solution of a response, or None where it has none.

    Args:
        data: the measurement on the ring.
        split: half of the BPMs of held-out correctors is fitted, and determines their calibration.
        effects: names of candidates; None: all usual ones.
        options: of the diagnosis.
        open_: undetermined errors of the ring, whose response is known.
    """
    hypotheses = single_causes(data, effects)
    if not hypotheses:
        return None
    judgement = options.judgement
    options.progress("single causes")
    design = begin(data, split)
    places = {name: sum(h[0] == name for h in hypotheses) for name in {h[0] for h in hypotheses}}
    problem = Response(
        base=design.at,
        used=_used(data, split),
        places=places,
        rare=rare(data.ring, list(places)),
        judgement=replace(judgement, rarer=RARER),
    )
    before = fit(problem, (), problem.first)
    count = int(problem.used.sum())
    gap = max(before.chi2 - count, 1.0)
    enough = max(_noise_alone(problem), min(MISSING * count, count + REST * gap))
    search = Search(
        problem, hypotheses, 1, unnamed=False, enough=enough, seed=options.seed,
        progress=options.progress,
    )  # fmt: skip
    try:
        found = _explained(search, problem, before, gap)
    except UnstableRingError:  # the sparse solution stores no beam
        found = None
    blur = None
    if (
        open_ is not None
        and open_.root.size
        and len(open_.hypotheses) * problem.used.size <= AT_ONCE
    ):
        blur = Blur(problem, open_)
        found = _among_open(search, before, found, blur)
    if found is None:
        return None
    base = problem.near(found.fit.causes).base
    orbits = None if blur is None else blur.of(found.fit.causes)
    start = replace(design, undetermined=orbits)
    return _result(start, base, found, count, judgement)


def outperforms(fit: HierarchicalFit, sparse: SparseFit, judgement: Judgement) -> bool:
    """Return whether the hierarchical fit explains more than the sparse solution: it alone leaves
    noise, or it predicts held-out readings better, at the BPMs that it does not reject, in the
    planes that were read."""
    if sparse.fit.p_value < judgement.noise[0] <= fit.p_value:
        return True
    state = sparse.fit.state
    of_all, of_few = fit.steps[-1], score(replace(state, good=fit.state.good), "sparse")
    gained = np.log([of_all.heldout_rms_in_plane / of_few.heldout_rms_in_plane,
                     of_all.heldout_rms_coupling / of_few.heldout_rms_coupling])  # fmt: skip
    return bool(np.nansum(gained) < np.log(HELPS))


def _explained(search: Search, problem: Response, before: Fit, gap: float) -> Explanation | None:
    """The sparse solution in the known ring; None where there is none."""
    if _hopeless(problem, search.hypotheses, before, MOST, search.enough):
        return None
    found = explain(search, before)
    if not found.fit.causes and before.chi2 <= _noise_alone(problem):
        return found
    if not found.fit.causes or before.chi2 - found.fit.chi2 < gap / (2 * MOST):
        return None  # the strongest cause would explain its share
    if found.fit.chi2 > search.enough:
        if _hopeless(problem, search.hypotheses, found.fit, MOST - 1, search.enough):
            return None
        found = explain(replace(search, most=MOST), before, found)
    return None if found.fit.chi2 > search.enough else _and_more(search, before, found)


def _and_more(search: Search, before: Fit, found: Explanation) -> Explanation:
    """The solution with further causes, if the residual together is noise of the stated size."""
    try:
        more = explain(replace(search, most=MOST, enough=-np.inf), before, found)
    except UnstableRingError:  # one of them stores no beam
        return found
    return more if more.fit.chi2 <= _noise_alone(search.problem) else found


def _noise_alone(problem: Problem) -> float:
    """Chi-square that the stated noise leaves at most."""
    return float(chi2.isf(problem.judgement.noise[1], int(problem.valid.sum())))


def _among_open(
    search: Search, before: Fit, found: Explanation | None, blur: Blur
) -> Explanation | None:
    """The solution given undetermined errors of the ring, if more probable; else `found`."""
    plain = blur.problem
    seen = found.first if found else scan(
        plain.metric(before.point), search.hypotheses, before.residual, seed=search.seed
    )  # fmt: skip
    statistic = float(seen.statistic.max(initial=0.0))
    detection = Detection(
        statistic, seen.threshold(plain.judgement.false_alarm), seen.p_value(statistic)
    )
    if detection.p_value > plain.judgement.false_alarm:
        return found
    changes = SingleChange(blur)
    starts: dict[Hypothesis, float | None] = {
        h: None for h in search.hypotheses if isinstance(find(h[0]), FamilyEffect)
    }
    starts |= leading(plain, seen, MOST)
    if found is not None:
        starts |= {(c.effect, c.element): c.amount for c in found.fit.causes}
    tried = changes.all_of(starts)
    if (
        tried and tried[0].fit.chi2 <= search.enough
    ):  # similar causes, given the undetermined errors
        about = changes.among(tried[0])
        there = about.at((), about.first)
        again = scan(about.metric(there), search.hypotheses, there.residual, effective=1.0)
        near = leading(about, again, NEAR)
        tried = (*tried, *changes.all_of({h: a for h, a in near.items() if h not in starts}))
        tried = tuple(sorted(tried, key=lambda one: -one.fit.log_evidence))
    tried = tuple(one for one in tried if one.fit.chi2 <= search.enough)
    if found is not None and len(found.fit.causes) > 1:
        found, evidence = _unsure(search, blur, found)
        if tried and tried[0].fit.log_evidence < evidence:
            return found
    if not tried:
        return found
    nothing = np.zeros(plain.valid.shape, dtype=bool)
    one = Explanation(
        plain, tried[0].fit, nothing, (Identified(detection, tried),),
        before=before, first=seen, scan=seen,
    )  # fmt: skip
    more, evidence = _unsure(search, blur, one)
    several = len(more.fit.causes) > 1 and evidence > one.fit.log_evidence
    return more if several else one


def _unsure(search: Search, blur: Blur, found: Explanation) -> tuple[Explanation, float]:
    """The search repeated given undetermined errors; its log evidence, -inf if it fails."""
    evidence = -np.inf
    for _ in range(AGAIN):
        problem = blur.among(blur.of(found.fit.causes))
        there = replace(search, problem=problem, most=MOST)
        again = explain(there, fit(problem, (), problem.first))
        if not again.fit.causes or again.fit.chi2 > search.enough:
            return found, -np.inf
        again = _and_more(there, again.before, again)
        same, found = again.names == found.names, again
        evidence = problem.log_scale + found.fit.log_evidence
        if same:
            break
    return found, evidence


def _hopeless(
    problem: Response, hypotheses: Sequence[Hypothesis], left: Fit, number: int, enough: float
) -> bool:
    """Whether a few further causes cannot reduce the residual below the limit: a quick test."""
    if _beyond(problem, left, PATTERNS * number + SPARE, enough) <= enough:
        return False
    # a kick, and an energy offset, are no product of columns and readings
    others = [h for h in hypotheses
              if not find(h[0]).responds or isinstance(find(h[0]), LaunchEffect)]  # fmt: skip
    seen = scan(problem.metric(left.point), others, left.residual, effective=1.0)
    fault = np.abs(seen.amount) < BEYOND * np.array([find(h[0]).largest for h in seen.hypotheses])
    return bool(seen.statistic[fault].max(initial=0.0) < (left.chi2 - problem.used.sum()) / 2)


def _beyond(problem: Response, before: Fit, patterns: int, enough: float) -> float:
    """A lower bound of chi-square for sparse solutions: the residual of the strongest patterns
    [column] x [monitor, plane]. Missing readings are filled in by the patterns, until less than
    `enough` is left or a round gains nothing."""
    left = problem.left(before.point)[0].reshape(len(problem.used), -1)
    used = problem.used.reshape(left.shape)
    filled, rest = left, np.inf
    for _ in range(ITERATIONS):
        columns, size, rows = np.linalg.svd(filled, full_matrices=False)
        model = (columns[:, :patterns] * size[:patterns]) @ rows[:patterns]
        before_that, rest = rest, float(((left - model)[used] ** 2).sum())
        if rest <= enough or rest > SETTLED * before_that:
            break
        filled = np.where(used, left, model)
    return rest


def _used(data: ResponseData, split: Split) -> Flags:
    """Readings that the search fits, [column, monitor, 2]."""
    half = split.held.copy()
    half[-1] = True  # the RF
    return np.isfinite(data.orbits) & (~half[:, None] | split.half)[:, :, None]


def _result(
    design: State,
    base: Predicted,
    found: Explanation,
    count: int,
    judgement: Judgement,
) -> SparseFit:
    found = finished(found)
    causes = found.fit.causes
    p_value = float(chi2.sf(found.fit.chi2, count - len(causes)))
    findings = findings_of(design.data.ring, found, (), judgement)
    verdict, findings, messages = verdict_of(
        replace(found, full=False), findings, p_value, False, judgement
    )
    steps = [score(design, "design")]
    state = design
    for i, cause in enumerate(causes, 1):
        state = replace(design, at=base.with_causes(causes[:i]))
        name = f"{cause.effect} {cause.element or ''}".rstrip()
        steps.append(score(state, name, 1))
    covariance = found.fit.covariance
    errors = np.sqrt(np.maximum(np.diag(covariance), 0.0)).tolist()
    fit = HierarchicalFit(design, state, tuple(steps))
    fitted_causes = list(zip(causes, errors, strict=True))
    expected = judgement.noise[1] <= p_value <= 1 - judgement.noise[1]
    noise = expected and fit.p_value >= judgement.noise[0]
    return SparseFit(fit, findings, verdict, fitted_causes, covariance, messages, noise)
