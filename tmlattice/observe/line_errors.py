"""Errors of line amplitudes: noise at a line's frequency and turns, and drifts."""

import numpy as np
from numpy.typing import NDArray

from tmlattice.observe.line_fit import LineFit

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

MIN_TURNS = 64
"""Turns of which half determine a change."""


def floor(fit: LineFit) -> Array:
    """Noise over the rms of the residual, [signal]: 1 unless lines remain, as sextupoles make them
    of a large oscillation. Lines fill few frequencies: the spectrum's median shows the noise."""
    turns = fit.residual.shape[1]
    if turns < 2 * MIN_TURNS:
        return np.ones(len(fit.residual))
    window = np.hanning(turns + 2)[1:-1]
    power = np.abs(np.fft.rfft(fit.residual * window)[:, 1:]) ** 2
    mean = np.maximum(power.mean(axis=1), 1e-300)
    return np.asarray(np.sqrt(np.median(power, axis=1) / np.log(2) / mean))


def noise_at(fit: LineFit, line: int, quiet: Array) -> float:
    """Noise at a line over that at all frequencies and turns, at least 1; of the typical signal.

    A line is measured in the turns in which its envelope is large, near its frequency.

    Args:
        fit: the lines.
        line: index of the line.
        quiet: noise at all frequencies, [signal].
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
    """Change of amplitudes between the first and the last half of a line's power, [signal].

    Where amplitude and energy shape the optics, the particles that decohere last have other ratios
    between monitors than all of them had at first. The common change and the noise are subtracted.
    It is the rms of the real and of the imaginary part, typical for the monitors of a plane, and
    proportional to the amplitude.
    """
    turns = fit.envelope.shape[1]
    found = np.zeros(len(planes))
    if turns < MIN_TURNS:
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
    """Growth of an envelope per turn, averaged over the line's power."""
    power = (np.abs(envelope) ** 2).sum()
    return complex((envelope.conj() * np.gradient(envelope)).sum() / power)
