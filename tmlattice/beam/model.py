"""The model of a diagnosis: a ring with its shots, and every hypothesis' signature.

Launches are (x, px, y, py, delta), one for each shot; readings are [shot, reading, 2] with the
turns of a shot one after another, `reading = turn * monitors + monitor`.

A signature is d readings / d amount. A cause changes the state at the exit of its layer. C^-1 of
the trajectory's tangent C makes that a change of the launch, and d reading / d launch carries it to
all readings downstream.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tmlattice.arrays import Array, Indices
from tmlattice.beam import aperture
from tmlattice.beam import tangents as kernels
from tmlattice.beam.assembly import Group, assembly, on_ring
from tmlattice.beam.layers import LayerParts
from tmlattice.beam.readouts import Lost, lost, outside, positions
from tmlattice.beam.rf import NO_RF, Cavities
from tmlattice.beam.threads import share
from tmlattice.effects import (
    CATALOGUE,
    Cause,
    Hypothesis,
    LaunchEffect,
    Monitors,
    ReadingEffect,
    RingEffect,
    Settings,
    beams,
    find,
    monitors_with,
    names,
)
from tmlattice.effects.apply import groups
from tmlattice.lattice import Ring

Kicks = Mapping[int, Array]
"""Free kicks by layer: (px, py) of every shot in the middle of its magnet, rad, [shot, 2]."""

NO_KICKS: Kicks = {}
LAUNCH = ("x", "px", "y", "py", "delta")
_COLUMNS = [0, 1, 2, 3, 5]  # of OCELOT's six coordinates


@dataclass(frozen=True)
class Paths:
    """Trajectories of the model, and their derivatives by the launches.

    Attributes:
        readings: [shot, reading, 2], m.
        launch: d readings / d (x, px, y, py, delta), [shot, reading, 2, 5].
        beam: position of the beam, [shot, reading, 2], m: readings before the monitors' errors;
            NaN where it is lost, as in these.
        states, tangents: at every exit, [shot, step + 1, n], [shot, step + 1, n, n].
        beam_launch: d beam / d launch, all coordinates, [shot, reading, 2, n].
        monitors: d reading / d beam, [monitor, 2, 2].
        monitors_of: with known errors and the causes.
    """

    readings: Array
    launch: Array
    beam: Array
    states: Array
    tangents: Array
    beam_launch: Array
    monitors: Array
    monitors_of: Monitors


class Model:
    """A ring as in the shots of a measurement, and every hypothesis.

    Over more than one turn the RF is on if the beam loses energy, the ring has cavities, or a shot
    sets the frequency: see `rf`. On one turn cavities are drifts.

    Args:
        known: causes that are no hypotheses (radiation, if asked for).
        dimension: 6; 4 if no cause changes the energy.

    Attributes:
        where: index of the state of each reading, [reading].
    """

    def __init__(
        self,
        ring: Ring,
        settings: Sequence[Settings],
        turns: int = 1,
        known: Sequence[Cause] = (),
        dimension: int = 6,
    ) -> None:
        self.design = ring
        self._settings = tuple(settings)
        self.turns = turns
        self.shots = len(settings)
        self.dimension = dimension
        self.assembly = assembly(ring, known, dimension)
        self.ring, self.maps = self.assembly.ring, self.assembly.maps
        self.layers, self.at = self.assembly.layers, self.maps.at
        self._known_monitors = monitors_with(ring, known)
        self._monitor = {name: m for m, name in enumerate(self.maps.monitors)}
        self._made: dict[tuple[int, tuple[Cause, ...], int], LayerParts] = {}
        self.groups = [
            Group(number, shots, setting, self.assembly)
            for number, (shots, setting) in enumerate(groups(settings, self.shots))
        ]
        self.steps = len(self.maps.W0) + 1
        self.where = np.concatenate([self.at + turn * self.steps for turn in range(turns)])
        for group in self.groups:
            self._cavities(group, ())

    def knowing(self, causes: Sequence[Cause]) -> "Model":
        """Return the shots with further known causes, in all of them."""
        return Model(
            self.design, self._settings, self.turns, (*self.assembly.known, *causes),
            self.dimension,
        )  # fmt: skip

    def monitor(self, name: str) -> int:
        """Index of a monitor."""
        return self._monitor[name]

    def kick(self, layer: int) -> Array:
        """Change of the state at a layer's exit by (px, py) in the middle of its magnet, [2, n]."""
        half = self.ring.magnets[layer].length / 2
        change = np.zeros((2, self.dimension))
        change[0, :2] = change[1, 2:4] = half, 1.0
        return change

    # --- shots with causes in them --------------------------------------------------------------
    def _cavities(self, group: Group, causes: Sequence[Cause]) -> Cavities:
        if self.turns == 1 or self.dimension == 4:
            return NO_RF
        return self.assembly.cavities(group.settings, causes)

    @contextmanager
    def _with(self, group: Group, causes: Sequence[Cause]) -> Iterator[None]:
        if not causes:
            yield
            return
        with group.layers.with_parts(group.parts(causes, self._made)):
            yield

    def _runs(
        self, causes: Sequence[Cause], kicks: Kicks
    ) -> Iterator[tuple[Group, NDArray[np.intp], Cavities]]:
        """Yield shots with equal weights, while their layers contain the causes and kicks."""
        causes = on_ring(causes)
        for group in self.groups:
            rf = self._cavities(group, causes)
            with self._with(group, causes):
                if not kicks:
                    yield group, group.shots, rf
                    continue
                W0 = group.layers.W[0]
                for shot in group.shots:
                    old = {layer: W0[layer].copy() for layer in kicks}
                    for layer, amounts in kicks.items():
                        W0[layer] += amounts[shot] @ self.kick(layer)
                    try:
                        yield group, np.array([shot]), rf
                    finally:
                        for layer, values in old.items():
                            W0[layer] = values

    def _states(self, launches: Array) -> Array:
        states = np.zeros((len(launches), self.dimension))
        columns = _COLUMNS[: 4 + (self.dimension == 6)]
        states[:, columns] = launches[:, : len(columns)]
        return states

    # --- readings -------------------------------------------------------------------------------
    def beam(self, launches: Array, causes: Sequence[Cause] = (), kicks: Kicks = NO_KICKS) -> Array:
        """Return the beam's position, [shot, reading, 2], m; NaN where it is lost."""
        nodes = self._nodes(launches, causes)
        found = np.empty((self.shots, self.turns * len(self.at), 2))
        for group, shots, rf in self._runs(causes, kicks):
            found[shots] = self._centroid(nodes, shots, group, rf)
        return found

    def _nodes(self, launches: Array, causes: Sequence[Cause]) -> tuple[Array, Array]:
        """Weights [node] and launches [node, shot, n] of the beam's particles."""
        return beams(self._states(launches), causes if self.dimension == 6 else ())

    def _centroid(
        self, nodes: tuple[Array, Array], shots: NDArray[np.intp], group: Group, rf: Cavities
    ) -> Array:
        """Position of the beam in some shots, [shot, reading, 2], m."""
        read = (weight * positions(node[shots], self.turns, group.layers, rf)
                for weight, node in zip(*nodes, strict=True))  # fmt: skip
        return np.asarray(sum(read)).reshape(len(shots), -1, 2)

    def readings(
        self, launches: Array, causes: Sequence[Cause] = (), kicks: Kicks = NO_KICKS
    ) -> Array:
        """Return the readings, [shot, reading, 2], m.

        Args:
            launches: (x, px, y, py, delta), [shot, 5].
            kicks: by layer, in the middle of its magnet, for each shot, [shot, 2], rad.
        """
        return self._read(self.beam(launches, causes, kicks), self._monitors(causes))

    def _read(self, beam: Array, monitors: Monitors) -> Array:
        by_turn = beam.reshape(self.shots, self.turns, -1, 2)
        return monitors.read(by_turn).reshape(beam.shape)

    def _monitors(self, causes: Sequence[Cause]) -> Monitors:
        """Return the monitors with known errors and causes."""
        monitors = self._known_monitors.copy()
        for cause in causes:
            effect = find(cause.effect)
            if isinstance(effect, ReadingEffect):
                effect.set(monitors, self._monitor[cause.element or ""], cause.amount)
        return monitors

    @np.errstate(over="ignore", invalid="ignore")  # of a lost beam
    def paths(
        self, launches: Array, causes: Sequence[Cause] = (), kicks: Kicks = NO_KICKS
    ) -> Paths:
        """Return trajectories, readings and their derivatives by the launches."""
        n = self.dimension
        weights, nodes = self._nodes(launches, causes)
        states = np.empty((self.shots, self.turns * self.steps + 1, n))
        tangents = np.empty((self.shots, self.turns * self.steps + 1, n, n))
        states[:, 0], tangents[:, 0] = weights @ nodes.swapaxes(0, 1), np.eye(n)
        slopes = np.empty((self.shots, self.turns * len(self.at), 2, n))
        beam = np.empty(slopes.shape[:3])
        for group, shots, rf in self._runs(causes, kicks):
            part, layers = (states[shots], tangents[shots]), group.layers
            share(
                kernels.trajectories, len(shots), (None,) * n, *layers.W, layers.curved,
                layers.third, rf.exits, rf.values, *part,
            )  # fmt: skip
            states[shots], tangents[shots] = part = _held(*part)
            kernels.read(shots, *layers.R, self.where, states, tangents, beam, slopes)
            if len(nodes) > 1:
                beam[shots] = self._centroid((weights, nodes), shots, group, rf)
        if len(nodes) == 1:
            beam[outside(states)[:, self.where]] = np.nan
        monitors_of = self._monitors(causes)
        monitors = monitors_of.matrix()
        turned = self._turned(monitors, slopes)
        launch = np.zeros((*slopes.shape[:3], 5))
        columns = _COLUMNS[: 4 + (n == 6)]
        launch[..., : len(columns)] = turned[..., columns]
        readings = self._read(beam, monitors_of)
        return Paths(readings, launch, beam, states, tangents, slopes, monitors, monitors_of)

    def lost(self, paths: Paths) -> tuple[Lost, ...]:
        """Return the shots whose beam is lost, with turn and magnet."""
        return lost(paths.states, self.maps.layers)

    def slopes(self, paths: Paths) -> Array:
        """d readings / d launch in all coordinates of the model, [shot, reading, 2, n]."""
        return self._turned(paths.monitors, paths.beam_launch)

    def _turned(self, monitors: Array, slopes: Array) -> Array:
        by_turn = slopes.reshape(self.shots, self.turns, -1, 2, self.dimension)
        turned = np.einsum("mij,stmjk->stmik", monitors, by_turn)
        return np.asarray(turned.reshape(slopes.shape))

    # --- hypotheses -----------------------------------------------------------------------------
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
        slope, constant = effect.slopes(paths.monitors_of)
        by_turn = paths.beam.reshape(self.shots, self.turns, -1, 2)
        change = np.einsum("mij,stmj->stmi", slope, by_turn) + constant
        return np.asarray(change.reshape(paths.beam.shape))

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
            out[index[:, None], shots[None]] = _through(paths.monitors, part)

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


def _held(states: Array, tangents: Array) -> tuple[Array, Array]:
    """Return states and tangents, [shot, step + 1, ...]; behind a loss those of its exit, since the
    maps overflow there."""
    lost = aperture.lost(states)
    if not lost.any():
        return states, tangents
    last = np.where(lost.any(axis=1), lost.argmax(axis=1), states.shape[1])
    kept = np.minimum(np.arange(states.shape[1]), last[:, None])
    shot = np.arange(len(states))[:, None]
    return states[shot, kept], tangents[shot, kept]


def _through(monitors: Array, beam: Array) -> Array:
    """Readings of changes of the beam, [hypothesis, shot, reading, 2]; monitors [monitor, 2, 2]."""
    if np.array_equal(monitors, np.broadcast_to(np.eye(2), monitors.shape)):
        return beam
    by_turn = beam.reshape(*beam.shape[:2], -1, len(monitors), 2)
    return np.asarray(np.einsum("mij,hstmj->hstmi", monitors, by_turn).reshape(beam.shape))
