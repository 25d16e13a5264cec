"""Fine-tuning by the most probable changes: many amounts under a prior.

A Gaussian prior spreads one large fault over all magnets that could share it. `Prior.FAULTS` has
the tails of Student's t with one degree of freedom: most strengths are nearly right, a few have
large errors.

Gauss-Newton in the space of the readings: with slopes J and prior variances P the amounts are
P J^T (J P J^T + C)^-1 target. Only products with J are needed (`Shifts`). Heavy tails give each
amount a variance of its own, which is updated during the fit.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import partial

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import cho_factor, cho_solve, solve_triangular

from tmlattice.beam.shifts import Shifts
from tmlattice.errors import BeamLostError, TmlatticeError, UnstableRingError
from tmlattice.fitting.adam import FitResult
from tmlattice.fitting.launches import FreeLaunches, launch_slopes
from tmlattice.fitting.sparse import in_coordinates, sparse_causes, warn_of_launches
from tmlattice.inference.priors import Student
from tmlattice.inference.search import Explanation
from tmlattice.lattice import Ring
from tmlattice.measurement import Measurement
from tmlattice.network import SymplecticNetwork, TaylorNetwork
from tmlattice.network.spaces import STRENGTH_RMS, Generators, Space, Strengths, tune_slopes
from tmlattice.observe.data import Data, first_turn
from tmlattice.optics import one_turn_optics

Array = NDArray[np.float64]


class Prior(StrEnum):
    """Free amounts, and their rms before scaling."""

    FAULTS = "faults"
    """Relative changes of the powered quadrupoles and sextupoles: 1 % is the half width of a
    distribution with long tails, scaled to 0.01 % by default."""
    STRENGTHS = "strengths"
    """The same, Gaussian: 1 % rms, scaled by the evidence by default."""
    GENERATORS = "generators"
    """Every coefficient of every layer's generator, Gaussian, by the effect of each degree at 1 mm
    and 0.1 mrad; scaled by the evidence."""


FAULT_SCALE = 0.01

MAX_LAUNCH = 0.01
"""m and rad: prior rms of an unknown launch; beam pipes are no wider."""


@dataclass(frozen=True)
class TurnReadings:
    """A measured first turn as a function of a space's amounts.

    Attributes:
        space: of the amounts; changed by every call.
        data: one turn.
        launches: of the shots, in the network's coordinates, [shot, n]; of unknown ones the point
            of linearisation.
        offset: their difference from nominal ones with an error, [shot, n], or None.
    """

    space: Space
    data: Data
    launches: Array
    offset: Array | None = None

    @property
    def launch_sigma(self) -> Array:
        """rms of the nominal launches, [shot, n]; 0 where exact."""
        return in_coordinates(self.data.launch_sigma, self.launches.shape[1])

    @property
    def sigma(self) -> Array:
        """Noise of the readings, m, [row]."""
        return np.asarray(self.data.sigma[self.data.valid])

    @property
    def largest(self) -> float:
        """Largest amount of the space."""
        return self.space.largest

    def residual(self, amounts: Array) -> Array:
        """Measured less model, m, [row]."""
        readings = self.space.readings(amounts, self.launches)
        left = self.data.readings - readings
        if self.offset is not None:  # relative to the nominal ones, which have the prior
            left = left + np.einsum(
                "smpi,si->smp", launch_slopes(self.space.network, self.launches), self.offset
            )
        return np.asarray(left[self.data.valid])

    def slopes(self, amounts: Array) -> Shifts:
        """Return the slopes as shifts of the launches."""
        maps = self.space.network.maps
        pairs = [self.space.shifts(amounts, x) for x in self.launches]
        return Shifts(
            rows=np.stack([maps.R1 @ M[maps.at] for M, _ in pairs]),
            shift=np.stack([shift for _, shift in pairs]),
            upto=np.searchsorted(self.space.layer, maps.at),
            present=self.data.valid,
        )

    def nuisances(self, amounts: Array) -> Array:
        """Covariance of the readings by errors of the launches, m^2, [row, row]."""
        sigma = np.minimum(self.launch_sigma, MAX_LAUNCH)
        if not sigma.any():
            return np.zeros((len(self.sigma),) * 2)
        return self.slopes(amounts).launch_kernel(sigma)


INITIAL_NOISE = 30.0
"""The residual's rms over the first added noise, which falls to zero: a linear model that is
believed exactly far from the solution diverges."""

WIDEST, NARROWING = 1000.0, 1.78
"""Heavy tails have many local maxima: the prior starts wider by the first number, near a Gaussian,
and narrows by the second at every update of the variances."""

MAX_HALVINGS = 8
"""Halvings of a step, at most, beyond the linear range."""

SCALE_ITERATIONS = 4
"""Iterations in which the prior's scale follows the evidence."""

