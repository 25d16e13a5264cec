"""Derivatives of the orbit response by each effect of the ring, in closed form, as factors.

To second order a corrector's kick and an error meet in four places. With the orbit's changes dc of
a column (a corrector, or the RF) and da of the error, a new kick arises at the exit of

- the error's layer: D'(x) dc, the slope of the error's direction D at the closed orbit x;
- every curved layer, where the error moves the closed orbit: T''(dc, da), feed-down;
- the corrector's layer: v'(x) da, and the error's change of the kick in the same element;

and the read-outs have corresponding terms. Every source is linear in dc = C u, u the column's
change of the launch: dz before the corrector and dz + w behind it. So with P_j the sum of
C^-1 (...) C over the layers before j, an error's change of the whole response is a few numbers for
each monitor (its reading of a launch changes) and for each column (its launch changes): `Factors`.
"""

from collections.abc import Hashable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from tmlattice.arrays import Array, Indices
from tmlattice.beam.closed_orbit import KICK, ResponseModel, feed_down
from tmlattice.effects import RingEffect, directions, find
from tmlattice.effects.directions import STEP, Directions, ring_effect
from tmlattice.errors import EffectError
from tmlattice.maps.quadratic import Quadratic, difference
from tmlattice.maps.taylor import second_derivatives

Hypothesis = tuple[str, str | None]

STILL = 1e-12
"""m and rad per unit: smaller kicks of an error are taken as no change of the closed orbit."""


def derivatives(
    model: ResponseModel,
    hypotheses: Sequence[Hypothesis],
    correctors: Sequence[str] | None = None,
) -> Iterator[Array]:
    """Yield d (orbit response) / d amount of effects.

    Args:
        correctors: names; None: all of the ring, in beam order.

    Yields:
        For each hypothesis [corrector + 1, monitor, 2]: m/rad per unit for the correctors; and in
        the last row the RF's, m per relative step per unit, 0 in four coordinates.
    """
    slopes = ResponseSlopes(model, correctors)
    return map(slopes.whole, slopes.factors(hypotheses))


@dataclass(frozen=True)
class Factors:
    """d (orbit response) / d amount of one error.

    With the slopes' `start`, `launch_kick` and `readings` (u, p and G) a monitor before a column's
    corrector changes by seen u + G before, one behind it by seen (u + p) + G (before + behind).

    Attributes:
        seen: change of each monitor's reading of the launch, [monitor, 2, n].
        before, behind: change of each column's launch, and of its kick as a launch, per unit of the
            column's kick, [column, n].
    """

    seen: Array
    before: Array
    behind: Array


