"""A stored beam at its closed orbit, and the effects of errors on orbit, tunes and modes.

Small oscillations around the closed orbit are two modes. With the one-turn matrix M, M U = U Lambda
for the modes' vectors U and Lambda = exp(2 pi i Q). Monitors with the slope G of the launch read a
mode as E = G U. All matrices are carried back to the start of the ring: a change D of the layer k's
matrix is the source S = C^-1 D C there (C from the start to the layer), and with the sum T of the
sources before a place

    d (matrix to there) = C T,    d M = M T_end,    d E = G T U + G dU,

dU and d Q by perturbation of the eigenvalues. An effect that kicks moves the closed orbit, which
changes every curved map behind: with P_j the sum over the curved layers of C^-1 B (C e) C per unit
e of the launch, its sources are contractions of P. Every effect costs some products of small
matrices.

With the RF on, a cavity changes the energy of an oscillating particle by its time of flight. All
matrices behind it include that, and the modes are those of six coordinates. The closed orbit meets
the RF's phase and is not affected.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from tmlattice.arrays import Array, ComplexArray, Indices
from tmlattice.beam.closed_orbit import ResponseModel, feed_down
from tmlattice.beam.response_derivatives import STILL, kicks_on_orbit
from tmlattice.beam.rf import NO_RF, Cavities
from tmlattice.effects import Hypothesis, RingEffect, find
from tmlattice.effects.directions import directions_nearby
from tmlattice.errors import UnstableRingError
from tmlattice.maps.taylor import second_derivatives

TRANSVERSE = 4
"""Coordinates of the betatron motion; energy and path length are those of the closed orbit."""

NEAR = 1e-9
"""Distance of two eigenvalues below which modes mix freely and have no derivative."""

GROWTH = 1e-2
"""Distance of an eigenvalue from the unit circle at which the motion counts as unstable: off the
axis second-order maps are symplectic to their own order only (1e-5 for an orbit of 6 mm)."""


@dataclass(frozen=True)
class Moved:
    """Orbit, tunes and modes of a stored beam, or their derivatives by hypotheses.

    Attributes:
        orbit: closed orbit at the monitors, m, [hypothesis, monitor, 2].
        tunes: Q of both modes, [hypothesis, 2].
        modes: their vectors at the monitors, [hypothesis, monitor, 2, mode], up to one complex
            factor per mode, that of the launch.
    """

    orbit: Array
    tunes: Array
    modes: ComplexArray


class StoredBeam:
    """A stored beam in a ring with its errors and settings.

    Args:
        model: closed orbit and matrices; monitors without errors.
        rf: cavities that act on the oscillation; six coordinates.

    Attributes:
        tunes: Q of the modes that are nearer to x and to y, in [0, 1).
        modes: their vectors at the monitors, [monitor, 2, mode]: the beam is at
            Re(sum_mode a E exp(2 pi i Q turn)), a any complex number.
    """

    def __init__(self, model: ResponseModel, rf: Cavities = NO_RF) -> None:
        self.model = model
        self.rf = rf
        # matrices of the oscillation: to the exits, into the layers, back from the exits, readings
        self._C, self._into = model.tangents, model.tangents
        self._back, self._G = model.inverse, model.reading_slopes
        self._turn = model.tangents[-1]
        if len(rf.exits):
            given, self._turn = _with_rf(model, rf)
            self._C, self._into = self._C @ given, self._C[:-1] @ given[1:]
            self._back = np.linalg.inv(given) @ self._back
            self._G = self._G @ given[model.maps.at]
        self._values, self._vectors = _modes(self._turn[:TRANSVERSE, :TRANSVERSE])
        if len(rf.exits):
            self._values, self._vectors = _nearest(self._turn, self._values, self._vectors)
        self.tunes = np.angle(self._values[:2]) / (2 * np.pi) % 1.0
        self._U = np.zeros((model.dimension, 2), dtype=complex)
        self._U[: len(self._values)] = self._vectors[:, :2]
        self.modes: ComplexArray = self._G @ self._U

    def launched(self, amplitude: ComplexArray) -> Array:
        """State at the start of the ring after a kick, [..., n] (amplitude: of the modes at turn 0,
        [..., mode])."""
        kicked = np.real(amplitude @ self._U.T)
        kicked[..., TRANSVERSE:] = 0.0  # a kick changes neither energy nor time
        return np.asarray(self.model.state + kicked)

    @property
    def shown(self) -> Moved:
        """Closed orbit, tunes and modes, without the axis of hypotheses."""
        return Moved(self.model.readings, self.tunes, self.modes)

    def moved(self, hypotheses: Sequence[Hypothesis], oscillates: bool = True) -> Moved:
        """Return the derivatives by effects on the ring.

        Args:
            hypotheses: (effect, place), of effects on the ring, or of the beam's energy.
            oscillates: whether tunes and modes are read; else theirs are 0.
        """
        model, count = self.model, len(hypotheses)
        on_ring = np.array([isinstance(find(name), RingEffect) for name, _ in hypotheses], bool)
        monitors = len(model.maps.at)
        moved = Moved(
            np.zeros((count, monitors, 2)), np.zeros((count, 2)),
            np.zeros((count, monitors, 2, 2), dtype=complex),
        )  # fmt: skip
        if not on_ring.all():
            one = self._by_energy(oscillates)
            moved.orbit[~on_ring], moved.tunes[~on_ring] = one.orbit, one.tunes
            moved.modes[~on_ring] = one.modes
        where = np.flatnonzero(on_ring)
        d = directions_nearby(model.layers, [hypotheses[i] for i in where.tolist()])
        if len(d.owner):
            w, slopes = kicks_on_orbit(model, d)
            found: list[tuple[Any, Any]] = [(moved.orbit, self._orbit(d.layer, w))]
            if oscillates:
                total, seen = self._sources(d.layer, w, slopes)
                tunes, mixed = self._perturbed(total)
                G = self._G.reshape(-1, model.dimension)
                there = (G @ mixed.transpose(1, 2, 0).reshape(model.dimension, -1)).T
                seen = seen + there.reshape(2, -1, monitors, 2).transpose(1, 2, 3, 0)
                found += [(moved.tunes, tunes), (moved.modes, seen)]
            for out, rows in found:
                if len(np.unique(d.owner)) == len(rows):
                    out[where[d.owner]] = rows
                else:  # families have one row per member
                    np.add.at(out, where[d.owner], rows)
        for row, (owner, m) in enumerate(zip(where[d.read_owner], d.monitor, strict=True)):
            at = model.maps.at[m]
            x = model.path[at]
            bent = second_derivatives(d.E2[row][None])[0] @ x
            moved.orbit[owner, m] += d.E0[row] + (d.E1[row] + bent / 2) @ x
            moved.modes[owner, m] += (d.E1[row] + bent) @ self._C[at] @ self._U
        return moved

    def _by_energy(self, oscillates: bool) -> Moved:
        """Orbit, tunes and modes by the relative energy that the RF frequency gives the beam."""
        model, n = self.model, self.model.dimension
        z = model.rf_start / model.rf_start[5]
        orbit = model.reading_slopes @ z
        if not oscillates:
            return Moved(orbit, np.zeros(2), np.zeros_like(self.modes))
        tunes, mixed = self._perturbed((self._bends[-1].reshape(-1, n) @ z).reshape(1, n, n))
        through = (z @ self._seen_bends).view(complex).reshape(self.modes.shape)
        return Moved(orbit, tunes[0], through + self._G @ mixed[0])

    def _orbit(self, k: Indices, w: Array) -> Array:
        """The closed orbit's change at the monitors, [row, monitor, 2], by kicks w in layers k, as
        changes of the launch, [row, n]."""
        model, at = self.model, self.model.maps.at
        G = model.reading_slopes.reshape(-1, model.dimension).T
        z, shape = w @ model.closing.T, (len(k), len(at), 2)
        behind = at[None] > k[:, None]  # the monitor reads behind the layer
        return np.asarray((z @ G).reshape(shape) + behind[..., None] * (w @ G).reshape(shape))

    def _sources(self, k: Indices, w: Array, slopes: Array) -> tuple[Array, ComplexArray]:
        """The sources of the whole turn, [row, n, n], and G T U at the monitors, [row, monitor, 2,
        mode], of kicks as in `_orbit` and their slopes by the state before the layer."""
        model, at, U, n = self.model, self.model.maps.at, self._U, self.model.dimension
        rows, z = len(k), w @ model.closing.T
        S = self._back[k + 1] @ slopes @ self._into[k]
        behind = at[None] > k[:, None]
        shape = (rows, len(at), 2)
        G, bends = self._G.reshape(-1, n), self._bends
        first = (bends[k + 1] @ w[:, None, :, None])[..., 0]
        whole = S - first + ((z + w) @ bends[-1].reshape(-1, n).T).reshape(rows, n, n)
        late = G @ ((S - first) @ U).transpose(1, 2, 0).reshape(n, -1)  # [monitor 2, mode row]
        seen = late.reshape(len(at), 2, 2, rows).transpose(3, 0, 1, 2)
        moving = np.abs(w).max(initial=0.0) > STILL
        if moving:
            seen = seen + (w @ self._seen_bends).view(complex).reshape(*shape, 2)
        seen = behind[..., None, None] * seen
        if moving:
            seen += (z @ self._seen_bends).view(complex).reshape(*shape, 2)
        return whole, seen

    @cached_property
    def _seen_bends(self) -> Array:
        """Change of the modes at the monitors by the closed orbit's launch, through curved maps and
        read-outs, [n, monitor * 2 * mode * (re, im)]."""
        model, maps = self.model, self.model.maps
        through = np.einsum(
            "mja,mabc,bp->cmjp", self._G, self._bends[maps.at], self._U, optimize=True
        )
        read = np.einsum(
            "majk,mkc,mjb,bp->cmap", second_derivatives(maps.R2), model.tangents[maps.at],
            self._C[maps.at], self._U, optimize=True,
        )  # fmt: skip
        whole = np.ascontiguousarray(through + read).reshape(model.dimension, -1)
        return np.asarray(whole.view(float))

    @cached_property
    def _bends(self) -> Array:
        """P: see `feed_down`."""
        return feed_down(self.model, self._back, self._into)

    def _perturbed(self, whole: Array) -> tuple[Array, ComplexArray]:
        """d tunes and d U at the start, [row, n, mode], for sources of the whole turn."""
        V, count = self._vectors, len(self._values)
        turn = (self._turn @ whole)[:, :count, :count]
        D = np.linalg.inv(V) @ turn @ V  # [row, 4, 4]
        values = self._values
        own = D[:, [0, 1], [0, 1]]
        tunes = (own / values[:2]).imag / (2 * np.pi)
        apart = values[None, :2] - values[:, None]  # [into, of mode]
        mixes = np.abs(apart) > NEAR
        weights = np.where(mixes, 1 / np.where(mixes, apart, 1.0), 0.0)
        mixed = np.zeros((len(whole), len(self._turn), 2), dtype=complex)
        mixed[:, :count] = V @ (D[:, :, :2] * weights)
        return tunes, mixed


def _with_rf(model: ResponseModel, rf: Cavities) -> tuple[Array, Array]:
    """Cavities in the matrices, carried back to the start: the product of those before each exit
    and the end, [layer + 2, n, n]; and the turn with all of them, [n, n]."""
    crest, phase, wave, _ = rf.values
    given = np.tile(np.eye(model.dimension), (len(model.tangents), 1, 1))
    slope = np.zeros((model.dimension,) * 2)
    slope[5, 4] = -crest * wave * np.cos(phase)
    last = len(model.tangents) - 1
    turn = np.eye(model.dimension)
    for k in np.sort(rf.exits):
        gives = np.eye(model.dimension) + model.inverse[k] @ slope @ model.tangents[k]
        turn = gives @ turn
        given[k + 1 :] = turn
    return given, model.tangents[last] @ turn


def _nearest(
    turn: Array, tunes: ComplexArray, modes: ComplexArray
) -> tuple[ComplexArray, ComplexArray]:
    """Eigenvalues and vectors of a turn with RF: first the two nearest to those of the transverse
    motion alone, then the others; UnstableRingError: the RF makes one of them grow."""
    values, vectors = np.linalg.eig(turn)
    chosen: list[int] = []
    for mode in (0, 1):
        apart = np.abs(values - tunes[mode])
        apart[chosen] = np.inf
        chosen.append(int(apart.argmin()))
        own, alone = vectors[:TRANSVERSE, chosen[-1]], modes[:, mode]
        vectors[:, chosen[-1]] *= np.vdot(own, alone) / np.vdot(own, own).real
    if np.abs(np.abs(values[chosen]) - 1).max() > GROWTH:
        raise UnstableRingError("the beam is not stable: its modes grow")
    order = [*chosen, *(i for i in range(len(values)) if i not in chosen)]
    return values[order], vectors[:, order]


def _modes(turn: Array) -> tuple[ComplexArray, ComplexArray]:
    """Eigenvalues and vectors of a transverse one-turn matrix: of the mode nearer to x, of the one
    nearer to y, and their conjugates.

    The rotation is that of the action: Im(conj(x) px + conj(y) py) is positive, which gives Q and
    not 1 - Q.

    Raises:
        UnstableRingError: an eigenvalue off the unit circle.
    """
    values, vectors = np.linalg.eig(turn)
    if np.abs(np.abs(values) - 1).max() > GROWTH or np.abs(values.imag).min() < 1e-9:
        raise UnstableRingError("the beam is not stable: its modes grow")
    action = (vectors[0::2].conj() * vectors[1::2]).imag.sum(axis=0)
    forward = np.flatnonzero(action > 0)
    if len(forward) != 2:
        raise UnstableRingError("the beam is not stable: its modes do not oscillate")
    in_x = (vectors[0].conj() * vectors[1]).imag / action
    order = forward[np.argsort(-in_x[forward])]
    chosen = vectors[:, order] / np.sqrt(2 * action[order])
    # continuous phase: the mode's own coordinate is real at the start
    largest = np.array([chosen[0, 0], chosen[2, 1]])
    chosen = chosen * (np.abs(largest) / largest)
    return (
        np.concatenate([values[order], values[order].conj()]),
        np.concatenate([chosen, chosen.conj()], axis=1),
    )
