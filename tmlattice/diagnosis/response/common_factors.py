"""Common factors of many gradient errors: one scale, focusing, regions, types, families, magnets.

>>> found = explain_gradients(fit.state)
>>> [(own.kind, own.name, own.amount, own.amount_sigma) for own in found.common_factors]

A hierarchical fit estimates an error of every quadrupole. The same readings are explained again by
common factors, numbers that many magnets share. Candidates of every level are compared by the
marginal likelihood (`inference.common_factors`), with alternative sets. The learnt scatter of
single magnets is in every error.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from tmlattice.arrays import TINY, Array, Flags, Indices, rms
from tmlattice.diagnosis.families.fields import (
    REPRODUCED,
    USUAL,
    QuadrupoleGradient,
)
from tmlattice.diagnosis.records import named, of
from tmlattice.diagnosis.response.linear import linear, marginal
from tmlattice.diagnosis.response.state import State
from tmlattice.diagnosis.response.stated import of_readings, of_sizes
from tmlattice.diagnosis.support import SHOWN, share_from_data
from tmlattice.inference.common_factors import (
    MAX_CHOSEN,
    MIN_CHI2,
    FactorModel,
    LikelySet,
    likely_sets,
    over_sets,
)
from tmlattice.inference.judgement import DEFAULT, FEW
from tmlattice.lattice import Element, Ring
from tmlattice.lattice.supplies import magnets, supplied_alike

GAP = 2.5
"""Ratio to the typical distance of two bends above which a straight is between them."""
BETWEEN = (1e-3, 2e-3, 5e-3, 1e-2, 2e-2, 5e-2)
"""Scatters of families, relative rms, that are tried."""
COST = {"all": 0.0, "focusing": 1.0, "region": 1.0, "type": 1.0, "family": 1.0, "magnet": 3.0}
"""Log prior odds against a common factor of each kind."""
MAKES = {
    "all": "the beam's energy differs from the magnets' by as much with the other sign, or all "
    "gradients have this calibration: the response does not separate the two",
    "focusing": "the calibration of one polarity: its supplies, or the set tunes",
    "region": "one supply, or one setting, of the magnets there; or the beam's orbit and fringe "
    "fields there are not the model's",
    "type": "the calibration or the fringe field of this type of magnet",
    "family": "their supply: its current, its calibration curve, or a wrong setting in the lattice "
    "file",
    "magnet": "this magnet alone: a shorted turn, a wrong tap, or a nearby field that is not "
    "in the lattice",
}
"""Possible causes of a common factor of each kind."""


@dataclass(frozen=True)
class Reason:
    """One number that many magnets share, or one magnet's.

    Attributes:
        kind: see `MAKES`.
        name: of the group.
        members: the magnets, by their first pieces.
        amount, amount_sigma: relative change of the gradients; the error includes the scatter of
            single magnets, and the amounts in alternative sets, weighted by their probability.
        probability: that it is present, over all sets.
        statistic: chi-square that it explains given all others.
        makes: its possible causes.
        `rivals`: alternatives that the data do not exclude, with probabilities.
        share_from_data: of the amount, 1 - posterior variance / prior variance.
    """

    kind: str
    name: str
    members: tuple[str, ...]
    amount: float
    amount_sigma: float
    probability: float
    statistic: float
    makes: str
    rivals: tuple[tuple[str, float], ...] = field(metadata=of("name", "probability"))
    share_from_data: float = 1.0


@dataclass(frozen=True)
class Instead:
    """An alternative set of common factors for the same gradients.

    Attributes:
        probability: among all sets.
        amounts: of each common factor in it: name, amount and error, relative.
    """

    probability: float
    amounts: tuple[tuple[str, float, float], ...] = field(
        metadata=named("common_factors") | of("name", "amount", "amount_sigma")
    )


@dataclass(frozen=True)
class CommonFactors:
    """The common factors of the gradients.

    Attributes:
        common_factors: of the most probable set, by falling chi-square.
        instead: alternative sets, by falling probability.
        share: of the gradients' mean square that the common factors explain.
        scatter: rms of single magnets about them, relative.
        between: rms of families about what they share, relative; 0 if families are alike, or are
            separate common factors.
    """

    common_factors: tuple[Reason, ...]
    instead: tuple[Instead, ...]
    share: float
    scatter: float
    between: float = field(metadata=named("between_families"))


def explain_gradients(state: State) -> CommonFactors | None:
    """Return the common factors of a hierarchical fit's gradients; None if none were fitted."""
    family = QuadrupoleGradient()
    if family.variable not in state.values or not family.size(state.data):
        return None
    there = linear(state, 0)
    information, pull = marginal(there, [family.variable])
    own = magnets(state.data.ring, ("quadrupole",), True)
    among = candidates(state.data.ring, own)
    kinds, names, members, _ = among
    known = state.groups.get(family.name)
    scatter = max(REPRODUCED if known is None else known.rms, REPRODUCED)
    posterior = there.posterior
    rows = there.where[family.variable]
    spread = posterior.spread[rows]
    covariance = spread @ posterior.covariance @ spread.T
    # the excess of stated errors over posterior ones is in every error, but is no scatter
    plain = np.maximum(np.diag(covariance), TINY)
    wider = of_readings(state, 0, there, posterior)[rows] / np.sqrt(plain)
    sizes = of_sizes(state, 0, there)[rows]
    more = np.sqrt(np.maximum(wider**2 - 1, 0))
    single = scatter**2 * np.eye(len(own)) + covariance * np.outer(more, more) + sizes @ sizes.T
    between, levels, sets = weighed(information, pull, among, single)
    found = [
        (one, chance)
        for one, chance in over_sets(levels, sets)
        if one.statistic >= MIN_CHI2  # the sets include families below the detection limit
    ]
    places = [pieces[0].name for pieces in own]
    common_factors = tuple(
        Reason(
            kinds[one.candidate], names[one.candidate],
            tuple(places[i] for i in np.flatnonzero(members[:, one.candidate])),
            one.amount, one.sigma, chance, one.statistic, MAKES[kinds[one.candidate]],
            tuple((names[c], p) for c, p in one.alternatives[1:]),
            share_from_data(one.sigma, float(levels.slab[one.candidate])),
        )
        for one, chance in found
    )  # fmt: skip
    values = state.values[family.variable]
    shared = sum((sets[0].amount(c) * members[:, c] for c in sets[0].chosen
                  if kinds[c] != "magnet"), np.zeros(len(own)))  # fmt: skip
    size = float(np.sum(values**2))
    left = values - shared
    instead = tuple(
        Instead(one.probability, tuple(
            (names[c], one.amount(c), float(np.sqrt(one.variance(c))))
            for c, square in zip(one.chosen, levels.squares(one.chosen), strict=True)
            if square >= MIN_CHI2
        ))
        for one in sets[1 : SHOWN + 1] if one.probability > 1 - DEFAULT.mass
    )  # fmt: skip
    return CommonFactors(
        common_factors,
        instead,
        1 - float(np.sum(left**2)) / size if size else 0.0,
        rms(left),
        between,
    )


