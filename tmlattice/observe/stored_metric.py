"""Products of a stored beam's signatures without forming them.

An error of a monitor affects that monitor's readings alone. An error of the ring changes the modes,
which every shot shows times its complex amplitude: sums over the shots are formed once, so that a
signature is as long as the modes, whatever the number of shots.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from tmlattice.beam.stored import Moved
from tmlattice.effects import ReadingEffect, RingEffect, find
from tmlattice.inference.metric import Hypothesis, Indices, Products
from tmlattice.observe.steady import SteadyMetric
from tmlattice.observe.stored import Stored, seen_by

Array = NDArray[np.float64]

LINES = -4
"""End of the lines among the data of a shot: see `ManyTurns`."""
AT_ONCE = 256
"""Changes of modes in memory: 4 MB for 246 monitors."""


class StoredMetric(SteadyMetric):
    """Products at one point of a `Stored` problem; errors of monitors from their own readings."""

    problem: Stored

    def quick(self, hypotheses: Sequence[Hypothesis], data: Array, found: Products) -> Indices:
        """Put in products of monitor errors, by effect; return their indices."""
        problem, done = self.problem, [np.zeros(0, dtype=np.intp)]
        owner = problem.owner()[problem.used]
        place = {name: i for i, name in enumerate(problem.monitors)}
        read = np.flatnonzero(owner >= 0)
        belongs = csr_array(
            (np.ones(len(read)), (read, owner[read])), shape=(len(owner), len(place))
        )
        vectors = self.vectors(data)
        for name in dict.fromkeys(name for name, _ in hypotheses):
            effect = find(name)
            if isinstance(effect, ReadingEffect):
                which = np.array([i for i, h in enumerate(hypotheses) if h[0] == name])
                at = [place[hypotheses[i][1] or ""] for i in which]
                row = problem.as_rows(
                    problem.of_monitors(self.point.view, self.point.nuisances, effect)
                )
                along = ((vectors * row) @ belongs)[:, at].T
                self.put(which, (row**2 @ belongs)[at], along, found)
                done.append(which)
        return np.concatenate(done)

    def vectors(self, data: Array) -> Array:
        """Rows of data, then those that the nuisances span."""
        return np.concatenate([data, self.projection.Q[0].T])

    def put(self, which: Indices, whole: Array, along: Array, found: Products) -> None:
        """Set squares [hypothesis], and products with `vectors` [hypothesis, vector]."""
        data = found.inner.shape[1]
        found.put(which, whole, (along[:, data:] ** 2).sum(axis=1), along[:, :data])


class TurnsMetric(StoredMetric):
    """Products at one point of turn-by-turn data."""

    def quick(self, hypotheses: Sequence[Hypothesis], data: Array, found: Products) -> Indices:
        """Put in products of errors of the ring and of monitors; return their indices."""
        done = super().quick(hypotheses, data, found)
        ring = [i for i, (name, _) in enumerate(hypotheses) if isinstance(find(name), RingEffect)]
        which = np.array(ring, dtype=np.intp)
        whole, along = self._on_ring([hypotheses[i] for i in ring], self.vectors(data))
        self.put(which, whole, along, found)
        return np.concatenate([done, which])

    def _on_ring(self, hypotheses: Sequence[Hypothesis], vectors: Array) -> tuple[Array, Array]:
        """Squares, and products with vectors; shots of the same beam together."""
        problem, view = self.problem, self.point.view
        weight = problem.used / problem.sigma**2
        weighted = np.zeros((len(vectors), *problem.used.shape))
        weighted[:, problem.used] = (
            vectors / np.broadcast_to(problem.sigma, weighted.shape[1:])[problem.used]
        )
        amplitude = self._amplitudes()  # [shot, mode's entry]
        whole, along = np.zeros(len(hypotheses)), np.zeros((len(hypotheses), len(vectors)))
        for beam in {id(own): own for own in view.beams}.values():
            shots = [i for i, own in enumerate(view.beams) if own is beam]
            a, b = amplitude[shots].real, amplitude[shots].imag
            re, im = weighted[:, shots, :LINES:2], weighted[:, shots, 1:LINES:2]
            sums = np.stack([(a * re + b * im).sum(1), (a * im - b * re).sum(1)], axis=-1)
            u, v = weight[shots, :LINES:2], weight[shots, 1:LINES:2]
            squares = [
                (own).sum(0) for own in (a**2 * u + b**2 * v, b**2 * u + a**2 * v, a * b * (v - u))
            ]
            tunes, of_tunes = weighted[:, shots, -2:].sum(1), weight[shots, -2:].sum(0)
            for start in range(0, len(hypotheses), AT_ONCE):
                part = slice(start, start + AT_ONCE)
                moved = seen_by(beam.moved(hypotheses[part]), view.monitors.matrix())
                modes = np.ascontiguousarray(moved.modes.reshape(len(moved.modes), -1))
                x, y = modes.real, modes.imag
                whole[part] += x**2 @ squares[0] + y**2 @ squares[1] + 2 * (x * y) @ squares[2]
                whole[part] += moved.tunes**2 @ of_tunes
                along[part] += modes.view(float) @ sums.reshape(len(vectors), -1).T
                along[part] += moved.tunes @ tunes.T
        return whole, along

    def _amplitudes(self) -> NDArray[np.complex128]:
        """Amplitude with which each shot shows the modes' entries, [shot, monitor * 2 * mode]."""
        nuisances, view = self.point.nuisances, self.point.view
        size = nuisances[..., 0] + 1j * nuisances[..., 1]
        ones = [
            Moved(np.zeros(0), np.zeros(0), np.ones_like(beam.modes) * own)
            for beam, own in zip(view.beams, size, strict=True)
        ]
        shown = self.problem.with_turn_offsets(ones, view.monitors.late)
        return np.stack([own.modes.ravel() for own in shown])
