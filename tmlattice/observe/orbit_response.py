"""What is read of an orbit response with errors of ring, monitors, correctors and beam; and rows.

>>> data = response_data(ring, measured)
>>> there = Predicted(data, Errors.none(data))
>>> data.orbits - there.read                       # what the design leaves, [column, monitor, 2]

Columns and blocks are those of `response_data`.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from tmlattice.beam.closed_orbit import ResponseModel
from tmlattice.beam.kicks import by_energy
from tmlattice.beam.response_derivatives import ResponseSlopes
from tmlattice.effects import Cause, ReadingEffect, RingEffect, apply, find, monitors_with
from tmlattice.errors import EffectError, UnstableRingError
from tmlattice.observe.response_data import ResponseData

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Flags = NDArray[np.bool_]
Hypothesis = tuple[str, str | None]

DELTA = 1e-3
"""Energy deviation of the differences that tell what an energy spread does; its square is also
the unit in which the spread's is fitted."""
TURN = 0.1
"""Roll that shows a corrector's kick in the other plane, rad."""
SMALL = 1e-3
"""Of a monitor's largest error: the step of the differences."""
OFF = 0.1
"""Share of what a corrector is told, below which what it kicks says nothing of its plane."""


@dataclass(frozen=True, eq=False)
class Errors:
    """What is wrong with monitors, correctors, ring and beam.

    Attributes:
        monitors: d reading / d beam, [monitor, 2, 2].
        calibration, roll: of the columns, 0 for the RF, [column].
        ring: causes in the ring.
        energy: relative deviation of the beam's mean energy from the one that its magnets are set
            for.
        spread: mean square energy deviation, in units of `DELTA` squared.
        dispersion: what the RF's orbit has of kicks, see `beam.kicks`, m, [monitor, 2].
        at_correctors: the dispersion of these kicks in each one's plane, m, [corrector].
    """

    monitors: Array
    calibration: Array
    roll: Array
    ring: tuple[Cause, ...] = ()
    energy: float = 0.0
    spread: float = 0.0
    dispersion: Array | float = 0.0
    at_correctors: Array | float = 0.0

    @classmethod
    def none(cls, data: ResponseData) -> "Errors":
        """The design."""
        columns, monitors = data.shape
        eye = np.tile(np.eye(2), (monitors, 1, 1))
        return cls(eye, np.zeros(columns), np.zeros(columns))

    @property
    def turned(self) -> Flags:
        """Columns of correctors that kick more in the other plane than in their own, and not next
        to nothing: these are off."""
        return np.abs(self.roll) > np.maximum(np.abs(1 + self.calibration), OFF)

    @property
    def kick(self) -> Array:
        """Of both planes, as a share of what a corrector is told; negative for a reversed one,
        which is told from one that is turned by more than half a right angle, [column]."""
        own = 1 + self.calibration
        return np.where((own < 0) & ~self.turned, -1.0, 1.0) * np.hypot(own, self.roll)

    @property
    def angle(self) -> Array:
        """Of each kick to its plane, rad: a right one where it has nothing in that, [column]."""
        sign = np.sign(self.kick)
        return np.arctan2(sign * self.roll, sign * (1 + self.calibration))

    def with_causes(self, data: ResponseData, causes: Sequence[Cause]) -> "Errors":
        """These and more; an energy spread adds in square.

        Raises:
            EffectError: an effect of the launch, which a closed orbit does not have.
        """
        ring = list(self.ring)
        scale, energy, spread = np.ones(len(data.kicks)), self.energy, self.spread
        for cause in causes:
            if cause.effect == "energy_spread":
                spread += (cause.amount / DELTA) ** 2
            elif cause.effect == "energy_offset":
                energy += cause.amount
            elif isinstance(find(cause.effect), RingEffect):
                ring.append(cause)
                if cause.effect == "corrector_calibration":  # of the steps, beside the setting's
                    scale[_column(data, cause.element)] *= 1 + cause.amount
            elif not isinstance(find(cause.effect), ReadingEffect):
                raise EffectError(f"'{cause.effect}' does not act on a closed orbit")
        more = monitors_with(data.ring, causes).matrix()[data.at]
        calibration = (1 + self.calibration) * scale - 1
        monitors = more @ self.monitors
        return replace(
            self, monitors=monitors, calibration=calibration, ring=tuple(ring), energy=energy,
            spread=spread,
        )  # fmt: skip


def _column(data: ResponseData, name: str | None) -> list[int]:
    return [i for i, own in enumerate(data.measured.correctors)
            if data.ring[own].name == data.ring[name or ""].name]  # fmt: skip


