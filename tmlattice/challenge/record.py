"""Comparison of an answer with the truth, as one flat row of plain values.

An answer is that of the diagnosis, the oracle or a baseline, in the diagnosis' JSON. Two elements
are within one monitor gap if at most one monitor is between them.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from tmlattice.challenge.figures import RATES
from tmlattice.diagnosis.recommended_actions import leading, pieces_of, recommended_actions
from tmlattice.effects import Cause, find
from tmlattice.inference.judgement import DEFAULT
from tmlattice.lattice import Ring

Pair = tuple[str | None, str | None]

ALIASED = 10.0
"""Residual of an unknown after the best catalogue member, in sigma, below which it is aliased."""

REFUSED = ("localised", "distributed")


class Places:
    """Positions of elements, families and monitors."""

    def __init__(self, ring: Ring) -> None:
        self.ring = ring
        self.monitors = np.array([monitor.s for monitor in ring.monitors])
        self.s: dict[str, list[float]] = {}
        for element in ring.elements:
            self.s.setdefault(element.name, []).append(element.s)
        for element in ring.elements:
            if element.kind in ("quadrupole", "sextupole") and element.family not in self.s:
                members = [e.s for e in ring.elements if e.family == element.family]
                self.s[element.family] = members

    def between(self, a: float, b: float) -> int:
        """Number of monitors strictly between two positions."""
        low, high = min(a, b) + 1e-9, max(a, b) - 1e-9
        return int(np.sum((low < self.monitors) & (self.monitors < high)))

    def near(self, true: str | None, found: Sequence[float]) -> bool:
        """Whether one of the positions is within one monitor gap of one of the element's."""
        if true is None:
            return False
        return any(self.between(a, b) <= 1 for a in self.s[true] for b in found)

    def of(self, element: str | None, s: float | None) -> list[float]:
        """Return the positions of a finding."""
        if element is not None and element in self.s:
            return self.s[element]
        return [] if s is None else [s]


def pairs(finding: Mapping[str, Any]) -> list[Pair]:
    """Return the credible set of a finding, the most probable first."""
    return [(m["effect"], m["element"]) for m in finding["credible_set"]]


def finding_row(finding: Mapping[str, Any] | None, cause: Cause, places: Places) -> dict[str, Any]:
    """Return how one finding matches one true cause."""
    true = (cause.effect, cause.element)
    if finding is None:
        empty = {"elements": 0, "members": 0, "mass": None, "probability": None, "pull": None}
        return dict.fromkeys(RATES[1:], False) | empty
    members = pairs(finding)
    elements = list(dict.fromkeys(element for _, element in members))
    effects = list(dict.fromkeys(effect for effect, _ in members))
    first = (finding["effect"], finding["element"])
    if cause.element is None:
        place = first == true  # the beam has no place but its name
    else:
        place = places.near(cause.element, places.of(finding["element"], finding["s"]))
    named = finding["effect"] is not None
    pull = None
    sigma = finding.get("amount_sigma")
    if first == true and sigma and not find(cause.effect).discrete:
        found, amount = float(finding["amount"]), cause.amount
        if find(cause.effect).power == 2:
            found, amount = abs(found), abs(amount)
        pull = float((found - amount) / sigma)
    return {
        "place": place,
        # a baseline may give an element without an effect
        "element_first": (named or cause.element is not None)
        and finding["element"] == cause.element,
        "element_in_three": cause.element in elements[:3],
        "element_in_set": cause.element in elements,
        "effect_first": finding["effect"] == cause.effect,
        "effect_in_set": cause.effect in effects,
        "first": first == true,
        "in_set": true in members,
        "elements": len(elements),
        "members": len(members),
        "mass": finding.get("mass"),
        "probability": finding.get("probability"),
        "pull": pull,
    }


def one_action(result: Mapping[str, Any], cause: Cause, ring: Ring) -> bool | None:
    """Whether the answer is one finding, named, with the action that corrects the true cause;
    None for an old result without recommended actions."""
    if any("recommended_action" not in finding for finding in result["findings"]):
        return None
    if result["verdict"] != "identified" or len(result["findings"]) != 1:
        return False
    found, true = result["findings"][0]["recommended_action"], leading(ring, cause)
    places = (pieces_of(ring, name) for name in (found["element"], true.element))
    return found["effect"] == true.effect and next(places) == next(places)


