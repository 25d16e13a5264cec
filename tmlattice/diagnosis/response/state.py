"""The state of a hierarchical fit of an orbit response, and the functions that change it.

Everything that is fitted is one frozen `State`; each function returns another one.
"""

import logging
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, TypeVar
from weakref import ref

import numpy as np

from tmlattice.arrays import Array, Flags, Reals, rms
from tmlattice.diagnosis.families.family import Family
from tmlattice.effects import Hypothesis, find
from tmlattice.errors import UnstableRingError
from tmlattice.inference import chi2
from tmlattice.inference.judgement import FEW
from tmlattice.inference.priors import SCALE_SPREAD, Group
from tmlattice.observe.orbit_response import Errors, Predicted
from tmlattice.observe.response_data import ResponseData, Split

log = logging.getLogger(__name__)

Made = TypeVar("Made")

ALONE = 0.3
"""Ratio to which a column's misfit falls by its own number if it has no other significant error."""


@dataclass(frozen=True, eq=False)
class Candidate:
    """A candidate for a single fault. Once detected, its numbers have a prior of their own, so that
    it does not change the scale of their family.

    Attributes:
        cause: effect and place.
        block: 0 in-plane, 1 coupling; None: both, by its signature.
        variable: of its numbers.
        members: the numbers for a unit of its amount, [number].
    """

    cause: Hypothesis
    block: int | None = None
    variable: str = ""
    members: Array = field(default_factory=lambda: np.zeros(0))

    @property
    def name(self) -> str:
        """The name of its prior."""
        return f"alone: {self.cause[0]} {self.cause[1]}"

    @property
    def wide(self) -> float:
        """Prior rms of its amount."""
        return find(self.cause[0]).largest

    @property
    def unit(self) -> Array:
        """Its amount is the product of its numbers and this, [number]."""
        return np.asarray(self.members / (self.members @ self.members))


class Kept(NamedTuple):
    """Derivatives of the readings by a variable of the ring, with the `Family.causes`, and with
    the gains and scales of the columns."""

    rows: Reals  # [number, column, monitor]
    causes: tuple[Hypothesis, ...]
    gain: Array  # [column, monitor]
    scale: Array  # [column]


@dataclass(frozen=True, eq=False)
class State:
    """The state of the fit.

    Attributes:
        data, split: the data, and the validation split.
        at: the model's readings with the values.
        lacking: model discrepancy in-plane and coupling, rms of each column, m, [block, column]. It
            reduces weights like noise, so that one misplaced corrector does not bias the gradients.
        good: BPMs that are not bad, [monitor].
        families: that are fitted.
        values: of the numbers, by variable.
        groups: the families' priors with learnt scales, by name.
        kept: of each block the ring and the derivatives there by the ring's variables, used until
            the ring has moved; latest: other results, and the state of each. Caches that all states
            of a fit share.
        share: factors on the weights, less for outliers, [block, column, monitor].
        robust: whether outliers among the correctors' readings have less weight, too.
        apart: detected single faults.
        independent: effective sample size as a share of the readings, see `independent`, [block,
            plane that is read]; None: all 1.
        jitter: orbits of beam jitter, of typical amplitude, m, [plane that is read, pattern,
            monitor]; None: no jitter.
        guessed: rms of the logarithm of a prior scale about its first guess.
        unneeded: rejected families. Their numbers are zero, but their uncertainty is in the stated
            errors (for the ring's families of few numbers).
        undetermined: of a change: d reading / d undetermined error of its reference, m,
            [error, column, monitor, 2]; None: without these.
    """

    data: ResponseData
    split: Split
    at: Predicted
    lacking: Array
    share: Array
    good: Flags
    families: tuple[Family, ...] = ()
    values: Mapping[str, Array] = field(default_factory=dict)
    groups: Mapping[str, Group] = field(default_factory=dict)
    kept: dict[int, tuple[Mapping[str, Array], dict[str, Kept]]] = field(default_factory=dict)
    latest: dict[Hashable, tuple[Any, Any]] = field(default_factory=dict)
    robust: bool = False
    apart: tuple[Candidate, ...] = ()
    independent: Array | None = None
    jitter: Array | None = None
    guessed: float = SCALE_SPREAD
    unneeded: tuple[Family, ...] = ()
    undetermined: Array | None = None

    def once(self, key: Hashable, made: Callable[[], Made]) -> Made:
        """What is made of this state; made anew, the last one freed, if that was of another."""
        if key not in self.latest or self.latest[key][0]() is not self:
            self.latest.pop(key, None)
            self.latest[key] = (ref(self), made())
        result: Made = self.latest[key][1]
        return result

    def of_block(self, block: int) -> tuple[Family, ...]:
        """Families of a block."""
        return tuple(family for family in self.families if family.block == block)

    def reads(self, block: int) -> bool:
        """Whether fitted correctors have readings in a block."""
        orbits = self.data.pick(self.data.orbits, block)
        return bool(np.isfinite(orbits[self.fitted][:, self.good]).any())

    def allows(self, name: str) -> bool:
        """Whether a family is in the fit."""
        return any(family.name == name for family in self.families)

    def has_fitted(self, name: str) -> bool:
        """Whether a family is in the fit and has numbers that are not all zero."""
        return any(own.name == name and self.values[own.variable].any() for own in self.families)

    @property
    def fitted(self) -> Flags:
        """Fitted correctors, [column]; of the RF's column the BPMs are split instead."""
        out = ~self.split.held
        out[-1] = False
        return out

    def moved(self, values: Mapping[str, Array]) -> "State":
        """The state with other values, and the model's readings with them."""
        errors = Errors.none(self.data)
        for family in {f.variable: f for f in self.families}.values():
            errors = family.put(errors, values[family.variable], self.data)
        return replace(self, values=values, at=Predicted(self.data, errors, self.at.bent))


