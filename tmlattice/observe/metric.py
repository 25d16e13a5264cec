"""Products of signatures of first turns, launches projected out.

Most signatures equal a launch's from a reading on (a single kick), or are confined to one monitor
(an effect on readings): cumulative sums over the readings give all their products. The others are
formed in chunks. Independent noise, and noise correlated over all shots by distributed errors, have
separate implementations.
"""

from collections.abc import Sequence
from functools import cached_property

import numpy as np

from tmlattice.arrays import Array, Flags, Indices
from tmlattice.beam.model import Model, Paths
from tmlattice.effects import ReadingEffect, find
from tmlattice.inference.problem import Hypothesis, Metric, Products
from tmlattice.inference.whitening import Projection, Whitening


def behind(values: Array) -> Array:
    """Sums over all readings from each on, [shot, reading, ...] -> [shot, reading + 1, ...]."""
    zero = np.zeros_like(values[:, :1])
    return np.concatenate([np.cumsum(values[:, ::-1], axis=1)[:, ::-1], zero], axis=1)


class TurnMetric(Metric):
    """Products at one set of trajectories; this class forms every signature.

    Args:
        model, paths, launches: the trajectories.
        whitening, projection: of the data, and of the launches.
        active: shots in which causes act, [shot].
    """

    def __init__(
        self,
        model: Model,
        paths: Paths,
        launches: Array,
        whitening: Whitening,
        projection: Projection,
        active: Flags,
    ) -> None:
        super().__init__(projection)
        self.model, self.paths, self.launches = model, paths, launches
        self.whitening = whitening
        self.active = active
        self.shots = np.flatnonzero(active)
        self.weight = whitening.weight * active[:, None, None]

    # --- named hypotheses -----------------------------------------------------------------------
    def rows(self, hypotheses: Sequence[Hypothesis]) -> Array:
        """Return every signature."""
        signatures = np.nan_to_num(self.model.signatures(self.paths, hypotheses, self.launches))
        return self.whitening.signature(signatures * self.active[:, None, None])

    def quick(self, hypotheses: Sequence[Hypothesis], data: Array, found: Products) -> Indices:
        """Put in products of single kicks and of effects on readings; return their indices."""
        done = (self.kicks(hypotheses, data, found), self.readings(hypotheses, data, found))
        return np.concatenate(done)

    def kicks(self, hypotheses: Sequence[Hypothesis], data: Array, found: Products) -> Indices:
        """Put in products of single kicks; return the indices of their hypotheses."""
        return np.zeros(0, dtype=np.intp)

    def readings(self, hypotheses: Sequence[Hypothesis], data: Array, found: Products) -> Indices:
        """Put in products of effects on readings; return the indices of their hypotheses."""
        return np.zeros(0, dtype=np.intp)

    def _on_readings(self, hypotheses: Sequence[Hypothesis]) -> dict[str, tuple[Indices, Indices]]:
        """Indices of the hypotheses on readings, and of their monitors, by effect."""
        monitor = {name: m for m, name in enumerate(self.model.maps.monitors)}
        members: dict[str, list[tuple[int, int]]] = {}
        for i, (name, place) in enumerate(hypotheses):
            if place is not None and isinstance(find(name), ReadingEffect):
                members.setdefault(name, []).append((i, monitor[place]))
        return {
            name: (np.array([i for i, _ in some]), np.array([m for _, m in some]))
            for name, some in members.items()
        }

    def _changed_readings(self, name: str) -> Array:
        """d readings / d amount of an effect at every monitor, [shot, reading, 2]."""
        return np.asarray(np.nan_to_num(self.model.reading_signatures(self.paths, name)))

    # --- what has no name -----------------------------------------------------------------------
    def free_kicks(self, layers: Indices, clean: Array) -> tuple[Array, Array]:
        """Information of a kick (px, py) in every active shot in the middle of layers' magnets, and
        its product with data.

        Returns:
            [layer, block, p, p] and [layer, block, p]; parameters of different blocks are
            independent.
        """
        grams, inners = [], []
        count = max(self.chunk // len(self.shots), 1)
        for start in range(0, len(layers), count):
            rows, parts = self._free_rows(layers[start : start + count], clean)
            grams.append(np.einsum("kbpr,kbqr->kbpq", rows, rows, optimize=True))
            inners.append(np.einsum("kbpr,br->kbp", rows, parts, optimize=True))
        return np.concatenate(grams), np.concatenate(inners)

    def _free_rows(self, layers: Indices, clean: Array) -> tuple[Array, Array]:
        """Whitened signatures of free kicks [layer, block, p, row], and data [block, row]."""
        kicked = self.model.kick_signatures(self.paths, layers)
        alone = np.zeros((len(kicked), len(self.shots), *kicked.shape[1:]))
        for i, shot in enumerate(self.shots):
            alone[:, i, :, shot] = kicked[:, :, shot]
        rows = self.projection.out(self.whitening.signature(alone))
        return rows.reshape(len(kicked), 1, -1, len(clean)), clean[None]

    def free_monitors(self, clean: Array) -> tuple[Array, Array]:
        """Information of all readings of each monitor, in every active shot and turn."""
        precision = self.whitening.projected_precision(self.projection)
        data = self.whitening.back(clean.reshape(self.whitening.shots, -1)[:, :-5])
        monitors, weight = len(self.model.at), self.whitening.weight
        flat = np.arange(weight.size).reshape(weight.shape)
        grams, inners = [], []
        for m in range(monitors):
            own = flat[self.shots][:, m::monitors].ravel()
            scale = weight.ravel()[own]
            grams.append((scale[:, None] * precision[np.ix_(own, own)] * scale)[None])
            inners.append(data.ravel()[own][None])
        return np.stack(grams), np.stack(inners)


class IndependentMetric(TurnMetric):
    """Products with independent noise of the readings."""

    @cached_property
    def _slopes(self) -> Array:
        """d readings / d launch in units of the noise, [shot, reading, 2, n]."""
        return np.asarray(self.whitening.weight[..., None] * self.model.slopes(self.paths))

    @cached_property
    def _known(self) -> Array:
        """Directions of the launches in the readings, [shot, reading, 2, direction]."""
        shots, readings = self.weight.shape[:2]
        return self.projection.Q[:, :-5].reshape(shots, readings, 2, -1)

    def _rows(self, data: Array) -> Array:
        """Data without the launches' rows, [data, shot, reading, 2]."""
        shots, readings = self.weight.shape[:2]
        return data.reshape(len(data), shots, -1)[:, :, :-5].reshape(-1, shots, readings, 2)

    def kicks(self, hypotheses: Sequence[Hypothesis], data: Array, found: Products) -> Indices:
        """Put in products of single kicks, from cumulative sums over the readings."""
        which, start, launch_kick = self.model.single_kicks(self.paths, hypotheses)
        if not len(which):
            return which
        launch_kick = launch_kick * self.active[:, None, None]
        slopes = self._slopes
        gram = behind(np.einsum("smpi,smpj->smij", slopes, slopes, optimize=True))
        along = behind(np.einsum("smpi,smpq->smiq", slopes, self._known, optimize=True))
        whole = np.einsum(
            "ski,skij,skj->k", launch_kick, gram[:, start], launch_kick, optimize=True
        )
        inside = np.einsum("ski,skiq->skq", launch_kick, along[:, start], optimize=True)
        inner = np.empty((len(which), len(data)))
        for d, row in enumerate(self._rows(data)):
            sums = behind(np.einsum("smpi,smp->smi", slopes, row))
            inner[:, d] = np.einsum("ski,ski->k", launch_kick, sums[:, start])
        found.put(which, whole, np.einsum("skq,skq->k", inside, inside), inner)
        return which

    def readings(self, hypotheses: Sequence[Hypothesis], data: Array, found: Products) -> Indices:
        """Put in products of effects on readings, each from one monitor's readings."""
        shape = (len(self.active), self.model.turns, len(self.model.at), 2)
        Q, rows = self._known.reshape(*shape, -1), self._rows(data).reshape(-1, *shape)
        done = [np.zeros(0, dtype=np.intp)]
        for name, (which, at) in self._on_readings(hypotheses).items():
            change = (self.weight * self._changed_readings(name)).reshape(shape)
            along = np.einsum("stmp,stmpq->smq", change, Q, optimize=True)
            found.put(
                which,
                np.einsum("stmp,stmp->m", change, change)[at],
                np.einsum("smq,smq->m", along, along)[at],
                np.einsum("stmp,dstmp->md", change, rows, optimize=True)[at],
            )
            done.append(which)
        return np.concatenate(done)

    def _free_rows(self, layers: Indices, clean: Array) -> tuple[Array, Array]:
        """Rows of free kicks; each shot is a block, as a kick acts in its own shot."""
        kicked = self.model.kick_signatures(self.paths, layers)
        rows = self.projection.out(self.whitening.signature(kicked))
        by_shot = rows.reshape(len(kicked), 2, len(self.active), -1).swapaxes(1, 2)
        return by_shot[:, self.shots], clean.reshape(len(self.active), -1)[self.shots]

    def free_monitors(self, clean: Array) -> tuple[Array, Array]:
        """Information by shot: a monitor's rows less their part along the launch's directions."""
        monitors, count = len(self.model.at), len(self.active)
        rows = np.arange(self.weight[0].size).reshape(self.model.turns, monitors, 2)
        at = rows.swapaxes(0, 1).reshape(monitors, -1)  # [monitor, turn * plane]
        weight = self.whitening.weight.reshape(count, -1)[self.shots][:, at]
        Q = self.projection.Q[self.shots][:, at]  # [shot, monitor, p, direction]
        gram = np.eye(at.shape[1]) - np.einsum("smpd,smqd->smpq", Q, Q)
        gram = weight[..., :, None] * gram * weight[..., None, :]
        inner = weight * clean.reshape(count, -1)[self.shots][:, at]
        return gram.swapaxes(0, 1), inner.swapaxes(0, 1)


class DenseMetric(TurnMetric):
    """Products with readings of one turn that are correlated over all shots.

    Readings are ordered by monitor. The Gram matrix of the launches' signatures behind a monitor
    grows by that monitor's rows: all of them cost one product of the precision with the slopes.
    """

    @cached_property
    def _precision(self) -> Array:
        """Precision less the launches' part, in units of the noise, [monitor shot plane, same]."""
        order = np.arange(self.weight.size).reshape(self.weight.shape).swapaxes(0, 1).ravel()
        precision = self.whitening.projected_precision(self.projection)
        return precision[np.ix_(order, order)]

    def _block(self, m: int) -> Array:
        """Block of one monitor's readings, [shot plane, shot plane]."""
        own = slice(2 * len(self.active) * m, 2 * len(self.active) * (m + 1))
        return np.asarray(self._precision[own, own])

    def _data(self, rows: Array) -> Array:
        """Precision times data, for products with signatures: [data, shot, reading, 2]."""
        parts = rows.reshape(len(rows), len(self.active), -1)[:, :, :-5]
        return self.whitening.back(parts) * (self.weight > 0)

    @cached_property
    def _slopes(self) -> Array:
        """d readings / d launch, [shot, reading, 2, n]."""
        return self.model.slopes(self.paths)

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

    def kicks(self, hypotheses: Sequence[Hypothesis], data: Array, found: Products) -> Indices:
        """Put in products of single kicks, from the Gram matrices of the readings behind them."""
        which, start, launch_kick = self.model.single_kicks(self.paths, hypotheses)
        if not len(which):
            return which
        stacked = np.moveaxis(launch_kick, 0, 1).reshape(len(which), -1)  # [kick, shot n]
        whole = np.empty(len(which))
        for m in np.unique(start):
            at = start == m
            whole[at] = np.einsum("ki,ij,kj->k", stacked[at], self._grams[m], stacked[at])
        inner = np.empty((len(which), len(data)))
        for d, row in enumerate(self._data(data)):
            sums = behind(np.einsum("smpi,smp->smi", self._slopes, row))
            inner[:, d] = np.einsum("ski,ski->k", launch_kick, sums[:, start])
        found.put(which, whole, 0.0, inner)
        return which

    def readings(self, hypotheses: Sequence[Hypothesis], data: Array, found: Products) -> Indices:
        """Put in products of effects on readings, from one monitor's block of the precision."""
        rows = self._data(data)
        done = [np.zeros(0, dtype=np.intp)]
        for name, (which, at) in self._on_readings(hypotheses).items():
            change = self._changed_readings(name)
            weighted = self.weight * change
            whole = np.array([weighted[:, m].ravel() @ self._block(m) @ weighted[:, m].ravel()
                              for m in at])  # fmt: skip
            found.put(which, whole, 0.0, np.einsum("smp,dsmp->md", change, rows)[at])
            done.append(which)
        return np.concatenate(done)

    def free_kicks(self, layers: Indices, clean: Array) -> tuple[Array, Array]:
        """One block for all shots: the background correlates them."""
        first, launch_kick = self.model.free_kicks(self.paths, layers)  # [layer, 2, shot, n]
        sums = behind(np.einsum("smpi,smp->smi", self._slopes, self._data(clean[None])[0]))
        size = 2 * len(self.shots)
        gram, inner = np.empty((len(layers), 1, size, size)), np.empty((len(layers), 1, size))
        for k, m in enumerate(first):
            alone = np.zeros((len(self.shots), 2, len(self.active), launch_kick.shape[3]))
            for i, shot in enumerate(self.shots):
                alone[i, :, shot] = launch_kick[k, :, shot]
            flat = alone.reshape(size, -1)
            gram[k, 0] = flat @ self._grams[m] @ flat.T
            inner[k, 0] = flat @ sums[:, m].ravel()
        return gram, inner
