"""Turn-by-turn readings of a stored beam: its betatron lines at every monitor, and its tunes.

A kicked beam oscillates in two modes. Each is a line in the spectrum of every monitor, whose
complex amplitude is the mode's vector there times one complex number of the shot. That number is a
nuisance, as size and phase of the kick are not accurate enough. The rest is optics: phases,
which are independent of gains, ratios of amplitudes, and betatron coupling. The amplitude shifts
the lines, see `Shift`; the deviation of this shift from the design's is a nuisance too, zero
within the stated error.

Products of a stored beam's signatures without forming them. An error of a monitor affects that
monitor's readings alone. An error of the ring changes the modes, which every shot shows times its
complex amplitude: sums over the shots are formed once, so that a signature is as long as the modes,
whatever the number of shots.

Amplitude dependence of betatron lines: shifts of tunes and of ratios between monitors. Sextupoles
and octupoles shift the tunes by the square of the amplitude; so does the longer path of an
oscillation where cavities hold the energy. The phases between monitors, and with them the lines,
shift by as much. The ring, the design until a cause is found, is tracked from the measured
amplitudes, and its turns are analysed by the same `lines` as the measured ones. The shift is the
difference from a small oscillation. It has a part by the action of each mode, which may compensate
one another; each has an error of its own. Its next order, in the fourth power of the amplitude, is
the shift less twice that at half the action: a pattern around the ring with an unknown share. (As
independent errors of the monitors a family of quadrupoles explained it, in a ring whose cells
repeat.)
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from tmlattice.arrays import TINY, Array, ComplexArray, Flags, Indices
from tmlattice.beam.readouts import positions
from tmlattice.beam.stored import Moved, StoredBeam
from tmlattice.effects import Cause, Hypothesis, ReadingEffect, find
from tmlattice.errors import MeasurementError, TooFewTurnsError, UnstableRingError, first_of
from tmlattice.inference.problem import Metric, Point, Products, effects_on_ring
from tmlattice.lattice import Ring
from tmlattice.measurement import TurnByTurn
from tmlattice.observe.spectra import Lines, lines
from tmlattice.observe.stored import (
    Beams,
    ModelCache,
    SteadyMetric,
    Stored,
    seen_by,
    stacked,
    states_of,
)
from tmlattice.optics import short_way

TUNE = 3e-4
"""Smallest error of a tune: it moves with the unknown energy."""

FLOOR = 1e-4
"""Smallest relative error of a line: the unmodelled effect of decoherence on the ratio of two
monitors."""


ORDERS = 3
"""Parts of a shift by amplitude: of the action of each mode, and the next order."""
OTHERS = ORDERS + 4
"""Nuisances of a shot and mode other than its amplitude: see `ManyTurns`."""
LINES = -2 * OTHERS - 2
"""End of the lines among the data of a shot."""
ENERGY = 1e-3
"""rms relative energy of the particles of a stored beam: as much may differ what oscillates."""
ASYMMETRY = 0.1
"""Mean energy of what oscillates in phase with the beam, as a share of its spread: by the energies
that a kick favours, and of some hundred particles."""
PARTS = 8
"""Of the turns, in which the power of a line is compared."""
STEP = 0.1
"""Energy on both sides of the beam's, as a share of it, for the change of its modes."""
AT_ONCE = 256
"""Changes of modes in memory: 4 MB for 246 monitors."""


TURNS = (256, 1024)
"""Fewest and most turns that are tracked, else as many as were measured: the first resolve a line;
the second hold some periods of the synchrotron motion that a longer path starts."""
MAX_CORRECTION = 0.5
"""Largest correction of a kick, as a share of it."""
SCALES = np.array([(1.0, 1.0), (0.5**0.5, 0.5**0.5), (1.0, 0.5**0.5), (1e-2, 1e-2)])
"""Tracked amplitudes of the modes, as shares of the measured ones; the last are small."""
SHARE = 0.1
"""rms error of a shift by one action, as a share of it. BPM gains that are all wrong by 5 % make
as much of the action; a beta beat of a few per cent does of the sextupoles' effect. The maps also
lack a third order of bends: 13 % of the shift in ThomX, 6 % in the Australian Synchrotron."""
CONVERGED = 0.5
"""Largest next order of a shift, as a share of it, for which its series is used."""
SEEN = 1e-3
"""Share of a line below which a shift is within the monitors' noise, whatever its next order."""


