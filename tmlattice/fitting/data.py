"""What a fit needs of a measurement: the first turn in the network's order, with its weights."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tmlattice.errors import MeasurementError
from tmlattice.measurement import Measurement
from tmlattice.network import TaylorNetwork
from tmlattice.network.network import NetworkChain

Array = NDArray[np.float64]

NOISE_FLOOR = 1e-9
"""m. Readings without noise are trusted to this: where OCELOT's maps are rounded and truncated."""


@dataclass(frozen=True)
class FirstTurn:
    """First-turn readings as one vector.

    Attributes:
        launches: [shot, n].
        readings: m, [shot, monitor, 2], zeros where missing.
        present: where there is a reading, [shot, monitor, 2].
        sigma: standard error of each, m, [shot, monitor, 2].
        launch_sigma: standard error of each launch coordinate, [n]; zeros where it is known.
    """

    launches: Array
    readings: Array
    present: NDArray[np.bool_]
    sigma: Array
    launch_sigma: Array

    def left(self, readings: Array) -> Array:
        """(measured - modelled) / sigma where there is a reading, flat."""
        return np.asarray(((self.readings - readings) / self.sigma)[self.present])


def first_turn(
    network: NetworkChain,
    measurement: Measurement,
    noise: float | None,
    launch_sigma: ArrayLike | None,
) -> FirstTurn:
    """The first turn of a measurement, with the noise of the measurement or the given one.

    Raises:
        MeasurementError: no reading of the first turn, or nobody states the noise.
        UnknownNameError: a monitor that the network does not have.
    """
    ordered = measurement.in_order_of(network.monitors)
    readings = ordered.readings[:, 0]
    present = np.isfinite(readings)
    if not present.any():
        raise MeasurementError("no reading of the first turn (turn 0); nothing can be fitted")
    stated = ordered.noise if noise is None else np.full((len(network.monitors), 2), noise)
    if stated is None or np.isnan(stated[present.any(axis=0)]).any():
        raise MeasurementError(
            "the measurement does not state its noise; give noise= in m (one reading's rms)"
        )
    sigma = np.empty_like(readings)
    sigma[:] = np.maximum(np.nan_to_num(stated, nan=1.0), NOISE_FLOOR)
    width = np.zeros(network.dimension)
    if launch_sigma is not None:
        width[:] = launch_sigma
    launches = np.ascontiguousarray(measurement.states(network.dimension))
    return FirstTurn(launches, np.where(present, readings, 0.0), present, sigma, width)


def readings_of(network: NetworkChain, launches: Array) -> Array:
    """Readings [shot, monitor, 2] without a gradient."""
    return np.asarray(network(launches).detach().numpy())


def tangents(network: TaylorNetwork, x: Array) -> tuple[Array, Array, Array]:
    """States [layer + 1, n], Jacobians M [layer + 1, n, n] of all exits by the launch x [n], and
    their inverses."""
    path, steps = network.jacobians(x)
    layers = len(network.layers)
    M = np.empty((layers + 1, *steps.shape[1:]))
    M[0] = np.eye(network.dimension)
    for k in range(layers):
        M[k + 1] = steps[k] @ M[k]
    return path[: layers + 1], M, np.linalg.inv(M)
