"""Rejected channels: BPMs, in one plane or both, and correctors that the model cannot describe.

A BPM plane with another one's signal, or noise, biases the validation; its other plane may be good.
The model explains almost nothing of such a channel, whatever its gain, but most of all others.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tmlattice.diagnosis.response.state import State
from tmlattice.measurement import OrbitResponse

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

STRANGE, TIMES = 0.5, 9.0
"""Least unexplained share of a rejected channel's mean square; its least ratio to the typical."""
ODD = 0.05
"""Least unexplained share of a channel that may be swapped."""
ENOUGH = 4
"""Fewest readings for a test."""
SILENT = 0.3
"""Share of the model's response below which a channel is weak, not rejected."""
MOST = 0.25
"""Largest share of rejected BPMs or correctors of a plane: more of them mean another lattice."""


@dataclass(frozen=True)
class RejectedChannels:
    """Rejected channels.

    Attributes:
        monitors: names, with the plane.
        correctors: names.
    """

    monitors: tuple[tuple[str, str], ...] = ()
    correctors: tuple[str, ...] = ()

    @property
    def any(self) -> bool:
        """Whether there are any."""
        return bool(self.monitors or self.correctors)

    @property
    def messages(self) -> tuple[str, ...]:
        """The messages about them."""
        found = []
        if self.monitors:
            sentence = ", ".join(f"{name} in {plane}" for name, plane in self.monitors)
            found.append(f"BPM channels that the model cannot describe, rejected: {sentence}")
        if self.correctors:
            sentence = ", ".join(self.correctors)
            found.append(f"correctors that the model cannot describe, rejected: {sentence}")
        return tuple(found)

    def without(self, measured: OrbitResponse) -> OrbitResponse:
        """The measurement without them."""
        gone = set(self.correctors)
        kept = measured.select([name for name in measured.correctors if name not in gone])
        response, rf = kept.response.copy(), kept.rf
        orbit = None if rf is None or rf.orbit is None else rf.orbit.copy()
        for name, plane in self.monitors:
            m, p = kept.monitors.index(name), "xy".index(plane)
            response[:, m, p] = np.nan
            if orbit is not None:
                orbit[m, p] = np.nan
        return replace(kept, response=response, rf=None if rf is None else replace(rf, orbit=orbit))


def reversed_ones(state: State) -> list[str]:
    """A message about BPMs and correctors with the wrong sign by the fit."""
    errors, measured = state.at.errors, state.data.measured
    gains = np.diagonal(errors.monitors, axis1=1, axis2=2)
    messages = []
    for what, names in (
        ("BPMs that read", [
            f"{measured.monitors[m]} in {'xy'[p]}"
            for m, p in np.argwhere((gains < 0) & state.good[:, None])
        ]),
        ("correctors that kick", [
            measured.correctors[c] for c in np.flatnonzero(errors.kick[:-1] < 0)
        ]),
    ):  # fmt: skip
        if names:
            messages.append(f"{what} with the wrong sign: {', '.join(names)}")
    return messages


def unlike_model(state: State, least: float = STRANGE) -> RejectedChannels:
    """Return the rejected channels among the readings in each column's own plane.

    Args:
        state: with the model's readings.
        least: least unexplained share of the mean square of a rejected channel.
    """
    data = state.data
    read, orbits = data.pick(state.at.read)[:-1], data.pick(data.orbits)[:-1]
    monitors: list[tuple[str, str]] = []
    correctors: list[str] = []
    for p in (0, 1):
        rows = np.flatnonzero(data.plane[:-1] == p)
        if not len(rows):
            continue
        there = np.isfinite(orbits[rows]) & state.good
        bad = _unlike(read[rows], orbits[rows], there, least)
        monitors += [(data.measured.monitors[m], "xy"[p]) for m in np.flatnonzero(bad)]
        odd = _unlike(read[rows].T, orbits[rows].T, (there & ~bad).T, least)
        correctors += [data.measured.correctors[rows[c]] for c in np.flatnonzero(odd)]
    return RejectedChannels(tuple(monitors), tuple(correctors))


def _unlike(model: Array, read: Array, there: Flags, least: float) -> Flags:
    """Of each column of [reading, one]: whether no multiple of the model explains it."""
    u, d = np.where(there, model, 0.0), np.where(there, read, 0.0)
    size = (d**2).sum(axis=0)
    gain = (u * d).sum(axis=0) / np.maximum((u**2).sum(axis=0), 1e-300)
    share = ((d - gain * u) ** 2).sum(axis=0) / np.maximum(size, 1e-300)
    # a weak response is described by a calibration or a gain
    seen = (there.sum(axis=0) >= ENOUGH) & (size > SILENT**2 * (u**2).sum(axis=0))
    if seen.sum() < ENOUGH:
        return np.zeros(len(share), dtype=bool)
    strange = seen & (share > max(least, TIMES * float(np.median(share[seen]))))
    return strange if strange.sum() <= MOST * seen.sum() else np.zeros_like(strange)