SCALES = np.logspace(-4, 3, 141)


@dataclass(frozen=True)
class MostProbable:
    """A fit: amounts, residual and history.

    Attributes:
        amounts: [amount].
        residual: measured less model, m, [row].
        prior: with its final width.
        chi2: of every step.
        converged: whether the last step was smaller than the noise.
    """

    amounts: Array
    residual: Array
    prior: Student
    chi2: tuple[float, ...]
    converged: bool = False


def most_probable(
    problem: TurnReadings,
    prior: Student,
    start: Array,
    *,
    choose: bool = False,
    wide: bool = True,
    iterations: int = 12,
) -> MostProbable:
    """Most probable amounts, with an added noise that falls to zero.

    Args:
        problem: readings as a function of amounts.
        prior: of each amount.
        start: first guess, [amount].
        choose: fit the width of the prior by the evidence.
        wide: start with wide tails; not where the start is a local maximum to keep.
        iterations: at most, at each level of added noise.
    """
    residual = problem.residual(start)
    now = MostProbable(start, residual, prior, (_chi2(problem, residual),))
    widening = WIDEST if wide and np.isfinite(prior.freedom) else 1.0
    added_noise = float(np.sqrt(np.mean(residual**2))) / INITIAL_NOISE
    least = float(problem.sigma.min())
    while True:
        added_noise = 0.0 if added_noise < least else added_noise
        for i in range(iterations):
            now, widening = _iterated(
                problem, now, added_noise, widening, choose and i < SCALE_ITERATIONS
            )
            if now.converged:
                break
        if added_noise == 0.0:
            return now
        added_noise /= 10


def _final_cost(problem: TurnReadings, found: MostProbable) -> float:
    """Negative log posterior, up to constants, with the readings' own noise."""
    half = cho_factor(_base(problem, found.amounts, 0.0))
    return _cost(half, found.residual, found.prior, found.amounts)


def _chi2(problem: TurnReadings, residual: Array) -> float:
    return float(np.sum((residual / problem.sigma) ** 2))


def _base(problem: TurnReadings, amounts: Array, added_noise: float) -> Array:
    return problem.nuisances(amounts) + np.diag(problem.sigma**2 + added_noise**2)


def _cost(half: tuple[Array, bool], residual: Array, prior: Student, amounts: Array) -> float:
    return float(0.5 * residual @ cho_solve(half, residual) + prior.penalty(amounts).sum())


def _iterated(
    problem: TurnReadings, now: MostProbable, added_noise: float, widening: float, choose: bool
) -> tuple[MostProbable, float]:
    """Return one step with added noise; converged if the step is smaller than the noise."""
    slopes, base = problem.slopes(now.amounts), _base(problem, now.amounts, added_noise)
    target = now.residual + slopes.times(now.amounts)
    if choose:
        unit = slopes.kernel(np.ones(len(now.amounts)))
        now = replace(now, prior=replace(now.prior, width=best_scale(unit, base, target)))
    wanted, half = now.amounts, cho_factor(base)
    best = _linear(slopes, base, half, target, len(wanted))
    for _ in range(MAX_HALVINGS if np.isfinite(now.prior.freedom) else 1):  # along one linear model
        wide = replace(now.prior, width=now.prior.width * widening)
        wanted = best(wide.precision(wanted))
        widening = max(1.0, widening / NARROWING)
    wide = replace(now.prior, width=now.prior.width * widening)
    step = np.clip(wanted, -problem.largest, problem.largest) - now.amounts
    before = _cost(half, now.residual, wide, now.amounts)
    for _ in range(MAX_HALVINGS):
        try:
            residual = problem.residual(now.amounts + step)
            if _cost(half, residual, wide, now.amounts + step) <= before:
                break
        except BeamLostError:
            pass
        step = step / 2
    else:
        chi2 = (*now.chi2, now.chi2[-1])
        return replace(now, chi2=chi2, converged=widening == 1.0), widening
    least = float(np.sqrt((problem.sigma**2).min() + added_noise**2))
    small = bool(np.abs(slopes.times(step)).max() < 0.1 * least)
    chi2 = (*now.chi2, _chi2(problem, residual))
    converged = small and widening == 1.0
    return MostProbable(now.amounts + step, residual, now.prior, chi2, converged), widening


