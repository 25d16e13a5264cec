"""Sets of common factors that explain the same numbers, with their probabilities.

>>> sets = likely_sets(model, most=20)
>>> sets[0].chosen, sets[0].probability

Shared errors have several descriptions: two families, or a polarity and one of its families with
the other sign. Stepwise selection ends in one of them, almost by chance. It therefore starts again
without each selected factor. From all ends the neighbouring sets (one factor more, less, or
exchanged) are expanded, the most probable first, as in the search of Hans, Dobra and West, J. Am.
Stat. Assoc. 102, 507, 2007, without its draws. The error of an amount is averaged over all sets
with it. Sets with the same span are one: a whole and a part, each of several numbers, are reported
as the two parts.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from heapq import heapify, heappop, heappush
from itertools import permutations

import numpy as np
from numpy.typing import NDArray

from tmlattice.inference.common_factors import MAX_BEHIND, MIN_CHI2, CommonFactor, FactorModel

Array = NDArray[np.float64]

MAX_EXCLUDED = 2
"""Selected factors that are excluded together for another start."""
MAX_EXPANDED = 300
"""Sets that are expanded at most. ESRF-EBS with 857 candidates needs 150."""
NEGLIGIBLE = 6.0
"""Log probability below the best at which a set is ignored: odds of 1 to 400."""


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


def likely_sets(levels: FactorModel, most: int, clear: float = MIN_CHI2) -> list[LikelySet]:
    """Sets in which every factor is significant given the others, the most probable first.

    Args:
        levels: the candidates.
        most: candidates in a set at most.
        clear: smallest chi-square of a factor.

    Returns:
        At least one set.
    """
    rests = _rests(levels.candidates)
    chances: dict[frozenset[int], float] = {}
    for one in _likely(levels, _starts(levels, most, clear), most, clear):
        parts = _in_parts(rests, one)
        reported = parts if (levels.squares(sorted(parts)) >= clear).all() else one
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
            likely = one.probability > np.exp(-MAX_BEHIND) * first.probability
            if likely and len(one.chosen) == len(first.chosen) and len(more) == 1:
                alternatives.append((more[0], one.probability))
        total = sum(chance for _, chance in alternatives)
        reported = tuple((candidate, chance / total) for candidate, chance in alternatives)
        found.append(
            (replace(own, sigma=float(np.sqrt(square / share)), alternatives=reported), share)
        )
    return found


def _starts(levels: FactorModel, most: int, clear: float) -> list[frozenset[int]]:
    """Ends of stepwise selection with all candidates, and without each selected one, in turn from
    each likely end; the most probable first."""
    ends = {frozenset[int](): 0.0}
    waiting: list[frozenset[int]] = [frozenset()]  # excluded candidates
    tried = set(waiting)
    while waiting:
        without = waiting.pop(0)
        end = frozenset(levels.choose(most, clear, without))
        ends[end] = levels.log_evidence(sorted(end))
        if len(without) < MAX_EXCLUDED and ends[end] > max(ends.values()) - NEGLIGIBLE:
            more = [without | {own} for own in sorted(end)]
            waiting += [one for one in more if one not in tried]
            tried.update(more)
    best = max(ends.values())
    likely = [one for one, value in ends.items() if value > best - NEGLIGIBLE]
    return sorted(likely, key=lambda one: (-ends[one], sorted(one)))


def _likely(
    levels: FactorModel, starts: Sequence[frozenset[int]], most: int, clear: float
) -> list[frozenset[int]]:
    """Likely sets that are reached from the starts over significant ones, by one candidate more,
    less or exchanged; the most probable are expanded first, `MAX_EXPANDED` of them."""
    met = {one: levels.log_evidence(sorted(one)) for one in starts}
    best = max(met.values())
    waiting = [(-value, sorted(one)) for one, value in met.items()]
    heapify(waiting)
    found: list[frozenset[int]] = []

    def meet(one: frozenset[int], value: float) -> None:
        if value > best - NEGLIGIBLE and one not in met:
            met[one] = value
            heappush(waiting, (-value, sorted(one)))

    while waiting and len(found) < MAX_EXPANDED and -waiting[0][0] > best - NEGLIGIBLE:
        negative, here = heappop(waiting)
        if not (levels.squares(here) >= clear).all():
            continue
        found.append(frozenset(here))
        best = max(best, -negative)
        # log probability of each smaller set, and with any one candidate more
        for own in [None, *here] if len(here) < most else here:
            others = [c for c in here if c != own]
            gain, square = levels.gains(others)
            left = -negative if own is None else -negative - float(gain[own])
            meet(frozenset(others), left)
            values = np.where(square >= clear, left + gain, -np.inf)
            for candidate in np.flatnonzero(values > best - NEGLIGIBLE).tolist():
                meet(frozenset([*others, candidate]), float(values[candidate]))
    return [one for one in found if met[one] > best - NEGLIGIBLE]


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
