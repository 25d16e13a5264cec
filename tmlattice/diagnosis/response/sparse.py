"""Few causes of an orbit response's gap: the search of trajectories, on the response's rows.

A magnet, a corrector or a monitor that is wrong alone is named before families of small errors are
fitted. Where a few causes do not explain the readings to their noise, this says nothing: errors are
everywhere, and the dense fit is asked.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tmlattice.diagnosis.families.family import StatedCause
from tmlattice.diagnosis.findings import findings_of, finished, verdict_of
from tmlattice.diagnosis.response.single_change import SingleChange
from tmlattice.diagnosis.response.state import begin, bend
from tmlattice.diagnosis.response.stepwise import Step, StepwiseFit
from tmlattice.diagnosis.response.undetermined import Blur, Undetermined
from tmlattice.diagnosis.response.validation import score
from tmlattice.diagnosis.result import Finding
from tmlattice.effects import LaunchEffect, find, rare
from tmlattice.effects.effect import FamilyEffect
from tmlattice.errors import UnstableRingError
from tmlattice.inference import chi2
from tmlattice.inference.alternatives import Detection, leading
from tmlattice.inference.judgement import Judgement
from tmlattice.inference.newton import Fit, fit
from tmlattice.inference.scan import scan
from tmlattice.inference.search import Explanation, Identified, Search, explain
from tmlattice.observe.orbit_response import Hypothesis, Predicted
from tmlattice.observe.response_data import ResponseData
from tmlattice.observe.response_problem import Response, single_causes
from tmlattice.observe.split import Split

Flags = NDArray[np.bool_]

MOST = 3
"""More causes are not few: each costs a search of its own."""

RARER = 100.0
"""Each cause beyond the first is so many times less likely than the one before: what another one of
them makes is known in part, and what is left of it looks like one more."""

NOISE, REST = 1.5, 0.01
"""Where what is left is more than noise, a few causes explain a response if they leave less than
this chi-square per reading, and this share of the gap: a noise stated a little low leaves as much,
small errors everywhere leave more."""


PATTERNS, SPARE = 2, 2
"""A thin error at one place changes each plane's response by the product of a column and a row (it
kicks by what the corrector does there, and the monitors see that kick): two patterns a cause. What
a magnet's length and sextupoles add has the spare ones."""

ROUNDS, SETTLED = 30, 0.99
"""Of filling in what was not read, at most, and the share of chi-square that another one leaves
where it is worth no more: of a column that is read by half, a round finds half of the rest."""

LESS = 0.98
"""Of what a few causes leave, both planes' rms multiplied: small errors everywhere have to leave
less, or the few have it."""

LARGER = 2.0
"""Times the largest fault: a kick of more is none, and stands for what it does to the tunes by all
sextupoles."""


BLURRED, AGAIN, LEADING, NEAR = 2 * 10**7, 3, 3, 12
"""Readings times what is left open, from which on that is not looked at; searches at most; and
hypotheses that are weighed among it, before and after one of them is known to explain them."""


@dataclass(frozen=True)
class SparseFit:
    """What few causes explain.

    Attributes:
        fit: the design, the same with the causes, and each of them as a step.
        findings: by falling statistic.
        verdict: the least certain of theirs.
        told: the causes with their errors.
        said: what a reader should know.
        noise: whether what they leave is noise, as much as is stated: no more, and no less, for
            beside less there is room for other causes.
    """

    fit: StepwiseFit
    findings: tuple[Finding, ...]
    verdict: str
    fitted_causes: list[StatedCause]
    messages: tuple[str, ...]
    noise: bool


@dataclass(frozen=True)
class _Search(Search):
    """A search for one cause first, and for some more where one is not all.

    Attributes:
        stated: chi-square that the stated noise leaves at most.
    """

    stated: float = -np.inf


def sparse_fit(
    data: ResponseData,
    split: Split,
    effects: Sequence[str] | None,
    most: int,
    judgement: Judgement,
    seed: int = 0,
    progress: Callable[[str], Any] = lambda stage: None,
    open_: Undetermined | None = None,
) -> SparseFit | None:
    """The few causes of a response, or None where few do not explain it.

    Args:
        data: what was measured.
        split: held-out correctors give half of their monitors to the fit: nothing else tells what
            they do of what they are told.
        effects: names of those that may be the cause; None: all usual ones.
        most: findings at most.
        judgement: thresholds.
        seed: of the threshold's simulation.
        progress: told what is being done.
        open_: what is not known of the ring, whose response is known nevertheless.
    """
    hypotheses = single_causes(data, effects)
    if not hypotheses:
        return None
    progress("single causes")
    design = begin(data, split)
    places = {name: sum(h[0] == name for h in hypotheses) for name in {h[0] for h in hypotheses}}
    problem = Response(
        base=bend(design).at,
        used=_used(data, split),
        places=places,
        rare=rare(data.ring, list(places)),
        judgement=replace(judgement, rarer=RARER),
    )
    before = fit(problem, (), problem.first)
    count = int(problem.used.sum())
    gap = max(before.chi2 - count, 1.0)
    stated = float(chi2.isf(judgement.noise[1], count))
    enough = max(stated, min(NOISE * count, count + REST * gap))
    search = _Search(
        problem, hypotheses, 1, unnamed=False, enough=enough, seed=seed, progress=progress,
        stated=stated,
    )  # fmt: skip
    try:
        found = _explained(search, problem, before, gap)
    except UnstableRingError:  # a few causes lead to where no beam is stored
        found = None
    if open_ is not None and open_.root.size and open_.size(problem) <= BLURRED:
        found = _among_open(search, problem, before, found, open_)
    if found is None:
        return None
    return _result(data, split, problem.base, found, count, most, judgement)


