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

from collections.abc import Hashable, Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_array

from tmlattice.arrays import AT_ONCE, Array, Indices
from tmlattice.beam.closed_orbit import KICK, ResponseModel, feed_down
from tmlattice.compiled import jit_sums
from tmlattice.effects import Hypothesis, RingEffect, directions, find
from tmlattice.effects.directions import STEP, Directions, ring_effect
from tmlattice.errors import EffectError
from tmlattice.maps.quadratic import Quadratic, slopes, stacked
from tmlattice.maps.taylor import second_derivatives

STILL = 1e-12
"""m and rad per unit: smaller kicks of an error are taken as no change of the closed orbit."""


def kicks_on_orbit(model: ResponseModel, d: Directions) -> tuple[Array, Array]:
    """Return the kick of each row of directions on the closed orbit as a change of the launch,
    [row, n], and its slope by the state at the layer's entrance, [row, n, n]."""
    x = model.path[d.layer][:, :, None]
    bent = (second_derivatives(d.D2) @ x[:, None])[..., 0]
    kick = d.D0[..., None] + (d.D1 + bent / 2) @ x
    return (model.inverse[d.layer + 1] @ kick)[..., 0], d.D1 + bent


class Factors(NamedTuple):
    """d (orbit response) / d amount of errors.

    With the slopes' `start`, `launch_kick` and `readings` (u, p and G) a monitor before a column's
    corrector changes by seen u + G before, one behind it by seen (u + p) + G (before + behind).

    Attributes:
        seen: change of each monitor's reading of the launch, [error, monitor, 2, n].
        before, behind: change of each column's launch, and of its kick as a launch, per unit of the
            column's kick, [error, column, n].
    """

    seen: Array
    before: Array
    behind: Array

    def combined(self, shares: Array | csr_array) -> "Factors":
        """Factors of sums of errors with shares [sum, error]."""
        return Factors(
            *((shares @ own.reshape(len(own), -1)).reshape(-1, *own.shape[1:]) for own in self)
        )

    def products(self, sums: "Factors") -> Array:
        """Products with sums over data in place of the errors, [error, data]."""
        pairs = zip(self, sums, strict=True)
        return np.asarray(sum(a.reshape(len(a), -1) @ b.reshape(len(b), -1).T for a, b in pairs))


