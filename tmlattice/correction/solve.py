"""Settings of the smallest expected errors of the targets in units of their tolerances.

With the errors e of a target (in one plane) in units of its tolerance, J their derivatives by the
knobs and G those by the uncertain errors of the ring, its expected square after a change x is, to
first order,

    s = |e + J x|^2 + sum_k (sigma_k |J_k| x_k)^2 + E |G delta|^2.

The first term can be reduced by the knobs. The second is a ridge without a free parameter: a knob's
change has a relative error sigma_k, so that large changes which cancel one another cost more than
they gain. The third is what the data do not determine: no knob lowers it.

The cost is the sum of sqrt(1 + s) - 1 over the targets: squares within the tolerances and the rms
beyond, the slowest growth that a cost with a single minimum can have. A sum of squares would be
that of the target which is furthest out of reach alone. At every point the roots have the slopes of
squares with the weights (1 + s)^(-1/2), and are below them everywhere else: what lowers these
squares lowers the cost.

The change with the smallest cost may still make one machine of the posterior worse: the gain of
its weighted squares, -2 (e + G delta) J x - |J x|^2, has the variance 4 x D x,
D = J^T G E[delta delta^T] G^T J. Of all changes that make the ring worse with one probability, the
one of the largest expected gain minimises the expected square plus a multiple (the risk aversion)
of x D x: directions whose slope is uncertain are shortened, the others are not.
"""

import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.linalg import solve, solve_triangular

from tmlattice.arrays import TINY, Array, Indices
from tmlattice.correction.estimate import Estimate
from tmlattice.correction.first_turn import Threading
from tmlattice.correction.knobs import KINDS, Knob
from tmlattice.correction.targets import THREADING, Targets
from tmlattice.effects import apply
from tmlattice.errors import UnstableRingError

Shown = Any
"""Orbit and optics of a ring, as its targets use them: `StoredOptics` or `Trajectory`."""

log = logging.getLogger(__name__)

MAX_ROUNDS = 30
"""Linearisations at most: a threaded beam gets further with each of them."""
MIN_FALL = 1e-3
"""Fall of the cost, relative and in tolerances, that ends the search."""
MAX_HALVINGS = 6
"""Halvings, at most, of a step that does not lower the cost."""
MAX_EXCESS = 5e-4, 2e-3
"""Excess over the smallest cost that is allowed for fewer knobs: relative, and in tolerances."""
SIGMAS = 3.0
"""Standard deviations by which a correction is expected to make the ring better: of a thousand such
corrections one makes it worse."""
MIN_GAIN = 0.01
"""Smallest gain that is worth a change: share of the expected square; half of it in rms."""
AVERSIONS, BISECTIONS = (1e-5, 1e5), 10
"""Risk aversions between which one is sought, relative to the means of both quadratic forms; and
halvings of this range: of two per cent."""
NEAR = 1.03
"""Standard deviations over `SIGMAS` at which a shortened correction is not lengthened again."""
COUNTS = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000)
"""Numbers of knobs that are tried, and whose gain is stated."""
ROUNDING = 1e-10
"""Of the squares of slopes, relative to a knob's size: a ridge for knobs without errors."""
MAX_PIVOTS = 1000
"""Of the search for the knobs at their limits: systems solved."""
PLANES = 2
"""Of each target: a target counts as much as the mean of its planes."""
AT_ONCE = 500
"""Uncertain errors whose derivatives are in memory."""


