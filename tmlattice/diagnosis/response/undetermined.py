"""Undetermined errors of a machine after a hierarchical fit, and their effect on a change.

A change between two measurements is fitted in the machine of the first one, whose errors have
uncertainties. Their effect on the readings cancels in the difference, but their effect on the
change does not: it scales with the change. Amounts, alternatives and statistics include it, for one
change (`Blur`) and for many (`linear.with_numbers`).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import block_diag

from tmlattice.arrays import Array
from tmlattice.diagnosis.families.dispersion import HorizontalOrbit, VerticalOrbit
from tmlattice.diagnosis.response.linear import linear
from tmlattice.diagnosis.response.state import State
from tmlattice.effects import Cause, background_rms, find
from tmlattice.inference.distributed import MarginalProblem
from tmlattice.inference.problem import Hypothesis
from tmlattice.lattice import Ring
from tmlattice.observe.response_problem import Response


@dataclass(frozen=True, eq=False)
class Undetermined:
    """Gaussian errors of a machine that are undetermined.

    Attributes:
        hypotheses: effects and places of the errors.
        root: their amounts by independent errors of size 1, [hypothesis, error].
    """

    hypotheses: tuple[Hypothesis, ...]
    root: Array


ORBITS = (
    *HorizontalOrbit.effects, *VerticalOrbit.effects, "sextupole_offset_x", "sextupole_offset_y",
)  # fmt: skip
"""Effects that make orbits: a response hardly shows them, but a change of sextupoles does."""


def undetermined(state: State) -> Undetermined:
    """Return the undetermined errors of a converged fit, with its priors."""
    blocks: list[dict[Hypothesis, Array]] = []
    for block in (block for block in (0, 1) if state.of_block(block)):
        there = linear(state, block)
        found = there.posterior
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
    hypotheses = tuple(dict.fromkeys(h for own in blocks for h in own))
    where = {h: i for i, h in enumerate(hypotheses)}
    roots = []
    for own in blocks:
        root = np.zeros((len(hypotheses), len(next(iter(own.values())))))
        for hypothesis, number in own.items():
            root[where[hypothesis]] = number
        roots.append(root)
    return Undetermined(hypotheses, np.hstack([np.zeros((len(hypotheses), 0)), *roots]))


def and_orbits(ring: Ring, open_: Undetermined) -> Undetermined:
    """Return the errors together with those that make orbits of the usual size."""
    usual = background_rms(dict.fromkeys(ORBITS))
    unseen = [(name, place) for name in ORBITS for place in find(name).places(ring)]
    alone = np.diag([usual[name] for name, _ in unseen])
    return Undetermined((*open_.hypotheses, *unseen), block_diag(open_.root, alone))


STRONGEST, HARDLY = 200, 0.1
"""Most errors that are kept, and the least effect of one, in units of the readings' noise."""


def strongest(problem: Response, open_: Undetermined, causes: Sequence[Cause]) -> Undetermined:
    """Return the combinations of errors with the largest effect on the changes of causes.

    Raises:
        UnstableRingError: no closed orbit with the causes.
    """
    views = problem.view(()), problem.view(causes)
    slopes = (view.signatures(open_.hypotheses) for view in views)
    noise = np.broadcast_to(problem.base.data.noise, problem.used.shape)[problem.used]
    moved = np.array([
        np.linalg.norm((with_them - without)[problem.used] / noise)
        for without, with_them in zip(*slopes, strict=True)
    ])  # fmt: skip
    moved *= np.sqrt(np.sum(open_.root**2, axis=1))
    order = np.argsort(-moved, kind="stable")[:STRONGEST]
    kept = np.sort(order[moved[order] > HARDLY])
    root = np.linalg.qr(open_.root[kept].T)[1].T
    return Undetermined(tuple(open_.hypotheses[i] for i in kept), root)


class Blur:
    """A problem with undetermined errors of the machine.

    Args:
        problem: of the response in that machine.
        open_: its undetermined errors.
    """

    def __init__(self, problem: Response, open_: Undetermined) -> None:
        self.problem, self.open = problem, open_

    @cached_property
    def _without(self) -> Array:
        """Signatures of unchanged causes, [hypothesis, reading]."""
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

    def among(self, spread: Array) -> MarginalProblem:
        """The problem with these undetermined errors."""
        own = self.problem
        return MarginalProblem(
            inner=own, spread=spread, places=own.places, rare=own.rare, amounts=own.amounts,
            judgement=own.judgement,
        )  # fmt: skip
