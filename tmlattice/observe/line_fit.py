"""Spectral lines common to many signals: a complex amplitude per signal, one envelope for all.

A signal is offset + sum over lines of Re(A g(t) exp(2 pi i f t)). The frequency f and the complex
envelope g of a line are the same in all signals, as decoherence, chromaticity and detuning of a
kicked beam are the same for all monitors; the ratios of the A are unaffected. The fit alternates
between two linear least squares: the lines' values of each turn, from all signals, and the
amplitudes of each signal, from all turns. In between a line's values are filtered near its
frequency.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.fft import dct, idct

from tmlattice.arrays import REDUNDANT, TINY, Array, ComplexArray, Flags, Indices
from tmlattice.harmonics import frequency as strongest

WIDEST = 0.05
"""Largest half width of a line, in tune: the envelope of a beam that decoheres in 10 turns."""
NARROW = 0.004
"""Largest half width of a line that is no betatron line, in tune."""
ROUNDS = 4
"""Rounds of the alternation: it starts within the noise of its end, and three reach it."""
QUIETEST = 0.1
"""Smallest noise of a signal over the typical one, so that none dominates."""


@dataclass(frozen=True)
class LineFit:
    """Lines of one shot.

    Attributes:
        frequency: in (0, 0.5), [line].
        frequency_error: rms, from the noise and from the line's drift, [line].
        amplitude: complex, in the signals' unit, [signal, line].
        variance: of the real and of the imaginary part, for a noise of 1, [signal, line].
        envelope: complex, mean square 1 and mean phase 0, [line, turn].
        noise: rms of a reading, from the residual, [signal].
        residual: 0 where missing, [signal, turn].
    """

    frequency: Array
    frequency_error: Array
    amplitude: ComplexArray
    variance: Array
    envelope: ComplexArray
    noise: Array
    residual: Array


def fit_lines(
    data: Array, there: Flags, frequencies: Sequence[float], noise: Array, *,
    broad: int, span: int, rounds: int = ROUNDS,
) -> LineFit:  # fmt: skip
    """Fit lines near given frequencies to all signals at once.

    Args:
        data: [signal, turn], 0 where missing.
        there: valid readings, [signal, turn].
        frequencies: of the lines, in (0, 0.5), to within half a bin.
        noise: rms of a reading, for the weights of the signals, [signal].
        broad: number of lines with an envelope, the first ones; the others are narrow.
        span: first turns in which the lines are visible: where the fit starts.
        rounds: of the alternation.
    """
    turns = data.shape[1]
    turn = np.arange(turns)
    lines = np.array(frequencies, dtype=float)
    offset = data.sum(axis=1) / there.sum(axis=1)
    window = np.pad(np.hanning(span + 2)[1:-1], (0, turns - span))
    turning = window[:, None] * np.exp(-2j * np.pi * np.outer(turn, lines))
    amplitude = (data - offset[:, None] * there) @ turning
    widths = _widths(lines, broad)
    shared = 2 * _cosines(widths, turns).sum() / len(data)
    free = np.maximum(there.sum(axis=1) - 1 - 2 * len(lines) - shared, 1)
    for step in range(rounds):
        patterns = _quadratures(amplitude)
        values, cover = least_squares(
            patterns, (data - offset[:, None] * there).T, there.T, 1 / noise**2, prior=1.0
        )
        envelopes = np.empty((len(lines), turns), dtype=complex)
        for i, width in enumerate(widths):
            own = values[:, 2 * i] + 1j * values[:, 2 * i + 1]
            lines[i], envelopes[i] = _line(own, lines[i], width, 0 if step else span)
        moving = envelopes * np.exp(2j * np.pi * np.outer(lines, turn))
        basis = np.column_stack([np.ones(turns), _quadratures(moving.T)])
        found, spread = least_squares(basis, data, there)
        offset = found[:, 0]
        amplitude = found[:, 1::2] + 1j * found[:, 2::2]
        residual = (data - found @ basis.T) * there
        own_noise = np.sqrt((residual**2).sum(axis=1) / free)
        least = max(QUIETEST * float(np.median(own_noise)), TINY)
        noise = np.asarray(np.maximum(own_noise, least))
    quadrature = 0.5 * (cover[:, 0::2] + cover[:, 1::2]).mean(axis=0)
    shifts, errors = np.array(
        [_shift(*own) for own in zip(envelopes, quadrature, strict=True)]
    ).T  # fmt: skip
    return LineFit(
        frequency=lines + shifts,
        frequency_error=errors,
        amplitude=amplitude,
        variance=0.5 * (spread[:, 1::2] + spread[:, 2::2]),
        envelope=envelopes * np.exp(-2j * np.pi * np.outer(shifts, turn)),
        noise=noise,
        residual=residual,
    )


def least_squares(
    basis: Array,
    data: Array,
    there: Flags,
    weights: Array | None = None,
    prior: float = 0.0,
) -> tuple[Array, Array]:
    """Coefficients of many signals in one basis, each from its valid samples.

    Args:
        basis: [sample, function].
        data: [signal, sample], 0 where missing.
        there: valid samples, [signal, sample].
        weights: of the samples; None: 1.
        prior: prior precision of the coefficients, so that undetermined ones stay small.

    Returns:
        Coefficients and the diagonal of the inverse normal matrix, both [signal, function]; the
        smallest solution where functions cannot be distinguished.
    """
    weighted = basis if weights is None else basis * weights[:, None]
    size = np.sqrt((basis * weighted).sum(axis=0))
    size = np.where(size > 0, size, 1.0)
    right = data @ (weighted / size)
    whole = there.all(axis=1)
    inverse = np.empty((len(data), basis.shape[1], basis.shape[1]))
    known = np.diag(prior / size**2)
    inverse[whole] = _inverse((basis / size).T @ (weighted / size) + known)
    if not whole.all():
        functions = basis.shape[1]
        products = (basis / size)[:, :, None] * (weighted / size)[:, None, :]
        normal = there[~whole].astype(float) @ products.reshape(len(basis), -1)
        inverse[~whole] = _inverse(normal.reshape(-1, functions, functions) + known)
    found = np.einsum("sfg,sg->sf", inverse, right) / size
    return np.asarray(found), np.asarray(np.diagonal(inverse, axis1=1, axis2=2) / size**2)


def _inverse(normal: Array) -> Array:
    # one monitor cannot separate the quadratures of a turn; the band does
    return np.asarray(np.linalg.pinv(normal, rcond=REDUNDANT, hermitian=True))


def _quadratures(values: ComplexArray) -> Array:
    """Re v and -Im v of each column, in turn: Re(A v) = Re A Re v - Im A Im v, [row, 2 columns]."""
    parts = np.empty((len(values), 2 * values.shape[1]))
    parts[:, 0::2], parts[:, 1::2] = values.real, -values.imag
    return parts


def _widths(lines: Array, broad: int) -> Array:
    """Half width of each line, in tune: less than half the distance to the next."""
    apart = np.abs(lines[:, None] - lines) + np.eye(len(lines))
    next_one = np.append(apart[:broad, :broad].min(axis=1), apart[broad:].min(axis=1))
    mirror = np.minimum(2 * lines, 1 - 2 * lines)
    most = np.append(np.full(broad, WIDEST), np.full(len(lines) - broad, NARROW))
    return np.asarray(np.minimum(most, 0.45 * np.minimum(next_one, mirror)))


def _cosines(width: Array | float, turns: int) -> Indices:
    """Number of cosines of the turns within a width."""
    return np.maximum(1, np.round(2 * np.asarray(width) * turns)).astype(np.int64)


def _slow(values: ComplexArray, width: float) -> ComplexArray:
    """Return values without what changes faster than a half width."""
    slow = dct(values, norm="ortho")
    slow[_cosines(width, len(values)) :] = 0
    return np.asarray(idct(slow, norm="ortho"))


def _line(values: ComplexArray, near: float, width: float, span: int) -> tuple[float, ComplexArray]:
    """Frequency and envelope of a line from its values by turn.

    The envelope is smooth: its slowest cosines, up to the width. The frequency is the mean one of
    its power; with a span, it is sought near NAFF's in so many turns.
    """
    turns = len(values)
    turn = np.arange(turns)
    envelope = _slow(values * np.exp(-2j * np.pi * near * turn), width)
    if span:
        found = (float(strongest(envelope[:span])[0]) + 0.5) % 1.0 - 0.5
        if abs(found) < width:
            near, envelope = near + found, envelope * np.exp(-2j * np.pi * found * turn)
    shift = growth(envelope).imag / (2 * np.pi)
    if abs(shift) < width:
        near, envelope = near + shift, envelope * np.exp(-2j * np.pi * shift * turn)
    size = np.sqrt(np.mean(np.abs(envelope) ** 2))
    phase = np.angle(np.sum(np.abs(envelope) * envelope))
    return near, envelope * np.exp(-1j * phase) / (size if size > 0 else 1.0)


def _peak(signal: ComplexArray) -> float:
    """Peak frequency of a signal with a line near 0, by Newton's method on its squared spectrum."""
    turn = np.arange(len(signal)) - (len(signal) - 1) / 2
    at = 0.0
    for _ in range(5):
        turned = signal * np.exp(-2j * np.pi * at * turn)
        value = turned.sum()
        slope = -2j * np.pi * (turn * turned).sum()
        bend = -4 * np.pi**2 * (turn**2 * turned).sum()
        below = abs(slope) ** 2 + (value.conjugate() * bend).real
        if below >= 0:  # no peak: the line has no steady part
            break
        at -= float((value.conjugate() * slope).real / below)
    return at