def begin(data: ResponseData, split: Split) -> State:
    """The state of the design, with the third order of the steps."""
    at = Predicted(data, Errors.none(data), data.bent)
    gap = data.pick(at.left)[~split.held]
    size = float(chi2.typical(gap))
    return State(
        data, split, at, lacking=np.full((2, data.shape[0]), size),
        share=np.ones((2, *data.shape)), good=np.ones(data.shape[1], dtype=bool),
    )  # fmt: skip


def bend(state: State) -> State:
    """The state with the third order of the steps, if the ring stores a beam with each."""
    try:
        return replace(state, at=state.at.bend())
    except UnstableRingError:
        return state


def allow(state: State, families: Sequence[Family]) -> State:
    """The state with more families, at zero or at given values; present ones are unchanged."""
    values = {f.variable: np.zeros(f.size(state.data)) for f in families}
    begun = any(state.values.get(name, new).any() for name, new in values.items())
    begun &= not {f.variable for f in state.families} >= set(values)
    names = [family.name for family in families]
    more = [family for family in families if not state.allows(family.name)]
    state = replace(
        state, families=(*state.families, *more), values={**values, **state.values},
        unneeded=tuple(family for family in state.unneeded if family.name not in names),
    )  # fmt: skip
    return state.moved(state.values) if begun else state


def forbid(state: State, families: Sequence[Family]) -> State:
    """The state without some families; numbers of no other family return to zero."""
    names = [family.name for family in families]
    gone = {group.name for family in families for group in family.groups(state.data)}
    left = tuple(family for family in state.families if family.name not in names)
    values = {f.variable: state.values[f.variable] for f in left}
    groups = {name: group for name, group in state.groups.items() if name not in gone}
    unneeded = (*state.unneeded, *families)
    return replace(state, families=left, groups=groups, unneeded=unneeded).moved(values)


