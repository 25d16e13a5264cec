"""A pendulum: the map of the ideal one, fine-tuned on one filmed swing of the real one.

State (angle [rad], angular velocity [rad/s]); only the angle is observed.

>>> learned = learn(angles)                       # [50], one every 0.1 s
>>> learned.length, learned.damping               # (value, standard error), m and 1/s
>>> learned.swing(0.17)                           # released at rest from 0.17 rad
"""

import os
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike
from scipy.integrate import solve_ivp
from scipy.optimize import least_squares

from tmlattice.arrays import Array
from tmlattice.maps import TaylorMap, ode_of_taylor_map, taylor_map_of_ode
from tmlattice.systems import Comparison
from tmlattice.systems.learning import MapFit, fit_map, follow, weights_of

GRAVITY = 9.8  # m/s^2, the paper's
FRAME = 0.1  # s
LAYERS = 49
IDEAL_LENGTH = 0.30  # m
TRUE_LENGTH = 0.28  # m
TRUE_DAMPING = 0.2  # 1/s
CAMERA_NOISE = 2e-3  # rad, rms of one angle
PRIOR = 0.3  # rms change of a linear weight that the fit allows, relative to its natural size


def equation(length: float, damping: float = 0.0) -> dict[tuple[int, ...], list[float]]:
    """angle'' = -damping angle' - g / length (angle - angle^3 / 6), m and 1/s, as terms."""
    k = GRAVITY / length
    return {(0, 1): [1.0, -damping], (1, 0): [0.0, -k], (3, 0): [0.0, k / 6]}


def ideal_map() -> TaylorMap:
    """The third-order map over one frame of an undamped pendulum of `IDEAL_LENGTH`."""
    return taylor_map_of_ode(equation(IDEAL_LENGTH), 3, FRAME)


def filmed(
    angle: float,
    rng: np.random.Generator,
    noise: float = CAMERA_NOISE,
    velocity: float = 0.0,
) -> Array:
    """Angles [50] of a simulated swing with the full sine, damping and camera noise, rad.

    Args:
        angle: at the first frame, rad.
        rng: of the camera's noise.
        noise: rms of one angle, rad.
        velocity: at the first frame, rad/s.
    """
    times = FRAME * np.arange(LAYERS + 1)
    done = solve_ivp(
        lambda t, x: [x[1], -TRUE_DAMPING * x[1] - GRAVITY / TRUE_LENGTH * np.sin(x[0])],
        (0, times[-1]), [angle, velocity], method="DOP853", t_eval=times, rtol=1e-11, atol=1e-13,
    )  # fmt: skip
    return np.asarray(done.y[0] + noise * rng.normal(size=len(times)))


def film(name: str) -> Array | None:
    """Return angles [frame] of a real swing, "a" or "b", from $TMLATTICE_DATA, or None."""
    folder = os.environ.get("TMLATTICE_DATA")
    path = Path(folder or "") / "pendulum" / f"swing_{name}.csv"
    if not folder or not path.exists():
        return None
    return np.loadtxt(path, delimiter=",", skiprows=1)[:, 1]


def _linear(taylor_map: TaylorMap) -> Array:
    """The matrix of d(angle, velocity)/dt near rest."""
    terms = ode_of_taylor_map(taylor_map, FRAME)
    return np.column_stack([terms[1, 0], terms[0, 1]])


def length_of(taylor_map: TaylorMap) -> float:
    """Return g over the determinant of the linear equation, m, independent of latent velocity."""
    return float(GRAVITY / np.linalg.det(_linear(taylor_map)))


def damping_of(taylor_map: TaylorMap) -> float:
    """Return minus the trace of the linear equation, 1/s."""
    return float(-np.trace(_linear(taylor_map)))


