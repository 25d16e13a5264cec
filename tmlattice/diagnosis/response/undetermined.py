"""Undetermined errors of a machine after a hierarchical fit, and their effect on a change.

A change between two measurements is fitted in the machine of the first one, whose errors have
uncertainties. Their effect on the readings cancels in the difference, but their effect on the
change does not: it scales with the change. Amounts, alternatives and statistics include it, for one
change (`Blur`) and for many (`linear.with_numbers`).

With undetermined errors x a change of amount a has the effect a (v + B x) on the
readings, with v in the fitted ring. So the readings have the covariance 1 + a^2 B B^T, which
differs between changes, and the most probable amount maximises the whole density. For a family of
sextupoles, the effect may come from an unknown orbit alone.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import block_diag

from tmlattice.arrays import Array, Indices
from tmlattice.diagnosis.families.dispersion import HorizontalOrbit, VerticalOrbit
from tmlattice.diagnosis.response.linear import linear
from tmlattice.diagnosis.response.state import State
from tmlattice.effects import Cause, Hypothesis, background_rms, find
from tmlattice.errors import UnstableRingError
from tmlattice.inference.alternatives import Alternative
from tmlattice.inference.distributed import MarginalProblem
from tmlattice.inference.judgement import DEFAULT
from tmlattice.inference.newton import AGAIN, Fit, Outcome
from tmlattice.inference.whitening import directions_of
from tmlattice.lattice import Ring
from tmlattice.observe.response_problem import Response


@dataclass(frozen=True, eq=False)
class Undetermined:
    """Gaussian errors of a machine that are undetermined.

    Attributes:
        hypotheses: effects and places of the errors.
        root: their amounts by independent errors of size 1, [hypothesis, error].
    """

    hypotheses: tuple[Hypothesis, ...]
    root: Array


ORBITS = (
    *HorizontalOrbit.effects, *VerticalOrbit.effects, "sextupole_offset_x", "sextupole_offset_y",
)  # fmt: skip
"""Effects that make orbits: a response hardly shows them, but a change of sextupoles does."""


def undetermined(state: State) -> Undetermined:
    """Return the undetermined errors of a converged fit, with its priors."""
    blocks: list[dict[Hypothesis, Array]] = []
    for block in (block for block in (0, 1) if state.of_block(block)):
        there = linear(state, block)
        found = there.posterior
        numbers = found.spread @ np.linalg.cholesky(found.covariance)
        amounts: dict[Hypothesis, Array] = {}
        for family in {f.variable: f for f in state.of_block(block)}.values():
            moved = zip(
                numbers[there.where[family.variable]], family.moves(state.data), strict=True
            )
            for number, moves in moved:
                for hypothesis, share in moves.items():
                    amounts[hypothesis] = share * number + amounts.get(hypothesis, 0.0)
        if amounts:
            blocks.append(amounts)
    hypotheses = tuple(dict.fromkeys(h for own in blocks for h in own))
    where = {h: i for i, h in enumerate(hypotheses)}
    roots = []
    for own in blocks:
        root = np.zeros((len(hypotheses), len(next(iter(own.values())))))
        for hypothesis, number in own.items():
            root[where[hypothesis]] = number
        roots.append(root)
    return Undetermined(hypotheses, np.hstack([np.zeros((len(hypotheses), 0)), *roots]))


def and_orbits(ring: Ring, open_: Undetermined) -> Undetermined:
    """Return the errors together with those that make orbits of the usual size."""
    usual = background_rms(dict.fromkeys(ORBITS))
    unseen = [(name, place) for name in ORBITS for place in find(name).places(ring)]
    alone = np.diag([usual[name] for name, _ in unseen])
    return Undetermined((*open_.hypotheses, *unseen), block_diag(open_.root, alone))


STRONGEST, HARDLY = 200, 0.1
"""Most errors that are kept, and the least effect of one, in units of the readings' noise."""


def strongest(problem: Response, open_: Undetermined, causes: Sequence[Cause]) -> Undetermined:
    """Return the combinations of errors with the largest effect on the changes of causes.

    Raises:
        UnstableRingError: no closed orbit with the causes.
    """
    views = problem.view(()), problem.view(causes)
    slopes = (view.signatures(open_.hypotheses) for view in views)
    noise = np.broadcast_to(problem.base.data.noise, problem.used.shape)[problem.used]
    moved = np.array([
        np.linalg.norm((with_them - without)[problem.used] / noise)
        for without, with_them in zip(*slopes, strict=True)
    ])  # fmt: skip
    moved *= np.sqrt(np.sum(open_.root**2, axis=1))
    order = np.argsort(-moved, kind="stable")[:STRONGEST]
    kept = np.sort(order[moved[order] > HARDLY])
    root = np.linalg.qr(open_.root[kept].T)[1].T
    return Undetermined(tuple(open_.hypotheses[i] for i in kept), root)


class Blur:
    """A problem with undetermined errors of the machine.

    Args:
        problem: of the response in that machine.
        open_: its undetermined errors.
    """

    def __init__(self, problem: Response, open_: Undetermined) -> None:
        self.problem, self.open = problem, open_

    @cached_property
    def _without(self) -> Array:
        """Signatures of unchanged causes, [hypothesis, reading]."""
        return self._signatures(())

    def _signatures(self, causes: Sequence[Cause]) -> Array:
        view = self.problem.view((*self.problem.fixed, *causes))
        out = np.empty((len(self.open.hypotheses), self.problem.used.size))
        for row, signature in zip(out, view.signatures(self.open.hypotheses), strict=True):
            row[:] = signature.ravel()
        return out

    def of(self, causes: Sequence[Cause]) -> Array:
        """d reading / d error, m, [error, *shape of the readings].

        Raises:
            UnstableRingError: no closed orbit with them.
        """
        spread = self.open.root.T @ (self._signatures(causes) - self._without)
        return np.asarray(spread.reshape(-1, *self.problem.used.shape))

    def among(self, spread: Array) -> MarginalProblem:
        """The problem with these undetermined errors."""
        own = self.problem
        return MarginalProblem(
            inner=own, spread=spread, places=own.places, rare=own.rare, amounts=own.amounts,
            judgement=own.judgement,
        )  # fmt: skip


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
        from scipy.optimize import minimize_scalar  # takes a fifth of a second

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
