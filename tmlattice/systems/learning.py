"""A map learned from one solution: a recurrent polynomial network of one shared layer.

>>> fit = fit_map(ideal, angles[:, None], observed=(0,), start=[angles[0], 0.0], noise=2e-3)
>>> fit.taylor_map, fit.start, fit.covariance

The network is x_k+1 = M(x_k), the same M at every step. It is fitted by least squares over the
whole solution (not step by step: a state that is not observed has no steps), with the exact
derivatives carried along, so it needs no learning rate and no seed.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import least_squares

from tmlattice.arrays import Array
from tmlattice.errors import TmlatticeError
from tmlattice.maps import TaylorMap

Bools = NDArray[np.bool_]
LOST = 1e3  # times the largest observation: a state beyond carries no information


class DivergedError(TmlatticeError):
    """A solution that leaves the range of its map."""


@dataclass(frozen=True)
class MapFit:
    """A learned map.

    Attributes:
        taylor_map: the learned one.
        start: fitted first state, [n].
        residuals: observations less the network's, [step, observed].
        covariance: of (free weights, free start coordinates), at the noise given.
        free: which of the map's weights moved, [n, monomial], in the order of `weights_of`.
    """

    taylor_map: TaylorMap
    start: Array
    residuals: Array
    covariance: Array
    free: Bools

    def error_of(self, quantity: Callable[[TaylorMap], float]) -> float:
        """Standard error of a number that is computed from the map, by its linear propagation."""
        rows = weights_of(self.taylor_map)
        slope = np.zeros(len(self.covariance))
        for i, place in enumerate(zip(*np.nonzero(self.free), strict=True)):
            step = 1e-4 * np.sqrt(self.covariance[i, i])
            either = []
            for sign in (1, -1):
                moved = rows.copy()
                moved[place] += sign * step
                either.append(quantity(map_of_weights(moved, self.taylor_map.order)))
            slope[i] = (either[0] - either[1]) / (2 * step)
        return float(np.sqrt(slope @ self.covariance @ slope))


def weights_of(taylor_map: TaylorMap) -> Array:
    """Return all weights of a map in one array [n, monomial], degree by degree from W0 on."""
    W = taylor_map.coefficients
    return np.concatenate([W[0][:, None], *W[1:]], axis=1)


def map_of_weights(rows: Array, order: int) -> TaylorMap:
    """Return the map whose `weights_of` are rows [n, monomial]."""
    return TaylorMap._of_rows(np.array(rows, dtype=float), order)


def follow(taylor_map: TaylorMap, start: ArrayLike, steps: int) -> Array:
    """Return the states x, M(x), M(M(x)), ..., [steps + 1, ..., n]; not finite once diverged."""
    states = [np.asarray(start, dtype=float)]
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(steps):
            states.append(taylor_map(states[-1]))
    return np.array(states)


def fit_step_by_step(solution: ArrayLike, order: int) -> TaylorMap:
    """Return the map from each observed state to the next, by linear least squares.

    It needs all coordinates. Columns are scaled to unit length; of equivalent solutions the one
    with the smallest weights in that scale is taken.

    Args:
        solution: [step, n], or several solutions of one length [solution, step, n].
    """
    solution = np.asarray(solution, dtype=float)
    n = solution.shape[-1]
    before = solution[..., :-1, :].reshape(-1, n)
    after = solution[..., 1:, :].reshape(-1, n)
    columns = TaylorMap.identity(n, order).monomials(before)
    scale = np.linalg.norm(columns, axis=0)
    scale[scale == 0] = 1.0
    weights, *_ = np.linalg.lstsq(columns / scale, after, rcond=None)
    return map_of_weights((weights / scale[:, None]).T, order)


def fit_map(
    first: TaylorMap,
    observations: ArrayLike,
    observed: Sequence[int],
    start: ArrayLike,
    noise: float | ArrayLike,
    free: Bools | None = None,
    free_start: Sequence[int] = (),
    prior: Array | float | None = None,
) -> MapFit:
    """Fine-tune a map on one solution.

    Args:
        first: the map to start from (a model's, or `fit_step_by_step`'s).
        observations: [step, observed], NaN where one is missing.
        observed: which coordinates these are.
        start: the first state [n]; a guess for the coordinates that are free.
        noise: rms of one observation, one or [observed], in its unit.
        free: weights that may move, [n, monomial] as in `weights_of`; else all.
        free_start: coordinates of the start to fit.
        prior: rms of the weights' changes from `first`, one or [n, monomial]; it determines what
            the solution does not. None: no prior.

    Returns:
        The map, with covariance for the noise given.

    Raises:
        DivergedError: the first map's own solution diverges.
    """
    y = np.asarray(observations, dtype=float)
    x0 = np.asarray(start, dtype=float)
    rows = weights_of(first)
    mask = np.ones(rows.shape, dtype=bool) if free is None else np.asarray(free, dtype=bool)
    weights = int(mask.sum())
    picked, columns, sigma = np.isfinite(y), list(observed), np.broadcast_to(noise, y.shape)
    limit = LOST * np.nanmax(np.abs(y))
    spread = None if prior is None else np.broadcast_to(prior, rows.shape)[mask]
    image, monomial = np.nonzero(mask)
    free_start = list(free_start)

    def unpacked(p: Array) -> tuple[TaylorMap, Array]:
        moved, begin = rows.copy(), x0.copy()
        moved[mask] += p[:weights]
        begin[free_start] += p[weights:]
        return map_of_weights(moved, first.order), begin

    def residuals(p: Array) -> Array:
        states = follow(*unpacked(p), len(y) - 1)
        states = np.clip(np.nan_to_num(states, nan=limit), -limit, limit)
        left = (states[:, columns] - y)[picked] / sigma[picked]
        return left if spread is None else np.concatenate([left, p[:weights] / spread])

    def slopes(p: Array) -> Array:
        taylor_map, x = unpacked(p)
        gradient = np.zeros((first.n, len(p)))
        gradient[free_start, range(weights, len(p))] = 1.0
        found = np.empty((len(y), len(columns), len(p)))
        states = np.clip(np.nan_to_num(follow(taylor_map, x, len(y) - 1)), -limit, limit)
        jacobians, powers = taylor_map.jacobian(states), taylor_map.monomials(states)
        for k in range(len(y)):
            found[k] = gradient[columns]
            gradient = jacobians[k] @ gradient
            gradient[image, range(weights)] += powers[k, monomial]
        left: Array = found[picked] / sigma[picked][:, None]
        if spread is not None:
            left = np.concatenate([left, np.eye(weights, len(p)) / spread[:, None]])
        return left

    begin = np.zeros(weights + len(free_start))
    first_states = follow(*unpacked(begin), len(y) - 1)
    if not (np.abs(first_states) < limit).all():
        step = int(np.argmin((np.abs(first_states) < limit).all(axis=1)))
        raise DivergedError(
            f"the map to start from diverges at step {step} of {len(y) - 1}; start from another, "
            "or fit a shorter solution first"
        )
    found = least_squares(
        residuals, begin, slopes, x_scale="jac", xtol=1e-12, ftol=1e-12, gtol=1e-12,
        max_nfev=100,
    )  # fmt: skip
    learned, begun = unpacked(found.x)
    _, singular, axes = np.linalg.svd(np.asarray(found.jac), full_matrices=False)
    kept = singular > 1e-13 * singular[0]
    covariance = (axes[kept].T / singular[kept] ** 2) @ axes[kept]
    left = y - follow(learned, begun, len(y) - 1)[:, columns]
    return MapFit(learned, begun, left, covariance, mask)