def by_columns(state: State, family: Family) -> tuple[Array, Array, Array]:
    """Return each column's own estimate of its number from its near BPMs, with the third order of
    its step, or without it where that agrees better.

    Returns:
        The change of the number, and the mean square residuals of far readings, in units of the
            noise, without and with it, [column]; NaN for held-out columns.
    """
    rows = np.asarray(family.rows(state.at, np.zeros(0)), dtype=float)
    left = state.data.pick(state.at.left, family.block)
    noise = state.data.noise_of(family.block)
    bent = state.data.pick(np.broadcast_to(state.at.bent, state.data.orbits.shape), family.block)
    bent = state.at.gain(family.block) * bent
    scale = 1 + state.at.errors.calibration[:, None]
    # a kick is (1 + calibration) (linear + bent); only in its own plane
    flat = (rows - bent, left + scale * bent) if family.block == 0 else (rows, left)
    seen = np.isfinite(left) & state.good & ~state.split.held[:, None]
    seen[-1] = False  # the RF's
    near, far = seen & state.split.half, seen & ~state.split.half
    amounts, sure = np.full((2, len(left)), np.nan)
    known = np.any(near & (rows != 0), axis=1)
    without = np.where(known, _mean_square(left / noise, far), np.nan)
    for own, read in ((rows, left), flat):
        (amount,), miss = amplitudes(own[..., None], read, near)
        mean = _mean_square(miss / noise, far)
        better = known & ~(mean >= sure)
        amounts, sure = np.where(better, [amount, mean], [amounts, sure])
    return amounts, without, sure


def _mean_square(values: Array, read: Flags) -> Array:
    """The mean square of some readings of each column, NaN without any, [column]."""
    with np.errstate(invalid="ignore"):
        return np.asarray(np.sum(np.where(read, values, 0.0) ** 2, axis=1) / read.sum(axis=1))


def by_monitors(state: State) -> Array:
    """Each BPM's own estimate of its gains relative to the present ones, x and y of each, [2 x
    monitor]: from half of the fitted columns, where the other half agrees; else 1."""
    model, orbits = (state.data.pick(own) for own in (state.at.read, state.data.orbits))
    gains = np.ones((len(state.data.at), 2))
    for p in (0, 1):
        rows = np.flatnonzero(state.fitted & (state.data.plane == p))
        for m in range(len(gains)):
            seen = rows[np.isfinite(orbits[rows, m])]
            near, far = seen[::2], seen[1::2]
            size = float(model[near, m] @ model[near, m])
            if len(far) < FEW or not size > 0:
                continue
            gain = float(model[near, m] @ orbits[near, m]) / size
            without = np.sum((orbits[far, m] - model[far, m]) ** 2)
            if np.sum((orbits[far, m] - gain * model[far, m]) ** 2) < ALONE**2 * without:
                gains[m, p] = gain
    return gains.ravel()


def jump(state: State, beyond: float | None = None) -> State:
    """The state with large numbers of single columns at their own estimates.

    Args:
        state: whose column families are checked.
        beyond: limits of the changes; None: `Family.gross`.
    """
    values = dict(state.values)
    for family in state.families:
        if family.per == "monitor" and not np.isinf(family.gross):
            gains = by_monitors(state)
            far = np.abs(gains - 1) > family.gross  # a gain of zero has no estimate
            moved = np.where(far, (1 + values[family.variable]) * (gains - 1), 0.0)
            values[family.variable] = values[family.variable] + moved
        limit = family.gross if beyond is None else beyond * family.trust
        if family.per != "column" or np.isinf(limit):
            continue
        amounts, without, sure = by_columns(state, family)
        far = state.fitted & (np.abs(amounts) > limit) & (sure < ALONE**2 * without)
        values[family.variable] = values[family.variable] + np.where(far, amounts, 0.0)
    changed = any((values[name] != state.values[name]).any() for name in values)
    return state.moved(values) if changed else state


def rms_of(values: Array) -> float:
    """Return the rms of all finite values; NaN without any."""
    return rms(values[np.isfinite(values)])


def amplitudes(patterns: Array, data: Array, near: Flags) -> tuple[Array, Array]:
    """Return the amplitudes of patterns by near readings, [pattern, ...], and the residuals of all.

    Args:
        patterns, data: m, [..., monitor, pattern] and [..., monitor].
        near: [..., monitor].
    """
    rows, right = np.where(near[..., None], patterns, 0.0), np.where(near, data, 0.0)
    size = np.abs(rows).max(axis=-2)
    size[size == 0] = 1
    rows = rows / size[..., None, :]
    rounded = np.finfo(float).eps * max(rows.shape[-2:])
    amounts = (np.linalg.pinv(rows, rcond=rounded) @ right[..., None])[..., 0] / size
    return np.moveaxis(amounts, -1, 0), data - (patterns @ amounts[..., None])[..., 0]
