"""Measurements of a stored beam: each kind reads closed orbits, tunes and modes in its own way.

A measurement has states of the ring (settings of a shot, steps of the RF). In each the beam has a
closed orbit, two tunes and two modes. Readings are linear in these, so that `readings_of` gives
prediction and derivatives. A new kind is a class with `readings_of` and its data.

A `Steady` kind of measurement gives its readings of a ring with causes (`view`, `read`), their
derivatives (`signatures`), and its nuisances (`directions`). The rest of a `Problem` is here.
"""

from abc import abstractmethod
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Self

import numpy as np
from scipy.sparse import csr_array

from tmlattice.arrays import Array, Flags, Indices
from tmlattice.beam.closed_orbit import ResponseModel
from tmlattice.beam.rf import NO_RF, Cavities, cavities, rf_of
from tmlattice.beam.stored import Moved, StoredBeam
from tmlattice.effects import (
    Cause,
    Hypothesis,
    LaunchEffect,
    Monitors,
    ReadingEffect,
    RingEffect,
    Settings,
    apply,
    find,
    is_energy,
    monitors_with,
)
from tmlattice.effects.effect import MIN_STRENGTH
from tmlattice.errors import LatticeError, UnstableRingError
from tmlattice.inference.problem import (
    NO_KICKS,
    Kicks,
    Metric,
    Point,
    Problem,
    Products,
    effects_on_readings,
)
from tmlattice.inference.whitening import Projection
from tmlattice.lattice import Ring
from tmlattice.observe.calibration import offset_of

NOTHING = np.zeros(0)
"""Nuisances of a kind without any."""


@dataclass(frozen=True, kw_only=True)
class Steady(Problem):
    """Readings of a stored beam.

    Attributes:
        used: fitted readings, of the kind's own shape.
        values, sigma: measured readings, and their noise, of compatible shapes.
    """

    used: Flags = field(repr=False)
    values: Array = field(repr=False)
    sigma: Array = field(repr=False)

    @abstractmethod
    def view(self, causes: Sequence[Cause]) -> Any:
        """Return the ring with these causes.

        Raises:
            UnstableRingError: no stored beam.
        """

    @abstractmethod
    def read(self, view: Any, nuisances: Array) -> Array:
        """Predicted readings, of the kind's shape."""

    @abstractmethod
    def signatures(self, view: Any, nuisances: Array, hypotheses: Sequence[Hypothesis]) -> Array:
        """d readings / d amount ** power of one cause more, [hypothesis, ...]; of a discrete effect
        its change, of an invisible one zero."""

    @abstractmethod
    def of_monitors(self, view: Any, nuisances: Array, effect: ReadingEffect) -> Array:
        """d readings / d amount of a further effect, for every monitor, of the kind's shape."""

    def directions(self, view: Any, nuisances: Array) -> Array:
        """d readings / d nuisance, [nuisance, ...]; here none."""
        return np.zeros((0, *self.used.shape))

    # --- the model ------------------------------------------------------------------------------
    @property
    def first(self) -> Array:
        """First guess of the nuisances; here none."""
        return NOTHING

    def at(self, causes: Sequence[Cause], nuisances: Array, kicks: Kicks = NO_KICKS) -> Point:
        """Return the model's point, lost without a stored beam."""
        count = int(self.used.sum())
        view, read, lost = None, np.zeros(self.used.shape), ""
        residual = np.full(count, np.nan)
        projection: Projection | None = None
        try:
            view = self.view((*self.fixed, *causes))
            read = self.read(view, nuisances)
            residual = self.as_rows(self.values - read)
            projection = Projection(self.as_rows(self.directions(view, nuisances)).T[None])
        except UnstableRingError:
            lost = "the ring has no closed orbit"
        return Point(tuple(causes), nuisances, dict(kicks), residual, projection, read, view, lost)

    def slope(self, point: Point, cause: int) -> Array:
        """Slope in closed form: the signature of the same effect on top of the present amount."""
        own = point.causes[cause]
        effect, amount = find(own.effect), own.amount
        if effect.multiplies and abs(1 + amount) < MIN_STRENGTH:
            before, behind = point.causes[:cause], point.causes[cause + 1 :]
            low, high = (
                self.at((*before, replace(own, amount=amount + side), *behind), point.nuisances)
                for side in (-MIN_STRENGTH, MIN_STRENGTH)
            )
            return np.asarray((low.residual - high.residual) / (2 * MIN_STRENGTH))
        (slope,) = self.signatures(point.view, point.nuisances, [(own.effect, own.element)])
        return self.as_rows(effect.chain(amount) * slope)

    def moved(self, nuisances: Array, change: Array) -> Array:
        """Return the nuisances after a change; they are linear."""
        return nuisances + change.reshape(nuisances.shape)

    def metric(self, point: Point) -> Metric:
        """Return products of closed-form signatures."""
        return SteadyMetric(self, point)

    def neighbours(self, hypothesis: Hypothesis, among: Sequence[Hypothesis]) -> list[Hypothesis]:
        """Return no neighbours: a stored beam is linear enough in all of them."""
        return []

    # --- readings -------------------------------------------------------------------------------
    @property
    def valid(self) -> Flags:
        """Fitted readings, of the kind's shape."""
        return self.used

    def as_rows(self, readings: Array) -> Array:
        """Rows of the fitted readings, in units of the noise."""
        scaled = readings / self.sigma
        if self.used.all():
            return np.asarray(scaled.reshape(*scaled.shape[: -self.used.ndim], self.used.size))
        return np.asarray(scaled[..., self.used])

    def left(self, point: Point) -> tuple[Array, Array]:
        """Residuals over noise and variances of 1: nuisances absorb a small share of a reading."""
        assert point.projection is not None
        rows = np.zeros(self.used.shape)
        rows[self.used] = point.projection.out(point.residual)
        return rows, np.ones(self.used.shape)

    def without(self, dropped: Flags) -> Self:
        """Return the problem without some readings."""
        return replace(self, used=self.used & ~dropped)