def _shift(envelope: ComplexArray, variance: float) -> tuple[float, float]:
    """Frequency of an envelope, and its error from noise and from the drift between two halves.

    It is the peak of the spectrum with the modulus as window, which the noise moves least; or the
    mean one, that of the mean energy of what oscillates, if noise does not explain the difference.

    Args:
        envelope: [turn].
        variance: of the line's real and imaginary part on one turn.
    """
    power = np.abs(envelope) ** 2
    turn = np.arange(len(power))

    def statistical(power: Array) -> float:
        own = turn[: len(power)]
        middle = (power * own).sum() / max(power.sum(), TINY)
        lever = (power * (own - middle) ** 2).sum()
        return float(variance / max(lever, TINY) / (2 * np.pi) ** 2)

    middle = int(np.searchsorted(np.cumsum(power), power.sum() / 2))
    halves = [slice(0, middle), slice(middle, len(power))]  # of the power
    peaks = [_peak(np.abs(envelope[half]) * envelope[half]) for half in halves]
    expected = sum(statistical(power[half]) for half in halves)
    drift = max((peaks[0] - peaks[1]) ** 2 - 9 * expected, 0.0) / 4
    peak, mean = _peak(np.abs(envelope) * envelope), growth(envelope).imag / (2 * np.pi)
    noise = (np.abs(np.gradient(envelope)) ** 2).sum() + power[0] + power[-1]
    noise *= variance / max(2 * np.pi * power.sum(), TINY) ** 2
    if (peak - mean) ** 2 > 9 * noise:
        return mean, float(np.sqrt(noise + drift))
    return peak, float(np.sqrt(statistical(power) + drift))