@dataclass(frozen=True, eq=False)
class Problem:
    """Errors, knobs and targets of a correction.

    Attributes:
        estimate: the ring and its posterior.
        knobs: the devices.
        targets: the goal.
        draws: errors drawn from the posterior, less their mean, [draw, error].
        noise: errors of the knobs' changes, in units of their own, [draw, knob].
        energies: errors of the beam's relative energy, [draw].
    """

    estimate: Estimate
    knobs: tuple[Knob, ...]
    targets: Targets | Threading
    draws: Array
    noise: Array
    energies: Array

    @cached_property
    def begin(self) -> "Point":
        """Return the estimated ring.

        Raises:
            UnstableRingError: no stored beam.
        """
        shown = self.targets.begin(self.estimate.ring, self.estimate.energy)
        return Point(self, np.zeros(len(self.knobs)), shown)

    @cached_property
    def sigma(self) -> Array:
        """Relative error of each knob's change, [knob]."""
        return np.array([knob.error for knob in self.knobs])

    @cached_property
    def groups(self) -> Indices:
        """Target and plane of each row, [row]."""
        return self.targets.groups(self.begin.errors)

    @cached_property
    def undetermined(self) -> Array:
        """Mean square of each row over the posterior in the estimated ring, [row]."""
        return np.asarray(np.mean(self.targets.rows(self.begin.open) ** 2, axis=0))

    def cost(self, squares: Array) -> Array:
        """Return the sum of sqrt(1 + s) - 1 over the targets, with their mean squares s, [...].

        Args:
            squares: of the rows, [..., row].
        """
        return np.asarray((np.sqrt(1 + self.sums(squares)) - 1).sum(axis=-1) / PLANES)

    def sums(self, squares: Array) -> Array:
        """Return mean squares of targets and planes from squares of the rows, [..., group]."""
        count = self.groups.max() + 1
        return np.asarray(PLANES * squares @ (self.groups[:, None] == np.arange(count)))

    @cached_property
    def bounds(self) -> Array:
        """Limits of the amounts, [2, knob]."""
        return np.array([knob.bounds for knob in self.knobs]).reshape(-1, 2).T

    def at(self, amounts: Array) -> "Point":
        """Return the estimated ring with changes of the knobs.

        Raises:
            UnstableRingError: no stored beam.
        """
        causes = [c for k, a in zip(self.knobs, amounts.tolist(), strict=True) for c in k.causes(a)]
        shift = sum(a for k, a in zip(self.knobs, amounts, strict=True) if k.kind == "rf")
        if not causes and not shift:
            return self.begin
        shown = self.begin.shown.moved(apply(self.estimate.ring, causes), shift)
        return Point(self, amounts, shown)

    def better(self, amounts: Array, least: float) -> "Point | None":
        """Return the point, if it stores a beam and its cost is below `least`."""
        try:
            point = self.at(amounts)
        except UnstableRingError:
            return None
        return point if point.cost < least else None


