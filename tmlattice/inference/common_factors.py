"""Common factors behind many numbers, selected by the marginal likelihood.

>>> model = FactorModel(information, score, candidates, variance, slab)
>>> [(one.candidate, one.amount, one.sigma) for one in model.reasons(model.choose(20))]

Many numbers (such as gradients) have a known covariance, and each scatters by itself. A candidate
factor moves some of them together: all, a family, one. Factors are selected by adding the one with
the largest evidence, removing redundant ones, and exchanging. The model is linear and Gaussian, so
that the error of each amount includes the scatter.

Sets of common factors that explain the same numbers, with their probabilities. Shared errors have
several descriptions: two families, or a polarity and one of its families with the other sign.
Stepwise selection ends in one of them, almost by chance. It therefore starts again without each
selected factor. From all ends the neighbouring sets (one factor more, less, or exchanged) are
expanded, the most probable first, as in the search of Hans, Dobra and West, J. Am. Stat. Assoc.
102, 507, 2007, without its draws. The error of an amount is averaged over all sets with it. Sets
with the same span are one: a whole and a part, each of several numbers, are reported as the two
parts.
"""

from collections.abc import Collection, Sequence
from copy import copy
from dataclasses import dataclass, replace
from heapq import heapify, heappop, heappush
from itertools import permutations

import numpy as np
from scipy.linalg import lu_factor, lu_solve
from scipy.special import logsumexp

from tmlattice.arrays import REDUNDANT, TINY, Array
from tmlattice.inference.judgement import DEFAULT, SIGNIFICANT
from tmlattice.inference.newton import ROUNDS

MIN_CHI2 = SIGNIFICANT**2
"""Chi-square of a selected factor, at least."""


@dataclass(frozen=True)
class CommonFactor:
    """One selected factor.

    Attributes:
        candidate: its index.
        amount, sigma: with the scatter of the single numbers in the error.
        statistic: its chi-square given all others.
        alternatives: candidates in its place and their probabilities; the first is itself.
    """

    candidate: int
    amount: float
    sigma: float
    statistic: float
    alternatives: tuple[tuple[int, float], ...]