class SteadyMetric(Metric):
    """Products at one point; errors of monitors from their own readings."""

    def __init__(self, problem: Steady, point: Point) -> None:
        assert point.projection is not None
        super().__init__(point.projection)
        self.problem, self.point = problem, point

    def rows(self, hypotheses: Sequence[Hypothesis]) -> Array:
        """See `Metric.rows`."""
        point = self.point
        return self.problem.as_rows(
            self.problem.signatures(point.view, point.nuisances, hypotheses)
        )

    def quick(self, hypotheses: Sequence[Hypothesis], data: Array, found: Products) -> Indices:
        """Put in products of monitor errors, by effect; return their indices."""
        problem, point, done = self.problem, self.point, [np.zeros(0, dtype=np.intp)]
        owner = problem.owner()[problem.used]
        read = np.flatnonzero(owner >= 0)
        shape = len(owner), len(problem.monitors)
        belongs = csr_array((np.ones(len(read)), (read, owner[read])), shape=shape)
        vectors = self.vectors(data)
        for effect, which, at in effects_on_readings(hypotheses, problem.monitors):
            row = problem.as_rows(problem.of_monitors(point.view, point.nuisances, effect))
            self.put(which, (row**2 @ belongs)[at], ((vectors * row) @ belongs)[:, at].T, found)
            done.append(which)
        return np.concatenate(done)

    def vectors(self, data: Array) -> Array:
        """Rows of data, then those that the nuisances span."""
        return np.concatenate([data, self.projection.Q[0].T])

    def put(self, which: Indices, whole: Array, along: Array, found: Products) -> None:
        """Set squares [hypothesis], and products with `vectors` [hypothesis, vector]."""
        data = found.inner.shape[1]
        found.put(which, whole, (along[:, data:] ** 2).sum(axis=1), along[:, :data])

    def free_monitors(self, clean: Array) -> tuple[Array, Array]:
        """Information of all readings of each monitor, and product with data."""
        owner = self.problem.owner()[self.problem.used]
        count = len(self.problem.monitors)
        most = int(np.bincount(owner[owner >= 0], minlength=count).max(initial=1))
        gram, inner = np.zeros((count, 1, most, most)), np.zeros((count, 1, most))
        (Q,) = self.projection.Q
        for m in range(count):
            own = np.flatnonzero(owner == m)
            k = len(own)
            gram[m, 0, :k, :k] = np.eye(k) - Q[own] @ Q[own].T
            inner[m, 0, :k] = clean[own]
        return gram, inner


MAX_CHANGES = 10
"""Causes up to which a model is changed from the one without; with more it is cached."""

