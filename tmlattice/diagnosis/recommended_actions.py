"""Recommended actions: explanations that the same adjustment corrects are one action.

A thin gradient in the middle of a quadrupole and a wrong strength of it are two hypotheses with one
action: set the gradient of that magnet. The catalogue lists which effects share an action, and in
which amount (`Effect.corrected_as`). The pieces of a magnet are one.

>>> action = recommended_actions(ring, alternatives, probability)[0]
>>> action.action, action.amount, action.probability
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import chain
from typing import Any

import numpy as np

from tmlattice.arrays import Array
from tmlattice.diagnosis.records import HIDDEN, OPTIONAL, of, record_of
from tmlattice.diagnosis.support import share_of_fault
from tmlattice.effects import CATALOGUE, Cause, RingEffect, find
from tmlattice.effects.effect import FamilyEffect, StrengthEffect
from tmlattice.lattice import Element, Kind, Ring

STRENGTHS = {"k1": "1/m2", "k2": "1/m3"}
"""Strengths reported before and after, with their units."""


@dataclass(frozen=True)
class Strength:
    """The designed and the estimated strength of a magnet."""

    name: str
    unit: str
    before: float
    after: float


@dataclass(frozen=True)
class RecommendedAction:
    """A correction at one place.

    Attributes:
        effect, element: that the recommended action is named for; None for the beam.
        pieces: of the magnet that the element is a piece of, or the element alone; empty for the
            beam.
        kind: of the element; of a family that of its members.
        amount, amount_sigma: in that effect's unit: its own where it is among the explanations,
            else that of the most probable one.
        probability: of all explanations that share it.
        mechanisms: their effects with their probabilities, the most probable first.
        strength: of the magnet, designed and found, where the effect scales one.
        device: what the control system calls the element; None: unknown.
    """

    effect: str
    element: str | None
    pieces: tuple[str, ...]
    kind: Kind | None = field(metadata=HIDDEN)
    amount: float
    amount_sigma: float | None
    probability: float
    mechanisms: tuple[tuple[str, float], ...] = field(metadata=of("effect", "probability"))
    strength: Strength | None
    device: str | None = field(default=None, metadata=OPTIONAL)

    @property
    def cause(self) -> Cause:
        """The cause that the action corrects."""
        return Cause(self.effect, self.element, self.amount)

    @property
    def action(self) -> str:
        """The action in words."""
        return action(self.effect, self.pieces)

    def as_json(self) -> dict[str, Any]:
        """The entry in the file of the diagnosis."""
        effect = find(self.effect)
        return record_of(self) | {
            "action": self.action,
            "check": effect.to_check,
            "quantity": effect.quantity or effect.words,
            "share_from_data": share_of_fault(self.effect, self.amount_sigma),
            "unit": effect.unit,
            "probability": min(self.probability, 1.0),  # a sum of shares
        }


def action(effect: str, pieces: Sequence[str]) -> str:
    """The correction of an effect, in words."""
    return find(effect).recommended_action.replace("{}", " + ".join(pieces) or "the ring")


def pieces_of(ring: Ring, name: str | None) -> tuple[str, ...]:
    """The pieces of an element's magnet; a family's name, or an element's, alone."""
    if name is None:
        return ()
    return ring.pieces(name) if _is_element(ring, name) else (name,)


def leading(ring: Ring, cause: Cause) -> Cause:
    """The cause whose action corrects this one too, with the equivalent amount."""
    if cause.element is None or not _is_element(ring, cause.element):
        return cause
    effect, scale = find(cause.effect).corrected_as(ring[cause.element])
    return Cause(effect, cause.element, scale * cause.amount)


def recommended_action(ring: Ring, cause: Cause) -> str:
    """The correction of a cause, in words; equal for causes with one action."""
    lead = leading(ring, cause)
    return action(lead.effect, pieces_of(ring, lead.element))


