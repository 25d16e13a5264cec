"""How errors change the orbit response: each effect of the ring in closed form, in one pass.

To second order a corrector's kick and an error meet in four places. With the orbit's changes dc of
a column (a corrector, or the RF) and da of the error, a new kick arises at the exit of

- the error's layer: D'(x) dc, the slope of the error's direction D at the closed orbit x;
- every layer that bends the map, where the error moves the closed orbit: T''(dc, da), feed-down;
- the corrector's layer: v'(x) da, and what the error makes of the kick in the same element;

and the read-outs gain the like. Every source is linear in dc = C u, u the column's change of the
launch: dz before the corrector and dz + w behind it. So with P_j the sum of C^-1 (...) C over the
layers before j, all columns cost two small matrix products per error.
"""

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from tmlattice.beam.closed_orbit import KICK, Columns, ResponseModel
from tmlattice.effects import RingEffect, directions, find
from tmlattice.effects.directions import STEP, Directions
from tmlattice.errors import EffectError
from tmlattice.maps.taylor import second_derivatives

Array = NDArray[np.float64]

STILL = 1e-12
"""m and rad per unit: an error whose own kick is smaller leaves the closed orbit where it is."""


def derivatives(
    model: ResponseModel,
    hypotheses: Sequence[tuple[str, str | None]],
    correctors: Sequence[str] | None = None,
) -> Iterator[Array]:
    """d (orbit response) / d amount of effects, one after another.

    Args:
        model: the ring about which the response is linear; its monitors read without errors.
        hypotheses: (effect, place) of the catalogue, of effects on the ring.
        correctors: names; None: all of the ring, in beam order.

    Yields:
        For each hypothesis [corrector + 1, monitor, 2]: m/rad per unit for the correctors; and in
        the last row the RF's, m per relative step per unit, 0 in four coordinates.

    Raises:
        EffectError: an effect that does not act on the ring.
        UnknownNameError, MeasurementError: see `ResponseModel.columns`.
    """
    for name, _ in hypotheses:
        if not isinstance(find(name), RingEffect):
            raise EffectError(f"'{name}' does not act on the ring; its derivative is not here")
    return _Pass(model, model.columns(correctors), hypotheses).run()


class _Pass:
    def __init__(
        self,
        model: ResponseModel,
        columns: Columns,
        hypotheses: Sequence[tuple[str, str | None]],
    ) -> None:
        self.model, self.columns, self.hypotheses = model, columns, hypotheses
        n, maps = model.dimension, model.maps
        rf = model.rf_start if n == 6 else np.zeros(n)
        self.start = np.vstack([columns.start, rf])
        self.pulled = np.vstack([columns.pulled, np.zeros(n)])
        after = model.downstream(columns)
        self.after = np.vstack([after, np.zeros((1, after.shape[1]), dtype=bool)])[:, :, None]
        self.exits = np.append(columns.layer + 1, 0)
        # the closing way of the ring is its last layer
        bends = np.concatenate([maps.W2, maps.closing.coefficients[2][None]])
        self.bends = second_derivatives(bends)
        self.curved = np.flatnonzero(bends.any(axis=(1, 2)))
        self.read_bends = second_derivatives(maps.R2)
        self.reads_bend = bool(maps.R2.any())
        self.directions: Directions = directions(model.layers, hypotheses)

    def run(self) -> Iterator[Array]:
        """The derivative by each hypothesis."""
        d = self.directions
        for h, hypothesis in enumerate(self.hypotheses):
            yield self._one(
                hypothesis, np.flatnonzero(d.owner == h), np.flatnonzero(d.read_owner == h)
            )

    def _one(
        self, hypothesis: tuple[str, str | None], rows: NDArray[np.intp], reads: NDArray[np.intp]
    ) -> Array:
        model, d, n = self.model, self.directions, self.model.dimension
        path, C, back, at = model.path, model.tangents, model.inverse, model.maps.at
        G = model.reading_slopes
        sources = np.zeros((len(C) - 1, n, n))  # C^-1 (...) C of each layer
        moved = np.zeros((len(C) - 1, n))  # w of the error's own kicks
        for r in rows:
            k = d.layer[r]
            bent = second_derivatives(d.D2[r][None])[0] @ path[k]
            sources[k] += back[k + 1] @ (d.D1[r] + bent) @ C[k]
            moved[k] += back[k + 1] @ (d.D0[r] + (d.D1[r] + bent / 2) @ path[k])
        own = np.zeros_like(self.pulled)
        reading = np.zeros_like(G)
        if np.abs(moved).max() > STILL:
            launch = np.concatenate([np.zeros((1, n)), np.cumsum(moved, axis=0)])
            launch += model.closing @ launch[-1]
            orbit = np.einsum("kij,kj->ki", C, launch)
            j = self.curved
            sources[j] += back[j + 1] @ np.einsum("kaij,kj->kai", self.bends[j], orbit[j]) @ C[j]
            at_corrector = np.einsum("cij,cj->ci", self.columns.slope, orbit[self.columns.layer])
            own[:-1] += self._pull(at_corrector)
            if self.reads_bend:
                reading += np.einsum("maij,mj->mai", self.read_bends, orbit[at]) @ C[at]
        for r in reads:
            m = d.monitor[r]
            bent = second_derivatives(d.E2[r][None])[0] @ path[at[m]]
            reading[m] += (d.E1[r] + bent) @ C[at[m]]
        own[:-1] += self._mixed(hypothesis)

        total = np.concatenate([np.zeros((1, n, n)), np.cumsum(sources, axis=0)])
        missed = np.einsum("cij,cj->ci", total[self.exits], self.pulled)
        end = self.start @ total[-1].T + self.pulled @ total[-1].T - missed + own
        everywhere = end @ model.closing.T
        carried = G @ total[at] + reading
        before = np.einsum("mai,ci->cma", carried, self.start, optimize=True)
        before += np.einsum("mai,ci->cma", G, everywhere, optimize=True)
        behind = np.einsum("mai,ci->cma", carried, self.pulled, optimize=True)
        behind += np.einsum("mai,ci->cma", G, own - missed, optimize=True)
        return np.asarray(before + self.after * behind)

    def _pull(self, kicks: Array) -> Array:
        """Kicks at the exits of the correctors' layers as changes of the launch."""
        return np.asarray(
            np.einsum("cij,cj->ci", self.model.inverse[self.columns.layer + 1], kicks)
        )

    def _mixed(self, hypothesis: tuple[str, str | None]) -> Array:
        """What an error in a corrector makes of its own kick, as a change of the launch."""
        model, columns = self.model, self.columns
        mixed = np.zeros((len(columns.names), model.dimension))
        effect, place = find(hypothesis[0]), hypothesis[1]
        assert isinstance(effect, RingEffect)
        members = effect.members(model.ring, place)
        for c in np.flatnonzero(np.isin(columns.place, members)):
            i, k = int(columns.place[c]), int(columns.layer[c])
            element, h = model.layers.ring.elements[i], STEP * effect.largest
            x = model.path[k]
            for kick, amount in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
                set_to = element.changed(angle=element.angle + kick * KICK)
                there = effect.changed(set_to, amount * h, model.ring.energy)
                w0, w1, w2 = model.layers.layer(k, {i: there})[0]
                image = w0 + (w1 + second_derivatives(w2[None])[0] @ x / 2) @ x
                mixed[c] += kick * amount * image / (4 * KICK * h)
        return self._pull(mixed)