def _linear(
    slopes: Shifts, base: Array, half: tuple[Array, bool], target: Array, amounts: int
) -> Callable[[Array], Array]:
    """Best amounts of a linear model as a function of the prior's precisions [amount], in the space
    of amounts or of readings, whichever is smaller."""
    if amounts < len(target):
        J = slopes.matrix
        weighed = cho_solve(half, J)
        inner, gram = weighed.T @ target, J.T @ weighed

        def of_amounts(precision: Array) -> Array:
            size = np.sqrt(precision)
            scaled = gram / size / size[:, None] + np.eye(len(size))
            return np.asarray(cho_solve(cho_factor(scaled), inner / size) / size)

        return of_amounts

    def of_readings(precision: Array) -> Array:
        factor = cho_factor(slopes.kernel(1 / precision) + base)
        return slopes.transposed(cho_solve(factor, target)) / precision

    return of_readings


def best_scale(kernel: Array, base: Array, target: Array) -> float:
    """Factor s of the largest evidence, target ~ N(0, s^2 kernel + base)."""
    half = np.linalg.cholesky(base)
    inner = np.linalg.solve(half, np.linalg.solve(half, kernel).T)
    values, vectors = np.linalg.eigh(0.5 * (inner + inner.T))
    power = (vectors.T @ np.linalg.solve(half, target)) ** 2
    spread = SCALES[:, None] ** 2 * np.maximum(values, 0.0) + 1.0
    evidence = -0.5 * np.sum(power / spread + np.log(spread), axis=1)
    return float(SCALES[int(evidence.argmax())])


def fit_map(
    network: TaylorNetwork | SymplecticNetwork,
    measurement: Measurement,
    *,
    ring: Ring | None = None,
    prior: Prior | str = Prior.FAULTS,
    kinds: Sequence[str] = ("quadrupole", "sextupole"),
    scale: float | None = None,
    noise: float | None = None,
    launch_sigma: ArrayLike | None = None,
    iterations: int = 12,
    progress: bool = True,
) -> FitResult:
    """Fit a measurement's first turn by the most probable changes under a prior.

    Args:
        network: the design.
        measurement: at least one shot.
        ring: of the network; None: the network's own `ring`.
        prior: free amounts, see `Prior`.
        kinds: of magnets, for the priors on strengths.
        scale: factor on the prior's rms; None: 0.01 for faults, else that of greatest evidence.
        noise: rms of one reading, m; else the measurement's.
        launch_sigma: standard error of the launch coordinates, one number, [n] or [shot, n]; 0:
            exact; inf: unknown; None: the measurement's own.
        iterations: of Gauss-Newton at most, at each level of added noise.
        progress: ignored, as in every method.

    Returns:
        The fitted network (symplectic, for the prior on generators), its tunes, and their standard
        error by the posterior covariance. It is valid if the prior is: a Gaussian one describes
        many small changes, not one magnet with an error of 20 %.

    Raises:
        MeasurementError: no reading, or no noise stated.
        TmlatticeError: a prior on strengths without a ring.
        BeamLostError: the launch is lost in the design.
    """
    begun = time.perf_counter()
    prior = Prior(prior)
    ring = network.ring if ring is None else ring
    space: Space
    if prior is Prior.GENERATORS:
        space = Generators(network)
    else:
        if ring is None:
            raise TmlatticeError("the prior on strengths needs the ring whose they are: give ring=")
        if isinstance(network, SymplecticNetwork):
            network = TaylorNetwork.from_ring(ring, network.dimension)
        space = Strengths(network, ring, kinds)
    monitors, dimension = space.network.monitors, space.network.dimension
    data = first_turn(monitors, measurement, noise, launch_sigma, dimension)
    tails = prior is Prior.FAULTS
    sparse = sparse_causes(ring, data, kinds, dimension) if tails and ring is not None else None
    if sparse is not None and ring is not None:
        warn_of_launches(ring, data, dimension, sparse)
    problem = _readings(space, data, measurement.states(dimension), sparse)
    width = FAULT_SCALE if tails and scale is None else scale
    student = Student(1.0 if width is None else width, 1.0 if tails else np.inf)
    start = np.zeros(len(space.layer))
    found = most_probable(problem, student, start, choose=width is None, iterations=iterations)
    if sparse is not None:  # many maxima: the sparse fit is another start
        amounts = _from_sparse(space, sparse)
        other = most_probable(problem, student, amounts, wide=False, iterations=iterations)
        found = min((found, other), key=partial(_final_cost, problem)) if amounts.any() else found
    space.put(found.amounts)
    tunes, sigma, errors = _posterior(problem, found)
    changes = {
        name: (float(STRENGTH_RMS * amount), float(STRENGTH_RMS * error))
        for name, amount, error in zip(space.names, found.amounts, errors, strict=False)
    }
    space.network.requires_grad_(True)
    return FitResult(
        network=space.network,
        loss=[c * float(np.mean(problem.sigma**2)) / data.shots for c in found.chi2],
        penalty=[0.0] * len(found.chi2),
        best_epoch=len(found.chi2) - 1,
        stopped_early=found.converged,
        seconds=time.perf_counter() - begun,
        options={
            "method": "map",
            "prior": prior.value,
            "kinds": list(kinds),
            "scale": found.prior.width,
            "noise": noise,
            "launch_sigma": None if launch_sigma is None else np.ravel(launch_sigma).tolist(),
            "iterations": iterations,
        },
        tunes=tunes,
        tune_sigma=sigma,
        changes=changes,
        launches=None
        if not problem.launch_sigma.any()
        else _free(problem).fitted(space.network, problem.launches),
    )


