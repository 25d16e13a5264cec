"""Swapped correctors or BPMs on one of two days.

>>> measured, data, before = all_right(partial(response_data, ring), measured, 0.2)
>>> since(before, after, messages)

The first day is compared with the design, the second one with the first.
"""

from collections.abc import Callable

import numpy as np

from tmlattice.diagnosis.response.state import begin
from tmlattice.diagnosis.response.swaps import Swaps, labels_corrected, swap_message
from tmlattice.diagnosis.response.unlike_model import unlike_model
from tmlattice.measurement import OrbitResponse
from tmlattice.observe.response_data import ResponseData
from tmlattice.observe.split import split_columns


def all_right(
    made: Callable[[OrbitResponse], ResponseData], measured: OrbitResponse, holdout: float
) -> tuple[OrbitResponse, ResponseData, Swaps]:
    """Return a measurement with swapped pairs corrected, its data, and these pairs.

    Args:
        made: returns the data of a measurement, with the model to compare with.
        measured: the measurement.
        holdout: share of the correctors that are held out.
    """
    known = Swaps([], {}, {}, [])
    while True:
        data = made(measured)
        state = begin(data, split_columns(data, holdout, np.random.default_rng(0)))
        right = labels_corrected(state, measured, known, unlike_model(state), ())
        if right is None:
            return measured, data, known
        measured = right[0]


def since(first: Swaps, second: Swaps, messages: list[str]) -> Swaps:
    """Return the pairs swapped on one of two days; `messages` are extended about those of both."""
    found = []
    for what, a, b in (
        ("correctors", first.correctors, second.correctors),
        ("monitors", first.monitors, second.monitors),
    ):
        before = {frozenset(pair): pair for pair in a}
        now = {frozenset(pair): pair for pair in b}
        if both := [pair for key, pair in now.items() if key in before]:
            messages.append(f"on both days {swap_message(both, what)}")
        alone = {pair: a[pair] for key, pair in before.items() if key not in now}
        found.append(alone | {pair: b[pair] for key, pair in now.items() if key not in before})
    return Swaps([], found[0], found[1], [])
