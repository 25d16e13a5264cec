"""Fine-tuning by a sparse set of causes: changed magnets, their changes, and the tunes.

Every powered quadrupole and sextupole is a candidate. It is the search of the diagnosis with these
hypotheses alone and the marginal likelihood alone as criterion. Magnets that explain the readings
about as well increase the stated error of the tunes.
"""

import time
import warnings
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from tmlattice.arrays import Array
from tmlattice.beam.model import Model
from tmlattice.effects import Cause, apply
from tmlattice.errors import BeamLostError, TmlatticeError, UnstableRingError
from tmlattice.fitting.adam import FitResult
from tmlattice.inference import chi2
from tmlattice.inference.judgement import Judgement
from tmlattice.inference.newton import Fit, fit
from tmlattice.inference.priors import AmountPrior, Student
from tmlattice.inference.search import Explanation, Search, explain
from tmlattice.lattice import Ring
from tmlattice.measurement import Measurement
from tmlattice.network import SymplecticNetwork, TaylorNetwork
from tmlattice.observe.data import Data, first_turn
from tmlattice.observe.first_turns import FirstTurns
from tmlattice.optics import RingTunes, short_way

EFFECTS = {"quadrupole": "quadrupole_gradient", "sextupole": "sextupole_strength"}

LARGEST = 1.5
"""Largest relative change of a strength."""

FAULT = 0.3
"""Prior rms of the relative change of a changed strength."""

LARGEST_NUMBER, REFINED = 5, 12
"""Number of causes, and of candidates that are refitted after each scan."""

MAX_MISFIT = 5.0
"""Standard errors of a misfit above the noise that are still compatible with it."""

FALSE_ALARM_ODDS = 1e6
"""Odds against a false alarm of `warn_of_launches`."""

RARER = 10.0
"""Prior odds against each cause beyond the first: faults are rare, and with hundreds of candidates
a false second one would come in one case of a hundred."""

NEGLIGIBLE = 1e-6
"""Weight of an explanation, relative to the best one's, below which it is ignored."""


def fit_sparse(
    network: TaylorNetwork,
    measurement: Measurement,
    *,
    ring: Ring | None = None,
    kinds: Sequence[str] = ("quadrupole", "sextupole"),
    noise: float | None = None,
    launch_sigma: ArrayLike | None = None,
    fault: float = FAULT,
    largest_number: int = LARGEST_NUMBER,
    refined: int = REFINED,
    candidates: Sequence[str] | None = None,
    progress: bool = True,
) -> FitResult:
    """Fit a measurement's first turn by the set of changed magnets with the largest evidence.

    Args:
        noise: rms of one reading, m; else the measurement's.
        candidates: names of the only magnets that may have changed; None: all of the kinds.

    Returns:
        The network of the refitted ring, its tunes from its own matrix, and their standard error:
        that of the changes, and the spread over other magnets that explain the readings nearly as
        well, weighted by their evidence; None without a cause.
    """
    begun = time.perf_counter()
    found = searched(
        network, measurement, ring, kinds, noise, launch_sigma, fault=fault,
        largest_number=largest_number, refined=refined, candidates=candidates,
    )  # fmt: skip
    warn_of_launches(found)
    best = _refined(found)
    turn = RingTunes(first_turns(found).model.assembly)
    tunes = turn.of(best.causes)
    errors = np.sqrt(np.diag(best.covariance))
    options = {
        "method": "sparse",
        "kinds": list(kinds),
        "noise": noise,
        "launch_sigma": None if launch_sigma is None else np.ravel(launch_sigma).tolist(),
        "fault": fault,
        "largest_number": largest_number,
        "refined": refined,
        "candidates": None if candidates is None else list(candidates),
    }
    return fitted(
        found,
        best.causes,
        errors.tolist(),
        best.nuisances,
        [found.before.chi2, best.chi2][: 1 + bool(best.causes)],
        options=options,
        seconds=time.perf_counter() - begun,
        tunes=tunes,
        tune_sigma=_spread(turn, best, tunes, found) if best.causes else None,
    )


def first_turns(found: Explanation) -> FirstTurns:
    """Return the problem that was searched."""
    assert isinstance(found.problem, FirstTurns)
    return found.problem


def searched(
    network: TaylorNetwork | SymplecticNetwork,
    measurement: Measurement,
    ring: Ring | None,
    kinds: Sequence[str],
    noise: float | None,
    launch_sigma: ArrayLike | None,
    **options: Any,
) -> Explanation:
    """Return the changed magnets by their evidence, see `fit_sparse` and `sparse_causes`;
    TmlatticeError: no ring to change."""
    ring = network.ring if ring is None else ring
    if ring is None:
        raise TmlatticeError("methods but 'adam' change the ring's magnets: give ring=")
    monitors = [monitor.name for monitor in ring.monitors]
    data = first_turn(monitors, measurement, noise, launch_sigma, network.dimension)
    return sparse_causes(ring, data, kinds, network.dimension, **options)


def fitted(
    found: Explanation,
    causes: Sequence[Cause],
    errors: Sequence[float],
    launches: Array,
    chi2: Sequence[float],
    **result: Any,
) -> FitResult:
    """Return the ring with these changes as a fitted network (launches: as fitted, [shot, 5])."""
    problem = first_turns(found)
    model, data = problem.model, problem.data
    n = model.dimension
    return FitResult(
        network=TaylorNetwork.from_ring(apply(model.design, causes), n),
        loss=[c * float(np.mean(data.sigma**2)) / data.shots for c in chi2],
        penalty=[0.0] * len(chi2),
        best_epoch=len(chi2) - 1,
        stopped_early=False,
        changes={
            str(cause.element): (cause.amount, float(error))
            for cause, error in zip(causes, errors, strict=True)
        },
        launches=in_coordinates(launches, n) if data.launch_sigma.any() else None,
        **result,
    )


