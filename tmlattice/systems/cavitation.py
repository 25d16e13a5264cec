"""A driven gas bubble in a liquid: growth, collapse and rebound by Taylor maps.

Rayleigh-Plesset, R R'' + 3/2 R'^2 = (p_B - p_0 - p_a s) / rho - 4 nu R'/R - 2 sigma / (rho R), with
the bubble's pressure p_B = p_v + p_g (R0 / R)^3 (isothermal) and a pressure wave s = sin(omega t).
With z = 1 / R and c = cos(omega t) it is a polynomial in five coordinates (R, R', z, s, c):

    R'  = u
    u'  = -3/2 u^2 z + z (p_B - p_0 - p_a s) / rho - 4 nu u z^2 - 2 sigma / rho z^2
    z'  = -u z^2        s' = omega c        c' = -omega s

Lengths are in the radius at rest R0, times in R0 sqrt(rho / p_0), pressures in p_0; maps expand
about the bubble at rest (1, 0, 1, 0, 0).

>>> bubble = Bubble(drive=0.8)
>>> run = ladder(bubble).follow(bubble.start, bubble.period)
>>> learned = learn(radii, steps)              # from one oscillation, begun with a wrong viscosity
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike
from scipy.integrate import solve_ivp

from tmlattice.arrays import Array
from tmlattice.maps import TaylorMap, ode_of_taylor_map, recentred, taylor_map_of_ode
from tmlattice.maps.ode import OdeError
from tmlattice.systems import Comparison
from tmlattice.systems.learning import MapFit, fit_map, follow, weights_of

REST = np.array([1.0, 0.0, 1.0, 0.0, 0.0])


@dataclass(frozen=True)
class Bubble:
    """A bubble in a liquid under a sound wave, SI units.

    Attributes:
        radius: at rest, m.
        density: of the liquid, kg/m^3.
        pressure: of the liquid at rest, Pa.
        vapour: pressure of the vapour, Pa.
        tension: N/m.
        viscosity: kinematic, m^2/s.
        frequency: of the wave, Hz.
        drive: amplitude of the wave in units of `pressure`.
    """

    radius: float = 1e-4
    density: float = 998.0
    pressure: float = 1.013e5
    vapour: float = 2.33e3
    tension: float = 0.0725
    viscosity: float = 2e-5
    frequency: float = 1e4
    drive: float = 0.8

    @property
    def time(self) -> float:
        """The unit of time, s."""
        return float(self.radius * np.sqrt(self.density / self.pressure))

    @property
    def period(self) -> float:
        """Period of the wave, in units of `time`."""
        return 1 / (self.frequency * self.time)

    @property
    def start(self) -> Array:
        """State at rest as the wave begins, as the distance from `REST`."""
        return np.array([0.0, 0.0, 0.0, 0.0, 1.0])

    @property
    def damping(self) -> float:
        """4 nu in the scaled units."""
        return 4 * self.viscosity * self.time / self.radius**2

    @property
    def _scaled(self) -> tuple[float, float, float]:
        """Pressures of the surface and of the vapour, and the wave's frequency, scaled."""
        surface = 2 * self.tension / (self.radius * self.pressure)
        return surface, self.vapour / self.pressure, 2 * np.pi / self.period

    @cached_property
    def terms(self) -> dict[tuple[int, ...], Array]:
        """The scaled equation for the distance from `REST`."""
        surface, vapour, omega = self._scaled
        rows = {
            (0, 1, 0, 0, 0): (0, 1.0),
            (0, 2, 1, 0, 0): (1, -1.5),
            (0, 0, 1, 0, 0): (1, vapour - 1.0),
            (0, 0, 4, 0, 0): (1, 1.0 - vapour + surface),  # at rest the pressures balance
            (0, 0, 1, 1, 0): (1, -self.drive),
            (0, 0, 2, 0, 0): (1, -surface),
            (0, 1, 2, 0, 0): (1, -self.damping),
            (0, 0, 0, 0, 1): (3, omega),
            (0, 0, 0, 1, 0): (4, -omega),
        }
        terms: dict[tuple[int, ...], Array] = {
            e: value * np.eye(5)[row] for e, (row, value) in rows.items()
        }
        terms[0, 1, 2, 0, 0] = terms[0, 1, 2, 0, 0] - np.eye(5)[2]  # z' = -u z^2
        return recentred(terms, REST)

    def solution(self, times: ArrayLike) -> Array:
        """Return true distances from `REST` at scaled times, [time, 5], by the equation in R."""
        surface, vapour, omega = self._scaled

        def slope(t: float, x: Array) -> list[float]:
            R, u = x
            gas = vapour + (1 - vapour + surface) / R**3
            outside = 1 + self.drive * np.sin(omega * t)
            force = gas - outside - self.damping * u / R - surface / R
            return [u, (force - 1.5 * u * u) / R]

        t = np.asarray(times, dtype=float)
        done = solve_ivp(
            slope, (0.0, t[-1]), [1.0, 0.0], method="DOP853", t_eval=t, rtol=1e-12, atol=1e-14
        )
        R, u = np.asarray(done.y)
        wave = np.sin(omega * t), np.cos(omega * t)
        return np.asarray(np.stack([R, u, 1 / R, *wave], axis=1) - REST)


