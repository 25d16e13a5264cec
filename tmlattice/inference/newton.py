"""Causes, free kicks and launches fitted together through the full nonlinear model.

Gauss and Newton on amounts and launches; the launches are eliminated by projection, a step that
makes things worse is halved. The evidence of a set of causes weighs its misfit against what it
assumes: amounts are spread evenly over their logarithm up to the largest fault, so that the cost of
an amount is that of its relative error, whatever the effect.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from tmlattice.beam.model import Hypothesis, Kicks, Model, Paths
from tmlattice.effects import Cause, find
from tmlattice.inference.scan import evidence_of_scale
from tmlattice.inference.whitening import Projection, Whitening
from tmlattice.observe.data import Data

Array = NDArray[np.float64]

DECADES = 4.0
"""Amounts of a fault reach from its largest down by so many powers of ten."""

SAME = 0.02
"""A slope is good while amount and orbit change by no more than this share."""

UNKNOWN = 0.05
"""Prior share of faults that the catalogue does not hold."""


@dataclass(frozen=True)
class Problem:
    """What a fit needs and does not change.

    Attributes:
        model: the ring with what is known.
        data: readings.
        whitening: their noise.
        places: number of places of each effect, for the prior.
        fixed: causes that are there and are not fitted.
    """

    model: Model
    data: Data
    whitening: Whitening
    places: Mapping[str, int]
    fixed: tuple[Cause, ...] = ()

    def prior(self, hypothesis: Hypothesis) -> float:
        """Log probability of one effect at one place, before the data."""
        count = len(self.places) * self.places.get(hypothesis[0], 1)
        return float(np.log((1 - UNKNOWN) / count))

    def unknown_prior(self, places: int) -> float:
        """The same for something unknown at one of so many places."""
        return float(np.log(UNKNOWN / 2 / places))


@dataclass(frozen=True)
class Slope:
    """d rows / d amount of one cause, [row], and where it was taken: at which amount, and with
    which orbit, [shot, reading, 2], m."""

    row: Array
    amount: float
    beam: Array

    def holds(self, amount: float, beam: Array) -> bool:
        """Whether amount and orbit are still nearly the same."""
        if abs(amount - self.amount) > SAME * abs(amount):
            return False
        if beam is self.beam:
            return True
        return bool(np.linalg.norm(beam - self.beam) <= SAME * np.linalg.norm(beam))


@dataclass(frozen=True)
class Fit:
    """Causes with their best amounts, and what they leave.

    Attributes:
        causes: named, with amounts.
        kicks: free ones by layer, [shot, 2], rad.
        launches: [shot, 5].
        paths: of the fitted model.
        residual: whitened rows.
        projection: of the launches.
        chi2: residual squared, prior rows included.
        information: of the amounts, launches eliminated, [cause, cause]; discrete ones left out.
        covariance: of the amounts, [cause, cause]; zero for discrete ones.
        log_evidence: up to a constant of the data.
        converged: false where the last step was still significant.
        slopes: of the causes that are not discrete, by cause.
    """

    causes: tuple[Cause, ...]
    kicks: Kicks
    launches: Array
    paths: Paths = field(repr=False)
    residual: Array = field(repr=False)
    projection: Projection = field(repr=False)
    chi2: float
    covariance: Array
    log_evidence: float
    converged: bool
    slopes: Mapping[Hypothesis, Slope] = field(default_factory=dict, repr=False)


def amount_prior(cause: Cause) -> float:
    """Log density of an amount: even in log |amount| up to the largest fault, thin beyond."""
    effect = find(cause.effect)
    if effect.discrete:
        return 0.0
    size = max(abs(cause.amount), 1e-300)
    density = -np.log(2 * size * DECADES * np.log(10))
    if size > effect.largest:
        density -= 8 * np.log(size / effect.largest)
    return float(density)


def fit(
    problem: Problem,
    causes: Sequence[Cause],
    launches: Array,
    kicks: Kicks | None = None,
    *,
    steps: int = 8,
    hopeless: float = -np.inf,
    slopes: Mapping[Hypothesis, Slope] | None = None,
) -> Fit:
    """The best amounts of these causes, the best free kicks, and the best launches.

    Args:
        problem: model and data.
        causes: with first guesses of their amounts; discrete ones are taken as they are.
        launches: first guess, [shot, 5].
        kicks: free ones by layer, with first guesses.
        steps: at most.
        hopeless: give up where the evidence stays far below this after two steps.
        slopes: of an earlier fit of the same problem: those that still hold are not taken again.
    """
    causes, kicks = tuple(causes), dict(kicks or {})
    state = _evaluate(problem, causes, kicks, launches)
    if not np.isfinite(state.chi2):  # a first guess that loses the beam: start small
        causes = tuple(
            c if find(c.effect).discrete else replace(c, amount=0.1 * c.amount) for c in causes
        )
        state = _evaluate(problem, causes, {k: 0.1 * v for k, v in kicks.items()}, launches)
    if not np.isfinite(state.chi2):
        return replace(state, covariance=np.zeros((len(causes), len(causes))))
    converged = False
    state = replace(state, slopes=dict(slopes or {}))
    state, rows = _with_slopes(problem, state)
    for step in range(steps):
        change, moved, promised = _step(problem, state, rows)
        best = None
        for shrink in (1.0, 0.5, 0.25, 0.0625):
            trial = _moved(problem, state, shrink * change, shrink * moved)
            trial = replace(trial, slopes=state.slopes)
            if trial.chi2 < state.chi2 or (shrink == 1.0 and trial.chi2 <= state.chi2 + 1e-6):
                best = trial
                break
        if best is None:
            converged = promised < 0.1
            break
        fell = state.chi2 - best.chi2
        state = best
        if fell < 0.02 and promised < 0.02:
            converged = True
            break
        state, rows = _with_slopes(problem, state)
        if step == 1 and -0.5 * state.chi2 < hopeless - 100 - 0.5 * promised:
            break
    return _finished(problem, state, rows, converged)


def _evaluate(problem: Problem, causes: tuple[Cause, ...], kicks: Kicks, launches: Array) -> Fit:
    paths = problem.model.paths(launches, (*problem.fixed, *causes), kicks)
    difference = np.where(problem.data.valid, problem.data.readings - paths.readings, 0.0)
    residual = problem.whitening.residual(difference, launches)
    finite = np.isfinite(residual).all()
    projection = Projection(problem.whitening.launch(paths.launch)) if finite else None
    return Fit(
        causes,
        kicks,
        launches,
        paths,
        residual,
        projection,  # type: ignore[arg-type]
        float(residual @ residual) if finite else np.inf,
        np.zeros((0, 0)),
        -np.inf,
        False,
    )


def _continuous(fit_: Fit) -> list[int]:
    return [i for i, cause in enumerate(fit_.causes) if not find(cause.effect).discrete]


def _with_slopes(problem: Problem, state: Fit) -> tuple[Fit, Array]:
    """The fit with slopes that hold; and d rows / d parameters: amounts, then the kicks of each
    layer in active shots."""
    model, whitening = problem.model, problem.whitening
    rows = []
    slopes: dict[Hypothesis, Slope] = {}
    for i in _continuous(state):
        cause = state.causes[i]
        place = (cause.effect, cause.element)
        known = state.slopes.get(place)
        if known is not None and known.holds(cause.amount, state.paths.beam):
            slopes[place] = known
            rows.append(known.row[None])
            continue
        effect = find(cause.effect)
        h = (1e-3 if effect.power == 1 else 1e-2) * effect.largest
        amounts = (cause.amount + h, cause.amount - h)
        ends = [
            model.readings(
                state.launches,
                [
                    *problem.fixed,
                    *state.causes[:i],
                    replace(cause, amount=a),
                    *state.causes[i + 1 :],
                ],
                state.kicks,
            )
            for a in amounts
        ]
        row = whitening.signature(np.nan_to_num(ends[0] - ends[1]) / (2 * h))
        slopes[place] = Slope(row, cause.amount, state.paths.beam)
        rows.append(row[None])
    shots = np.flatnonzero(problem.data.active)
    for layer in state.kicks:
        kicked = model.kick_signatures(state.paths, np.array([layer]))[0]
        alone = np.zeros((len(shots), *kicked.shape))
        for i, shot in enumerate(shots):
            alone[i, :, shot] = kicked[:, shot]
        rows.append(whitening.signature(alone).reshape(2 * len(shots), -1))
    stacked = np.concatenate(rows) if rows else np.zeros((0, whitening.rows))
    return replace(state, slopes=slopes), stacked


def _step(problem: Problem, state: Fit, rows: Array) -> tuple[Array, Array, float]:
    """Changes of parameters and launches, and how far chi-square should fall."""
    clean = state.projection.out(state.residual)
    change = np.zeros(len(rows))
    promised = state.chi2 - float(clean @ clean)
    if len(rows):
        own = state.projection.out(rows)
        size = np.sqrt(np.einsum("kr,kr->k", own, own))
        unit = own / np.where(size > 0, size, 1.0)[:, None]
        gram = unit @ unit.T + 1e-10 * np.eye(len(unit))
        inner = unit @ clean
        solved = np.linalg.solve(gram, inner)
        promised += float(inner @ solved)
        change = solved / np.where(size > 0, size, np.inf)
    left = state.residual - change @ rows
    moved = state.projection.coordinates(left).reshape(problem.data.shots, -1)
    return change, moved, promised


def _moved(problem: Problem, state: Fit, change: Array, moved: Array) -> Fit:
    launches = state.launches.copy()
    launches[:, problem.whitening.columns] += moved
    causes = list(state.causes)
    amounts = _continuous(state)
    for i, delta in zip(amounts, change, strict=False):
        causes[i] = replace(causes[i], amount=causes[i].amount + float(delta))
    kicks = {}
    shots = np.flatnonzero(problem.data.active)
    at = len(amounts)
    for layer, values in state.kicks.items():
        new = values.copy()
        new[shots] += change[at : at + 2 * len(shots)].reshape(-1, 2)
        kicks[layer] = new
        at += 2 * len(shots)
    return _evaluate(problem, tuple(causes), kicks, launches)


def _finished(problem: Problem, state: Fit, rows: Array, converged: bool) -> Fit:
    named = _continuous(state)
    covariance = np.zeros((len(state.causes), len(state.causes)))
    log_evidence = -0.5 * state.chi2
    own = state.projection.out(rows)
    gram = own @ own.T
    for cause in state.causes:
        log_evidence += problem.prior((cause.effect, cause.element)) + amount_prior(cause)
    if named:
        size = np.sqrt(np.maximum(np.diagonal(gram), 1e-300))
        scaled = gram / size[:, None] / size + 1e-10 * np.eye(len(gram))
        inverse = np.linalg.inv(scaled) / size[:, None] / size
        covariance[np.ix_(named, named)] = inverse[: len(named), : len(named)]
        sign, determinant = np.linalg.slogdet(covariance[np.ix_(named, named)])
        log_evidence += 0.5 * (determinant + len(named) * np.log(2 * np.pi)) if sign > 0 else -1e9
    shots = np.flatnonzero(problem.data.active)
    at = len(named)
    for values in state.kicks.values():
        part = slice(at, at + 2 * len(shots))
        at += 2 * len(shots)
        information = gram[part, part]
        log_evidence += free_evidence(information, values[shots].reshape(-1))
        log_evidence += problem.unknown_prior(len(problem.model.maps.layers))
    return replace(
        state, covariance=covariance, log_evidence=float(log_evidence), converged=converged
    )


def free_evidence(information: Array, values: Array) -> float:
    """Log evidence of free parameters at their best values, less that of their misfit (<= 0)."""
    weights, vectors = np.linalg.eigh(information)
    seen = weights > 1e-10 * max(weights[-1], 1e-300)
    scaled = (vectors.T @ values)[seen] * np.sqrt(weights[seen])
    relative = weights[seen] / max(weights[-1], 1e-300)
    gain = evidence_of_scale(scaled[None], relative[None])[0]
    return float(gain - 0.5 * scaled @ scaled)
