"""Products of signatures with data and with one another, nuisances projected out.

A scan needs no signature itself, only its square and its products with data. A kind of measurement
says what the signatures are (`rows`), and may know quicker ways for some of them (`quick`).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tmlattice.inference.whitening import Projection

Array = NDArray[np.float64]
Indices = NDArray[np.intp]
Hypothesis = tuple[str, str | None]
"""An effect and the place where it might sit."""


@dataclass(frozen=True)
class Products:
    """Of signatures [hypothesis] with themselves and with rows of data.

    Attributes:
        whole: square, [hypothesis].
        inside: the part of it along the launches' directions, [hypothesis].
        inner: with the data, [hypothesis, data].
    """

    whole: Array
    inside: Array
    inner: Array

    @classmethod
    def empty(cls, hypotheses: int, data: int) -> "Products":
        """All zero."""
        return cls(np.zeros(hypotheses), np.zeros(hypotheses), np.zeros((hypotheses, data)))

    def put(self, at: Indices, whole: Array, inside: Array | float, inner: Array) -> None:
        """Those of some hypotheses."""
        self.whole[at], self.inside[at], self.inner[at] = whole, inside, inner


class Metric:
    """Products about one point; this one makes every signature.

    Args:
        projection: of the nuisances.

    Attributes:
        chunk: hypotheses at a time: the memory of a scan does not grow with their number.
    """

    chunk = 512

    def __init__(self, projection: Projection) -> None:
        self.projection = projection

    def rows(self, hypotheses: Sequence[Hypothesis]) -> Array:
        """Whitened signatures, d rows / d amount ** power, [hypothesis, row]; of what is discrete
        the change when it is there."""
        raise NotImplementedError

    def quick(self, hypotheses: Sequence[Hypothesis], data: Array, found: Products) -> Indices:
        """Put in what needs no signature; returns which of the hypotheses these are."""
        return np.zeros(0, dtype=np.intp)

    def products(self, hypotheses: Sequence[Hypothesis], data: Array) -> Products:
        """Of every hypothesis with itself and with data, [data, row], nuisances projected out."""
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
        """Every signature, some rows of all hypotheses at a time; here all rows at once.

        Yields:
            Which rows, [row], and the signatures there, [hypothesis, row].
        """
        some = [
            self.rows(hypotheses[start : start + self.chunk])
            for start in range(0, len(hypotheses), self.chunk)
        ]
        if some:
            rows = np.concatenate(some)
            yield np.arange(rows.shape[1]), rows

    def free_kicks(self, places: NDArray[np.int64], clean: Array) -> tuple[Array, Array]:
        """Information of a free kick at places, and its product with data.

        Returns:
            [place, block, p, p] and [place, block, p]; parameters of different blocks are
            independent.
        """
        raise NotImplementedError

    def free_monitors(self, clean: Array) -> tuple[Array, Array]:
        """The same for all readings of a monitor, [monitor, ...]."""
        raise NotImplementedError
