"""All usual distributed errors of a ring in an orbit response, with their prior scales.

>>> state = small_errors(data, split, fit.state)
>>> sizes_in(linear(state, 0))

They are the background model of a fault: the families of a hierarchical fit, and the closed orbit
in sextupoles. All readings are fitted; of held-out correctors the half of the BPMs that
determines their kicks. Priors are Gaussian, and the largest number of a family is omitted from its
scale, because it may be the fault.
"""

import logging
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.special import ndtri

from tmlattice.arrays import Array, Flags
from tmlattice.diagnosis.assessment import MISSING
from tmlattice.diagnosis.families.dispersion import HorizontalOrbit, VerticalOrbit
from tmlattice.diagnosis.families.family import Family
from tmlattice.diagnosis.families.fields import (
    FamilyGradient,
    OtherGradient,
    QuadrupoleGradient,
    SkewGradient,
)
from tmlattice.diagnosis.families.steps import (
    CorrectorCalibration,
    CorrectorRoll,
    MonitorGain,
    MonitorRoll,
)
from tmlattice.diagnosis.response.linear import Linear
from tmlattice.diagnosis.response.rounds import LEARN, log_evidence, settle
from tmlattice.diagnosis.response.state import State, allow, begin, bend, jump
from tmlattice.diagnosis.response.stepwise import ROUGH, fit_chi2
from tmlattice.effects import find
from tmlattice.errors import TmlatticeError
from tmlattice.inference.normal import solve
from tmlattice.inference.priors import SMALLEST, Group
from tmlattice.observe.orbit_response import Errors, Predicted
from tmlattice.observe.response_data import ResponseData
from tmlattice.observe.split import Split

log = logging.getLogger(__name__)

USUAL: tuple[Family, ...] = (
    CorrectorCalibration(), FamilyGradient(), MonitorGain(), QuadrupoleGradient(), OtherGradient(),
    MonitorRoll(), CorrectorRoll(), SkewGradient(), HorizontalOrbit(), VerticalOrbit(),
)  # fmt: skip
"""Families of every ring."""
ANEW = 20_000
"""Most readings for a second fit, from the design, because the given one may be of a wrong ring."""
SHARED = {
    "vertical_focusing": "vertical_focusing",
    "quadrupole_gradient of families": "quadrupole_gradient",
    "corrector_calibration of families": "corrector_calibration",
}
"""Groups of few numbers, in which the usual scale counts as `COUNTS` further numbers."""
COUNTS = 4


def small_errors(data: ResponseData, split: Split, fitted: State) -> State:
    """Return the fit of the distributed errors to all readings outside the validation set.

    Args:
        data, split: the data, and the validation split.
        fitted: a hierarchical fit of the data.
    """
    data = _near(data, split)
    none = np.zeros_like(split.held)
    split_of_all = Split(none, none, _halves(split), np.zeros_like(split.inner_rf))
    design = replace(begin(data, split_of_all), good=fitted.good, exploring=False)
    families = _families(design, fitted.families)
    continued = _from(design, families, fitted)
    few = data.orbits.size <= ANEW
    found: list[tuple[float, State]] = []
    for start in (allow(design, families), continued) if few else (continued,):
        try:
            state = settle(jump(start, beyond=1.0), gain=ROUGH)
            state = settle(bend(state))
        except (TmlatticeError, np.linalg.LinAlgError):  # diverged
            continue
        found.append((log_evidence(state, state.good), state))
        log.info("distributed errors: evidence %.1f", found[-1][0])
        if all(own.ratio**2 < MISSING for own in fit_chi2(state)[:2]):
            break
    return max(found, key=lambda one: one[0])[1] if found else continued


def _near(data: ResponseData, split: Split) -> ResponseData:
    """The data without the validation readings of held-out correctors."""
    far = split.held[:-1, None] & ~split.half[:-1]
    orbits = data.orbits.copy()
    orbits[:-1][far] = np.nan
    return replace(data, orbits=orbits)


def _halves(split: Split) -> Flags:
    """BPMs that determine a corrector's kick; the others validate it. Of held-out correctors these
    are half of the remaining ones."""
    half = split.half.copy()
    for column in np.flatnonzero(split.held):
        half[column, np.flatnonzero(half[column])[::2]] = False
    return half


def _families(design: State, more: Sequence[Family]) -> list[Family]:
    """Usual families, and those accepted in the fit."""
    names = [family.name for family in USUAL]
    known = [*USUAL, *(family for family in more if family.name not in names)]
    return [f for f in known if design.reads(f.block) and f.size(design.data)]


def _from(design: State, families: Sequence[Family], fitted: State) -> State:
    """The state of the hierarchical fit."""
    at = Predicted(design.data, Errors.none(design.data), fitted.at.bent)
    state = replace(design, at=at, lacking=fitted.lacking, groups=fitted.groups)
    state = allow(state, families)
    return state.moved({**state.values, **{k: v for k, v in fitted.values.items()
                                           if k in state.values}})  # fmt: skip


# --- prior scales ---------------------------------------------------------------------------
def sizes_in(there: Linear) -> tuple[Group, ...]:
    """Return the priors of a fit with scales from all numbers but each family's largest."""
    groups = [replace(group, each=None, freedom=np.inf) for group in there.groups]
    pull = there.normal.vector + there.normal.matrix @ there.start
    for _ in range(LEARN):
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
    """The mean square without the largest, corrected for that omission."""
    n = len(squares)
    if group.fixed or not n:
        return group
    if group.name in SHARED:
        usual = find(SHARED[group.name]).background or SMALLEST
        mean = (squares.sum() - squares.max() + COUNTS * usual**2) / (n - 1 + COUNTS)
    elif n < 3:
        mean = float(squares.mean())
    else:
        expected = float(ndtri(0.5 / n)) ** 2  # expectation of the largest of n
        without = (squares.sum() - squares.max()) / max(n - expected, 1.0)
        mean = min(float(squares.mean()), float(without))
    return replace(group, rms=max(float(np.sqrt(mean)), SMALLEST))
