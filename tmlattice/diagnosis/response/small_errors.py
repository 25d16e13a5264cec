"""All usual small errors of a ring as an orbit response shows them, with their sizes.

>>> state = small_errors(data, split, fit.state)
>>> sizes_in(linear(state, 0))

What a fault is weighed against. Beside the families of a dense fit there is the closed orbit that
kicks make (`orbit_modes`). Everything that was read is fitted, of held-out correctors the half of
the monitors that gives their kicks. Sizes are those of Gauss, and the largest number of a family
does not count: it may be the fault.
"""

import logging
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from tmlattice.diagnosis.families.family import Family
from tmlattice.diagnosis.families.fields import FamilyGradient, QuadrupoleGradient, SkewGradient
from tmlattice.diagnosis.families.orbit_modes import orbit_families
from tmlattice.diagnosis.families.steps import (
    CorrectorCalibration,
    CorrectorRoll,
    MonitorGain,
    MonitorRoll,
)
from tmlattice.diagnosis.response.linear import Linear
from tmlattice.diagnosis.response.rounds import log_evidence, settle
from tmlattice.diagnosis.response.state import State, allow, begin, bend, jump
from tmlattice.diagnosis.response.stepwise import ROUGH, fit_chi2
from tmlattice.effects import find
from tmlattice.errors import TmlatticeError
from tmlattice.inference.normal import solve
from tmlattice.inference.priors import SMALLEST, Group
from tmlattice.observe.orbit_response import Errors, Predicted
from tmlattice.observe.response_data import ResponseData
from tmlattice.observe.split import Split

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

log = logging.getLogger(__name__)

USUAL: tuple[Family, ...] = (
    CorrectorCalibration(), FamilyGradient(), MonitorGain(), QuadrupoleGradient(), MonitorRoll(),
    CorrectorRoll(), SkewGradient(),
)  # fmt: skip
"""Families that a ring always has."""
ANEW = 20_000
"""Readings up to which everything is also fitted from the design on: where the families alone went
astray, they hide what they made up."""
EXPLAINED = 1.5
"""Chi-square per reading of each plane at which one start is enough."""
SIZES = 12
"""Rounds of EM for the sizes."""
SHARED = {
    "vertical_focusing": "vertical_focusing",
    "quadrupole_gradient of families": "quadrupole_gradient",
    "corrector_calibration of families": "corrector_calibration",
}
"""Groups of a few numbers, and whose usual size counts as much as `COUNTS` of them."""
COUNTS = 4


def small_errors(data: ResponseData, split: Split, fitted: State) -> State:
    """Fitted to all that may be fitted.

    Args:
        data, split: what was measured, and who judges.
        fitted: a dense fit of it.
    """
    data = _near(data, split)
    nobody = np.zeros_like(split.held)
    everybody = Split(nobody, nobody, _halves(split), np.zeros_like(split.inner_rf))
    design = replace(begin(data, everybody), good=fitted.good, exploring=False)
    families = _families(design, fitted.families)
    beside = _from(design, families, fitted)
    few = data.orbits.size <= ANEW
    found: list[tuple[float, State]] = []
    for start in (allow(design, families), beside) if few else (beside,):
        try:
            state = settle(jump(bend(start), beyond=1.0), gain=ROUGH)
            state = settle(bend(state))
        except (TmlatticeError, np.linalg.LinAlgError):  # astray
            continue
        found.append((log_evidence(state, state.good), state))
        log.info("small errors: evidence %.1f", found[-1][0])
        if all(own.per_reading < EXPLAINED for own in fit_chi2(state)[:2]):
            break
    return max(found, key=lambda one: one[0])[1] if found else beside


def _near(data: ResponseData, split: Split) -> ResponseData:
    """Without the readings of held-out correctors that judge."""
    far = split.held[:-1, None] & ~split.half[:-1]
    orbits = data.orbits.copy()
    orbits[:-1][far] = np.nan
    return replace(data, orbits=orbits)


def _halves(split: Split) -> Flags:
    """Monitors that give a corrector its kick while the others say whether it is that; of held-out
    ones half of those that are read here."""
    half = split.half.copy()
    for column in np.flatnonzero(split.held):
        half[column, np.flatnonzero(half[column])[::2]] = False
    return half


def _families(design: State, more: Sequence[Family]) -> list[Family]:
    """Usual ones, and those that a fit wanted beside them."""
    known = [*USUAL, *orbit_families(design.data.ring, design.at.model)]
    names = [family.name for family in known]
    known += [family for family in more if family.name not in names]
    return [f for f in known if design.reads(f.block) and f.size(design.data)]


def _from(design: State, families: Sequence[Family], fitted: State) -> State:
    """Where the families' fit stands."""
    at = Predicted(design.data, Errors.none(design.data), fitted.at.bent)
    state = replace(design, at=at, lacking=fitted.lacking, groups=fitted.groups)
    state = allow(state, families)
    return state.moved({**state.values, **{k: v for k, v in fitted.values.items()
                                           if k in state.values}})  # fmt: skip


# --- how large they are ---------------------------------------------------------------------------
def sizes_in(there: Linear) -> tuple[Group, ...]:
    """The priors with sizes from all numbers but each family's largest.

    Args:
        there: where the fit stands.
    """
    groups = [replace(group, each=None, freedom=np.inf) for group in there.groups]
    pull = there.normal.vector + there.normal.matrix @ there.start
    for _ in range(SIZES):
        found = solve(there.normal, groups, there.start, rounds=0)
        scale = np.concatenate([group.scale for group in groups])
        amounts = found.covariance @ (found.spread.T @ pull)
        squares = (amounts**2 + np.diag(found.covariance)) * scale**2
        ends = np.cumsum([group.basis.shape[1] for group in groups])[:-1]
        groups = [
            _sized(group, own) for group, own in zip(groups, np.split(squares, ends), strict=True)
        ]
    return tuple(groups)


def _sized(group: Group, squares: Array) -> Group:
    """Of all but the largest, as much larger as that makes them smaller by chance."""
    n = len(squares)
    if group.fixed or not n:
        return group
    if group.name in SHARED:
        usual = find(SHARED[group.name]).background or SMALLEST
        mean = (squares.sum() - squares.max() + COUNTS * usual**2) / (n - 1 + COUNTS)
    elif n < 3:
        mean = float(squares.mean())
    else:
        expected = float(ndtri(0.5 / n)) ** 2  # of the largest of n
        without = (squares.sum() - squares.max()) / max(n - expected, 1.0)
        mean = min(float(squares.mean()), float(without))
    return replace(group, rms=max(float(np.sqrt(mean)), SMALLEST))
