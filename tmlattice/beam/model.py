"""The model's side of a diagnosis: what a ring with causes makes the monitors read.

Launches are (x, px, y, py, delta), one for each shot; readings are [shot, reading, 2] with the
turns of a shot one after another, `reading = turn * monitors + monitor`.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tmlattice.beam import tangents as kernels
from tmlattice.beam.readouts import positions
from tmlattice.beam.sweeps import curved
from tmlattice.beam.threads import share
from tmlattice.effects import (
    CATALOGUE,
    Cause,
    Directions,
    LaunchEffect,
    Monitors,
    ReadingEffect,
    RingEffect,
    Settings,
    apply,
    beams,
    changed_elements,
    directions,
    find,
    monitors_with,
    names,
    set_elements,
)
from tmlattice.effects.settings import groups
from tmlattice.lattice import Element, Ring
from tmlattice.maps import LayerMaps, RingMaps, ring_maps
from tmlattice.maps.magnets import Weights

Array = NDArray[np.float64]
Hypothesis = tuple[str, str | None]
"""An effect and the place where it might sit."""

LayerParts = tuple[Weights, list[Weights]]
"""The weights of a layer, and the read-outs of the monitors before its magnet."""

MADE = 10_000
"""Changed layers that a model remembers: some 20 MB."""

KEPT = 4
"""Models with something known that are kept with a ring."""
FEW = 10
"""Known causes of which a model is worth keeping."""

Kicks = Mapping[int, Array]
"""By layer: (px, py) of every shot in the middle of its magnet, rad, [shot, 2]."""

NO_KICKS: Kicks = {}
LAUNCH = ("x", "px", "y", "py", "delta")
_COLUMNS = [0, 1, 2, 3, 5]  # of OCELOT's six coordinates


@dataclass(frozen=True)
class Paths:
    """The model's trajectories, and how they depend on their launches.

    Attributes:
        readings: [shot, reading, 2], m.
        launch: d readings / d (x, px, y, py, delta), [shot, reading, 2, 5].
        beam: where the beam is, [shot, reading, 2], m: readings before the monitors' errors.
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


@dataclass(frozen=True)
class _Base:
    """What every model of a ring shares; kept with the ring."""

    ring: Ring
    layers: LayerMaps
    maps: RingMaps
    directions: dict[tuple[Hypothesis, ...], Directions]


def _base(ring: Ring, known: tuple[Cause, ...], dimension: int) -> _Base:
    key = ("model", known if len(known) < FEW else None, dimension)
    if key in ring.memory and len(known) < FEW:
        kept: _Base = ring.memory[key]
        return kept
    with_known = apply(ring, known) if known else ring
    layers = LayerMaps(with_known, dimension)
    maps = ring_maps(with_known, dimension, layers)
    if len(known) < FEW:
        others = [k for k in ring.memory if k[0] == "model" and k[1]]
        if len(others) >= KEPT:  # a study that tells each case something would fill the memory
            del ring.memory[others[0]]
        ring.memory[key] = _Base(with_known, layers, maps, {})
        return _base(ring, known, dimension)
    # small errors everywhere turn a hypothesis's direction by as little as they are large
    return _Base(with_known, layers, maps, _base(ring, (), dimension).directions)


class _Group:
    """Shots with equal settings, and the stacked weights of their ring."""

    def __init__(
        self, number: int, shots: NDArray[np.intp], settings: Settings, active: bool
    ) -> None:
        self.number = number
        self.layers: frozenset[int] = frozenset()  # that the settings touch
        self.shots = shots
        self.active = active
        self.settings = settings
        self.latest: tuple[tuple[Hypothesis, ...], Directions] | None = None
        self.W: list[Array] = []
        self.R: list[Array] = []


@dataclass(frozen=True)
class _Patch:
    """What stood in a group's weights, by layer and by read-out."""

    layers: NDArray[np.intp]
    W: list[Array]
    rows: NDArray[np.intp]
    R: list[Array]


