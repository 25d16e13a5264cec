"""Parts of a measurement that a diagnosis keeps for plots and tables."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tmlattice.diagnosis.numbers import NumberRead
from tmlattice.inference.search import Explanation
from tmlattice.inference.validation import Misfit
from tmlattice.measurement import OrbitResponse
from tmlattice.observe.data import Data
from tmlattice.observe.first_turns import FirstTurns


@dataclass(frozen=True, eq=False)
class TrajectoryView:
    """The view of trajectories, for plots.

    Attributes:
        explanation: the search.
        problem: the shots of the fit, without what was rejected.
        before, after: readings of the design and of the result, launches fitted,
            [shot, reading, 2], m.
        dropped: readings that the search left out, [shot, reading, 2].
    """

    explanation: Explanation
    problem: FirstTurns
    before: NDArray[np.float64]
    after: NDArray[np.float64]
    dropped: NDArray[np.bool_]

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
    data: NDArray[np.float64]
    design: NDArray[np.float64]
    model: NDArray[np.float64]
    held: NDArray[np.bool_]
    good: NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class PartView:
    """One of several measurements, with residuals before and after.

    Attributes:
        label, kind: what the user calls it, and what it is.
        readings: their number.
        before, after: what the design and the result leave.
        monitors: names.
        left: rms of what is left at each monitor in units of the noise, before and after,
            [2, monitor]; NaN where nothing was read.
        numbers: of tunes, each as read and as both models have it.
    """

    label: str
    kind: str
    readings: int
    before: Misfit
    after: Misfit
    monitors: tuple[str, ...]
    left: NDArray[np.float64] = field(repr=False)
    numbers: tuple[NumberRead, ...] = ()

    def as_json(self) -> dict[str, Any]:
        """The entry in the file of the diagnosis."""
        return {
            "name": self.label,
            "kind": self.kind,
            "readings": self.readings,
            "before": dict(vars(self.before)),
            "after": dict(vars(self.after)),
            **({"numbers": [n.as_json() for n in self.numbers]} if self.numbers else {}),
        }


@dataclass(frozen=True, eq=False)
class StoredView:
    """What the file of a diagnosis keeps of its measurement.

    Attributes:
        kind: of the measurement, see `Diagnosis.kind`.
        parts: the measurements, without their monitors' residuals.
        measured: quantities of the stored beam that were measured.
        correctors: how many of an orbit response were held out; None: no response.
    """

    kind: str
    parts: tuple[PartView, ...]
    measured: tuple[str, ...]
    correctors: int | None


@dataclass(frozen=True, eq=False)
class JointView:
    """The view of a stored beam's measurements, or of several together, for plots.

    Attributes:
        explanation: the search.
        parts: the measurements.
    """

    explanation: Explanation
    parts: tuple[PartView, ...]