@dataclass(frozen=True)
class Run:
    """A solution by maps: scaled times [step + 1], distances from `REST` [step + 1, 5]."""

    times: Array
    states: Array

    @property
    def radius(self) -> Array:
        """In units of the radius at rest, [step + 1]."""
        return self.states[:, 0] + 1.0


@dataclass(frozen=True)
class Ladder:
    """Maps over a step, half of it, a quarter, ...; each state uses the longest valid one.

    A step is valid if the terms of the highest degree, the last of the truncation, add less than
    `tolerance` times the step.

    Attributes:
        longest: the first step, in units of time.
        maps: one for each halving.
        tolerance: of one step, relative to its length.
    """

    longest: float
    maps: tuple[TaylorMap, ...]
    tolerance: float

    def follow(self, start: ArrayLike, duration: float) -> Run:
        """Return states after each step from `start` [5] until `duration`, a multiple of longest.

        Raises:
            OdeError: even the shortest step is not valid.
        """
        x = np.asarray(start, dtype=float)
        order = self.maps[0].order
        top = self.maps[0].exponents.sum(axis=1) == order
        rows = [weights_of(m) for m in self.maps]
        finest = 2 ** (len(self.maps) - 1)
        end, now = round(duration / self.longest) * finest, 0
        rung, times, states = 0, [0.0], [x]
        while now < end:
            powers = self.maps[0].monomials(x)
            rung = max(0, rung - 1)
            while now % (finest >> rung):  # a step begins at a multiple of itself
                rung += 1
            while True:
                step = self.longest / 2**rung
                if np.abs(rows[rung][:, top] @ powers[top]).max() <= self.tolerance * step:
                    break
                rung += 1
                if rung == len(self.maps):
                    raise OdeError(
                        f"at {now / finest * self.longest:.6g} the bubble is too small for the "
                        f"shortest step {step:.3g}; make a ladder with more halvings"
                    )
            x = rows[rung] @ powers
            now += finest >> rung
            times.append(now / finest * self.longest)
            states.append(x)
        return Run(np.array(times), np.array(states))


def ladder(
    bubble: Bubble, order: int = 6, steps: int = 100, halvings: int = 14, tolerance: float = 1e-6
) -> Ladder:
    """Return maps of a bubble for a period of the wave in `steps` steps, and repeated halvings."""
    longest = bubble.period / steps
    maps = tuple(taylor_map_of_ode(bubble.terms, order, longest / 2**k) for k in range(halvings))
    return Ladder(longest, maps, tolerance)


GENTLE = Bubble(drive=0.4)  # for learning: its collapse needs no halved steps
WRONG = 0.5  # of the true viscosity, in the initial model
STEPS = 400  # a period
ORDER = 5
OBSERVED = 1.5  # periods: one growth, collapse and rebound of the bubble
READING = 1e-3  # rms of one radius, in units of the radius at rest


def damping_of(taylor_map: TaylorMap, time: float) -> float:
    """Return 4 nu in scaled units from a map over `time`: the linear damping of u."""
    return -float(ode_of_taylor_map(taylor_map.truncated(1), time)[0, 1, 0, 0, 0][1])


@dataclass(frozen=True)
class LearnedBubble:
    """A map learned from the radius over one oscillation.

    Attributes:
        fit: the map over a period / `STEPS`, and its covariance.
        bubble: the initial model, of the wrong viscosity.
    """

    fit: MapFit
    bubble: Bubble

    @property
    def viscosity(self) -> tuple[float, float]:
        """Viscosity recovered through map -> equation, and its standard error, m^2/s."""
        step = self.bubble.period / STEPS
        unit = 4 * self.bubble.time / self.bubble.radius**2
        value = damping_of(self.fit.taylor_map, step) / unit
        return value, self.fit.error_of(lambda m: damping_of(m, step)) / unit

    def radii(self, periods: float = 1.0, drive: float | None = None) -> Array:
        """Return R / R0 at every step from rest; a drive sets the size of the wave (s, c)."""
        start = self.bubble.start * (1.0 if drive is None else drive / self.bubble.drive)
        return follow(self.fit.taylor_map, start, round(periods * STEPS))[:, 0] + 1.0