class ResponseSlopes:
    """Derivatives of one response.

    Args:
        correctors: names; None: all of the ring, in beam order.

    Attributes:
        start, launch_kick: each column's change of the launch per unit, and its kick as a further
            change behind it; the RF's last, [column, n].
        readings: the monitors' readings of the launch, [monitor, 2, n].
        first: the first monitor behind each column's kick; none behind the RF's, [column].
        at_once: number of errors whose factors need little memory.

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
        self.at_once = max(AT_ONCE // (8 * (self.readings.size + self.start.size)), 1)
        self._exits = np.append(columns.layer + 1, 0)
        self._mixes: dict[Hashable, Quadratic] = {}

    def whole(self, change: Factors) -> Array:
        """Derivatives of the whole response, [error, column, monitor, 2]: m/rad per unit of the
        error for the correctors; in the last column the RF's, m per relative step per unit, 0 in
        four coordinates."""
        at = np.arange(len(self.readings))
        return np.stack(
            [self.picked(change, at, np.full(len(self.start), p)) for p in (0, 1)], axis=3
        )

    def picked(
        self,
        change: Factors,
        at: Indices,
        plane: Indices,
        scale: Array | float = 1.0,
        gain: Array | None = None,
    ) -> Array:
        """Derivatives of some readings, [error, column, monitor].

        Args:
            change: the errors' factors.
            at: monitors in beam order, [monitor].
            plane: of each column's readings, the RF's last, [column].
            scale: factor of each column, [column].
            gain: of each monitor in each plane, [monitor, 2].
        """
        gain = np.ones((len(at), 2)) if gain is None else gain
        scale = np.broadcast_to(scale, len(plane))[:, None]
        seen = change.seen[:, at] * gain[:, :, None]
        return np.asarray(
            _picked(
                np.ascontiguousarray(seen.transpose(0, 2, 3, 1)),
                np.ascontiguousarray((self.readings[at] * gain[:, :, None]).transpose(1, 2, 0)),
                np.stack([self.start, self.start + self.launch_kick]) * scale,
                np.stack([change.before, change.before + change.behind]) * scale,
                np.searchsorted(at, self.first),
                plane,
            )
        )

    def factors(self, hypotheses: Sequence[Hypothesis]) -> Factors:
        """Return the derivatives by hypotheses, in factors.

        Raises:
            EffectError: an effect that does not act on the ring.
        """
        for name, _ in hypotheses:
            if not isinstance(find(name), RingEffect):
                raise EffectError(f"'{name}' does not act on the ring; it has no such derivative")
        n, errors = self.model.dimension, len(hypotheses)
        out = Factors(
            np.empty((errors, *self.readings.shape)), *np.empty((2, errors, len(self.start), n))
        )
        for start in range(0, errors, self.at_once):
            some = slice(start, start + self.at_once)
            for into, own in zip(out, self._factors(hypotheses[some]), strict=True):
                into[some] = own
        return out

    def _factors(self, hypotheses: Sequence[Hypothesis]) -> Factors:
        model, d, n = self.model, directions(self.model.layers, hypotheses), self.model.dimension
        kicks, slopes = kicks_on_orbit(model, d)
        sources = model.inverse[d.layer + 1] @ slopes @ model.tangents[d.layer]
        G, p, errors = self.readings.reshape(-1, n), self.launch_kick, len(hypotheses)
        later = (model.maps.at > d.layer[:, None])[:, :, None, None]  # monitors
        ahead = (self._exits > d.layer[:, None])[:, :, None]  # columns
        rows = np.arange(len(d.owner))
        of_error = csr_array((np.ones(len(rows)), (d.owner, rows)), (errors, len(rows)))

        def summed(each: Array) -> Array:
            """The sum over the rows of each error, [error, ...]."""
            flat = each.reshape(len(each), int(np.prod(each.shape[1:])))
            return np.asarray((of_error @ flat).reshape(errors, *each.shape[1:]))

        moving = summed(np.abs(kicks).max(axis=1))[d.owner] > STILL
        if moving.any():  # the closed orbit
            fed, seen_by, missed_by, own_by = self._fed
            kicks *= moving[:, None]
            sources -= (fed[d.layer + 1] @ kicks[:, None, :, None])[..., 0]  # before the kick
        seen = (G @ sources).reshape(-1, *self.readings.shape)
        behind = -(ahead * (p @ sources.transpose(0, 2, 1)))
        if moving.any():
            further = (self._exits > d.layer[:, None] + 1)[:, :, None]
            seen += np.tensordot(kicks, seen_by, (1, 3))
            behind += further * np.tensordot(kicks, own_by, (1, 2))
            behind -= ahead * np.tensordot(kicks, missed_by, (1, 2))
        seen, behind, end = summed(later * seen), summed(behind), summed(sources)
        behind += np.stack([self._mixed(hypothesis) for hypothesis in hypotheses])
        if moving.any():
            total = summed(kicks)
            orbit = total @ model.closing.T
            seen += np.tensordot(orbit, seen_by, (1, 3))
            behind += np.tensordot(orbit, own_by - missed_by, (1, 2))
            end += np.tensordot(orbit + total, fed[-1], (1, 2))
        for r, (owner, m) in enumerate(zip(d.read_owner, d.monitor, strict=True)):
            bent = second_derivatives(d.E2[r][None])[0] @ model.path[model.maps.at[m]]
            seen[owner, m] += (d.E1[r] + bent) @ model.tangents[model.maps.at[m]]
        before = (self.start + p) @ end.transpose(0, 2, 1) + behind
        return Factors(seen, before @ model.closing.T, behind)

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
        for i in effect.members(model.ring, place):
            for c in self._at.get(i, ()):
                k = int(columns.layer[c])
                image, _ = self._mix(effect, i).after(model.layers.way(k))(model.path[k])
                mixed[c] = model.inverse[k + 1] @ image
        return mixed

    @cached_property
    def _at(self) -> dict[int, list[int]]:
        """Columns by the place of their corrector."""
        found: dict[int, list[int]] = {}
        for c, place in enumerate(self.columns.place.tolist()):
            found.setdefault(place, []).append(c)
        return found

    def _mix(self, effect: RingEffect, place: int) -> Quadratic:
        """d2 (map of a corrector) / d kick d amount; shared by equal correctors."""
        layers = self.model.layers
        element, h = layers.ring.elements[place], STEP * effect.largest
        key = (effect.name, layers.physics(element))
        if key not in self._mixes:
            ends = [
                effect.changed(element.changed(angle=angle), amount, layers.ring.energy)
                for angle in (element.angle + KICK, element.angle - KICK) for amount in (h, -h)
            ]  # fmt: skip
            by_amount = slopes(stacked(layers.maps(ends), layers.dimension), 2 * h)
            self._mixes[key] = slopes(by_amount, 2 * KICK).each()[0]
        return self._mixes[key]


# `reassoc`: the sum may follow the vector unit's order.
@jit_sums
def _picked(seen, readings, start, change, first, plane):  # type: ignore[no-untyped-def]
    """seen . start + readings . change at each monitor, [error, column, monitor].

    Args:
        seen: change of the readings of a launch by an error, [error, 2, n, monitor]; n is even.
        readings: readings of a launch, [2, n, monitor].
        start: launches of the columns, for monitors before and behind each column's kick,
            [2, column, n].
        change: of these by an error, [2, error, column, n].
        first: the first monitor behind each column's kick, [column].
        plane: of each column's readings, [column].
    """
    errors, _, n, monitors = seen.shape
    out = np.zeros((errors, len(plane), monitors))
    for h in range(errors):
        for c in range(len(plane)):
            p, into = plane[c], out[h, c]
            for side in range(2):
                low, high = (0, first[c]) if side == 0 else (first[c], monitors)
                for i in range(0, n, 2):
                    u, v = start[side, c, i], start[side, c, i + 1]
                    a, b = change[side, h, c, i], change[side, h, c, i + 1]
                    for m in range(low, high):
                        into[m] += (
                            u * seen[h, p, i, m] + v * seen[h, p, i + 1, m]
                            + a * readings[p, i, m] + b * readings[p, i + 1, m]
                        )  # fmt: skip
    return out
