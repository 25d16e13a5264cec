"""Fine-tuning by the most probable small changes: Gauss-Newton with a physical prior.

A direction is something that may change in one layer: the strength of a magnet, whose layer is then
OCELOT's own, or a coefficient of the generator of a symplectic layer (`SymplecticNetwork`); with
the rms that it has before anything was measured. There are more directions than readings, so the
system is solved in the space of the readings: K = J P J^T + sigma^2, at most 492 by 492 for one
shot of PETRA III. J is never built. A reading sees a direction as its row times the shift of the
launch that does the same, so J P J^T is two rows about a running sum, over the layers that both
readings see, of 4 x 4 matrices.

A Gaussian prior spreads one large fault over all magnets that could share it. `Prior.FAULTS` has
the tails of Student's t with one degree of freedom: most strengths are nearly right, a few are far
off. Each direction then has a variance of its own, (rms^2 + amount^2) / 2, found as the fit goes.
"""

import time
from collections.abc import Sequence
from enum import StrEnum
from functools import cached_property

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import cho_factor, cho_solve, solve_triangular

from tmlattice.beam.chain import chain
from tmlattice.errors import BeamLostError, TmlatticeError, UnstableRingError
from tmlattice.fitting.adam import FitResult
from tmlattice.fitting.data import FirstTurn, first_turn, readings_of, tangents
from tmlattice.fitting.sparse import few_causes
from tmlattice.fitting.strengths import LARGEST, ring_strengths
from tmlattice.lattice import Ring
from tmlattice.maps import RingMaps
from tmlattice.maps.taylor import symplectic_form
from tmlattice.measurement import Measurement
from tmlattice.network import SymplecticNetwork, TaylorNetwork
from tmlattice.network.generators import exponents, field_matrix
from tmlattice.optics import normal_modes, one_turn_optics

Array = NDArray[np.float64]


class Prior(StrEnum):
    """What may change, with which rms before the scale."""

    FAULTS = "faults"
    """Relative changes of the powered quadrupoles and sextupoles: 1 % is the half width of a
    distribution with long tails, scaled to 0.01 % unless told otherwise."""
    STRENGTHS = "strengths"
    """The same, Gaussian: 1 % rms, scaled by the evidence unless told otherwise."""
    GENERATORS = "generators"
    """Every coefficient of every layer's generator, Gaussian, as errors of each degree act on 1 mm
    and 0.1 mrad; scaled by the evidence."""


STRENGTH_RMS = 0.01
GENERATOR_RMS = {1: 1e-7, 2: 1e-4, 3: 1e-3}
"""Of the coefficients by degree: a kick in rad, a gradient in 1/m, a sextupole in 1/m2."""

FAULT_SCALE = 0.01
FIRST_TRUST = 30.0
"""The fit begins with a noise of the residual's rms over this, and ends with the readings' own: a
linear model is worth no more, and a fit that believes it exactly runs away."""

WIDEST, NARROWING = 1000.0, 1.78
"""Tails have many local maxima: they begin this much wider, near a Gaussian, and every time that
the variances are found anew they are narrower by the second figure."""


class _Strengths:
    """The amounts are relative changes of strengths, in units of `STRENGTH_RMS`."""

    def __init__(self, network: TaylorNetwork, ring: Ring, kinds: Sequence[str]) -> None:
        self.design = network
        self.network = network.copy()
        self.network.requires_grad_(False)
        self.known = ring_strengths(ring, kinds, network.dimension)
        self.layer = self.known.layer
        self.names = tuple(s.name for s in self.known.strengths)
        self.largest = 0.98 * LARGEST / STRENGTH_RMS
        self.changes = np.zeros(len(self.layer))

    def put(self, amounts: Array) -> None:
        self.changes = STRENGTH_RMS * amounts
        weights = self.known.weights(self.changes)
        for parameter, weight in zip(self.network.parameters(), weights, strict=True):
            parameter[self.layer] = torch.from_numpy(weight)

    def signatures(self, x: Array) -> tuple[Array, Array]:
        """M [layer + 1, n, n], and the shift of the launch for a unit of each amount, [., n]."""
        path, M, back = tangents(self.network, x)
        entrance = path[self.layer]
        i, j = np.triu_indices(len(x))
        d0, d1, d2 = self.known.slopes(self.changes)
        kick = d0 + np.einsum("jab,jb->ja", d1, entrance)
        kick += np.einsum("jam,jm->ja", d2, entrance[:, i] * entrance[:, j])
        return M, STRENGTH_RMS * np.einsum("jab,jb->ja", back[self.layer + 1], kick)

    def hessians(self) -> Array:
        """Of the quadratic Hamiltonian, at the layer's exit, that a unit of each amount adds,
        [direction, 4, 4]."""
        W1 = self.known.weights(self.changes)[1]
        rate = STRENGTH_RMS * self.known.slopes(self.changes)[1] @ np.linalg.inv(W1)
        return np.asarray(symplectic_form(4).T @ rate[:, :4, :4])


