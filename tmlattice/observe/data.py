"""Data of a diagnosis: readings, their noise, launches; and these as rows.

Noise is independent, and, if asked for, correlated by distributed errors that are the same in all
shots: C = sigma^2 + sum_h tau_h^2 s_h s_h^T. Launches are nuisance parameters: their directions are
projected out of data and signatures. Prior knowledge of a launch adds rows: [shot, 2 readings + 5
coordinates], flattened.
"""

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from tmlattice.arrays import Array, Flags
from tmlattice.effects import Settings
from tmlattice.errors import MeasurementError
from tmlattice.inference.whitening import Projection
from tmlattice.lattice import Ring
from tmlattice.measurement import Measurement

EXACT = 1e-12
"""m, rad or relative: rms of a launch coordinate that is known exactly."""


@dataclass(frozen=True)
class Data:
    """Shots in the order of the ring's monitors.

    Attributes:
        readings: [shot, reading, 2], m, with reading = turn * monitors + monitor; 0 where missing.
        valid: whether a reading exists, [shot, reading, 2].
        sigma: noise of each reading, m, [shot, reading, 2]; NaN where unknown.
        launches: nominal (x, px, y, py, delta), [shot, 5].
        launch_sigma: its rms; inf where unknown, 0 where exact, [shot, 5].
        settings: of each shot.
        turns: of each shot.
    """

    readings: Array
    valid: Flags
    sigma: Array
    launches: Array
    launch_sigma: Array
    settings: tuple[Settings, ...]
    turns: int

    @property
    def shots(self) -> int:
        """Number of shots."""
        return len(self.readings)

    @property
    def planes(self) -> Flags:
        """Whether there are readings in x, and in y, [2]."""
        return np.asarray(self.valid.any(axis=(0, 1)))

    def with_sigma(self, planes: Array) -> "Data":
        """Return the data with the noise of each plane [2] where it is unknown."""
        filled = np.where(np.isfinite(self.sigma), self.sigma, planes)
        return replace(self, sigma=filled)

    def without(self, dropped: Flags) -> "Data":
        """Return the data without some readings."""
        return replace(self, valid=self.valid & ~dropped)


def of_measurement(ring: Ring, measurement: Measurement) -> Data:
    """Return the shots of a measurement.

    Raises:
        UnknownNameError: a monitor that is not in the ring.
        MeasurementError: no reading.
    """
    names = [monitor.name for monitor in ring.monitors]
    data = _of_turns(measurement.in_order_of(names), None)
    if not data.valid.any():
        raise MeasurementError("every reading is missing; nothing can be diagnosed")
    return data


def _of_turns(ordered: Measurement, turns: int | None) -> Data:
    """The first turns of a measurement, or all; unknown launches have exact energies."""
    own = ordered.readings[:, :turns]
    shots, turns = own.shape[:2]
    readings = own.reshape(shots, -1, 2)
    valid = np.isfinite(readings)
    noise = np.full(own.shape[2:], np.nan) if ordered.noise is None else ordered.noise
    launch_sigma = ordered.launch_sigma
    if launch_sigma is None:
        launch_sigma = np.tile([np.inf] * 4 + [0.0], (shots, 1))
    return Data(
        readings=np.where(valid, readings, 0.0),
        valid=valid,
        sigma=np.broadcast_to(np.tile(noise, (turns, 1)), readings.shape).copy(),
        launches=ordered.launches,
        launch_sigma=launch_sigma,
        settings=tuple(ordered.settings or ({} for _ in range(shots))),
        turns=turns,
    )


def launch_errors(
    measurement: Measurement, dimension: int, launch_sigma: ArrayLike | None = None
) -> Array:
    """Return the rms of the launches in n coordinates, [shot, n]: inf where unknown, 0 where exact.

    Args:
        measurement: whose own is taken by default. If it states none, its launches are unknown
            and their energy is exact.
        dimension: n, 4 or 6.
        launch_sigma: instead: one number, [n] or [shot, n].
    """
    sigma = np.zeros((len(measurement.launches), dimension))
    if launch_sigma is not None:
        sigma[:] = launch_sigma
        return sigma
    stated = measurement.launch_sigma
    sigma[:, :4] = np.inf if stated is None else stated[:, :4]
    if dimension == 6 and stated is not None:
        sigma[:, 5] = stated[:, 4]
    return sigma


NOISE_FLOOR = 1e-9
"""m; smallest noise of a reading: rounding and truncation of OCELOT's maps."""


