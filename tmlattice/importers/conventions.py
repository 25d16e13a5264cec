"""Conventions of a measured response, determined by comparison with the design's response.

The data checks (`diagnosis.data_checks`) find a wrong sign, unit or order everywhere. Here each
corrector and each BPM is compared with the design's, and the data decide whether the RF frequency
or the momentum was constant. Nothing is corrected.
"""

from dataclasses import dataclass, replace

import numpy as np

from tmlattice.arrays import Array
from tmlattice.beam.closed_orbit import ResponseModel
from tmlattice.diagnosis.data_checks import check_data
from tmlattice.errors import MeasurementError, UnstableRingError
from tmlattice.importers.imported import counted
from tmlattice.lattice import Ring
from tmlattice.measurement import OrbitResponse
from tmlattice.observe.compared import NEAR, OfResponse, ratio

MOST = 0.7
"""Correlation with the design's, of the typical corrector, from which single ones can be found: on
ten real rings it is 0.93 or more, and 0.8 with two of sixteen monitors exchanged."""
ODD = 0.6
"""Correlation below which a single one is rejected; of random columns of sixteen monitors
one in seventy has more."""
SURE = 0.95
"""Correlation above which it is another's: neighbours a tenth of a wave apart have 0.8."""
CLEARER = 1.02
"""Ratio of what two models leave, above which the data separate them: on ten real rings a fixed
frequency leaves 1.04 to 11 times less than a fixed momentum."""
ROUNDS = 5


@dataclass(frozen=True)
class Plane:
    """What the correctors of one plane do in that plane.

    Attributes:
        plane: "x" or "y".
        correctors, monitors: names.
        measured, design: orbit changes, m, [corrector, monitor], 0 where nothing was read.
        readings: their number.
    """

    plane: str
    correctors: list[str]
    monitors: tuple[str, ...]
    measured: Array
    design: Array
    readings: int

    def alike(self) -> Array:
        """Correlation of what each monitor read with the design's at each, over the correctors,
        [monitor, monitor]; 0 for one that read nothing."""
        return _correlation(self.measured.T, self.design.T)

    def columns(self) -> Array:
        """Correlation of each corrector's orbit with the design's, [corrector]."""
        return np.diagonal(_correlation(self.measured, self.design))


def compared(ring: Ring, measured: OrbitResponse) -> tuple[list[str], list[str]]:
    """What the data confirm and what they contradict, given the design's response; a sentence each
    (ring: the design, with the measurement's names)."""
    try:
        contradicted = [check.sentence for check in check_data(ring, measured).reported]
        contradicted += _per_kick(OfResponse(ring, replace(measured, rf=None)))
        model, flat = ResponseModel.of(ring), ResponseModel.of(ring, dimension=4)
    except UnstableRingError as error:
        return [], [f"the lattice has no closed orbit to compare with ({error})"]
    confirmed: list[str] = []
    for plane in dict.fromkeys(measured.planes):
        own = _plane(model, measured, plane)
        if abs(np.median(own.columns())) < MOST:
            continue
        contradicted += _single(own)
        if plane != "x":
            continue
        # with gains free: was the frequency or the momentum constant?
        left, other = (1e6 * _left(fit) for fit in (own, _plane(flat, measured, plane)))
        what = f"with gains free, {left:.3g} µm are left in x, and {other:.3g} at a fixed momentum"
        if left < other / CLEARER:
            confirmed.append(f"the data agree that the frequency stood still: {what}")
        elif other < left / CLEARER:
            contradicted.append(f"the momentum stood still, and not the frequency: {what}")
    return confirmed, contradicted


def _per_kick(checked: OfResponse) -> list[str]:
    """A hint where the orbits are the design's for a kick of one unit, and not for the steps."""
    try:
        read, made, _ = checked.pairs(checked.data)
    except MeasurementError:  # reported already
        return []
    stated = ratio(read, made)
    for unit, kick in (("mrad", 1e-3), ("rad", 1.0)):
        steps = np.abs(checked.data.kicks[:, None, None]) / kick
        other = ratio(read * steps, made)
        if abs(np.log(abs(other))) < NEAR < abs(np.log(abs(stated))):
            return [
                f"the orbits are {stated:.3g} times the design's for the steps, and {other:.3g} "
                f"times for a kick of 1 {unit}: give orbit changes, not the response per {unit}"
            ]
    return []


def _plane(model: ResponseModel, measured: OrbitResponse, plane: str) -> Plane:
    index = {name: i for i, name in enumerate(model.monitors)}
    at = [index[model.ring[name].name] for name in measured.monitors]
    columns = [i for i, own in enumerate(measured.planes) if own == plane]
    names = [measured.correctors[i] for i in columns]
    p = int(plane == "y")
    read = measured.response[columns, :, p]
    made = model.response(names)[:, at, p] * measured.kicks[columns, None]
    there = np.isfinite(read)
    read, made = (np.where(there, orbits, 0.0) for orbits in (read, made))
    return Plane(plane, names, measured.monitors, read, made, int(there.sum()))


def _correlation(a: Array, b: Array) -> Array:
    """Of rows with rows, about zero; 0 for a row of zeros."""
    size = np.outer(*(np.sqrt((rows**2).sum(axis=1)) for rows in (a, b)))
    return np.asarray(a @ b.T / np.where(size > 0, size, np.inf))


def _single(own: Plane) -> list[str]:
    """Correctors and monitors of opposite sign, without correlation, or with swapped labels."""
    sign = np.sign(np.median(own.columns()))
    monitors = own.alike() * sign
    said = []
    for what, names, alike in (
        ("correctors", own.correctors, own.columns() * sign),
        ("BPMs", list(own.monitors), np.diagonal(monitors)),
    ):
        for is_such, how in (
            (alike < -ODD, "have the sign against the others"),
            ((alike != 0) & (np.abs(alike) <= ODD), "do not correlate with the design"),
        ):
            which = [names[k] for k in np.flatnonzero(is_such)]
            if 0 < len(which) < len(names) / 4:
                said.append(f"single {what} of {own.plane} {how}: {counted(which)}")
    odd = np.flatnonzero((np.diagonal(monitors) < ODD) & own.measured.any(axis=0))
    said += [
        f"BPMs '{own.monitors[i]}' and '{own.monitors[k]}' read each other's {own.plane}"
        for i in odd
        for k in odd
        if i < k and min(monitors[i, k], monitors[k, i]) > SURE
    ]
    return said


def _left(own: Plane) -> float:
    """rms that a gain for each corrector and each monitor leaves, over what was read, m."""
    m, d = own.measured, own.design
    gain, turned = np.ones(m.shape[1]), d
    for _ in range(ROUNDS):
        scaled = d * gain
        turned = d * _slope(m, scaled, 1)[:, None]
        gain = _slope(m, turned, 0)
    return float(np.sqrt(((m - turned * gain) ** 2).sum() / max(own.readings, 1)))


def _slope(m: Array, d: Array, axis: int) -> Array:
    size = (d**2).sum(axis=axis)
    return np.asarray((m * d).sum(axis=axis) / np.where(size > 0, size, np.inf))
