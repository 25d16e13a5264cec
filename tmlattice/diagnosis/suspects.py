"""Suspects: the first places to inspect for an undetected fault.

On a `distributed` verdict the search has no accepted findings, or distributed errors explain the
data. An undetected fault is most probable where the scan's statistic is largest. In a hierarchical
fit it is an amount that is an outlier of its family.

>>> [(one.kind, one.element) for one in suspects(ring, explanation, judgement)]
>>> [(one.element, one.amount) for one in outliers(ring, causes, errors, findings)]
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from tmlattice.arrays import TINY
from tmlattice.diagnosis.places import between
from tmlattice.diagnosis.records import OPTIONAL, of
from tmlattice.diagnosis.support import SHOWN
from tmlattice.effects import Cause, Hypothesis
from tmlattice.inference import chi2
from tmlattice.inference.judgement import ENOUGH, SIGNIFICANT, Judgement
from tmlattice.inference.search import Explanation
from tmlattice.lattice import Element, Ring

SuspectKind = Literal["monitor", "corrector", "magnet", "section"]


@dataclass(frozen=True)
class Suspect:
    """A BPM, a corrector, a magnet, or a section between two BPMs.

    Attributes:
        kind: which of them.
        effect: that explains most there; None: something without a name.
        element: the monitor, the corrector, or the element of the section that explains most.
        where: from the last monitor before to the first one behind, m.
        near: the names of those monitors.
        statistic: fall of chi-square by it; or, of an outlier of a family, its distance from the
            median in units of the family's scatter.
        threshold: of the whole scan; a larger one that is no finding is less probably a
            fault than a large distributed error. Or `SIGNIFICANT`.
        measure: "chi2" or "scatter": of which the statistic is.
        elements: all that share the amount.
        amount, amount_sigma: in the effect's unit; None of a scan's.
        device: what the control system calls the element; None: unknown.
    """

    kind: SuspectKind
    effect: str | None
    element: str
    where: tuple[float, float] = field(metadata=of("s_from", "s_to"))
    near: tuple[str, ...]
    statistic: float
    threshold: float
    measure: Literal["chi2", "scatter"] = "chi2"
    elements: tuple[str, ...] = ()
    amount: float | None = None
    amount_sigma: float | None = None
    device: str | None = field(default=None, metadata=OPTIONAL)


def suspects(ring: Ring, explanation: Explanation, judgement: Judgement) -> tuple[Suspect, ...]:
    """Return the first suspects of each kind, where the explanation does not explain the data: of
    the search, then of the scan."""
    candidates: list[tuple[str | None, str | None, float]] = [
        (cause.effect, cause.element, named.detection.statistic)
        for cause, named in zip(explanation.fit.causes, explanation.named, strict=True)
    ]
    candidates += [(None, ring.magnets[k].name, d.statistic) for k, d in explanation.kicks.items()]
    candidates += [
        (None, ring.monitors[m].name, d.statistic) for m, d in explanation.monitors.items()
    ]
    candidates.sort(key=lambda candidate: -candidate[2])
    scan = explanation.scan
    order = np.argsort(-scan.statistic)
    seen = order[scan.statistic[order] >= chi2.isf(judgement.false_alarm, 1)]  # by a single test
    candidates += [(*scan.hypotheses[i], float(scan.statistic[i])) for i in seen]
    found: dict[tuple[SuspectKind, object], Suspect] = {}
    places = {element.name: element for element in ring.elements}
    threshold = scan.threshold(judgement.false_alarm)
    for effect, name, statistic in candidates:
        if name is None or name not in places:
            continue  # the beam, or a family: no place to inspect
        element = places[name]
        where, near = between(ring, [element.s])
        kind = _kind(element)
        key: object = name
        if kind == "magnet":
            kind, key = "section", where
        if (kind, key) not in found and sum(k == kind for k, _ in found) < SHOWN:
            found[kind, key] = Suspect(
                kind, effect, name, where, near, statistic, threshold, elements=(name,)
            )
    return tuple(found.values())


def _kind(element: Element) -> SuspectKind:
    if element.kind == "monitor":
        return "monitor"
    return "corrector" if element.is_corrector else "magnet"


def outliers(
    ring: Ring, causes: Sequence[Cause], errors: Sequence[float], named: Iterable[Hypothesis]
) -> tuple[Suspect, ...]:
    """Return the outliers of their families in a hierarchical fit that are no findings, the largest
    first.

    Args:
        ring: the design.
        causes, errors: of the fit, with the standard error of each amount.
        named: effect and element of the findings.
    """
    found: list[Suspect] = []
    known, fitted = set(named), list(zip(causes, errors, strict=True))
    for effect in dict.fromkeys(cause.effect for cause in causes):
        own = numbers((c, s) for c, s in fitted if c.effect == effect and c.element is not None)
        if len(own) < ENOUGH:
            continue
        amounts = np.array([places[0].amount for places, _ in own])
        off = np.abs(amounts - np.median(amounts))
        scatter = float(chi2.typical(off))
        for (places, sigma), distance in zip(own, off, strict=True):
            times = float(distance / max(scatter, sigma, TINY))
            if times > SIGNIFICANT and not any((c.effect, c.element) in known for c in places):
                elements = tuple(c.element for c in places if c.element is not None)
                element = ring[elements[0]]
                found.append(
                    Suspect(
                        _kind(element), effect, element.name, *between(ring, [element.s]), times,
                        SIGNIFICANT, "scatter", elements, places[0].amount, sigma,
                    )
                )  # fmt: skip
    return tuple(sorted(found, key=lambda one: -one.statistic)[:ENOUGH])


def numbers(amounts: Iterable[tuple[Cause, float]]) -> list[tuple[tuple[Cause, ...], float]]:
    """Amounts with their errors; those of several places with one number (a magnet's pieces)
    together."""
    found: dict[tuple[float, float], tuple[list[Cause], float]] = {}
    for cause, sigma in amounts:
        one = bool(cause.amount) and sigma > 0
        own = (round(cause.amount / sigma, 9), sigma) if one else (float(len(found)), -1.0)
        found.setdefault(own, ([], sigma))[0].append(cause)
    return [(tuple(own), sigma) for own, sigma in found.values()]