MAX_BEAMS = 6
"""Stored beams in memory: some megabytes each."""


class ModelCache:
    """Cache of models: measurements of one machine share them, and most causes stay the same from
    one call to the next."""

    def __init__(self) -> None:
        self._bases: dict[str, tuple[tuple[Cause, ...], ResponseModel]] = {}
        self._beams: deque[tuple[str, tuple[float, bool], tuple[Cause, ...], StoredBeam]] = deque(
            maxlen=MAX_BEAMS
        )

    def beam(
        self,
        ring: Ring,
        settings: Settings,
        frequency: float,
        causes: tuple[Cause, ...],
        feels_rf: bool = False,
    ) -> StoredBeam:
        """Return the stored beam of a ring with settings and causes.

        Args:
            ring: the design.
            settings, causes: of the state.
            frequency: of the RF, relative.
            feels_rf: whether the oscillation includes the RF turn by turn, see `Rf.on`.

        Raises:
            UnstableRingError: no stored beam.
        """
        key, state = repr(settings), (frequency, feels_rf)
        near: tuple[ResponseModel, float] | None = None
        for own, at, known, beam in self._beams:
            if own == key and known == causes:
                if at == state:
                    return beam
                near = beam.model, frequency + beam.model.frequency - at[0]
        if near is None:
            model, energy = self._model(ring, settings, causes), offset_of(causes)
            near = model, frequency + (energy / float(model.rf_start[5]) if energy else 0.0)
        model, of_beam = near
        if model.frequency != of_beam:
            model = model.at_frequency(of_beam)
        made = StoredBeam(model, cavities_of(ring, model, frequency) if feels_rf else NO_RF)
        self._beams.append((key, state, causes, made))
        return made

    def _model(self, ring: Ring, settings: Settings, causes: tuple[Cause, ...]) -> ResponseModel:
        key = repr(settings)
        known, base = self._bases.get(key, ((), None))
        if base is None or causes[: len(known)] != known:
            pairs = enumerate(zip(causes, known, strict=False))
            same = next((i for i, (a, b) in pairs if a != b), min(len(causes), len(known)))
            many = same if same > MAX_CHANGES else len(causes)
            known = causes[:many] if len(causes) > MAX_CHANGES else ()
            base = ResponseModel(apply(ring, known, settings))
            self._bases[key] = (known, base)
        rest = [c for c in causes[len(known) :] if isinstance(find(c.effect), RingEffect)]
        return base.changed_to(apply(base.ring, rest)) if rest else base


def cavities_of(ring: Ring, model: ResponseModel, frequency: float | None = None) -> Cavities:
    """Return the RF that acts on turns of a stored beam.

    Args:
        ring: the design.
        model: of the ring with its errors.
        frequency: relative change that was set; None: the model's. The rest of the model's is an
            energy of the beam, which turns no RF on.

    Raises:
        UnstableRingError: the RF cannot replace the energy loss.
    """
    rf = ring.memory.setdefault("rf", rf_of(ring))
    loss = sum(element.errors.loss for element in model.ring.elements)
    if not rf.on(loss, model.frequency if frequency is None else frequency):
        return NO_RF
    try:
        return cavities(ring, rf, model.layers.layer_of, loss, model.frequency)
    except LatticeError as error:
        raise UnstableRingError(str(error)) from error


