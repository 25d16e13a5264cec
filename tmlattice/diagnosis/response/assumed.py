"""Messages about quantities that a response does not state, and the assumptions instead.

>>> warnings = assumed_of(measured, response_data(ring, measured))
"""

import numpy as np

from tmlattice.inference.judgement import MISSTATED
from tmlattice.measurement import OrbitResponse
from tmlattice.observe.noise import stated_and_estimated
from tmlattice.observe.response_data import ResponseData


def assumed_of(measured: OrbitResponse, data: ResponseData) -> list[str]:
    """Return messages about missing quantities of a measurement, and the assumptions instead."""
    messages = []
    if measured.noise is None or np.isnan(measured.noise).any():
        x, y = (f"{1e6 * size:.2g} µm" for size in np.median(data.noise, axis=0))
        messages.append(
            f"the noise of the readings is not stated; the residuals between neighbouring BPMs "
            "give "
            f"{x} in x and {y} in y (without beam jitter)"
        )
    else:
        messages += _misstated(data)
    rf = data.measured.rf
    if rf is None or rf.orbit is None:
        copied = measured.rf is not None and measured.rf.orbit is not None
        why = (
            "the RF step's orbit repeats to the last digit, or is the design's own: it is "
            "simulated, not measured, and is rejected"
            if copied
            else "there is no RF step"
        )
        messages.append(
            f"{why}: the dispersion is unknown, and only the priors separate the scale of all "
            "correctors from that of all BPMs"
        )
    for plane in (p for p in "xy" if p not in measured.planes):
        messages.append(
            f"no corrector kicks in {plane}: errors that act in that plane alone are unknown"
        )
    for p, plane in enumerate("xy"):
        own = data.orbits[:-1][data.plane[:-1] == p, :, p]
        if len(own) and not np.isfinite(own).any():
            messages.append(
                f"no BPM reads {plane}: errors that act in that plane alone are unknown"
            )
    if not np.isfinite(data.pick(data.orbits, 1)[:-1]).any():
        messages.append(
            "no corrector is read in the other plane: rolls and skew gradients are unknown"
        )
    return messages


def _misstated(data: ResponseData) -> list[str]:
    """Messages about stated noise that the readings contradict."""
    both = stated_and_estimated(data.ring, data.measured)
    if both is None:
        return []
    messages = []
    for plane, own, seen in zip("xy", *both, strict=True):
        but = (
            f"the noise in {plane} is stated as {1e6 * own:.2g} µm, but the residuals "
            f"between neighbouring BPMs are {1e6 * seen:.2g} µm"
        )
        if seen > MISSTATED * own:
            messages.append(f"{but}: chi-square is as much too large")
        elif own > MISSTATED * seen:
            messages.append(f"{but}: the stated noise is too large, or includes beam jitter")
    return messages
