"""The effect of each single cause on an orbit response, given all usual distributed errors.

>>> seen = Seen(state, suspects_of(state, single_causes(state.data)))

A cause that is one number of a family (a quadrupole's gradient, a gain, a roll), or a sum of some
(a supply), is in the normal equations already. Others (a misaligned sextupole, a device) are
compared by their signatures; the usual errors of their effect, of which the fit has no family,
reduce their statistics. Once detected, they are numbers, too (`with_number`).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from tmlattice.arrays import REDUNDANT, Array
from tmlattice.diagnosis.families.family import RingFamily
from tmlattice.diagnosis.families.fields import QuadrupoleGradient, SkewGradient
from tmlattice.diagnosis.response.linear import Linear, gathered, linear
from tmlattice.diagnosis.response.small_errors import sizes_in
from tmlattice.diagnosis.response.state import Candidate, State
from tmlattice.diagnosis.response.weights import weighed, weight
from tmlattice.effects import RingEffect, find
from tmlattice.effects.quadrupoles import FamilyGradient
from tmlattice.inference.normal import solve
from tmlattice.inference.priors import Group
from tmlattice.observe.orbit_response import Hypothesis
from tmlattice.observe.response_data import ResponseData

AFFORDABLE = 4e9
"""Most products of signatures and derivatives; above it only numbers of families are compared."""


# --- causes without a family ----------------------------------------------------------------------
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


# --- candidates -----------------------------------------------------------------------------------
def suspects_of(state: State, causes: Sequence[Hypothesis]) -> list[Candidate]:
    """Return the suspects of causes that the readings may determine."""
    numbers = _numbers(state)
    found, signed = [], []
    for cause in causes:
        if cause in numbers:
            block, variable, at, share = numbers[cause]
            members = np.zeros(len(state.values[variable]))
            members[at] = share
            found.append(Candidate(cause, block, variable, members))
        elif cause[1] is not None and isinstance(find(cause[0]), RingEffect):
            signed.append(Candidate(cause))
    size = sum(len(values) for values in state.values.values())
    if len(signed) * state.data.orbits.size * size <= AFFORDABLE:
        found += signed
    return found


def _numbers(state: State) -> dict[Hypothesis, tuple[int, str, list[int], list[float]]]:
    """Causes that are numbers of the fit: block, variable, members, and factors."""
    data, ring = state.data, state.data.ring
    out: dict[Hypothesis, tuple[int, str, list[int], list[float]]] = {}
    for family in state.families:
        if family.name == "monitor_gain":
            for m, name in enumerate(data.measured.monitors):
                for p, plane in enumerate("xy"):
                    key = (f"monitor_gain_{plane}", ring[name].name)
                    out[key] = (0, family.variable, [2 * m + p], [1.0])
        elif family.name == "monitor_roll":
            for m, name in enumerate(data.measured.monitors):
                for effect, across in (("monitor_roll", -1.0), ("monitor_coupling", 1.0)):
                    key = (effect, ring[name].name)
                    out[key] = (1, family.variable, [2 * m, 2 * m + 1], [1.0, across])
        elif family.per == "column":
            for c, name in enumerate(data.measured.correctors):
                # a roll's number is a share of the stated kick, not of the actual one
                kick = 1 + state.at.errors.calibration[c] if family.block else 1.0
                out[(family.name, ring[name].name)] = (family.block, family.variable, [c], [kick])
        elif isinstance(family, QuadrupoleGradient):
            _of_gradients(family, state, out)
        elif isinstance(family, SkewGradient):
            for i, pieces in enumerate(family.shares(data)):
                for name, share in pieces.items():
                    out[("skew_gradient", name)] = (1, family.variable, [i], [1.0])
                    strength = ring[name].k1 * ring[name].length
                    if strength and len(pieces) == 1:
                        turned = [-2 * strength / share]
                        out[("quadrupole_roll", name)] = (1, family.variable, [i], turned)
        elif family.per == "ring":
            for i, moves in enumerate(family.moves(data)):
                for cause, share in moves.items():
                    if len(moves) == 1 and cause[1] is not None:
                        out[cause] = (family.block, family.variable, [i], [1 / share])
    return out


def _of_gradients(
    family: QuadrupoleGradient,
    state: State,
    out: dict[Hypothesis, tuple[int, str, list[int], list[float]]],
) -> None:
    """Causes of single numbers, of supplies, and the same in absolute units."""
    ring = state.data.ring
    places = {name: i for i, own in enumerate(family.shares(state.data)) for name in own}
    for name, i in places.items():
        out[("quadrupole_gradient", name)] = (0, family.variable, [i], [1.0])
        strength = ring[name].k1 * ring[name].length
        out[("gradient_absolute", name)] = (0, family.variable, [i], [1 / strength])
    supply = FamilyGradient()
    for place in supply.places(ring):
        members = [ring.elements[i].name for i in supply.members(ring, place)]
        own = sorted({places[name] for name in members if name in places})
        if len(own) > 1:
            out[(supply.name, place)] = (0, family.variable, own, [1.0] * len(own))


# --- products -------------------------------------------------------------------------------------
@dataclass(frozen=True, eq=False)
class _Block:
    """Products of one block: the fit, its residual, and each suspect's products with both.

    Attributes:
        there: the fit.
        sizes: the distributed errors' priors, without those of single faults.
        across: J^T W S, [number, suspect].
        own, left: S^T W S, and S^T W r, [suspect].
    """

    there: Linear
    sizes: tuple[Group, ...]
    across: Array
    own: Array
    left: Array


@dataclass(frozen=True, eq=False)
class Weighed:
    """The statistics of each suspect given distributed errors.

    Attributes:
        statistic: fall of chi-square, given the usual scatter of the amount, [suspect].
        amount, sigma: best amount, and its error, [suspect].
        information: by block, [2, suspect].
    """

    statistic: Array
    amount: Array
    sigma: Array
    information: Array


class Seen:
    """The products of all suspects at a fit.

    Args:
        state: with distributed errors, and with the single faults so far.
        suspects: to be compared.
    """

    def __init__(self, state: State, suspects: Sequence[Candidate]) -> None:
        self.state, self.suspects = state, suspects
        alone = ["", *(kind.variable for kind in KINDS)]
        self.scatter = np.array([(find(one.cause[0]).background or 0.0) * (one.variable in alone)
                                 for one in suspects])  # fmt: skip
        blocks = [block for block in (0, 1) if state.of_block(block)]
        there = {block: linear(state, block) for block in blocks}
        self.blocks = {block: self._block(block, there[block]) for block in blocks}
        self._by_signature()

    def _block(self, block: int, there: Linear) -> _Block:
        across = np.zeros((len(there.normal.vector), len(self.suspects)))
        for h, one in enumerate(self.suspects):
            if one.block == block and one.variable in there.where:
                across[there.where[one.variable], h] = one.members
        left = there.normal.vector @ across
        spread = there.normal.matrix @ across
        own = np.einsum("nh,nh->h", across, spread)
        return _Block(there, sizes_in(there), spread, own, left)

    def _by_signature(self) -> None:
        state = self.state
        some = [h for h, one in enumerate(self.suspects) if one.block is None]
        weights = {block: weight(state, block) for block in self.blocks}
        left = {
            block: np.where(w > 0, state.data.pick(state.at.left, block), 0.0)
            for block, w in weights.items()
        }
        signatures = state.at.signatures([self.suspects[h].cause for h in some])
        for h, signature in zip(some, signatures, strict=True):
            for block, it in self.blocks.items():
                row = np.where(weights[block] > 0, state.data.pick(signature, block), 0.0)
                heavy = weighed(state, block, row)
                it.own[h] = np.sum(heavy * row)
                it.left[h] = np.sum(heavy * left[block])
                it.across[:, h] = gathered(it.there, state.data.plane_of(block), heavy)

    def beside(self, without: str | None = None) -> Weighed:
        """Return the statistics of each suspect, given distributed errors and accepted faults.

        Args:
            without: name of the prior of an accepted fault that is replaced by its alternatives.
        """
        shape = (2, len(self.suspects))
        information, inner = np.zeros(shape), np.zeros(shape)
        for block, it in self.blocks.items():
            priors = [group for group in it.sizes if group.name != without]
            found = solve(it.there.normal, priors, it.there.start, rounds=0)
            along = found.spread.T @ it.across
            taken = np.einsum("ph,ph->h", along, found.covariance @ along)
            information[block] = np.maximum(it.own - taken, 0.0)
            information[block][information[block] < REDUNDANT * it.own] = 0.0
            inner[block] = it.left - (found.values - it.there.start) @ it.across
        inner[information == 0] = 0.0
        total = information.sum(axis=0)
        safe = np.where(total > 0, total, 1.0)
        pull = inner.sum(axis=0)
        amount = np.where(total > 0, pull / safe, 0.0)
        sigma = np.where(total > 0, 1 / np.sqrt(safe), np.inf)
        statistic = amount * pull / (1 + total * self.scatter**2)
        return Weighed(statistic, amount, sigma, information)