@dataclass(frozen=True)
class Beams:
    """Stored beams at some causes.

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
        read_by: the monitor of each reading, -1 for none, of the kind's shape.
        cache: of models; measurements of the same ring may share one.
        counts: whether readings are turn by turn.
        oscillates: whether tunes or modes are read.
    """

    counts: ClassVar[bool] = False
    oscillates: ClassVar[bool] = True

    ring: Ring = field(repr=False)
    states: tuple[tuple[Settings, float], ...]
    read_by: Indices = field(repr=False)
    cache: ModelCache = field(default_factory=ModelCache, repr=False, compare=False)

    @abstractmethod
    def readings_of(self, states: Sequence[Moved], nuisances: Array) -> Array:
        """Readings [..., *shape] of the states' orbits, tunes and modes, or of changes of these,
        with any leading axes; linear."""

    def with_turn_offsets(self, states: Sequence[Moved], late: Array) -> list[Moved]:
        """Return the states, or their changes, with turn offsets of the monitors [monitor]."""
        return list(states)

    def one_turn_later(self, states: Sequence[Moved]) -> list[Moved]:
        """Return their change, to first order, by one turn later at every monitor."""
        raise NotImplementedError("this kind of measurement has no turns")

    @property
    def monitors(self) -> Sequence[str]:
        """All monitors of the ring."""
        return [monitor.name for monitor in self.ring.monitors]

    def owner(self) -> Indices:
        """Monitor of each reading; -1: of no single monitor."""
        return self.read_by

    # --- the model ------------------------------------------------------------------------------
    def sees(self, hypothesis: Hypothesis) -> bool:
        """Whether a stored beam shows the cause: of the launch the energy, which the RF's frequency
        determines, and turn offsets in turns alone."""
        effect = find(hypothesis[0])
        if isinstance(effect, LaunchEffect):
            return is_energy(effect.name)
        return self.counts or not effect.of_turns

    def view(self, causes: Sequence[Cause]) -> Beams:
        """Return the stored beam of each state."""
        there = tuple(causes)
        beams = tuple(
            self.cache.beam(self.ring, *state, there, self.counts) for state in self.states
        )
        return Beams(beams, monitors_with(self.ring, causes))

    def shown(self, view: Beams, nuisances: Array) -> list[Moved]:
        """Return orbit, tunes and modes of each state."""
        return [beam.shown for beam in view.beams]

    def read(self, view: Beams, nuisances: Array) -> Array:
        """Predicted readings with the monitors' errors."""
        matrix, constant = view.monitors.matrix(), view.monitors.constant()
        shown = self.with_turn_offsets(self.shown(view, nuisances), view.monitors.late)
        return self.readings_of([seen_by(one, matrix, constant) for one in shown], nuisances)

    def signatures(self, view: Beams, nuisances: Array, hypotheses: Sequence[Hypothesis]) -> Array:
        """Signatures: effects on the beam in closed form, those on monitors by differences."""
        out = np.zeros((len(hypotheses), *self.used.shape))
        of_beam = np.flatnonzero([not isinstance(find(h[0]), ReadingEffect) for h in hypotheses])
        if len(of_beam):
            some = [hypotheses[i] for i in of_beam.tolist()]
            matrix = view.monitors.matrix()
            known: dict[int, Moved] = {}
            for beam in view.beams:
                if id(beam) not in known:
                    known[id(beam)] = seen_by(beam.moved(some, self.oscillates), matrix)
            moved = self.with_turn_offsets(
                [known[id(beam)] for beam in view.beams], view.monitors.late
            )
            out[of_beam] = self.readings_of(moved, nuisances)
        for effect, which, at in effects_on_readings(hypotheses, self.monitors):
            changed = self.of_monitors(view, nuisances, effect)
            for i, monitor in zip(which, at, strict=True):
                mine = self.read_by == monitor
                out[i][mine] = changed[mine]
        return out

    def of_monitors(self, view: Beams, nuisances: Array, effect: ReadingEffect) -> Array:
        """d readings / d amount of a further effect, for every monitor."""
        own = self.with_turn_offsets(self.shown(view, nuisances), view.monitors.late)
        if effect.of_turns:
            matrix = view.monitors.matrix()
            return self.readings_of(
                [seen_by(one, matrix) for one in self.one_turn_later(own)], nuisances
            )
        slope, constant = effect.slopes(view.monitors)
        return self.readings_of(
            [seen_by(one, slope, constant, tunes=0.0) for one in own], nuisances
        )


def seen_by(
    shown: Moved, matrix: Array, constant: Array | float = 0.0, tunes: float = 1.0
) -> Moved:
    """Return the states as read by monitors with errors."""
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


def states_of(settings: Sequence[Settings], shots: int) -> tuple[tuple[Settings, float], ...]:
    """Settings and relative RF frequency of each shot; without settings, those of the design."""
    return tuple(
        (own, float(own.get("rf", {}).get("frequency_relative", 0.0)))
        for own in settings or ({},) * shots
    )


def stacked(states: Sequence[Moved], name: str) -> Array:
    """One quantity of all states, [..., state, *its own axes]; "orbit" behind leading axes."""
    depth = {"orbit": 2, "tunes": 1, "modes": 3}[name]
    parts = [getattr(state, name) for state in states]
    return np.stack(parts, axis=parts[0].ndim - depth)
