"""Products of signatures with data and with each other, nuisances projected out.

A scan needs only the squares of signatures and their products with data. A kind of measurement
gives the signatures (`rows`), and may have faster ways for some of them (`quick`).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from tmlattice.arrays import AT_ONCE, Array, Indices
from tmlattice.inference.whitening import Projection

Hypothesis = tuple[str, str | None]
"""An effect and its place."""


@dataclass(frozen=True)
class Products:
    """Products of signatures [hypothesis] with themselves and with rows of data.

    Attributes:
        whole: square, [hypothesis].
        inside: its part along the nuisances' directions, [hypothesis].
        inner: with the data, [hypothesis, data].
    """

    whole: Array
    inside: Array
    inner: Array

    @classmethod
    def empty(cls, hypotheses: int, data: int) -> "Products":
        """Return zeros."""
        return cls(np.zeros(hypotheses), np.zeros(hypotheses), np.zeros((hypotheses, data)))

    def put(self, at: Indices, whole: Array, inside: Array | float, inner: Array) -> None:
        """Set the products of some hypotheses."""
        self.whole[at], self.inside[at], self.inner[at] = whole, inside, inner


class Metric:
    """Products at one point; this class forms every signature.

    Args:
        projection: of the nuisances.

    Attributes:
        chunk: hypotheses at a time, which bounds the memory of a scan.
    """

    def __init__(self, projection: Projection) -> None:
        self.projection = projection
        self.chunk = max(AT_ONCE // max(projection.rows, 1), 1)

    def rows(self, hypotheses: Sequence[Hypothesis]) -> Array:
        """Whitened signatures, d rows / d amount ** power, [hypothesis, row]; of a discrete effect
        its change of the rows."""
        raise NotImplementedError

    def quick(self, hypotheses: Sequence[Hypothesis], data: Array, found: Products) -> Indices:
        """Put in products that need no signature; return the indices of their hypotheses."""
        return np.zeros(0, dtype=np.intp)

    def products(self, hypotheses: Sequence[Hypothesis], data: Array) -> Products:
        """Return products of each hypothesis with itself and with data [data, row]."""
        found = Products.empty(len(hypotheses), len(data))
        rest = np.ones(len(hypotheses), dtype=bool)
        rest[self.quick(hypotheses, data, found)] = False
        left = np.flatnonzero(rest)
        for start in range(0, len(left), self.chunk):
            part = left[start : start + self.chunk]
            rows = self.rows([hypotheses[i] for i in part])
            whole = np.einsum("hr,hr->h", rows, rows)
            found.put(part, whole, self.projection.inside(rows), rows @ data.T)
        return found

    def pieces(self, hypotheses: Sequence[Hypothesis]) -> Iterator[tuple[Indices, Array]]:
        """Yield every signature, some rows of all hypotheses at a time; here all rows at once.

        Yields:
            Indices of rows, [row], and the signatures there, [hypothesis, row].
        """
        some = [
            self.rows(hypotheses[start : start + self.chunk])
            for start in range(0, len(hypotheses), self.chunk)
        ]
        if some:
            rows = np.concatenate(some)
            yield np.arange(rows.shape[1]), rows

    def free_kicks(self, places: Indices, clean: Array) -> tuple[Array, Array]:
        """Information of free kicks at places, and their product with data.

        Returns:
            [place, block, p, p] and [place, block, p]; parameters of different blocks are
            independent.
        """
        raise NotImplementedError

    def free_monitors(self, clean: Array) -> tuple[Array, Array]:
        """Information of all readings of each monitor, and their product with data."""
        raise NotImplementedError
