"""Free fall with drag, dv/dt = g - (k / m) v^2: a map against Euler, Runge-Kutta and a forest.

>>> step_errors([0.5, 0.1])                     # of Euler's and the map's steps, m/s
>>> predicted_masses([60, 90, 120])             # learned from 100 and 80 kg alone
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from tmlattice.arrays import Array
from tmlattice.maps import TaylorMap, taylor_map_of_ode
from tmlattice.systems import Comparison
from tmlattice.systems.learning import follow, map_of_weights, weights_of

GRAVITY = 9.8  # m/s^2
DRAG = 0.392  # kg/m
LEARNED_FROM = (100.0, 80.0)  # kg
ORDERS = (2, 4, 8)  # of the compared maps
FALL: Array = 0.5 * np.arange(31.0)  # s


def equation(mass: float = 100.0) -> dict[tuple[int, ...], list[float]]:
    """dv/dt in m/s^2 as terms in v [m/s]; mass in kg."""
    return {(0,): [GRAVITY], (2,): [-DRAG / mass]}


def velocity(time: ArrayLike, mass: ArrayLike = 100.0) -> Array:
    """The closed solution v(t), m/s, of a fall from rest."""
    final = np.sqrt(GRAVITY * np.asarray(mass, dtype=float) / DRAG)
    return np.asarray(final * np.tanh(GRAVITY * np.asarray(time, dtype=float) / final))


def euler_map(step: float, mass: float = 100.0) -> TaylorMap:
    """Euler's step v -> v + step (g - k/m v^2), read as a map of second order."""
    return TaylorMap([[step * GRAVITY], [[1.0]], [[-step * DRAG / mass]]])


def runge_kutta_map(step: float, mass: float = 100.0) -> TaylorMap:
    """The classic Runge-Kutta step of fourth order: a polynomial of degree 16 in v, exactly."""

    def slope(v: np.polynomial.Polynomial) -> np.polynomial.Polynomial:
        return GRAVITY - DRAG / mass * v * v

    v = np.polynomial.Polynomial([0.0, 1.0])
    k1 = slope(v)
    k2 = slope(v + step / 2 * k1)
    k3 = slope(v + step / 2 * k2)
    k4 = slope(v + step * k3)
    end = v + step / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return map_of_weights(np.asarray(end.coef, dtype=np.float64)[None, :], 16)


@dataclass(frozen=True)
class StepErrors:
    """Largest error over a fall of 15 s from rest, m/s, by step [s]; each [step]."""

    steps: Array
    euler: Array
    taylor: dict[int, Array]  # by order of the map
    runge_kutta: Array


def step_errors(steps: ArrayLike) -> StepErrors:
    """Return errors of Euler, the truncated maps and Runge-Kutta in 15 s, for each step [s]."""
    steps = np.asarray(steps, dtype=float)
    errors = []
    for step in steps:
        count = round(15 / step)
        truth = velocity(step * np.arange(count + 1))[:, None]
        maps = [euler_map(step), runge_kutta_map(step)]
        maps += [taylor_map_of_ode(equation(), order, step) for order in ORDERS]
        errors.append([np.abs(follow(m, [0.0], count) - truth).max() for m in maps])
    euler, kutta, *taylor = np.array(errors).T
    return StepErrors(steps, euler, dict(zip(ORDERS, taylor, strict=True)), kutta)


def masses_map() -> TaylorMap:
    """Return a map of third order of (v, 100 kg / m) fitted to the falls of `LEARNED_FROM`.

    Two masses determine no more than a straight line in 1 / m, so only monomials with at most its
    first power are fitted; the map has no other physics.
    """
    states = _learned_falls()
    identity = TaylorMap.identity(2, 3)
    columns = identity.monomials(states[:, :-1].reshape(-1, 2))
    exponents = identity.exponents
    free = exponents[:, 1] <= 1
    scale = np.linalg.norm(columns, axis=0)
    found, *_ = np.linalg.lstsq((columns / scale)[:, free], states[:, 1:, 0].ravel(), rcond=1e-10)
    rows = weights_of(identity)
    rows[0] = 0.0
    rows[0, free] = found / scale[free]
    return map_of_weights(rows, 3)


@dataclass(frozen=True)
class MassErrors:
    """Largest error over 15 s of falls of masses that were not learned from, m/s, [mass]."""

    masses: Array
    taylor: Array
    forest: Array | None
    time: Array
    truth: Array
    taylor_falls: Array
    forest_falls: Array | None