def recommended_actions(
    ring: Ring,
    causes: Sequence[Cause],
    probability: Sequence[float] | Array,
    sigma: float | None = None,
) -> tuple[RecommendedAction, ...]:
    """Return the recommended actions of alternative explanations.

    Args:
        ring: the design.
        causes: of the alternatives, most probable first.
        probability: of each.
        sigma: standard error of the first one's amount.

    Returns:
        That of the first one first, the others by falling probability.
    """
    alike: dict[tuple[str, tuple[str, ...]], list[tuple[Cause, Cause, float]]] = {}
    for cause, share in zip(causes, np.asarray(probability).tolist(), strict=True):
        lead = leading(ring, cause)
        key = (lead.effect, pieces_of(ring, lead.element))
        alike.setdefault(key, []).append((cause, lead, share))
    found = []
    for (effect, pieces), own in alike.items():
        shares: dict[str, float] = {}
        for cause, _, share in own:  # of the same effect, in other pieces, added up
            shares[cause.effect] = shares.get(cause.effect, 0.0) + share
        cause, lead, _ = own[0]
        error = None
        if cause is causes[0] and sigma is not None:
            error = sigma * abs(lead.amount / cause.amount) if cause.amount else sigma
        # its own fit is better than a converted thin one
        best = next((one for made_of, one, _ in own if made_of.effect == effect), lead)
        best = best if best.element == lead.element else lead
        found.append(RecommendedAction(
            effect, lead.element, pieces, element_kind(ring, lead.element), best.amount, error,
            sum(share for *_, share in own), tuple(shares.items()), _strength(ring, best),
        ))  # fmt: skip
    return (*found[:1], *sorted(found[1:], key=lambda action: -action.probability))


def fewest(probability: Sequence[float] | Array, mass: float) -> int:
    """How many, by falling probability, reach the mass."""
    return int(np.searchsorted(np.cumsum(probability), mass)) + 1


def credible(
    recommended_actions: Sequence[RecommendedAction], mass: float
) -> tuple[RecommendedAction, ...]:
    """The fewest actions whose probabilities reach the mass, the first one first."""
    order = sorted(recommended_actions, key=lambda action: -action.probability)
    count = fewest([action.probability for action in order], mass)
    return (recommended_actions[0], *(r for r in order[:count] if r is not recommended_actions[0]))


def _is_element(ring: Ring, name: str) -> bool:
    return any(element.name == name for element in ring.elements)


def element_kind(ring: Ring, name: str | None) -> Kind | None:
    """The kind of an element, or of a family's members; None for the beam."""
    own = (i for i, element in enumerate(ring.elements) if element.name == name)
    families = (effect for effect in CATALOGUE.values() if isinstance(effect, FamilyEffect))
    shared = (i for effect in families for i in effect.members(ring, name))
    first = next(chain(own, shared), None)
    return None if first is None else ring.elements[first].kind


def _strength(ring: Ring, cause: Cause) -> Strength | None:
    """The common strength of the magnets that an effect scales; None where they differ."""
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


def compensated(ring: Ring, causes: Sequence[Cause]) -> tuple[Ring, tuple[Cause, ...]]:
    """Return the ring with settings that correct the causes, and the causes that no setting
    corrects.

    With the causes in it, a magnet of the returned ring acts as the given ring's does: a quadrupole
    that is 20 % too weak is set 25 % higher. The second result has what must be moved, turned,
    calibrated or repaired, and errors of BPMs or the beam. Natural effects are ignored.
    """
    settings: dict[int, Element] = {}
    by_hand: list[Cause] = []
    for cause in reversed(causes):  # the last that acts is corrected first
        effect = find(cause.effect)
        if effect.natural:
            continue
        if not isinstance(effect, RingEffect) or effect.acts_on_settings:
            by_hand.append(cause)
            continue
        places = effect.members(ring, cause.element)
        corrected = [
            effect.compensated(settings.get(i, ring.elements[i]), cause.amount) for i in places
        ]
        if any(element is None for element in corrected):
            by_hand.append(cause)
            continue
        settings |= {i: e for i, e in zip(places, corrected, strict=True) if e is not None}
    return ring.with_elements(settings), tuple(reversed(by_hand))
