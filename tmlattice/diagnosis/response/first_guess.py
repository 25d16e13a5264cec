"""The start of a hierarchical fit, if the design is far from the ring.

Gauss-Newton converges if phase errors are a fraction of a turn. From another working point it may
converge to a ring that matches one plane only. There, focusing and defocusing quadrupoles are
scanned together, and the fit starts at the best match.
"""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import product
from typing import NamedTuple

import numpy as np

from tmlattice.arrays import TINY, Array
from tmlattice.diagnosis.families.fields import QuadrupoleGradient
from tmlattice.diagnosis.families.steps import Trial
from tmlattice.diagnosis.response.state import State, allow, begin
from tmlattice.errors import UnstableRingError
from tmlattice.lattice.supplies import magnets
from tmlattice.observe.response_data import ResponseData, Split

log = logging.getLogger(__name__)

FAR = 0.25
"""Unexplained share of the typical column's mean square, in the worse plane, above which the design
is far from the ring. Usual rings have a tenth of that."""
BETTER = 0.5
"""Largest ratio of that share at another start to that of the design."""
STEPS = np.arange(-3, 4) * 0.01
"""Relative changes that are tried."""


def begun(design: State, trials: Sequence[Trial]) -> State:
    """Return the design, or the ring of the first guess, with a number for each quadrupole: numbers
    of no family would return to zero.

    Args:
        design: without families.
        trials: to be fitted; without quadrupole gradients the result is the design.
    """
    family = QuadrupoleGradient()
    if not any(own.name == family.name for trial in trials for own in trial):
        return design
    guess = first_guess(design)
    return design if guess is None else allow(replace(design, values=guess.values), [family])


class Guess(NamedTuple):
    """A start that matches the readings better than the design.

    Attributes:
        focusing, defocusing: relative change of all such quadrupoles.
        values: the same, by variable.
        left: share of the typical column's mean square that is unexplained there.
    """

    focusing: float
    defocusing: float
    values: Mapping[str, Array]
    left: float


def elsewhere(data: ResponseData) -> Guess | None:
    """Return the first guess by all readings."""
    split = Split(held=np.zeros(len(data.orbits), dtype=bool), half=np.ones(data.shape, dtype=bool))
    return first_guess(begin(data, split))


def first_guess(design: State) -> Guess | None:
    """Return the start of a fit of the design; None if that is near, or nothing is better."""
    unexplained = strange(design)
    family = QuadrupoleGradient()
    if not unexplained > FAR or not family.size(design.data):
        return None
    start = allow(design, [family])
    own = magnets(design.data.ring, ("quadrupole",), True)
    focusing = np.array([pieces[0].k1 > 0 for pieces in own])
    best, found = BETTER * unexplained, None
    for f, d in product(STEPS, STEPS):
        values = {family.variable: np.where(focusing, f, d)}
        try:
            left = strange(start.moved(values))
        except UnstableRingError:
            continue
        if left < best:
            best, found = left, Guess(float(f), float(d), values, left)
            log.info("focusing %+.2g, defocusing %+.2g: %.2g of the typical column's square is "
                     "unexplained, %.2g by the design", f, d, left, unexplained)  # fmt: skip
    return found


def strange(state: State, least: int = 1) -> float:
    """Return the unexplained share of the typical column's mean square, given its kick.

    Args:
        state: with the model's readings; of both planes the worse one counts.
        least: fewest columns of a plane.
    """
    data = state.data
    read, orbits = data.pick(state.at.read)[:-1], data.pick(data.orbits)[:-1]
    seen = np.isfinite(orbits) & state.fitted[:-1, None] & state.good
    u, d = np.where(seen, read, 0.0), np.where(seen, orbits, 0.0)
    size = (d**2).sum(axis=1)
    kick = np.maximum((u * d).sum(axis=1) / np.maximum((u**2).sum(axis=1), TINY), 0.0)
    left = ((d - kick[:, None] * u) ** 2).sum(axis=1)
    shares = [
        np.median(left[rows] / size[rows])
        for rows in ((data.plane[:-1] == p) & (size > 0) for p in (0, 1))
        if rows.sum() >= least
    ]
    return float(max(shares, default=0.0))
