"""Amplitude dependence of betatron lines: shifts of tunes and of ratios between monitors.

Sextupoles and octupoles shift the tunes by the square of the amplitude; so does the longer path of
an oscillation where cavities hold the energy. The phases between monitors, and with them the lines,
shift by as much. The design is tracked from the measured amplitudes, and its turns are analysed by
the same `lines` as the measured ones. The shift is the difference from a small oscillation. Its
next order, in the fourth power of the amplitude, is the shift less twice that at half the action.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tmlattice.beam.nonlinear import nonlinear_turn, track
from tmlattice.beam.stored import StoredBeam
from tmlattice.errors import first_of
from tmlattice.lattice import Ring
from tmlattice.measurement import TurnByTurn
from tmlattice.observe.spectra import Lines, lines

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Flags = NDArray[np.bool_]

TURNS = (256, 1024)
"""Fewest and most turns that are tracked, else as many as were measured: the first resolve a line;
the second hold some periods of the synchrotron motion that a longer path starts."""
MAX_CORRECTION = 0.5
"""Largest correction of a kick, as a share of it."""
SMALL = 1e-2
"""Amplitude of a small oscillation, as a share of the measured one."""
SHARE = 0.1
"""rms error of a shift, as a share of it. BPM gains that are all wrong by 5 % make as much of the
action; a beta beat of a few per cent does of the sextupoles' effect. The maps also lack a third
order of bends: 13 % of the shift in ThomX, 6 % in the Australian Synchrotron."""
CONVERGED = 0.5
"""Largest next order of a shift, as a share of it, for which its series is used."""
SEEN = 1e-3
"""Share of a line below which a shift is within the monitors' noise, whatever its next order."""


@dataclass(frozen=True)
class Shift:
    """Shift of the lines of each shot by its amplitude.

    Attributes:
        modes: change of the modes' vectors at the monitors, [shot, monitor, 2, mode].
        tunes: change of Q, [shot, mode].
        error: relative rms error of both, common to all monitors, [shot, mode].
        mode_error, tune_error: rms of the next order: of the lines, m, independent between
            monitors, [shot, monitor, 2, mode], and of the tunes, [shot, mode].
        too_large: shots whose amplitude second-order maps do not describe, [shot].
    """

    modes: ComplexArray
    tunes: Array
    error: Array
    mode_error: Array
    tune_error: Array
    too_large: Flags

    @classmethod
    def none(cls, shots: int, monitors: int) -> "Shift":
        """Return no shift."""
        modes, two = np.zeros((shots, monitors, 2, 2)), np.zeros((shots, 2))
        none = np.zeros(shots, dtype=np.bool_)
        return cls(modes.astype(np.complex128), two.copy(), two + SHARE, modes, two.copy(), none)


def shift_of(ring: Ring, beams: Sequence[StoredBeam], found: Lines, at: Array) -> Shift:
    """Return the shift of measured lines.

    Args:
        ring: the design.
        beams: stored beam of each shot.
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
    weight = np.where(there, 1 / np.maximum(np.where(there, error, 1.0), 1e-300) ** 2, 0.0)
    inner = (weight * beam.modes.conj() * np.where(there, read, 0.0)).sum(axis=(0, 1))
    whole = (weight * np.abs(beam.modes) ** 2).sum(axis=(0, 1))
    return np.asarray(inner / np.maximum(whole, 1e-300))


def _spread(found: Lines, shots: Sequence[int]) -> Array:
    """Squared envelope over the line's mean power: its maximum, and its power-weighted mean, [shot,
    mode, 2]. The first holds for particles that decohere, the second for a damped beam."""
    g = np.abs(found.envelope[shots]) ** 2
    mean = (g**2).sum(axis=2) / np.maximum(g.sum(axis=2), 1e-300)
    return np.stack([g.max(axis=2), mean], axis=2)


def _tracked(
    ring: Ring, beam: StoredBeam, wanted: ComplexArray, turns: int, at: Array
) -> tuple[ComplexArray, Array, Flags]:
    """Lines of the design over their amplitudes [shot, monitor, 2, mode], tunes [shot, mode], and
    whether the beam survived [shot], for amplitudes [shot, mode] of which the last is small."""
    way, maps = nonlinear_turn(beam.model.layers), beam.model.maps
    names = tuple(monitor.name for monitor in ring.monitors)

    def seen(launched: ComplexArray, turns: int) -> tuple[ComplexArray, Lines, Flags]:
        readings = track(beam.launched(launched), turns, way, maps, beam.rf)
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
    return found.amplitude / unit[:, None, None], found.tune, kept


def _fill(
    shift: Shift, ring: Ring, beam: StoredBeam, shots: Sequence[int], amplitude: ComplexArray,
    found: Lines, at: Array,
) -> None:  # fmt: skip
    """Write the shift by amplitudes [shot, mode] of some shots."""
    spread = _spread(found, shots)
    size = amplitude * np.sqrt(spread.mean(axis=2))
    scales = (1.0, np.sqrt(0.5), SMALL)
    turns = int(np.clip(found.turns[shots].max(), *TURNS))
    wanted = np.concatenate([scale * size for scale in scales])
    both = _tracked(ring, beam, wanted, turns, at)
    modes, tunes, kept = (own.reshape(len(scales), len(shots), *own.shape[1:]) for own in both)
    whole, half = (modes[i] - modes[2] for i in (0, 1))
    tune, tune_half = ((tunes[i] - tunes[2] + 0.5) % 1.0 - 0.5 for i in (0, 1))
    beyond, beyond_tune = whole - 2 * half, tune - 2 * tune_half

    def rms(change: ComplexArray) -> Array:
        """Relative to the modes, [shot, mode]."""
        squares = (np.abs(change) ** 2).sum(axis=(1, 2))
        return np.asarray(np.sqrt(squares / (np.abs(beam.modes) ** 2).sum(axis=(0, 1))))

    # a mode without a line was not kicked, or its plane was not measured
    there = np.isfinite(rms(whole) + rms(half) + tune) & (size != 0)
    large = there & (rms(whole) > SEEN)
    share = np.where(large, rms(beyond) / np.maximum(rms(whole), 1e-300), 0.0)
    shift.modes[shots] = np.where(there[:, None, None], whole, 0.0)
    shift.tunes[shots] = np.where(there, tune, 0.0)
    # an action with an error of SHARE makes twice that of its square
    more = np.where(there[:, None, None], np.abs(beyond * amplitude[:, None, None]), 0.0)
    shift.mode_error[shots] = 2 * SHARE * more
    shift.tune_error[shots] = 2 * SHARE * np.where(there, np.abs(beyond_tune), 0.0)
    decohered = (spread[..., 0] - spread[..., 1]) / np.maximum(spread.sum(axis=2), 1e-300)
    shift.error[shots] = np.sqrt(SHARE**2 + decohered**2 + (2 * SHARE * share) ** 2)
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