@dataclass(frozen=True)
class Shift:
    """Shift of the lines of each shot by its amplitude.

    Attributes:
        modes: change of the modes' vectors at the monitors by the action of each mode, and by the
            next order, [shot, part, monitor, 2, mode].
        tunes: change of Q, [shot, part, mode].
        error: relative rms error of both, common to all monitors, [shot, part, mode].
        too_large: shots whose amplitude second-order maps do not describe, [shot].
    """

    modes: ComplexArray
    tunes: Array
    error: Array
    too_large: Flags

    @classmethod
    def none(cls, shots: int, monitors: int) -> "Shift":
        """Return no shift."""
        modes = np.zeros((shots, ORDERS, monitors, 2, 2), dtype=np.complex128)
        shape = (shots, ORDERS, 2)
        return cls(modes, np.zeros(shape), np.full(shape, SHARE), np.zeros(shots, dtype=np.bool_))


def shift_of(ring: Ring, beams: Sequence[StoredBeam], found: Lines, at: Array) -> Shift:
    """Return the shift of measured lines.

    Args:
        ring: the design, for its monitors.
        beams: stored beam of each shot, in the ring with its causes.
        found: the measured lines.
        at: s / C of each monitor.
    """
    shift = Shift.none(len(beams), len(at))
    for beam in {id(own): own for own in beams}.values():
        shots = [i for i, own in enumerate(beams) if own is beam]
        amplitude = np.stack([_amplitudes(found, i, beam) for i in shots])
        if amplitude.any():
            _fill(shift, ring, beam, shots, amplitude, found, at)
    return shift


def _amplitudes(found: Lines, shot: int, beam: StoredBeam) -> ComplexArray:
    """Amplitude of each mode in a shot, 0 without a line, [mode]."""
    read, error = found.amplitude[shot], found.error[shot]
    there = np.isfinite(read) & np.isfinite(error)
    weight = np.where(there, 1 / np.maximum(np.where(there, error, 1.0), TINY) ** 2, 0.0)
    inner = (weight * beam.modes.conj() * np.where(there, read, 0.0)).sum(axis=(0, 1))
    whole = (weight * np.abs(beam.modes) ** 2).sum(axis=(0, 1))
    return np.asarray(inner / np.maximum(whole, TINY))


def _spread(found: Lines, shots: Sequence[int]) -> Array:
    """Squared envelope over the line's mean power: its maximum, and its power-weighted mean, [shot,
    mode, 2]. The first holds for particles that decohere, the second for a damped beam."""
    g = np.abs(found.envelope[shots]) ** 2
    mean = (g**2).sum(axis=2) / np.maximum(g.sum(axis=2), TINY)
    return np.stack([g.max(axis=2), mean], axis=2)


def _faded(found: Lines) -> Array:
    """How far the beam decohered: 0 for a steady line, at most 1, [shot, mode]. It is about the
    imaginary energy of what oscillates, in units of the beam's spread."""
    high, low = np.zeros(found.tune.shape), np.zeros(found.tune.shape)
    for i, turns in enumerate(found.turns):
        squares = np.abs(found.envelope[i, :, :turns]) ** 2
        parts = [own.mean(axis=1) for own in np.array_split(squares, PARTS, axis=1) if own.size]
        if parts:
            high[i], low[i] = np.max(parts, axis=0), np.min(parts, axis=0)
    seen = np.nansum((np.abs(found.amplitude) / found.noise[..., None]) ** 2, axis=(1, 2))
    noise = np.sqrt(2 * PARTS / np.maximum(found.turns[:, None] * seen, TINY))
    # eight parts of a steady line differ by 2.8 +- 0.8 of this noise
    faded = (high - low) / np.maximum(high + low, TINY) - 5 * noise
    return np.asarray(np.sqrt(np.clip(faded, 0.0, 1.0)))


