"""What was exchanged on one of two days: pairs of correctors, or of monitors.

>>> measured, data, before = all_right(partial(response_data, ring), measured, 0.2)
>>> since(before, after, said)

The first day is held against the design, the second one against the first.
"""

from collections.abc import Callable

import numpy as np

from tmlattice.diagnosis.response.exchanged import PutRight, righted, told
from tmlattice.diagnosis.response.state import begin
from tmlattice.diagnosis.response.strangers import strangers
from tmlattice.measurement import OrbitResponse
from tmlattice.observe.response_data import ResponseData
from tmlattice.observe.split import split_columns


def all_right(
    made: Callable[[OrbitResponse], ResponseData], measured: OrbitResponse, holdout: float
) -> tuple[OrbitResponse, ResponseData, PutRight]:
    """A measurement with exchanged pairs of correctors and monitors put right, what was made of it,
    and which these are.

    Args:
        made: readings in a model, of a measurement.
        measured: as it was read.
        holdout: share of the correctors that are held out.
    """
    known = PutRight([], {}, {}, [])
    while True:
        data = made(measured)
        state = begin(data, split_columns(data, holdout, np.random.default_rng(0)))
        right = righted(state, measured, known, strangers(state), ())
        if right is None:
            return measured, data, known
        measured = right[0]


def since(first: PutRight, second: PutRight, said: list[str]) -> PutRight:
    """Pairs that were exchanged on one of two days; those of both are added to what is `said`."""
    found = []
    for what, a, b in (
        ("correctors", first.correctors, second.correctors),
        ("monitors", first.monitors, second.monitors),
    ):
        before = {frozenset(pair): pair for pair in a}
        now = {frozenset(pair): pair for pair in b}
        if both := [pair for key, pair in now.items() if key in before]:
            said.append(f"on both days {told(both, what)}")
        alone = {pair: a[pair] for key, pair in before.items() if key not in now}
        found.append(alone | {pair: b[pair] for key, pair in now.items() if key not in before})
    return PutRight([], found[0], found[1], [])
