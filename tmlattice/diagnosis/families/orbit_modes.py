"""Families of closed-orbit patterns by small kicks, which act through sextupoles.

A response is hardly sensitive to a kick itself, but off axis sextupoles focus and couple. With
usual alignment that exceeds the quadrupoles' own errors. Single kicks are degenerate, so the
numbers are amplitudes of patterns: the combinations of bends' kicks that focus most.

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
"""Share of the strongest pattern below which one is omitted; quadrupole gradients absorb it."""
TOGETHER = 32
"""Number of bends whose derivatives are computed at a time."""


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
        """Zero: patterns have no members that could be faulty."""
        return 0.0

    def size(self, data: ResponseData) -> int:
        """Number of patterns."""
        return len(self.patterns)

    def groups(self, data: ResponseData) -> list[Group]:
        """Amplitudes in units of usual kicks."""
        return [Group(self.name, np.eye(len(self.patterns)), 1.0)]

    def rows(self, at: Predicted, values: Array) -> Array:
        """Derivatives by the kicks of all bends."""
        out = np.zeros((len(self.patterns), at.data.orbits[..., 0].size))
        for start in range(0, len(self.places), TOGETHER):
            places = self.places[start : start + TOGETHER]
            pairs = [(self.effect, place) for place in places]
            slopes = [slope.ravel().copy() for slope in at.slopes_of(self.block, pairs)]
            out += self.patterns[:, start : start + TOGETHER] @ np.stack(slopes)
        return np.asarray(out.reshape(-1, *at.data.shape) * at.gain(self.block))

    def put(self, errors: Errors, values: Array, data: ResponseData) -> Errors:
        """The errors with the kicks of the bends."""
        amounts = (values @ self.patterns).tolist()
        causes = [Cause(self.effect, *one) for one in zip(self.places, amounts, strict=True)]
        return replace(errors, ring=(*errors.ring, *(c for c in causes if c.amount)))

    def causes_of(
        self, errors: Errors, values: Array, sigma: Array, data: ResponseData
    ) -> list[StatedCause]:
        """No causes: single kicks are degenerate."""
        return []

    def moves(self, data: ResponseData) -> list[dict[Hypothesis, float]]:
        """Kicks of all bends."""
        hypotheses: list[Hypothesis] = [(self.effect, place) for place in self.places]
        return [dict(zip(hypotheses, pattern, strict=True)) for pattern in self.patterns.tolist()]


class HorizontalOrbit(_Orbit):
    """The horizontal orbit by field errors of bends, which focuses in sextupoles."""

    name, effect, effects = "horizontal orbit", "dipole_field", ("dipole_field",)
    block, variable = 0, "horizontal orbit"


class VerticalOrbit(_Orbit):
    """The vertical orbit by rolls of bends, which couples in sextupoles."""

    name, effect, effects = "vertical orbit", "dipole_roll", ("dipole_roll",)
    block, variable = 1, "vertical orbit"


def orbit_families(ring: Ring, model: ResponseModel) -> list[Family]:
    """Return a family for each plane; none without sextupoles or bends.

    Args:
        ring: the design.
        model: of the design.
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