def _learned_falls() -> Array:
    """(v, 100 kg / m) of one fall from rest a mass, [mass, step + 1, 2]."""
    falls = velocity(FALL, np.array(LEARNED_FROM)[:, None])
    inverse = np.broadcast_to(100 / np.array(LEARNED_FROM)[:, None], falls.shape)
    return np.stack([falls, inverse], axis=2)


def predicted_masses(masses: Sequence[float], forest: bool = True, seed: int = 0) -> MassErrors:
    """Return falls of other masses by the fitted map and by a random forest on the same two falls.

    Args:
        masses: kg.
        forest: whether to train one; it needs scikit-learn, and is skipped without it.
    """
    truth = velocity(FALL, np.array(masses)[:, None])
    starts = np.stack([np.zeros(len(masses)), 100 / np.array(masses)], axis=1)
    by_map = follow(masses_map(), starts, len(FALL) - 1)[:, :, 0].T
    by_forest = _forest_falls(starts, seed) if forest else None
    return MassErrors(
        np.array(masses, dtype=float),
        np.abs(by_map - truth).max(axis=1),
        None if by_forest is None else np.abs(by_forest - truth).max(axis=1),
        FALL,
        truth,
        by_map,
        by_forest,
    )


def _forest_falls(starts: Array, seed: int) -> Array | None:
    try:
        from sklearn.ensemble import RandomForestRegressor
    except ImportError:
        return None
    learned = _learned_falls()
    forest = RandomForestRegressor(n_estimators=200, random_state=seed)
    forest.fit(learned[:, :-1].reshape(-1, 2), learned[:, 1:, 0].ravel())
    states = starts.copy()
    result = [states[:, 0].copy()]
    for _ in FALL[1:]:
        states[:, 0] = forest.predict(states)
        result.append(states[:, 0].copy())
    return np.array(result).T


def comparisons(errors: StepErrors, masses: MassErrors) -> list[Comparison]:
    """Return comparisons of the paper's figures with ours."""
    W0, W1, W2 = (w.item() for w in taylor_map_of_ode(equation(), 2, 0.1).coefficients)
    kutta = runge_kutta_map(0.1)
    true16 = taylor_map_of_ode(equation(), 16, 0.1)
    difference = np.abs(weights_of(kutta) - weights_of(true16))[0]
    rows = [
        Comparison("dt = 0.1 s: constant [m/s]", 0.979874527, W0),
        Comparison("dt = 0.1 s: linear", 0.999615938, W1),
        Comparison(
            "dt = 0.1 s: quadratic [s/m]", -3.842686e-4, W2,
            "a misprint: -tanh(a) / cosh(a)^2 / 50 m/s with a = 0.0196, closed solution",
        ),
        Comparison(
            "steps of 15 s at 0.5 s", 60, len(masses.time) - 1,
            "a misprint: 15 / 0.5 = 30 (60 samples are those of both masses)",
        ),
        Comparison(
            "Runge-Kutta 4 at 0.1 s as a map of degree 16: largest error of a coefficient to v^2",
            None, float(difference[:3].max()),
            "against the true map; its error is of fifth order in the step",
        ),
        Comparison(
            "the same: coefficients from v^6 on that are wrong by more than half", None,
            int((difference > 0.5 * np.abs(weights_of(true16)[0]))[6:].sum()),
            "of 11; v^k begins with the step to the power k - 1, and it has powers to four right",
        ),
    ]  # fmt: skip
    names = " / ".join(f"map {order}" for order in errors.taylor)
    for i, step in enumerate(errors.steps):
        maps = " / ".join(f"{taylor[i]:.1e}" for taylor in errors.taylor.values())
        rows.append(
            Comparison(
                f"largest error in 15 s, step {step:g} s: Euler / {names} / Runge-Kutta [m/s]",
                None, f"{errors.euler[i]:.1e} / {maps} / {errors.runge_kutta[i]:.1e}",
                "the map of order 2 lacks v^3 (step^2), the largest near the final 50 m/s, "
                "and is behind Euler's there" if i == 0 else "",
            )
        )  # fmt: skip
    for i, mass in enumerate(masses.masses):
        forest = "not installed" if masses.forest is None else f"{masses.forest[i]:.2f}"
        rows.append(
            Comparison(
                f"learned from 100 and 80 kg, error for {mass:g} kg: map / forest [m/s]", None,
                f"{masses.taylor[i]:.3f} / {forest}",
                "the forest repeats the nearer of the two falls" if i == 0 else "",
            )
        )  # fmt: skip
    return rows
