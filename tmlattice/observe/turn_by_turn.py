"""Turn by turn of a stored beam: its betatron lines at every monitor, and its tunes.

A kicked beam oscillates in two modes; each is a line in the spectrum of every monitor, whose
complex amplitude is the mode's vector there times one complex number of the shot. That number is a
nuisance (nobody knows the kick's size and phase so well), all else is optics: phases, which no gain
touches, ratios of amplitudes, and in the other plane coupling. The amplitude shifts them, see
`amplitude`; how far this machine's differs from the design's is a nuisance, too, which is 0 within
the stated error.
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
"""Below this a tune is not believed: it moves with the energy, which nobody states."""

FLOOR = 1e-4
"""Share of a line below which its error is not believed: what decoherence does to the ratio of two
monitors, which the model leaves out."""


@dataclass(frozen=True, kw_only=True)
class ManyTurns(Stored):
    """Lines [shot, (monitor, plane, mode, re and im), then two errors of shifts, two tunes]; m, 1.

    Nuisances are re and im of the complex amplitude of each shot and mode, and the relative error
    of its shift, [shot, 2, 3]. The errors of shifts are read as 0.

    Attributes:
        shift: by the amplitude of each shot.
        said: what could not be used of the turns, a sentence each.
    """

    counts: ClassVar[bool] = True
    shift: Shift = field(repr=False)
    said: tuple[str, ...] = ()

    def neighbours(self, hypothesis: Hypothesis, among: Sequence[Hypothesis]) -> list[Hypothesis]:
        """What is wrong with a monitor may be its count of turns; and all that is seen may be what
        the RF does, which is on where the beam loses energy."""
        return [
            (name, place) for name, place in among
            if place is None or (find(name).of_turns and place == hypothesis[1])
        ]  # fmt: skip

    @property
    def _turn(self) -> Array:
        """Phase of both lines in a turn, [shot, mode], rad, as it was read: the amplitude moves it.
        The nearer way round: that is what stands between two whole turns."""
        return np.asarray(2 * np.pi * ((self.data[:, -2:] + 0.5) % 1 - 0.5))

    def counted(self, states: Sequence[Moved], late: Array) -> list[Moved]:
        """By the phase of so many turns."""
        if not late.any():
            return list(states)
        turned = np.exp(1j * late[:, None, None] * self._turn[:, None, None, :])
        own = zip(states, turned, strict=True)
        return [replace(state, modes=state.modes * by) for state, by in own]

    def a_turn_on(self, states: Sequence[Moved]) -> list[Moved]:
        """Its phase, in every mode."""
        return [
            Moved(np.zeros_like(one.orbit), np.zeros_like(one.tunes), 1j * phase * one.modes)
            for one, phase in zip(states, self._turn, strict=True)
        ]

    @property
    def first(self) -> Array:
        """The amplitudes that fit the ring as it is known best."""
        shots = len(self.data)
        view = self.view(self.fixed)
        nothing = np.zeros((shots, 2, 3))
        slopes = self.as_rows(self.directions(view, nothing)).T
        left = self.as_rows(self.data - self.read(view, nothing))
        solved = np.linalg.lstsq(slopes, left, rcond=None)[0]
        return np.asarray(solved.reshape(nothing.shape))

    def metric(self, point: Point) -> Metric:
        """By changes of the modes."""
        return TurnsMetric(self, point)

    def left(self, point: Point) -> tuple[Array, Array]:
        """A line is no single reading: none is left out alone."""
        return np.zeros(self.used.shape), np.ones(self.used.shape)

    def without(self, dropped: NDArray[np.bool_]) -> Self:
        """What is known of the shifts stays."""
        dropped = dropped.copy()
        dropped[:, LINES:-2] = False
        return super().without(dropped)

    def shown(self, view: Beams, nuisances: Array) -> list[Moved]:
        """Shifted by the amplitude."""
        own = zip(view.beams, self.shift.modes, self.shift.tunes, nuisances, strict=True)
        return [
            replace(
                beam.shown, modes=beam.modes + (1 + of_shot[:, 2]) * modes,
                tunes=beam.tunes + (1 + of_shot[:, 2]) * tunes,
            )
            for beam, modes, tunes, of_shot in own
        ]  # fmt: skip

    def read(self, view: Beams, nuisances: Array) -> Array:
        """With the errors of the shifts."""
        readings = super().read(view, nuisances)
        readings[:, LINES:-2] = nuisances[..., 2]
        return readings

    def told(self, states: Sequence[Moved], nuisances: Array) -> Array:
        """A shot is a state."""
        size = nuisances[..., 0] + 1j * nuisances[..., 1]
        seen = np.ascontiguousarray(stacked(states, "modes") * size[:, None, None, :])
        flat = seen.view(float).reshape(*seen.shape[:-3], -1)
        tunes = stacked(states, "tunes")
        return np.concatenate([flat, np.zeros_like(tunes), tunes], axis=-1)

    def directions(self, view: Beams, nuisances: Array) -> Array:
        """Of amplitudes in the lines; of the shifts in these and the tunes."""
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
    """What turns of a stored beam are for an inference.

    A real signal does not tell Q from 1 - Q: lines are looked for near to the design's tunes.

    Args:
        ring: the design.
        measured: readings.
        places: of each effect, for the prior.
        spectrum: their lines, where they are known already.

    Raises:
        MeasurementError: no line can be used.
        UnknownNameError: a monitor that the ring does not have.
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
    # what the model leaves out goes with the line of the mode in its own plane
    size = np.nan_to_num(np.abs(found.amplitude)).max(axis=2, keepdims=True)
    error = np.sqrt(found.error**2 + (FLOOR * size) ** 2 + shift.mode_error**2).reshape(shots, -1)
    both = np.stack([found.amplitude.real, found.amplitude.imag], axis=-1)
    # the shifts' errors of all shots are one machine's: their mean is known no better than one
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
            else "no betatron line stands out of the noise"
            + (f": {'; '.join(found.said)}" if found.said else "; kick the beam harder")
        )
    return replace(
        blank,
        data=np.where(there, data, 0.0),
        errors=np.where(there, errors, 1.0),
        used=there,
        shift=shift,
        said=(*found.said, *large),
    )
