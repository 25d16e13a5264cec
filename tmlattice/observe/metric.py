"""Products of signatures of first turns, launches projected out.

Most signatures equal a launch's from a reading on (a single kick), or are confined to one monitor
(an effect on readings): cumulative sums over the readings give all their products. The others are
formed in chunks. The squares of independent noise, and of noise correlated over all shots by
distributed errors, have separate implementations.
"""

from abc import abstractmethod
from collections.abc import Sequence
from functools import cached_property

import numpy as np

from tmlattice.arrays import Array, Indices
from tmlattice.beam.model import Model, Paths
from tmlattice.effects import Hypothesis
from tmlattice.inference.problem import Metric, Products, effects_on_readings
from tmlattice.inference.whitening import Projection
from tmlattice.observe.data import Whitening, each_shot


def behind(values: Array) -> Array:
    """Sums over all readings from each on, [shot, reading, ...] -> [shot, reading + 1, ...]."""
    zero = np.zeros_like(values[:, :1])
    return np.concatenate([np.cumsum(values[:, ::-1], axis=1)[:, ::-1], zero], axis=1)


class TurnMetric(Metric):
    """Products at one set of trajectories; this class forms every signature.

    Args:
        model, paths, launches: the trajectories.
        whitening, projection: of the data, and of the launches.
    """

    def __init__(
        self,
        model: Model,
        paths: Paths,
        launches: Array,
        whitening: Whitening,
        projection: Projection,
    ) -> None:
        super().__init__(projection)
        self.model, self.paths, self.launches = model, paths, launches
        self.whitening = whitening
        self.weight = whitening.weight

    # --- named hypotheses -----------------------------------------------------------------------
    def rows(self, hypotheses: Sequence[Hypothesis]) -> Array:
        """Return every signature."""
        signatures = np.nan_to_num(self.model.signatures(self.paths, hypotheses, self.launches))
        return self.whitening.signature(signatures)

    # --- what has no name -----------------------------------------------------------------------
    def free_kicks(self, layers: Indices, clean: Array) -> tuple[Array, Array]:
        """See `Metric`; of kicks (px, py) in each shot, in the middle of layers' magnets."""
        grams, inners = [], []
        count = max(self.chunk // len(self.weight), 1)
        for start in range(0, len(layers), count):
            rows, parts = self._free_rows(layers[start : start + count], clean)
            grams.append(np.einsum("kbpr,kbqr->kbpq", rows, rows, optimize=True))
            inners.append(np.einsum("kbpr,br->kbp", rows, parts, optimize=True))
        return np.concatenate(grams), np.concatenate(inners)

    def _free_rows(self, layers: Indices, clean: Array) -> tuple[Array, Array]:
        """Whitened signatures of free kicks [layer, block, p, row], and data [block, row]."""
        kicked = self.model.kick_signatures(self.paths, layers)
        alone = each_shot(kicked)
        rows = self.projection.out(self.whitening.signature(alone))
        return rows.reshape(len(kicked), 1, -1, len(clean)), clean[None]

    @cached_property
    def precision(self) -> Array:
        """See `Whitening.projected_precision`."""
        return self.whitening.projected_precision(self.projection)

    def free_monitors(self, clean: Array) -> tuple[Array, Array]:
        """Information of all readings of each monitor, in every shot and turn."""
        data = self.whitening.back(clean)
        monitors, weight = len(self.model.at), self.weight
        flat = np.arange(weight.size).reshape(weight.shape)
        grams, inners = [], []
        for m in range(monitors):
            own = flat[:, m::monitors].ravel()
            scale = weight.ravel()[own]
            grams.append((scale[:, None] * self.precision[np.ix_(own, own)] * scale)[None])
            inners.append(data.ravel()[own][None])
        return np.stack(grams), np.stack(inners)


class SummedMetric(TurnMetric):
    """Products of single kicks and of effects on readings, from sums over readings."""

    def quick(self, hypotheses: Sequence[Hypothesis], data: Array, found: Products) -> Indices:
        """Put in products of single kicks and of effects on readings; return their indices."""
        rows = self.whitening.back(data)  # for products with signatures in m
        done = (self._kicks(hypotheses, rows, found), self._readings(hypotheses, rows, found))
        return np.concatenate(done)

    @abstractmethod
    def kick_squares(self, start: Indices, launch_kick: Array) -> tuple[Array, Array | float]:
        """Squares of kicks, and their parts along the launches' directions, [kick]; from the first
        reading behind each [kick], and the launches equal to them there [shot, kick, n]."""

    @abstractmethod
    def reading_squares(self, change: Array, at: Indices) -> tuple[Array, Array | float]:
        """Squares of an effect at some monitors, and their parts along the launches' directions,
        [monitor]; from its change of all readings over noise [shot, reading, 2]."""

    @cached_property
    def _slopes(self) -> Array:
        """d readings / d launch, [shot, reading, 2, n]."""
        return self.model.slopes(self.paths)

    def _behind(self, row: Array) -> Array:
        """Data times the launches' signatures from each reading on, [shot, reading + 1, n]."""
        return behind(np.einsum("smpi,smp->smi", self._slopes, row))

    def _kicks(self, hypotheses: Sequence[Hypothesis], rows: Array, found: Products) -> Indices:
        """Put in products of single kicks, from cumulative sums over the readings."""
        which, start, launch_kick = self.model.single_kicks(self.paths, hypotheses)
        if not len(which):
            return which
        inner = np.empty((len(which), len(rows)))
        for d, row in enumerate(rows):
            inner[:, d] = np.einsum("ski,ski->k", launch_kick, self._behind(row)[:, start])
        found.put(which, *self.kick_squares(start, launch_kick), inner)
        return which

    def _readings(self, hypotheses: Sequence[Hypothesis], rows: Array, found: Products) -> Indices:
        """Put in products of effects on readings, each from one monitor's readings."""
        done = [np.zeros(0, dtype=np.intp)]
        for effect, which, at in effects_on_readings(hypotheses, self.model.maps.monitors):
            change = np.nan_to_num(self.model.reading_signatures(self.paths, effect))
            product = np.einsum("srp,dsrp->rd", change, rows, optimize=True)
            inner = product.reshape(self.model.turns, -1, len(rows)).sum(axis=0)[at]
            found.put(which, *self.reading_squares(self.weight * change, at), inner)
            done.append(which)
        return np.concatenate(done)


class IndependentMetric(SummedMetric):
    """Products with independent noise of the readings."""

    @cached_property
    def _known(self) -> Array:
        """Directions of the launches in the readings, [shot, reading, 2, direction]."""
        return self.projection.Q[:, :-5].reshape(*self.weight.shape, -1)

    def kick_squares(self, start: Indices, launch_kick: Array) -> tuple[Array, Array]:
        """See `SummedMetric`."""
        slopes = self.weight[..., None] * self._slopes
        gram = behind(np.einsum("smpi,smpj->smij", slopes, slopes, optimize=True))
        along = behind(np.einsum("smpi,smpq->smiq", slopes, self._known, optimize=True))
        whole = np.einsum(
            "ski,skij,skj->k", launch_kick, gram[:, start], launch_kick, optimize=True
        )
        inside = np.einsum("ski,skiq->skq", launch_kick, along[:, start], optimize=True)
        return whole, np.einsum("skq,skq->k", inside, inside)

    def reading_squares(self, change: Array, at: Indices) -> tuple[Array, Array]:
        """See `SummedMetric`."""
        shape = (len(self.weight), self.model.turns, len(self.model.at), 2)
        change, Q = change.reshape(shape), self._known.reshape(*shape, -1)
        along = np.einsum("stmp,stmpq->smq", change, Q, optimize=True)
        whole = np.einsum("stmp,stmp->m", change, change)
        return whole[at], np.einsum("smq,smq->m", along, along)[at]

    def _free_rows(self, layers: Indices, clean: Array) -> tuple[Array, Array]:
        """Rows of free kicks; each shot is a block, as a kick acts in its own shot."""
        kicked = self.model.kick_signatures(self.paths, layers)
        rows = self.projection.out(self.whitening.signature(kicked))
        by_shot = rows.reshape(len(kicked), 2, len(self.weight), -1).swapaxes(1, 2)
        return by_shot, clean.reshape(len(self.weight), -1)

    def free_monitors(self, clean: Array) -> tuple[Array, Array]:
        """Information by shot: a monitor's rows less their part along the launch's directions."""
        monitors, count = len(self.model.at), len(self.weight)
        rows = np.arange(self.weight[0].size).reshape(self.model.turns, monitors, 2)
        at = rows.swapaxes(0, 1).reshape(monitors, -1)  # [monitor, turn * plane]
        weight = self.weight.reshape(count, -1)[:, at]
        Q = self.projection.Q[:, at]  # [shot, monitor, p, direction]
        gram = np.eye(at.shape[1]) - np.einsum("smpd,smqd->smpq", Q, Q)
        gram = weight[..., :, None] * gram * weight[..., None, :]
        inner = weight * clean.reshape(count, -1)[:, at]
        return gram.swapaxes(0, 1), inner.swapaxes(0, 1)


class DenseMetric(SummedMetric):
    """Products with readings of one turn that are correlated over all shots.

    Readings are ordered by monitor. The Gram matrix of the launches' signatures behind a monitor
    grows by that monitor's rows: all of them cost one product of the precision with the slopes.
    """

    @cached_property
    def _precision(self) -> Array:
        """Precision less the launches' part, in units of the noise, [monitor shot plane, same]."""
        order = np.arange(self.weight.size).reshape(self.weight.shape).swapaxes(0, 1).ravel()
        return self.precision[np.ix_(order, order)]

    def _block(self, m: int) -> Array:
        """Block of one monitor's readings, [shot plane, shot plane]."""
        own = slice(2 * len(self.weight) * m, 2 * len(self.weight) * (m + 1))
        return np.asarray(self._precision[own, own])

    @cached_property
    def _grams(self) -> Array:
        """Gram matrices of the launches' signatures from each reading on, [reading + 1, shot n,
        shot n]."""
        slopes = self.weight[..., None] * self._slopes
        shots, monitors, _, n = slopes.shape
        spread = np.zeros((monitors, shots, 2, shots, n))
        for shot in range(shots):
            spread[:, shot, :, shot] = slopes[shot]
        H = spread.reshape(monitors, 2 * shots, shots * n)
        rows = H.reshape(-1, shots * n)
        grams = np.zeros((monitors + 1, shots * n, shots * n))
        for m in range(monitors - 1, -1, -1):
            own = slice(2 * shots * m, 2 * shots * (m + 1))
            rest = slice(2 * shots * (m + 1), None)
            cross = H[m].T @ (self._precision[own, rest] @ rows[rest])
            grams[m] = grams[m + 1] + cross + cross.T + H[m].T @ self._block(m) @ H[m]
        return grams

    def kick_squares(self, start: Indices, launch_kick: Array) -> tuple[Array, float]:
        """See `SummedMetric`; from the Gram matrices of the readings behind the kicks."""
        stacked = np.moveaxis(launch_kick, 0, 1).reshape(len(start), -1)  # [kick, shot n]
        whole = np.empty(len(start))
        for m in np.unique(start):
            at = start == m
            whole[at] = np.einsum("ki,ij,kj->k", stacked[at], self._grams[m], stacked[at])
        return whole, 0.0

    def reading_squares(self, change: Array, at: Indices) -> tuple[Array, float]:
        """See `SummedMetric`; from one monitor's block of the precision."""
        rows = np.moveaxis(change, 1, 0).reshape(change.shape[1], -1)[at]
        return np.array([row @ self._block(m) @ row for row, m in zip(rows, at, strict=True)]), 0.0

    def free_kicks(self, layers: Indices, clean: Array) -> tuple[Array, Array]:
        """One block for all shots: the background correlates them."""
        first, launch_kick = self.model.free_kicks(self.paths, layers)  # [layer, 2, shot, n]
        sums = self._behind(self.whitening.back(clean))
        size = 2 * len(self.weight)
        gram, inner = np.empty((len(layers), 1, size, size)), np.empty((len(layers), 1, size))
        alone = each_shot(launch_kick).reshape(len(layers), size, -1)
        for k, (m, flat) in enumerate(zip(first, alone, strict=True)):
            gram[k, 0] = flat @ self._grams[m] @ flat.T
            inner[k, 0] = flat @ sums[:, m].ravel()
        return gram, inner
