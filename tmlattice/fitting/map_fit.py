"""Fine-tuning by the most probable changes of all strengths, given the readings.

Every powered quadrupole and sextupole has a relative change with a Gaussian prior. `Prior.FAULTS`
has a wide one for the magnets that `sparse` selects and a narrow one for all others: most strengths
are nearly right, a few have large errors. Gauss-Newton starts at the changes of `sparse`.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import solve_triangular

from tmlattice.arrays import Array
from tmlattice.effects import Cause, Hypothesis
from tmlattice.errors import UnstableRingError, choice
from tmlattice.fitting.adam import FitResult
from tmlattice.fitting.sparse import FAULT, first_turns, fitted, searched, warn_of_launches
from tmlattice.inference.distributed import components_of_rows
from tmlattice.inference.newton import fit_nuisances
from tmlattice.inference.problem import Point
from tmlattice.lattice import Ring
from tmlattice.measurement import Measurement
from tmlattice.network import TaylorNetwork
from tmlattice.observe.first_turns import FirstTurns
from tmlattice.optics import RingTunes, short_way


class Prior(StrEnum):
    """Prior of the relative changes."""

    FAULTS = "faults"
    """Any size for the magnets that `sparse` selects, 0.01 % rms by default for the others."""
    STRENGTHS = "strengths"
    """The same rms for all magnets, by default that of the largest marginal likelihood."""


STRENGTH_RMS = 0.01
"""Unit of the scale, relative."""

FAULT_SCALE = 0.01
"""Default scale of the magnets without a fault."""

STEPS = 8
"""Steps of Gauss-Newton, at most: one or two from the changes of `sparse`."""

STEP = 1e-5
"""Relative change of a strength, for slopes of the tunes."""

SETTLED = 0.01
"""Change of the readings over their noise, below which the fit has converged."""


@dataclass(frozen=True)
class MostProbable:
    """Most probable changes, and the problem and the model with them.

    Attributes:
        hypotheses: (effect, magnet), [magnet].
        amounts, rms: relative changes, and those of the prior, [magnet].
        spread: root of their covariance, [magnet, magnet]: spread spread^T.
    """

    problem: FirstTurns
    hypotheses: Sequence[Hypothesis]
    amounts: Array
    rms: Array
    spread: Array
    point: Point
    chi2: tuple[float, ...]


def most_probable(
    problem: FirstTurns, hypotheses: Sequence[Hypothesis], amounts: Array, rms: Array, learn: bool
) -> MostProbable:
    """Return the most probable changes, and their covariance.

    Args:
        hypotheses: (effect, magnet).
        amounts: first guess, [magnet].
        rms: of the prior, [magnet].
    """
    chi2, nuisances = list[float](), problem.first
    while True:
        own = zip(hypotheses, amounts.tolist(), strict=True)
        model = problem.model.knowing([Cause(*h, a) for h, a in own])
        there = replace(problem, model=model)
        point = fit_nuisances(there, (), nuisances)
        if point.projection is None:
            raise UnstableRingError(
                f"{point.lost} with the fitted magnets; test the measurement by `tmlattice check`"
            )
        nuisances = point.nuisances
        rows = there.metric(point).rows(hypotheses)
        residual = point.residual + amounts @ rows
        if learn:
            one, directions = np.zeros(len(rms), dtype=np.int64), point.projection.matrix()
            found = components_of_rows(residual, directions, rms[:, None] * rows, one)
            rms = rms * found.scale[0]
        # (1 + A A^T)^-1 by a triangle: prior less data would cancel for small noise
        A = point.projection.out(rms[:, None] * rows)
        triangle = np.linalg.qr(np.concatenate([A.T, np.eye(len(rms))]), mode="r")
        spread = rms[:, None] * solve_triangular(triangle, np.eye(len(rms)))
        best = spread @ (spread.T @ (A @ residual / rms))
        chi2.append(point.chi2)
        moved = np.abs(point.projection.out((best - amounts) @ rows)).max()
        if moved < SETTLED or len(chi2) > STEPS:
            return MostProbable(there, hypotheses, amounts, rms, spread, point, tuple(chi2))
        amounts = best


def fit_map(
    network: TaylorNetwork,
    measurement: Measurement,
    *,
    ring: Ring | None = None,
    prior: Prior | str = Prior.FAULTS,
    kinds: Sequence[str] = ("quadrupole", "sextupole"),
    scale: float | None = None,
    noise: float | None = None,
    launch_sigma: ArrayLike | None = None,
    progress: bool = True,
) -> FitResult:
    """Fit a measurement's first turn by the most probable changes under a prior.

    Args:
        ring: of the network; None: the network's own `ring`.
        scale: rms of the prior, in %; None: 0.01 % for faults, else that of the largest marginal
            likelihood.
        noise: rms of one reading, m; else the measurement's.
        launch_sigma: see `fine_tune`.

    Returns:
        The network of the most probable ring, its tunes, and their standard error by the posterior
        covariance. It is valid if the prior is: `Prior.STRENGTHS` describes many small changes, not
        one magnet with an error of 20 %.
    """
    begun = time.perf_counter()
    prior = choice("prior", prior, Prior)
    sparse = searched(network, measurement, ring, kinds, noise, launch_sigma)
    hypotheses = sparse.first.hypotheses
    start = np.zeros(len(hypotheses))
    for cause in sparse.fit.causes:
        start[hypotheses.index((cause.effect, cause.element))] = cause.amount
    rms = np.full(len(start), STRENGTH_RMS * (FAULT_SCALE if scale is None else scale))
    if prior is Prior.FAULTS:
        warn_of_launches(sparse)
        rms = np.where(start, FAULT, rms)
    learn = scale is None and prior is Prior.STRENGTHS
    found = most_probable(first_turns(sparse), hypotheses, start, rms, learn)
    tunes, sigma = _tunes(found)
    return fitted(
        sparse,
        [Cause(*h, a) for h, a in zip(hypotheses, found.amounts.tolist(), strict=True)],
        np.linalg.norm(found.spread, axis=1).tolist(),
        found.point.nuisances,
        found.chi2,
        options={
            "method": "map",
            "prior": prior.value,
            "kinds": list(kinds),
            "scale": found.rms.min() / STRENGTH_RMS,
            "noise": noise,
            "launch_sigma": None if launch_sigma is None else np.ravel(launch_sigma).tolist(),
        },
        seconds=time.perf_counter() - begun,
        tunes=tunes,
        tune_sigma=sigma,
    )


def _tunes(found: MostProbable) -> tuple[Array, Array] | tuple[None, None]:
    """Tunes and their standard errors, [2] each; None of an unstable ring."""
    turn = RingTunes(found.problem.model.assembly)
    slopes = []
    try:
        for hypothesis, amount in zip(found.hypotheses, found.amounts.tolist(), strict=True):
            ends = [turn.of([Cause(*hypothesis, side / (1 + amount))]) for side in (STEP, -STEP)]
            slopes.append(short_way(ends[0] - ends[1]) / (2 * STEP))
        return turn.of(()), np.linalg.norm(np.transpose(slopes) @ found.spread, axis=1)
    except UnstableRingError:
        return None, None