class FactorModel:
    """Candidate factors together with the scatter of single numbers.

    Args:
        information: J^T W J of the numbers, nuisances projected out, [number, number].
        score: J^T W y with all numbers at zero, [number].
        candidates: what each moves, [number, candidate].
        variance: of the scatter of each number, or its covariance, [number] or [number, number].
        slab: prior rms of each candidate's amount, [candidate].
        cost: log odds against each candidate beyond their number, [candidate].

    Attributes:
        background: log evidence of the scatter alone, over numbers that are zero.
    """

    def __init__(
        self,
        information: Array,
        score: Array,
        candidates: Array,
        variance: Array,
        slab: Array,
        cost: Array | None = None,
    ) -> None:
        scatter = np.diag(variance) if variance.ndim == 1 else variance
        factor = lu_factor(np.eye(len(score)) + information @ scatter)
        wide = np.log(np.abs(np.diag(factor[0]))).sum()
        self.background = float(score @ scatter @ lu_solve(factor, score) - wide) / 2
        self.slab = slab
        self.cost = np.log(len(slab)) + (np.zeros(len(slab)) if cost is None else cost)
        self.score = candidates.T @ lu_solve(factor, score)
        self.information = candidates.T @ lu_solve(factor, information) @ candidates
        self.information = (self.information + self.information.T) / 2
        self.candidates = candidates

    def given(self, others: Sequence[int], rms: float) -> "FactorModel":
        """Return the model with some candidates integrated out, each an amount of this rms."""
        at = np.array(others, dtype=int)
        inside = self.information[np.ix_(at, at)] + np.eye(len(at)) / rms**2
        across = self.information[:, at]
        taken = np.linalg.solve(inside, np.column_stack([across.T, self.score[at]]))
        made = copy(self)
        made.information = self.information - across @ taken[:, :-1]
        made.score = self.score - across @ taken[:, -1]
        wide = np.linalg.slogdet(inside)[1] + 2 * len(at) * np.log(rms)
        made.background = self.background + float(self.score[at] @ taken[:, -1] - wide) / 2
        made.information[at] = made.information[:, at] = made.score[at] = 0.0
        return made

    def given_others(
        self, chosen: Sequence[int], alike: Collection[int], rms: Sequence[float]
    ) -> "GivenOthers":
        """Return the selected factors with the unresolved ones of their kind integrated out.

        The common rms of the unresolved factors follows the evidence. A selected factor that is no
        longer significant is one of them, or is removed.

        Args:
            chosen: selected factors.
            alike: candidates of one kind.
            rms: of the others' amounts, to be tried; together as probable as no others.
        """
        stay = list(chosen)
        if not set(alike) & set(stay):
            return GivenOthers(self, stay, 0.0, ((self, 1.0),))
        while True:
            chosen, others = stay, [own for own in alike if own not in stay]
            sizes = [0.0, *rms] if others else [0.0]
            made = [self.given(others, one) if one else self for one in sizes]
            logs = np.array([own.background + own.log_evidence(chosen) for own in made])
            best = int(np.argmax(logs - DEFAULT.behind * (np.array(sizes) > 0)))
            stay = made[best]._pruned(list(chosen))
            if len(stay) == len(chosen):
                logs[1:] -= np.log(max(len(rms), 1))
                chance = np.exp(logs - logsumexp(logs)).tolist()
                return GivenOthers(
                    made[best], stay, sizes[best], tuple(zip(made, chance, strict=True))
                )

    def fitted(self, chosen: Sequence[int]) -> tuple[Array, Array]:
        """Amounts of some candidates and their covariance."""
        at = np.array(chosen, dtype=int)
        inside = self.information[np.ix_(at, at)] + np.diag(self.slab[at] ** -2.0)
        covariance = np.linalg.inv(inside)
        return covariance @ self.score[at], covariance

    def log_evidence(self, chosen: Sequence[int]) -> float:
        """Log evidence of some candidates over none, with the prior odds."""
        if not len(chosen):
            return 0.0
        at = np.array(chosen, dtype=int)
        amounts, covariance = self.fitted(chosen)
        wide = np.linalg.slogdet(covariance)[1] / 2 - np.log(self.slab[at]).sum()
        return float(amounts @ self.score[at] / 2 + wide - self.cost[at].sum())

    def squares(self, chosen: Sequence[int]) -> Array:
        """Chi-square of each of some candidates given the others."""
        amounts, covariance = self.fitted(chosen)
        variance = np.diag(covariance)
        known = 1 / variance - self.slab[np.array(chosen, dtype=int)] ** -2.0
        known = np.maximum(known, 0)
        return np.where(known > 0, (amounts / variance) ** 2 / np.maximum(known, TINY), 0.0)

    def _given(self, chosen: Sequence[int]) -> tuple[Array, Array, Array]:
        """Score and information of each candidate given some, and the change of the amounts of
        these by a unit of it, [chosen, candidate]."""
        amounts, covariance = self.fitted(chosen)
        across = self.information[:, list(chosen)]
        lessened = covariance @ across.T
        own = np.diag(self.information) - np.einsum("ij,ji->i", across, lessened)
        return self.score - across @ amounts, np.maximum(own, 0.0), lessened

    def gains(self, chosen: Sequence[int]) -> tuple[Array, Array]:
        """Log evidence of adding each candidate, and its chi-square."""
        score, own, _ = self._given(chosen)
        spread = own + self.slab**-2.0
        gain = 0.5 * score**2 / spread - 0.5 * np.log(spread * self.slab**2)
        square = np.where(own > 0, score**2 / np.maximum(own, TINY), 0.0)
        seen = own > REDUNDANT * np.diag(self.information)  # else redundant
        gain = np.where(seen, gain, 0.0) - self.cost
        gain[list(chosen)] = -np.inf
        return gain, np.where(seen, square, 0.0)

    def choose(self, most: int, without: Collection[int] = ()) -> list[int]:
        """Select factors, except some."""
        chosen: list[int] = []
        while len(chosen) < most:
            gain, square = self.gains(chosen)
            gain[list(without)] = -np.inf
            gain[square < MIN_CHI2] = -np.inf
            best = int(np.argmax(gain))
            if not gain[best] > 0:
                break
            chosen = self._pruned([*chosen, best])
            if best not in chosen:
                break
        for _ in range(ROUNDS):
            before = list(chosen)
            for own in before:
                others = [c for c in chosen if c != own]
                gain, square = self.gains(others)
                gain[list(without)] = -np.inf
                best = int(np.argmax(np.where(square < MIN_CHI2, -np.inf, gain)))
                if gain[best] > gain[own] + 1e-9:
                    chosen = [*others, best]
            chosen = self._pruned(chosen)
            if set(chosen) == set(before):
                break
        return chosen

    def _pruned(self, chosen: list[int]) -> list[int]:
        """Remove redundant factors, the weakest first."""
        while chosen:
            worth = []
            for own in chosen:
                gain, square = self.gains([c for c in chosen if c != own])
                worth.append(gain[own] if square[own] >= MIN_CHI2 else -np.inf)
            least = int(np.argmin(worth))
            if worth[least] > 0:
                break
            chosen = [c for i, c in enumerate(chosen) if i != least]
        return chosen

    def averaged(self, chosen: Sequence[int]) -> tuple[Array, Array]:
        """Amounts of some candidates and their variances, averaged over one further factor that is
        not significant."""
        amounts, covariance = self.fitted(chosen)
        score, own, lessened = self._given(chosen)
        spread = own + self.slab**-2.0
        moved = -lessened * (score / spread)
        gain = self.gains(chosen)[0]
        gain[own <= REDUNDANT * np.diag(self.information)] = -np.inf  # redundant
        there = np.exp(gain - np.logaddexp(0.0, logsumexp(gain)))
        more = moved @ there
        wider = np.diag(covariance) + (moved**2 + lessened**2 / spread) @ there
        return amounts + more, wider - more**2

    def reasons(
        self, chosen: Sequence[int], over: Sequence[tuple["FactorModel", float]] = ()
    ) -> list[CommonFactor]:
        """Return amounts, errors and alternatives of the selected factors, by falling chi-square.

        Args:
            chosen: selected factors.
            over: models with their probabilities, each averaged over one further factor, see
                `averaged`; none: no further factor.
        """
        if not chosen:
            return []
        amounts, covariance = self.fitted(chosen)
        variance = np.diag(covariance)
        if over:
            each = [own.averaged(chosen) for own, _ in over]
            chance = np.array([share for _, share in over])
            means, within = (np.array([own[i] for own in each]) for i in (0, 1))
            amounts = chance @ means
            variance = chance @ (within + (means - amounts) ** 2)
        found = []
        for i, own in enumerate(chosen):
            gain, square = self.gains([c for c in chosen if c != own])
            near = np.flatnonzero(gain > gain[own] - DEFAULT.behind).tolist()
            others = [c for c in near if c != own]
            odds = np.exp(gain[[own, *others]] - gain[own])
            ranked = sorted(zip([own, *others], odds / odds.sum(), strict=True),
                          key=lambda row: (row[0] != own, -row[1]))  # fmt: skip
            found.append(
                CommonFactor(
                    own, float(amounts[i]), float(np.sqrt(variance[i])), float(square[own]),
                    tuple((c, float(p)) for c, p in ranked),
                )
            )  # fmt: skip
        return sorted(found, key=lambda reason: -reason.statistic)


