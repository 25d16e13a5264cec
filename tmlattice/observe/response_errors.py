"""Global errors of an orbit response: a wrong sign, unit or order of all readings or kicks.

>>> search = ResponseGlobalErrors(ring, measured)
>>> search.verdict()

A machine's response is its design's to a tenth or so, column by column. A wrong sign or unit of all
readings makes nearly all columns of a plane unrelated to it. A single bad corrector is one column,
a single bad monitor a small part of all.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from tmlattice.beam.closed_orbit import ResponseModel
from tmlattice.errors import MeasurementError
from tmlattice.lattice import Ring
from tmlattice.measurement import OrbitResponse
from tmlattice.measurement.assume import ASSUMPTIONS, assume, in_beam_order
from tmlattice.observe.response_data import read

Array = NDArray[np.float64]
Names = tuple[str, ...]

USUAL = 0.01
"""Mean square misfit of a column by usual errors, relative to the column: a tenth squared."""
GAIN = 2.5
"""Mean fall of the log misfit that the changed columns need."""
OF_RF = 1.4
"""The same for the RF's one orbit, whose size follows from the ring's length."""
UNRELATED, RESEMBLING = 1.5, 0.5
"""Or: typical misfits before and after, of columns that were unrelated and now resemble the
design."""
SCALES, NEAR, SIMILAR = {"kicks-doubled": 2.0, "kicks-halved": 0.5}, 0.15, 0.8
"""Or: ratio of the typical column to the design's, tolerance of its logarithm, and smallest
correlation with the design."""
COLUMNS = 2
"""Columns that an assumption must change, at least: one may be a bad corrector."""
SEEN = 1e-3
"""Smallest share of the design's square at the monitors that read a column."""
SHARE = 0.8
"""Share of the changed columns that an assumption must improve."""
ALIKE = 2.0
"""Gain below which two assumptions are equivalent: less than the RF's column alone."""
ANOTHER = 1.0
"""Misfit of the typical column above which the response is of another ring."""


@dataclass(frozen=True)
class ResponseVerdict:
    """A global error whose correction improves an orbit response far.

    Attributes:
        names: assumptions, together.
        gain: sum over columns of the fall of the log misfit.
        before, after: misfit of the typical changed column, 0 to 4.
        alike: other assumptions that explain the data as well.
    """

    names: Names
    gain: float
    before: float
    after: float
    alike: tuple[Names, ...] = ()


