"""What a family of errors of a dense fit is; see `families`."""

from abc import ABC, abstractmethod
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from tmlattice.effects import Cause, find
from tmlattice.inference.priors import Group
from tmlattice.observe.orbit_response import Errors, Hypothesis, Predicted
from tmlattice.observe.response_data import ResponseData

Array = NDArray[np.float64]
StatedCause = tuple[Cause, float]
"""A cause and the posterior rms of its amount."""

TAILS = 4.0
"""Degree of freedom of priors with tails: one magnet in a hundred may be far off."""


class Family(ABC):
    """One kind of error, at all of its places.

    Attributes:
        name: in options and logs; its priors' names begin so.
        effects: of the catalogue, that it is told as.
        block: 0 in-plane, 1 coupling.
        per: whose numbers they are: "monitor", "column" or "ring".
        variable: the numbers that it moves; families that share one add up.
        trust: rms by which one round may move a number.
        gross: a column's number that is larger starts from what the column alone says: rounds
            would take long to go there, and the column meanwhile counts for nothing.
    """

    name: ClassVar[str]
    effects: ClassVar[tuple[str, ...]]
    block: ClassVar[int]
    per: ClassVar[str]
    variable: ClassVar[str]
    trust: ClassVar[float]
    gross: ClassVar[float] = np.inf

    @property
    def title(self) -> str:
        """Its effects, for people."""
        return ", ".join(self.effects)

    @property
    def largest(self) -> float:
        """The largest fault of one member, in the unit of the numbers; 0: they have no members."""
        return find(self.effects[0]).largest

    @abstractmethod
    def size(self, data: ResponseData) -> int:
        """How many numbers its variable has."""

    @abstractmethod
    def groups(self, data: ResponseData) -> list[Group]:
        """Its priors, over the variable's numbers."""

    @abstractmethod
    def rows(self, at: Predicted, values: Array) -> Array:
        """What readings of its block do, m: [number, column, monitor], or per column, or monitor,
        each reading's own number alone, [column, monitor]."""

    @abstractmethod
    def put(self, errors: Errors, values: Array, data: ResponseData) -> Errors:
        """Errors with these, instead of none."""

    @abstractmethod
    def causes_of(
        self, errors: Errors, values: Array, sigma: Array, data: ResponseData
    ) -> list[StatedCause]:
        """As causes, with errors."""

    @abstractmethod
    def moves(self, data: ResponseData) -> list[dict[Hypothesis, float]]:
        """What a unit of each number is of the catalogue's effects (amounts, to their powers): of
        small numbers."""

    def count(self, data: ResponseData) -> int:
        """Parameters, for people."""
        return self.size(data)

    def lowest(self, data: ResponseData) -> Array | float:
        """The least that each number can be; any can be zero."""
        return -np.inf

    def doubt(self, values: Array, data: ResponseData) -> str | None:
        """Why numbers that were found cannot be what the family stands for; None: they can."""
        return None