@dataclass(frozen=True, eq=False)
class GivenOthers:
    """Selected factors, given unresolved ones of the same kind.

    Attributes:
        levels: the model, with the most probable rms of the others in its errors.
        chosen: the selected factors.
        rms: of the others, 0 if the evidence is against them.
        over: models with every rms of the others, and their probabilities.
    """

    levels: FactorModel
    chosen: list[int]
    rms: float
    over: tuple[tuple[FactorModel, float], ...]


MAX_CHOSEN = 40
"""Selected factors at most: many supplies may be changed on purpose."""
MAX_EXCLUDED = 2
"""Selected factors that are excluded together for another start."""
MAX_EXPANDED = 300
"""Sets that are expanded at most. ESRF-EBS with 857 candidates needs 150."""


@dataclass(frozen=True)
class LikelySet:
    """Factors that explain the numbers together.

    Attributes:
        chosen: their candidates.
        probability: among all sets.
        amounts: of each.
        covariance: of the amounts, given this set.
    """

    chosen: tuple[int, ...]
    probability: float
    amounts: Array
    covariance: Array

    def amount(self, candidate: int) -> float:
        """Amount of one candidate."""
        return float(self.amounts[self.chosen.index(candidate)])

    def variance(self, candidate: int) -> float:
        """Variance of the amount of one candidate, given this set."""
        at = self.chosen.index(candidate)
        return float(self.covariance[at, at])


def likely_sets(levels: FactorModel, most: int) -> list[LikelySet]:
    """Sets in which every factor is significant given the others, the most probable first.

    Args:
        levels: the candidates.
        most: candidates in a set at most.

    Returns:
        At least one set.
    """
    rests = _rests(levels.candidates)
    chances: dict[frozenset[int], float] = {}
    for one in _likely(levels, _starts(levels, most), most):
        parts = _in_parts(rests, one)
        reported = parts if (levels.squares(sorted(parts)) >= MIN_CHI2).all() else one
        chance = levels.log_evidence(sorted(one))
        chances[reported] = max(chance, chances.get(reported, -np.inf))
    sets = list(chances)
    logs = np.array([chances[one] for one in sets])
    shares = np.exp(logs - logs.max())
    shares /= shares.sum()
    order = sorted(range(len(sets)), key=lambda i: (-shares[i], sorted(sets[i])))
    return [
        LikelySet(tuple(sorted(sets[i])), float(shares[i]), *levels.fitted(sorted(sets[i])))
        for i in order
    ]


