"""One change between two measurements, given the undetermined errors of the first fit.

With undetermined errors x (`undetermined`) a change of amount a has the effect a (v + B x) on the
readings, with v in the fitted ring. So the readings have the covariance 1 + a^2 B B^T, which
differs between changes, and the most probable amount maximises the whole density. For a family of
sextupoles, the effect may come from an unknown orbit alone.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.optimize import minimize_scalar

from tmlattice.arrays import Array, Indices
from tmlattice.diagnosis.response.undetermined import Blur
from tmlattice.effects import Cause, find
from tmlattice.errors import UnstableRingError
from tmlattice.inference.alternatives import Alternative
from tmlattice.inference.distributed import MarginalProblem
from tmlattice.inference.judgement import DEFAULT
from tmlattice.inference.newton import AGAIN, Fit, Outcome
from tmlattice.inference.problem import Hypothesis
from tmlattice.inference.whitening import directions_of

AMOUNTS = np.geomspace(1e-5, 1.2, 120)
"""Start of the search for the most probable amount, as a share of the largest fault."""
STEP = 0.01
"""Start for a change of unknown amount, as a share of the largest fault."""


@dataclass(frozen=True, eq=False)
class _Line:
    """A change, linear in its strength t = amount^power, with its uncertainty.

    Attributes:
        left: rows without the change, [row].
        slope: v, [row].
        spread: B^T, [error, row].
    """

    left: Array
    slope: Array
    spread: Array

    @cached_property
    def _parts(self) -> tuple[Array, Array, Array, Array]:
        """Variances along the directions of B, residual and slope there; their products beyond."""
        values, along = directions_of(self.spread)
        both = np.stack([self.left, self.slope])
        inside = both @ along.T
        beyond = both @ both.T - inside @ inside.T
        return values, inside[0], inside[1], beyond

    def log_density(self, strengths: Array) -> Array:
        """The log density of the readings, up to a constant, [strength]."""
        variance, left, slope, beyond = self._parts
        t = np.atleast_1d(strengths)[:, None]
        spread = 1 + t**2 * variance
        inside = ((left - t * slope) ** 2 / spread + np.log(spread)).sum(axis=1)
        t = t[:, 0]
        return np.asarray(
            -0.5 * (inside + beyond[0, 0] - 2 * t * beyond[0, 1] + t**2 * beyond[1, 1])
        )


def _peaks(amounts: Array, seen: Array, inner: bool) -> Indices:
    """Local maxima of a density of amounts on either side of zero, by rising amount; at the
    smallest amount only if allowed, because a log-uniform prior diverges towards zero."""
    found = []
    for side in (amounts < 0, amounts > 0):
        own = np.flatnonzero(side)
        order = own[np.argsort(np.abs(amounts[own]))]
        before = np.append(-np.inf if inner else np.inf, seen[order[:-1]])
        behind = np.append(seen[order[1:]], -np.inf)
        found += order[(seen[order] > before) & (seen[order] >= behind)].tolist()
    return np.array(found, dtype=int)


class SingleChange:
    """Single changes of one machine.

    Args:
        blur: undetermined errors and their effect on the changes.
    """

    def __init__(self, blur: Blur) -> None:
        self.blur, self.plain = blur, blur.problem
        self.left = self.plain.at((), self.plain.first).residual

    def likeliest(self, hypothesis: Hypothesis, start: float | None = None) -> Alternative | None:
        """Return the change with its most probable amount; None if the readings reject it.

        Args:
            hypothesis: effect and place.
            start: an amount near it; None: any.
        """
        effect = find(hypothesis[0])
        at = start if start is not None else STEP * effect.largest
        found: tuple[float, float, float] | None = None
        try:
            unit = self.blur.of((Cause(*hypothesis, at),)) / at**effect.power
            spread = self.plain.as_rows(unit)
            for _ in range(AGAIN):
                slope = self._made((Cause(*hypothesis, at),)) / at**effect.power
                line = _Line(self.left, slope, spread)
                near = None if found is None else at
                found = self._amount(line, hypothesis, near)
                if found is None and near is not None:  # far from the start
                    found = self._amount(line, hypothesis, None)
                if found is None:
                    return None
                if effect.discrete or abs(found[0] - at) <= DEFAULT.same * abs(found[0]):
                    break
                at = found[0]
            assert found is not None
            return self._rival(hypothesis, unit, *found)
        except UnstableRingError:
            return None

    def _made(self, causes: Sequence[Cause]) -> Array:
        """The effect of causes on the rows."""
        there = self.plain.at(causes, self.plain.first)
        if there.lost:
            raise UnstableRingError(there.lost)
        return self.left - there.residual

    def _amount(
        self, line: _Line, hypothesis: Hypothesis, near: float | None
    ) -> tuple[float, float, float] | None:
        """The most probable amount, its error, and the log density there with the amount's prior;
        None if no change is better."""
        effect = find(hypothesis[0])
        if effect.discrete:
            return 1.0, 0.0, float(line.log_density(np.ones(1))[0])
        steps = effect.largest * AMOUNTS if near is None else abs(near) * np.geomspace(0.5, 2, 40)
        amounts = steps if effect.one_sign else np.concatenate([-steps[::-1], steps])

        def density(amount: Array) -> Array:
            prior = [self.plain.amounts.log_density(Cause(*hypothesis, float(a))) for a in amount]
            return np.asarray(line.log_density(amount**effect.power) + np.array(prior))

        seen = density(amounts)
        peaks = _peaks(amounts, seen, inner=near is not None)
        gained = line.log_density(amounts[peaks] ** effect.power) > line.log_density(np.zeros(1))
        peaks = peaks[gained]
        if not len(peaks):
            return None
        top = int(peaks[seen[peaks].argmax()])
        same = amounts[amounts * amounts[top] > 0]  # of its sign
        at = int(np.searchsorted(same, amounts[top]))
        low, high = same[max(at - 1, 0)], same[min(at + 1, len(same) - 1)]
        best = minimize_scalar(
            lambda a: -float(density(np.array([a]))[0]), bounds=(low, high), method="bounded",
            options={"xatol": 1e-6 * (high - low)},
        )  # fmt: skip
        amount = float(best.x)
        h = 1e-3 * abs(amount)
        ends = density(np.array([amount - h, amount, amount + h]))
        for _ in range(30):  # until the difference is significant
            bend = float(2 * ends[1] - ends[0] - ends[2])
            if bend > 0.01 or h > abs(amount) / 2:
                break
            h *= 2
            ends = density(np.array([amount - h, amount, amount + h]))
        sigma = float(h / np.sqrt(bend)) if bend > 0 else abs(amount)
        mirror = peaks[amounts[peaks] * amount < 0]
        if len(mirror):  # an uncertain sign is included in the error
            other = int(mirror[seen[mirror].argmax()])
            odds = float(np.exp(min(seen[other] - ends[1], 0.0)))
            sigma = float(np.hypot(sigma, np.sqrt(odds / (1 + odds)) * (amount - amounts[other])))
        return amount, sigma, float(ends[1])

    def _rival(
        self, hypothesis: Hypothesis, unit: Array, amount: float, sigma: float, density: float
    ) -> Alternative:
        """The change as a fit; its point includes the undetermined errors."""
        problem = self.blur.among(amount ** find(hypothesis[0]).power * unit)
        point = problem.at((Cause(*hypothesis, amount),), problem.first)
        evidence = density + self.plain.prior(hypothesis)
        if sigma:
            evidence += 0.5 * np.log(2 * np.pi * sigma**2)
        covariance = np.array([[sigma**2]])
        return Alternative(hypothesis, Fit(point, covariance, float(evidence), Outcome.CONVERGED))

    def among(self, one: Alternative) -> MarginalProblem:
        """The problem with the undetermined errors of a change."""
        return self.blur.among(self.blur.of((one.cause,)))

    def all_of(self, starts: Mapping[Hypothesis, float | None]) -> tuple[Alternative, ...]:
        """Return some hypotheses, with amounts near the given ones, by falling evidence."""
        tried = (self.likeliest(hypothesis, start) for hypothesis, start in starts.items())
        found = [rival for rival in tried if rival is not None]
        return tuple(sorted(found, key=lambda rival: -rival.fit.log_evidence))