def _tracked(
    ring: Ring, beam: StoredBeam, wanted: ComplexArray, turns: int, at: Array
) -> tuple[ComplexArray, Array, Array, Flags]:
    """Lines of the ring over their amplitudes [shot, monitor, 2, mode], tunes and actions [shot,
    mode], and whether the beam survived [shot], for about these amplitudes [shot, mode], of which
    the last is small."""
    layers = beam.model.turn
    names = tuple(monitor.name for monitor in ring.monitors)

    def seen(launched: ComplexArray, turns: int) -> tuple[ComplexArray, Lines, Flags]:
        readings = positions(beam.launched(launched), turns, layers, beam.rf)
        kept: Flags = np.asarray(np.isfinite(readings).reshape(len(readings), -1).all(axis=1))
        readings[~kept] = readings[-1]
        found = lines(TurnByTurn(readings=readings, monitors=names), beam.tunes, at)
        unit = np.einsum("mpk,smpk->sk", beam.modes.conj(), found.amplitude)
        return np.asarray(unit / (np.abs(beam.modes) ** 2).sum(axis=(0, 1))), found, kept

    # sextupoles change the lines of a kick by a few per cent
    unit, *_ = seen(wanted, TURNS[0])
    ratio = wanted / np.where(unit == 0, np.nan, unit)
    good = np.abs(ratio - 1) < MAX_CORRECTION
    unit, found, kept = seen(wanted * np.where(good, ratio, 1.0), turns)
    return found.amplitude / unit[:, None, None], found.tune, np.abs(unit) ** 2, kept


def _fill(
    shift: Shift, ring: Ring, beam: StoredBeam, shots: Sequence[int], amplitude: ComplexArray,
    found: Lines, at: Array,
) -> None:  # fmt: skip
    """Write the shift by amplitudes [shot, mode] of some shots."""
    spread = _spread(found, shots)
    size = amplitude * np.sqrt(spread.mean(axis=2))
    turns = int(np.clip(found.turns[shots].max(), *TURNS))
    wanted = np.concatenate([scale * size for scale in SCALES])
    every = _tracked(ring, beam, wanted, turns, at)
    modes, tunes, actions, kept = (own.reshape(len(SCALES), len(shots), *own.shape[1:])
                                   for own in every)  # fmt: skip
    whole, half, first = (modes[i] - modes[-1] for i in range(3))
    tune, tune_half, tune_first = (short_way(tunes[i] - tunes[-1]) for i in range(3))
    # tracked actions over the measured ones; a mode that was not kicked makes no shift
    alone = np.array([(1.0, 0.0), (0.0, 0.0), (0.0, 1.0)])[:, None]
    over = np.where(size == 0, alone, actions[:3] / np.maximum(np.abs(size) ** 2, TINY))
    (a, b), (c, d) = over[0].T, over[2].T
    inverse = np.array([(d, -b), (-c, a)]) / np.where(a * d == b * c, np.nan, a * d - b * c)

    def parted(whole: Any, half: Any, first: Any) -> tuple[Any, Any]:
        """The shift by each action, [shot, action, ...], and its next order."""
        parts = np.einsum("ars,rs...->sa...", inverse, np.stack([whole, first]))
        return parts, 2 * (np.einsum("sa,sa...->s...", over[1], parts) - half)

    parts, beyond = parted(whole, half, first)
    tune_parts, beyond_tune = parted(tune, tune_half, tune_first)
    whole = parts.sum(axis=1)

    def rms(change: ComplexArray) -> Array:
        """Relative to the modes, [..., mode]."""
        squares = (np.abs(change) ** 2).sum(axis=(-3, -2))
        return np.asarray(np.sqrt(squares / (np.abs(beam.modes) ** 2).sum(axis=(0, 1))))

    # a mode without a line was not kicked, or its plane was not measured
    of_parts = rms(parts)
    there = np.isfinite(of_parts.sum(axis=1) + rms(half) + tune_parts.sum(axis=1)) & (size != 0)
    large = there & (rms(whole) > SEEN)
    share = np.where(large, rms(beyond) / np.maximum(rms(whole), TINY), 0.0)
    orders = np.concatenate([parts, beyond[:, None]], axis=1)
    tune_orders = np.concatenate([tune_parts, beyond_tune[:, None]], axis=1)
    shift.modes[shots] = np.where(there[:, None, None, None], orders, 0.0)
    shift.tunes[shots] = np.where(there[:, None], tune_orders, 0.0)
    # a small part is what terms of the usual size leave of one another
    seen = there[:, None]
    squares = np.where(seen, of_parts, 0.0) ** 2
    usual = np.sqrt(squares.sum(axis=2, keepdims=True) / np.maximum(seen.sum(axis=2), 1)[..., None])
    decohered = (spread[..., 0] - spread[..., 1]) / np.maximum(spread.sum(axis=2), TINY)
    terms = SHARE * np.fmax(usual / np.maximum(of_parts, TINY), 1.0)
    own = np.sqrt(terms**2 + (decohered**2 + (2 * SHARE * share) ** 2)[:, None])
    # an action with an error of SHARE makes twice that of its square
    shift.error[shots, :2], shift.error[shots, 2] = np.where(seen, own, SHARE), 2 * SHARE
    shift.too_large[shots] = ~kept.all(axis=0) | (share > CONVERGED).any(axis=1)


