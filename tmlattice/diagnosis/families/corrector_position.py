"""Where the fields of correctors are, by the magnets beside them.

The iron of a magnet draws the field of a corrector beside it: correctors that stand
between the same two magnets kick as much further up or down than the lattice has it. One that
stands so alone has no number: nobody else could confirm it.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from tmlattice.diagnosis.families.family import Family, Told
from tmlattice.effects import Cause
from tmlattice.inference.priors import Group
from tmlattice.lattice import Ring
from tmlattice.lattice.slices import stem
from tmlattice.observe.orbit_response import Errors, Hypothesis, Predicted, ResponseData

Array = NDArray[np.float64]

LARGEST = 0.05
"""m; a field that is further away is another corrector's."""


def between(ring: Ring, correctors: Sequence[str], planes: Sequence[str]) -> list[str]:
    """Of each corrector its plane and the families of the magnets before and behind it.

    Args:
        ring: where they stand.
        correctors: names.
        planes: "x" or "y", of each.
    """
    others = [e for e in ring.magnets if e.kind not in ("hcorrector", "vcorrector")]
    places = np.array([e.s for e in others])
    behind = np.searchsorted(places, [ring[name].s for name in correctors]) % len(others)
    return [
        f"{plane} {stem(others[i - 1].name)} {stem(others[i].name)}"
        for plane, i in zip(planes, behind, strict=True)
    ]


class CorrectorPosition(Family):
    """One number for all correctors of a plane between the same two families of magnets."""

    name, effects = "corrector_position", ("corrector_position",)
    block, per, variable, trust = 0, "ring", "position", 0.02

    def members(self, data: ResponseData) -> list[list[int]]:
        """The columns of each number."""
        measured = data.measured
        own = between(data.ring, measured.correctors, measured.planes)
        alike = [[i for i, other in enumerate(own) if other == k] for k in dict.fromkeys(own)]
        return [columns for columns in alike if len(columns) > 1]

    def size(self, data: ResponseData) -> int:
        """Pairs of neighbours that more than one corrector has."""
        return len(self.members(data))

    def groups(self, data: ResponseData) -> list[Group]:
        """Of each pair."""
        return [Group(self.name, np.eye(self.size(data)), 5e-3, most=LARGEST)]

    def rows(self, at: Predicted, values: Array) -> Array:
        """A kick that comes later has moved the beam by less: each column's own jump."""
        data = at.data
        kicks = data.kicks * (1 + at.errors.calibration)
        jump = -at.gain(0) * data.pick(at.jumps) * kicks[:, None]
        out = np.zeros((self.size(data), *data.shape))
        for row, columns in zip(out, self.members(data), strict=True):
            row[columns] = jump[columns]
        return out

    def put(self, errors: Errors, values: Array, data: ResponseData) -> Errors:
        """As causes in the ring."""
        names = data.measured.correctors
        causes = tuple(
            Cause(self.name, names[i], float(value))
            for columns, value in zip(self.members(data), values, strict=True)
            for i in columns
            if value
        )
        return replace(errors, ring=(*errors.ring, *causes))

    def told(self, errors: Errors, values: Array, sigma: Array, data: ResponseData) -> list[Told]:
        """Of each corrector."""
        names = data.measured.correctors
        return [
            (Cause(self.name, names[i], float(value)), float(error))
            for columns, value, error in zip(self.members(data), values, sigma, strict=True)
            for i in columns
        ]

    def moves(self, data: ResponseData) -> list[dict[Hypothesis, float]]:
        """All of them by as much."""
        names = data.measured.correctors
        return [{(self.name, names[i]): 1.0 for i in columns} for columns in self.members(data)]
