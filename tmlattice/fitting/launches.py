"""Launches of limited accuracy, fitted together with other parameters.

>>> free = FreeLaunches(nominal, sigma, readings, noise)
>>> launches = free.fitted(network)                    # [shot, n]

A shot's launch is linear in its readings to a few per cent, so one or two Gauss-Newton steps reach
its best value for any weights.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from tmlattice.arrays import Array
from tmlattice.beam.model import Model
from tmlattice.errors import BeamLostError, MeasurementError
from tmlattice.inference.newton import fit
from tmlattice.lattice import Ring
from tmlattice.measurement import Measurement
from tmlattice.network.base import NetworkChain
from tmlattice.observe.data import NOISE_FLOOR, of_measurement
from tmlattice.observe.first_turns import FirstTurns
from tmlattice.observe.noise import estimate

STEP = 1e-6
"""m, rad or relative: half the distance of the two launches of a slope."""


GUESSED_NOISE = 1e-4
"""m; noise of a fit of launches whose residual gives the noise."""


def with_noise(
    ring: Ring, measurement: Measurement, dimension: int = 4
) -> tuple[Measurement, bool]:
    """Return the first turn with noise for every reading, and whether some of it is estimated.

    Args:
        dimension: 4 or 6.

    Raises:
        MeasurementError: too few readings for an estimate.
    """
    measurement = measurement.select(turns=[0])
    noise = measurement.noise
    there = np.asarray(np.isfinite(measurement.readings[:, 0]).any(axis=0))
    if noise is not None and np.isfinite(noise[there]).all():
        return measurement, False
    data = of_measurement(ring, measurement).with_sigma(np.full(2, GUESSED_NOISE))
    model = Model(ring, data.settings, 1, dimension=dimension)
    start = fit(FirstTurns(model=model, data=data, places={}), (), data.launches)
    if start.point.lost:
        raise BeamLostError(f"{start.point.lost} in '{ring.name}'; check the launches")
    found = estimate([(data, start.point.view)])
    if not np.isfinite(found).any():
        raise MeasurementError(
            "the noise is not stated and the readings are too few to estimate it; state the noise "
            "of a reading in the measurement"
        )
    found = np.maximum(np.where(np.isfinite(found), found, np.nanmean(found)), NOISE_FLOOR)
    stated = np.full((len(there), 2), np.nan) if noise is None else noise
    return replace(measurement, noise=np.where(np.isfinite(stated), stated, found)), True


@dataclass(frozen=True)
class FreeLaunches:
    """Readings and nominal launches [shot, n], and their errors.

    Attributes:
        sigma: rms of these; inf where unknown, 0 where exact, [shot, n].
        readings: m, [shot, monitor, 2]; NaN where missing.
        noise: rms of a reading, m, [monitor, 2].
    """

    nominal: Array
    sigma: Array
    readings: Array
    noise: Array

    @cached_property
    def weight(self) -> Array:
        """1 / noise, 0 where missing, [shot, monitor, 2]."""
        inverse = 1 / np.where(self.noise > 0, self.noise, 1.0)
        return np.where(np.isfinite(self.readings), inverse, 0.0)

    def gains(self, network: NetworkChain, launches: Array) -> Callable[[Array, Array], Array]:
        """Return the step from readings [shot, monitor, 2] at launches [shot, n], [shot,
        n], by this network's slopes there."""
        shots, n = launches.shape
        slopes = launch_slopes(network, launches).reshape(shots, -1, n)
        weight = self.weight.reshape(shots, -1)
        rows = slopes * (weight[:, :, None] * (self.sigma > 0)[:, None, :])
        known = np.where(self.sigma > 0, 1 / np.where(self.sigma > 0, self.sigma, 1.0) ** 2, 1.0)
        size = np.sqrt(np.einsum("sri,sri->si", rows, rows) + known)
        size = np.where(size > 0, size, 1.0)
        unit = rows / size[:, None, :]
        gram = unit.swapaxes(1, 2) @ unit + np.eye(n) * (known / size**2 + 1e-12)[:, None, :]
        inverse = np.linalg.inv(gram) / size[:, None, :] / size[:, :, None]
        measured = np.where(weight > 0, np.nan_to_num(self.readings).reshape(shots, -1), 0.0)

        def step(readings: Array, now: Array) -> Array:
            left = (measured - readings.reshape(shots, -1)) * weight
            pull = np.einsum("sri,sr->si", rows, left) + known * (self.nominal - now)
            return np.asarray(np.einsum("sij,sj->si", inverse, pull))

        return step

    def fitted(self, network: NetworkChain, start: Array | None = None, steps: int = 4) -> Array:
        """Return the best launches for a network, [shot, n]."""
        launches = self.nominal if start is None else start
        if not self.sigma.any():
            return launches
        for _ in range(steps):
            readings = network.readings(launches)
            launches = launches + self.gains(network, launches)(readings, launches)
        return launches


def launch_slopes(network: NetworkChain, launches: Array) -> Array:
    """Return d readings / d launch, [shot, monitor, 2, n], by central differences."""
    shots, n = launches.shape
    moved = launches[:, None, None] + STEP * np.stack([np.eye(n), -np.eye(n)])[None]
    ends = network.readings(moved.reshape(-1, n)).reshape(shots, 2, n, -1, 2)
    return np.asarray(np.moveaxis((ends[:, 0] - ends[:, 1]) / (2 * STEP), 1, -1))
