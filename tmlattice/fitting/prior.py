"""Fine-tuning by the most probable small changes: Gauss-Newton with a physical Gaussian prior.

The layers are symplectic (`SymplecticNetwork`) and every change is one of their generators. A
direction is a pattern of generator coefficients in one layer, with the rms that it has before
anything was measured. There are far more directions than readings, so the system is solved in the
space of the readings: K = J P J^T + sigma^2, at most 492 by 492 for one shot of PETRA III. J is
never built. A reading sees a direction as its row times the shift of the launch that does the same
(`SymplecticNetwork.signatures`), so J P J^T is two rows about a running sum, over the layers that
both readings see, of 4 x 4 matrices.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from tmlattice.errors import BeamLostError, TmlatticeError, UnstableRingError
from tmlattice.fitting.adam import FitResult
from tmlattice.fitting.data import FirstTurn, first_turn, readings_of
from tmlattice.fitting.strengths import ring_strengths
from tmlattice.lattice import Ring
from tmlattice.measurement import Measurement
from tmlattice.network import SymplecticNetwork, TaylorNetwork
from tmlattice.network.generators import exponents
from tmlattice.network.network import chain
from tmlattice.optics import normal_modes, one_turn_optics

Array = NDArray[np.float64]


class Prior(StrEnum):
    """What may change, with which rms before the scale that the evidence chooses."""

    STRENGTHS = "strengths"
    """Relative changes of the powered quadrupoles and sextupoles, 1 % rms."""
    GENERATORS = "generators"
    """Every coefficient of every layer, as errors of each degree act on 1 mm and 0.1 mrad."""


GENERATOR_RMS = {1: 1e-7, 2: 1e-4, 3: 1e-3}
"""Of the coefficients by degree: a kick in rad, a gradient in 1/m, a sextupole in 1/m2."""


@dataclass(frozen=True)
class Directions:
    """Patterns of change, in order of their layers.

    Attributes:
        layer: [direction].
        pattern: one rms of the change, as generator coefficients, [direction, coefficient].
        names: of the magnets, for strengths; else empty.
        rms: of the amounts that the names stand for, [direction].
    """

    layer: NDArray[np.int64]
    pattern: Array
    names: tuple[str, ...]
    rms: float


def prior_directions(
    network: SymplecticNetwork, prior: Prior, ring: Ring | None, kinds: Sequence[str]
) -> Directions:
    """The directions of a prior.

    Raises:
        TmlatticeError: strengths, and no ring whose strengths they are.
    """
    n = network.dimension
    if prior is Prior.GENERATORS:
        sizes = np.array([GENERATOR_RMS[sum(row)] for row in exponents(n)])
        layers = len(network.layers)
        pattern = np.tile(np.diag(sizes), (layers, 1))
        return Directions(np.repeat(np.arange(layers), len(sizes)), pattern, (), 1.0)
    if ring is None:
        raise TmlatticeError("the prior on strengths needs the ring whose they are: give ring=")
    known = ring_strengths(ring, kinds, n)
    strengths = known.strengths
    layer = np.array([s.layer for s in strengths])
    rms = 0.01
    names = tuple(s.name for s in strengths)
    return Directions(layer, rms * known.directions, names, rms)


class _Linear:
    """The readings as linear functions of the directions' amounts, about one network.

    Rows of J are never formed: `rows` [shot, monitor, 2, n] times shifts of the launch.
    """

    def __init__(self, network: SymplecticNetwork, data: FirstTurn, space: Directions) -> None:
        maps, self.space, self.data = network.maps, space, data
        rows, shifts = [], []
        for x in data.launches:
            _, M, D = network.signatures(x)
            rows.append(maps.R1 @ M[maps.at])
            shifts.append(np.einsum("jac,jc->ja", D[space.layer], space.pattern))
        self.rows = np.stack(rows)
        self.shift = np.stack(shifts)  # [shot, direction, n]
        # Directions up to this one are seen by the monitor: they are in beam order.
        self.upto = np.searchsorted(space.layer, maps.at)

    def running(self, terms: Array) -> Array:
        """Sums over the directions that each monitor sees of terms [..., direction, ...] whose
        first axis is the direction: [monitor, ...]."""
        total = np.concatenate([np.zeros((1, *terms.shape[1:])), np.cumsum(terms, axis=0)])
        return np.asarray(total[self.upto])

    def times(self, amounts: Array) -> Array:
        """J amounts: change of the readings [shot, monitor, 2]."""
        moved = self.running(np.moveaxis(self.shift * amounts[:, None], 1, 0))
        return np.asarray(np.einsum("smpa,msa->smp", self.rows, moved))

    def transposed(self, weights: Array) -> Array:
        """J^T weights [shot, monitor, 2], [direction]."""
        at_start = np.einsum("smpa,smp->msa", self.rows, weights)
        later = np.zeros((len(self.upto) + 1, *at_start.shape[1:]))
        later[:-1] = np.cumsum(at_start[::-1], axis=0)[::-1]
        # The first monitor that sees direction j is the first with upto > j.
        first = np.searchsorted(self.upto, np.arange(self.shift.shape[1]), side="right")
        return np.asarray(np.einsum("sja,jsa->j", self.shift, later[first]))

    def kernel(self) -> Array:
        """J J^T over all readings [reading, reading], in the order [shot, monitor, 2]."""
        shots, monitors = self.rows.shape[:2]
        low = np.minimum.outer(np.arange(monitors), np.arange(monitors))
        K = np.empty((shots, monitors, 2, shots, monitors, 2))
        for s in range(shots):
            for t in range(s + 1):
                both = self.running(np.einsum("ja,jb->jab", self.shift[s], self.shift[t]))
                half = self.rows[s][:, None] @ both[low]  # [monitor, monitor, 2, n]
                block = (half @ self.rows[t].swapaxes(1, 2)).swapaxes(1, 2)
                K[s, :, :, t] = block
                K[t, :, :, s] = block.transpose(2, 3, 0, 1)
        size = shots * monitors * 2
        return K.reshape(size, size)

    def matrix(self) -> Array:
        """J itself, [present reading, direction]: for few directions."""
        seen = np.arange(self.shift.shape[1]) < self.upto[:, None]
        J = np.einsum("smpa,sja->smpj", self.rows, self.shift) * seen[:, None, :]
        return np.asarray(J[self.data.present])

    def launch_kernel(self) -> Array:
        """Covariance of the readings from the launches' own errors, as `kernel`."""
        shots, monitors = self.rows.shape[:2]
        scaled = (self.rows * self.data.launch_sigma).reshape(shots, monitors * 2, -1)
        K = np.zeros((shots, monitors * 2, shots, monitors * 2))
        for s in range(shots):
            K[s, :, s] = scaled[s] @ scaled[s].T
        return K.reshape(shots * monitors * 2, -1)