@dataclass(frozen=True, eq=False)
class Point:
    """The estimated ring with changes of the knobs.

    Attributes:
        problem, amounts: arguments, [knob].
        shown: orbit and optics of the ring.
    """

    problem: Problem
    amounts: Array
    shown: Shown

    @cached_property
    def errors(self) -> dict[str, Array]:
        """Errors of all targets, see `Targets.errors`."""
        errors = self.problem.targets.errors(self.shown.values)
        if "dispersion" in errors:
            errors["dispersion"] = errors["dispersion"] + self.problem.estimate.dispersion
        return errors

    @cached_property
    def rows(self) -> Array:
        """Errors of the wanted targets, in units of their tolerances, [row]."""
        return self.problem.targets.rows(self.errors)

    @cached_property
    def by_frequency(self) -> dict[str, Array]:
        """d errors / d relative RF frequency, [1, reading, plane] each."""
        return self.problem.targets.changes(self.shown.by_frequency())

    @cached_property
    def by_knobs(self) -> dict[str, Array]:
        """d errors / d amount of each knob, [knob, reading, plane] each."""
        targets = self.problem.targets
        hypotheses, owner, rf = [], [], []
        for k, knob in enumerate(self.problem.knobs):
            effect = KINDS[knob.kind].effect
            if effect is None:
                rf.append(k)
                continue
            hypotheses += [(effect, member) for member in knob.members]
            owner += [k] * len(knob.members)
        changes = targets.changes(self.shown.derivatives(hypotheses))
        found = {}
        for name, errors in self.errors.items():
            found[name] = np.zeros((len(self.problem.knobs), *errors.shape))
            np.add.at(found[name], owner, changes[name])
            if rf:
                found[name][rf] = self.by_frequency[name]
        return found

    @cached_property
    def slopes(self) -> Array:
        """d rows / d amount of each knob, [row, knob]."""
        return self.problem.targets.rows(self.by_knobs).T

    @cached_property
    def open(self) -> dict[str, Array]:
        """Contribution of the draws from the posterior, and of the knobs' errors, to the target
        errors, to first order, [draw, reading, plane] each."""
        problem, estimate = self.problem, self.problem.estimate
        noise = problem.noise * problem.sigma * self.amounts
        total = {name: np.tensordot(noise, part, 1) for name, part in self.by_knobs.items()}
        if estimate.energy_error:
            shift = problem.energies * self.shown.per_energy
            for name, part in self.by_frequency.items():
                total[name] += shift[:, None, None] * part
        for some, changes in self.by_errors():
            for name, part in changes.items():
                total[name] += np.tensordot(problem.draws[:, some], part, 1)
        return total

    def by_errors(self) -> Iterator[tuple[slice, dict[str, Array]]]:
        """Yield d errors / d amount of the uncertain errors, some at a time."""
        hypotheses = self.problem.estimate.hypotheses
        for first in range(0, len(hypotheses), AT_ONCE):
            some = slice(first, first + AT_ONCE)
            yield some, self.problem.targets.changes(self.shown.derivatives(hypotheses[some]))

    def squares(self, weights: Array) -> Array:
        """Weighted squares of the rows over the draws, [draw].

        Args:
            weights: [row].
        """
        rows = self.rows + self.problem.targets.rows(self.open)
        return np.asarray(rows**2 @ weights**2)

    @cached_property
    def _expected(self) -> Array:
        """Expected square of each row, [row]."""
        moved = (self.problem.sigma * self.amounts) ** 2
        unsure = self.slopes**2 @ moved if moved.any() else 0.0
        return np.asarray(self.rows**2 + unsure + self.problem.undetermined)

    @cached_property
    def cost(self) -> float:
        """Of the expected squares."""
        return float(self.problem.cost(self._expected))

    @cached_property
    def weights(self) -> Array:
        """Factors of the rows with which the sum of squares has the slopes of the cost, [row]."""
        sums = self.problem.sums(self._expected)
        return np.asarray((1 + sums[self.problem.groups]) ** -0.25)

    @cached_property
    def sizes(self) -> Array:
        """Norm of the weighted rows' derivatives by each knob, [knob]; 1 if it has no effect."""
        return sizes_of(self.weights[:, None] * self.slopes)

    @cached_property
    def doubt(self) -> Array:
        """Covariance of half the slopes of the weighted square in the estimated ring by the knobs,
        in units of their sizes, over the posterior, [knob, knob]."""
        problem, estimate, begin = self.problem, self.problem.estimate, self.problem.begin
        slopes = self.weights[:, None] ** 2 * begin.slopes / self.sizes
        parts = [problem.targets.rows(own) @ slopes for _, own in begin.by_errors()]
        whole = estimate.independent(np.concatenate(parts)) if parts else 0.0 * slopes
        if estimate.energy_error:
            shift = estimate.energy_error * begin.shown.per_energy
            energy = shift * problem.targets.rows(begin.by_frequency) @ slopes
            whole = np.concatenate([whole, energy])
        return np.asarray(whole.T @ whole)

    @property
    def dominated(self) -> bool:
        """Whether most of the weighted square is errors of the changes."""
        unsure, rows = self.problem.sigma * self.sizes * self.amounts, self.weights * self.rows
        return float(unsure @ unsure) > float(rows @ rows)

    @cached_property
    def _normal(self) -> tuple[Array, Array, float]:
        """Normal equations in units of the knobs' sizes: matrix with the ridge, [knob, knob], right
        side, [knob], and the weighted square without any change."""
        slopes = self.weights[:, None] * self.slopes / self.sizes
        start = self.weights * (self.rows - self.slopes @ self.amounts)
        return *normal(start, slopes, self.problem.sigma), float(start @ start)

    def step(self, knobs: Indices, aversion: float = 0.0) -> tuple[Array, float]:
        """Return the amounts of some knobs, the others at zero, of the smallest linearised expected
        square within the limits, with a risk aversion; and that square, weighted."""
        matrix, right, square = self._normal
        bounds = self.problem.bounds[:, knobs] * self.sizes[knobs]
        matrix, right = matrix[np.ix_(knobs, knobs)], right[knobs]
        found = bounded(matrix + self._ridge(knobs, aversion), right, *bounds)
        amounts = np.zeros(len(self.amounts))
        amounts[knobs] = found / self.sizes[knobs]
        return amounts, square + float(found @ (matrix @ found - 2 * right))

    def _ridge(self, knobs: Indices, aversion: float) -> Array | float:
        return aversion * self.doubt[np.ix_(knobs, knobs)] if aversion else 0.0

    def sigmas(self, knobs: Indices, aversion: float) -> float:
        """Return the standard deviations of the gain by which a step with a risk aversion is
        expected to gain, to first order."""
        amounts, then = self.step(knobs, aversion)
        own = (amounts * self.sizes)[knobs]
        deviation = 2 * float(np.sqrt(own @ self.doubt[np.ix_(knobs, knobs)] @ own))
        return (self._normal[2] - then) / max(deviation, TINY)

    def aversion(self, knobs: Indices, sigmas: float) -> float:
        """Return the smallest risk aversion whose step gains these standard deviations, to first
        order; infinite where none does."""
        size = float(np.trace(self.doubt[np.ix_(knobs, knobs)]))
        low, high = np.log(AVERSIONS) + np.log(len(knobs) / max(size, TINY))
        if self.sigmas(knobs, float(np.exp(high))) < sigmas:
            return np.inf
        for _ in range(BISECTIONS):
            middle = (low + high) / 2
            safe = self.sigmas(knobs, float(np.exp(middle))) >= sigmas
            low, high = (low, middle) if safe else (middle, high)
        return float(np.exp(high))

    def gains(self, knobs: Indices, aversion: float) -> Array:
        """Return the falls of the linearised expected square by each knob after those before it,
        without limits, with a risk aversion, [knob]."""
        matrix, right, _ = self._normal
        root = np.linalg.cholesky(matrix[np.ix_(knobs, knobs)] + self._ridge(knobs, aversion))
        return np.asarray(solve_triangular(root, right[knobs], lower=True) ** 2)

    def by_gain(self) -> Iterator[int]:
        """Yield the knobs in the order of the largest fall of the expected square, with those
        before adjusted (orthogonal matching pursuit, as MICADO): a pivoted Cholesky
        decomposition."""
        matrix, right, _ = self._normal
        left, scale = right.copy(), np.diag(matrix).copy()
        open_, factor = np.ones(len(right), dtype=bool), np.zeros(matrix.shape)
        for n in range(len(right)):
            gains = np.where(open_, left**2 / np.maximum(scale, ROUNDING), 0.0)
            k = int(np.argmax(gains))
            if not gains[k]:
                return  # the others have no effect
            open_[k] = False
            pivot = np.sqrt(max(scale[k], ROUNDING))
            column = (matrix[k] - factor[:n, k] @ factor[:n]) / pivot
            factor[n] = column
            left -= column * (left[k] / pivot)
            scale -= column**2
            yield k