@dataclass(frozen=True)
class ResponseGlobalErrors:
    """Search for global errors of one orbit response.

    Args:
        ring: the design.
        measured: its monitors those of the ring.

    Raises:
        UnknownNameError, MeasurementError: see `predict`.
        UnstableRingError: the design has no closed orbit.
    """

    ring: Ring
    measured: OrbitResponse

    @cached_property
    def monitors(self) -> list[str]:
        """Monitors of the ring, in beam order."""
        return [monitor.name for monitor in self.ring.monitors]

    @cached_property
    def design(self) -> OrbitResponse:
        """Response of the design to steps of one."""
        data = in_beam_order(self.measured, self.monitors)
        rf = data.rf if data.rf is None else replace(data.rf, step=data.rf.frequency * TINY)
        ones = replace(data, kicks=np.ones(len(data.kicks)), rf=rf)
        stepped = data.rf is not None and data.rf.orbit is not None
        return predict(ResponseModel(self.ring, 6 if stepped else 4), ones)

    def misfit(self, names: Names) -> Array:
        """Misfit of each column, the RF's last: |measured - design|^2 over the mean of both
        squares. 0: equal, 2: unrelated, 4: wrong sign, NaN: no reading of what the design does."""
        data = assume(in_beam_order(self.measured, self.monitors), names, self.monitors)
        read, made = [*data.response], [*(data.kicks[:, None, None] * self.design.response)]
        rf, own = data.rf, self.design.rf
        if rf is not None and own is not None and rf.orbit is not None and own.orbit is not None:
            read.append(rf.orbit)
            made.append(own.orbit * (rf.step / rf.frequency / TINY))
        there, whole = np.isfinite(read), np.array(made)
        a, b = (np.where(there, values, 0.0) for values in (np.array(read), whole))
        made_there = (b**2).sum(axis=(1, 2))
        size = ((a**2).sum(axis=(1, 2)) + made_there) / 2
        left = ((a - b) ** 2).sum(axis=(1, 2))
        seen = (size > 0) & (made_there > SEEN * (whole**2).sum(axis=(1, 2)))
        return np.where(seen, left / np.where(seen, size, 1.0), np.nan)

    def scale(self) -> float:
        """Ratio of the typical corrector's column to the design's; NaN if they are unrelated."""
        read, made = self.measured, self.design
        data = in_beam_order(read, self.monitors)
        there = np.isfinite(data.response)
        a = np.where(there, data.response, 0.0)
        b = np.where(there, data.kicks[:, None, None] * made.response, 0.0)
        both, own, design = ((u * v).sum(axis=(1, 2)) for u, v in ((a, b), (a, a), (b, b)))
        seen = (own > 0) & (design > 0)
        if not seen.any():
            return float("nan")
        alike = float(np.median(both[seen] / np.sqrt(own[seen] * design[seen])))
        return float(np.median(both[seen] / design[seen])) if alike > SIMILAR else float("nan")

    def rf_scale(self) -> float:
        """Ratio of the RF's orbit to the design's; NaN without one, or if they are unrelated."""
        own, made = in_beam_order(self.measured, self.monitors).rf, self.design.rf
        if own is None or made is None or own.orbit is None or made.orbit is None:
            return float("nan")
        if not read(self.measured):
            return float("nan")
        seen = np.isfinite(own.orbit)
        a, b = own.orbit[seen], made.orbit[seen] * (own.step / own.frequency / TINY)
        both = float(a @ b)
        alike = both**2 > SIMILAR**2 * float(a @ a) * float(b @ b)
        return both / float(b @ b) if alike and both else float("nan")

    def candidates(self) -> list[Names]:
        """Return the assumptions that these data allow."""
        found: list[Names] = [(n,) for n, a in ASSUMPTIONS.items() if a.response]
        if self.measured.rf is None or self.measured.rf.orbit is None:
            found = [own for own in found if not own[0].startswith("rf")]
        return found

    def verdict(self) -> ResponseVerdict | None:
        """Return the assumption that improves the data far, if any."""
        stated = self.misfit(())
        found = []
        for names in self.candidates():
            other = self.misfit(names)
            change = np.log((other + USUAL) / (stated + USUAL))
            moved = np.abs(np.nan_to_num(change)) > np.log(2.0)
            few = moved.sum() < COLUMNS and not names[0].startswith("rf")
            if moved.any() and not few and (change[moved] < 0).mean() >= SHARE:
                gain = -float(change[moved].sum())
                before, after = (float(np.median(own[moved])) for own in (stated, other))
                corrected = before > UNRELATED and after < RESEMBLING
                if names[0] in SCALES:  # common to all correctors, whatever other errors
                    corrected |= abs(np.log(self.scale() / SCALES[names[0]])) < NEAR
                least = OF_RF if names[0].startswith("rf") else GAIN
                if corrected or gain > least * moved.sum():
                    found.append(ResponseVerdict(names, gain, before, after))
        if not found:
            return None
        best = max(own.gain for own in found)
        alike = [own for own in found if own.gain > best - ALIKE]
        first = alike[0]
        return replace(first, alike=tuple(own.names for own in alike if own is not first))

    def corrected(self, names: Names) -> "ResponseGlobalErrors":
        """Return the search with assumptions corrected in the data."""
        data = assume(in_beam_order(self.measured, self.monitors), names, self.monitors)
        made = ResponseGlobalErrors(self.ring, data)
        made.__dict__["design"] = self.design  # same correctors and monitors
        return made


TINY = 1e-6
"""Relative RF step used in place of a step of 1."""


def predict(model: ResponseModel, measured: OrbitResponse) -> OrbitResponse:
    """Return the model's orbit changes for the same correctors, kicks, monitors and RF step.

    It is linear in kicks and step, and has no missing readings.

    Args:
        model: with six coordinates if the RF was stepped.
        measured: for its names, kicks and RF step.

    Raises:
        UnknownNameError: a corrector or a monitor that is not in the ring.
        MeasurementError: a corrector of another plane, or an element that is not a corrector.
    """
    columns = model.columns(measured.correctors)
    for name, plane, own in zip(measured.correctors, measured.planes, columns.planes, strict=True):
        if plane != own:
            raise MeasurementError(
                f"corrector '{name}' is stated to kick in {plane}; the ring's kicks in {own}"
            )
    order = {name: i for i, name in enumerate(model.monitors)}
    ring = model.ring
    at = [order[ring[name].name] for name in measured.monitors]
    response = model.response(measured.correctors)[:, at]
    rf = measured.rf
    if rf is not None and model.dimension == 6:
        rf = replace(rf, orbit=model.rf_change(rf.step / rf.frequency)[at])
    return replace(measured, response=np.asarray(measured.kicks)[:, None, None] * response, rf=rf)