def outperforms(fit: StepwiseFit, sparse: StepwiseFit) -> bool:
    """Whether correctors that were not fitted say that a fit of everything knows more than a few
    causes do, of the monitors that it takes for good and the planes that were read."""
    of_all = fit.heldout[1]
    of_few = score(replace(sparse.state, good=fit.state.good), sparse.state.split.held)
    gained = np.log([of_all.in_plane / of_few.in_plane, of_all.coupling / of_few.coupling])
    return bool(np.nansum(gained) < np.log(LESS))


def _explained(search: _Search, problem: Response, before: Fit, gap: float) -> Explanation | None:
    """Few causes in the ring as it is known; None where so few do not explain it."""
    if _hopeless(problem, search.hypotheses, before, MOST, search.enough):
        return None
    found = explain(search, before)
    if not found.fit.causes or before.chi2 - found.fit.chi2 < gap / (2 * MOST):
        return None  # the strongest of a few would explain its share
    if found.fit.chi2 > search.enough:
        if _hopeless(problem, search.hypotheses, found.fit, MOST - 1, search.enough):
            return None
        found = explain(replace(search, most=MOST), before, found)
    return None if found.fit.chi2 > search.enough else _and_more(search, before, found)


def _and_more(search: _Search, before: Fit, found: Explanation) -> Explanation:
    """With causes that are seen beside what explains the readings, if what they leave together is
    noise as it is stated: what stands out of more than that may be anything."""
    try:
        more = explain(replace(search, most=MOST, enough=-np.inf), before, found)
    except UnstableRingError:  # one of them stores no beam
        return found
    return more if more.fit.chi2 <= search.stated else found


def _among_open(
    search: _Search, plain: Response, before: Fit, found: Explanation | None, open_: Undetermined
) -> Explanation | None:
    """The same where what causes do is known no better than the ring is: one cause, and what is
    seen beside it, where that is likelier than what was found, else what was found."""
    seen = found.first if found else scan(
        plain.metric(before.point), search.hypotheses, before.residual, seed=search.seed
    )  # fmt: skip
    statistic = float(seen.statistic.max(initial=0.0))
    detection = Detection(
        statistic, seen.threshold(plain.judgement.false_alarm), seen.p_value(statistic)
    )
    if detection.p_value > plain.judgement.false_alarm:
        return found
    blur = Blur(plain, open_)
    changes = SingleChange(blur)
    starts: dict[Hypothesis, float | None] = {
        h: None for h in search.hypotheses if isinstance(find(h[0]), FamilyEffect)
    }
    starts |= leading(plain, seen, LEADING)
    if found is not None:
        starts |= {(c.effect, c.element): c.amount for c in found.fit.causes}
    tried = changes.all_of(starts)
    if tried and tried[0].fit.chi2 <= search.enough:  # its like, among what is open of it
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


def _unsure(search: _Search, blur: Blur, found: Explanation) -> tuple[Explanation, float]:
    """The search repeated among what is open of what was found; and its log evidence, if it still
    explains the readings there."""
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
    """Whether so few causes more, none beyond all measure, cannot explain what is left to less than
    enough: quick, where the search for each is not."""
    if _beyond(problem, left, PATTERNS * number + SPARE, enough) <= enough:
        return False
    # a kick, and another energy of the beam, are no pattern of columns by readings
    others = [h for h in hypotheses
              if not find(h[0]).responds or isinstance(find(h[0]), LaunchEffect)]  # fmt: skip
    seen = scan(problem.metric(left.point), others, left.residual, effective=1.0)
    fault = np.abs(seen.amount) < LARGER * np.array([find(h[0]).largest for h in seen.hypotheses])
    return bool(seen.statistic[fault].max(initial=0.0) < (left.chi2 - problem.used.sum()) / 2)


def _beyond(problem: Response, before: Fit, patterns: int, enough: float) -> float:
    """Chi-square that the strongest patterns [column] x [monitor, plane] leave: a few causes cannot
    explain more, whatever they are; quick, where a scan is not. What was not read is filled in by
    the patterns themselves, until less than `enough` is left or no more comes of it."""
    left = problem.left(before.point)[0].reshape(len(problem.used), -1)
    used = problem.used.reshape(left.shape)
    filled, rest = left, np.inf
    for _ in range(ROUNDS):
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
    data: ResponseData,
    split: Split,
    base: Predicted,
    found: Explanation,
    count: int,
    most: int,
    judgement: Judgement,
) -> SparseFit:
    found = finished(found)
    causes = found.fit.causes
    p_value = float(chi2.sf(found.fit.chi2, count - len(causes)))
    findings = findings_of(data.ring, found, (), judgement)
    verdict, findings, messages = verdict_of(
        replace(found, full=False), findings, p_value, False, judgement
    )
    design = begin(data, split)
    steps = [Step.scored("design", 0, score(design, split.held))]
    state = design
    for i, cause in enumerate(causes, 1):
        state = replace(design, at=base.with_causes(causes[:i]))
        name = f"{cause.effect} {cause.element or ''}".rstrip()
        steps.append(Step.scored(name, 1, score(state, split.held)))
    heldout = (score(design, split.held), score(state, split.held))
    errors = np.sqrt(np.maximum(np.diag(found.fit.covariance), 0.0)).tolist()
    stepwise = StepwiseFit(design, state, tuple(steps), (), heldout)
    fitted_causes = list(zip(causes, errors, strict=True))
    less = p_value > 1 - judgement.noise[1]
    noise = p_value >= judgement.noise[1] and not less
    return SparseFit(stepwise, findings[:most], verdict, fitted_causes, messages, noise)