def sizes_of(slopes: Array) -> Array:
    """Return the norm of the rows' derivatives by each knob, [knob]; 1 if it has no effect."""
    size = np.linalg.norm(slopes, axis=0)
    return np.asarray(np.where(size > 0, size, 1.0))


def normal(rows: Array, slopes: Array, sigma: Array) -> tuple[Array, Array]:
    """Return the normal equations with the ridge: matrix, [knob, knob], and right side, [knob].

    Args:
        rows: [row].
        slopes: in units of the knobs' sizes, [row, knob].
        sigma: relative error of each knob's change, [knob].
    """
    matrix = slopes.T @ slopes
    matrix.flat[:: len(matrix) + 1] += sigma**2 + ROUNDING
    return matrix, -slopes.T @ rows


def bounded(matrix: Array, right: Array, low: Array, high: Array) -> Array:
    """Return the minimum of x matrix x / 2 - right x with low <= x <= high.

    An active set: knobs that reach a limit are held there, and released where the slope leads back
    inside (Nocedal & Wright, Numerical Optimization, 16.5). A step holds all knobs that it takes
    beyond a limit if it lowers the value nevertheless, else it ends at the first limit: the value
    never rises.

    Args:
        matrix: positive definite, [knob, knob].
        right, low, high: [knob].
    """
    x = np.clip(np.zeros(len(right)), low, high)
    free = np.ones(len(right), dtype=bool)
    slope = right - matrix @ x
    for _ in range(MAX_PIVOTS):
        step = np.zeros(len(right))
        step[free] = solve(matrix[np.ix_(free, free)], slope[free], assume_a="pos")
        new = np.clip(x + step, low, high)
        beyond = new != x + step
        moved = new - x
        if beyond.any() and moved @ (matrix @ moved - 2 * slope) >= 0:
            share = np.divide(moved, step, out=np.ones(len(right)), where=beyond)
            beyond = share == share.min()
            new = np.where(beyond, new, x + share.min() * step)
        free &= ~beyond
        x = new
        slope = right - matrix @ x
        if not beyond.any():
            inward = ~free & np.where(slope > 0, x < high, x > low) & (np.abs(slope) > ROUNDING)
            if not inward.any():
                break
            free |= inward
    return np.asarray(x)


def optimised(problem: Problem, begin: Point, knobs: Indices) -> Point:
    """Return the point of the smallest cost with some knobs, by repeated linearisation.

    Args:
        problem: errors, knobs and targets.
        begin: starting point.
        knobs: indices of free knobs; the others are at zero.
    """
    now = begin
    for _ in range(MAX_ROUNDS):
        goal, _ = now.step(knobs)
        found = None
        for half in range(MAX_HALVINGS):
            found = problem.better(now.amounts + (goal - now.amounts) / 2**half, now.cost)
            if found is not None:
                break
        if found is None:
            return now
        log.info("cost %.4g -> %.4g", now.cost, found.cost)
        done = now.cost - found.cost < MIN_FALL * (1 + found.cost)
        now = found
        if done:
            break
    return now


