"""What a response does not say, and what is taken instead; in sentences.

>>> warnings = assumed_of(measured, response_data(ring, measured))
"""

import numpy as np

from tmlattice.measurement import OrbitResponse
from tmlattice.observe.response_data import ResponseData
from tmlattice.observe.response_noise import OVERSTATED, stated_and_estimated

UNDERSTATED = 2.0
"""So many times the stated noise is told, where the readings show it."""


def assumed_of(measured: OrbitResponse, data: ResponseData) -> list[str]:
    """What the measurement does not say, and what is taken instead."""
    messages = []
    if measured.noise is None or np.isnan(measured.noise).any():
        x, y = (f"{1e6 * size:.2g} µm" for size in np.median(data.noise, axis=0))
        messages.append(
            f"the noise of the readings is not stated; from what neighbouring monitors leave it is "
            f"{x} in x and {y} in y (a jitter of the beam is not in it)"
        )
    else:
        messages += _misstated(data)
    rf = data.measured.rf
    if rf is None or rf.orbit is None:
        copied = measured.rf is not None and measured.rf.orbit is not None
        why = (
            "the RF step's orbit repeats to the last digit, or is the design's own: it is a "
            "model's and no measurement, and is left out"
            if copied
            else "there is no RF step"
        )
        messages.append(
            f"{why}: dispersion is not known, and only what is usual tells the scale of all "
            "correctors from that of all monitors"
        )
    for plane in (p for p in "xy" if p not in measured.planes):
        messages.append(
            f"no corrector kicks in {plane}: what acts in that plane alone is not known"
        )
    for p, plane in enumerate("xy"):
        own = data.orbits[:-1][data.plane[:-1] == p, :, p]
        if len(own) and not np.isfinite(own).any():
            messages.append(f"no monitor reads {plane}: what acts in that plane alone is not known")
    if not np.isfinite(data.pick(data.orbits, 1)[:-1]).any():
        messages.append(
            "no corrector is read in the other plane: rolls and skew gradients are not known"
        )
    return messages


def _misstated(data: ResponseData) -> list[str]:
    """Where the readings scatter by far more, or less, than the noise that is stated."""
    both = stated_and_estimated(data.ring, data.measured)
    if both is None:
        return []
    messages = []
    for plane, own, seen in zip("xy", *both, strict=True):
        but = (
            f"the noise in {plane} is stated as {1e6 * own:.2g} µm, but neighbouring monitors "
            f"leave {1e6 * seen:.2g} µm of each other's readings"
        )
        if seen > UNDERSTATED * own:
            messages.append(f"{but}: chi-square is as much too large")
        elif own > OVERSTATED * seen:
            messages.append(f"{but}: it is too large, or a jitter of the beam")
    return messages