def too_large(shift: Shift, shots: Sequence[int], found: Lines) -> list[str]:
    """Return a warning if the amplitude of shots is too large."""
    own = np.flatnonzero(shift.too_large).tolist()
    if not own:
        return []
    size = np.sqrt(np.nanmean(np.nansum(np.abs(found.amplitude[own]) ** 2, axis=3) / 2))
    ids = first_of([shots[i] for i in own])
    return [
        f"shot{'s' * (len(own) > 1)} {ids}: an oscillation of {1e3 * size:.2g} mm rms is too large "
        "for second-order maps of this ring: its tunes no longer shift by the square of the "
        "amplitude; kick the beam less; these turns are not used"
    ]


class TurnsMetric(SteadyMetric):
    """Products at one point of turn-by-turn data."""

    problem: Stored

    def quick(self, hypotheses: Sequence[Hypothesis], data: Array, found: Products) -> Indices:
        """Put in products of errors of the ring and of monitors; return their indices."""
        done = super().quick(hypotheses, data, found)
        which = effects_on_ring(hypotheses)
        whole, along = self._on_ring([hypotheses[i] for i in which], self.vectors(data))
        self.put(which, whole, along, found)
        return np.concatenate([done, which])

    def _on_ring(self, hypotheses: Sequence[Hypothesis], vectors: Array) -> tuple[Array, Array]:
        """Squares, and products with vectors; shots of the same beam together."""
        problem, view = self.problem, self.point.view
        weight = problem.used / problem.sigma**2
        weighted = np.zeros((len(vectors), *problem.used.shape))
        weighted[:, problem.used] = (
            vectors / np.broadcast_to(problem.sigma, weighted.shape[1:])[problem.used]
        )
        amplitude = self._amplitudes()  # [shot, mode's entry]
        whole, along = np.zeros(len(hypotheses)), np.zeros((len(hypotheses), len(vectors)))
        for beam in {id(own): own for own in view.beams}.values():
            shots = [i for i, own in enumerate(view.beams) if own is beam]
            a, b = amplitude[shots].real, amplitude[shots].imag
            re, im = weighted[:, shots, :LINES:2], weighted[:, shots, 1:LINES:2]
            sums = np.stack([(a * re + b * im).sum(1), (a * im - b * re).sum(1)], axis=-1)
            u, v = weight[shots, :LINES:2], weight[shots, 1:LINES:2]
            squares = [
                (own).sum(0) for own in (a**2 * u + b**2 * v, b**2 * u + a**2 * v, a * b * (v - u))
            ]
            tunes, of_tunes = weighted[:, shots, -2:].sum(1), weight[shots, -2:].sum(0)
            for start in range(0, len(hypotheses), AT_ONCE):
                part = slice(start, start + AT_ONCE)
                moved = seen_by(beam.moved(hypotheses[part]), view.monitors.matrix())
                modes = np.ascontiguousarray(moved.modes.reshape(len(moved.modes), -1))
                x, y = modes.real, modes.imag
                whole[part] += x**2 @ squares[0] + y**2 @ squares[1] + 2 * (x * y) @ squares[2]
                whole[part] += moved.tunes**2 @ of_tunes
                along[part] += modes.view(float) @ sums.reshape(len(vectors), -1).T
                along[part] += moved.tunes @ tunes.T
        return whole, along

    def _amplitudes(self) -> NDArray[np.complex128]:
        """Amplitude with which each shot shows the modes' entries, [shot, monitor * 2 * mode]."""
        nuisances, view = self.point.nuisances, self.point.view
        size = nuisances[..., 0] + 1j * nuisances[..., 1]
        ones = [
            Moved(np.zeros(0), np.zeros(0), np.ones_like(beam.modes) * own)
            for beam, own in zip(view.beams, size, strict=True)
        ]
        shown = self.problem.with_turn_offsets(ones, view.monitors.late)
        return np.stack([own.modes.ravel() for own in shown])