def oracle_one_action(evaluated: Mapping[str, Any], cause: Cause, ring: Ring) -> bool:
    """The same of the exact posterior: whether one action, the true one, holds the mass."""
    (oracle,) = evaluated["oracles"]
    members = [m for m in oracle["posterior"] if m["probability"]]
    causes = [Cause(m["effect"], m["element"], m["amount"]) for m in members]
    actions = recommended_actions(ring, causes, [m["probability"] for m in members])
    first = max(actions, key=lambda action: action.probability, default=None)
    if not oracle["detected"] or first is None or first.probability < DEFAULT.mass:
        return False
    true = leading(ring, cause)
    return (first.effect, first.pieces) == (true.effect, pieces_of(ring, true.element))


def column(result: Mapping[str, Any], cause: Cause) -> str:
    """Return the column of the confusion table."""
    if not result["findings"]:
        refused = result["verdict"] == "distributed" and not result.get("priors")
        return "unknown" if refused else "none"
    finding = result["findings"][0]
    if finding["effect"] is None:
        return "unknown"
    if finding["effect"] == cause.effect:
        return cause.effect
    if cause.effect in {effect for effect, _ in pairs(finding)}:
        return "ambiguous"
    return str(finding["effect"])


def stated(result: Mapping[str, Any], causes: Sequence[Cause]) -> list[tuple[float, bool]]:
    """Return stated probabilities of members of credible sets, and whether each is true."""
    true = {(cause.effect, cause.element) for cause in causes}
    return [
        (float(m["probability"]), (m["effect"], m["element"]) in true)
        for finding in result["findings"]
        for m in finding["credible_set"]
    ]


def exact(result: Mapping[str, Any], causes: Sequence[Cause]) -> bool:
    """Whether every cause is in the credible set of one finding each, without further findings."""
    findings = list(result["findings"])
    if len(findings) != len(causes):
        return False
    wanted = [{(c.effect, c.element)} for c in causes]
    fits = np.array([[bool(w & set(pairs(f))) for f in findings] for w in wanted])
    from scipy.optimize import linear_sum_assignment

    rows, columns = linear_sum_assignment(~fits)
    return bool(fits[rows, columns].all())


def oracle_answer(evaluated: Mapping[str, Any], ranking: str) -> dict[str, Any]:
    """Return the oracle's answer in the form of a diagnosis.

    Args:
        evaluated: see `evaluate`.
        ranking: "class", all within a chi-square of 9, or "posterior", a 95 % credible set.
    """
    findings = [_oracle_finding(o, ranking) for o in evaluated["oracles"] if o["detected"]]
    if not findings:
        return {"verdict": "none", "findings": []}
    several = any(len(finding["credible_set"]) > 1 for finding in findings)
    return {"verdict": "ambiguous" if several else "identified", "findings": findings}


def _oracle_finding(oracle: Mapping[str, Any], ranking: str) -> dict[str, Any]:
    members = list(oracle[ranking])
    if ranking == "posterior":
        total = np.cumsum([m["probability"] or 0.0 for m in members])  # null: invisible
        members = members[: int(np.searchsorted(total, 0.95)) + 1]
    first = members[0]
    return {
        **{key: first[key] for key in ("effect", "element", "amount", "probability")},
        "s": None,
        "amount_sigma": float(abs(first["amount"]) / np.sqrt(max(first["statistic"], 1e-300))),
        "credible_set": members,
        "mass": float(sum(m["probability"] for m in members)),
    }


def baseline_answer(
    guesses: Sequence[Mapping[str, Any]], separate: int | None = None
) -> dict[str, Any]:
    """Return a baseline's answer in the form of a diagnosis; it always has a finding.

    Args:
        guesses: see `baselines`.
        separate: number of guesses that are findings of their own; None: one finding.
    """
    parts = [list(guesses)] if separate is None else [[guess] for guess in guesses[:separate]]
    findings = []
    for part in parts:
        members = [{**g, "probability": 1 / len(part)} for g in part]
        if part:
            findings.append({**part[0], "s": None, "amount": None, "credible_set": members})
    return {"verdict": "identified" if findings else "none", "findings": findings}
