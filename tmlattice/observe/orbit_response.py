"""Orbit response as monitors with errors read it, linearised at those errors.

>>> data = response_data(ring, measured)
>>> there = Predicted(data, Errors.none(data))
>>> data.orbits - there.read                       # residual of the design, [column, monitor, 2]

Columns and blocks are those of `response_data`.

The change between two responses of one ring is a measurement of its own.

>>> change = response_change(data_before, errors, data_after)
>>> change.orbits                                  # the model before plus the measured change

Model discrepancy is the same in both measurements and cancels in their difference, which is added
to the response of the model with the errors of the first.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.sparse import csr_array

from tmlattice.arrays import Array, Flags, Reals
from tmlattice.beam.closed_orbit import ResponseModel
from tmlattice.beam.kicks import by_energy, orbits_of_kicks
from tmlattice.beam.response_derivatives import Factors, ResponseSlopes
from tmlattice.effects import (
    Cause,
    Hypothesis,
    Monitors,
    ReadingEffect,
    RingEffect,
    apply,
    find,
    monitors_with,
)
from tmlattice.errors import EffectError, MeasurementError, UnstableRingError
from tmlattice.inference.judgement import FEW
from tmlattice.lattice import Ring
from tmlattice.measurement import OrbitResponse
from tmlattice.observe.response_data import ResponseData, third_order

DELTA = 1e-3
"""Energy step of the differences for an energy spread; its square is the unit of the fitted
spread."""
MIN_KICK = 0.1
"""Kick over the set one below which a corrector's plane is undetermined."""


