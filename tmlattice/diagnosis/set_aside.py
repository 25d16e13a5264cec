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

from tmlattice.diagnosis.rounds import settle
from tmlattice.diagnosis.state import State
from tmlattice.diagnosis.weights import good_monitors, sound_monitors

log = logging.getLogger(__name__)

HOPELESS = 20.0
"""Of the median rms residual: no magnet's error does that to a sound monitor, once all families are
there."""


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
    log.info("neighbours set aside: %s, sound in the end: %s",
             np.flatnonzero(together), np.flatnonzero(sound & together))  # fmt: skip
    if not (sound & good).sum() > state.good.sum():
        return state
    return settle(replace(trial, good=sound & good))
