"""The oracle: the best possible answer from the data.

It has the exact statistics: the true launches (where it is linearised; priors of launches are those
of every method), the true noise and background, and the largest fault. It weighs every hypothesis
by its likelihood ratio, the leading ones by the finite change of the readings. Its class is every
hypothesis within a chi-square of 9 of the best.

Of several causes it seeks one at a time, given all the others: no method can do better.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tmlattice.beam.model import Hypothesis, Model
from tmlattice.challenge.case import Case, Truth, ring_of
from tmlattice.challenge.ruler import background_signatures
from tmlattice.effects import Cause, RingEffect, find, modelled
from tmlattice.inference.judgement import DEFAULT
from tmlattice.inference.scan import effective_number, free_threshold
from tmlattice.inference.whitening import Projection, Whitening
from tmlattice.machine import draw_background
from tmlattice.observe.data import Data, joined, of_measurement

Array = NDArray[np.float64]

CLASS = 9.0
"""Chi-square within which the oracle does not distinguish hypotheses."""

DRAWS = 200
REFINED = 60
LISTED = 400
CHUNK = 512


class Oracle:
    """Every hypothesis about one case, linearised at the true launches.

    Args:
        case, truth: both parts of it.
        given: known causes.
    """

    def __init__(self, case: Case, truth: Truth, given: Sequence[Cause] = ()) -> None:
        ring = ring_of(case.lattice)
        data = of_measurement(ring, case.fit)
        launches = truth.launches["fit"]
        if case.reference is not None:
            data = joined(of_measurement(ring, case.reference, reference=True), data)
            launches = np.concatenate([truth.launches["reference"], launches])
        self.data = _without_dead(data, truth, [m.name for m in ring.monitors])
        self.launches = launches
        # Distributed errors make an orbit of millimetres: a gradient kicks by that orbit, not by
        # the design's. The oracle is linearised at the machine before the fault; its data are those
        # of the linear model of the distributed errors.
        small = draw_background(ring, truth.background, truth.seed)
        set_there = {name for setting in data.settings for name in setting}
        known, self.small = [], []  # in the ring for good, and with every reading
        for cause in (*small, *given):
            if find(cause.effect).acts_on_settings:
                self.small += [cause] * (cause.element in set_there)
            elif isinstance(find(cause.effect), RingEffect):
                known.append(cause)
            else:
                self.small.append(cause)
        self.model = Model(ring, data.settings, known=known)
        self.paths = self.model.paths(launches, self.small)
        spread = None
        self.linear = np.zeros(self.paths.readings.shape)
        if truth.background:
            _, rms, spread = background_signatures(
                self.model, self.paths, launches, truth.background
            )
            amounts = np.array([cause.amount for cause in small])
            self.linear = np.einsum("h,hsrp->srp", amounts / rms, spread)
        self.whitening = Whitening(self.data, spread)
        self.projection = Projection(self.whitening.launch(self.paths.launch))
        self.hypotheses = self.model.hypotheses(modelled(case.options.get("effects")))
        self.rows = self._signatures()
        self.norm = np.einsum("hr,hr->h", self.rows, self.rows)
        self.cap = np.array([find(n).largest ** find(n).power for n, _ in self.hypotheses])
        self.discrete = np.array([find(n).discrete for n, _ in self.hypotheses])
        self.threshold = self._threshold()

    def residual(self, readings: Array) -> Array:
        """Return whitened rows of the fit's readings, with those of a reference unchanged."""
        whole = self.data.readings.copy()
        whole[self.data.active] = np.nan_to_num(readings)
        difference = np.where(self.data.valid, whole - self.paths.readings + self.linear, 0.0)
        return self.projection.out(self.whitening.residual(difference, self.launches))

    def statistics(self, clean: Array) -> tuple[Array, Array]:
        """Return the fall of chi-square, and the best amount ** power within the largest fault."""
        inner = self.rows @ clean
        return _best(inner, self.norm, self.cap, self.discrete)

    def refined(self, clean: Array) -> tuple[Array, Array]:
        """Return the same, of the leading hypotheses by their finite changes."""
        statistic, amount = self.statistics(clean)
        base = self.model.readings(self.launches, self.small)
        active = self.data.active[:, None, None]
        for h in np.argsort(-statistic)[:REFINED]:
            if statistic[h] <= 0 or self.discrete[h]:
                continue
            name, place = self.hypotheses[h]
            power = find(name).power
            for _ in range(2):
                if amount[h] == 0 or (power == 2 and amount[h] < 0):
                    break
                size = amount[h] if power == 1 else np.sqrt(amount[h])
                causes = [*self.small, Cause(name, place, float(size))]
                change = (self.model.readings(self.launches, causes) - base) * active
                row = self.whitening.signature(np.nan_to_num(change) / amount[h])
                row = self.projection.out(row)
                found = _best(
                    np.array([row @ clean]),
                    np.array([row @ row]),
                    self.cap[h : h + 1],
                    self.discrete[h : h + 1],
                )
                statistic[h], amount[h] = found[0][0], found[1][0]
        return statistic, amount

    def _signatures(self) -> Array:
        rows = np.empty((len(self.hypotheses), self.whitening.rows))
        active = self.data.active[:, None, None]
        for start in range(0, len(rows), CHUNK):
            some = self.hypotheses[start : start + CHUNK]
            change = np.nan_to_num(self.model.signatures(self.paths, some, self.launches)) * active
            rows[start : start + CHUNK] = self.projection.out(self.whitening.signature(change))
        return rows

    def _threshold(self) -> float:
        """Statistic that noise reaches in 0.5 % of data sets, from its simulated tail."""
        draws = np.random.default_rng([0, 7]).standard_normal((DRAWS, self.whitening.rows))
        inner = self.rows @ self.projection.out(draws).T  # [hypothesis, draw]
        largest = _best(inner.T, self.norm, self.cap, self.discrete)[0].max(axis=1)
        return free_threshold(DEFAULT.false_alarm, 1, effective_number(largest, 1))


