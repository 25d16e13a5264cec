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

from tmlattice.diagnosis.dense import DenseFit, Step, score
from tmlattice.diagnosis.family import Told
from tmlattice.diagnosis.findings import findings_of, verdict_of
from tmlattice.diagnosis.result import Finding
from tmlattice.diagnosis.state import begin
from tmlattice.effects import find, rare
from tmlattice.inference import chi2
from tmlattice.inference.judgement import Judgement
from tmlattice.inference.newton import Fit, fit
from tmlattice.inference.scan import scan
from tmlattice.inference.search import Explanation, Search, explain
from tmlattice.observe.orbit_response import Predicted, ResponseData, Split
from tmlattice.observe.response_problem import Response, single_causes

Flags = NDArray[np.bool_]

MOST = 3
"""More causes are not few: each costs a search of its own."""

NOISE, REST = 1.5, 0.01
"""Where what is left is more than noise, a few causes explain a response if they leave less than
this chi-square per reading, and this share of the gap: a noise stated a little low leaves as much,
small errors everywhere leave more."""


PATTERNS, SPARE = 2, 2
"""A thin error at one place changes each plane's response by the product of a column and a row (it
kicks by what the corrector does there, and the monitors see that kick): two patterns a cause. What
a magnet's length and sextupoles add has the spare ones."""

KICKS = 50_000
"""Readings up to which kicks are sought too, which bend the orbit in all sextupoles and so make
many patterns: of more, a scan of them takes longer than of all others."""


@dataclass(frozen=True)
class Few:
    """What few causes explain.

    Attributes:
        fit: the design, the same with the causes, and each of them as a step.
        findings: by falling statistic.
        verdict: the least certain of theirs.
        told: the causes with their errors.
        said: what a reader should know.
    """

    fit: DenseFit
    findings: tuple[Finding, ...]
    verdict: str
    told: list[Told]
    said: tuple[str, ...]


def few_causes(
    data: ResponseData,
    split: Split,
    effects: Sequence[str] | None,
    most: int,
    judgement: Judgement,
    seed: int = 0,
    progress: Callable[[str], Any] = lambda stage: None,
) -> Few | None:
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
    """
    hypotheses = single_causes(data, effects)
    if not hypotheses:
        return None
    progress("single causes")
    design = begin(data, split)
    places = {name: sum(h[0] == name for h in hypotheses) for name in {h[0] for h in hypotheses}}
    problem = Response(
        base=design.at.bend(),
        used=used(data, split),
        places=places,
        rare=rare(data.ring, list(places)),
        judgement=judgement,
    )
    before = fit(problem, (), problem.first)
    count = int(problem.used.sum())
    if count > KICKS:
        hypotheses = [h for h in hypotheses if find(h[0]).responds]
    number = min(most, MOST)
    gap = max(before.chi2 - count, 1.0)
    enough = float(chi2.isf(judgement.noise[1], count))
    enough = max(enough, min(NOISE * count, count + REST * gap))
    if _beyond(problem, before, PATTERNS * number + SPARE) > enough:
        kicks = [h for h in hypotheses if not find(h[0]).responds]
        seen = scan(problem.metric(before.point), kicks, before.residual, effective=1.0)
        if seen.statistic.max(initial=0.0) < gap / 2:
            return None
    search = Search(
        problem, hypotheses, 1, unnamed=False, enough=enough, seed=seed, progress=progress
    )
    found = explain(search, before)
    if not found.fit.causes or before.chi2 - found.fit.chi2 < gap / (2 * number):
        return None  # the strongest of a few would explain its share
    if found.fit.chi2 > search.enough and number > 1:
        found = explain(replace(search, most=number), before)
    if found.fit.chi2 > search.enough:
        return None
    return few_told(data, split, found, before.point.view, count, judgement)


def _beyond(problem: Response, before: Fit, patterns: int) -> float:
    """Chi-square that the strongest patterns [column] x [monitor, plane] leave: a few causes cannot
    explain more, whatever they are; quick, where a scan is not."""
    left, _ = problem.left(before.point)
    size = np.linalg.svd(left.reshape(len(left), -1), compute_uv=False)
    return float((size[patterns:] ** 2).sum())


def used(data: ResponseData, split: Split) -> Flags:
    """Readings that the search fits, [column, monitor, 2]."""
    half = split.held.copy()
    half[-1] = True  # the RF
    return np.isfinite(data.orbits) & (~half[:, None] | split.half)[:, :, None]


def few_told(
    data: ResponseData,
    split: Split,
    found: Explanation,
    base: Predicted,
    count: int,
    judgement: Judgement,
) -> Few:
    """What a search says, with its causes as steps from what is known.

    Args:
        data, split: what the steps are judged by.
        found: by the search.
        base: what is known.
        count: of readings that were searched.
        judgement: thresholds.
    """
    causes = found.fit.causes
    p_value = float(chi2.sf(found.fit.chi2, count - len(causes)))
    findings = findings_of(data.ring, found, (), judgement)
    verdict, findings, said = verdict_of(
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
    dense = DenseFit(design, state, tuple(steps), (), heldout)
    return Few(dense, findings, verdict, list(zip(causes, errors, strict=True)), said)