class _Generators:
    """The amounts are coefficients of all layers' generators, in units of `GENERATOR_RMS`."""

    names: tuple[str, ...] = ()
    largest = np.inf

    def __init__(self, network: TaylorNetwork | SymplecticNetwork) -> None:
        self.network = network.symplectic().copy()
        self.network.requires_grad_(False)
        self.start = self.network.generator.detach().numpy().copy()
        rows = exponents(self.network.dimension)
        self.sizes = np.array([GENERATOR_RMS[sum(row)] for row in rows])
        self.layer = np.repeat(np.arange(len(self.start)), len(rows))

    def put(self, amounts: Array) -> None:
        change = amounts.reshape(self.start.shape) * self.sizes
        self.network.generator.copy_(torch.from_numpy(self.start + change))

    def signatures(self, x: Array) -> tuple[Array, Array]:
        """As for strengths."""
        _, M, D = self.network.signatures(x)
        return M, np.ascontiguousarray((D * self.sizes).swapaxes(1, 2)).reshape(-1, len(x))

    def hessians(self) -> Array:
        """As for strengths."""
        n = self.network.dimension
        slope = np.moveaxis(field_matrix(n)[:, 1 : n + 1], 2, 0) * self.sizes[:, None, None]
        hessians = symplectic_form(4).T @ slope[:, :4, :4]
        return np.tile(hessians, (len(self.start), 1, 1))


_Space = _Strengths | _Generators


class _Linear:
    """The readings as linear functions of the amounts, about where the network is now.

    Rows of J are never formed: `rows` [shot, monitor, 2, n] times shifts of the launch.
    """

    def __init__(self, space: _Space, data: FirstTurn) -> None:
        maps: RingMaps = space.network.maps
        self.data = data
        pairs = [space.signatures(x) for x in data.launches]
        self.rows = np.stack([maps.R1 @ M[maps.at] for M, _ in pairs])
        self.shift = np.stack([shift for _, shift in pairs])  # [shot, direction, n]
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

    def kernel(self, variance: Array) -> Array:
        """J P J^T for variances P [direction] over all readings [reading, reading], in the order
        [shot, monitor, 2]."""
        shots, monitors = self.rows.shape[:2]
        low = np.minimum.outer(np.arange(monitors), np.arange(monitors))
        K = np.empty((shots, monitors, 2, shots, monitors, 2))
        for s in range(shots):
            for t in range(s + 1):
                both = self.running(
                    np.einsum("ja,jb->jab", self.shift[s] * variance[:, None], self.shift[t])
                )
                half = self.rows[s][:, None] @ both[low]  # [monitor, monitor, 2, n]
                block = (half @ self.rows[t].swapaxes(1, 2)).swapaxes(1, 2)
                K[s, :, :, t] = block
                K[t, :, :, s] = block.transpose(2, 3, 0, 1)
        size = shots * monitors * 2
        return K.reshape(size, size)

    @cached_property
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


def tune_slopes(space: _Space) -> Array:
    """d (tunes) / d (amounts) [2, direction], on the closed orbit, linear part.

    A Hamiltonian with the Hessian h in a layer turns mode v by v^H h v / 2, in rad (v^H S v = 2 i);
    a pure gradient k gives beta k / 2. What kicks do through sextupoles is left out.

    Raises:
        UnstableRingError: no tune exists.
    """
    network = space.network
    _, steps = network.jacobians(one_turn_optics(network).closed_orbit)
    steps = steps[:, :4, :4]
    _, vector = normal_modes(chain(steps))
    modes = np.empty((len(network.layers), 4, 2), dtype=complex)
    for k in range(len(modes)):
        vector = steps[k] @ vector
        modes[k] = vector
    v = modes[space.layer]
    turned = np.einsum("jav,jab,jbv->vj", v.conj(), space.hessians(), v, optimize=True)
    return np.asarray(np.real(turned) / (4 * np.pi))