class ResponseSlopes:
    """Derivatives of one response.

    Args:
        model, correctors: see `derivatives`.

    Attributes:
        start, launch_kick: each column's change of the launch per unit, and its kick as a further
            change behind it; the RF's last, [column, n].
        readings: the monitors' readings of the launch, [monitor, 2, n].
        first: the first monitor behind each column's kick; none behind the RF's, [column].

    Raises:
        UnknownNameError, MeasurementError: see `ResponseModel.columns`.
    """

    def __init__(self, model: ResponseModel, correctors: Sequence[str] | None = None) -> None:
        self.model = model
        self.columns = columns = model.columns(correctors)
        n, at = model.dimension, model.maps.at
        rf = model.rf_start if n == 6 else np.zeros(n)
        self.start = np.vstack([columns.start, rf])
        self.launch_kick = np.vstack([columns.launch_kick, np.zeros(n)])
        self.readings = model.reading_slopes
        self.first = np.append(np.searchsorted(at, columns.layer, side="right"), len(at))
        self._exits = np.append(columns.layer + 1, 0)
        self._mixes: dict[Hashable, Quadratic] = {}

    def whole(self, change: Factors) -> Array:
        """Derivative of the whole response, [column, monitor, 2]: see `derivatives`."""
        n, shape = self.model.dimension, (len(self.start), *self.readings.shape[:2])
        seen = np.concatenate([change.seen, self.readings], axis=2).reshape(-1, 2 * n).T
        out = np.hstack([self.start, change.before]) @ seen
        behind = np.hstack([self.launch_kick, change.behind]) @ seen
        there = np.arange(shape[1]) >= self.first[:, None]
        return np.asarray(out.reshape(shape) + there[:, :, None] * behind.reshape(shape))

    def picked(
        self, hypotheses: Sequence[Hypothesis], at: Indices, plane: Indices
    ) -> Iterator[Array]:
        """Yield the derivative by each hypothesis, as `whole`, of some readings, [column, monitor].

        Args:
            hypotheses: see `factors`.
            plane: of each column's readings, the RF's last, [column].
        """
        parts = []
        for p in (0, 1):
            rows = np.flatnonzero(plane == p)
            there = (at >= self.first[rows, None]).astype(float)
            parts.append((p, rows, there, self.readings[at, p]))
        out = np.empty((len(plane), len(at)))
        for change in self.factors(hypotheses):
            for p, rows, there, readings in parts:
                seen = np.hstack([change.seen[at, p], readings]).T
                behind = np.hstack([self.launch_kick[rows], change.behind[rows]]) @ seen
                out[rows] = np.hstack([self.start[rows], change.before[rows]]) @ seen
                out[rows] += there * behind
            yield out

    def factors(self, hypotheses: Sequence[Hypothesis]) -> Iterator[Factors]:
        """Yield the derivative by each hypothesis, in factors; EffectError: an effect that does not
        act on the ring."""
        for name, _ in hypotheses:
            if not isinstance(find(name), RingEffect):
                raise EffectError(f"'{name}' does not act on the ring; it has no such derivative")
        return self._factors(hypotheses)

    def _factors(self, hypotheses: Sequence[Hypothesis]) -> Iterator[Factors]:
        model, d = self.model, directions(self.model.layers, hypotheses)
        kicks, sources = self._own(d)
        rows = np.searchsorted(d.owner, np.arange(len(hypotheses) + 1))
        for h, hypothesis in enumerate(hypotheses):
            own = slice(*rows[h : h + 2])
            seen, missed, end = self._stepped(d.layer[own], sources[own])
            for r in np.flatnonzero(d.read_owner == h):
                m = d.monitor[r]
                bent = second_derivatives(d.E2[r][None])[0] @ model.path[model.maps.at[m]]
                seen[m] += (d.E1[r] + bent) @ model.tangents[model.maps.at[m]]
            behind = self._mixed(hypothesis) - missed
            if np.abs(kicks[own]).max(initial=0.0) > STILL:
                moved = self._moved(d.layer[own], kicks[own])
                seen, behind, end = seen + moved[0], behind + moved[1], end + moved[2]
            before = (self.start + self.launch_kick) @ end.T + behind
            yield Factors(seen, before @ model.closing.T, behind)

    def _own(self, d: Directions) -> tuple[Array, Array]:
        """Kick of each row of directions on the closed orbit, [row, n], and its slope by the
        launch, [row, n, n]; both as changes of the launch."""
        model = self.model
        x, back = model.path[d.layer], model.inverse[d.layer + 1]
        bent = (second_derivatives(d.D2) @ x[:, None, :, None])[..., 0]
        kick = d.D0 + ((d.D1 + bent / 2) @ x[:, :, None])[..., 0]
        kicks = (back @ kick[:, :, None])[..., 0]
        return kicks, back @ (d.D1 + bent) @ model.tangents[d.layer]

    def _stepped(self, layers: Indices, sources: Array) -> tuple[Array, Array, Array]:
        """Terms of new kicks S u [row, n, n] in layers: in the monitors' readings of the launch; in
        the columns' kicks behind the layers, [column, n]; and their sum, [n, n]."""
        seen, missed = np.zeros_like(self.readings), np.zeros_like(self.launch_kick)
        for k, source in zip(layers, sources, strict=True):
            behind = np.searchsorted(self.model.maps.at, k, side="right")
            seen[behind:] += self.readings[behind:] @ source
            missed += (self._exits > k)[:, None] * (self.launch_kick @ source.T)
        return seen, missed, sources.sum(axis=0)

    def _moved(self, layers: Indices, kicks: Array) -> tuple[Array, Array, Array]:
        """Terms of orbit kicks [row, n] in layers: in the monitors' readings of the launch, in the
        columns' kicks, [column, n], and the sum of the layers' sources, [n, n]."""
        fed, seen_by, missed_by, own_by = self._fed
        everywhere = self.model.closing @ kicks.sum(axis=0)
        seen, added = seen_by @ everywhere, (own_by - missed_by) @ everywhere
        end = fed[-1] @ (everywhere + kicks.sum(axis=0))
        for k, kick in zip(layers, kicks, strict=True):
            earlier = fed[k + 1] @ kick  # before the kick
            behind = np.searchsorted(self.model.maps.at, k, side="right")
            seen[behind:] += seen_by[behind:] @ kick - self.readings[behind:] @ earlier
            missed = missed_by @ kick - self.launch_kick @ earlier.T
            added -= (self._exits > k)[:, None] * missed
            added += (self._exits > k + 1)[:, None] * (own_by @ kick)
            end -= earlier
        return seen, added, end

    @cached_property
    def _fed(self) -> tuple[Array, Array, Array, Array]:
        """Feed-down of a change of the orbit, as one of the launch (the last axis).

        Returns:
            The sum of C^-1 T''(., C da) C over the layers before each, [layer + 2, n, n, n]; the
            change of a monitor's reading of a column's launch, [monitor, 2, n, n]; the part of the
            sum before a column's kick; and the change of that kick itself, [column, n, n].
        """
        model, maps, n = self.model, self.model.maps, self.model.dimension
        C, back, columns = model.tangents, model.inverse, self.columns
        fed = feed_down(model, back, C)
        G, at = self.readings, maps.at
        seen = np.einsum("mpa,mabi->mpbi", G, fed[at])
        if maps.R2.any():
            bends = second_derivatives(maps.R2)
            seen += np.einsum("mpxy,mxb,myi->mpbi", bends, C[at], C[at], optimize=True)
        missed = np.einsum("cabi,cb->cai", fed[self._exits], self.launch_kick)
        own = np.zeros((len(self.launch_kick), n, n))
        own[:-1] = back[columns.layer + 1] @ columns.slope @ C[columns.layer]
        return fed, seen, missed, own

    def _mixed(self, hypothesis: Hypothesis) -> Array:
        """Change of a corrector's kick by an error in it, as a change of the launch."""
        model, columns = self.model, self.columns
        mixed = np.zeros_like(self.launch_kick)
        effect, place = ring_effect(hypothesis[0]), hypothesis[1]
        members = effect.members(model.ring, place)
        for c in np.flatnonzero(np.isin(columns.place, members)):
            i, k = int(columns.place[c]), int(columns.layer[c])
            w0, w1, w2 = self._mix(effect, i).after(model.layers.way(k)).reduced()
            x = model.path[k]
            image = w0 + (w1 + second_derivatives(w2[None])[0] @ x / 2) @ x
            mixed[c] = model.inverse[k + 1] @ image
        return mixed

    def _mix(self, effect: RingEffect, place: int) -> Quadratic:
        """d2 (map of a corrector) / d kick d amount; shared by equal correctors."""
        layers = self.model.layers
        element, h = layers.ring.elements[place], STEP * effect.largest
        key = (effect.name, layers.physics(element))
        if key not in self._mixes:
            ends = []
            for kick, amount in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
                set_to = element.changed(angle=element.angle + kick * KICK)
                there = effect.changed(set_to, amount * h, layers.ring.energy)
                ends.append((kick * amount, layers.map(there)))
            self._mixes[key] = difference(ends, 4 * KICK * h)
        return self._mixes[key]
