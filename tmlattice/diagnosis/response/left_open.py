"""What a dense fit leaves open of a machine, and what a change of it looks like because of that.

A change between two measurements is seen in the machine that was fitted to the first one, whose
numbers are known with errors. What is not known of them moves no reading by itself, for it was
there before; but it moves what the change makes of the readings, by as much as the change is large.
So far the readings are blurred (`inference.among.Blurred`): amounts, rivals and statistics know it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from tmlattice.diagnosis.response.rounds import linear
from tmlattice.diagnosis.response.state import State
from tmlattice.effects import Cause, background_rms, find
from tmlattice.inference.among import Blurred
from tmlattice.inference.normal import solve
from tmlattice.inference.problem import Hypothesis
from tmlattice.observe.response_problem import Response

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class LeftOpen:
    """Errors of a machine that are not known, Gaussian.

    Attributes:
        hypotheses: what they are errors of.
        root: their amounts by independent ones of size 1, [hypothesis, error].
    """

    hypotheses: tuple[Hypothesis, ...]
    root: Array

    def size(self, problem: Response) -> int:
        """Numbers that have to be held."""
        return len(self.hypotheses) * problem.used.size


ORBITS = (
    "quadrupole_offset_x", "quadrupole_offset_y", "dipole_field", "dipole_roll",
    "sextupole_offset_x", "sextupole_offset_y",
)  # fmt: skip
"""What makes orbits, and what sextupoles make of them: a response shows hardly anything of it, and
a change of sextupoles does."""


def left_open(state: State) -> LeftOpen:
    """By a fit that has settled, with its priors; and orbits as large as usual errors make them."""
    blocks: list[dict[Hypothesis, Array]] = []
    for block in (block for block in (0, 1) if state.of_block(block)):
        there = linear(state, block)
        found = solve(there.normal, there.groups, there.start, rounds=0)
        numbers = found.spread @ np.linalg.cholesky(found.covariance)
        amounts: dict[Hypothesis, Array] = {}
        for family in {f.variable: f for f in state.of_block(block)}.values():
            moved = zip(
                numbers[there.where[family.variable]], family.moves(state.data), strict=True
            )
            for number, moves in moved:
                for hypothesis, share in moves.items():
                    amounts[hypothesis] = share * number + amounts.get(hypothesis, 0.0)
        if amounts:
            blocks.append(amounts)
    usual = background_rms(dict.fromkeys(ORBITS))
    unseen = [(name, place) for name in ORBITS for place in find(name).places(state.data.ring)]
    blocks += [{h: np.eye(len(unseen))[i] * usual[h[0]] for i, h in enumerate(unseen)}]
    hypotheses = tuple(dict.fromkeys(h for own in blocks for h in own))
    where = {h: i for i, h in enumerate(hypotheses)}
    roots = []
    for own in blocks:
        root = np.zeros((len(hypotheses), len(next(iter(own.values())))))
        for hypothesis, number in own.items():
            root[where[hypothesis]] = number
        roots.append(root)
    return LeftOpen(hypotheses, np.hstack(roots))


class Blur:
    """What is not known of what causes do, in one machine.

    Args:
        problem: of the response in that machine.
        open_: what is not known of it.
    """

    def __init__(self, problem: Response, open_: LeftOpen) -> None:
        self.problem, self.open = problem, open_

    @cached_property
    def _without(self) -> Array:
        """Signatures where nothing changed, [hypothesis, reading]."""
        return self._signatures(())

    def _signatures(self, causes: Sequence[Cause]) -> Array:
        view = self.problem.view((*self.problem.fixed, *causes))
        out = np.empty((len(self.open.hypotheses), self.problem.used.size))
        for row, signature in zip(out, view.signatures(self.open.hypotheses), strict=True):
            row[:] = signature.ravel()
        return out

    def of(self, causes: Sequence[Cause]) -> Array:
        """d reading / d error, m, [error, *shape of the readings].

        Raises:
            UnstableRingError: no closed orbit with them.
        """
        spread = self.open.root.T @ (self._signatures(causes) - self._without)
        return np.asarray(spread.reshape(-1, *self.problem.used.shape))

    def among(self, spread: Array) -> Blurred:
        """The problem among errors that make so much of the readings."""
        own = self.problem
        return Blurred(
            inner=own, spread=spread, places=own.places, rare=own.rare, amounts=own.amounts,
            judgement=own.judgement,
        )  # fmt: skip
