"""The ring from above: where its elements stand, from the lengths and the angles of its bends.

>>> plan = survey(ring)
>>> plan.at(["qd::12"])  # x and y in m, [element, 2]
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from tmlattice.arrays import Array
from tmlattice.lattice.ring import Ring


@dataclass(frozen=True, eq=False)
class Survey:
    """Plan view; the first element begins at the origin, along x, and bends turn to the right.

    Attributes:
        names: of the elements, in beam order.
        middle: of each element, [element, (x, y)], m.
        ends: of the elements, the start of the first one before them, [element + 1, (x, y)], m.
        heading: at the middle, from the x axis to the left, rad, [element].
    """

    names: tuple[str, ...]
    middle: Array
    ends: Array
    heading: Array

    def at(self, names: Iterable[str]) -> Array:
        """The middles of these elements, [element, (x, y)], m; KeyError: no such element."""
        index = {name: i for i, name in enumerate(self.names)}
        return self.middle[[index[name] for name in names]]

    def along(self, s: float, ring: Ring) -> Array:
        """The place at s, between the ends of elements, (x, y), m."""
        ends = np.concatenate([[0.0], np.cumsum([e.length for e in ring.elements])])
        return np.array([np.interp(s, ends, self.ends[:, k]) for k in (0, 1)])


def survey(ring: Ring) -> Survey:
    """Where the elements stand, seen from above.

    A bend is an arc of its length and angle; one that bends out of the plane counts by the part of
    its angle in it. What a corrector does to the orbit does not move the ring.
    """
    length = np.array([element.length for element in ring.elements])
    angle = np.array([e.bending * np.cos(e.tilt) for e in ring.elements])
    before = -np.concatenate([[0.0], np.cumsum(angle)])[:-1]
    half, whole = _chord(length / 2, angle / 2, before), _chord(length, angle, before)
    ends = np.concatenate([np.zeros((1, 2)), np.cumsum(whole, axis=0)])
    return Survey(
        tuple(element.name for element in ring.elements), ends[:-1] + half, ends, before - angle / 2
    )


def _chord(length: Array, angle: Array, heading: Array) -> Array:
    """From the start of an arc that turns right to its end, [arc, (x, y)]."""
    size = length * np.sinc(angle / (2 * np.pi))
    along = heading - angle / 2
    return np.stack([size * np.cos(along), size * np.sin(along)], axis=-1)
