"""Turn-by-turn readings of a stored beam: its betatron lines at every monitor, and its tunes.

A kicked beam oscillates in two modes. Each is a line in the spectrum of every monitor, whose
complex amplitude is the mode's vector there times one complex number of the shot. That number is a
nuisance, as size and phase of the kick are not accurate enough. The rest is optics: phases,
which are independent of gains, ratios of amplitudes, and betatron coupling. The amplitude shifts
the lines, see `amplitude`; the deviation of this shift from the design's is a nuisance too, zero
within the stated error.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from tmlattice.beam.stored import Moved
from tmlattice.effects import Settings, find
from tmlattice.errors import MeasurementError
from tmlattice.inference.metric import Metric
from tmlattice.inference.problem import Hypothesis, Point
from tmlattice.lattice import Ring
from tmlattice.measurement import TurnByTurn
from tmlattice.observe.amplitude import Shift, shift_of, too_large
from tmlattice.observe.spectra import Lines, lines
from tmlattice.observe.stored import Beams, Stored, rf_of, stacked
from tmlattice.observe.stored_metric import LINES, TurnsMetric

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

TUNE = 3e-4
"""Smallest error of a tune: it moves with the unknown energy."""

FLOOR = 1e-4
"""Smallest relative error of a line: the unmodelled effect of decoherence on the ratio of two
monitors."""


@dataclass(frozen=True, kw_only=True)
class ManyTurns(Stored):
    """Lines [shot, (monitor, plane, mode, re and im), then two errors of shifts, two tunes]; m, 1.

    Nuisances are re and im of the complex amplitude of each shot and mode, and the relative error
    of its shift, [shot, 2, 3]. The errors of shifts are read as 0.

    Attributes:
        shift: by the amplitude of each shot.
        warnings: a sentence for all data that could not be used.
    """

    counts: ClassVar[bool] = True
    shift: Shift = field(repr=False)
    warnings: tuple[str, ...] = ()

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
        return np.asarray(2 * np.pi * ((self.data[:, -2:] + 0.5) % 1 - 0.5))

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
        shots = len(self.data)
        view = self.view(self.fixed)
        nothing = np.zeros((shots, 2, 3))
        slopes = self.as_rows(self.directions(view, nothing)).T
        left = self.as_rows(self.data - self.read(view, nothing))
        solved = np.linalg.lstsq(slopes, left, rcond=None)[0]
        return np.asarray(solved.reshape(nothing.shape))

    def metric(self, point: Point) -> Metric:
        """Return products from changes of the modes."""
        return TurnsMetric(self, point)

    def left(self, point: Point) -> tuple[Array, Array]:
        """Return no single residuals: a line is no single reading."""
        return np.zeros(self.used.shape), np.ones(self.used.shape)

    def without(self, dropped: NDArray[np.bool_]) -> Self:
        """Return the problem without some readings; priors of the shifts stay."""
        dropped = dropped.copy()
        dropped[:, LINES:-2] = False
        return super().without(dropped)

    def shown(self, view: Beams, nuisances: Array) -> list[Moved]:
        """Return the states, shifted by the amplitude."""
        own = zip(view.beams, self.shift.modes, self.shift.tunes, nuisances, strict=True)
        return [
            replace(
                beam.shown, modes=beam.modes + (1 + of_shot[:, 2]) * modes,
                tunes=beam.tunes + (1 + of_shot[:, 2]) * tunes,
            )
            for beam, modes, tunes, of_shot in own
        ]  # fmt: skip

    def read(self, view: Beams, nuisances: Array) -> Array:
        """Predicted readings with the errors of the shifts."""
        readings = super().read(view, nuisances)
        readings[:, LINES:-2] = nuisances[..., 2]
        return readings

    def readings_of(self, states: Sequence[Moved], nuisances: Array) -> Array:
        """Return the readings; a shot is a state."""
        size = nuisances[..., 0] + 1j * nuisances[..., 1]
        seen = np.ascontiguousarray(stacked(states, "modes") * size[:, None, None, :])
        flat = seen.view(float).reshape(*seen.shape[:-3], -1)
        tunes = stacked(states, "tunes")
        return np.concatenate([flat, np.zeros_like(tunes), tunes], axis=-1)

    def directions(self, view: Beams, nuisances: Array) -> Array:
        """Directions of the amplitudes in the lines, and of the shifts in lines and tunes."""
        ones = nuisances.copy()
        ones[..., :2] = 1.0, 0.0
        shots = len(ones)
        at_one = self.read(view, ones)
        more = ones + np.array([0.0, 0.0, 1.0])
        of_shift = self.read(view, more) - at_one
        # [shot, , mode, re and im]
        lines, shifted = (own[:, :LINES].reshape(shots, -1, 2, 2) for own in (at_one, of_shift))
        size = nuisances[..., 0] + 1j * nuisances[..., 1]
        out = np.zeros((shots, 2, 3, shots, lines.shape[1], 2, 2))
        rest = np.zeros((shots, 2, 3, shots, 4))
        for shot in range(shots):
            for mode in range(2):
                own, by = lines[shot, :, mode], shifted[shot, :, mode]
                out[shot, mode, 0, shot, :, mode] = own
                out[shot, mode, 1, shot, :, mode] = np.stack([-own[:, 1], own[:, 0]], axis=1)
                moved = (by[:, 0] + 1j * by[:, 1]) * size[shot, mode]
                out[shot, mode, 2, shot, :, mode] = np.stack([moved.real, moved.imag], axis=1)
                rest[shot, mode, 2, shot, mode::2] = of_shift[shot, LINES:][mode::2]
        flat = out.reshape(nuisances.size, shots, -1)
        return np.concatenate([flat, rest.reshape(nuisances.size, shots, -1)], axis=2)


def many_turns(
    ring: Ring, measured: TurnByTurn, places: Mapping[str, float], spectrum: Lines | None = None
) -> ManyTurns:
    """Return the problem of the turns of a stored beam.

    A real signal does not distinguish Q from 1 - Q: lines are sought near the design's tunes.

    Args:
        ring: the design.
        measured: readings.
        places: of each effect, for the prior.
        spectrum: their lines, if known.

    Raises:
        MeasurementError: no line can be used.
        UnknownNameError: a monitor that is not in the ring.
    """
    names = [monitor.name for monitor in ring.monitors]
    settings: tuple[Settings, ...] = measured.settings or ({},) * len(measured.shots)
    count, shots = len(names), len(measured.shots)
    shape = (shots, 8 * count + 4)
    blank = ManyTurns(
        ring=ring,
        states=tuple((one, rf_of(one)) for one in settings),
        data=np.zeros(shape),
        errors=np.ones(shape),
        read_by=np.tile(np.append(np.repeat(np.arange(count), 8), [-1] * 4), (shots, 1)),
        used=np.zeros(shape, dtype=bool),
        places=places,
        shift=Shift.none(shots, count),
    )
    beams = blank.view(()).beams
    design = np.array([beam.tunes for beam in beams])
    found, shift = spectrum, blank.shift
    if found is None:
        at = np.array([monitor.s for monitor in ring.monitors]) / ring.length
        found = lines(measured.in_order_of(names), near=design[0], at=at)
        shift = shift_of(ring, beams, found, at)
    # the model's error is proportional to the line of the mode in its own plane
    size = np.nan_to_num(np.abs(found.amplitude)).max(axis=2, keepdims=True)
    error = np.sqrt(found.error**2 + (FLOOR * size) ** 2 + shift.mode_error**2).reshape(shots, -1)
    both = np.stack([found.amplitude.real, found.amplitude.imag], axis=-1)
    # shift errors are common to all shots: their mean is known no better than one
    known = shift.error * np.sqrt(shots)
    tunes = design + (found.tune - design + 0.5) % 1.0 - 0.5
    data = np.concatenate([both.reshape(shots, -1), np.zeros((shots, 2)), tunes], axis=1)
    tune_error = np.sqrt(found.tune_error**2 + TUNE**2 + shift.tune_error**2)
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
    return replace(
        blank,
        data=np.where(there, data, 0.0),
        errors=np.where(there, errors, 1.0),
        used=there,
        shift=shift,
        warnings=(*found.warnings, *large),
    )