@dataclass(frozen=True, eq=False)
class Predicted:
    """What monitors read with some errors, and how it changes: linear about them.

    Attributes:
        data: correctors, kicks and monitors are its.
        errors: that are there.
        bent: what the steps' finite size adds to their linear orbit changes, m; see `bend`.
    """

    data: ResponseData
    errors: Errors
    bent: Array | float = 0.0

    @cached_property
    def model(self) -> ResponseModel:
        """Of the ring with its errors, at the beam's energy; UnstableRingError where it has no
        closed orbit."""
        model, errors = self.data.design, self.errors
        if errors.ring:
            model = model.changed_to(apply(model.ring, errors.ring))
        return model.at_energy(errors.energy) if errors.energy else model

    def orbits(self, model: ResponseModel) -> Array:
        """Orbit changes of the steps, the RF's last, m, [column, monitor, 2].

        The RF's is as large as the dispersion: a step of half a per cent in energy has a third
        order that is several times the readings' noise.
        """
        data = self.data
        steps = model.response(data.measured.correctors) * data.kicks[:-1, None, None]
        whole = np.concatenate([steps, model.rf_change(data.kicks[-1])[None]])[:, data.at]
        if np.any(self.errors.dispersion):
            at_monitors = np.asarray(self.errors.dispersion) / data.energy_of_rf
            names = data.measured.correctors
            at_correctors = np.broadcast_to(self.errors.at_correctors, len(names))
            slope = by_energy(model, names, data.at, at_monitors, at_correctors)
            whole[:-1] += slope * data.kicks[:-1, None, None]
            whole[-1] += self.errors.dispersion
        return np.asarray(whole + self.bent)

    def bend(self) -> "Predicted":
        """With the third order of the correctors' two-sided steps.

        It is a micrometre where the orbit is a millimetre, and the closed orbits of all correctors
        take seconds: it is taken once a step.
        """
        data, names = self.data, self.data.measured.correctors
        kicks = data.kicks[:-1] * (1 + self.errors.calibration[:-1])
        up, down = (self.model.closed_orbits(names, side * kicks / 2) for side in (1, -1))
        linear = self.model.response(names) * kicks[:, None, None]
        bent = np.zeros_like(data.orbits)
        bent[:-1] = (up - down - linear)[:, data.at]
        bowed = Predicted(data, self.errors, bent)
        bowed.__dict__["model"] = self.model  # the same ring
        return bowed

    @cached_property
    def straight(self) -> Array:
        """Orbit changes of one particle, correctors as they are told, m, [column, monitor, 2]."""
        return self.orbits(self.model)

    @cached_property
    def curved(self) -> Array:
        """What a mean square energy deviation of `DELTA` squared adds to that.

        A monitor reads the centroid of particles whose orbits answer each as its energy has it:
        half the second derivative by the energy, times the mean square.
        """
        up, down = self._off_energy
        return np.asarray((up + down) / 2 - self.straight)

    @cached_property
    def chromatic(self) -> Array:
        """d orbit changes / d relative energy of the beam, m, [column, monitor, 2]."""
        up, down = self._off_energy
        return np.asarray((up - down) / (2 * DELTA))

    @cached_property
    def _off_energy(self) -> tuple[Array, Array]:
        """Orbit changes of one particle `DELTA` above and below; as they are where a ring stores no
        beam so far off, for that says nothing of it."""
        try:
            up, down = (self.orbits(self.model.at_energy(side * DELTA)) for side in (1, -1))
        except UnstableRingError:
            return self.straight, self.straight
        return up, down

    @cached_property
    def across(self) -> Array:
        """Orbit changes by a corrector's roll, m/rad, [column, monitor, 2]; 0 for the RF."""
        data, names = self.data, self.data.measured.correctors
        turned = [Cause("corrector_roll", name, TURN) for name in names]
        model = self.model.changed_to(apply(self.model.ring, turned)).response(names)[:, data.at]
        flat = self.model.response(names)[:, data.at]
        out = np.zeros_like(data.orbits)
        slope = (model - flat * np.cos(TURN)) / np.sin(TURN)
        out[:-1] = slope * data.kicks[:-1, None, None]
        return out

    @cached_property
    def beam(self) -> Array:
        """Orbit changes of the centroid, correctors as told, m, [column, monitor, 2]."""
        if not self.errors.spread:
            return self.straight
        return np.asarray(self.straight + self.errors.spread * self.curved)

    @cached_property
    def kicked(self) -> Array:
        """The beam's orbit changes with the correctors as they are, m, [column, monitor, 2]."""
        errors = self.errors
        beam = (1 + errors.calibration)[:, None, None] * self.beam
        if errors.roll.any():
            beam = beam + errors.roll[:, None, None] * self.across
        return np.asarray(beam)

    def seen(self, beam: Array) -> Array:
        """What the monitors make of the beam's orbit changes [..., monitor, 2]."""
        return np.asarray(np.einsum("mij,...mj->...mi", self.errors.monitors, beam))

    @cached_property
    def read(self) -> Array:
        """What monitors read, m, [column, monitor, 2]."""
        return self.seen(self.kicked)

    @cached_property
    def left(self) -> Array:
        """Measured less this, m, [column, monitor, 2]."""
        return np.asarray(self.data.orbits - self.read)

    def gain(self, block: int) -> Array:
        """Of each reading's monitor in the plane that is read, [column, monitor]."""
        own = np.diagonal(self.errors.monitors, axis1=1, axis2=2)
        return np.asarray(own[:, self.data.plane_of(block)].T)

    def slopes(self, pairs: Sequence[Hypothesis]) -> Iterator[Array]:
        """d beam's orbit changes / d amount of effects on the ring, m, [column, monitor, 2]."""
        data = self.data
        scale = ((1 + self.errors.calibration) * data.kicks)[:, None, None]
        for change in self.response_slopes.factors(pairs):
            yield self.response_slopes.whole(change)[:, data.at] * scale

    @cached_property
    def response_slopes(self) -> ResponseSlopes:
        """Of the linear response, at all of the ring's monitors."""
        return ResponseSlopes(self.model, self.data.measured.correctors)

    def slopes_of(self, block: int, pairs: Sequence[Hypothesis]) -> Iterator[Array]:
        """The same, of the plane that a block is read in, m, [column, monitor]: one array, that
        each overwrites."""
        data = self.data
        scale = ((1 + self.errors.calibration) * data.kicks)[:, None]
        for slope in self.response_slopes.picked(pairs, data.at, data.plane_of(block)):
            yield np.multiply(slope, scale, out=slope)

    def rows(self, effect: str, places: Sequence[str], block: int) -> Array:
        """What the readings of a block do for each error, gains alone, [error, column, monitor]."""
        out = np.empty((len(places), *self.data.shape))
        gain = self.gain(block)
        for own, slope in zip(
            out, self.slopes_of(block, [(effect, place) for place in places]), strict=True
        ):
            np.multiply(slope, gain, out=own)
        return out

    @cached_property
    def jumps(self) -> Array:
        """Beam orbit for a position jump of a metre at each corrector, [column, monitor, 2]."""
        model, data = self.model, self.data
        columns = model.columns(data.measured.correctors)
        jump = np.zeros((len(columns.names), model.dimension))
        jump[np.arange(len(jump)), 2 * data.plane[:-1]] = 1
        pulled = np.einsum("cij,cj->ci", model.inverse[columns.layer + 1], jump)
        before = np.einsum("mai,ci->cma", model.reading_slopes, pulled @ model.closing.T)
        behind = np.einsum("mai,ci->cma", model.reading_slopes, pulled)
        whole = before + model.downstream(columns)[:, :, None] * behind
        return np.concatenate([whole[:, data.at], np.zeros((1, len(data.at), 2))])

    # --- one cause more ---------------------------------------------------------------------------
    def signatures(self, hypotheses: Sequence[Hypothesis]) -> Iterator[Array]:
        """d reading / d amount of causes that are added, m, [column, monitor, 2], one by one.

        Of an effect that is there or not: the whole change. What a closed orbit does not see (an
        offset of a monitor) is zero.
        """
        on_ring = [h for h in hypotheses if isinstance(find(h[0]), RingEffect)]
        slopes = self.slopes(on_ring)
        for effect, place in hypotheses:
            kind = find(effect)
            if isinstance(kind, RingEffect):
                yield self.seen(next(slopes))
            elif isinstance(kind, ReadingEffect):
                yield self._read_otherwise(effect, place)
            elif effect == "energy_spread":  # by the square of the amount
                scale = (1 + self.errors.calibration)[:, None, None] / DELTA**2
                yield self.seen(scale * self.curved)
            elif effect == "energy_offset":
                yield self.seen((1 + self.errors.calibration)[:, None, None] * self.chromatic)
            else:
                raise EffectError(f"'{effect}' does not act on a closed orbit")

    def _read_otherwise(self, effect: str, place: str | None) -> Array:
        out, at = np.zeros_like(self.read), self.monitor(place)
        if at >= 0:
            out[:, at] = self.monitor_slope(effect, at)
        return out

    def monitor(self, name: str | None) -> int:
        """Which of the measured monitors it is; -1 for none of them."""
        return self._monitors.get(self.data.ring[name or ""].name, -1)

    @cached_property
    def _monitors(self) -> dict[str, int]:
        return {self.data.ring[name].name: i for i, name in enumerate(self.data.measured.monitors)}

    def monitor_slope(self, name: str, at: int) -> Array:
        """d reading / d amount of an effect on one of the measured monitors, m, [column, 2]."""
        effect, read, nothing = find(name), self.read[:, at], np.zeros((1, 2))
        assert isinstance(effect, ReadingEffect)
        steps = (1.0, 0.0) if effect.discrete else (SMALL * effect.largest, -SMALL * effect.largest)
        up, down = (effect.change(read, h) - effect.change(nothing, h) for h in steps)
        return np.asarray((up - down) / (steps[0] - steps[1]))

    def with_causes(self, causes: Sequence[Cause]) -> "Predicted":
        """The same with more causes, not linearised."""
        return Predicted(self.data, self.errors.with_causes(self.data, causes), self.bent)
