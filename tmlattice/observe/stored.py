"""Kinds of measurement of a stored beam: each reads closed orbits, tunes and modes in its own way.

A measurement sees the ring in some states (settings of a shot, steps of the RF). In each the beam
has a closed orbit, two tunes and two modes; what the monitors show of these is linear in them, and
so `told` is prediction and derivative in one. A new kind is a class with `told` and its data.
"""

from abc import abstractmethod
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from tmlattice.beam.closed_orbit import ResponseModel
from tmlattice.beam.rf import NO_RF, Cavities, cavities
from tmlattice.beam.rf import rf_of as rf_in
from tmlattice.beam.stored import Moved, StoredBeam
from tmlattice.effects import (
    Cause,
    LaunchEffect,
    Monitors,
    ReadingEffect,
    RingEffect,
    Settings,
    apply,
    find,
    monitors_with,
)
from tmlattice.errors import LatticeError, UnstableRingError
from tmlattice.inference.metric import Hypothesis
from tmlattice.lattice import Ring
from tmlattice.observe.steady import Steady

Array = NDArray[np.float64]

SMALL = 1e-3
"""Of a monitor's largest error: the step of the differences."""

FEW = 10
"""Causes with which a model is made from the one without; of more it is kept."""

BEAMS = 6
"""Stored beams that are remembered: some megabytes each."""


class Kept:
    """Models made a moment ago: measurements of one machine ask for the same ones, and most causes
    are the same from one call to the next."""

    def __init__(self) -> None:
        self._bases: dict[str, tuple[tuple[Cause, ...], ResponseModel]] = {}
        self._beams: deque[tuple[str, tuple[float, bool], tuple[Cause, ...], StoredBeam]] = deque(
            maxlen=BEAMS
        )

    def beam(
        self,
        ring: Ring,
        settings: Settings,
        frequency: float,
        causes: tuple[Cause, ...],
        feels_rf: bool = False,
    ) -> StoredBeam:
        """The stored beam of a ring with settings and causes.

        Args:
            ring: the design.
            settings, causes: of the state.
            frequency: of the RF, relative.
            feels_rf: its oscillation does, turn by turn; where the RF is on, see `Rf.on`.

        Raises:
            UnstableRingError: there is none.
        """
        key, near, state = repr(settings), None, (frequency, feels_rf)
        for own, at, known, beam in self._beams:
            if own == key and known == causes:
                if at == state:
                    return beam
                near = beam
        model = self._model(ring, settings, causes) if near is None else near.model
        if model.frequency != frequency:
            model = model.at_frequency(frequency)
        made = StoredBeam(model, cavities_of(ring, model) if feels_rf else NO_RF)
        self._beams.append((key, state, causes, made))
        return made

    def _model(self, ring: Ring, settings: Settings, causes: tuple[Cause, ...]) -> ResponseModel:
        key = repr(settings)
        known, base = self._bases.get(key, ((), None))
        if base is None or causes[: len(known)] != known:
            pairs = enumerate(zip(causes, known, strict=False))
            same = next((i for i, (a, b) in pairs if a != b), min(len(causes), len(known)))
            many = same if same > FEW else len(causes)
            known = causes[:many] if len(causes) > FEW else ()
            base = ResponseModel(apply(ring, known, settings))
            self._bases[key] = (known, base)
        rest = [c for c in causes[len(known) :] if isinstance(find(c.effect), RingEffect)]
        return base.changed_to(apply(base.ring, rest)) if rest else base


def cavities_of(ring: Ring, model: ResponseModel) -> Cavities:
    """The RF that turns of a stored beam feel.

    Args:
        ring: the design.
        model: of it with what is wrong.

    Raises:
        UnstableRingError: the RF cannot make good what the beam loses.
    """
    rf = ring.memory.setdefault("rf", rf_in(ring))
    loss = sum(element.errors.loss for element in model.ring.elements)
    try:
        return cavities(ring, rf, model.layers.layer_of, loss, model.frequency)
    except LatticeError as error:
        raise UnstableRingError(str(error)) from error


@dataclass(frozen=True)
class Beams:
    """What there is at some causes.

    Attributes:
        beams: the stored beam of each state.
        monitors: with their errors.
    """

    beams: tuple[StoredBeam, ...]
    monitors: Monitors


