"""Causes in the ring without a family (a misaligned sextupole, a device), as numbers of a fit.

>>> state = with_number(state, ("sextupole_offset_x", "sf::3"), block=0)
"""

from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from tmlattice.arrays import Array
from tmlattice.diagnosis.families.family import Family, StatedCause
from tmlattice.diagnosis.response.state import State
from tmlattice.effects import Cause, find
from tmlattice.inference.priors import Group
from tmlattice.observe.orbit_response import Errors, Hypothesis, Predicted
from tmlattice.observe.response_data import ResponseData


@dataclass(frozen=True, eq=False)
class _Others(Family):
    """Causes of one number each; their priors are those of single faults.

    Attributes:
        causes: effect and place.
    """

    causes: tuple[Hypothesis, ...] = ()

    per, trust, effects = "ring", 0.03, ()
    name: ClassVar[str]

    @property
    def units(self) -> Array:
        """Amounts in units of the effect's largest fault, [number]."""
        return np.array([find(effect).largest for effect, _ in self.causes])

    def size(self, data: ResponseData) -> int:
        """Number of causes."""
        return len(self.causes)

    def groups(self, data: ResponseData) -> list[Group]:
        """None: each number has the prior of its single fault."""
        return []

    def rows(self, at: Predicted, values: Array) -> Array:
        """Derivatives of the response."""
        out = np.empty((len(self.causes), *at.data.shape))
        gain, slopes = at.gain(self.block), at.slopes_of(self.block, self.causes)
        for row, slope, unit in zip(out, slopes, self.units, strict=True):
            row[:] = unit * slope * gain
        return out

    def put(self, errors: Errors, values: Array, data: ResponseData) -> Errors:
        """The errors with these causes in the ring."""
        own = zip(self.causes, (values * self.units).tolist(), strict=True)
        return replace(errors, ring=(*errors.ring, *(Cause(*h, a) for h, a in own if a)))

    def causes_of(
        self, errors: Errors, values: Array, sigma: Array, data: ResponseData
    ) -> list[StatedCause]:
        """The causes with their amounts."""
        amounts, sigmas = (values * self.units).tolist(), (sigma * self.units).tolist()
        rows = zip(self.causes, amounts, sigmas, strict=True)
        return [(Cause(*h, a), s) for h, a, s in rows]

    def moves(self, data: ResponseData) -> list[dict[Hypothesis, float]]:
        """The effect of each number, in its unit."""
        return [{h: u} for h, u in zip(self.causes, self.units.tolist(), strict=True)]


class OthersInPlane(_Others):
    """Causes whose amount the plane of the kick determines."""

    name, block, variable = "others in-plane", 0, "others in-plane"


class OthersAcross(_Others):
    """Causes whose amount the other plane determines."""

    name, block, variable = "others across", 1, "others across"


KINDS: tuple[Any, ...] = (OthersInPlane, OthersAcross)


def with_number(state: State, cause: Hypothesis, block: int) -> State:
    """The state with one more number, at zero."""
    kind = KINDS[block]
    have = next((f.causes for f in state.families if isinstance(f, kind)), ())
    if cause in have:
        return state
    families = [f for f in state.families if not isinstance(f, kind)]
    values = np.append(state.values.get(kind.variable, np.zeros(0)), 0.0)
    apart = tuple(
        replace(one, members=np.append(one.members, 0.0)) if one.variable == kind.variable else one
        for one in state.apart
    )
    return replace(
        state,
        apart=apart,
        families=(*families, kind((*have, cause))),
        values={**state.values, kind.variable: values},
    )
