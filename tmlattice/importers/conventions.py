"""What a measured response says of the conventions it was written down with, beside the design's.

Each column is regressed on what the design answers to the same kick, monitor by monitor: a slope
and a correlation a column. The median slope of a block is near one where signs and units are the
design's; minus one, a half, two or a thousand each has a plain reason. Nothing is mended here.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tmlattice.beam.closed_orbit import ResponseModel
from tmlattice.errors import UnstableRingError
from tmlattice.importers.imported import Array, counted
from tmlattice.lattice import Ring
from tmlattice.measurement import OrbitResponse

ALIKE = 0.6
"""Correlation of a column with the design's, above which its slope says something: on ten real
rings the median is 0.93 or more, and of random columns of twenty monitors one in 200 has 0.6."""
ODD = 0.6
"""Correlation below which a single one resembles nothing where most have more than 0.9."""
SURE = 0.95
"""Correlation above which it is another's: neighbours a tenth of a wave apart have 0.8."""
CLEARER = 1.02
"""Ratio of what two models leave, above which the data tell them apart: on ten real rings a fixed
frequency leaves 1.04 to 11 times less than a fixed momentum."""
ROUNDS = 5
FACTORS = {
    0.5: "half", 2.0: "twice", 1e3: "a thousand times", 1e-3: "a thousandth of",
    1e6: "a million times", 1e-6: "a millionth of",
}  # fmt: skip
NEAR = 1.3
"""A slope within this factor of 1/2 or 2 is that: gains and calibrations err by ten per cent."""
FAR = 4.0
"""The same for units: no other factor is near."""


@dataclass(frozen=True)
class Slopes:
    """Of one block: columns of one plane, read in that plane.

    Attributes:
        slope, alike: measured on design, and the correlation, [column].
        monitor: slope by monitor over all columns, [monitor].
        monitor_alike: correlation by monitor.
    """

    slope: Array
    alike: Array
    monitor: Array
    monitor_alike: Array

    @property
    def typical(self) -> float:
        """The median slope of the columns that resemble the design; NaN where most do not."""
        good = np.abs(self.alike) > ALIKE
        return float(np.median(self.slope[good])) if good.mean() > 0.5 else np.nan


def slopes(measured: Array, design: Array) -> Slopes:
    """Regress each column and each monitor of [column, monitor] on the design's."""
    there = np.isfinite(measured) & np.isfinite(design)
    m, d = np.where(there, measured, 0.0), np.where(there, design, 0.0)

    def along(axis: int) -> tuple[Array, Array]:
        md, dd, mm = ((a * b).sum(axis) for a, b in ((m, d), (d, d), (m, m)))
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.nan_to_num(md / dd), np.nan_to_num(md / np.sqrt(dd * mm))

    return Slopes(*along(1), *along(0))


def compared(ring: Ring, measured: OrbitResponse) -> tuple[list[str], list[str]]:
    """What the data confirm and what they contradict, beside the ring's own response; a sentence
    each.

    Args:
        ring: the design, with the measurement's names.
        measured: the response.
    """
    try:
        model = ResponseModel(ring)
    except UnstableRingError as error:
        return [], [f"the lattice has no closed orbit to compare with ({error})"]
    index = {ring[name].name: i for i, name in enumerate(model.monitors)}
    at = [index[ring[name].name] for name in measured.monitors]
    design = model.response(measured.correctors)[:, at] * measured.kicks[:, None, None]
    planes = np.array([int(plane == "y") for plane in measured.planes])
    rf = _rf(model, measured, at)
    said = []
    found = {}
    for p, plane in enumerate("xy"):
        columns = np.flatnonzero(planes == p)
        if not len(columns):
            continue
        own = slopes(measured.response[columns, :, p], design[columns, :, p])
        found[plane] = own
        if np.isnan(own.typical):
            other = slopes(measured.response[columns, :, 1 - p], design[columns, :, p])
            said.append(_unlike(plane, own, other))
            continue
        said += _of_size(f"orbit changes in {plane} by correctors of {plane}", own.typical)
        said += _single(plane, own, [measured.correctors[i] for i in columns], measured.monitors)
        said += _exchanged(
            measured.response[columns, :, p], design[columns, :, p], own, measured.monitors, plane
        )
    if rf is not None:
        found["rf"] = rf
        if np.isnan(rf.typical):
            said.append(
                "the RF step's orbit does not resemble the design's (correlation "
                f"{rf.alike[0]:+.2f}): its sign or the monitors are not known"
            )
        else:
            said += _of_size("orbit changes in x by the RF's step", rf.typical)
    said += _signs({key: own.typical for key, own in found.items()})
    if "x" not in found or np.isnan(found["x"].typical):
        return [], said
    confirmed, contradicted = _frequency(ring, measured, design, planes == 0, at)
    return confirmed, said + contradicted


def _frequency(
    ring: Ring,
    measured: OrbitResponse,
    design: Array,
    columns: NDArray[np.bool_],
    at: list[int],
) -> tuple[list[str], list[str]]:
    """Whether the frequency stood still, or the momentum did: which of them leaves less in x, with
    a gain free for each monitor and each corrector."""
    names = [n for n, x in zip(measured.correctors, columns.tolist(), strict=True) if x]
    flat = ResponseModel(ring, dimension=4).response(names)[:, at, 0]
    orbits = measured.response[columns, :, 0]
    fixed, momentum = (
        1e6 * _left(orbits, d)
        for d in (design[columns, :, 0], flat * measured.kicks[columns, None])
    )
    told = f"with gains free, {fixed:.3g} µm are left in x, and {momentum:.3g} at a fixed momentum"
    if fixed < momentum / CLEARER:
        return [f"the data agree that the frequency stood still: {told}"], []
    if momentum < fixed / CLEARER:
        return [], [f"the momentum stood still, and not the frequency: {told}"]
    return [], []


