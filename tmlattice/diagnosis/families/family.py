"""The interface of a family of errors of a hierarchical fit; see `families`."""

from abc import ABC, abstractmethod
from dataclasses import replace
from typing import ClassVar

import numpy as np
from scipy.sparse import csr_array

from tmlattice.arrays import Array, Reals
from tmlattice.effects import Cause, Hypothesis, find
from tmlattice.inference.priors import Group
from tmlattice.observe.orbit_response import Errors, Predicted
from tmlattice.observe.response_data import ResponseData

StatedCause = tuple[Cause, float]
"""A cause and the posterior rms of its amount."""

TAILS = 4.0
"""Degrees of freedom of heavy-tailed priors: one magnet in a hundred may be an outlier."""


class Family(ABC):
    """One kind of error, at all of its places.

    Attributes:
        name: in options and logs; the names of its priors begin with it.
        effects: of the catalogue, as which it is reported.
        block: 0 in-plane, 1 coupling.
        per: what has a number each: "monitor", "column" or "ring".
        variable: the numbers that it changes; families that share one add up.
        trust: step bound of a number in one round, rms.
        gross: limit above which a column's number starts from its own estimate; otherwise the
            column would have no weight until the rounds reach that value.
        late: whether it is added once the others have converged.
        single: whether one member may be faulty; not a pattern, or a type with one design.
        rms, tails, most: prior of a single number: rms, degrees of freedom, largest rms.
        causes: of its numbers, if a fit chooses them.
    """

    name: ClassVar[str]
    effects: ClassVar[tuple[str, ...]]
    block: ClassVar[int]
    per: ClassVar[str]
    variable: ClassVar[str]
    trust: ClassVar[float]
    gross: ClassVar[float] = np.inf
    late: ClassVar[bool] = False
    single: ClassVar[bool] = True
    rms: ClassVar[float]
    tails: ClassVar[float] = np.inf
    most: ClassVar[float] = np.inf
    causes: ClassVar[tuple[Hypothesis, ...]] = ()

    @property
    def title(self) -> str:
        """The names of its effects."""
        return ", ".join(self.effects)

    @property
    def largest(self) -> float:
        """The largest fault of one member, in the unit of the numbers; 0: no single faults."""
        return find(self.effects[0]).largest if self.single else 0.0

    @abstractmethod
    def size(self, data: ResponseData) -> int:
        """The number of parameters of its variable."""

    def groups(self, data: ResponseData) -> list[Group]:
        """Its priors, over the variable's numbers; here that of single numbers."""
        return [Group(self.name, np.eye(self.size(data)), self.rms, self.tails, most=self.most)]

    @abstractmethod
    def rows(self, at: Predicted, values: Array) -> Reals:
        """Derivatives of the readings of its block, m: [number, column, monitor]; or, for numbers
        of one column or BPM, [column, monitor]."""

    @abstractmethod
    def put(self, errors: Errors, values: Array, data: ResponseData) -> Errors:
        """The errors with these values."""

    def causes_of(
        self, errors: Errors, values: Array, sigma: Array, data: ResponseData
    ) -> list[StatedCause]:
        """The values as causes, with errors; here by `moves`."""
        return [
            (Cause(*cause, share * float(value)), abs(share) * float(error))
            for moves, value, error in zip(self.moves(data), values, sigma, strict=True)
            for cause, share in moves.items()
        ]

    @abstractmethod
    def moves(self, data: ResponseData) -> list[dict[Hypothesis, float]]:
        """Amounts of effects, to their powers, of a unit of each number, for small numbers."""

    def count(self, data: ResponseData) -> int:
        """The number of its parameters for a report."""
        return self.size(data)

    def lowest(self, data: ResponseData) -> Array | float:
        """The lower bounds of the numbers, at most zero."""
        return -np.inf

    def doubt(self, values: Array, data: ResponseData) -> str | None:
        """The reason why fitted values are implausible for the family; None: they are plausible."""
        return None


class RingFamily(Family):
    """Causes in the ring: each number is the amount of one, or of several in fixed shares."""

    per = "ring"

    def size(self, data: ResponseData) -> int:
        """The number of causes, or of sets of them."""
        return len(self.moves(data))

    def units(self, values: Array) -> Array:
        """Derivative of each number's causes by the number, over their shares."""
        return np.ones(len(values))

    def rows(self, at: Predicted, values: Array) -> Reals:
        """Derivatives of the response, with gains."""
        each = self.moves(at.data)
        column = {cause: i for i, cause in enumerate(dict.fromkeys(c for own in each for c in own))}
        counts = [len(own) for own in each]
        shares = np.array([share for own in each for share in own.values()])
        shares *= np.repeat(self.units(values), counts)
        where = [column[cause] for own in each for cause in own]
        matrix = csr_array((shares, where, np.cumsum([0, *counts])), (len(each), len(column)))
        return at.rows(list(column), self.block, matrix)

    def put(self, errors: Errors, values: Array, data: ResponseData) -> Errors:
        """The errors with these causes in the ring."""
        causes = (own for own, _ in self.causes_of(errors, values, np.zeros(len(values)), data))
        return replace(errors, ring=(*errors.ring, *(own for own in causes if own.amount)))