class Candidates(NamedTuple):
    """All candidates for a common factor.

    Attributes:
        kinds, names: see `MAKES`.
        members: 1 for each magnet that shares it, [magnet, candidate].
        families: whether it is a family of several magnets, whatever its kind.
    """

    kinds: tuple[str, ...]
    names: tuple[str, ...]
    members: Array
    families: Flags


def weighed(
    information: Array, pull: Array, among: Candidates, single: Array
) -> tuple[float, FactorModel, list[LikelySet]]:
    """Return the scatter of families by the marginal likelihood, and the sets of common factors.

    If families differ by no more than their magnets, an outlier family is a common factor like
    others. If each family has its own calibration, all families are in every set, with their
    scatter as prior; otherwise the errors of numbers that many of them share would be too small. A
    magnet without a family is its own family.

    Args:
        information: J^T W J of the gradients, nuisances integrated out, [magnet, magnet].
        pull: J^T W y at zero gradients, [magnet].
        among: the candidates.
        single: covariance of the scatter of single magnets, [magnet, magnet].

    Returns:
        Rms of families about what they share, relative, 0 if they are alike; the model of all
        candidates; and the probable sets of them.
    """
    cost = np.array([COST[kind] for kind in among.kinds])
    families, others = np.flatnonzero(among.families), np.flatnonzero(~among.families)
    alone = np.diag(1.0 - np.minimum(among.members[:, families].sum(axis=1), 1.0))

    def levels(at: Indices, between: float) -> FactorModel:
        share = among.members[:, families] * between
        scatter = single + share @ share.T + between**2 * alone
        slab = np.full(len(at), max(USUAL, between))
        return FactorModel(information, pull, among.members[:, at], scatter, slab, cost[at])

    alike = levels(np.arange(len(cost)), 0.0)
    best, known = (
        0.0,
        alike.background + alike.log_evidence(alike.choose(MAX_CHOSEN)) + DEFAULT.behind,
    )
    for between in BETWEEN if len(families) >= FEW else ():
        tried = levels(others, between)
        evidence = tried.background + tried.log_evidence(tried.choose(MAX_CHOSEN))
        if evidence > known:
            best, known = between, evidence
    if not best:
        return 0.0, alike, likely_sets(alike, MAX_CHOSEN)
    slab = np.full(len(cost), max(USUAL, best))
    slab[families] = best
    whole = FactorModel(information, pull, among.members, single + best**2 * alone, slab, cost)
    sets = []
    for one in likely_sets(levels(others, best), MAX_CHOSEN):
        chosen = (*(int(others[c]) for c in one.chosen), *families.tolist())
        sets.append(LikelySet(chosen, one.probability, *whole.fitted(chosen)))
    return best, whole, sets