def first_turn(
    monitors: Sequence[str],
    measurement: Measurement,
    noise: float | None,
    launch_sigma: ArrayLike | None,
    dimension: int = 4,
) -> Data:
    """First turn alone, with a stated noise and launches.

    Args:
        monitors: names, in the order of the readings.
        measurement: at least one shot.
        noise: rms of one reading, m; None: the measurement's.
        launch_sigma: standard error of the launch coordinates, see `launch_errors`.
        dimension: n, of the network.

    Raises:
        MeasurementError: no reading of the first turn, no stated noise, or a launch that n
            coordinates cannot describe.
        UnknownNameError: another monitor.
    """
    ordered = measurement.in_order_of(monitors)
    ordered.states(dimension)  # raises if four coordinates are too few
    data = _of_turns(ordered, 1)
    if not data.valid.any():
        raise MeasurementError("no reading of the first turn (turn 0); nothing can be fitted")
    sigma = data.sigma if noise is None else np.full(data.sigma.shape, noise)
    if np.isnan(sigma[:, data.valid.any(axis=0)]).any():
        raise MeasurementError(
            "the measurement does not state its noise; give noise= in m (one reading's rms)"
        )
    width = launch_errors(measurement, dimension, launch_sigma)
    known = np.zeros((data.shots, 5))
    known[:, :4] = width[:, :4]
    if dimension == 6:
        known[:, 4] = width[:, 5]
    sigma = np.maximum(np.nan_to_num(sigma, nan=1.0), NOISE_FLOOR)
    return replace(data, sigma=sigma, launch_sigma=known)


class Whitening:
    """Division by the noise, or by the Cholesky factor of its covariance.

    Args:
        data: readings and their noise, launches and their priors.

    Attributes:
        columns: free coordinates of the launch.
        rows: length of a whitened vector.
    """

    def __init__(self, data: Data) -> None:
        self.weight = np.where(data.valid, 1.0 / data.sigma, 0.0)
        self.shots = len(data.valid)
        sigma = np.maximum(data.launch_sigma, EXACT)
        self.columns = np.flatnonzero((data.launch_sigma > 0).any(axis=0))
        self._prior = np.where(np.isfinite(sigma), 1.0 / sigma, 0.0)  # [shot, 5]
        self._prior[:, (data.launch_sigma == 0).all(axis=0)] = 0.0
        self._nominal = data.launches
        self.rows = self.shots * (self.weight[0].size + 5)
        self._inverse: Array | None = None  # of the Cholesky factor: faster than solving

    def correlated(self, root: Array) -> "Whitening":
        """Return the whitening of readings that distributed errors correlate.

        Args:
            root: W of `inference.whitening`, [white row, row], with the columns of these rows,
                those of the launches too.
        """
        other = copy(self)
        readings = np.arange(self.rows).reshape(self.shots, -1)[:, :-5].ravel()
        other._inverse, other.rows = root[:, readings], len(root)
        return other

    @property
    def dense(self) -> bool:
        """Whether readings of different shots are correlated."""
        return self._inverse is not None

    def projected_precision(self, projection: Projection) -> Array:
        """Inverse covariance of the readings of all shots in units of their own noise, less what
        launches explain, [row, row]."""
        assert self._inverse is not None
        along = self._inverse.T @ projection.Q[0]
        return np.asarray(self._inverse.T @ self._inverse - along @ along.T)

    def back(self, rows: Array) -> Array:
        """Adjoint of `signature`: white rows [..., row] as [..., shot, reading, 2], 1 / m."""
        if self._inverse is None:
            flat = rows.reshape(*rows.shape[:-1], self.shots, -1)[..., :-5]
        else:
            flat = rows @ self._inverse
        return np.asarray(self.weight * flat.reshape(*rows.shape[:-1], *self.weight.shape))

    def signature(self, x: Array) -> Array:
        """x [..., shot, reading, 2] in m as rows [..., row]; zero in the launch's rows."""
        flat = (self.weight * x).reshape(*x.shape[:-3], self.weight.size)
        if self._inverse is not None:
            white = flat.reshape(-1, flat.shape[-1]) @ self._inverse.T
            return np.asarray(white.reshape(*flat.shape[:-1], self.rows))
        out = np.zeros((*flat.shape[:-1], self.shots, self.weight[0].size + 5))
        out[..., :-5] = flat.reshape(*flat.shape[:-1], self.shots, self.weight[0].size)
        return out.reshape(*flat.shape[:-1], self.rows)

    def residual(self, difference: Array, launches: Array) -> Array:
        """Readings less model [shot, reading, 2], and nominal less fitted launches, as rows."""
        rows = self.signature(difference).reshape(self.shots, -1)
        rows[:, -5:] = self._prior * (self._nominal - launches)
        return rows.reshape(-1)

    def launch(self, slopes: Array) -> Array:
        """d rows / d free launch coordinates from d readings / d launch [shot, reading, 2, 5],
        without distributed errors, [shot, row of the shot, column]."""
        moved = np.moveaxis(slopes[..., self.columns], -1, 0)  # [column, shot, reading, 2]
        size = len(self.columns), self.shots, self.rows // self.shots
        parts = self.signature(moved).reshape(size)
        for i, column in enumerate(self.columns):
            parts[i, :, -5 + column] = self._prior[:, column]
        return np.ascontiguousarray(np.moveaxis(parts, 0, 2))


def each_shot(moved: Array) -> Array:
    """Return changes [place, parameter, shot, ...] of a single shot each, zero in the others,
    [place, single shot, parameter, shot, ...]."""
    shots = np.arange(moved.shape[2])
    alone = np.zeros((len(moved), len(shots), *moved.shape[1:]))
    alone[:, shots, :, shots] = np.moveaxis(moved, 2, 0)
    return alone
