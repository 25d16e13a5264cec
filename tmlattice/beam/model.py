"""The model of a diagnosis: a ring with its shots, and every hypothesis' signature.

A signature is d readings / d amount. A cause changes the state at the exit of its layer. C^-1 of
the trajectory's tangent C makes that a change of the launch, and d reading / d launch carries it to
all readings downstream.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from tmlattice.arrays import Array, Indices
from tmlattice.beam import tangents as kernels
from tmlattice.beam.assembly import Group
from tmlattice.beam.threads import share
from tmlattice.beam.tracked import LAUNCH, Kicks, Paths, TrackedShots
from tmlattice.effects import (
    CATALOGUE,
    Cause,
    Hypothesis,
    LaunchEffect,
    Monitors,
    ReadingEffect,
    RingEffect,
    find,
    names,
)

__all__ = ["LAUNCH", "Hypothesis", "Kicks", "Model", "Paths"]


SMALL = 1e-4
"""Step of central differences of readings over the largest fault; no effect is of higher than
second order there."""


class Model(TrackedShots):
    """A ring as in the shots of a measurement, and every hypothesis.

    Args, attributes, errors: those of `TrackedShots`.
    """

    def hypotheses(self, effects: Sequence[str] | None = None) -> list[Hypothesis]:
        """Return every effect at every place, in the catalogue's order.

        Discrete effects (swapped, dead) are included; the energy's only in six coordinates.
        """
        chosen = names() if effects is None else list(effects)
        found: list[Hypothesis] = []
        for name in chosen:
            if not (CATALOGUE[name].energy and self.dimension == 4):
                found += [(name, place) for place in CATALOGUE[name].places(self.ring)]
        return found

    def signatures(self, paths: Paths, hypotheses: Sequence[Hypothesis], launches: Array) -> Array:
        """d readings / d amount ** power of every hypothesis, [hypothesis, shot, reading, 2]; of a
        discrete effect its change of the readings.

        Args:
            launches: those of the paths.
        """
        out = np.zeros((len(hypotheses), *paths.readings.shape))
        kinds = [find(name) for name, _ in hypotheses]
        ring = [i for i, effect in enumerate(kinds) if isinstance(effect, RingEffect)]
        if ring:
            self._of_ring(paths, [hypotheses[i] for i in ring], np.array(ring), out)
        count = len(self.at)
        read: dict[str, Array] = {}
        for i, ((name, place), effect) in enumerate(zip(hypotheses, kinds, strict=True)):
            if isinstance(effect, ReadingEffect):
                assert place is not None
                m = self.monitor(place)
                if name not in read:
                    read[name] = self.reading_signatures(paths, effect)
                out[i, :, m::count] = read[name][:, m::count]
            elif isinstance(effect, LaunchEffect):
                change = self._of_launch(effect, name, launches)[None]
                out[i] = _through(paths.monitors, change)[0]
        return out

    def kick_signatures(self, paths: Paths, layers: Indices) -> Array:
        """d readings / d kick (px, py) in the middle of layers' magnets, m / rad, [layer, 2, shot,
        reading, 2]."""
        turns = np.arange(self.turns) * self.steps
        exits = np.asarray(layers)[:, None] + 1 + turns[None]  # [layer, turn]
        kick = np.stack([self.kick(k) for k in layers])
        inverse = np.linalg.inv(paths.tangents[:, exits])  # [shot, layer, turn, n, n]
        launch_kick = np.einsum("slTij,lpj->sTlpi", inverse, kick, optimize=True)
        launch_kick = np.ascontiguousarray(
            launch_kick.reshape(self.shots, self.turns, -1, self.dimension)
        )
        start = np.repeat(np.searchsorted(self.where, exits), 2, axis=0)
        out = np.zeros((2 * len(kick), *paths.readings.shape))
        owner = np.arange(2 * len(kick))
        share(kernels.carry, self.shots, owner, start, launch_kick, paths.beam_launch, out)
        return _through(paths.monitors, out).reshape(len(kick), 2, *paths.readings.shape)

    def free_kicks(self, paths: Paths, layers: Indices) -> tuple[Indices, Array]:
        """Kicks (px, py) in the middle of layers' magnets on one turn, as changes of the launch:
        the first reading behind each, [layer], and [layer, 2, shot, n]."""
        kick = np.stack([self.kick(k) for k in layers])
        inverse = np.linalg.inv(paths.tangents[:, layers + 1])  # [shot, layer, n, n]
        launch_kick = np.einsum("slij,lpj->lpsi", inverse, kick, optimize=True)
        return np.searchsorted(self.where, layers + 1), launch_kick

    def single_kicks(
        self, paths: Paths, hypotheses: Sequence[Hypothesis]
    ) -> tuple[Indices, Indices, Array]:
        """Hypotheses that are one kick on one turn, as changes of the launch.

        Such a signature equals the launch's from a reading on: all that `scan` needs.

        Returns:
            Indices of these hypotheses, [kick]; the first reading behind each; and the change of
            the launch, [shot, kick, n].
        """
        empty = np.zeros(0, dtype=np.int64)
        ring = [i for i, h in enumerate(hypotheses) if isinstance(find(h[0]), RingEffect)]
        if self.turns > 1 or not ring:
            return empty, empty, np.zeros((self.shots, 0, self.dimension))
        some = [hypotheses[i] for i in ring]
        base = self.groups[0].directions(some)
        rows = np.bincount(base.owner, minlength=len(some))
        rows[base.read_owner] = 0
        one = np.isin(base.owner, np.flatnonzero(rows == 1))
        order = np.argsort(base.owner[one])
        owner, exits = base.owner[one][order], base.layer[one][order] + 1
        launch_kick = np.zeros((self.shots, len(owner), self.dimension))
        inverse = np.linalg.inv(paths.tangents)
        for group in self.groups:
            if not group.active:
                continue
            d = group.directions(some)
            own = np.isin(d.owner, owner)  # without those that a setting removes
            kicks = np.empty((len(group.shots), 1, len(d.owner), self.dimension))
            states = np.ascontiguousarray(paths.states[group.shots])
            kernels.kicks(d.layer, d.D0, d.D1, d.D2, states, 0, kicks)
            back = inverse[group.shots][:, d.layer[own] + 1]
            change = np.einsum("skij,skj->ski", back, kicks[:, 0][:, own], optimize=True)
            launch_kick[np.ix_(group.shots, np.searchsorted(owner, d.owner[own]))] = change
        return np.array(ring)[owner], np.searchsorted(self.where, exits), launch_kick

    def reading_signatures(self, paths: Paths, effect: ReadingEffect) -> Array:
        """d readings / d amount of an effect at every monitor, [shot, reading, 2]; it joins the
        errors that each monitor has, in the order of `Monitors`."""
        high = 1.0 if effect.discrete else SMALL * effect.largest
        low = 0.0 if effect.discrete else -high
        up, down = (_with_all(paths.monitors_of, effect, amount) for amount in (high, low))
        by_turn = paths.beam.reshape(self.shots, self.turns, -1, 2)
        change = (up.read(by_turn) - down.read(by_turn)) / (high - low)
        return change.reshape(paths.beam.shape)

    def _of_launch(self, effect: LaunchEffect, name: str, launches: Array) -> Array:
        """d beam / d amount ** power, [shot, reading, 2]."""
        h = (1e-3 if effect.power == 1 else 1e-2) * effect.largest
        up = self.beam(launches, [Cause(name, None, h)])
        if effect.power == 1:
            return np.asarray((up - self.beam(launches, [Cause(name, None, -h)])) / (2 * h))
        return np.asarray((up - self.beam(launches)) / h**effect.power)

    def _of_ring(
        self, paths: Paths, hypotheses: list[Hypothesis], index: Indices, out: Array
    ) -> None:
        steps = self.steps
        inverse = np.linalg.inv(paths.tangents)  # [shot, step + 1, n, n]
        where = self.where
        turns = np.arange(self.turns) * steps
        for group in self.groups:
            d = group.directions(hypotheses)
            shots = group.shots
            kicks = np.empty((len(shots), self.turns, len(d.owner), self.dimension))
            states = np.ascontiguousarray(paths.states[shots])
            kernels.kicks(d.layer, d.D0, d.D1, d.D2, states, steps, kicks)
            exits = d.layer[:, None] + 1 + turns[None]  # [row, turn]
            launch_kick = np.einsum("strij,strj->stri", inverse[shots][:, exits.T], kicks)
            start = np.searchsorted(where, exits)
            part = np.zeros((len(hypotheses), len(shots), *out.shape[2:]))
            slopes = np.ascontiguousarray(paths.beam_launch[shots])
            share(kernels.carry, len(shots), d.owner, start, launch_kick, slopes, part)
            self._given_back(group, hypotheses, inverse, states, slopes, part)
            for row, (owner, monitor) in enumerate(zip(d.read_owner, d.monitor, strict=True)):
                for turn in range(self.turns):
                    x = states[:, turns[turn] + self.at[monitor]]
                    i, j = np.triu_indices(self.dimension)
                    moved = d.E0[row] + x @ d.E1[row].T + (x[:, i] * x[:, j]) @ d.E2[row].T
                    part[owner, :, turn * len(self.at) + monitor] += moved
            out[index[:, None], shots[None]] = _through(paths.monitors[shots], part)

    def _given_back(
        self,
        group: Group,
        hypotheses: list[Hypothesis],
        inverse: NDArray[np.floating],
        states: Array,
        slopes: Array,
        part: Array,
    ) -> None:
        """Signature by the cavities' phase, which follows the radiation loss."""
        if self.turns == 1:
            return
        there = self.assembly
        for h, (name, place) in enumerate(hypotheses):
            lost = there.turn_loss(Cause(name, place, 1.0))
            if not lost:
                continue
            rf = there.cavities(group.settings, [Cause(name, place, 1e-9)])
            if not len(rf.exits):
                continue
            _, phase, wave, slip = rf.values
            behind = (rf.exits[:, None] + np.arange(self.turns) * self.steps).ravel()
            slipped = np.repeat(np.where(rf.exits == self.steps, slip, 0.0), self.turns)
            late = states[:, behind, 4] - slipped  # at the end the RF slips behind the cavity
            gain = lost / len(rf.exits) * np.cos(phase - wave * late) / np.cos(phase)
            launch_kick = inverse[group.shots[:, None], behind][..., 5] * gain[..., None]
            launch_kick = np.ascontiguousarray(launch_kick[:, None])  # [shot, 1, cavity, turn, n]
            start = np.searchsorted(self.where, behind)[:, None]
            owner = np.full(len(behind), h)
            share(kernels.carry, len(part[h]), owner, start, launch_kick, slopes, part)


def _with_all(monitors: Monitors, effect: ReadingEffect, amount: float) -> Monitors:
    changed = monitors.copy()
    if amount:
        effect.set(changed, slice(None), amount)
    return changed


def _through(monitors: Array, beam: Array) -> Array:
    """Readings of changes of the beam, [hypothesis, shot, reading, 2], by monitors [shot, monitor,
    2, 2]."""
    if np.array_equal(monitors, np.broadcast_to(np.eye(2), monitors.shape)):
        return beam
    by_turn = beam.reshape(*beam.shape[:2], -1, monitors.shape[1], 2)
    return np.asarray(np.einsum("smij,hstmj->hstmi", monitors, by_turn).reshape(beam.shape))