def _best(
    inner: Array, norm: Array, cap: Array, discrete: NDArray[np.bool_]
) -> tuple[Array, Array]:
    safe = np.where(norm > 1e-12, norm, np.inf)
    amount = np.clip(inner / safe, -cap, cap)
    amount = np.where(discrete, np.where(norm > 1e-12, 1.0, 0.0), amount)
    return 2 * amount * inner - amount**2 * norm, amount


def _without_dead(data: Data, truth: Truth, monitors: Sequence[str]) -> Data:
    dropped = np.zeros(data.valid.shape, dtype=bool)
    for cause in truth.causes:
        if not find(cause.effect).modelled:
            dropped[:, monitors.index(str(cause.element))] = True
    return data.without(dropped)


def evaluate(argument: tuple[Case, Truth]) -> dict[str, Any]:
    """Return the oracle's answer for a case, as JSON: {"oracles": one per cause, "residual"}.

    A case of an unknown, or of none, has one oracle and, of an unknown, the residual after the best
    member of the catalogue, in sigma.
    """
    case, truth = argument
    causes = truth.causes
    if len(causes) > 1:
        # a monitor without a signal is known as such
        asked = [cause for cause in causes if find(cause.effect).modelled]
        given = [tuple(c for c in causes if c is not cause) for cause in asked]
        return {
            "oracles": [_as_answer(Oracle(case, truth, others), case) for others in given],
            "residual": None,
        }
    oracle = Oracle(case, truth)
    left = None
    if truth.unknown is not None:
        quiet = oracle.residual(truth.clean["fit"])
        if case.reference is not None:  # with the reference's noise: only the change counts
            quiet = quiet - oracle.residual(truth.clean["before"])
        best = oracle.refined(quiet)[0].max()
        left = float(np.sqrt(max(float(quiet @ quiet) - best, 0.0)))
    return {"oracles": [_as_answer(oracle, case)], "residual": left}


def _as_answer(oracle: Oracle, case: Case) -> dict[str, Any]:
    clean = oracle.residual(case.fit.in_order_of(oracle.model.maps.monitors).readings[:, 0])
    statistic, amount = oracle.refined(clean)
    root = np.array([1 / find(name).power for name, _ in oracle.hypotheses])
    return answer(
        oracle.hypotheses,
        statistic,
        np.sign(amount) * np.abs(amount) ** root,
        np.array(_priors(oracle.hypotheses)),
        oracle.threshold,
    )


def answer(
    hypotheses: Sequence[Hypothesis],
    statistic: Array,
    amount: Array,
    prior: Array,
    threshold: float,
) -> dict[str, Any]:
    """Return the oracle's answer from its hypotheses, as JSON.

    Args:
        hypotheses: all hypotheses.
        statistic, amount, prior: fall of chi-square, best amount, log prior probability of each,
            [hypothesis].
        threshold: of the largest statistic.
    """
    weight = statistic / 2 + prior
    weight = np.exp(weight - weight.max())
    weight /= weight.sum()
    by_weight = np.argsort(-weight)[:LISTED]
    by_likelihood = np.argsort(-statistic)[:LISTED]

    def listed(some: NDArray[np.intp]) -> list[dict[str, Any]]:
        return [
            {
                "effect": hypotheses[h][0],
                "element": hypotheses[h][1],
                "statistic": float(statistic[h]),
                "amount": float(amount[h]),
                "probability": float(weight[h]),
            }
            for h in some
        ]

    top = float(statistic.max())
    return {
        "statistic": top,
        "threshold": threshold,
        "detected": bool(top > threshold),
        "class_size": int((statistic > top - CLASS).sum()),
        "class": listed(by_likelihood[statistic[by_likelihood] > top - CLASS]),
        "posterior": listed(by_weight),
    }


def _priors(hypotheses: Sequence[Hypothesis]) -> list[float]:
    """Log prior probabilities: effects are drawn uniformly, then places."""
    count: dict[str, int] = {}
    for name, _ in hypotheses:
        count[name] = count.get(name, 0) + 1
    return [-float(np.log(len(count) * count[name])) for name, _ in hypotheses]