@dataclass(frozen=True, kw_only=True)
class ManyTurns(Stored):
    """Lines [shot, (monitor, plane, mode, re and im), then (mode, errors of both shifts, re and im
    of the energy and of its square), two tunes]; m, 1.

    Nuisances are re and im of the complex amplitude of each shot and mode, the relative errors of
    its shifts by both actions and in the next order, re and im of the energy of what oscillates in
    units of the beam's spread, and of its square, [shot, mode, 2 + OTHERS]. All but the amplitudes
    are read as 0.

    With chromaticity a particle's phase keeps account of its energy. Those ahead of the mean phase
    have another energy than those behind it, which is an imaginary energy of the line. It grows
    with the turns until the beam has decohered. A few simulated particles have a mean energy too.

    Attributes:
        shift: by the amplitude of each shot, of the ring at the causes of the last `near`.
        lines: the measured lines, by which the ring is tracked for the shift; None: no shift.
        shifts: the latest of `near`, by its causes.
        chromatic: change of tunes and modes by the energy and by its square, in units of the
            spread, [shot, order, mode] and [shot, order, monitor, 2, mode].
        warnings: a sentence for all data that could not be used.
    """

    counts: ClassVar[bool] = True
    shift: Shift = field(repr=False)
    lines: Lines | None = field(repr=False)
    shifts: dict[tuple[Cause, ...], Shift] = field(default_factory=dict, repr=False, compare=False)
    chromatic: tuple[Array, ComplexArray] = field(repr=False)
    warnings: tuple[str, ...] = ()

    def near(self, causes: Sequence[Cause]) -> Self:
        """Return the problem with the shifts by amplitude at these causes, if the ring stores a
        beam of these amplitudes there; those of a shot whose amplitude is too large there stay."""
        there = tuple(c for c in (*self.fixed, *causes)
                      if not isinstance(find(c.effect), ReadingEffect))  # fmt: skip
        if self.lines is None or not there:
            return self
        if there not in self.shifts:
            at = np.array([monitor.s for monitor in self.ring.monitors]) / self.ring.length
            try:
                new = shift_of(self.ring, self.view(there).beams, self.lines, at)
            except (UnstableRingError, TooFewTurnsError):
                return self
            self.shifts.clear()
            self.shifts[there] = new
        new = self.shifts[there]
        kept = new.too_large & ~self.shift.too_large
        modes, tunes = new.modes.copy(), new.tunes.copy()
        modes[kept], tunes[kept] = self.shift.modes[kept], self.shift.tunes[kept]
        return replace(self, shift=replace(self.shift, modes=modes, tunes=tunes))

    def neighbours(self, hypothesis: Hypothesis, among: Sequence[Hypothesis]) -> list[Hypothesis]:
        """Return alternatives: of a monitor's error its turn offset; of others the RF, where the
        beam loses energy."""
        return [
            (name, place) for name, place in among
            if place is None or (find(name).of_turns and place == hypothesis[1])
        ]  # fmt: skip

    @property
    def _turn(self) -> Array:
        """Measured phase advance of both lines per turn, [shot, mode], rad, in (-pi, pi)."""
        return 2 * np.pi * short_way(self.values[:, -2:])

    def with_turn_offsets(self, states: Sequence[Moved], late: Array) -> list[Moved]:
        """Return the states after the phase of each monitor's turn offset."""
        if not late.any():
            return list(states)
        turned = np.exp(1j * late[:, None, None] * self._turn[:, None, None, :])
        own = zip(states, turned, strict=True)
        return [replace(state, modes=state.modes * by) for state, by in own]

    def one_turn_later(self, states: Sequence[Moved]) -> list[Moved]:
        """Return the change by one turn of phase, in every mode."""
        return [
            Moved(np.zeros_like(one.orbit), np.zeros_like(one.tunes), 1j * phase * one.modes)
            for one, phase in zip(states, self._turn, strict=True)
        ]

    @property
    def first(self) -> Array:
        """Amplitudes that fit the known ring."""
        shots = len(self.values)
        view = self.view(self.fixed)
        nothing = np.zeros((shots, 2, 2 + OTHERS))
        slopes = self.as_rows(self.directions(view, nothing)).T
        left = self.as_rows(self.values - self.read(view, nothing))
        solved = np.linalg.lstsq(slopes, left, rcond=None)[0]
        return np.asarray(solved.reshape(nothing.shape))

    def metric(self, point: Point) -> Metric:
        """Return products from changes of the modes."""
        return TurnsMetric(self, point)

    def left(self, point: Point) -> tuple[Array, Array]:
        """Return no single residuals: a line is no single reading."""
        return np.zeros(self.used.shape), np.ones(self.used.shape)

    def without(self, dropped: NDArray[np.bool_]) -> Self:
        """Return the problem without some readings; priors of the nuisances stay."""
        dropped = dropped.copy()
        dropped[:, LINES:-2] = False
        return super().without(dropped)

    def shown(self, view: Beams, nuisances: Array) -> list[Moved]:
        """Return the states, shifted by the amplitude and by the energy of what oscillates."""
        by = nuisances[..., 2 : 2 + ORDERS] + [1, 1, 0]  # the parts have the next order in them
        energy = nuisances[..., 2 + ORDERS :: 2] + 1j * nuisances[..., 3 + ORDERS :: 2]
        tunes, modes = self.chromatic
        modes = np.einsum("sko,sompk->smpk", energy, modes)
        modes += np.einsum("ska,sampk->smpk", by, self.shift.modes)
        tunes = np.einsum("sko,sok->sk", energy.real, tunes)
        tunes += np.einsum("ska,sak->sk", by, self.shift.tunes)
        return [
            replace(beam.shown, modes=beam.modes + own, tunes=beam.tunes + shift)
            for beam, own, shift in zip(view.beams, modes, tunes, strict=True)
        ]

    def read(self, view: Beams, nuisances: Array) -> Array:
        """Predicted readings with all nuisances but the amplitudes."""
        readings = super().read(view, nuisances)
        readings[:, LINES:-2] = nuisances[..., 2:].reshape(len(readings), -1)
        return readings

    def readings_of(self, states: Sequence[Moved], nuisances: Array) -> Array:
        """Return the readings; a shot is a state."""
        size = nuisances[..., 0] + 1j * nuisances[..., 1]
        seen = np.ascontiguousarray(stacked(states, "modes") * size[:, None, None, :])
        flat = seen.view(float).reshape(*seen.shape[:-3], -1)
        tunes = stacked(states, "tunes")
        return np.concatenate([flat, *[np.zeros_like(tunes)] * OTHERS, tunes], axis=-1)

    def directions(self, view: Beams, nuisances: Array) -> Array:
        """Directions of the amplitudes in the lines, and of the others in lines and tunes."""
        ones = nuisances.copy()
        ones[..., :2] = 1.0, 0.0
        shots = len(ones)
        each = np.arange(shots)  # has its own nuisances
        at_one = self.read(view, ones)
        lines = at_one[:, :LINES].reshape(shots, -1, 2, 2)  # [shot, , mode, re and im]
        turned = np.stack([-lines[..., 1], lines[..., 0]], axis=-1)
        size = nuisances[..., 0] + 1j * nuisances[..., 1]
        out = np.zeros((shots, 2, 2 + OTHERS, shots, lines.shape[1], 2, 2))
        rest = np.zeros((shots, 2, 2 + OTHERS, shots, -LINES))
        for mode in range(2):
            out[each, mode, 0, each, :, mode] = lines[:, :, mode]
            out[each, mode, 1, each, :, mode] = turned[:, :, mode]
        for other in range(OTHERS):
            more = ones.copy()
            more[..., 2 + other] += 1.0
            change = self.read(view, more) - at_one
            by = change[:, :LINES].reshape(lines.shape)
            moved = (by[..., 0] + 1j * by[..., 1]) * size[:, None]
            parts = np.stack([moved.real, moved.imag], axis=-1)
            for mode in range(2):
                out[each, mode, 2 + other, each, :, mode] = parts[:, :, mode]
                for own in (OTHERS * mode + other, 2 * OTHERS + mode):
                    rest[each, mode, 2 + other, each, own] = change[:, LINES + own]
        flat = out.reshape(nuisances.size, shots, -1)
        return np.concatenate([flat, rest.reshape(nuisances.size, shots, -1)], axis=2)


