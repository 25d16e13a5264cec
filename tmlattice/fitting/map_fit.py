"""Fine-tuning by the most probable changes: many amounts under a prior.

A Gaussian prior spreads one large fault over all magnets that could share it. `Prior.FAULTS` has
the tails of Student's t with one degree of freedom: most strengths are nearly right, a few have
large errors.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import solve_triangular

from tmlattice.beam.shifts import Shifts
from tmlattice.errors import TmlatticeError, UnstableRingError
from tmlattice.fitting.adam import FitResult
from tmlattice.fitting.launches import FreeLaunches, launch_slopes
from tmlattice.fitting.sparse import in_coordinates, sparse_causes, warn_of_launches
from tmlattice.inference.dual import MostProbable, best_of, most_probable, posterior_base
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
    """A measured first turn as a function of a space's amounts: `inference.dual.AmountProblem`.

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
        found = best_of(problem, (found, other)) if amounts.any() else found
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
    variance, base = 1 / found.prior.precision(found.amounts), posterior_base(problem, found)
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