def tune_slopes(network: SymplecticNetwork, space: Directions) -> Array:
    """d (tunes) / d (amounts) [2, direction], on the network's closed orbit, linear part.

    A generator with the Hessian h in a layer turns mode v by v^H h v / 2, in rad (v^H S v = 2 i);
    a pure gradient k gives beta k / 2. What kicks do through sextupoles is left out.
    """
    orbit = one_turn_optics(network).closed_orbit
    _, steps = network.jacobians(orbit)
    steps = steps[:, :4, :4]
    _, vector = normal_modes(chain(steps))
    modes = np.empty((len(network.layers), 4, 2), dtype=complex)
    for k in range(len(network.layers)):
        vector = steps[k] @ vector
        modes[k] = vector
    v = modes[space.layer]
    n = network.dimension
    slope = np.zeros((2, len(space.layer)))
    for c, row in enumerate(exponents(n)):
        if sum(row) == 2 and not any(row[4:]):
            i, j = (a for a, e in enumerate(row) for _ in range(e))
            turned = np.real(v[:, i].conj() * v[:, j]) / (2 * np.pi)
            slope += (space.pattern[:, c, None] * turned).T
    return slope


def fit_map(
    network: TaylorNetwork | SymplecticNetwork,
    measurement: Measurement,
    *,
    ring: Ring | None = None,
    prior: Prior | str = Prior.STRENGTHS,
    kinds: Sequence[str] = ("quadrupole", "sextupole"),
    scale: float | None = None,
    noise: float | None = None,
    launch_sigma: ArrayLike | None = None,
    iterations: int = 12,
    progress: bool = True,
) -> FitResult:
    """Fit a measurement's first turn by the most probable generators under a Gaussian prior.

    Args:
        network: the design; its layers are made symplectic.
        measurement: at least one shot.
        ring: that the network was made from; else the network's own `ring`.
        prior: what may change, see `Prior`.
        kinds: of magnets, for the prior on strengths.
        scale: factor on the prior's rms; None: the one of greatest evidence.
        noise: rms of one reading, m; else the measurement's.
        launch_sigma: standard error of the launch coordinates, one number or [n]; None: known.
        iterations: of Gauss-Newton at most.
        progress: there is nothing to show; every method takes it.

    Returns:
        A symplectic network, its tunes, and their standard error by the posterior covariance.
        That error holds where the prior is true: many small changes. One magnet that is 20 % off
        is no draw from it, and the error is then too small (use "sparse").

    Raises:
        MeasurementError: no reading, or no noise stated.
        TmlatticeError: a prior on strengths without a ring.
        BeamLostError: the launch is lost in the design.
    """
    begun = time.perf_counter()
    prior = Prior(prior)
    ring = network.ring if ring is None else ring
    model = network.symplectic().copy()
    start = model.generator.detach().clone()
    data = first_turn(model, measurement, noise, launch_sigma)
    space = prior_directions(model, prior, ring, kinds)
    sigma2, there = data.sigma[data.present] ** 2, data.present.ravel()
    asked = scale
    amounts = np.zeros(len(space.layer))
    readings = readings_of(model, data.launches)

    def put(values: Array) -> Array:
        change = np.zeros(tuple(start.shape))
        np.add.at(change, space.layer, space.pattern * values[:, None])
        with torch.no_grad():
            model.generator.copy_(start + torch.from_numpy(change))
        return readings_of(model, data.launches)

    def misfit(values: Array) -> float:
        return float(np.sum(data.left(values) ** 2))

    chi2 = [misfit(readings)]
    for iteration in range(iterations):
        linear = _Linear(model, data, space)
        K = linear.kernel()[np.ix_(there, there)]
        base = np.diag(sigma2) + linear.launch_kernel()[np.ix_(there, there)]
        target = (data.readings - readings + linear.times(amounts))[data.present]
        if asked is None and iteration < 4:  # then it stays, or the fit would chase itself
            scale = _best_scale(K, base, target)
        assert scale is not None
        weights = np.zeros_like(data.readings)
        weights[data.present] = np.linalg.solve(scale**2 * K + base, target)
        step = scale**2 * linear.transposed(weights) - amounts
        for _ in range(6):  # halved where the linear model does not reach
            try:
                moved = put(amounts + step)
                if misfit(moved) <= max(1.5 * chi2[-1], 4.0 * len(sigma2)):
                    break
            except BeamLostError:
                pass
            step = step / 2
        else:
            readings = put(amounts)
            break
        amounts, readings = amounts + step, moved
        chi2.append(misfit(readings))
        if np.abs(linear.times(step)[data.present]).max() < 1e-2 * np.sqrt(sigma2.min()):
            break
    assert scale is not None
    tunes = sigma = None
    linear = _Linear(model, data, space)
    factor = np.linalg.inv(
        scale**2 * linear.kernel()[np.ix_(there, there)]
        + np.diag(sigma2)
        + linear.launch_kernel()[np.ix_(there, there)]
    )
    try:
        tunes = one_turn_optics(model).tunes
        slopes = tune_slopes(model, space)
        seen = np.stack([linear.times(slope)[data.present] for slope in slopes])
        covariance = scale**2 * slopes @ slopes.T - scale**4 * seen @ factor @ seen.T
        sigma = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    except UnstableRingError:
        pass
    changes: dict[str, tuple[float, float]] = {}
    if space.names:
        J = linear.matrix()
        variance = scale**2 - scale**4 * np.sum(J * (factor @ J), axis=0)
        errors = space.rms * np.sqrt(np.maximum(variance, 0.0))
        for name, amount, error in zip(space.names, space.rms * amounts, errors, strict=True):
            changes[name] = (float(amount), float(error))
    return FitResult(
        network=model,
        loss=[c * float(np.mean(sigma2)) / len(data.launches) for c in chi2],
        penalty=[0.0] * len(chi2),
        best_epoch=len(chi2) - 1,
        stopped_early=len(chi2) <= iterations,
        seconds=time.perf_counter() - begun,
        options={
            "method": "map",
            "prior": prior.value,
            "kinds": list(kinds),
            "scale": scale,
            "noise": noise,
            "launch_sigma": None if launch_sigma is None else data.launch_sigma.tolist(),
            "iterations": iterations,
        },
        tunes=tunes,
        tune_sigma=sigma,
        changes=changes,
    )


def _best_scale(K: Array, base: Array, target: Array) -> float:
    """The factor s of greatest evidence, target ~ N(0, s^2 K + base)."""
    half = np.linalg.cholesky(base)
    inner = np.linalg.solve(half, np.linalg.solve(half, K).T)
    values, vectors = np.linalg.eigh(0.5 * (inner + inner.T))
    power = (vectors.T @ np.linalg.solve(half, target)) ** 2
    grid = np.logspace(-4, 3, 141)
    spread = grid[:, None] ** 2 * np.maximum(values, 0.0) + 1.0
    evidence = -0.5 * np.sum(power / spread + np.log(spread), axis=1)
    return float(grid[int(evidence.argmax())])