def _chromatic(beam: StoredBeam, at: Array) -> tuple[Array, ComplexArray]:
    """Change of tunes and modes by the energy in units of ENERGY, and by its square, [order, ...],
    at the same phase of each monitor: `lines` delays the envelope by its part of the turn."""
    moved = (beam.model.at_energy(h * ENERGY) for h in (STEP, -STEP))
    ends = [StoredBeam(model) for model in (beam.model, *moved)]  # all without the RF

    def orders(zero: Any, up: Any, down: Any) -> Any:
        return np.stack([(up - down) / (2 * STEP), (up - 2 * zero + down) / (2 * STEP**2)])

    tunes = [short_way(end.tunes - ends[0].tunes) for end in ends]
    delays = [np.exp(-2j * np.pi * at[:, None, None] * own) for own in tunes]
    modes = [end.modes * own for end, own in zip(ends, delays, strict=True)]
    return orders(*tunes), orders(*modes)


def many_turns(
    ring: Ring, measured: TurnByTurn, places: Mapping[str, float], spectrum: Lines | None = None,
    shifted: bool = True,
) -> ManyTurns:  # fmt: skip
    """Return the problem of the turns of a stored beam.

    A real signal does not distinguish Q from 1 - Q: lines are sought near the design's tunes.

    Args:
        ring: the design.
        measured: readings.
        places: of each effect, for the prior.
        spectrum: their lines, if known; then without shifts.
        shifted: lines shift with the amplitude, for which the design is tracked; else no amplitude
            is too large.

    Raises:
        MeasurementError: no line can be used.
        UnknownNameError: a monitor that is not in the ring.
    """
    names = [monitor.name for monitor in ring.monitors]
    count, shots = len(names), len(measured.shots)
    states, cache = states_of(measured.settings, shots), ModelCache()
    beams = [cache.beam(ring, *state, (), feels_rf=True) for state in states]
    design = np.array([beam.tunes for beam in beams])
    found, shift = spectrum, Shift.none(shots, count)
    at = np.array([monitor.s for monitor in ring.monitors]) / ring.length
    each = {id(beam): _chromatic(beam, at) for beam in beams}
    of_tunes, of_modes = (
        np.stack(own) for own in zip(*(each[id(beam)] for beam in beams), strict=True)
    )
    if found is None:
        share = np.zeros_like(beams[0].modes)
        for mode in (0, 1):  # the other plane shows a mode by coupling alone
            own = of_modes[0, 0, :, mode, mode] / beams[0].modes[:, mode, mode]
            share[:, mode, mode] = own + 2j * np.pi * at * of_tunes[0, 0, mode]
        found = lines(measured.in_order_of(names), near=design[0], at=at, chromatic=share)
        shift = shift_of(ring, beams, found, at) if shifted else shift
    # the model's error is proportional to the line of the mode in its own plane
    size = np.nan_to_num(np.abs(found.amplitude)).max(axis=2, keepdims=True)
    error = np.sqrt(found.error**2 + (FLOOR * size) ** 2).reshape(shots, -1)
    both = np.stack([found.amplitude.real, found.amplitude.imag], axis=-1)
    # of shifts and energies, common to all shots: their mean is known no better than one. The mean
    # phase of a symmetric beam is that of its mean energy, which is the ring's
    energy = np.maximum(_faded(found), 1e-3)[..., None] * [ASYMMETRY, 1.0, 1.0, 1.0]
    known = np.concatenate([shift.error.swapaxes(1, 2), energy], axis=2)
    known = known.reshape(shots, -1) * np.sqrt(shots)
    tunes = design + short_way(found.tune - design)
    data = np.concatenate([both.reshape(shots, -1), np.zeros_like(known), tunes], axis=1)
    tune_error = np.sqrt(found.tune_error**2 + TUNE**2)
    errors = np.concatenate([np.repeat(error, 2, axis=1), known, tune_error], axis=1)
    there = np.isfinite(data) & np.isfinite(errors)
    there[shift.too_large, :LINES] = there[shift.too_large, -2:] = False
    large = too_large(shift, measured.shots, found)
    if not there[:, :LINES].any():
        raise MeasurementError(
            large[0]
            if large
            else "no betatron line is significant"
            + (f": {'; '.join(found.warnings)}" if found.warnings else "; kick the beam harder")
        )
    return ManyTurns(
        ring=ring,
        states=states,
        values=np.where(there, data, 0.0),
        sigma=np.where(there, errors, 1.0),
        read_by=np.tile(np.append(np.repeat(np.arange(count), 8), [-1] * -LINES), (shots, 1)),
        used=there,
        places=places,
        cache=cache,
        shift=shift,
        lines=found if shifted and spectrum is None else None,
        chromatic=(of_tunes, of_modes),
        warnings=(*found.warnings, *large),
    )
