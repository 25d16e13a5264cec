"""Outlier steps and outlier readings of a fit: they are neither fitted nor used for validation.

>>> readings, steps = outlier_steps(state)
>>> readings.and_more(steps).messages
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tmlattice.diagnosis.response.inconsistent_steps import inconsistent
from tmlattice.diagnosis.response.outlier_readings import gross, told_gross
from tmlattice.diagnosis.response.spurious_kicks import SpuriousKick, left_in_plane, spurious_kicks
from tmlattice.diagnosis.response.state import State, bend, jump
from tmlattice.diagnosis.response.swaps import swaps
from tmlattice.observe.response_data import ResponseData

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

MANY = 0.1
"""Share of a step's readings above which, if more than one, its outliers are no single readings."""
GAINS = "monitor_gain"
"""The family of BPM gains."""


@dataclass(frozen=True)
class OutlierSteps:
    """Rejected readings.

    Attributes:
        unread: which readings are rejected, [column, monitor, plane that is read].
        messages: about them.
    """

    unread: Flags
    messages: tuple[str, ...] = ()

    def and_more(self, *others: "OutlierSteps") -> "OutlierSteps":
        """Return these together with others."""
        unread, messages = self.unread, self.messages
        for own in others:
            unread, messages = unread | own.unread, (*messages, *own.messages)
        return OutlierSteps(unread, messages)


def outlier_steps(state: State) -> tuple[OutlierSteps, OutlierSteps]:
    """Return outlier readings; and inconsistent steps together with those of spurious kicks.

    No step is rejected if too few columns would remain for the fit and its validation.

    Args:
        state: with all families. Without BPM gains nothing is rejected, because unknown gains look
            like inconsistencies and like kicks.
    """
    data, split = state.data, state.split
    nothing = np.zeros(data.orbits.shape, dtype=bool)
    if not state.allows(GAINS):
        return OutlierSteps(nothing), OutlierSteps(nothing)
    # if the lattice is far from the ring, a column may have started with a wrong calibration, and
    # with the third order of its kick
    state = bend(jump(state, beyond=1.0))
    alone = gross(data, _beside_own_kick(state))
    read = np.isfinite(data.orbits).sum(axis=(1, 2))
    many = np.maximum(MANY * read, 1)
    alone[alone.sum(axis=(1, 2)) > many] = False  # the step is the outlier
    state = beside(state, alone)
    broken = inconsistent(state)
    alone[broken] = False  # rejected with their step
    single = OutlierSteps(alone, tuple(told_gross(data, alone, "the fit")))
    names = data.measured.correctors
    swapped = {name for pair in swaps(state) for name in pair}  # corrected, not rejected
    others = [
        own
        for own in spurious_kicks(state)
        if not broken[own.column] and names[own.column] not in swapped
    ]
    unread = np.zeros((len(data.plane), 2), dtype=bool) | broken[:, None]
    for own in others:
        unread[own.column, own.plane] = True
        if own.plane == data.plane[own.column]:  # its own kick is unknown
            unread[own.column] = True
    unread[left_in_plane(state, [own.column for own in others])] = True
    gone = unread.all(axis=1)
    if not all((own & ~gone).any() for own in (split.held, split.inner, state.fitted)):
        return single, OutlierSteps(nothing)
    whole = np.broadcast_to(unread[:, None], nothing.shape)
    return single, OutlierSteps(whole, (*_torn(data, broken), *_kicked(state, others)))


def _beside_own_kick(state: State) -> Array:
    """Residuals given each column's own kick, because held-out columns are not fitted, m, [column,
    monitor, 2]. The kick minimises the absolute deviations, which is robust against outliers."""
    data, read = state.data, state.at.read
    model, orbits = data.pick(read), data.pick(data.orbits)
    kick = np.ones(len(model))
    for c, (u, d) in enumerate(zip(model, orbits, strict=True)):
        use = np.isfinite(d) & state.good & (u != 0)
        ratio, size = (d[use] / u[use]), np.abs(u[use])
        order = np.argsort(ratio)
        half = np.searchsorted(np.cumsum(size[order]), size.sum() / 2)
        kick[c] = ratio[order][half] if use.any() else 1.0
    return np.asarray(data.orbits - kick[:, None, None] * read)


def _torn(data: ResponseData, columns: Flags) -> list[str]:
    names = [data.measured.correctors[c] for c in np.flatnonzero(columns)]
    if not names:
        return []
    return [
        "inconsistent steps, at which neighbouring BPMs contradict one another as if some had been "
        f"read before the orbit settled, rejected: {', '.join(names)}; measure these correctors "
        "again, and wait longer after each step"
    ]


def _kicked(state: State, others: list[SpuriousKick]) -> list[str]:
    if not others:
        return []
    names, layers = state.data.measured.correctors, state.at.model.maps.layers
    kicks = ", ".join(
        f"{names[own.column]} ({1e6 * own.amount:+.2g} µrad in {'xy'[own.plane]}, as behind "
        f"{layers[own.layer]})"
        for own in others
    )
    return [
        "spurious kicks during the steps of correctors (their positions are known up to half "
        f"betatron oscillations): {kicks}; these readings are rejected; look for a power supply "
        "that jumps, and measure these correctors again"
    ]


def beside(state: State, flags: Flags) -> State:
    """Return the state without some readings, [column, monitor, 2]. Columns without readings are
    neither fitted nor used for validation, and their own numbers are zero."""
    if not flags.any():
        return state
    data = state.data
    orbits = np.where(flags, np.nan, data.orbits)
    measured = replace(data.measured, response=orbits[:-1].copy())
    data = replace(data, orbits=orbits, measured=measured)
    gone = flags.all(axis=(1, 2))
    split = replace(state.split, held=state.split.held & ~gone, inner=state.split.inner & ~gone)
    values = dict(state.values)
    for family in state.families:
        if family.per == "column":
            values[family.variable] = np.where(gone, 0.0, values[family.variable])
    return replace(state, data=data, split=split).moved(values)