def _left(measured: Array, design: Array) -> float:
    """rms that a gain for each column and each monitor leaves, over what was read."""
    there = np.isfinite(measured)
    m, d = np.where(there, measured, 0.0), np.where(there, design, 0.0)
    gain = np.ones(m.shape[1])
    with np.errstate(invalid="ignore", divide="ignore"):
        for _ in range(ROUNDS):
            kick = np.nan_to_num((m * d * gain).sum(axis=1) / ((d * gain) ** 2).sum(axis=1))
            turned = d * kick[:, None]
            gain = np.nan_to_num((m * turned).sum(axis=0) / (turned**2).sum(axis=0))
    return float(np.sqrt(((m - turned * gain) ** 2).sum() / there.sum()))


def _rf(model: ResponseModel, measured: OrbitResponse, at: list[int]) -> Slopes | None:
    rf = measured.rf
    if rf is None or rf.orbit is None or not rf.step or not np.isfinite(rf.orbit[:, 0]).any():
        return None
    expected = model.rf_response()[at, 0] * rf.step / rf.frequency
    return slopes(rf.orbit[None, :, 0], expected[None])


def _unlike(plane: str, own: Slopes, other: Slopes) -> str:
    alike = float(np.median(np.abs(own.alike)))
    if np.median(np.abs(other.alike)) > max(ALIKE, alike):
        return (
            f"correctors of {plane} move the beam in the other plane, as the design does in "
            f"{plane}: planes are exchanged"
        )
    return (
        f"what correctors of {plane} do does not resemble the design (median correlation "
        f"{alike:.2f}): the columns or monitors stand in another order, or the lattice is another"
    )


def _of_size(what: str, slope: float) -> list[str]:
    size = abs(slope)
    for factor, words in FACTORS.items():
        near = NEAR if 0.1 < factor < 10 else FAR
        if 1 / near < size / factor < near:
            why = "steps from the middle to one side, or from side to side" if near == NEAR else (
                "another unit"
            )  # fmt: skip
            return [f"{what} are {words} the design's (median slope {slope:+.4g}): {why}"]
    if not 1 / NEAR < size < NEAR:
        return [f"{what} are {slope:+.3g} times the design's: kicks or units are not as stated"]
    return []


def _signs(typical: dict[str, float]) -> list[str]:
    """Which sign is the other one, by which of x, y and the RF are."""
    x, y, rf = (np.sign(typical.get(key, np.nan)) for key in ("x", "y", "rf"))
    said = []
    if x < 0 and rf < 0:
        said.append("x is of the other sign: correctors and the RF say so")
    elif x < 0:
        said.append("the kicks of correctors of x are of the other sign" + (
            ": the RF's orbit is not" if rf > 0 else ", or x is"
        ))  # fmt: skip
    elif rf < 0:
        said.append("the RF's step is of the other sign: the correctors of x are not")
    if y < 0:
        said.append("the kicks of correctors of y are of the other sign, or y is")
    return said


def _exchanged(
    measured: Array, design: Array, own: Slopes, monitors: tuple[str, ...], plane: str
) -> list[str]:
    """Monitors that read what the design has at another one, which is as odd itself."""
    m = np.where(np.isfinite(measured), measured, 0.0)
    with np.errstate(invalid="ignore", divide="ignore"):
        size = np.outer(*(np.sqrt((a**2).sum(axis=0)) for a in (m, design)))
        alike = np.nan_to_num(m.T @ design / size) * np.sign(own.typical)
    odd = np.flatnonzero((np.diagonal(alike) < ODD) & m.any(axis=0))
    return [
        f"monitors '{monitors[i]}' and '{monitors[k]}' read each other's {plane}"
        for i in odd
        for k in odd
        if i < k and min(alike[i, k], alike[k, i]) > SURE
    ]


def _single(plane: str, own: Slopes, correctors: list[str], monitors: tuple[str, ...]) -> list[str]:
    """Single correctors and monitors that go against the others."""
    said = []
    for what, names, slope, alike in (
        ("correctors", correctors, own.slope, own.alike),
        ("monitors", list(monitors), own.monitor, own.monitor_alike),
    ):
        against = (slope * np.sign(own.typical) < 0) & (np.abs(alike) > ALIKE)
        wrong = [name for name, w in zip(names, against.tolist(), strict=True) if w]
        if wrong and len(wrong) < len(names) / 2:
            said.append(f"single {what} of {plane} have the sign against the others: "
                        f"{counted(wrong)}")  # fmt: skip
        nothing = (np.abs(alike) < ODD) & (alike != 0)
        odd = [name for name, n in zip(names, nothing.tolist(), strict=True) if n]
        if odd and len(odd) < len(names) / 4 and np.median(np.abs(alike)) > 0.9:
            said.append(f"single {what} of {plane} resemble nothing in the design: {counted(odd)}")
    return said