@dataclass(frozen=True, kw_only=True)
class Stored(Steady):
    """Readings of stored beams in some states of a ring.

    Attributes:
        ring: the design.
        states: settings and relative RF frequency of each.
        data, errors: what was read and its noise, of the kind's shape.
        read_by: the monitor of each reading, -1 for none, of the kind's shape.
        kept: models made a moment ago; those of the same ring may share one.
        counts: whether turn by turn is read.
    """

    counts: ClassVar[bool] = False

    ring: Ring = field(repr=False)
    states: tuple[tuple[Settings, float], ...]
    data: Array = field(repr=False)
    errors: Array = field(repr=False)
    read_by: NDArray[np.int64] = field(repr=False)
    kept: Kept = field(default_factory=Kept, repr=False, compare=False)

    @abstractmethod
    def told(self, states: Sequence[Moved], nuisances: Array) -> Array:
        """The kind's readings [..., *shape] of what each state shows, or of changes of that, with
        any axes in front; linear."""

    def counted(self, states: Sequence[Moved], late: Array) -> list[Moved]:
        """What is shown, or changes of it, where monitors [monitor] count turns from later ones."""
        return list(states)

    def a_turn_on(self, states: Sequence[Moved]) -> list[Moved]:
        """What a turn later at every monitor changes of that, to first order."""
        raise NotImplementedError("this kind of measurement has no turns")

    @property
    def values(self) -> Array:
        """As read."""
        return self.data

    @property
    def sigma(self) -> Array:
        """Of each reading."""
        return self.errors

    @property
    def monitors(self) -> Sequence[str]:
        """All of the ring."""
        return [monitor.name for monitor in self.ring.monitors]

    def owner(self) -> NDArray[np.int64]:
        """The monitor of each reading; -1: what no monitor tells alone."""
        return self.read_by

    # --- the model ------------------------------------------------------------------------------
    def sees(self, hypothesis: Hypothesis) -> bool:
        """A stored beam has no launch, and only where turns are read their count."""
        effect = find(hypothesis[0])
        return not isinstance(effect, LaunchEffect) and (self.counts or not effect.of_turns)

    def view(self, causes: Sequence[Cause]) -> Beams:
        """A closed orbit for each state."""
        there = tuple(causes)
        beams = tuple(
            self.kept.beam(self.ring, *state, there, self.counts) for state in self.states
        )
        return Beams(beams, monitors_with(self.ring, causes))

    def shown(self, view: Beams, nuisances: Array) -> list[Moved]:
        """What the beam of each state shows."""
        return [beam.shown for beam in view.beams]

    def read(self, view: Beams, nuisances: Array) -> Array:
        """Monitors' errors and all."""
        matrix, constant = view.monitors.matrix(), view.monitors.constant()
        shown = self.counted(self.shown(view, nuisances), view.monitors.late)
        return self.told([seen_by(one, matrix, constant) for one in shown], nuisances)

    def signatures(self, view: Beams, nuisances: Array, hypotheses: Sequence[Hypothesis]) -> Array:
        """Effects on the ring in closed form, those of monitors by differences."""
        out = np.zeros((len(hypotheses), *self.used.shape))
        kinds = [find(name) for name, _ in hypotheses]
        on_ring = [i for i, kind in enumerate(kinds) if isinstance(kind, RingEffect)]
        if on_ring:
            some = [hypotheses[i] for i in on_ring]
            matrix = view.monitors.matrix()
            known: dict[int, Moved] = {}
            for beam in view.beams:
                if id(beam) not in known:
                    known[id(beam)] = seen_by(beam.moved(some), matrix)
            moved = self.counted([known[id(beam)] for beam in view.beams], view.monitors.late)
            out[on_ring] = self.told(moved, nuisances)
        place = {monitor.name: i for i, monitor in enumerate(self.ring.monitors)}
        for name in dict.fromkeys(name for name, _ in hypotheses):
            effect = find(name)
            if isinstance(effect, ReadingEffect):
                own = [i for i, h in enumerate(hypotheses) if h[0] == name]
                changed = self.of_monitors(view, nuisances, effect)
                for i in own:
                    mine = self.read_by == place[hypotheses[i][1] or ""]
                    out[i][mine] = changed[mine]
        return out

    def of_monitors(self, view: Beams, nuisances: Array, effect: ReadingEffect) -> Array:
        """d readings / d amount of an effect on top, every monitor's own."""
        own = self.counted(self.shown(view, nuisances), view.monitors.late)
        if effect.of_turns:
            matrix = view.monitors.matrix()
            return self.told([seen_by(one, matrix) for one in self.a_turn_on(own)], nuisances)
        high = 1.0 if effect.discrete else SMALL * effect.largest
        low = 0.0 if effect.discrete else -high
        ends = []
        for amount in (high, low):
            monitors = view.monitors.copy()
            if amount:
                effect.set(monitors, slice(None), amount)
            ends.append((monitors.matrix(), monitors.constant()))
        (upper, up), (lower, down) = ends
        slope, constant = ((a - b) / (high - low) for a, b in ((upper, lower), (up, down)))
        return self.told([seen_by(one, slope, constant, tunes=0.0) for one in own], nuisances)


def seen_by(
    shown: Moved, matrix: Array, constant: Array | float = 0.0, tunes: float = 1.0
) -> Moved:
    """What monitors make of it."""
    orbit, modes = shown.orbit + constant, shown.modes
    wrong = np.flatnonzero((matrix != np.eye(2)).any(axis=(1, 2)))
    if len(wrong):
        modes, orbit = modes.copy(), orbit.copy()
        own = matrix[wrong]
        modes[..., wrong, :, :] = np.einsum(
            "mij,...mjp->...mip", own, shown.modes[..., wrong, :, :]
        )
        beam = shown.orbit[..., wrong, :]
        orbit[..., wrong, :] += np.einsum("mij,...mj->...mi", own, beam) - beam
    return Moved(orbit, tunes * shown.tunes, modes)


def rf_of(settings: Settings) -> float:
    """Relative RF frequency that a shot was set to."""
    return float(settings.get("rf", {}).get("frequency_relative", 0.0))


def stacked(states: Sequence[Moved], name: str) -> Array:
    """One quantity of all states, [..., state, *its own]: "orbit" behind the axes in front."""
    depth = {"orbit": 2, "tunes": 1, "modes": 3}[name]
    parts = [getattr(state, name) for state in states]
    return np.stack(parts, axis=parts[0].ndim - depth)