def tuned(problem: Problem) -> Point:
    """Return the point where a search begins: the tunes are nearer to the goal's by one step.

    A resonance between the tunes and the goal's is a barrier, since beta or coupling diverge on it.
    A step for the tunes alone crosses it.
    """
    begin = problem.begin
    own = problem.groups // PLANES == [*problem.targets.names, "tunes"].index("tunes")
    slopes, rows = begin.slopes[own], begin.rows[own]
    sizes = sizes_of(slopes)
    step = bounded(*normal(rows, slopes / sizes, problem.sigma), *(problem.bounds * sizes)) / sizes
    for half in range(MAX_HALVINGS):
        point = problem.better(step / 2**half, np.inf)
        if point is not None and np.linalg.norm(point.rows[own]) < np.linalg.norm(rows):
            return point
    return begin


def fewest(problem: Problem) -> tuple[Point, Indices]:
    """Return the end of a correction, and its knobs by falling gain: the fewest of `COUNTS` whose
    cost is nearly that of all."""
    every = np.arange(len(problem.knobs))
    whole = optimised(problem, tuned(problem), every)
    order = np.array([*whole.by_gain()], dtype=np.int64)
    least = whole.step(every)[1]
    for count in COUNTS:
        chosen = order[:count]
        if len(chosen) == len(order):
            return whole, order
        goal, square = whole.step(chosen)
        if nearly(square, least):
            break
    end = optimised(problem, problem.better(goal, problem.begin.cost) or problem.begin, chosen)
    # or it is not as linear as that
    return (end, chosen) if nearly(end.cost, whole.cost) else (whole, order)


def nearly(value: float, least: float) -> bool:
    """Return whether a cost, or a weighted square, is as good as the smallest one."""
    relative, beyond = MAX_EXCESS
    return value <= (1 + relative) * least + beyond


def safest(begin: Point, end: Point, knobs: Indices) -> tuple[Point, float]:
    """Return the point of the largest expected gain that is `SIGMAS` standard deviations above
    zero, at settings that the devices' steps allow, and its risk aversion: 0 where the whole
    correction is as safe; infinite, and the beginning, where nothing is.

    Args:
        begin, end: before and after the whole correction.
        knobs: indices of free knobs; the others are at zero.
    """
    problem, now, found = end.problem, begin.squares(end.weights), (begin, np.inf)
    amounts, aversion = end.amounts, 0.0
    for _ in range(MAX_HALVINGS):
        pairs = zip(problem.knobs, amounts.tolist(), strict=True)
        new = np.array([knob.rounded(amount) if amount else 0.0 for knob, amount in pairs])
        point = end if np.array_equal(new, end.amounts) else problem.better(new, np.inf)
        gain = now - (now if point is None else point.squares(end.weights))
        mean, deviation = float(gain.mean()), float(gain.std())
        safe = mean >= SIGMAS * deviation
        if point is not None and safe and mean >= MIN_GAIN * now.mean():
            found = point, aversion
        if safe and (not aversion or mean <= NEAR * SIGMAS * deviation):
            break
        beyond = end.sigmas(knobs, aversion) * deviation / max(mean, TINY)  # first order
        aversion = end.aversion(knobs, 1.01 * SIGMAS * float(np.clip(beyond, 0.5, 10.0)))
        if np.isinf(aversion):
            break
        amounts, _ = end.step(knobs, aversion)
    return found


def drawn(
    estimate: Estimate, knobs: Sequence[Knob], targets: Targets | Threading, count: int, seed: int
) -> Problem:
    """Return the problem with draws from the posterior."""
    random = np.random.default_rng(seed)
    scaled = [
        replace(knob, scale=estimate.calibrations.get(knob.members[0], 1.0))
        if knob.kind in ("hcorrector", "vcorrector") and knob.members else knob
        for knob in knobs
    ]  # fmt: skip
    found = Problem(
        estimate, tuple(scaled), targets, estimate.draw(count, random),
        random.standard_normal((count, len(knobs))),
        estimate.energy_error * random.standard_normal(count),
    )  # fmt: skip
    if isinstance(targets, Threading):
        open_ = found.begin.open[THREADING].std(axis=0)
        found = replace(found, targets=targets.determined(open_))
    return found
