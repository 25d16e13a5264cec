"""What a dense fit leaves open of a machine, and what a change of it looks like because of that.

A change between two measurements is seen in the machine that was fitted to the first one, whose
numbers are known with errors. What is not known of them moves no reading by itself, for it was
there before; but it moves what the change makes of the readings, by as much as the change is large.
So far the readings are blurred (`inference.among.Blurred`): amounts, rivals and statistics know it.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tmlattice.diagnosis.rounds import linear
from tmlattice.diagnosis.state import State
from tmlattice.effects import Cause
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


def left_open(state: State) -> LeftOpen:
    """By a fit that has settled, with its priors."""
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
        blocks.append(amounts)
    hypotheses = tuple(dict.fromkeys(h for own in blocks for h in own))
    where = {h: i for i, h in enumerate(hypotheses)}
    roots = []
    for own in blocks:
        root = np.zeros((len(hypotheses), len(next(iter(own.values())))))
        for hypothesis, number in own.items():
            root[where[hypothesis]] = number
        roots.append(root)
    return LeftOpen(hypotheses, np.hstack(roots) if roots else np.zeros((0, 0)))


def blurred(problem: Response, open_: LeftOpen, causes: Sequence[Cause]) -> Blurred:
    """A response's problem with what is not known of what some causes do.

    Raises:
        UnstableRingError: no closed orbit with them.
    """
    with_them, without = (
        problem.view(there).signatures(open_.hypotheses)
        for there in ((*problem.fixed, *causes), problem.fixed)
    )
    change = np.empty((len(open_.hypotheses), problem.used.size))
    for row, after, before in zip(change, with_them, without, strict=True):
        row[:] = (after - before).ravel()
    spread = open_.root.T @ change
    return Blurred(
        inner=problem, spread=spread.reshape(-1, *problem.used.shape), places=problem.places,
        rare=problem.rare, amounts=problem.amounts, judgement=problem.judgement,
    )  # fmt: skip