@dataclass(frozen=True)
class LearnedPendulum:
    """A pendulum learned from one swing.

    Attributes:
        fit: the fine-tuned map and its covariance.
        noise: rms of one angle, rad, estimated from the fit's residuals.
    """

    fit: MapFit
    noise: float

    @cached_property
    def length(self) -> tuple[float, float]:
        """Recovered through map -> equation, and its standard error, m."""
        return length_of(self.fit.taylor_map), self.fit.error_of(length_of)

    @cached_property
    def damping(self) -> tuple[float, float]:
        """Recovered through map -> equation, and its standard error, 1/s."""
        return damping_of(self.fit.taylor_map), self.fit.error_of(damping_of)

    def swing(self, angle: float, velocity: float = 0.0) -> Array:
        """Return the angles of 50 frames from a start, rad and rad/s.

        The latent coordinate is only nearly the velocity: here it is chosen so that the angle
        begins to change with `velocity` under the learned equation.
        """
        A = _linear(self.fit.taylor_map)
        latent = (velocity - A[0, 0] * angle) / A[0, 1]
        return follow(self.fit.taylor_map, [angle, latent], LAYERS)[:, 0]


def learn(angles: ArrayLike, start_velocity: float = 0.0) -> LearnedPendulum:
    """Fine-tune the ideal map on one swing, the first velocity free.

    Linear weights are free; a prior of 30 % keeps the latent coordinate near the velocity, which
    angles alone do not determine, and hardly affects the rest. A swing of a tenth of a radian does
    not determine cubic weights: they stay at the ideal map's.

    Args:
        angles: [frame], one every 0.1 s, rad.
        start_velocity: a guess, rad/s.
    """
    y = np.asarray(angles, dtype=float)
    ideal = ideal_map()
    free = np.zeros(weights_of(ideal).shape, dtype=bool)
    free[:, 1:3] = True
    k = np.sqrt(GRAVITY / IDEAL_LENGTH)
    natural = np.ones_like(weights_of(ideal))
    natural[:, 1:3] = PRIOR * np.array([[1, 1 / k], [k, 1]])
    noise = CAMERA_NOISE
    for _ in range(3):  # the weight of the prior depends on the noise, which is that of residuals
        fit = fit_map(ideal, y[:, None], (0,), [y[0], start_velocity], noise, free, (0, 1), natural)
        # of the six fitted numbers four are determined: period, damping and the start
        noise = float(np.sqrt((fit.residuals**2).sum() / (len(y) - 4)))
    return LearnedPendulum(fit, noise)


def predict(taylor_map: TaylorMap, angles: ArrayLike, seen: int = 5) -> Array:
    """Return angles of a swing from its first frames: a map's best start, then the map alone.

    Args:
        taylor_map: learned or ideal.
        angles: [frame], rad; only the first `seen` are used.
        seen: frames that fix the start.

    Returns:
        [frame], rad.
    """
    y = np.asarray(angles, dtype=float)

    def residuals(x: Array) -> Array:
        return np.asarray(follow(taylor_map, x, seen - 1)[:, 0] - y[:seen])

    found = least_squares(residuals, np.array([y[0], 0.0]))
    return follow(taylor_map, found.x, len(y) - 1)[:, 0]


@dataclass(frozen=True)
class SwingTest:
    """A swing that was not learned: angles [frame] as filmed and as two maps predict it."""

    source: str
    angles: Array
    learned: Array
    ideal: Array
    seen: int

    def rms(self) -> tuple[float, float]:
        """Return rms errors of the learned and the ideal map over the frames not seen, rad."""
        left = np.stack([self.learned, self.ideal])[:, self.seen :] - self.angles[self.seen :]
        learned, ideal = np.sqrt(np.mean(left**2, axis=1))
        return float(learned), float(ideal)


@dataclass(frozen=True)
class PendulumStudy:
    """Results from a simulated swing and, if there is a film, from the real one."""

    angles: Array
    simulated: LearnedPendulum
    tests: tuple[SwingTest, ...]
    real_angles: Array | None
    real: LearnedPendulum | None
    other: LearnedPendulum | None  # learned from the film's other swing, to see how they agree


