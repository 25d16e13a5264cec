"""What is to be done about a finding: explanations that the same adjustment takes away are one.

A thin gradient in the middle of a quadrupole and a wrong strength of it are two hypotheses and one
line in a logbook: the gradient of that magnet. Which effects share a action at an element, and in
which amount, the catalogue says (`Effect.stands_for`). A magnet that stands in pieces is one.

>>> action = recommended_actions(ring, rivals, probability)[0]
>>> action.action, action.amount, action.probability
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tmlattice.diagnosis.support import share_of_fault
from tmlattice.effects import CATALOGUE, Cause, RingEffect, find
from tmlattice.effects.effect import FamilyEffect, StrengthEffect
from tmlattice.lattice import Element, Kind, Ring

Array = NDArray[np.float64]

STRENGTHS = {"k1": "1/m2", "k2": "1/m3"}
"""Strengths that a recommended action tells before and after, with their units."""


@dataclass(frozen=True)
class Strength:
    """What a magnet is designed to have and what it was found to have."""

    name: str
    unit: str
    before: float
    after: float


@dataclass(frozen=True)
class RecommendedAction:
    """What takes a finding away at one place.

    Attributes:
        effect, element: that the recommended action is named for; None for the beam.
        pieces: of the magnet that the element is a piece of, or the element alone; empty for the
            beam.
        kind: of the element; of a family that of its members.
        amount, amount_sigma: in that effect's unit: its own where it is among the explanations,
            else that of the likeliest one.
        probability: of all explanations that share it.
        mechanisms: their effects with their probabilities, the likeliest first.
        strength: of the magnet, designed and found, where the effect scales one.
        device: what the control system calls the element; None: unknown.
    """

    effect: str
    element: str | None
    pieces: tuple[str, ...]
    kind: Kind | None
    amount: float
    amount_sigma: float | None
    probability: float
    mechanisms: tuple[tuple[str, float], ...]
    strength: Strength | None
    device: str | None = None

    @property
    def cause(self) -> Cause:
        """What is told to be wrong."""
        return Cause(self.effect, self.element, self.amount)

    @property
    def action(self) -> str:
        """What to do, in words."""
        return action(self.effect, self.pieces)

    def as_json(self) -> dict[str, Any]:
        """As it stands in the diagnosis."""
        effect = find(self.effect)
        return {
            "action": self.action,
            "check": effect.to_check,
            "effect": self.effect,
            "element": self.element,
            "pieces": list(self.pieces),
            "quantity": effect.quantity or effect.words,
            "amount": self.amount,
            "amount_sigma": self.amount_sigma,
            "share_from_data": share_of_fault(self.effect, self.amount_sigma),
            "unit": effect.unit,
            "strength": None if self.strength is None else dict(vars(self.strength)),
            "probability": min(self.probability, 1.0),  # a sum of shares
            "mechanisms": [{"effect": e, "probability": p} for e, p in self.mechanisms],
            **({} if self.device is None else {"device": self.device}),
        }


def action(effect: str, pieces: Sequence[str]) -> str:
    """What takes an effect away, in words."""
    return find(effect).recommended_action.replace("{}", " + ".join(pieces) or "the ring")


def pieces_of(ring: Ring, name: str | None) -> tuple[str, ...]:
    """Of the magnet that an element is a piece of; a family's name, or an element's, alone."""
    if name is None:
        return ()
    return ring.pieces(name) if _is_element(ring, name) else (name,)


def leading(ring: Ring, cause: Cause) -> Cause:
    """The cause whose action takes this one away too, with the amount that does as much."""
    if cause.element is None or not _is_element(ring, cause.element):
        return cause
    effect, scale = find(cause.effect).stands_for(ring[cause.element])
    return Cause(effect, cause.element, scale * cause.amount)


def recommended_action(ring: Ring, cause: Cause) -> str:
    """What takes a cause away, in words: the same for causes that one adjustment takes away."""
    lead = leading(ring, cause)
    return action(lead.effect, pieces_of(ring, lead.element))


def recommended_actions(
    ring: Ring,
    causes: Sequence[Cause],
    probability: Sequence[float] | Array,
    sigma: float | None = None,
) -> tuple[RecommendedAction, ...]:
    """The recommended actions of rival explanations.

    Args:
        ring: the design.
        causes: of the rivals, likeliest first.
        probability: of each.
        sigma: standard error of the first one's amount.

    Returns:
        That of the first one first, the others by falling probability.
    """
    found: dict[tuple[str, tuple[str, ...]], RecommendedAction] = {}
    for cause, share in zip(causes, np.asarray(probability).tolist(), strict=True):
        lead = leading(ring, cause)
        key = (lead.effect, pieces_of(ring, lead.element))
        own = ((cause.effect, share),)
        if key in found:
            known = found[key]
            known = replace(
                known, probability=known.probability + share, mechanisms=_more(known, *own)
            )
            thin = known.effect not in [effect for effect, _ in found[key].mechanisms]
            if thin and cause.effect == lead.effect and lead.element == known.element:
                # its own fit is better than a thin one converted
                known = replace(known, amount=lead.amount, strength=_strength(ring, lead))
            found[key] = known
            continue
        error = None
        if cause is causes[0] and sigma is not None:
            error = sigma * abs(lead.amount / cause.amount) if cause.amount else sigma
        found[key] = RecommendedAction(
            lead.effect, lead.element, key[1], element_kind(ring, lead.element), lead.amount,
            error, share, own, _strength(ring, lead),
        )  # fmt: skip
    if not found:
        return ()
    first, *rest = found.values()
    return (first, *sorted(rest, key=lambda recommended_action: -recommended_action.probability))


def _more(known: RecommendedAction, mechanism: tuple[str, float]) -> tuple[tuple[str, float], ...]:
    """Mechanisms with one more, those of the same effect (in other pieces) added up."""
    shares = dict(known.mechanisms)
    shares[mechanism[0]] = shares.get(mechanism[0], 0.0) + mechanism[1]
    return tuple(shares.items())


def credible(
    recommended_actions: Sequence[RecommendedAction], mass: float
) -> tuple[RecommendedAction, ...]:
    """The fewest that hold the mass, the first with them."""
    order = sorted(
        recommended_actions, key=lambda recommended_action: -recommended_action.probability
    )
    count = int(np.searchsorted(np.cumsum([r.probability for r in order]), mass)) + 1
    return (recommended_actions[0], *(r for r in order[:count] if r is not recommended_actions[0]))


def _is_element(ring: Ring, name: str) -> bool:
    return any(element.name == name for element in ring.elements)


def _members(ring: Ring, name: str | None) -> list[Element]:
    """The element of this name, or the family's."""
    own = [element for element in ring.elements if element.name == name]
    families = (effect for effect in CATALOGUE.values() if isinstance(effect, FamilyEffect))
    shared = (effect.members(ring, name) for effect in families)
    return own or [ring.elements[i] for i in next((some for some in shared if some), ())]


