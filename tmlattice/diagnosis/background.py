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

from tmlattice.beam.model import Hypothesis, Model, Paths
from tmlattice.effects import Cause
from tmlattice.inference.newton import Fit, Problem, fit
from tmlattice.inference.whitening import Whitening
from tmlattice.lattice import Ring
from tmlattice.observe.data import Data

Array = NDArray[np.float64]

ROUNDS = 2
"""Linearisations: about the design, and about the likeliest errors."""


@dataclass(frozen=True)
class SmallErrors:
    """The background, linear about its likeliest amounts.

    Attributes:
        model: with those amounts in it.
        data: readings plus what the signatures make of the amounts.
        spread: rms times signature of every error, [error, shot, reading, 2], m.
        whitening: of these data with this spread.
        before: launches alone, in this model.
        hypotheses, rms: of every error.
    """

    model: Model
    data: Data
    spread: Array
    whitening: Whitening
    before: Fit
    hypotheses: tuple[Hypothesis, ...]
    rms: Array

    def estimate(self, explained: Fit, whitening: Whitening) -> list[Cause]:
        """The likeliest small errors beside an explanation, which was found in this whitening."""
        clean = explained.projection.out(explained.residual)
        return _causes(self.hypotheses, self.rms, self.spread, whitening, clean)

    def made_by(self, estimate: Sequence[Cause]) -> Array:
        """What small errors make of the readings, linearly, [shot, reading, 2], m."""
        amounts = np.array([cause.amount for cause in estimate]) / self.rms
        return np.asarray(np.einsum("e,esrp->srp", amounts, self.spread, optimize=True))


def _causes(
    hypotheses: Sequence[Hypothesis], rms: Array, spread: Array, whitening: Whitening, clean: Array
) -> list[Cause]:
    rows = clean.reshape(whitening.shots, -1)[:, :-5]
    weights = whitening.back(rows[None])[0]
    amounts = rms * np.einsum("esrp,srp->e", spread, weights, optimize=True)
    return [Cause(*h, float(a)) for h, a in zip(hypotheses, amounts, strict=True)]


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
    data: Data,
    known: Sequence[Cause],
    rms: Mapping[str, float],
    launches: Array,
    causes: Sequence[Cause] = (),
    estimate: Sequence[Cause] = (),
) -> SmallErrors:
    """The background of a machine as these data show it.

    Args:
        ring: the design.
        data: all shots, those of a reference too: it is the same machine.
        known: causes that are there anyway.
        rms: by effect.
        launches: first guess, [shot, 5].
        causes: what was found already: small errors act along the orbit that it makes.
        estimate: the likeliest small errors beside it.
    """
    fixed = tuple(causes)
    for _ in range(1 if estimate else ROUNDS):
        model = Model(ring, data.settings, data.turns, [*known, *estimate], active=data.active)
        alone = fit(Problem(model, data, Whitening(data), {}, fixed), (), launches)
        hypotheses, scale, spread = background_signatures(model, alone.paths, launches, rms)
        amounts = np.array([cause.amount for cause in estimate] or np.zeros(len(scale)))
        moved = np.einsum("e,esrp->srp", amounts / scale, spread, optimize=True)
        shifted = replace(data, readings=data.readings + np.where(data.valid, moved, 0.0))
        whitening = Whitening(shifted, spread)
        explained = fit(Problem(model, shifted, whitening, {}, fixed), (), alone.launches)
        launches = explained.launches
        clean = explained.projection.out(explained.residual)
        estimate = _causes(hypotheses, scale, spread, whitening, clean)
    before = explained
    if fixed:
        before = fit(Problem(model, shifted, whitening, {}), (), launches)
    return SmallErrors(model, shifted, spread, whitening, before, tuple(hypotheses), scale)
