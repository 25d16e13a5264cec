"""Rejected BPMs that may be sound, because a magnet next to them is wrong.

A BPM whose readings contradict all others is bad. But sound BPMs next to a magnet with a large
error look bad too, and without them the error cannot be found. A broken BPM has no rejected
neighbours. So rejected neighbours are fitted again, and kept if they agree with that fit.
"""

import logging
from dataclasses import replace

import numpy as np

from tmlattice.diagnosis.response.rounds import log_evidence, settle
from tmlattice.diagnosis.response.state import State
from tmlattice.diagnosis.response.weights import good_monitors
from tmlattice.inference.judgement import GROSS

log = logging.getLogger(__name__)


def taken_back(state: State) -> State:
    """Return the converged state with the rejected neighbours that agree with the fit."""
    aside = ~state.good & good_monitors(state, bad=GROSS)
    together = aside & (np.roll(aside, 1) | np.roll(aside, -1))
    if not together.any():
        return state
    good = state.good | together
    trial = settle(replace(state, good=good), look_at_monitors=False)
    sound = good_monitors(trial) & good_monitors(trial, 1)
    back = together & sound
    lost = log_evidence(state, state.good, state.independent) - log_evidence(
        trial, state.good, state.independent
    )
    orbits = state.data.pick(state.data.orbits)[state.fitted]
    readings = int(np.isfinite(orbits[:, back]).sum())
    # each regained reading may cost a standard error
    log.info("rejected neighbours: %s, sound: %s; evidence of the others falls by %.1f",
             np.flatnonzero(together), np.flatnonzero(back), lost)  # fmt: skip
    if not back.any() or (state.good & ~sound).any() or lost > readings / 2:
        return state
    return settle(replace(trial, good=state.good | back))
