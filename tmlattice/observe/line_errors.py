"""What amplitudes of lines are worth: the noise where and when a line is, and how they change."""

import numpy as np
from numpy.typing import NDArray

from tmlattice.observe.line_fit import LineFit

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

FEWEST = 64
"""Turns from which on half of them tell a change."""


def floor(fit: LineFit) -> Array:
    """What noise is over the rms of what is left, [signal]: 1 but where lines are left, as
    sextupoles make them of a large oscillation. Lines fill few of the frequencies, so the median of
    the spectrum shows the noise."""
    turns = fit.residual.shape[1]
    if turns < 2 * FEWEST:
        return np.ones(len(fit.residual))
    window = np.hanning(turns + 2)[1:-1]
    power = np.abs(np.fft.rfft(fit.residual * window)[:, 1:]) ** 2
    mean = np.maximum(power.mean(axis=1), 1e-300)
    return np.asarray(np.sqrt(np.median(power, axis=1) / np.log(2) / mean))


def noise_at(fit: LineFit, line: int, quiet: Array) -> float:
    """What noise is where a line is, over what it is at all frequencies and turns, at least 1.

    A line is read in the turns in which its envelope is large, so noise counts as much as it is
    there, near the line's frequency. The typical signal's is taken.

    Args:
        fit: the lines.
        line: which.
        quiet: the noise at all frequencies, [signal].
    """
    turns = fit.envelope.shape[1]
    envelope = np.abs(fit.envelope[line])
    power = np.abs(np.fft.rfft(fit.residual * envelope)) ** 2
    scale = np.maximum(quiet**2 * (envelope**2).sum(), 1e-300)
    wide = round(2 * turns * (envelope**4).sum() / (envelope**2).sum() ** 2)
    away = np.abs(np.arange(power.shape[1]) - round(fit.frequency[line] * turns))
    away[0] = turns  # the offset
    parts = [away <= wide, (away > wide) & (away <= wide + turns // 16)]
    density = [np.median(power[:, part] / scale[:, None], axis=0) for part in parts if part.any()]
    return float(np.sqrt(max(1.0, *[own.mean() / np.log(2) for own in density])))


def change(fit: LineFit, line: int, planes: NDArray[np.int64]) -> Array:
    """By how much amplitudes change between two halves of a line's power, the first and the last.

    Where amplitude and energy shape the beam's optics, the particles that decohere last have other
    ratios between monitors than all of them had at first. What both halves share, and what noise
    makes of the difference, does not count. It is the rms of the real and of the imaginary part,
    typical for the monitors of a plane, and goes with the amplitude, [signal].
    """
    turns = fit.envelope.shape[1]
    found = np.zeros(len(planes))
    if turns < FEWEST:
        return found
    envelope = fit.envelope[line]
    moving = envelope * np.exp(2j * np.pi * fit.frequency[line] * np.arange(turns))
    power = np.abs(envelope) ** 2
    middle = int(np.searchsorted(np.cumsum(power), power.sum() / 2))
    shares = [power[:middle].sum(), power[middle:].sum()]
    if not min(shares):
        return found
    first, second = (
        2 * fit.residual[:, part] @ moving[part].conj() / own
        for part, own in zip((slice(0, middle), slice(middle, turns)), shares, strict=True)
    )
    amplitude = fit.amplitude[:, line]
    weight = 1 / fit.noise**2
    both = (weight * amplitude.conj() * (second - first)).sum()
    apart = second - first - both / (weight * np.abs(amplitude) ** 2).sum() * amplitude
    by_noise = 4 * fit.noise**2 * (1 / shares[0] + 1 / shares[1])
    for plane in (0, 1):
        own = planes == plane
        if own.any():
            surely = 1 + 3 / np.sqrt(own.sum())
            excess = np.mean(np.abs(apart[own]) ** 2 - surely * by_noise[own])
            size = np.mean(np.abs(amplitude[own]) ** 2)
            found[own] = np.sqrt(max(excess, 0.0) / size) / 2 * np.abs(amplitude[own])
    return found


def growth(envelope: ComplexArray) -> complex:
    """By how much an envelope grows in a turn, on the mean over the line's power."""
    power = (np.abs(envelope) ** 2).sum()
    return complex((envelope.conj() * np.gradient(envelope)).sum() / power)
