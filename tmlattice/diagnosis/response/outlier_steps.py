"""Steps of correctors, and single readings, that went wrong, by what a fit leaves of them: they are
not fitted, and judge nobody.

>>> readings, steps = outlier_steps(state)
>>> odd = readings.and_more(steps)
>>> state = beside(state, odd.unread)
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
"""Share of a step's readings, and more than one, from which they are not single ones."""
GAINS = "monitor_gain"
"""The family of monitors' gains."""


@dataclass(frozen=True)
class OutlierSteps:
    """What went wrong.

    Attributes:
        unread: which readings are not used, [column, monitor, plane that is read].
        said: sentences of them.
    """

    unread: Flags
    messages: tuple[str, ...] = ()

    def and_more(self, *others: "OutlierSteps") -> "OutlierSteps":
        """With others."""
        unread, messages = self.unread, self.messages
        for own in others:
            unread, messages = unread | own.unread, (*messages, *own.messages)
        return OutlierSteps(unread, messages)


def outlier_steps(state: State) -> tuple[OutlierSteps, OutlierSteps]:
    """Single readings that went wrong; and steps whose readings belong to no orbit, and those with
    another kick in them: none where too few are left to fit and to judge.

    Args:
        state: with all families; without monitors' gains nothing is told, for these break triples
            and leave kicks, too.
    """
    data, split = state.data, state.split
    nothing = np.zeros(data.orbits.shape, dtype=bool)
    if not state.allows(GAINS):
        return OutlierSteps(nothing), OutlierSteps(nothing)
    # beside a far lattice a column may have begun with a calibration that it has not, and with the
    # third order of that
    state = bend(jump(state, beyond=1.0))
    alone = gross(data, _beside_own_kick(state))
    read = np.isfinite(data.orbits).sum(axis=(1, 2))
    many = np.maximum(MANY * read, 1)
    alone[alone.sum(axis=(1, 2)) > many] = False  # the step went wrong, not single readings
    state = beside(state, alone)
    broken = inconsistent(state)
    alone[broken] = False  # among all the others
    single = OutlierSteps(alone, tuple(told_gross(data, alone, "the fit")))
    names = data.measured.correctors
    swapped = {name for pair in swaps(state) for name in pair}  # to be put right, not left out
    others = [
        own
        for own in spurious_kicks(state)
        if not broken[own.column] and names[own.column] not in swapped
    ]
    unread = np.zeros((len(data.plane), 2), dtype=bool) | broken[:, None]
    for own in others:
        unread[own.column, own.plane] = True
        if own.plane == data.plane[own.column]:  # its own kick is not known either
            unread[own.column] = True
    unread[left_in_plane(state, [own.column for own in others])] = True
    gone = unread.all(axis=1)
    if not all((own & ~gone).any() for own in (split.held, split.inner, state.fitted)):
        return single, OutlierSteps(nothing)
    whole = np.broadcast_to(unread[:, None], nothing.shape)
    return single, OutlierSteps(whole, (*_torn(data, broken), *_kicked(state, others)))


def _beside_own_kick(state: State) -> Array:
    """What is left with the kick that each column's readings have, for held-out ones have not been
    fitted, m, [column, monitor, 2]: the one of least absolute deviations, of which a few wrong
    readings move nothing."""
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
        "correctors at whose steps monitors next to one another contradict each other, as if some "
        f"had been read before the beam had settled, left out: {', '.join(names)}; measure these "
        "again, and wait longer"
    ]


def _kicked(state: State, others: list[SpuriousKick]) -> list[str]:
    if not others:
        return []
    names, layers = state.data.measured.correctors, state.at.model.maps.layers
    told = ", ".join(
        f"{names[own.column]} ({1e6 * own.amount:+.2g} µrad in {'xy'[own.plane]}, as from "
        f"{layers[own.layer]})"
        for own in others
    )
    return [
        "something else kicked the beam while these correctors were stepped (where is known up to "
        f"half betatron oscillations): {told}; these readings are left out; look for a supply that "
        "jumps, and measure them again"
    ]


def beside(state: State, flags: Flags) -> State:
    """A state as if nobody had taken these readings, [column, monitor, 2]: columns that have none
    are fitted nowhere, judge nothing, and have no numbers of their own."""
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
