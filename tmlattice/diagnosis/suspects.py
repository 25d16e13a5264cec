"""Where to look first when no few causes explain the data: suspects, not findings.

On a `distributed` verdict what the search found stands no longer, or small errors everywhere
explain the data and nothing stands out; yet what the scan sees most of is where a fault would be,
if there is one among them.

>>> [(one.kind, one.element) for one in suspects(ring, explanation, judgement)]
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from tmlattice.diagnosis.places import between
from tmlattice.inference.judgement import Judgement
from tmlattice.inference.search import Explanation
from tmlattice.lattice import Ring

MOST = 3
"""Suspects of each kind."""

FLOOR = 9.0
"""Fall of chi-square from which on a hypothesis is suspect: 3 sigma of one looked at alone."""

SuspectKind = Literal["monitor", "corrector", "section"]


@dataclass(frozen=True)
class Suspect:
    """A monitor, a corrector, or what stands between two monitors.

    Attributes:
        kind: which of them.
        effect: that explains most there; None: something without a name.
        element: the monitor, the corrector, or the element of the section that explains most.
        where: from the last monitor before to the first one behind, m.
        near: the names of those monitors.
        statistic: fall of chi-square by it.
        threshold: of the whole scan. What exceeds it and is no finding is less likely to be a fault
            than a large one of the small errors everywhere.
    """

    kind: SuspectKind
    effect: str | None
    element: str
    where: tuple[float, float]
    near: tuple[str, ...]
    statistic: float
    threshold: float

    def as_json(self) -> dict[str, Any]:
        """As it stands in the diagnosis."""
        return {
            "kind": self.kind,
            "effect": self.effect,
            "element": self.element,
            "where": {"s_from": self.where[0], "s_to": self.where[1]},
            "near": list(self.near),
            "statistic": self.statistic,
            "threshold": self.threshold,
        }


Candidate = tuple[str | None, str, float]
"""Effect, element, statistic."""


def suspects(ring: Ring, explanation: Explanation, judgement: Judgement) -> tuple[Suspect, ...]:
    """The first of each kind: what the search found, then what the scan behind it sees most of.

    Args:
        ring: the design.
        explanation: that does not explain the data.
        judgement: its thresholds.
    """
    found: dict[tuple[SuspectKind, object], Suspect] = {}
    places = {element.name: element for element in ring.elements}
    threshold = explanation.scan.threshold(judgement.false_alarm)
    for effect, name, statistic in _candidates(ring, explanation):
        if name not in places:
            continue  # the beam, or a family: no place to look at
        element = places[name]
        where, near = between(ring, [element.s])
        kind: SuspectKind = "section"
        key: object = where
        if element.kind == "monitor":
            kind, key = "monitor", name
        elif element.kind in ("hcorrector", "vcorrector"):
            kind, key = "corrector", name
        if (kind, key) not in found and sum(k == kind for k, _ in found) < MOST:
            found[kind, key] = Suspect(kind, effect, name, where, near, statistic, threshold)
    return tuple(found.values())


def _candidates(ring: Ring, explanation: Explanation) -> Iterator[Candidate]:
    """By falling statistic: of the search, then of the scan of what it leaves."""
    told: list[Candidate] = [
        (cause.effect, cause.element, named.detection.statistic)
        for cause, named in zip(explanation.fit.causes, explanation.named, strict=True)
        if cause.element is not None
    ]
    told += [(None, ring.magnets[k].name, d.statistic) for k, d in explanation.kicks.items()]
    told += [(None, ring.monitors[m].name, d.statistic) for m, d in explanation.monitors.items()]
    yield from sorted(told, key=lambda candidate: -candidate[2])
    scan = explanation.scan
    for i in np.argsort(-scan.statistic):
        if scan.statistic[i] < FLOOR:
            break
        effect, name = scan.hypotheses[int(i)]
        if name is not None:
            yield effect, name, float(scan.statistic[i])