# --- candidates -----------------------------------------------------------------------------------
def candidates(ring: Ring, own: Sequence[tuple[Element, ...]]) -> Candidates:
    """Return all groups of a ring's magnets that may share an error; each group has one name.

    Args:
        ring: with the magnets.
        own: the magnets, each with its pieces.
    """
    kinds: list[str] = []
    names: list[str] = []
    columns: list[Array] = []
    families: list[bool] = []

    def add(kind: str, name: str, members: Array) -> None:
        if members.sum() < (1 if kind == "magnet" else 2):
            return
        same = [i for i, column in enumerate(columns) if (members == column).all()]
        if same:
            families[same[0]] |= kind == "family"
            return
        kinds.append(kind)
        names.append(name)
        columns.append(members)
        families.append(kind == "family")

    focusing = np.array([float(pieces[0].k1 > 0) for pieces in own])
    add("all", "all quadrupoles", np.ones(len(own)))
    add("focusing", "all focusing quadrupoles", focusing)
    add("focusing", "all defocusing quadrupoles", 1 - focusing)
    stems, by_stem = supplied_alike(ring)
    for name, members in zip(stems, by_stem.T, strict=True):
        add("family", name, members)
    groups = [pieces[0].family.casefold() for pieces in own]
    for name in dict.fromkeys(groups):
        add("family", name, np.array([float(group == name) for group in groups]))
    for name, members in _regions(ring, own):
        add("region", name, members)
        add("region", f"{name}, focusing", members * focusing)
        add("region", f"{name}, defocusing", members * (1 - focusing))
    for length in sorted({_length(pieces) for pieces in own}):
        alike = np.array([float(_length(pieces) == length) for pieces in own])
        add("type", f"quadrupoles of {length:g} m", alike)
    for i, pieces in enumerate(own):
        add("magnet", pieces[0].name, np.eye(len(own))[i])
    return Candidates(tuple(kinds), tuple(names), np.array(columns).T, np.array(families))


def _length(pieces: Sequence[Element]) -> float:
    return round(sum(e.length for e in pieces), 3)


def _regions(ring: Ring, own: Sequence[tuple[Element, ...]]) -> list[tuple[str, Array]]:
    """Arcs and straights, all of them and single ones."""
    bends = np.array([e.s for e in ring.elements if e.kind == "bend"])
    if len(bends) < 3:
        return []
    ways = np.diff(np.append(bends, bends[0] + ring.length))
    long = np.flatnonzero(ways > GAP * np.median(ways))
    if not 0 < len(long) < len(ways) / 2:
        return []
    s = np.array([pieces[0].s for pieces in own])
    low, high = bends[long], bends[long] + ways[long]
    within = [((s > a) & (s < b)) | (s + ring.length < b) for a, b in zip(low, high, strict=True)]
    straight = np.any(within, axis=0)
    found = [("arcs", np.where(straight, 0.0, 1.0)), ("straights", straight.astype(float))]
    for inside, a, b in zip(within, low, high, strict=True):
        found.append((f"straight at s = {((a + b) / 2) % ring.length:.0f} m", inside.astype(float)))
    for start, end in zip(high, np.append(low[1:], low[0] + ring.length), strict=True):
        inside = ((s > start) & (s < end)) | (s + ring.length < end) & (s + ring.length > start)
        inside &= ~straight
        middle = ((start + end) / 2) % ring.length
        found.append((f"arc at s = {middle:.0f} m", inside.astype(float)))
    return found
