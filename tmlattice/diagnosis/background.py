"""A machine with small errors everywhere: the background against which a fault must be seen.

The errors are Gaussian with known rms, the same in all shots, and far too many to be found one by
one; what they do to the readings is a covariance. It is linear only about orbits near the true
ones, which small errors move by millimetres. So the likeliest errors are worked out, put into the
model, and the covariance is taken anew about that model; the data are moved so that the errors'
prior still stands about zero.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tmlattice.beam.model import Model, Paths
from tmlattice.effects import Cause
from tmlattice.inference.newton import Fit, fit
from tmlattice.inference.problem import Hypothesis
from tmlattice.inference.whitening import Whitening
from tmlattice.lattice import Ring
from tmlattice.observe.first_turns import FirstTurns

Array = NDArray[np.float64]

ROUNDS = 2
"""Linearisations: about the design, and about the likeliest errors."""


@dataclass(frozen=True)
class SmallErrors:
    """The background, linear about its likeliest amounts.

    Attributes:
        problem: with those amounts in its model, and in its data what the signatures make of them.
        before: launches alone, in this model.
        hypotheses, rms: of every error.
    """

    problem: FirstTurns
    before: Fit
    hypotheses: tuple[Hypothesis, ...]
    rms: Array

    def estimate(self, explained: Fit, whitening: Whitening) -> list[Cause]:
        """The likeliest small errors beside an explanation, which was found in this whitening."""
        assert self.problem.spread is not None
        rows = explained.clean.reshape(whitening.shots, -1)[:, :-5]
        weights = whitening.back(rows[None])[0]
        shares = np.einsum("esrp,srp->e", self.problem.spread, weights, optimize=True)
        amounts = (self.rms * shares).tolist()
        return [Cause(*h, amount) for h, amount in zip(self.hypotheses, amounts, strict=True)]

    def made_by(self, estimate: Sequence[Cause]) -> Array:
        """What small errors make of the readings, linearly, [shot, reading, 2], m."""
        assert self.problem.spread is not None
        amounts = np.array([cause.amount for cause in estimate]) / self.rms
        return np.asarray(np.einsum("e,esrp->srp", amounts, self.problem.spread, optimize=True))


def background_signatures(
    model: Model, paths: Paths, launches: Array, rms: Mapping[str, float]
) -> tuple[list[Hypothesis], Array, Array]:
    """Every small error along these trajectories.

    Args:
        model, paths, launches: the base.
        rms: by effect.

    Returns:
        Which they are; the rms of each, [error]; rms times signature, [error, shot, reading, 2], m.
    """
    hypotheses = model.hypotheses(list(rms))
    scale = np.array([rms[name] for name, _ in hypotheses])
    signatures = np.nan_to_num(model.signatures(paths, hypotheses, launches))
    return hypotheses, scale, scale[:, None, None, None] * signatures


def small_errors(
    ring: Ring,
    plain: FirstTurns,
    known: Sequence[Cause],
    rms: Mapping[str, float],
    launches: Array,
    causes: Sequence[Cause] = (),
    estimate: Sequence[Cause] = (),
) -> SmallErrors:
    """The background of a machine as these data show it.

    Args:
        ring: the design.
        plain: all shots, those of a reference too (it is the same machine), without small errors.
        known: causes that are there anyway.
        rms: by effect.
        launches: first guess, [shot, 5].
        causes: what was found already: small errors act along the orbit that it makes.
        estimate: the likeliest small errors beside it.
    """
    fixed, data = tuple(causes), plain.data
    for _ in range(1 if estimate else ROUNDS):
        model = Model(ring, data.settings, data.turns, [*known, *estimate], active=data.active)
        alone = fit(replace(plain, model=model, fixed=fixed), (), launches)
        paths = alone.point.view
        hypotheses, scale, spread = background_signatures(model, paths, alone.nuisances, rms)
        amounts = np.array([cause.amount for cause in estimate] or np.zeros(len(scale)))
        moved = np.einsum("e,esrp->srp", amounts / scale, spread, optimize=True)
        shifted = replace(data, readings=data.readings + np.where(data.valid, moved, 0.0))
        problem = replace(plain, model=model, data=shifted, fixed=fixed, spread=spread, white=None)
        explained = fit(problem, (), alone.nuisances)
        launches = explained.nuisances
        problem = replace(problem, fixed=())
        small = SmallErrors(problem, explained, tuple(hypotheses), scale)
        estimate = small.estimate(explained, problem.whitening)
    if fixed:
        small = replace(small, before=fit(problem, (), launches))
    return small
