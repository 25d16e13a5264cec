"""Tracked shots of a measurement: readings of a ring with causes.

Launches are (x, px, y, py, delta), one for each shot; readings are [shot, reading, 2] with the
turns of a shot one after another, `reading = turn * monitors + monitor`.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from tmlattice.arrays import Array, Flags
from tmlattice.beam import aperture
from tmlattice.beam import tangents as kernels
from tmlattice.beam.assembly import Group, assembly, on_ring
from tmlattice.beam.layers import LayerParts
from tmlattice.beam.readouts import Lost, lost, positions
from tmlattice.beam.rf import NO_RF, Cavities
from tmlattice.beam.threads import share
from tmlattice.effects import (
    Cause,
    LaunchEffect,
    Monitors,
    ReadingEffect,
    Settings,
    beams,
    find,
    monitors_with,
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
        beam: position of the beam, [shot, reading, 2], m: readings before the monitors' errors.
        states, tangents: at every exit, [shot, step + 1, n], [shot, step + 1, n, n].
        beam_launch: d beam / d launch, all coordinates, [shot, reading, 2, n].
        monitors: d reading / d beam, [shot, monitor, 2, 2].
    """

    readings: Array
    launch: Array
    beam: Array
    states: Array
    tangents: Array
    beam_launch: Array
    monitors: Array
    monitors_of: Monitors


class TrackedShots:
    """A ring with the shots of a measurement; see `Model` for hypotheses.

    Over more than one turn the RF is on if the beam loses energy, the ring has cavities, or a shot
    sets the frequency: see `rf`. On one turn cavities are drifts.

    Args:
        known: causes that are no hypotheses (radiation, if asked for).
        dimension: 6; 4 if no cause changes the energy.
        active: shots in which causes act; the others are of the ring without, [shot].

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
        active: Flags | None = None,
    ) -> None:
        self.design = ring
        self._settings = tuple(settings)
        self.active = np.ones(len(settings), dtype=bool) if active is None else active
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
            Group(number, shots, setting, there, self.assembly)
            for number, (shots, setting, there) in enumerate(self._alike(settings))
        ]
        self.steps = len(self.maps.W0) + 1
        self.where = np.concatenate([self.at + turn * self.steps for turn in range(turns)])
        for group in self.groups:
            self._cavities(group, ())

    def _alike(
        self, settings: Sequence[Settings]
    ) -> Iterator[tuple[NDArray[np.intp], Settings, bool]]:
        for shots, setting in groups(settings, self.shots):
            for active in (True, False):
                own = shots[self.active[shots] == active]
                if len(own):
                    yield own, setting, active

    def knowing(self, causes: Sequence[Cause]) -> Self:
        """Return the shots with further known causes, in all of them."""
        return type(self)(
            self.design, self._settings, self.turns, (*self.assembly.known, *causes),
            self.dimension, self.active,
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
        return self.assembly.cavities(group.settings, causes if group.active else ())

    @contextmanager
    def _with(self, group: Group, causes: Sequence[Cause]) -> Iterator[None]:
        if not causes or not group.active:
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
                if not kicks or not group.active:
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
        states = self._states(launches)
        still = beams(states, ())
        moved = beams(states, causes) if self.dimension == 6 else still
        total = np.zeros((self.shots, self.turns * len(self.at), 2))
        for group, shots, rf in self._runs(causes, kicks):
            for weight, node in zip(*(moved if group.active else still), strict=True):
                found = positions(node[shots], self.turns, group.layers, rf)
                total[shots] += weight * found.reshape(len(found), -1, 2)
        return total

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
        readings = monitors.read(by_turn)
        if not self.active.all():
            readings[~self.active] = self._known_monitors.read(by_turn[~self.active])
        return readings.reshape(beam.shape)

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
        states = np.empty((self.shots, self.turns * self.steps + 1, n))
        tangents = np.empty((self.shots, self.turns * self.steps + 1, n, n))
        states[:, 0] = self._states(launches)
        for cause in causes:
            effect = find(cause.effect)
            if isinstance(effect, LaunchEffect) and effect.shifts is not None:
                states[self.active, 0, effect.shifts] += cause.amount
        tangents[:, 0] = np.eye(n)
        slopes = np.empty((self.shots, self.turns * len(self.at), 2, n))
        for group, shots, rf in self._runs(causes, kicks):
            part, layers = (states[shots], tangents[shots]), group.layers
            share(
                kernels.trajectories, len(shots), *layers.W, layers.curved, layers.third, rf.exits,
                rf.values, *part,
            )  # fmt: skip
            states[shots], tangents[shots] = part = _held(*part)
            R1, R2 = (np.tile(r, (self.turns, *(1,) * (r.ndim - 1))) for r in layers.R[1:])
            x = part[0][:, self.where]  # [shot, reading, n]
            own = np.broadcast_to(R1, (len(x), *R1.shape)).copy()
            if R2.any():
                for pair, (a, b) in enumerate(zip(*np.triu_indices(n), strict=True)):
                    own[..., a] += R2[..., pair] * x[:, :, None, b]
                    own[..., b] += R2[..., pair] * x[:, :, None, a]
            slopes[shots] = own @ part[1][:, self.where]
        beam = self.beam(launches, causes, kicks)
        monitors_of = self._monitors(causes)
        monitors = np.empty((self.shots, len(self.at), 2, 2))
        monitors[:] = self._known_monitors.matrix()
        monitors[self.active] = monitors_of.matrix()
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
        turned = np.einsum("smij,stmjk->stmik", monitors, by_turn)
        return np.asarray(turned.reshape(slopes.shape))


def _held(states: Array, tangents: Array) -> tuple[Array, Array]:
    """Return states and tangents, [shot, step + 1, ...]; behind a loss those of its exit, since the
    maps overflow there."""
    outside = aperture.lost(states)
    if not outside.any():
        return states, tangents
    last = np.where(outside.any(axis=1), outside.argmax(axis=1), states.shape[1])
    kept = np.minimum(np.arange(states.shape[1]), last[:, None])
    shot = np.arange(len(states))[:, None]
    return states[shot, kept], tangents[shot, kept]