def warn_of_launches(found: Explanation) -> None:
    """Warn if the readings contradict the stated launches.

    The same search with free launches must explain the readings, and lower chi-square by more than
    four free numbers per shot do by chance, at odds of `FALSE_ALARM_ODDS`.

    Args:
        found: the search with the stated launches; unknown ones cannot be contradicted.
    """
    model, data = first_turns(found).model, first_turns(found).data
    stated = np.isfinite(data.launch_sigma[:, :4])
    if not stated.any():
        return
    sigma = data.launch_sigma.copy()
    sigma[:, :4] = np.inf
    unknown = replace(data, launch_sigma=sigma)
    free = sparse_causes(model.design, unknown, dimension=model.dimension).fit
    readings, numbers = int(data.valid.sum()), int(stated.sum())
    gain = found.fit.chi2 - free.chi2
    explained = free.chi2 <= readings + MAX_MISFIT * np.sqrt(2 * readings)
    if not explained or gain <= chi2.isf(1 / FALSE_ALARM_ODDS, numbers):
        return
    off = np.abs(free.nuisances - data.launches)[:, :4]
    x, y = 1e6 * off[:, [0, 2]].max(axis=0)
    px, py = 1e6 * off[:, [1, 3]].max(axis=0)
    warnings.warn(
        f"the launches are not those stated: if they are fitted freely, chi-square falls by "
        f"{gain:.0f}, of {readings} readings, and they differ from the stated ones by up to "
        f"{x:.3g} µm and {px:.3g} µrad in x, {y:.3g} µm and {py:.3g} µrad in y; give "
        "launch_sigma=, inf where the launches are unknown",
        stacklevel=3,
    )


def in_coordinates(launches: Array, dimension: int) -> Array:
    """Return launches (x, px, y, py, delta), [shot, 5], in a network's coordinates, [shot, n]."""
    states = np.zeros((len(launches), dimension))
    states[:, :4] = launches[:, :4]
    if dimension == 6:
        states[:, 5] = launches[:, 4]
    return states


def sparse_causes(
    ring: Ring,
    data: Data,
    kinds: Sequence[str] = ("quadrupole", "sextupole"),
    dimension: int = 4,
    fault: float = FAULT,
    largest_number: int = LARGEST_NUMBER,
    refined: int = REFINED,
    candidates: Sequence[str] | None = None,
) -> Explanation:
    """Return the changed strengths by their evidence; see `fit_sparse` for the arguments.

    Raises:
        TmlatticeError: no such magnet.
        BeamLostError: the launch is lost in the design.
    """
    model = Model(ring, data.settings, data.turns, dimension=dimension)
    effects = [EFFECTS[kind] for kind in kinds]
    hypotheses = model.hypotheses(effects)
    if not hypotheses:
        raise TmlatticeError(f"'{ring.name}' has no powered {' or '.join(kinds)} to fit")
    if candidates is not None:
        wanted = {ring[name].name for name in candidates}
        hypotheses = [h for h in hypotheses if h[1] in wanted]
        if not hypotheses:
            raise TmlatticeError(
                f"none of {sorted(wanted)} is a powered {' or '.join(kinds)}; name some that are"
            )
    problem = FirstTurns(
        model=model,
        data=data,
        places=dict.fromkeys(effects, len(hypotheses) / len(effects)),  # all magnets equal
        amounts=AmountPrior(Student(fault, np.inf), bound=LARGEST),
        judgement=Judgement(unknown=0.0, alternatives=refined, rarer=RARER),
    )
    before = fit(problem, (), data.launches)
    if before.point.lost:
        raise BeamLostError("the launch is lost in the design ring; launch closer to the axis")
    return explain(
        Search(problem, hypotheses, largest_number, unnamed=False, by_marginal_likelihood=True),
        before,
    )


def _refined(found: Explanation) -> Fit:
    """Amounts to rounding: the search stops at a share of their error."""
    fresh = replace(found.problem, judgement=replace(found.problem.judgement, same=0.0))
    now = found.fit
    return fit(fresh, now.causes, now.nuisances, steps=20, tolerance=1e-9) if now.causes else now


def _spread(turn: RingTunes, best: Fit, tunes: Array, found: Explanation) -> Array:
    """Standard error of the tunes [2] over all explanations refitted last."""
    others = [one.fit for named in found.named for one in named.alternatives[1:]]
    total, weights = np.zeros((2, 2)), 0.0
    for one in [best, *others, *(one.fit for one in found.beyond)]:
        weight = float(np.exp(one.log_evidence - best.log_evidence))
        if not weight > NEGLIGIBLE:
            continue
        try:
            away = short_way(turn.of(one.causes) - tunes)
            slopes = _tune_slopes(turn, one)
        except UnstableRingError:
            continue  # no tunes
        total += weight * (slopes @ one.covariance @ slopes.T + np.outer(away, away))
        weights += weight
    return np.asarray(np.sqrt(np.diag(total / weights)))


def _tune_slopes(turn: RingTunes, one: Fit) -> Array:
    """d tunes / d amounts, [2, cause]."""
    slopes = []
    for i, cause in enumerate(one.causes):
        h = min(1e-5, 0.1 * float(np.sqrt(one.covariance[i, i])))
        ends = []
        for side in (h, -h):
            moved = Cause(cause.effect, cause.element, cause.amount + side)
            ends.append(turn.of((*one.causes[:i], moved, *one.causes[i + 1 :])))
        slopes.append(short_way(ends[0] - ends[1]) / (2 * h))
    return np.stack(slopes, axis=1)