class Model:
    """A ring as the shots of a measurement saw it, and every hypothesis about it.

    Args:
        ring: the design.
        settings: of each shot.
        turns: of each shot.
        known: causes that are no hypothesis (radiation where it is asked for).
        dimension: 6; 4 where no cause touches the energy.
        active: shots in which causes are there; the others are of the ring without, [shot].
    """

    def __init__(
        self,
        ring: Ring,
        settings: Sequence[Settings],
        turns: int = 1,
        known: Sequence[Cause] = (),
        dimension: int = 6,
        active: NDArray[np.bool_] | None = None,
    ) -> None:
        self.design = ring
        self.active = np.ones(len(settings), dtype=bool) if active is None else active
        self.turns = turns
        self.shots = len(settings)
        self.dimension = dimension
        self._base = _base(ring, tuple(known), dimension)
        self.ring, self.layers, maps = self._base.ring, self._base.layers, self._base.maps
        self._known_monitors = monitors_with(ring, known)
        self.maps = maps
        self.at = maps.at
        self._monitor = {name: m for m, name in enumerate(maps.monitors)}
        base = [
            np.concatenate([w, c[None]])
            for w, c in zip((maps.W0, maps.W1, maps.W2), maps.closing.coefficients, strict=True)
        ]
        self._touched: dict[Hypothesis, tuple[int, ...]] = {}
        self._made: dict[tuple[int, tuple[Cause, ...], int], LayerParts] = {}
        self.groups: list[_Group] = []
        for shots, setting, there in self._alike(settings):
            group = _Group(len(self.groups), shots, setting, there)
            group.W = [w.copy() for w in base]
            group.R = [r.copy() for r in (maps.R0, maps.R1, maps.R2)]
            replaced = set_elements(self.ring, setting)
            group.layers = frozenset(int(self.layers.layer_of[place]) for place in replaced)
            if replaced:
                self._set(group, {k: self.layers.layer(k, replaced) for k in group.layers})
            self.groups.append(group)

    def _alike(
        self, settings: Sequence[Settings]
    ) -> Iterator[tuple[NDArray[np.intp], Settings, bool]]:
        for shots, setting in groups(settings, self.shots):
            for active in (True, False):
                own = shots[self.active[shots] == active]
                if len(own):
                    yield own, setting, active

    # --- weights with causes in them ------------------------------------------------------------
    def _set(self, group: _Group, parts: Mapping[int, LayerParts]) -> _Patch:
        """Put layers into a group's weights; returns what was there."""
        layers = np.fromiter(parts, dtype=np.intp)
        old_W = [w[layers] for w in group.W]
        for stack, new in zip(
            group.W, zip(*(own for own, _ in parts.values()), strict=True), strict=True
        ):
            stack[layers] = new
        reads = {
            int(self.maps.start[k]) + i: read
            for k, (_, found) in parts.items()
            for i, read in enumerate(found)
        }
        rows = np.fromiter(reads, dtype=np.intp)
        old_R = [r[rows] for r in group.R]
        if reads:
            for stack, new in zip(group.R, zip(*reads.values(), strict=True), strict=True):
                stack[rows] = new
        return _Patch(layers, old_W, rows, old_R)

    def _parts(self, group: _Group, causes: Sequence[Cause]) -> dict[int, LayerParts]:
        """The layers that causes touch, as they are with them: groups of equal settings share what
        no setting touches, and what one fit needed the next one finds."""
        touching: dict[int, list[Cause]] = {}
        for cause in causes:
            for layer in self._layers_of(cause):
                touching.setdefault(layer, []).append(cause)
        replaced: dict[int, Element] | None = None
        found: dict[int, LayerParts] = {}
        if len(self._made) > MADE:
            self._made.clear()
        for layer, own in touching.items():
            key = (layer, tuple(own), group.number if layer in group.layers else -1)
            part = self._made.get(key)
            if part is None:
                if replaced is None:
                    replaced = changed_elements(self.ring, causes, group.settings)
                part = self._made[key] = self.layers.layer(layer, replaced)
            found[layer] = part
        return found

    def _layers_of(self, cause: Cause) -> tuple[int, ...]:
        place = (cause.effect, cause.element)
        if place not in self._touched:
            effect = find(cause.effect)
            assert isinstance(effect, RingEffect)
            members = effect.members(self.ring, cause.element)
            self._touched[place] = tuple(sorted({int(self.layers.layer_of[m]) for m in members}))
        return self._touched[place]

    @contextmanager
    def _with(self, group: _Group, causes: Sequence[Cause]) -> Iterator[None]:
        ring_causes = [c for c in causes if isinstance(find(c.effect), RingEffect)]
        if not ring_causes or not group.active:
            yield
            return
        before = self._set(group, self._parts(group, ring_causes))
        try:
            yield
        finally:
            for stack, values in zip(group.W, before.W, strict=True):
                stack[before.layers] = values
            for stack, values in zip(group.R, before.R, strict=True):
                stack[before.rows] = values

    def _runs(
        self, causes: Sequence[Cause], kicks: Kicks
    ) -> Iterator[tuple[_Group, NDArray[np.intp]]]:
        """Shots with equal weights, the weights with causes and kicks in them meanwhile."""
        for group in self.groups:
            with self._with(group, causes):
                if not kicks or not group.active:
                    yield group, group.shots
                    continue
                W0 = group.W[0]
                for shot in group.shots:
                    old = {layer: W0[layer].copy() for layer in kicks}
                    for layer, amounts in kicks.items():
                        W0[layer] += amounts[shot] @ self._kick(layer)
                    try:
                        yield group, np.array([shot])
                    finally:
                        for layer, values in old.items():
                            W0[layer] = values

    def _kick(self, layer: int) -> Array:
        """Change of the state at a layer's exit by (px, py) in the middle of its magnet, [2, n]."""
        half = self.ring.magnets[layer].length / 2
        change = np.zeros((2, self.dimension))
        change[0, :2] = change[1, 2:4] = half, 1.0
        return change

    def _states(self, launches: Array) -> Array:
        states = np.zeros((len(launches), self.dimension))
        columns = _COLUMNS[: 4 + (self.dimension == 6)]
        states[:, columns] = launches[:, : len(columns)]
        return states

    # --- readings -------------------------------------------------------------------------------
    def beam(self, launches: Array, causes: Sequence[Cause] = (), kicks: Kicks = NO_KICKS) -> Array:
        """Where the beam is, [shot, reading, 2], m; NaN where it is lost."""
        states = self._states(launches)
        weights, nodes = (np.ones(1), states[None])
        if self.dimension == 6:
            weights, nodes = beams(states, causes)
        total = np.zeros((self.shots, self.turns * len(self.at), 2))
        for group, shots in self._runs(causes, kicks):
            beam = (weights, nodes) if group.active else (np.ones(1), states[None])
            for weight, node in zip(*beam, strict=True):
                found = positions(node[shots], self.turns, group.W, group.R, self.at)
                total[shots] += weight * found.reshape(len(found), -1, 2)
        return total

    def readings(
        self, launches: Array, causes: Sequence[Cause] = (), kicks: Kicks = NO_KICKS
    ) -> Array:
        """What the monitors read, [shot, reading, 2], m.

        Args:
            launches: (x, px, y, py, delta), [shot, 5].
            causes: of all three kinds.
            kicks: by layer, in the middle of its magnet, for each shot, [shot, 2], rad.
        """
        return self._read(self.beam(launches, causes, kicks), causes)

    def _read(self, beam: Array, causes: Sequence[Cause]) -> Array:
        by_turn = beam.reshape(self.shots, self.turns, -1, 2)
        readings = self._monitors(causes).read(by_turn)
        if not self.active.all():
            readings[~self.active] = self._known_monitors.read(by_turn[~self.active])
        return readings.reshape(beam.shape)

    def _monitors(self, causes: Sequence[Cause]) -> Monitors:
        """The monitors with what is known of them and with causes."""
        monitors = self._known_monitors.copy()
        for cause in causes:
            effect = find(cause.effect)
            if isinstance(effect, ReadingEffect):
                effect.set(monitors, self._monitor[cause.element or ""], cause.amount)
        return monitors

    def paths(
        self, launches: Array, causes: Sequence[Cause] = (), kicks: Kicks = NO_KICKS
    ) -> Paths:
        """Trajectories, readings and their derivatives by the launches."""
        n, maps = self.dimension, self.maps
        steps = len(maps.W0) + 1
        order = np.tile(np.arange(steps), self.turns)
        states = np.empty((self.shots, len(order) + 1, n))
        tangents = np.empty((self.shots, len(order) + 1, n, n))
        states[:, 0] = self._states(launches)
        for cause in causes:
            effect = find(cause.effect)
            if isinstance(effect, LaunchEffect) and effect.shifts is not None:
                states[self.active, 0, effect.shifts] += cause.amount
        tangents[:, 0] = np.eye(n)
        slopes = np.empty((self.shots, self.turns * len(self.at), 2, n))
        where = self._where()
        for group, shots in self._runs(causes, kicks):
            part = states[shots], tangents[shots]
            share(_trajectories, len(shots), *group.W, curved(group.W[2]), order, *part)
            states[shots], tangents[shots] = part
            R1, R2 = (np.tile(r, (self.turns, *(1,) * (r.ndim - 1))) for r in group.R[1:])
            x = part[0][:, where]  # [shot, reading, n]
            own = np.broadcast_to(R1, (len(x), *R1.shape)).copy()
            if R2.any():
                for pair, (a, b) in enumerate(zip(*np.triu_indices(n), strict=True)):
                    own[..., a] += R2[..., pair] * x[:, :, None, b]
                    own[..., b] += R2[..., pair] * x[:, :, None, a]
            slopes[shots] = own @ part[1][:, where]
        beam = self.beam(launches, causes, kicks)
        monitors = np.empty((self.shots, len(self.at), 2, 2))
        monitors[:] = self._known_monitors.matrix()
        monitors[self.active] = self._monitors(causes).matrix()
        turned = np.einsum(
            "smij,stmjk->stmik", monitors, slopes.reshape(self.shots, self.turns, -1, 2, n)
        ).reshape(slopes.shape)
        launch = np.zeros((*slopes.shape[:3], 5))
        columns = _COLUMNS[: 4 + (n == 6)]
        launch[..., : len(columns)] = turned[..., columns]
        return Paths(self._read(beam, causes), launch, beam, states, tangents, slopes, monitors)

    def _where(self) -> NDArray[np.int64]:
        steps = len(self.maps.W0) + 1
        return np.concatenate([self.at + turn * steps for turn in range(self.turns)])

    # --- hypotheses -----------------------------------------------------------------------------
    def hypotheses(self, effects: Sequence[str] | None = None) -> list[Hypothesis]:
        """Every effect at every place that it can sit on, in the catalogue's order.

        Effects that are there or not (swapped, dead) are included; the energy's only in six
        coordinates.
        """
        chosen = names() if effects is None else list(effects)
        found: list[Hypothesis] = []
        for name in chosen:
            if not (CATALOGUE[name].energy and self.dimension == 4):
                found += [(name, place) for place in CATALOGUE[name].places(self.ring)]
        return found

    def signatures(self, paths: Paths, hypotheses: Sequence[Hypothesis], launches: Array) -> Array:
        """d readings / d amount ** power of every hypothesis, [hypothesis, shot, reading, 2].

        For what is discrete: the change when it is there.

        Args:
            paths: of the model as it stands.
            hypotheses: see `hypotheses`.
            launches: those of the paths.
        """
        out = np.zeros((len(hypotheses), *paths.readings.shape))
        ring = [i for i, (name, _) in enumerate(hypotheses) if isinstance(find(name), RingEffect)]
        if ring:
            self._ring_signatures(paths, [hypotheses[i] for i in ring], np.array(ring), out)
        index = self._monitor
        count = len(self.at)
        for i, (name, place) in enumerate(hypotheses):
            effect = find(name)
            if isinstance(effect, ReadingEffect):
                assert place is not None
                m = slice(index[place], None, count)
                h = 1.0 if effect.discrete else 1e-6
                out[i, :, m] = effect.change(paths.beam[:, m], h) / h
            elif isinstance(effect, LaunchEffect):
                h = (1e-3 if effect.power == 1 else 1e-2) * effect.largest
                up = self.beam(launches, [Cause(name, None, h)])
                if effect.power == 1:
                    out[i] = (up - self.beam(launches, [Cause(name, None, -h)])) / (2 * h)
                else:
                    out[i] = (up - self.beam(launches)) / h**effect.power
        return out

    def kick_signatures(self, paths: Paths, layers: NDArray[np.int64]) -> Array:
        """d readings / d (px, py) kick in the middle of layers' magnets.

        Returns:
            [layer, 2, shot, reading, 2], m / rad.
        """
        steps = len(self.maps.W0) + 1
        turns = np.arange(self.turns) * steps
        exits = np.asarray(layers)[:, None] + 1 + turns[None]  # [layer, turn]
        kick = np.stack([self._kick(k) for k in layers])
        inverse = np.linalg.inv(paths.tangents[:, exits])  # [shot, layer, turn, n, n]
        pulled = np.einsum("slTij,lpj->sTlpi", inverse, kick, optimize=True)
        pulled = np.ascontiguousarray(pulled.reshape(self.shots, self.turns, -1, self.dimension))
        start = np.repeat(np.searchsorted(self._where(), exits), 2, axis=0)
        out = np.zeros((2 * len(kick), *paths.readings.shape))
        owner = np.arange(2 * len(kick))
        share(kernels.carry, self.shots, owner, start, pulled, paths.beam_launch, out)
        by_turn = out.reshape(len(out), self.shots, self.turns, -1, 2)
        turned = _through(paths.monitors, by_turn)
        return np.asarray(turned.reshape(len(kick), 2, *paths.readings.shape))

    def free_kicks(
        self, paths: Paths, layers: NDArray[np.int64]
    ) -> tuple[NDArray[np.int64], Array]:
        """A kick (px, py) in the middle of layers' magnets on one turn, as a change of the launch.

        Returns:
            The first reading behind each, [layer], and [layer, 2, shot, n].
        """
        kick = np.stack([self._kick(k) for k in layers])
        inverse = np.linalg.inv(paths.tangents[:, layers + 1])  # [shot, layer, n, n]
        pulled = np.einsum("slij,lpj->lpsi", inverse, kick, optimize=True)
        return np.searchsorted(self._where(), layers + 1), pulled

    def single_kicks(
        self, paths: Paths, hypotheses: Sequence[Hypothesis]
    ) -> tuple[NDArray[np.int64], NDArray[np.int64], Array]:
        """Hypotheses that are one kick on one turn, as changes of the launch.

        Such a signature is the launch's own, cut off before a reading: `scan` needs no more.

        Returns:
            Which of the hypotheses these are, [kick]; the first reading behind each; and the
            change of the launch, [shot, kick, n].
        """
        empty = np.zeros(0, dtype=np.int64)
        ring = [i for i, h in enumerate(hypotheses) if isinstance(find(h[0]), RingEffect)]
        if self.turns > 1 or not ring:
            return empty, empty, np.zeros((self.shots, 0, self.dimension))
        some = [hypotheses[i] for i in ring]
        base = self._directions(some, self.groups[0])
        rows = np.bincount(base.owner, minlength=len(some))
        rows[base.read_owner] = 0
        one = np.isin(base.owner, np.flatnonzero(rows == 1))
        order = np.argsort(base.owner[one])
        owner, exits = base.owner[one][order], base.layer[one][order] + 1
        pulled = np.zeros((self.shots, len(owner), self.dimension))
        inverse = np.linalg.inv(paths.tangents)
        for group in self.groups:
            if not group.active:
                continue
            d = self._directions(some, group)
            own = np.isin(d.owner, owner)  # fewer where a setting takes its effect away
            kicks = np.empty((len(group.shots), 1, len(d.owner), self.dimension))
            states = np.ascontiguousarray(paths.states[group.shots])
            kernels.kicks(d.layer, d.D0, d.D1, d.D2, states, 0, kicks)
            back = inverse[group.shots][:, d.layer[own] + 1]
            change = np.einsum("skij,skj->ski", back, kicks[:, 0][:, own], optimize=True)
            pulled[np.ix_(group.shots, np.searchsorted(owner, d.owner[own]))] = change
        return np.array(ring)[owner], np.searchsorted(self._where(), exits), pulled

    def slopes(self, paths: Paths) -> Array:
        """d readings / d launch in all coordinates of the model, [shot, reading, 2, n]."""
        by_turn = paths.beam_launch.reshape(self.shots, self.turns, -1, 2, self.dimension)
        turned = np.einsum("smij,stmjk->stmik", paths.monitors, by_turn)
        return np.asarray(turned.reshape(paths.beam_launch.shape))

    def _ring_signatures(
        self, paths: Paths, hypotheses: list[Hypothesis], index: NDArray[np.int64], out: Array
    ) -> None:
        steps = len(self.maps.W0) + 1
        inverse = np.linalg.inv(paths.tangents)  # [shot, step + 1, n, n]
        where = self._where()
        turns = np.arange(self.turns) * steps
        for group in self.groups:
            d = self._directions(hypotheses, group)
            shots = group.shots
            kicks = np.empty((len(shots), self.turns, len(d.owner), self.dimension))
            states = np.ascontiguousarray(paths.states[shots])
            kernels.kicks(d.layer, d.D0, d.D1, d.D2, states, steps, kicks)
            exits = d.layer[:, None] + 1 + turns[None]  # [row, turn]
            pulled = np.einsum("strij,strj->stri", inverse[shots][:, exits.T], kicks)
            start = np.searchsorted(where, exits)
            part = np.zeros((len(hypotheses), len(shots), *out.shape[2:]))
            slopes = np.ascontiguousarray(paths.beam_launch[shots])
            share(kernels.carry, len(shots), d.owner, start, pulled, slopes, part)
            for row, (owner, monitor) in enumerate(zip(d.read_owner, d.monitor, strict=True)):
                for turn in range(self.turns):
                    x = states[:, turns[turn] + self.at[monitor]]
                    i, j = np.triu_indices(self.dimension)
                    moved = d.E0[row] + x @ d.E1[row].T + (x[:, i] * x[:, j]) @ d.E2[row].T
                    part[owner, :, turn * len(self.at) + monitor] += moved
            by_turn = part.reshape(*part.shape[:2], self.turns, -1, 2)
            turned = _through(paths.monitors[shots], by_turn)
            out[index[:, None], shots[None]] = turned.reshape(part.shape)

    def _directions(self, hypotheses: list[Hypothesis], group: _Group) -> Directions:
        key = tuple(hypotheses)
        if key not in self._base.directions:
            design = _base(self.design, (), self.dimension).layers
            self._base.directions[key] = directions(design, hypotheses)
        base = self._base.directions[key]
        if not group.layers:
            return base
        if group.latest is not None and group.latest[0] == key:
            return group.latest[1]
        replaced = set_elements(self.ring, group.settings)
        touched = {self.ring.elements[place].name for place in replaced}
        families = {self.ring.elements[place].family for place in replaced}
        again = [
            i for i, (_, place) in enumerate(hypotheses) if place in touched or place in families
        ]
        layers = LayerMaps(self.ring.with_elements(replaced), self.dimension)
        fresh = directions(layers, [hypotheses[i] for i in again])
        keep = ~np.isin(base.owner, again)
        keep_read = ~np.isin(base.read_owner, again)
        owner = np.array(again, dtype=np.int64)
        joined = {
            name: np.concatenate([getattr(base, name)[kept], getattr(fresh, name)])
            for names, kept in (
                (("layer", "D0", "D1", "D2"), keep),
                (("monitor", "E0", "E1", "E2"), keep_read),
            )
            for name in names
        }
        found = Directions(
            hypotheses=base.hypotheses,
            owner=np.concatenate([base.owner[keep], owner[fresh.owner]]),
            read_owner=np.concatenate([base.read_owner[keep_read], owner[fresh.read_owner]]),
            **joined,
        )
        if len(key) > FEW:
            group.latest = (key, found)
        return found


def _through(monitors: Array, beam: Array) -> Array:
    """What monitors [shot, monitor, 2, 2] make of [hypothesis, shot, turn, monitor, 2]."""
    if np.array_equal(monitors, np.broadcast_to(np.eye(2), monitors.shape)):
        return beam
    return np.asarray(np.einsum("smij,hstmj->hstmi", monitors, beam))


def _trajectories(first: int, last: int, *arguments: Array) -> None:
    W0, W1, W2, bends, order, states, tangents = arguments
    kernels.trajectories(W0, W1, W2, bends, order, states[first:last], tangents[first:last])
