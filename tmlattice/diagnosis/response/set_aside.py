"""Monitors that were set aside, and may be sound: neighbours, where the ring itself is wrong.

A monitor that reads what no other one makes likely is bad. But so seem all that stand beside a
magnet that is far off, before it is found; and once they are set aside nothing is left that could
find it. A broken monitor stands alone. So neighbours that were set aside together are taken back,
the fit settles with them, and they stay if they fit then. (Pohang: two monitors beside a quadrupole
that is 18 % off; whether they were set aside hung on who was held out.)
"""

import logging
from dataclasses import replace

import numpy as np

from tmlattice.diagnosis.response.rounds import log_evidence, settle
from tmlattice.diagnosis.response.state import State
from tmlattice.diagnosis.response.weights import good_monitors, sound_monitors

log = logging.getLogger(__name__)

HOPELESS = 20.0
"""Of the median rms residual: no magnet's error does that to a sound monitor, once all families are
there."""
WORTH = 0.5
"""Log evidence that the others may lose for each of their readings: what one standard error is."""


def taken_back(state: State) -> State:
    """With neighbours that fit once they are fitted; else as it stands.

    Args:
        state: that has settled.
    """
    aside = ~state.good & good_monitors(state, HOPELESS)
    together = aside & (np.roll(aside, 1) | np.roll(aside, -1))
    if not together.any():
        return state
    good = state.good | together
    trial = settle(replace(state, good=good), look_at_monitors=False)
    sound = sound_monitors(trial)
    back = together & sound
    lost = log_evidence(state, state.good, state.independent) - log_evidence(
        trial, state.good, state.independent
    )
    orbits = state.data.pick(state.data.orbits)[state.fitted]
    readings = int(np.isfinite(orbits[:, back]).sum())
    log.info("neighbours set aside: %s, sound in the end: %s; the others lose %.1f",
             np.flatnonzero(together), np.flatnonzero(back), lost)  # fmt: skip
    if not back.any() or (state.good & ~sound).any() or lost > WORTH * readings:
        return state
    return settle(replace(trial, good=state.good | back))
