"""Readings without a BPM, tunes and chromaticities, with the prediction of each model."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from tmlattice.inference.problem import Point, Problem
from tmlattice.observe.tune_readings import TuneReadings

QUANTITIES = ("tune_x", "tune_y", "chromaticity_x", "chromaticity_y")
"""Quantities in the order of the columns of `TuneReadings`, named as in the files."""


@dataclass(frozen=True)
class NumberRead:
    """One number, as measured and by two models. A tune is a fraction.

    Attributes:
        shot: its place among those of the fit.
        quantity: one of `QUANTITIES`.
        read, error: the reading, and its standard error.
        before, after: of the design and of the result.
    """

    shot: int
    quantity: str
    read: float
    error: float
    before: float
    after: float

    def as_json(self) -> dict[str, Any]:
        """The entry in the file of the diagnosis."""
        return dict(vars(self))


def numbers_read(own: Problem, before: Point, after: Point) -> tuple[NumberRead, ...]:
    """The numbers of a problem of tunes; empty for any other.

    Args:
        own: the problem of one measurement.
        before, after: of the design and of the result.
    """
    if not isinstance(own, TuneReadings):
        return ()
    read_numbers = []
    for shot, column in np.argwhere(own.valid).tolist():
        values = [float(one[shot, column]) for one in (own.data, before.orbit, after.orbit)]
        read, *models = (value % 1.0 for value in values) if column < 2 else values
        error = float(own.errors[shot, column])
        read_numbers.append(NumberRead(shot, QUANTITIES[column], read, error, *models))
    return tuple(read_numbers)
