"""Tunes from turn-by-turn positions.

>>> states = network.track(launch, turns=500)          # [batch, turns + 1, 4], m
>>> tune = tunes(states, optics=one_turn_optics(network))
>>> tune.fraction                                       # [batch, 2], (x, y), in turns

The normalised complex coordinate z = x_N - i p_N (`Optics.normalised`) turns by +Q a turn, so Q and
1 - Q differ: a real signal cannot separate them, and the wrong sign would exchange them. Motion
that grows or shrinks (a network that is not symplectic) keeps its phase: the trend of log |z| is
taken out before the line is sought.
"""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from enum import StrEnum
from functools import cache
from importlib import import_module
from typing import Any, cast

import numpy as np

from tmlattice.arrays import Array, ComplexArray
from tmlattice.errors import TooFewTurnsError
from tmlattice.optics import Optics, short_way

MIN_TURNS = 16


class Method(StrEnum):
    """How a frequency is found in a signal."""

    NAFF = "naff"
    FFT = "fft"


@dataclass(frozen=True)
class Tunes:
    """Frequencies of the strongest line of each plane.

    Attributes:
        fraction: fractional tunes (x, y) in [0, 1), [batch, 2].
        error: their error, from the difference between the two halves of the signal, [batch, 2]:
            how far the line is from one steady frequency.
        amplitude: of the line, as the modulus of z in sqrt(m), [batch, 2].
        method: which was used.
        turns: length of the signal.
    """

    fraction: Array
    error: Array
    amplitude: Array
    method: Method
    turns: int


def tunes(states: Array, optics: Optics | None = None, method: Method | str = "naff") -> Tunes:
    """The fractional tunes of a turn-by-turn signal, resolved between 0 and 1.

    Args:
        states: (x, px, y, py, ...) at the start of each turn, [batch, turns, n >= 4], m.
        optics: Twiss parameters and closed orbit at the same place; else they are taken from the
            second moments of the signal itself.
        method: "naff" (nafflib, 1e-9 on a clean signal) or "fft" (Hann window, interpolated,
            about 1e-6 in 500 turns).

    Raises:
        TooFewTurnsError: fewer than 16 turns, or a signal that is lost or not finite (names the
            turn).
        ValueError: an array of another shape, or an unknown method.

    Source: J. Laskar, Physica D 67 (1993) 257, for NAFF; R. Bartolini et al., Part. Accel. 52
    (1996) 147, for interpolated FFT with a window.
    """
    method = Method(method)
    states = np.asarray(states, dtype=float)
    if states.ndim != 3 or states.shape[2] < 4:
        raise ValueError(f"states have the shape {states.shape}; it should be [batch, turns, 4]")
    turns = states.shape[1]
    if turns < MIN_TURNS:
        raise TooFewTurnsError(f"{turns} turns are too few for a tune; {MIN_TURNS} at least do")
    finite = np.all(np.isfinite(states), axis=2)
    if not finite.all():
        trajectory = int(np.any(~finite, axis=1).argmax())
        turn = int((~finite[trajectory]).argmax())
        raise TooFewTurnsError(f"trajectory {trajectory} is lost in turn {turn}: it has no tune")
    signals = levelled(np.ascontiguousarray(normalised(states, optics).swapaxes(1, 2)))
    half = turns // 2
    fraction, amplitude = frequency(signals, method)
    first, second = (frequency(s, method)[0] for s in (signals[..., :half], signals[..., -half:]))
    error = np.abs(short_way(first - second)) / 2
    if not np.isfinite(fraction).all():
        raise TooFewTurnsError(
            f"no steady line in {turns} turns; track more turns, or closer to the closed orbit"
        )
    return Tunes(fraction, error, amplitude, method, turns)


def normalised(states: Array, optics: Optics | None = None) -> ComplexArray:
    """z = x_N - i p_N of both planes, [..., turns, 2], in sqrt(m), of states [..., turns, n].

    Without optics each plane is normalised by the second moments of its own signal.
    """
    if optics is not None:
        return optics.normalised(states)
    planes = []
    for x, p in ((states[..., 0], states[..., 1]), (states[..., 2], states[..., 3])):
        x0, p0 = (v - v.mean(axis=-1, keepdims=True) for v in (x, p))
        xx, xp, pp = (
            (a * b).mean(axis=-1, keepdims=True) for a, b in ((x0, x0), (x0, p0), (p0, p0))
        )
        area = np.sqrt(np.maximum(xx * pp - xp**2, 1e-300))
        alpha, beta = -xp / area, np.maximum(xx / area, 1e-300)
        planes.append((x0 - 1j * (alpha * x0 + beta * p0)) / np.sqrt(beta))
    return np.stack(planes, axis=-1)


def levelled(signals: ComplexArray) -> ComplexArray:
    """Complex signals [..., turns] without their exponential growth; first amplitudes stay."""
    size = np.abs(signals)
    moves = np.asarray(
        (size > 0).all(axis=-1)
    )  # not: no motion at all, or motion that passes through zero
    turn = np.arange(signals.shape[-1])
    centred = turn - turn.mean()
    growth = np.log(np.where(moves[..., None], size, 1.0))
    rate = growth @ centred / (centred @ centred)
    return np.asarray(signals * np.exp(-rate[..., None] * turn))


def frequency(signals: ComplexArray, method: Method = Method.NAFF) -> tuple[Array, Array]:
    """Frequencies in [0, 1) and amplitudes of the strongest lines of complex signals [..., turns],
    each [...]."""
    if method is Method.FFT:
        return _interpolated_fft(signals)
    flat = signals.reshape(-1, signals.shape[-1])
    lines = np.array([_strongest(signal) for signal in flat]).reshape(*signals.shape[:-1], 2)
    return lines[..., 0] % 1.0, lines[..., 1]


def _strongest(signal: ComplexArray) -> tuple[float, float]:
    lines, values = _naff()(signal.copy(), num_harmonics=1)
    return float(np.real(values[0])), float(abs(lines[0]))


@cache
def _naff() -> Callable[..., Any]:
    """nafflib's NAFF, whose compiled loop is kept from one process to the next, as our own are."""
    from tmlattice.compiled import keep  # first: it settles where numba keeps its code

    nafflib = import_module("nafflib")
    with suppress(AttributeError):  # another version
        keep(nafflib.optimize.expArray)
    return cast(Callable[..., Any], nafflib.naff)


def _interpolated_fft(signals: ComplexArray) -> tuple[Array, Array]:
    """The peaks of the Hann-windowed spectra, between their bins.

    With the Hann window the two largest neighbours of a single line at k + d have the exact ratio
    r = (1 + d) / (2 - d) for long signals, so d = (2 r - 1) / (r + 1).
    """
    turns = signals.shape[-1]
    window = 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(turns) / turns)
    spectrum = np.abs(np.fft.fft(signals * window))
    peak = spectrum.argmax(axis=-1)[..., None]
    height, right, left = (
        np.take_along_axis(spectrum, place % turns, -1)[..., 0]
        for place in (peak, peak + 1, peak - 1)
    )
    ratio = np.maximum(right, left) / height
    shift = np.where(right >= left, 1, -1) * (2 * ratio - 1) / (ratio + 1)
    hann = np.sinc(shift) / (1 - shift**2) / 2  # the window's response off the bin
    return ((peak[..., 0] + shift) / turns) % 1.0, height / turns / hann
