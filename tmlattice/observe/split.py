"""Split of an orbit response: readings to fit, to select families, and to validate.

>>> split = split_columns(data, 0.2, np.random.default_rng(0))
>>> split.held.sum()                               # number of held-out correctors
"""

from dataclasses import dataclass

import numpy as np

from tmlattice.arrays import Flags
from tmlattice.errors import MeasurementError
from tmlattice.observe.response_data import ResponseData

INNER = 0.2
"""Share of the fitted correctors, and of the RF's fitted monitors, that select families."""


@dataclass(frozen=True, eq=False)
class Split:
    """Fitted, selecting and validating readings.

    Attributes:
        held: held-out correctors, [column].
        inner: correctors that select families of errors, [column].
        half: monitors that determine a corrector's kick, or fit the RF, [column, monitor].
        inner_rf: those of the RF's fitted monitors that select, [monitor].
    """

    held: Flags
    inner: Flags
    half: Flags
    inner_rf: Flags


def split_columns(data: ResponseData, holdout: float, rng: np.random.Generator) -> Split:
    """Draw a split of the correctors that are read in the plane of their kick.

    Raises:
        MeasurementError: too few correctors.
    """
    columns, monitors = data.shape
    read = np.asarray(np.isfinite(data.pick(data.orbits)[:-1]).any(axis=1))
    some = int(read.sum())
    count = round(holdout * some)
    inner = round(INNER * (some - count))
    if not (count > 0 and inner > 0 and count + inner < some - 1):
        raise MeasurementError(
            f"{some} correctors that are read in the plane of their kick cannot be split; "
            "measure more"
        )
    held, chooses = np.zeros((2, columns), dtype=bool)
    drawn = rng.permutation(columns - 1)
    drawn = drawn[np.argsort(~read[drawn], kind="stable")]  # others validate nothing
    plane = data.plane[drawn]
    alone = [np.flatnonzero(read[drawn] & (plane == p))[-1] for p in set(plane[read[drawn]])]
    drawn = np.append(np.delete(drawn, alone), drawn[alone])  # each plane has one in the fit
    held[drawn[:count]] = True
    chooses[drawn[count : count + inner]] = True
    half = np.zeros((columns, monitors), dtype=bool)

    def draw(c: int) -> None:
        half[c, rng.choice(monitors, monitors // 2, replace=False)] = True

    for c in [*np.flatnonzero(held | chooses), columns - 1]:
        draw(int(c))
    near = np.flatnonzero(half[-1])
    inner_rf = np.zeros(monitors, dtype=bool)
    inner_rf[rng.choice(near, max(1, round(INNER * len(near))), replace=False)] = True
    for c in np.flatnonzero(~(held | chooses))[:-1]:
        draw(int(c))
    return Split(held, chooses, half, inner_rf)
