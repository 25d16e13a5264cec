"""Sets of reasons that explain the same numbers: which others are as likely as the best one.

>>> sets = likely_sets(levels, most=20)
>>> sets[0].chosen, sets[0].probability

Shared errors can be told in many ways: two families, or a polarity and one of its families with the
other sign. Adding and exchanging one by one ends in one of them, and which one that is hangs on
little. So it begins anew without each of those that were chosen, and from all ends the sets beside
them are looked at (one more, one less, one exchanged; the likeliest first, as in the search of
Hans, Dobra and West, J. Am. Stat. Assoc. 102, 507, 2007, without its draws). All are weighed, and
an amount's error is told over all sets that hold it. Sets that span the same are one: a whole and a
part, each of several numbers, are told as the two parts.
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
"""Candidates left out together, of those that were chosen, to end elsewhere."""
MAX_EXPANDED = 300
"""Sets whose neighbours are looked at. Of ESRF-EBS' 857 candidates 150 are needed."""
NEGLIGIBLE = 6.0
"""Log probability behind the best by which a set is not counted: a four hundredth."""


@dataclass(frozen=True)
class LikelySet:
    """Candidates that explain the numbers together.

    Attributes:
        chosen: which ones.
        probability: among all that were counted.
        amounts: of each.
        covariance: of the amounts, of this set alone.
    """

    chosen: tuple[int, ...]
    probability: float
    amounts: Array
    covariance: Array

    def amount(self, candidate: int) -> float:
        """Of one of them."""
        return float(self.amounts[self.chosen.index(candidate)])

    def variance(self, candidate: int) -> float:
        """Of the amount of one of them, in this set alone."""
        at = self.chosen.index(candidate)
        return float(self.covariance[at, at])


def likely_sets(levels: FactorModel, most: int, clear: float = MIN_CHI2) -> list[LikelySet]:
    """Those in which every candidate explains `clear` of chi-square beside the others, likeliest
    first; never empty.

    Args:
        levels: the candidates.
        most: candidates in a set.
        clear: chi-square.
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
    """The reasons of the first set, by falling chi-square, and the probability that each is there.

    Errors are those about all sets that hold a reason; its rivals are those of the sets that have
    one other candidate in its place.
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
    """What adding and exchanging ends in, with all candidates, and without each one of those that
    were chosen so; of a likely end each of its own in turn. Likeliest first."""
    ends = {frozenset[int](): 0.0}
    waiting: list[frozenset[int]] = [frozenset()]  # candidates that are not to be chosen
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
    """All that are reached from the starts over clear sets that are likely, by one candidate more,
    less or exchanged at a time; the likeliest are looked at first, `STEPS` of them."""
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
        # of each set that is left the log probability, and that with any one candidate more
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
    """Of a candidate and one that moves a part of its numbers, the one that moves the rest of them,
    where there is one; each several numbers, for a whole with one number apart is simpler."""
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
    """With no whole beside a part of it."""
    while True:
        found = next((pair for pair in permutations(sorted(one), 2) if pair in rests), None)
        if found is None:
            return one
        one = one - {found[0]} | {rests[found]}