LONG = 64
"""Turns of which half determine a change, and that resolve the floor between lines."""


def floor(fit: LineFit) -> Array:
    """Noise over the rms of the residual, [signal]: 1 unless lines remain, as sextupoles make them
    of a large oscillation. Lines fill few frequencies: the spectrum's median shows the noise."""
    turns = fit.residual.shape[1]
    if turns < 2 * LONG:
        return np.ones(len(fit.residual))
    window = np.hanning(turns + 2)[1:-1]
    power = np.abs(np.fft.rfft(fit.residual * window)[:, 1:]) ** 2
    mean = np.maximum(power.mean(axis=1), TINY)
    return np.asarray(np.sqrt(np.median(power, axis=1) / np.log(2) / mean))


def noise_at(fit: LineFit, line: int, quiet: Array, planes: Indices) -> Array:
    """Noise at a line over that at all frequencies and turns, at least 1; of the typical signal of
    each plane, [signal]. Lines near this one may be in one plane alone.

    A line is measured in the turns in which its envelope is large, near its frequency.

    Args:
        fit: the lines.
        line: index of the line.
        quiet: noise at all frequencies, [signal].
        planes: of each signal, [signal].
    """
    turns = fit.envelope.shape[1]
    envelope = np.abs(fit.envelope[line])
    power = np.abs(np.fft.rfft(fit.residual * envelope)) ** 2
    power /= np.maximum(quiet**2 * (envelope**2).sum(), TINY)[:, None]
    wide = round(2 * turns * (envelope**4).sum() / (envelope**2).sum() ** 2)
    away = np.abs(np.arange(power.shape[1]) - round(fit.frequency[line] * turns))
    away[0] = turns  # the offset
    parts = [away <= wide, (away > wide) & (away <= wide + turns // 16)]
    found = np.ones(len(planes))
    for plane in set(planes.tolist()):
        typical = np.median(power[planes == plane], axis=0) / np.log(2)
        near = [typical[part].mean() for part in parts if part.any()]
        found[planes == plane] = np.sqrt(max(1.0, *near))
    return found


def without(fit: LineFit, changes: ComplexArray) -> LineFit:
    """Subtract known changes of the ratios between signals from the residual, with any envelope.

    Args:
        fit: the lines.
        changes: of the amplitudes of the first lines, [signal, line].
    """
    there = fit.residual != 0
    turn = np.arange(fit.residual.shape[1])
    lines = fit.frequency[: changes.shape[1]]
    values, _ = least_squares(
        _quadratures(changes), fit.residual.T, there.T, 1 / fit.noise**2, prior=1.0
    )
    residual = fit.residual.copy()
    for i, width in enumerate(_widths(lines, len(lines))):
        moving = np.exp(2j * np.pi * lines[i] * turn)
        envelope = _slow((values[:, 2 * i] + 1j * values[:, 2 * i + 1]) / moving, width)
        residual -= np.real(np.outer(changes[:, i], envelope * moving)) * there
    return replace(fit, residual=residual)


def change(fit: LineFit, line: int, planes: Indices) -> Array:
    """Change of amplitudes between the first and the last half of a line's power, [signal].

    Where amplitude and energy shape the optics, the particles that decohere last have other ratios
    between monitors than all of them had at first. The common change and the noise are subtracted.
    It is the rms of the real and of the imaginary part, typical for the monitors of a plane, and
    proportional to the amplitude.
    """
    turns = fit.envelope.shape[1]
    found = np.zeros(len(planes))
    if turns < LONG:
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
    return complex(np.vdot(envelope, np.gradient(envelope)) / max(power, TINY))