def learn(radii: ArrayLike, model: Bubble) -> LearnedBubble:
    """Fine-tune the map of a model on the radius over one oscillation.

    The free weights are those of the velocity by products of (u, z) up to the third degree: gas,
    surface and viscosity. The wave and the definitions of R and z are fixed.

    Args:
        radii: R / R0 from rest on, `STEPS` times a period of the wave, [step].
        model: with the wrong viscosity.
    """
    step = model.period / STEPS
    first = taylor_map_of_ode(model.terms, ORDER, step)
    exponents = first.exponents
    degree = exponents.sum(axis=1)
    inside = (degree > 0) & (degree <= 3) & (exponents[:, [0, 3, 4]] == 0).all(axis=1)
    free = np.zeros((5, len(degree)), dtype=bool)
    free[1, inside] = True
    y = np.asarray(radii, dtype=float)[:, None] - 1.0
    # a prior of a tenth of the unit of force, for what the solution does not determine
    return LearnedBubble(
        fit_map(first, y, (0,), model.start, READING, free, prior=0.1 * step), model
    )


@dataclass(frozen=True)
class CavitationStudy:
    """Everything of `tmlattice dev reproduce cavitation`."""

    bubble: Bubble
    run: Run
    truth: Array
    ladder: Ladder
    observed: Array
    model: Array
    learned: LearnedBubble
    stronger: float
    stronger_truth: Array
    stronger_model: Array


def study(
    drive: float = 0.8, periods: int = 2, order: int = 7, tolerance: float = 1e-3, seed: int = 0
) -> CavitationStudy:
    """Follow a hard collapse by maps, and learn the viscosity from one gentle oscillation."""
    bubble = Bubble(drive=drive)
    rungs = ladder(bubble, order, tolerance=tolerance)
    run = rungs.follow(bubble.start, periods * bubble.period)
    rng = np.random.default_rng(seed)
    times = GENTLE.period / STEPS * np.arange(2 * STEPS + 1)
    truth = GENTLE.solution(times)[:, 0] + 1.0
    seen = round(OBSERVED * STEPS) + 1
    observed = truth[:seen] + READING * rng.normal(size=seen)
    wrong = replace(GENTLE, viscosity=WRONG * GENTLE.viscosity)
    learned = learn(observed, wrong)
    stronger = 1.25 * GENTLE.drive
    return CavitationStudy(
        bubble, run, bubble.solution(run.times), rungs, observed,
        wrong.solution(times)[:, 0] + 1.0, learned, stronger,
        replace(GENTLE, drive=stronger).solution(times)[:, 0] + 1.0,
        replace(wrong, drive=stronger).solution(times)[:, 0] + 1.0,
    )  # fmt: skip


def comparisons(done: CavitationStudy) -> list[Comparison]:
    """Return comparisons of the paper's figures with our numbers."""
    run, truth = done.run, done.truth[:, 0] + 1
    taken = np.diff(run.times)
    viscosity, error = done.learned.viscosity
    period = 2 * STEPS
    ours, model = done.learned.radii(2, done.stronger), done.stronger_model
    rms = [1e3 * float(np.sqrt(np.mean((r - done.stronger_truth) ** 2))) for r in (ours, model)]
    return [
        Comparison("equation of the wave", "c' = -omega c", "c' = -omega s",
                   "a misprint; ours turns, and the pressure term is z (p_B - p_0) / rho"),
        Comparison(f"drive {done.bubble.drive:g} p_0: largest and smallest R / R0", None,
                   f"{run.radius.max():.3f}, {run.radius.min():.3f}",
                   f"numerical solver: {truth.max():.3f}, {truth.min():.3f} at the same times"),
        Comparison(f"maps of order {done.ladder.maps[0].order}: largest error of R / R0", None,
                   float(np.abs(run.radius - truth).max()),
                   f"{len(taken)} steps over {run.times[-1] / done.bubble.period:g} periods, from "
                   f"1/{done.bubble.period / taken.max():.0f} to "
                   f"1/{done.bubble.period / taken.min():.0f} of a period"),
        Comparison("learned from one oscillation: viscosity [m²/s]", None,
                   f"{viscosity:.3e} ± {error:.1e}",
                   f"truth {GENTLE.viscosity:.1e}, the model began with "
                   f"{done.learned.bubble.viscosity:.1e}; {READING:g} R0 noise"),
        Comparison(f"drive {done.stronger:g} p_0, {period // STEPS} periods: rms error of R / R0, "
                   "learned / wrong model [1e-3]", None, f"{rms[0]:.2f} / {rms[1]:.2f}",
                   f"learned from a drive of {GENTLE.drive:g} p_0"),
    ]  # fmt: skip
