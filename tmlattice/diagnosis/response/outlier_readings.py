"""Single readings that stick out of what a response's fit leaves: they count less, and are named.

One monitor may read one corrector's step wrongly, by fifty times its noise, and be sound else: such
readings are few, and their squares most of the misfit. In the last fit they weigh as if their noise
were as large as makes them five times it, and no more.
"""

import warnings
from collections import Counter
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from tmlattice.diagnosis.response.state import State
from tmlattice.measurement import OrbitResponse
from tmlattice.observe.orbit_response import Errors, Predicted
from tmlattice.observe.response_data import ResponseData

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

GROSS = 20.0
"""So many times what the design, or a fit, leaves of the typical reading, both of its corrector and
of its monitor, no error of a ring makes of one reading alone: it went wrong."""
OUT = 5.0
"""A reading sticks out from so many times what is left of its column's typical one."""
LEAST = 6
"""Readings of the RF's orbit that say what is usual of them."""
NAMED = 3
"""Monitors and correctors that are named."""
MANY = 8
"""Readings of the RF's orbit that are named."""
OFTEN = 2
"""Readings of one monitor, or corrector, from which it is named."""
_MAD = 1.4826  # of a Gaussian


def without_gross(measured: OrbitResponse, data: ResponseData) -> tuple[OrbitResponse, list[str]]:
    """The measurement without single readings that went wrong, and a sentence of them.

    Held-out correctors have such readings too, and a few of them make up all that the judges see.

    Args:
        measured: the response.
        data: the same, as the ring has it.
    """
    wrong = gross(data, data.orbits - Predicted(data, Errors.none(data)).read)
    if not wrong.any():
        return measured, []
    response = data.measured.response.copy()
    response[wrong[:-1]] = np.nan
    return replace(data.measured, response=response), told_gross(data, wrong, "the design")


def gross(data: ResponseData, left: Array) -> Flags:
    """Readings of the correctors that went wrong, by what something leaves of them, [column,
    monitor, 2].

    Args:
        data: the response.
        left: m, NaN where nothing was read, [column, monitor, 2].
    """
    gap, plane = np.abs(left[:-1]), data.plane[:-1]
    wrong = np.zeros(left.shape, dtype=bool)
    for kicked, read in ((0, 0), (0, 1), (1, 0), (1, 1)):
        rows = np.flatnonzero(plane == kicked)
        own = gap[rows, :, read]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # what was not read at all
            column, monitor = (np.nanmedian(own, axis=k, keepdims=True) for k in (1, 0))
        usual = np.fmax(np.fmax(column, monitor), data.noise[:, read])
        wrong[rows, :, read] = np.nan_to_num(own) > GROSS * _MAD * usual
    return wrong


def told_gross(data: ResponseData, wrong: Flags, what: str) -> list[str]:
    """A sentence of readings that went wrong, where there are any.

    Args:
        data: the response.
        wrong: which, [column, monitor, 2].
        what: they differ from.
    """
    if not wrong.any():
        return []
    columns, monitors, _ = np.nonzero(wrong)
    names = data.measured
    most = _most(Counter(names.monitors[i] for i in monitors.tolist()),
                 Counter(names.correctors[i] for i in columns.tolist()))  # fmt: skip
    return [
        f"single readings that differ from {what} by {GROSS:g} times what is usual of their "
        f"corrector and of their monitor, left out: {len(columns)}{most}"
    ]


def _most(*tables: Counter[str]) -> str:
    """Who has most of them."""
    most = [
        f"{name} ({own})"
        for table in tables
        for name, own in table.most_common(NAMED)
        if own >= OFTEN
    ]
    return f"; most at {', '.join(most)}" if most else ""


def robust(state: State) -> State:
    """Every reading has a weight of its own from here on."""
    return replace(state, share=np.ones((2, *state.data.shape)))


def rf_shares(state: State, block: int, left: Array) -> Array:
    """By which each reading of the RF's orbit counts, [block, monitor]: it is one orbit, and a few
    of its readings that went wrong (0 where nothing was read, say) make kicks and energies of it.

    Args:
        state: that is fitted.
        block: 0 in-plane, 1 coupling.
        left: what the fit leaves of it, m, NaN where nothing is fitted, [monitor].
    """
    own = np.ones((2, len(left))) if state.rf_share is None else state.rf_share.copy()
    if np.isfinite(left).sum() >= LEAST:
        typical = _MAD * float(np.nanmedian(np.abs(left)))
        pull = np.nan_to_num(np.abs(left) / np.maximum(state.data.noise_of(block)[-1], typical))
        own[block] = (OUT / np.maximum(pull, OUT)) ** 4
    return own


def shares(state: State, block: int, left: Array) -> Array:
    """By which each reading of the correctors counts; the RF's have shares of their own.

    Args:
        state: that is fitted.
        block: 0 in-plane, 1 coupling.
        left: what the fit leaves, m, NaN where nothing is fitted, [column but the RF, monitor].
    """
    assert state.share is not None
    out = state.share.copy()
    pull = np.nan_to_num(np.abs(_pulls(state, block, left)))
    out[block, :-1] = (OUT / np.maximum(pull, OUT)) ** 2
    return out


def _pulls(state: State, block: int, left: Array) -> Array:
    """In units of what is left of the column's typical reading, or of the noise if that is more."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # columns that are not fitted
        typical = _MAD * np.nanmedian(np.abs(left), axis=1)
    return np.asarray(left / np.fmax(state.data.noise_of(block)[:-1], typical[:, None]))


def outlier_readings(state: State) -> list[str]:
    """Sentences of those that stick out of a result, where there are any."""
    if state.share is None:
        return []
    messages = _odd_rf(state)
    measured, monitors, correctors = state.data.measured, Counter[str](), Counter[str]()
    count = total = 0
    for block in (0, 1):
        left = np.where(state.fitted[:, None] & state.good, state.data.pick(state.at.left, block),
                        np.nan)[:-1]  # fmt: skip
        out = np.nan_to_num(np.abs(_pulls(state, block, left))) > OUT
        count, total = count + int(out.sum()), total + int(np.isfinite(left).sum())
        monitors.update(measured.monitors[i] for i in np.nonzero(out)[1])
        correctors.update(measured.correctors[i] for i in np.nonzero(out)[0])
    if not count:
        return messages
    return [
        *messages,
        f"{count} of {total} readings stick out by more than {OUT:g} times what is left of their "
        f"corrector's typical one, and count little{_most(monitors, correctors)}.",
    ]


def _odd_rf(state: State) -> list[str]:
    """A sentence of the RF's readings that count little."""
    if state.rf_share is None:
        return []
    odd = np.flatnonzero((state.rf_share < 1).any(axis=0) & state.good)
    if not len(odd):
        return []
    names = ", ".join(state.data.measured.monitors[i] for i in odd[:MANY])
    more = f" and {len(odd) - MANY} more" if len(odd) > MANY else ""
    return [
        f"readings of the RF's orbit that stick out of it by more than {OUT:g} times what is usual "
        f"of it, and count next to nothing: {names}{more}."
    ]
