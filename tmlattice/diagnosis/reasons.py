"""Few reasons behind many gradient errors: one scale, focusing, regions, types, families, magnets.

>>> found = explain_gradients(fit.state)
>>> [(own.kind, own.name, own.amount, own.amount_sigma) for own in found.reasons]

A dense fit ends in an error of every quadrupole. Here the same readings are asked which few numbers
that many magnets share explain them: candidates of every level are weighed by evidence
(`inference.levels`), with the scatter of single magnets, as the fit has learnt it, in every error.
Single magnets that stay far off all the same are flagged, with the neighbours they pull against.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tmlattice.diagnosis.fields import QuadrupoleGradient
from tmlattice.diagnosis.magnets import families, magnets
from tmlattice.diagnosis.rounds import linear, marginal
from tmlattice.diagnosis.state import State
from tmlattice.diagnosis.stated import of_readings, of_sizes
from tmlattice.inference.levels import Levels
from tmlattice.inference.normal import solve
from tmlattice.lattice import Element, Ring

Array = NDArray[np.float64]

USUAL = 1e-2
"""Prior rms of a shared error, relative."""
LEAST_SCATTER = 1e-4
"""Relative: no two magnets are more alike."""
TOLERANCE = 0.02
"""Relative: no sound magnet is further from its family."""
MOST = 20
"""Reasons at most: more are no explanation."""
AGAINST = 0.4
"""Correlation from which magnets pull against each other."""
SHOWN = 3
"""Neighbours that are named."""
GAP = 2.5
"""Times the usual way between two bends that makes a straight."""
COST = {"all": 0.0, "focusing": 1.0, "region": 1.0, "type": 1.0, "family": 1.0, "magnet": 3.0}
"""Log odds against a reason of each kind, beside those of how many there are."""
MAKES = {
    "all": "the beam's energy is other than the magnets' by as much with the other sign, or all "
    "gradients are calibrated so: the response does not part the two",
    "focusing": "the calibration of one polarity: its supplies, or the tunes were set so",
    "region": "one supply, or one setting, of the magnets there; or the beam's orbit and fringe "
    "fields there are not the model's",
    "type": "the calibration or the fringe field of this type of magnet",
    "family": "their supply: its current, its calibration curve, or a wrong setting in the lattice "
    "file",
    "magnet": "this magnet alone: a shorted turn, a wrong tap, or a field beside it that the "
    "lattice does not have",
}
"""What would make a reason of each kind."""


@dataclass(frozen=True)
class Reason:
    """One number that many magnets share, or one magnet.

    Attributes:
        kind: see `MAKES`.
        name: of what shares it.
        members: the magnets, by their first pieces.
        amount, amount_sigma: relative change of the gradients, with the scatter of single magnets
            in the error.
        statistic: chi-square that it explains beside all the others.
        makes: what would make it.
        rivals: what the data do not exclude in its place, with probabilities.
    """

    kind: str
    name: str
    members: tuple[str, ...]
    amount: float
    amount_sigma: float
    statistic: float
    makes: str
    rivals: tuple[tuple[str, float], ...]

    def as_json(self) -> dict[str, Any]:
        """As it stands in the diagnosis."""
        rivals = [{"name": name, "probability": p} for name, p in self.rivals]
        return {**vars(self), "members": list(self.members), "rivals": rivals}


@dataclass(frozen=True)
class Outlier:
    """A magnet further from its reasons than magnets are.

    Attributes:
        element: its first piece.
        amount, amount_sigma: relative, beyond what it shares.
        against: neighbours that it pulls against: name, amount and correlation.
    """

    element: str
    amount: float
    amount_sigma: float
    against: tuple[tuple[str, float, float], ...]

    def as_json(self) -> dict[str, Any]:
        """As it stands in the diagnosis."""
        against = [{"element": n, "amount": a, "correlation": c} for n, a, c in self.against]
        return {**vars(self), "against": against}


@dataclass(frozen=True)
class Reasons:
    """What is behind the gradients.

    Attributes:
        reasons: by falling chi-square.
        outliers: by falling size.
        share: of the gradients' mean square, that the reasons hold.
        scatter: rms of single magnets about them, relative.
    """

    reasons: tuple[Reason, ...]
    outliers: tuple[Outlier, ...]
    share: float
    scatter: float

    def as_json(self) -> dict[str, Any]:
        """As it stands in the diagnosis."""
        return {
            "reasons": [own.as_json() for own in self.reasons],
            "outliers": [own.as_json() for own in self.outliers],
            "share": self.share,
            "scatter": self.scatter,
        }


def explain_gradients(state: State) -> Reasons | None:
    """The few reasons behind the gradients of a dense fit; None where none were fitted."""
    family = QuadrupoleGradient()
    if family.variable not in state.values:
        return None
    there = linear(state, 0)
    information, pull = marginal(there, [family.variable])
    own = magnets(state.data.ring, ("quadrupole",), True)
    kinds, names, members = candidates(state.data.ring, own)
    known = state.groups.get(family.name)
    scatter = max(LEAST_SCATTER if known is None else known.rms, LEAST_SCATTER)
    posterior = solve(there.normal, there.groups, there.start, rounds=0)
    rows = there.where[family.variable]
    spread = posterior.spread[rows]
    covariance = spread @ posterior.covariance @ spread.T
    # what the stated errors have more than the posterior's is no scatter of the magnets; but it is
    # in every error as that is
    plain = np.maximum(np.diag(covariance), 1e-24)
    wider = of_readings(state, 0, there, posterior)[rows] / np.sqrt(plain)
    sizes = of_sizes(state, 0, there)[rows]
    more = np.sqrt(np.maximum(wider**2 - 1, 0))
    beside = scatter**2 * np.eye(len(own)) + covariance * np.outer(more, more) + sizes @ sizes.T
    covariance = covariance * np.outer(wider, wider) + sizes @ sizes.T
    sigma = np.sqrt(np.maximum(np.diag(covariance), 1e-24))
    levels = Levels(
        information,
        pull,
        members,
        beside,
        np.full(len(names), USUAL),
        np.array([COST[kind] for kind in kinds]),
    )
    found = levels.reasons(levels.choose(MOST))
    places = [pieces[0].name for pieces in own]
    reasons = tuple(
        Reason(
            kinds[one.candidate], names[one.candidate],
            tuple(places[i] for i in np.flatnonzero(members[:, one.candidate])),
            one.amount, one.sigma, one.statistic, MAKES[kinds[one.candidate]],
            tuple((names[c], p) for c, p in one.rivals[1:]),
        )
        for one in found
    )  # fmt: skip
    values = state.values[family.variable]
    shared = sum((one.amount * members[:, one.candidate] for one in found
                  if kinds[one.candidate] != "magnet"), np.zeros(len(own)))  # fmt: skip
    size = float(np.sum(values**2))
    left = values - shared
    return Reasons(
        reasons,
        _outliers(places, left, values, sigma, covariance / np.outer(sigma, sigma)),
        1 - float(np.sum(left**2)) / size if size else 0.0,
        float(np.sqrt(np.mean(left**2))),
    )


def _outliers(
    places: Sequence[str], left: Array, values: Array, sigma: Array, correlation: Array
) -> tuple[Outlier, ...]:
    found = []
    for i in np.flatnonzero(np.abs(left) - sigma > TOLERANCE).tolist():
        other = np.argsort(-np.abs(correlation[i]))
        pulls = [int(j) for j in other if j != i and abs(correlation[i, j]) > AGAINST][:SHOWN]
        against = tuple((places[j], float(values[j]), float(correlation[i, j])) for j in pulls)
        found.append(Outlier(places[i], float(left[i]), float(sigma[i]), against))
    return tuple(sorted(found, key=lambda one: -abs(one.amount)))


# --- what may share an error ----------------------------------------------------------------------
def candidates(
    ring: Ring, own: Sequence[tuple[Element, ...]]
) -> tuple[list[str], list[str], Array]:
    """Kinds, names and members [magnet, candidate] of all that may share an error.

    Args:
        ring: where the magnets stand.
        own: the magnets, each with its pieces.
    """
    kinds: list[str] = []
    names: list[str] = []
    columns: list[Array] = []

    def add(kind: str, name: str, members: Array) -> None:
        fewest = 1 if kind == "magnet" else 2
        new = not any((members == column).all() for column in columns)
        if members.sum() >= fewest and new:
            kinds.append(kind)
            names.append(name)
            columns.append(members)

    focusing = np.array([float(pieces[0].k1 > 0) for pieces in own])
    add("all", "all quadrupoles", np.ones(len(own)))
    add("focusing", "all focusing quadrupoles", focusing)
    add("focusing", "all defocusing quadrupoles", 1 - focusing)
    for name, members in _regions(ring, own):
        add("region", name, members)
        add("region", f"{name}, focusing", members * focusing)
        add("region", f"{name}, defocusing", members * (1 - focusing))
    stems, by_stem = families([pieces[0].name for pieces in own])
    for length in sorted({_length(pieces) for pieces in own}):
        alike = np.array([float(_length(pieces) == length) for pieces in own])
        add("type", f"quadrupoles of {length:g} m", alike)
    for name, members in zip(stems, by_stem.T, strict=True):
        add("family", name, members)
    groups = [pieces[0].family.casefold() for pieces in own]
    for name in dict.fromkeys(groups):
        add("family", name, np.array([float(group == name) for group in groups]))
    for i, pieces in enumerate(own):
        add("magnet", pieces[0].name, np.eye(len(own))[i])
    return kinds, names, np.array(columns).T


def _length(pieces: Sequence[Element]) -> float:
    return round(sum(e.length for e in pieces), 3)


def _regions(ring: Ring, own: Sequence[tuple[Element, ...]]) -> list[tuple[str, Array]]:
    """Arcs and straights, all of them and one by one."""
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