def _readings(space: Space, data: Data, nominal: Array, sparse: Explanation | None) -> TurnReadings:
    """Return the problem at the nominal launches, or at those of the sparse fit."""
    nominal = np.ascontiguousarray(nominal)
    sigma = in_coordinates(data.launch_sigma, nominal.shape[1])
    if sparse is None or not sigma.any():
        return TurnReadings(space, data, nominal)
    about = in_coordinates(sparse.fit.nuisances, nominal.shape[1])
    offset = np.where(np.isfinite(sigma), about - nominal, 0.0)
    return TurnReadings(space, data, about, offset)


def _free(problem: TurnReadings) -> FreeLaunches:
    data = problem.data
    nominal = in_coordinates(data.launches, problem.launches.shape[1])
    readings = np.where(data.valid, data.readings, np.nan)
    return FreeLaunches(nominal, problem.launch_sigma, readings, data.sigma[0])


def _from_sparse(space: Space, found: Explanation) -> Array:
    """Amounts of the sparse fit; of the most probable magnet if it is empty."""
    best = found.fit if found.named or not found.beyond else found.beyond[0].fit
    start = np.zeros(len(space.layer))
    for cause in best.causes:
        start[space.names.index(str(cause.element))] = cause.amount / STRENGTH_RMS
    return start


def _posterior(
    problem: TurnReadings, found: MostProbable
) -> tuple[Array | None, Array | None, Array]:
    """Tunes, their standard error, and that of the amounts (of strengths; else empty)."""
    space, slopes = problem.space, problem.slopes(found.amounts)
    variance, base = 1 / found.prior.precision(found.amounts), _base(problem, found.amounts, 0.0)
    sizes, errors, spread = np.sqrt(variance), np.zeros(0), None
    if space.names:
        # (1 + A^T A)^-1 by a triangle: prior less data would cancel for small noise
        A = solve_triangular(np.linalg.cholesky(base), slopes.matrix * sizes, lower=True)
        triangle = np.linalg.qr(np.concatenate([A, np.eye(len(sizes))]), mode="r")
        spread = sizes[:, None] * solve_triangular(triangle, np.eye(len(sizes)))
        errors = np.sqrt(np.sum(spread**2, axis=1))
    try:
        tunes = one_turn_optics(space.network).tunes
        rates = tune_slopes(space, found.amounts)
    except UnstableRingError:
        return None, None, errors
    if spread is not None:
        return tunes, np.sqrt(np.sum((rates @ spread) ** 2, axis=1)), errors
    factor = np.linalg.inv(slopes.kernel(variance) + base)
    seen = np.stack([slopes.times(variance * rate) for rate in rates])
    covariance = (rates * variance) @ rates.T - seen @ factor @ seen.T
    return tunes, np.sqrt(np.maximum(np.diag(covariance), 0.0)), errors