class _Fit:
    """The most probable amounts, for one prior and one scale."""

    def __init__(
        self,
        space: _Space,
        data: FirstTurn,
        scale: float | None,
        tails: bool,
        start: Array | None = None,
    ) -> None:
        self.space, self.data, self.scale, self.tails = space, data, scale, tails
        self.there = data.present.ravel()
        self.sigma2 = data.sigma[data.present] ** 2
        self.amounts = np.zeros(len(space.layer)) if start is None else start
        self.readings = self.put(self.amounts)
        self.widening = WIDEST if tails and start is None else 1.0
        self.choosing = scale is None
        self.chi2 = [self.misfit()]
        self.settled = False

    @property
    def width(self) -> float:
        """Of the prior, as it is at this step, in rms."""
        assert self.scale is not None
        return self.scale * self.widening

    def put(self, amounts: Array) -> Array:
        self.space.put(amounts)
        return readings_of(self.space.network, self.data.launches)

    def misfit(self) -> float:
        return float(np.sum(self.data.left(self.readings) ** 2))

    def run(self, iterations: int) -> None:
        """To the maximum, from a noise far above the readings' own down to it."""
        trust = float(np.sqrt(np.mean(self.left(self.readings) ** 2))) / FIRST_TRUST
        while True:
            trust = 0.0 if trust < np.sqrt(self.sigma2.min()) else trust
            for i in range(iterations):
                self.settled = self.iterate(trust, self.choosing and i < 4)
                self.chi2.append(self.misfit())
                if self.settled:
                    break
            if trust == 0.0:
                return
            trust /= 10

    def final_cost(self) -> float:
        """Of the amounts found, with the readings' own noise and the prior's own width."""
        self.put(self.amounts)
        half = cho_factor(self.base(_Linear(self.space, self.data), 0.0))
        return self.cost(half, self.left(self.readings), self.amounts)

    def left(self, readings: Array) -> Array:
        return np.asarray((self.data.readings - readings)[self.data.present])

    def base(self, linear: _Linear, trust: float) -> Array:
        """Covariance of the readings without the amounts."""
        own = linear.launch_kernel()[np.ix_(self.there, self.there)]
        return np.asarray(own + np.diag(self.sigma2 + trust**2))

    def kernel(self, linear: _Linear, variance: Array) -> Array:
        if self.space.names:  # a few hundred: J itself is quicker
            A = linear.matrix * np.sqrt(variance)
            return np.asarray(A @ A.T)
        return linear.kernel(variance)[np.ix_(self.there, self.there)]

    def variance(self, amounts: Array) -> Array:
        """Of the Gaussian that touches the prior from below at these amounts."""
        if not self.tails:
            return np.full(len(amounts), self.width**2)
        return np.asarray((self.width**2 + amounts**2) / 2)

    def cost(self, half: tuple[Array, bool], residual: Array, amounts: Array) -> float:
        """- log of likelihood and prior, up to constants."""
        misfit = 0.5 * residual @ cho_solve(half, residual)
        if self.tails:
            return float(misfit + np.sum(np.log1p((amounts / self.width) ** 2)))
        return float(misfit + 0.5 * np.sum((amounts / self.width) ** 2))

    def iterate(self, trust: float, choose_scale: bool) -> bool:
        """One step with noise `trust` added; True where it was smaller than the noise."""
        linear = _Linear(self.space, self.data)
        base = self.base(linear, trust)
        residual = self.left(self.readings)
        target = residual + linear.times(self.amounts)[self.data.present]
        if choose_scale:
            K = self.kernel(linear, np.ones(len(self.amounts)))
            self.scale = _best_scale(K, base, target)
        wanted = self.amounts
        for _ in range(8 if self.tails else 1):  # the tails, along one linear model
            variance = self.variance(wanted)
            weights = np.zeros_like(self.data.readings)
            factor = cho_factor(self.kernel(linear, variance) + base)
            weights[self.data.present] = cho_solve(factor, target)
            wanted = variance * linear.transposed(weights)
            self.widening = max(1.0, self.widening / NARROWING)
        wanted = np.clip(wanted, -self.space.largest, self.space.largest)
        step = wanted - self.amounts
        half = cho_factor(base)
        now = self.cost(half, residual, self.amounts)
        for _ in range(8):  # halved where the linear model does not reach
            try:
                moved = self.put(self.amounts + step)
                if self.cost(half, self.left(moved), self.amounts + step) <= now:
                    break
            except BeamLostError:
                pass
            step = step / 2
        else:
            self.put(self.amounts)
            return self.widening == 1.0
        self.amounts, self.readings = self.amounts + step, moved
        seen = linear.times(step)[self.data.present]
        small = bool(np.abs(seen).max() < 0.1 * np.sqrt(self.sigma2.min() + trust**2))
        return small and self.widening == 1.0


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
        ring: that the network was made from; else the network's own `ring`.
        prior: what may change, see `Prior`.
        kinds: of magnets, for the priors on strengths.
        scale: factor on the prior's rms; None: 0.01 for faults, else that of greatest evidence.
        noise: rms of one reading, m; else the measurement's.
        launch_sigma: standard error of the launch coordinates, one number or [n]; None: known.
        iterations: of Gauss-Newton at most, at each level of noise on the way to the readings' own.
        progress: there is nothing to show; every method takes it.

    Returns:
        The fitted network (symplectic, for the prior on generators), its tunes, and their standard
        error by the posterior covariance. It holds where the prior is true: under a Gaussian one
        for many small changes; one magnet that is 20 % off is no draw from it.

    Raises:
        MeasurementError: no reading, or no noise stated.
        TmlatticeError: a prior on strengths without a ring.
        BeamLostError: the launch is lost in the design.
    """
    begun = time.perf_counter()
    prior = Prior(prior)
    ring = network.ring if ring is None else ring
    space: _Space
    if prior is Prior.GENERATORS:
        space = _Generators(network)
    else:
        if ring is None:
            raise TmlatticeError("the prior on strengths needs the ring whose they are: give ring=")
        if isinstance(network, SymplecticNetwork):
            network = TaylorNetwork.from_ring(ring, network.dimension)
        space = _Strengths(network, ring, kinds)
    data = first_turn(space.network, measurement, noise, launch_sigma)
    tails = prior is Prior.FAULTS
    fit = _Fit(space, data, FAULT_SCALE if tails and scale is None else scale, tails)
    fit.run(iterations)
    if tails:  # many maxima: another start is the few magnets that explain most
        assert isinstance(space, _Strengths)
        few = few_causes(space.design, space.known, data)
        if few is not None:
            start = np.zeros(len(space.layer))
            start[list(few.causes)] = few.amounts / STRENGTH_RMS
            other = _Fit(space, data, fit.scale, tails, start)
            other.run(iterations)
            best = min((fit, other), key=_Fit.final_cost)
            best.put(best.amounts)
            fit = best
    tunes, sigma, errors = _posterior(fit)
    changes = {
        name: (float(STRENGTH_RMS * amount), float(STRENGTH_RMS * error))
        for name, amount, error in zip(space.names, fit.amounts, errors, strict=False)
    }
    space.network.requires_grad_(True)
    return FitResult(
        network=space.network,
        loss=[c * float(np.mean(fit.sigma2)) / len(data.launches) for c in fit.chi2],
        penalty=[0.0] * len(fit.chi2),
        best_epoch=len(fit.chi2) - 1,
        stopped_early=fit.settled,
        seconds=time.perf_counter() - begun,
        options={
            "method": "map",
            "prior": prior.value,
            "kinds": list(kinds),
            "scale": fit.scale,
            "noise": noise,
            "launch_sigma": None if launch_sigma is None else data.launch_sigma.tolist(),
            "iterations": iterations,
        },
        tunes=tunes,
        tune_sigma=sigma,
        changes=changes,
    )


def _posterior(fit: _Fit) -> tuple[Array | None, Array | None, Array]:
    """Tunes, their standard error, and that of the amounts (of strengths; else empty)."""
    data, linear = fit.data, _Linear(fit.space, fit.data)
    variance, base = fit.variance(fit.amounts), fit.base(linear, 0.0)
    sizes, errors, spread = np.sqrt(variance), np.zeros(0), None
    if fit.space.names:
        # (1 + A^T A)^-1 by a triangle: prior less data would cancel where the noise is small.
        A = solve_triangular(np.linalg.cholesky(base), linear.matrix * sizes, lower=True)
        triangle = np.linalg.qr(np.concatenate([A, np.eye(len(sizes))]), mode="r")
        spread = sizes[:, None] * solve_triangular(triangle, np.eye(len(sizes)))
        errors = np.sqrt(np.sum(spread**2, axis=1))
    try:
        tunes = one_turn_optics(fit.space.network).tunes
        slopes = tune_slopes(fit.space)
    except UnstableRingError:
        return None, None, errors
    if spread is not None:
        return tunes, np.sqrt(np.sum((slopes @ spread) ** 2, axis=1)), errors
    factor = np.linalg.inv(fit.kernel(linear, variance) + base)
    seen = np.stack([linear.times(variance * slope)[data.present] for slope in slopes])
    covariance = (slopes * variance) @ slopes.T - seen @ factor @ seen.T
    return tunes, np.sqrt(np.maximum(np.diag(covariance), 0.0)), errors


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