def element_kind(ring: Ring, name: str | None) -> Kind | None:
    """The kind of an element, or of a family's members; None for the beam."""
    return next((element.kind for element in _members(ring, name)), None)


def _strength(ring: Ring, cause: Cause) -> Strength | None:
    """Of the magnets that an effect scales, where they all have the same."""
    effect = find(cause.effect)
    if not isinstance(effect, StrengthEffect) or effect.strength not in STRENGTHS:
        return None
    members = [ring.elements[i] for i in effect.members(ring, cause.element)]
    designed = {getattr(member, effect.strength) for member in members}
    if len(designed) != 1:
        return None
    (before,) = designed
    unit = STRENGTHS[effect.strength]
    return Strength(effect.strength, unit, before, before * (1 + cause.amount))


def undone(ring: Ring, causes: Sequence[Cause]) -> tuple[Ring, tuple[Cause, ...]]:
    """The ring with the settings that take causes away, and the causes that no setting does.

    With the causes in it, a magnet of the returned ring acts as the given ring's does: a quadrupole
    that gives 20 % less than it is told is told 25 % more. What has to be moved, turned, calibrated
    or mended, and what is wrong with monitors or the beam, is handed back; known physics that is no
    fault is passed over.
    """
    settings: dict[int, Element] = {}
    by_hand: list[Cause] = []
    for cause in reversed(causes):  # the last that acts is undone first
        effect = find(cause.effect)
        if effect.natural:
            continue
        if not isinstance(effect, RingEffect) or effect.acts_on_settings:
            by_hand.append(cause)
            continue
        places = effect.members(ring, cause.element)
        told = [effect.undone(settings.get(i, ring.elements[i]), cause.amount) for i in places]
        if any(element is None for element in told):
            by_hand.append(cause)
            continue
        settings |= {i: e for i, e in zip(places, told, strict=True) if e is not None}
    return ring.with_elements(settings), tuple(reversed(by_hand))