@dataclass(frozen=True, eq=False)
class Errors:
    """Errors of monitors, correctors, ring and beam.

    Attributes:
        monitors: d reading / d beam, [monitor, 2, 2].
        calibration, roll: of the columns, 0 for the RF, [column].
        ring: causes in the ring.
        energy: relative deviation of the beam's mean energy from that of the magnets' settings.
        spread: mean square energy deviation, in units of `DELTA` squared.
        dispersion: contribution of kicks to the RF's orbit, see `beam.kicks`, m, [monitor, 2].
        at_correctors: dispersion of these kicks in each corrector's plane, m, [corrector].
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
        """Return the design, without errors."""
        columns, monitors = data.shape
        eye = np.tile(np.eye(2), (monitors, 1, 1))
        return cls(eye, np.zeros(columns), np.zeros(columns))

    @property
    def turned(self) -> Flags:
        """Correctors whose kick is larger in the other plane than in their own, [column]."""
        return np.abs(self.roll) > np.maximum(np.abs(1 + self.calibration), MIN_KICK)

    @property
    def kick(self) -> Array:
        """Kick in both planes over the set one, [column]; negative if reversed, which is a turn by
        more than half a right angle."""
        own = 1 + self.calibration
        return np.where((own < 0) & ~self.turned, -1.0, 1.0) * np.hypot(own, self.roll)

    @property
    def angle(self) -> Array:
        """Angle of each kick to its plane, rad, [column]."""
        sign = np.sign(self.kick)
        return np.arctan2(sign * self.roll, sign * (1 + self.calibration))

    def with_causes(self, data: ResponseData, causes: Sequence[Cause]) -> "Errors":
        """Return the errors with more causes; an energy spread adds in square.

        Raises:
            EffectError: an effect of the launch, which does not act on a closed orbit.
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
                if cause.effect == "corrector_calibration":  # of the steps; the setting has it too
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
    """Response with some errors, and its derivatives there.

    Attributes:
        data: the measurement, with correctors, kicks and monitors.
        errors: of the prediction.
        bent: correction of the linear orbit changes for finite steps, m; see `bend`.
    """

    data: ResponseData
    errors: Errors
    bent: Array | float = 0.0

    @cached_property
    def model(self) -> ResponseModel:
        """Model of the ring with its errors, at the beam's energy; UnstableRingError without a
        closed orbit."""
        model, errors = self.data.design, self.errors
        if errors.ring:
            model = model.changed_to(apply(model.ring, errors.ring))
        return model.at_energy(errors.energy) if errors.energy else model

    def orbits(self, model: ResponseModel) -> Array:
        """Orbit changes of the steps, the RF's last, m, [column, monitor, 2].

        The RF's is not linearised: at half a per cent in energy its third order is several times
        the readings' noise.
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
        """Return the prediction with the third order of the correctors' two-sided steps.

        It is a micrometre for an orbit of a millimetre. The closed orbits of all correctors take
        seconds, so it is computed once per step.
        """
        data = self.data
        kicks = data.kicks[:-1] * (1 + self.errors.calibration[:-1])
        bent = third_order(self.model, data.measured.correctors, kicks, data.at)
        finite = Predicted(data, self.errors, bent)
        finite.__dict__["model"] = self.model  # the same ring
        return finite

    @cached_property
    def straight(self) -> Array:
        """Orbit changes of one particle for the set kicks, m, [column, monitor, 2]."""
        return self.orbits(self.model)

    @cached_property
    def curved(self) -> Array:
        """Change of these by a mean square energy deviation of `DELTA` squared.

        A monitor reads the centroid of particles with different energies: half the second
        derivative by the energy, times the mean square.
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
        """Orbit changes of one particle `DELTA` above and below; the nominal ones if no beam is
        stored there."""
        try:
            up, down = (self.orbits(self.model.at_energy(side * DELTA)) for side in (1, -1))
        except UnstableRingError:
            return self.straight, self.straight
        return up, down

    @cached_property
    def across(self) -> Array:
        """Orbit changes by a corrector's roll, m/rad, [column, monitor, 2]; 0 for the RF."""
        data, out = self.data, np.zeros_like(self.data.orbits)
        slope = self.model.response(data.measured.correctors, turned=True)[:, data.at]
        out[:-1] = slope * data.kicks[:-1, None, None]
        return out

    @cached_property
    def beam(self) -> Array:
        """Orbit changes of the centroid for the set kicks, m, [column, monitor, 2]."""
        if not self.errors.spread:
            return self.straight
        return np.asarray(self.straight + self.errors.spread * self.curved)

    @cached_property
    def kicked(self) -> Array:
        """Orbit changes of the beam for the actual kicks, m, [column, monitor, 2]."""
        errors = self.errors
        beam = (1 + errors.calibration)[:, None, None] * self.beam
        if errors.roll.any():
            beam = beam + errors.roll[:, None, None] * self.across
        return np.asarray(beam)

    def seen(self, beam: Array) -> Array:
        """Readings of orbit changes [..., monitor, 2] by the monitors."""
        x, y = np.moveaxis(self.errors.monitors, 2, 0)
        return np.asarray(x * beam[..., :1] + y * beam[..., 1:])

    @cached_property
    def read(self) -> Array:
        """Predicted readings, m, [column, monitor, 2]."""
        return self.seen(self.kicked)

    @cached_property
    def left(self) -> Array:
        """Residual, measured less predicted, m, [column, monitor, 2]."""
        return np.asarray(self.data.orbits - self.read)

    def gain(self, block: int) -> Array:
        """Gain of each reading's monitor in the plane of a block, [column, monitor]."""
        own = np.diagonal(self.errors.monitors, axis1=1, axis2=2)
        return np.asarray(own[:, self.data.plane_of(block)].T)

    def slopes(self, pairs: Sequence[Hypothesis]) -> Iterator[Array]:
        """Yield d beam's orbit changes / d amount of effects on the ring, m, [column, monitor,
        2]."""
        data, slopes = self.data, self.response_slopes
        scale = ((1 + self.errors.calibration) * data.kicks)[:, None, None]
        some = max(slopes.at_once // len(data.orbits), 1)
        for start in range(0, len(pairs), some):
            for whole in slopes.whole(slopes.factors(pairs[start : start + some])):
                yield whole[:, data.at] * scale

    @cached_property
    def response_slopes(self) -> ResponseSlopes:
        """Derivatives of the linear response, at all of the ring's monitors."""
        return ResponseSlopes(self.model, self.data.measured.correctors)

    def rows(
        self, pairs: Sequence[Hypothesis], block: int, shares: Array | csr_array | None = None
    ) -> Reals:
        """Derivatives of a block's readings by effects on the ring, with gains alone, m, [error,
        column, monitor], in single precision.

        Args:
            pairs: (effect, place).
            block: of the readings.
            shares: amounts of the effects for a unit of each number; then [number, column,
                monitor]; None: each effect is a number.
        """
        data, slopes = self.data, self.response_slopes
        factors = slopes.factors(pairs)
        factors = factors if shares is None else factors.combined(shares)
        rows = np.empty((len(factors.before), *data.shape), dtype=np.float32)
        for low in range(0, len(rows), slopes.at_once):
            some = slice(low, low + slopes.at_once)
            rows[some] = slopes.picked(
                Factors(*(own[some] for own in factors)), data.at, data.plane_of(block),
                (1 + self.errors.calibration) * data.kicks,
                np.diagonal(self.errors.monitors, axis1=1, axis2=2),
            )  # fmt: skip
        return rows

    @cached_property
    def jumps(self) -> Array:
        """Beam orbit for a position jump of a metre at each corrector, [column, monitor, 2]."""
        model, data = self.model, self.data
        layers = model.columns(data.measured.correctors).layer
        jump = np.eye(model.dimension)[2 * data.plane[:-1]]
        exits, rows = model.maps.at[data.at], model.reading_slopes[data.at]
        orbits = [orbits_of_kicks(model, layers, exits, rows[:, p], jump).T for p in (0, 1)]
        return np.concatenate([np.stack(orbits, axis=2), np.zeros((1, len(data.at), 2))])

    # --- one cause more ---------------------------------------------------------------------------
    def signatures(self, hypotheses: Sequence[Hypothesis]) -> Iterator[Array]:
        """Yield d reading / d amount of additional causes, m, [column, monitor, 2].

        Of a discrete effect the change; of one without effect on a closed orbit (a monitor's
        offset) zero.
        """
        on_ring = [h for h in hypotheses if isinstance(find(h[0]), RingEffect)]
        slopes, changed = self.slopes(on_ring), dict[str, Array]()
        for effect, place in hypotheses:
            kind = find(effect)
            if isinstance(kind, RingEffect):
                yield self.seen(next(slopes))
            elif isinstance(kind, ReadingEffect):
                if effect not in changed:
                    changed[effect] = self.of_monitors(kind)
                mine = np.array(self.monitors) == self.data.ring[place or ""].name
                yield np.where(mine[:, None], changed[effect], 0.0)
            elif effect == "energy_spread":  # by the square of the amount
                scale = (1 + self.errors.calibration)[:, None, None] / DELTA**2
                yield self.seen(scale * self.curved)
            elif effect == "energy_offset":
                yield self.seen((1 + self.errors.calibration)[:, None, None] * self.chromatic)
            else:
                raise EffectError(f"'{effect}' does not act on a closed orbit")

    @cached_property
    def monitors(self) -> list[str]:
        """Names of the measured monitors in the ring."""
        return [self.data.ring[name].name for name in self.data.measured.monitors]

    def of_monitors(self, effect: ReadingEffect) -> Array:
        """d reading / d amount of a further effect, for every monitor, m, [column, monitor, 2]."""
        slope, _ = effect.slopes(Monitors.perfect(len(self.errors.monitors)))
        return np.asarray(np.einsum("mij,cmj->cmi", slope, self.read))

    def with_causes(self, causes: Sequence[Cause]) -> "Predicted":
        """Return the prediction with more causes, not linearised."""
        return Predicted(self.data, self.errors.with_causes(self.data, causes), self.bent)


def alike(
    ring: Ring, before: OrbitResponse, after: OrbitResponse
) -> tuple[OrbitResponse, OrbitResponse]:
    """Return both measurements with their common correctors and monitors, in the order of the
    first.

    Raises:
        MeasurementError: too few in common, or other planes.
        UnknownNameError: an element that is not in the ring.
    """
    before, after = (
        replace(
            one,
            monitors=tuple(ring[name].name for name in one.monitors),
            correctors=tuple(ring[name].name for name in one.correctors),
        )
        for one in (before, after)
    )
    columns = [name for name in before.correctors if name in set(after.correctors)]
    monitors = [name for name in before.monitors if name in set(after.monitors)]
    for what, own, all_of in (
        ("correctors", columns, after.correctors), ("BPMs", monitors, after.monitors),
    ):  # fmt: skip
        if len(own) < max(FEW, len(all_of) // 4):
            raise MeasurementError(
                f"the reference shares {len(own)} of {len(all_of)} {what}: it is not of this "
                "machine; give one with the same names"
            )
    first, second = (one.select(columns, monitors) for one in (before, after))
    other = [c for c, a, b in zip(columns, first.planes, second.planes, strict=True) if a != b]
    if other:
        raise MeasurementError(f"corrector '{other[0]}' kicks in another plane in the reference")
    return first, second


def response_change(
    before: ResponseData, errors: Errors, after: ResponseData, orbit_kicks: Array | None = None
) -> ResponseData:
    """Return the second measurement as it would be in the ring of the first.

    Args:
        before: of the design; correctors and monitors as in `after`.
        errors: of ring, monitors, correctors and energy, fitted to it.
        after: the second measurement.
        orbit_kicks: kicks of the closed orbit, whose dispersion acts with a changed gradient, see
            `ResponseModel`.

    Returns:
        A measurement by perfect monitors with the actual corrector steps, in the design with the
        ring's errors, energy, orbit kicks and corrector rolls: that ring's response plus the
        difference of the two measurements.
    """
    columns = before.measured.correctors
    scale = (before.kicks / after.kicks)[:, None, None]
    change = _as_the_beam(errors.monitors, after.orbits * scale - before.orbits)
    noise = np.hypot(before.noise, after.noise * np.abs(np.median(scale)))
    noise = np.sqrt(_as_the_beam(errors.monitors, noise**2, power=2))
    kicks = np.append(before.kicks[:-1] * errors.kick[:-1], before.kicks[-1])
    own = zip(columns, errors.angle.tolist(), strict=False)
    rolls = [Cause("corrector_roll", name, angle) for name, angle in own if angle]
    there = replace(
        before,
        ring=apply(before.ring, (*errors.ring, *rolls)),
        kicks=kicks,
        noise=noise,
        energy=errors.energy,
        orbit_kicks=orbit_kicks,
    )
    orbits = Predicted(there, Errors.none(there), there.bent).straight + change
    rf = before.measured.rf
    if rf is not None and rf.orbit is not None:
        rf = replace(rf, orbit=orbits[-1])
    measured = replace(before.measured, kicks=kicks[:-1], response=orbits[:-1], noise=noise, rf=rf)
    return replace(there, measured=measured, orbits=orbits)


def _as_the_beam(monitors: Array, read: Array, power: int = 1) -> Array:
    """Readings [..., monitor, 2] as of perfect monitors; without the other plane's reading by the
    gain alone, as a mixed change is negligible.

    Args:
        monitors: gains and coupling, [monitor, 2, 2].
        read: readings.
        power: of the factors: 2 for variances.
    """
    both = np.einsum("mij,...mj->...mi", np.linalg.inv(monitors) ** power, read)
    alone = read / np.diagonal(monitors, axis1=1, axis2=2) ** power
    return np.where(np.isnan(both), alone, both)
