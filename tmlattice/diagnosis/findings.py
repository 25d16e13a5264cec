"""Findings of a search: each with alternatives, place and probability."""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from tmlattice.arrays import Array
from tmlattice.diagnosis.consequences import consequences
from tmlattice.diagnosis.places import between
from tmlattice.diagnosis.recommended_actions import credible as credible_actions
from tmlattice.diagnosis.recommended_actions import fewest, recommended_action, recommended_actions
from tmlattice.diagnosis.response.state import State
from tmlattice.diagnosis.result import VERDICTS, Finding, Member, faults_of
from tmlattice.effects import CATALOGUE, Cause, Hypothesis, RingEffect, find
from tmlattice.inference.alternatives import Alternative, Detection
from tmlattice.inference.judgement import Judgement
from tmlattice.inference.newton import ITERATIONS, Outcome, fit
from tmlattice.inference.scan import FreeScan, Scan, look_elsewhere
from tmlattice.inference.search import Explanation
from tmlattice.lattice import Element, Ring


def credible(rivals: Sequence[Alternative], mass: float) -> tuple[list[Alternative], Array]:
    """The most probable alternatives within the credible set, and the probabilities of all."""
    evidence = np.array([rival.fit.log_evidence for rival in rivals])
    probability = np.exp(evidence - evidence.max())
    probability /= probability.sum()
    return list(rivals[: fewest(probability, mass)]), probability


def finished(explanation: Explanation) -> Explanation:
    """The fit of the causes, iterated until it converges or reaches the maximum."""
    last = explanation.fit
    if last.outcome is not Outcome.STEPS:
        return explanation
    again = fit(explanation.problem, last.causes, last.nuisances, last.kicks, steps=ITERATIONS)
    return replace(explanation, fit=again) if again.good else explanation


def findings_of(
    ring: Ring, explanation: Explanation, dead: Sequence[tuple[int, float]], judgement: Judgement
) -> tuple[Finding, ...]:
    """Findings by falling statistic: named causes, unexplained kicks, rejected and dead BPMs."""
    found, fitted = [], explanation.fit
    sigmas = np.sqrt(np.maximum(np.diag(fitted.covariance), 0.0)).tolist()
    for k, named in enumerate(explanation.named):
        _, probability = credible(named.alternatives, judgement.mass)
        causes = [fitted.causes[k], *(m.cause for m in named.alternatives[1:])]
        found.append(
            finding_of(ring, causes, probability, sigmas[k], named.detection, judgement.mass)
        )
    for layer, detection in explanation.kicks.items():
        found.append(located(ring, ring.magnets[layer], detection))
    for m, detection in explanation.monitors.items():
        found.append(located(ring, ring.monitors[m], detection))
    sure = Detection(float("inf"), float("nan"), 0.0)  # the readings alone show the fault
    for m, amount in dead:
        cause = Cause("monitor_dead", ring.monitors[m].name, amount)
        found.append(finding_of(ring, [cause], np.ones(1), 0.0, sure, judgement.mass))
    return strongest_first(found)


def cause_of(found: Finding) -> Cause:
    """The hypothesis as a cause with its amount."""
    return Cause(found.effect or "", found.element, found.amount or 0.0)


def strongest_first(found: Iterable[Finding]) -> tuple[Finding, ...]:
    """Findings by falling statistic."""
    return tuple(sorted(found, key=lambda own: -own.detection.statistic))


def least_certain(found: Sequence[Finding], without: str) -> str:
    """The verdict of the least certain finding; without findings by the remainder."""
    return max((own.verdict for own in found), key=VERDICTS.index) if found else without


def finding_of(
    ring: Ring,
    causes: Sequence[Cause],
    probability: Array,
    sigma: float,
    detection: Detection,
    mass: float,
) -> Finding:
    """The finding of a named cause.

    Args:
        ring: the design.
        causes: the cause, and its alternatives by falling probability.
        probability: of each.
        sigma: standard error of the amount.
        detection: how clearly it was seen.
        mass: of the credible set.
    """
    cause, shown = causes[0], causes[: fewest(probability, mass)]
    actions = recommended_actions(ring, causes, probability, sigma)
    positions = [s for m in shown for s in _positions(ring, (m.effect, m.element))]
    where, near = between(ring, positions) if positions else (None, ())
    return Finding(
        effect=cause.effect,
        element=cause.element,
        s=_middle(ring, cause.element),
        amount=cause.amount,
        amount_sigma=sigma,
        unit=find(cause.effect).unit,
        probability=min(actions[0].probability, 1.0),
        detection=detection,
        where=where,
        near=near,
        credible_set=tuple(
            Member(
                m.effect,
                m.element,
                _middle(ring, m.element),
                float(p),
                m.amount,
                recommended_action(ring, m),
            )
            for m, p in zip(shown, probability, strict=False)
        ),
        mass=float(probability[: len(shown)].sum()),
        recommended_actions=credible_actions(actions, mass),
    )


