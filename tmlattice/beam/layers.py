"""The layers of one turn as stacked weights."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

from tmlattice.arrays import Array, ComplexArray, Flags, Indices
from tmlattice.beam.sweeps import curved
from tmlattice.maps import RingMaps
from tmlattice.maps.quadratic import Weights

LayerParts = tuple[Weights, list[Weights], ComplexArray]
"""The weights of a layer, the read-outs of the monitors before its magnet, and the magnet's third
order."""


@dataclass(frozen=True)
class Layers:
    """A turn: every layer, then the drift from the last magnet to the ring's end.

    Step k sends the state x at exit k to W0[k] + W1[k] x + W2[k] x^[2] at exit k + 1, the products
    in the reduced Kronecker order x1^2, x1 x2, ..., xn^2, and adds the magnet's third order, see
    `beam.nonlinear`. A monitor reads R0 + R1 x + R2 x^[2].

    Attributes:
        W: W0 [step, n], W1 [step, n, n], W2 [step, n, n (n + 1) / 2].
        third: [step, 4].
        R: R0 [monitor, 2], R1 [monitor, 2, n], R2 [monitor, 2, n (n + 1) / 2].
        at: the exit of each monitor's state, rising, [monitor].
        start: the monitors at exit k are start[k] to start[k + 1] - 1.
    """

    W: Weights
    third: ComplexArray
    R: Weights
    at: Indices
    start: Indices

    @classmethod
    def of(
        cls, maps: RingMaps, third: ComplexArray | None = None, weights: Weights | None = None
    ) -> "Layers":
        """Return writable copies of the arrays; optionally with a third order, or with other
        weights of the layers."""
        weights = (maps.W0, maps.W1, maps.W2) if weights is None else weights
        closing = maps.closing.coefficients
        W0, W1, W2 = (np.concatenate([w, c[None]]) for w, c in zip(weights, closing, strict=True))
        R = maps.R0.copy(), maps.R1.copy(), maps.R2.copy()
        third = np.zeros((len(W0), 4), dtype=complex) if third is None else third.copy()
        return cls((W0, W1, W2), third, R, maps.at, maps.start)

    @property
    def steps(self) -> int:
        """Steps of a turn: the layers and the closing drift."""
        return len(self.W[0])

    @property
    def curved(self) -> Flags:
        """Whether each step has a second order, [step]."""
        return curved(self.W[2])

    def put(self, parts: Mapping[int, LayerParts]) -> dict[int, LayerParts]:
        """Write layers in place; return the previous ones."""
        steps = np.fromiter(parts, dtype=np.intp)
        reads = [(int(self.start[k]), len(found)) for k, (_, found, _) in parts.items()]
        rows = np.array([row for s, m in reads for row in range(s, s + m)], dtype=np.intp)
        old_W, old_R = [w[steps] for w in self.W], [r[rows] for r in self.R]
        third = self.third[steps]
        own = zip(*(w for w, _, _ in parts.values()), strict=True)
        for stack, new in zip(self.W, own, strict=False):
            stack[steps] = new
        for k, (_, _, high) in parts.items():
            self.third[k] = high
        found = [read for _, there, _ in parts.values() for read in there]
        for stack, new in zip(self.R, zip(*found, strict=True), strict=False):
            stack[rows] = new
        before: dict[int, LayerParts] = {}
        first = 0
        for i, (k, (_, count)) in enumerate(zip(parts, reads, strict=True)):
            here = range(first, first + count)
            first += count
            before[k] = (_row(old_W, i), [_row(old_R, r) for r in here], third[i])
        return before

    @contextmanager
    def with_parts(self, parts: Mapping[int, LayerParts]) -> Iterator[None]:
        """Replace these layers within a context."""
        before = self.put(parts)
        try:
            yield
        finally:
            self.put(before)


def _row(stacks: list[Array], i: int) -> Weights:
    a, b, c = (stack[i] for stack in stacks)
    return a, b, c
