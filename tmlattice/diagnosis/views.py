"""Parts of a measurement that a diagnosis keeps for plots and tables."""

from dataclasses import dataclass, field

import numpy as np

from tmlattice.arrays import Array, Flags
from tmlattice.diagnosis.records import HIDDEN, OPTIONAL, named
from tmlattice.inference.problem import Point, Problem
from tmlattice.inference.search import Explanation
from tmlattice.inference.validation import Misfit
from tmlattice.measurement import OrbitResponse
from tmlattice.measurement.kinds import QUANTITIES
from tmlattice.observe.data import Data
from tmlattice.observe.first_turns import FirstTurns
from tmlattice.observe.tune_readings import TuneReadings


@dataclass(frozen=True)
class NumberRead:
    """One number, as measured and by two models. A tune is a fraction.

    Attributes:
        shot: its place among those of the fit.
        quantity: as in the files, one of `measurement.kinds.QUANTITIES`.
        read, error: the reading, and its standard error.
        before, after: of the design and of the result.
    """

    shot: int
    quantity: str
    read: float
    error: float
    before: float
    after: float


def numbers_read(own: Problem, before: Point, after: Point) -> tuple[NumberRead, ...]:
    """The numbers of a problem of tunes by the design and by the result; empty for any other."""
    if not isinstance(own, TuneReadings):
        return ()
    read_numbers = []
    for shot, column in np.argwhere(own.valid).tolist():
        values = [float(one[shot, column]) for one in (own.values, before.orbit, after.orbit)]
        read, *models = (value % 1.0 for value in values) if column < 2 else values
        error = float(own.sigma[shot, column])
        read_numbers.append(NumberRead(shot, QUANTITIES[column], read, error, *models))
    return tuple(read_numbers)


@dataclass(frozen=True, eq=False)
class TrajectoryView:
    """The view of trajectories, for plots.

    Attributes:
        explanation: the search.
        problem: the shots of the fit, without what was rejected.
        before, after: readings of the design and of the result, launches fitted,
            [shot, reading, 2], m.
        dropped: readings that the search rejected, [shot, reading, 2].
    """

    explanation: Explanation
    problem: FirstTurns
    before: Array
    after: Array
    dropped: Flags

    @property
    def data(self) -> Data:
        """The readings."""
        return self.problem.data


@dataclass(frozen=True, eq=False)
class ResponseView:
    """The view of an orbit response, for plots.

    Attributes:
        measured: the response, its monitors in the ring's order.
        data: measured, the RF last, m, [column, monitor, 2].
        design, model: the model's, before and after.
        held: correctors held out, [column], the RF last.
        good: monitors kept, [monitor].
    """

    measured: OrbitResponse
    data: Array
    design: Array
    model: Array
    held: Flags
    good: Flags


@dataclass(frozen=True, eq=False)
class PartView:
    """One of several measurements, with residuals before and after.

    Attributes:
        label, kind: what the user calls it, and what it is.
        readings: their number.
        before, after: what the design and the result leave.
        monitors: names; none after loading.
        left: rms residual at each BPM in units of the noise, before and after,
            [2, monitor]; NaN where nothing was read.
        numbers: of tunes, each as read and as both models have it.
    """

    label: str = field(metadata=named("name"))
    kind: str
    readings: int
    before: Misfit
    after: Misfit
    monitors: tuple[str, ...] = field(default=(), metadata=HIDDEN)
    left: Array = field(default_factory=lambda: np.zeros((2, 0)), repr=False, metadata=HIDDEN)
    numbers: tuple[NumberRead, ...] = field(default=(), metadata=OPTIONAL)