def study(seed: int = 0) -> PendulumStudy:
    """Learn from one swing, predict others; simulated, and filmed where the film is present."""
    rng = np.random.default_rng(seed)
    angles = filmed(0.09, rng)
    simulated = learn(angles)
    tests = []
    for angle in (0.05, 0.17, 0.3):
        swing = filmed(angle, rng, noise=0.0)
        ideal = follow(ideal_map(), [angle, 0.0], LAYERS)[:, 0]
        tests.append(
            SwingTest(f"simulated, {angle:g} rad", swing, simulated.swing(angle), ideal, 1)
        )
    a, b = film("a"), film("b")
    real = None if a is None else learn(a)
    other = None if b is None else learn(b)
    if real is not None and b is not None:
        seen = 5
        by_learned, by_ideal = (predict(m, b, seen) for m in (real.fit.taylor_map, ideal_map()))
        tests.append(SwingTest("filmed, swing b", b, by_learned, by_ideal, seen))
    return PendulumStudy(angles, simulated, tuple(tests), a, real, other)


def comparisons(done: PendulumStudy) -> list[Comparison]:
    """Return comparisons of the paper's figures with ours."""
    W3 = ideal_map().coefficients[3]
    rows = [
        Comparison(f"ideal map, W3 row {i + 1}, {name}", printed, float(W3[i, j]),
                   "printed with one digit" if (i, j) == (0, 3) else "")
        for i, line in enumerate([[0.02445, 0.002389, 1.21e-4, 2e-6],
                                  [0.43723, 0.065468, 0.004534, 1.21e-4]])
        for j, (name, printed) in enumerate(zip(("a^3", "a^2 w", "a w^2", "w^3"), line,
                                                strict=True))
    ]  # fmt: skip
    for what, made, truth in (
        ("simulated", done.simulated, (f"{TRUE_LENGTH:g} m", f"{TRUE_DAMPING:g} 1/s")),
        ("filmed swing a", done.real, ("0.28 m, by the builder", "unknown")),
    ):
        if made is None:
            why = "set TMLATTICE_DATA to the folder that holds pendulum/"
            rows.append(Comparison(f"{what}: length [m]", TRUE_LENGTH, "no film here", why))
            continue
        (length, dl), (damping, dd) = made.length, made.damping
        rows += [
            Comparison(f"{what}: length [m]", TRUE_LENGTH, f"{length:.4f} ± {dl:.4f}",
                       f"truth {truth[0]}; the model begins with 0.30" if made is done.simulated
                       else f"{truth[0]}; the period here, "
                       f"{2 * np.pi * np.sqrt(length / GRAVITY):.3f} s, if 10 frames a second"),
            Comparison(f"{what}: damping [1/s]", None, f"{damping:.3f} ± {dd:.3f}",
                       f"truth {truth[1]}; the model begins with 0"),
            Comparison(f"{what}: noise of one angle [mrad]", None, round(1e3 * made.noise, 2),
                       f"put in {1e3 * CAMERA_NOISE:g}" if made is done.simulated
                       else "the camera was not calibrated; steps of 4 mrad"),
        ]  # fmt: skip
    if done.other is not None:
        (length, dl), (damping, dd) = done.other.length, done.other.damping
        rows.append(
            Comparison("filmed swing b, learned alone: length [m], damping [1/s]", None,
                       f"{length:.4f} ± {dl:.4f}, {damping:.3f} ± {dd:.3f}",
                       "the two swings differ by more than their noise (friction may depend on "
                       "the amplitude): the errors above are too small for the film")
        )  # fmt: skip
    for test in done.tests:
        learned, ideal = test.rms()
        rows.append(
            Comparison(f"{test.source}: rms error, learned / ideal [mrad]", None,
                       f"{1e3 * learned:.2f} / {1e3 * ideal:.2f}",
                       f"start from its first {test.seen} frames" if test.seen > 1
                       else "released at rest; noise-free truth")
        )  # fmt: skip
    return rows
