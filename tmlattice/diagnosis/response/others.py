"""Causes in the ring without a family (a misaligned sextupole, a device), as numbers of a fit.

>>> state = with_number(state, ("sextupole_offset_x", "sf::3"), block=0)
"""

from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from tmlattice.diagnosis.families.family import RingFamily
from tmlattice.diagnosis.response.state import State
from tmlattice.effects import find
from tmlattice.inference.priors import Group
from tmlattice.observe.orbit_response import Hypothesis
from tmlattice.observe.response_data import ResponseData


@dataclass(frozen=True, eq=False)
class _Others(RingFamily):
    """Causes of one number each; their priors are those of single faults.

    Attributes:
        causes: effect and place.
    """

    causes: tuple[Hypothesis, ...] = ()

    trust, effects = 0.03, ()
    name: ClassVar[str]

    def groups(self, data: ResponseData) -> list[Group]:
        """None: each number has the prior of its single fault."""
        return []

    def moves(self, data: ResponseData) -> list[dict[Hypothesis, float]]:
        """Each number is in units of its effect's largest fault."""
        return [{cause: find(cause[0]).largest} for cause in self.causes]


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
