"""The closed orbit that small kicks make, as a family of a dense fit: what it does in sextupoles.

A response hardly sees a kick itself, but off their axis sextupoles focus and couple: on a ring with
usual alignment by more than the quadrupoles' own errors do. One kick looks like another one, so the
numbers are not kicks but patterns: those combinations of bends' kicks that focus most.

>>> families = orbit_families(ring, model)
"""

from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from tmlattice.beam.closed_orbit import ResponseModel
from tmlattice.beam.kicks import orbits_of_kicks
from tmlattice.diagnosis.families.family import Family, StatedCause
from tmlattice.effects import Cause, find
from tmlattice.inference.priors import Group
from tmlattice.lattice import Ring
from tmlattice.observe.orbit_response import Errors, Hypothesis, Predicted
from tmlattice.observe.response_data import ResponseData

Array = NDArray[np.float64]

LEAST = 0.02
"""Patterns that focus by less than this share of the strongest are left to the quadrupoles."""
TOGETHER = 32
"""Bends whose rows are held at a time."""


@dataclass(frozen=True, eq=False)
class _Orbit(Family):
    """Patterns of kicks.

    Attributes:
        places: bends.
        patterns: usual kicks of each, as the effect's amounts, [pattern, bend].
    """

    places: tuple[str, ...]
    patterns: Array

    per, trust = "ring", 1.0
    effect: ClassVar[str]

    @property
    def largest(self) -> float:
        """Patterns have none: a single kick makes all of them."""
        return 0.0

    def size(self, data: ResponseData) -> int:
        """Of the patterns."""
        return len(self.patterns)

    def groups(self, data: ResponseData) -> list[Group]:
        """In units of what is usual."""
        return [Group(self.name, np.eye(len(self.patterns)), 1.0)]

    def rows(self, at: Predicted, values: Array) -> Array:
        """Of all bends together."""
        out = np.zeros((len(self.patterns), at.data.orbits[..., 0].size))
        for start in range(0, len(self.places), TOGETHER):
            places = self.places[start : start + TOGETHER]
            pairs = [(self.effect, place) for place in places]
            slopes = [slope.ravel().copy() for slope in at.slopes_of(self.block, pairs)]
            out += self.patterns[:, start : start + TOGETHER] @ np.stack(slopes)
        return np.asarray(out.reshape(-1, *at.data.shape) * at.gain(self.block))

    def put(self, errors: Errors, values: Array, data: ResponseData) -> Errors:
        """As kicks of the bends."""
        amounts = (values @ self.patterns).tolist()
        causes = [Cause(self.effect, *one) for one in zip(self.places, amounts, strict=True)]
        return replace(errors, ring=(*errors.ring, *(c for c in causes if c.amount)))

    def causes_of(
        self, errors: Errors, values: Array, sigma: Array, data: ResponseData
    ) -> list[StatedCause]:
        """Nothing: other kicks make the same orbit."""
        return []

    def moves(self, data: ResponseData) -> list[dict[Hypothesis, float]]:
        """Kicks of all bends."""
        hypotheses: list[Hypothesis] = [(self.effect, place) for place in self.places]
        return [dict(zip(hypotheses, pattern, strict=True)) for pattern in self.patterns.tolist()]


class HorizontalOrbit(_Orbit):
    """By fields of bends: it focuses."""

    name, effect, effects = "horizontal orbit", "dipole_field", ("dipole_field",)
    block, variable = 0, "horizontal orbit"


class VerticalOrbit(_Orbit):
    """By rolls of bends: it couples."""

    name, effect, effects = "vertical orbit", "dipole_roll", ("dipole_roll",)
    block, variable = 1, "vertical orbit"


def orbit_families(ring: Ring, model: ResponseModel) -> list[Family]:
    """One of each plane; none without sextupoles or bends.

    Args:
        ring: the design.
        model: of it.
    """
    magnets = ring.magnets
    bends = [i for i, e in enumerate(magnets) if e.kind == "bend" and e.angle]
    strong = [i for i, e in enumerate(magnets) if e.kind == "sextupole" and e.k2]
    if not bends or not strong:
        return []
    found: list[Family] = []
    kinds: tuple[Any, ...] = (HorizontalOrbit, VerticalOrbit)
    for plane, kind in enumerate(kinds):
        kicks = np.array([abs(magnets[i].angle) for i in bends]) * find(kind.effect).background
        exits = np.array(strong) + 1
        moved = orbits_of_kicks(model, bends, exits, model.tangents[exits][:, 2 * plane], plane)
        moved = moved * kicks
        focused = moved * np.array([[magnets[i].k2 * magnets[i].length] for i in strong])
        _, size, patterns = np.linalg.svd(focused, full_matrices=False)
        kept = patterns[size > LEAST * size[0]] * find(kind.effect).background
        found.append(kind(tuple(magnets[i].name for i in bends), kept))
    return found