def located(ring: Ring, element: Element, detection: Detection) -> Finding:
    """The finding of a kick without a named cause."""
    where, near = between(ring, [element.s])
    near = tuple(dict.fromkeys((*near[:1], element.name, *near[1:])))
    return Finding(s=element.s, detection=detection, where=where, near=near)


def with_consequences(
    ring: Ring, findings: Sequence[Finding], causes: Sequence[Cause]
) -> tuple[Finding, ...]:
    """The findings with their effects on the stored beam of the design's settings."""
    if not findings:
        return ()
    effects = consequences(ring, faults_of(findings, causes))
    actions = [finding.recommended_action for finding in findings]
    return tuple(
        replace(
            finding,
            consequences=None if action is None else effects.get((action.effect, action.element)),
        )
        for finding, action in zip(findings, actions, strict=True)
    )


def _middle(ring: Ring, name: str | None) -> float | None:
    return next((e.s for e in ring.elements if e.name == name), None)


def _positions(ring: Ring, hypothesis: Hypothesis) -> list[float]:
    """Positions of all elements that a hypothesis touches, m."""
    place = _middle(ring, hypothesis[1])
    if place is not None:
        return [place]
    effect = find(hypothesis[0])
    if hypothesis[1] is None or not isinstance(effect, RingEffect):
        return []
    return [ring.elements[i].s for i in effect.members(ring, hypothesis[1])]


def verdict_of(
    explanation: Explanation,
    findings: tuple[Finding, ...],
    p_value: float,
    estimated: bool,
    judgement: Judgement,
    refuted: str = "",
) -> tuple[str, tuple[Finding, ...], tuple[str, ...]]:
    """The verdict, the accepted findings, and the notes."""
    _, far_more = judgement.noise
    if findings and (why := refuted or _no_solution(explanation)):
        return "distributed", (), (f"no cause is named: {why}",)
    if explanation.full and explanation.scan.chance < judgement.false_alarm:
        many = f"as many as {len(findings)} causes do" if len(findings) > 1 else "one cause does"
        return "distributed", (), (f"{many} not explain the data",)
    clean = "none" if p_value >= far_more or estimated else "distributed"
    return least_certain(findings, clean), findings, ()


def _no_solution(explanation: Explanation) -> str:
    """The reason why the fit of the findings is rejected; empty where it is accepted."""
    last, before = explanation.fit, explanation.before
    if not (last.causes or last.kicks):
        return ""
    if last.outcome is Outcome.STEPS:
        return f"the fit did not converge ({last.outcome.value})"
    if last.chi2 > before.chi2:
        return f"with them chi-square rises from {before.chi2:.4g} to {last.chi2:.4g}"
    return ""


def unexplained(ring: Ring, left: FreeScan, p_value: float, judgement: Judgement) -> dict[str, Any]:
    """The test of the remaining residual, and its place."""
    places: list[dict[str, float]] = []
    taken: set[float] = set()
    for i in np.argsort(-left.gain)[:200]:
        statistic, freedom = float(left.statistic[i]), max(int(left.freedom[i]), 1)
        chance = look_elsewhere(statistic, freedom, len(left.gain))
        if len(places) == 3 or chance > judgement.false_alarm:
            break
        (start, end), _ = between(ring, [ring.magnets[int(i)].s])
        if start not in taken:
            taken.add(start)
            places.append({"s_from": start, "s_to": end, "statistic": statistic})
    return {"p_value": p_value, "places": places}


def sensitivity(found: Scan, judgement: Judgement) -> dict[str, float]:
    """Detection limits: by effect, the amount that reaches the threshold at half of its places."""
    threshold = found.threshold(judgement.false_alarm)
    amounts: dict[str, list[float]] = {}
    for (name, _), information in zip(found.hypotheses, found.information, strict=True):
        if information > 0 and not CATALOGUE[name].discrete:
            least = np.sqrt(threshold / information) ** (1 / CATALOGUE[name].power)
            amounts.setdefault(name, []).append(float(least))
    return {name: float(np.median(values)) for name, values in amounts.items()}


def swap_of(state: State, name: str, judgement: Judgement) -> Finding:
    """The finding of a BPM with swapped planes."""
    data = state.data
    at = data.measured.monitors.index(name)
    model, d = state.at.read[:, at], data.orbits[:, at]
    as_read = np.nansum((d[:, ::-1] - model) ** 2 - (d - model) ** 2, axis=0)
    statistic = float(np.sum(as_read / data.noise[at] ** 2))
    cause = Cause("monitor_swap", data.ring[name].name, 1.0)
    seen = Detection.among(statistic, 2 * len(data.at))
    return finding_of(data.ring, [cause], np.ones(1), 0.0, seen, judgement.mass)