def over_sets(levels: FactorModel, sets: Sequence[LikelySet]) -> list[tuple[CommonFactor, float]]:
    """Factors of the first set, by falling chi-square, and the probability of each.

    Errors are averaged over all sets with a factor. Its alternatives are those in sets with one
    other candidate in its place.
    """
    first = sets[0]
    found = []
    for own in levels.reasons(first.chosen):
        c, amount = own.candidate, own.amount
        there = [one for one in sets if c in one.chosen]
        share = sum(one.probability for one in there)
        square = sum(
            one.probability * (one.variance(c) + (one.amount(c) - amount) ** 2) for one in there
        )
        others = frozenset(first.chosen) - {c}
        alternatives = [(c, first.probability)]
        for one in sets[1:]:
            (*more,) = frozenset(one.chosen) - others
            likely = one.probability > (1 - DEFAULT.mass) * first.probability
            if likely and len(one.chosen) == len(first.chosen) and len(more) == 1:
                alternatives.append((more[0], one.probability))
        total = sum(chance for _, chance in alternatives)
        reported = tuple((candidate, chance / total) for candidate, chance in alternatives)
        found.append(
            (replace(own, sigma=float(np.sqrt(square / share)), alternatives=reported), share)
        )
    return found


def _starts(levels: FactorModel, most: int) -> list[frozenset[int]]:
    """Ends of stepwise selection with all candidates, and without each selected one, in turn from
    each likely end; the most probable first."""
    ends = {frozenset[int](): 0.0}
    waiting: list[frozenset[int]] = [frozenset()]  # excluded candidates
    tried = set(waiting)
    while waiting:
        without = waiting.pop(0)
        end = frozenset(levels.choose(most, without))
        ends[end] = levels.log_evidence(sorted(end))
        if len(without) < MAX_EXCLUDED and ends[end] > max(ends.values()) - DEFAULT.log_odds:
            more = [without | {own} for own in sorted(end)]
            waiting += [one for one in more if one not in tried]
            tried.update(more)
    best = max(ends.values())
    likely = [one for one, value in ends.items() if value > best - DEFAULT.log_odds]
    return sorted(likely, key=lambda one: (-ends[one], sorted(one)))


def _likely(
    levels: FactorModel, starts: Sequence[frozenset[int]], most: int
) -> list[frozenset[int]]:
    """Likely sets that are reached from the starts over significant ones, by one candidate more,
    less or exchanged; the most probable are expanded first, `MAX_EXPANDED` of them."""
    met = {one: levels.log_evidence(sorted(one)) for one in starts}
    best = max(met.values())
    waiting = [(-value, sorted(one)) for one, value in met.items()]
    heapify(waiting)
    found: list[frozenset[int]] = []

    def meet(one: frozenset[int], value: float) -> None:
        if value > best - DEFAULT.log_odds and one not in met:
            met[one] = value
            heappush(waiting, (-value, sorted(one)))

    while waiting and len(found) < MAX_EXPANDED and -waiting[0][0] > best - DEFAULT.log_odds:
        negative, here = heappop(waiting)
        if not (levels.squares(here) >= MIN_CHI2).all():
            continue
        found.append(frozenset(here))
        best = max(best, -negative)
        # log probability of each smaller set, and with any one candidate more
        for own in [None, *here] if len(here) < most else here:
            others = [c for c in here if c != own]
            gain, square = levels.gains(others)
            left = -negative if own is None else -negative - float(gain[own])
            meet(frozenset(others), left)
            values = np.where(square >= MIN_CHI2, left + gain, -np.inf)
            for candidate in np.flatnonzero(values > best - DEFAULT.log_odds).tolist():
                meet(frozenset([*others, candidate]), float(values[candidate]))
    return [one for one in found if met[one] > best - DEFAULT.log_odds]


def _rests(candidates: Array) -> dict[tuple[int, int], int]:
    """Complement of each part of a whole among the candidates, {(whole, part): complement}; each of
    several numbers."""
    several = np.flatnonzero(np.count_nonzero(candidates, axis=0) > 1)
    columns = {candidates[:, c].tobytes(): int(c) for c in several}
    own = candidates[:, several]
    within = own.T @ own == np.sum(own**2, axis=0)  # [whole, part], of numbers that are 0 or 1
    found = {}
    for w, p in np.argwhere(within & ~np.eye(len(several), dtype=bool)).tolist():
        rest = columns.get((own[:, w] - own[:, p]).tobytes())
        if rest is not None:
            found[int(several[w]), int(several[p])] = rest
    return found


def _in_parts(rests: dict[tuple[int, int], int], one: frozenset[int]) -> frozenset[int]:
    """Replace each whole with a part in the set by the complement of that part."""
    while True:
        found = next((pair for pair in permutations(sorted(one), 2) if pair in rests), None)
        if found is None:
            return one
        one = one - {found[0]} | {rests[found]}
