"""The start of a hierarchical fit, if the design is far from the ring.

Gauss-Newton converges from phase errors of a fraction of a turn. From another working point it
converges to a ring that matches one plane only. There, focusing and defocusing quadrupoles are
scanned together, and the fit starts at the best match.
"""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tmlattice.diagnosis.families.fields import QuadrupoleGradient
from tmlattice.diagnosis.families.steps import Trial
from tmlattice.diagnosis.response.state import State, allow, begin
from tmlattice.errors import UnstableRingError
from tmlattice.lattice.supplies import magnets
from tmlattice.observe.response_data import ResponseData
from tmlattice.observe.split import Split

Array = NDArray[np.float64]

log = logging.getLogger(__name__)

FAR = 0.25
"""Share of the typical column's mean square, in the worse plane, from which on the design is far:
half of its size. Usual rings leave a tenth of that."""
BETTER = 0.5
"""Largest ratio of that share at another start to that of the design."""
STEPS = np.arange(-3, 4) * 0.01
"""Relative changes that are tried."""


def begun(design: State, trials: Sequence[Trial]) -> State:
    """The design, or the ring that resembles the readings more, with each quadrupole's gradient a
    number of its own from the first: one of no family would else go back to nothing.

    Args:
        design: with no families yet.
        trials: that will be fitted; without quadrupoles' gradients it is the design.
    """
    family = QuadrupoleGradient()
    if not any(own.name == family.name for trial in trials for own in trial.families):
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
    """The first guess by all readings."""
    nobody, everybody = (np.full(data.shape, own) for own in (False, True))
    split = Split(held=nobody[:, 0], inner=nobody[:, 0], half=everybody, inner_rf=nobody[0])
    return first_guess(begin(data, split))


def first_guess(design: State) -> Guess | None:
    """Return the start of a fit; None where the design is near enough, or nothing is better.

    Args:
        design: with no families yet.
    """
    stands = strange(design)
    family = QuadrupoleGradient()
    if not stands > FAR or not family.size(design.data):
        return None
    start = allow(design, [family])
    own = magnets(design.data.ring, ("quadrupole",), True)
    focusing = np.array([pieces[0].k1 > 0 for pieces in own])
    best, found = BETTER * stands, None
    for f, d in product(STEPS, STEPS):
        values = {family.variable: np.where(focusing, f, d)}
        try:
            left = strange(start.moved(values))
        except UnstableRingError:
            continue
        if left < best:
            best, found = left, Guess(float(f), float(d), values, left)
            log.info("focusing %+.2g, defocusing %+.2g: %.2g of the typical column's square left, "
                     "%.2g by the design", f, d, left, stands)  # fmt: skip
    return found


def strange(state: State, least: int = 1) -> float:
    """Return the unexplained share of the typical column's mean square, each with its own kick, of
    the worse plane.

    Args:
        state: what the model makes of the readings.
        least: columns of a plane required for the typical one.
    """
    data = state.data
    read, orbits = data.pick(state.at.read)[:-1], data.pick(data.orbits)[:-1]
    seen = np.isfinite(orbits) & state.fitted[:-1, None] & state.good
    u, d = np.where(seen, read, 0.0), np.where(seen, orbits, 0.0)
    size = (d**2).sum(axis=1)
    kick = np.maximum((u * d).sum(axis=1) / np.maximum((u**2).sum(axis=1), 1e-300), 0.0)
    left = ((d - kick[:, None] * u) ** 2).sum(axis=1)
    shares = [
        np.median(left[rows] / size[rows])
        for rows in ((data.plane[:-1] == p) & (size > 0) for p in (0, 1))
        if rows.sum() >= least
    ]
    return float(max(shares, default=0.0))
