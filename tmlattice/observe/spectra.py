"""Betatron lines of a stored beam's turns: tunes, and each monitor's complex amplitudes.

>>> found = lines(turns, near=optics.tunes % 1)
>>> found.tune                                          # [shot, mode], fractions
>>> found.amplitude                                     # [shot, monitor, plane, mode], complex, m
>>> found.warnings                                      # data that could not be used, and why

The reading of turn t is offset + Re(A1 g1(t) exp(2 pi i Q1 t)) + Re(A2 g2(t) exp(2 pi i Q2 t)) +
noise, with t counted from turn 0 of the measurement. The complex envelopes g are common to all
monitors of a shot (see `fit_lines`), with mean square 1 and mean phase 0: 1 for a steady line.
Decoherence is in g. The ratios of A between monitors and planes are those of the eigenvector; one
complex scale of each mode and shot is unknown. Other lines (synchrotron motion, harmonics) are
fitted and dropped.

A signal of `fit_lines` is offset + sum over lines of Re(A g(t) exp(2 pi i f t)). The frequency f
and the complex envelope g of a line are the same in all signals, as decoherence, chromaticity and
detuning of a kicked beam are the same for all monitors; the ratios of the A are unaffected. The fit
alternates between two linear least squares: the lines' values of each turn, from all signals, and
the amplitudes of each signal, from all turns. In between a line's values are filtered near its
frequency.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.fft import dct, idct
from scipy.special import betaincinv

from tmlattice.arrays import REDUNDANT, TINY, Array, ComplexArray, Flags, Indices
from tmlattice.errors import TooFewTurnsError, first_of
from tmlattice.harmonics import MIN_TURNS
from tmlattice.harmonics import frequency as strongest
from tmlattice.inference import chi2
from tmlattice.inference.judgement import DEFAULT
from tmlattice.measurement import TurnByTurn
from tmlattice.measurement.lost_beam import beam_lost

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


Near = Sequence[float] | Array | None
Modes = tuple[int | None, int | None]
"""Lines of the modes nearer to x and to y; None without a line."""

RESOLUTION = 2.2
"""Bins of the spectrum (1 / turns) within which two lines are not resolved."""
MAX_SIDE_NOISE = 3.0
"""Noise near a line over that elsewhere above which there is another line."""
IMPURE = (
    "the residual near the line of mode {} exceeds the noise: it is not one mode, or two tunes "
    "are nearly equal"
)
OUTLIER = 8.0
"""Residual over noise above which a reading is rejected."""


@dataclass(frozen=True)
class Lines:
    """Betatron lines of the turns of a stored beam.

    Modes are (1, 2): the one nearer to x, and to y. Indices are (x, y). Missing values are NaN.

    Attributes:
        monitors: names.
        shots: ids.
        tune: fraction in [0, 1) if tunes were given, else in (0, 0.5), [shot, mode].
        tune_error: its rms, from noise and drift, [shot, mode].
        amplitude: A, complex, m, [shot, monitor, plane, mode]. For 1 - Q instead of Q it is the
            complex conjugate.
        error: rms of its real and of its imaginary part, without the common scale of all monitors,
            m, [shot, monitor, plane, mode]: from the noise at the line, and from the change of
            ratios between monitors while the beam decoheres.
        noise: rms of one reading, from the residual, m, [monitor, plane].
        turns: used of each shot, [shot].
        envelope: g, complex, [shot, mode, turn]; 0 behind the used turns.
        warnings: a sentence for all data that could not be used, or are doubtful.
    """

    monitors: tuple[str, ...]
    shots: tuple[int, ...]
    tune: Array
    tune_error: Array
    amplitude: ComplexArray
    error: Array
    noise: Array
    turns: Indices
    envelope: ComplexArray
    warnings: tuple[str, ...]


def lines(
    turns: TurnByTurn, near: Near = None, at: Array | None = None,
    chromatic: ComplexArray | None = None,
) -> Lines:  # fmt: skip
    """Return the betatron lines of every shot.

    Args:
        turns: the measurement.
        near: fractional tunes (x, y) in [0, 1) of a model: lines are sought within 0.12 of them,
            and they distinguish Q from 1 - Q, which positions cannot.
        at: position of each monitor in the turn, s / C, [monitor]: the envelope of a later one is
            later. None: monitors are equidistant, in their order.
        chromatic: change of the modes by the relative energy in the model that `near` is from, as
            a share of them, [monitor, plane, mode], 0 where it is unknown. What oscillates
            changes its energy while the beam decoheres, which is not an error of the amplitudes.

    Raises:
        TooFewTurnsError: no shot has 16 turns with a beam.

    Source: J. Laskar, Physica D 67 (1993) 257, for NAFF; C. Wang et al., Phys. Rev. ST Accel.
    Beams 6 (2003) 104001, for modes common to all monitors.
    """
    turns = beam_lost(turns).without
    shots, _, monitors, _ = turns.readings.shape
    place = np.arange(monitors) / monitors if at is None else np.asarray(at, dtype=float)
    signals = np.moveaxis(turns.readings, 1, 3).reshape(shots, 2 * monitors, -1)
    found = _empty(turns)
    if chromatic is not None:
        above = np.asarray(near) % 1 > 0.5
        chromatic = np.where(above, chromatic.conj(), chromatic).reshape(-1, 2)
    warnings: Warnings = {}
    noise: list[Array] = []
    for i, shot in enumerate(turns.shots):
        own = _shot(signals[i], near, partial(_warn, warnings, shot))
        if own is None:
            continue
        fit, usable, modes = own
        planes = np.tile([0, 1], monitors)[usable]
        used = fit.envelope.shape[1]
        found.turns[i] = used
        quiet = fit.noise * floor(fit)
        noise.append(np.full(2 * monitors, np.nan))
        noise[-1][usable] = fit.noise
        if chromatic is not None:
            changes = np.zeros_like(fit.amplitude[:, :2])
            for mode, line in enumerate(modes):
                if line is not None:
                    changes[:, line] = fit.amplitude[:, line] * chromatic[usable, mode]
            fit = without(fit, changes)
        for mode, line in enumerate(modes):
            if line is None:
                continue
            louder = noise_at(fit, line, quiet, planes)
            if louder.mean() > MAX_SIDE_NOISE:
                _warn(warnings, shot, IMPURE.format(mode + 1))
            mirrored = near is not None and near[mode] % 1 > 0.5
            turned = np.conj if mirrored else np.asarray
            found.tune[i, mode] = abs(mirrored - fit.frequency[line])
            found.tune_error[i, mode] = fit.frequency_error[line]
            found.envelope[i, mode, :used] = turned(fit.envelope[line])
            late = 1 + np.repeat(place, 2)[usable] * growth(fit.envelope[line])
            values = found.amplitude[i].reshape(-1, 2)
            values[usable, mode] = turned(fit.amplitude[:, line] / late)
            errors = found.error[i].reshape(-1, 2)
            own_error = quiet * np.sqrt(fit.variance[:, line]) * louder
            errors[usable, mode] = np.hypot(own_error, change(fit, line, planes))
    if not noise:
        raise TooFewTurnsError(
            f"no shot has {MIN_TURNS} turns with a beam, too few for a tune; "
            "give them as first turns"
        )
    with np.errstate(invalid="ignore"):
        squares = np.array(noise) ** 2
        counted = np.isfinite(squares).sum(axis=0)
        found.noise[:] = np.sqrt(np.nansum(squares, axis=0) / counted).reshape(-1, 2)
    sentences = [f"{_shots(own)}: {what}" for what, own in warnings.items()]
    sentences += _silent(turns, found.noise) + _louder(turns, found.noise)
    return replace(found, warnings=tuple(sentences))


def _empty(turns: TurnByTurn) -> Lines:
    shots, number, monitors, _ = turns.readings.shape
    return Lines(
        monitors=turns.monitors,
        shots=turns.shots,
        tune=np.full((shots, 2), np.nan),
        tune_error=np.full((shots, 2), np.nan),
        amplitude=np.full((shots, monitors, 2, 2), complex(np.nan, np.nan)),
        error=np.full((shots, monitors, 2, 2), np.nan),
        noise=np.full((monitors, 2), np.nan),
        turns=np.zeros(shots, dtype=np.int64),
        envelope=np.zeros((shots, 2, number), dtype=complex),
        warnings=(),
    )


Warnings = dict[str, list[int]]
"""Warnings, with the shots that they concern."""


def _warn(warnings: Warnings, shot: int, sentence: str) -> None:
    warnings.setdefault(sentence, []).append(shot)


def _shots(ids: Sequence[int]) -> str:
    return f"shot{'s' * (len(ids) > 1)} {first_of(ids)}"


def _shot(
    signals: Array, near: Near, warn: Callable[[str], None]
) -> tuple[LineFit, Flags, Modes] | None:
    """Lines of one shot [signal, turn], the signals that have any, and the line of each mode."""
    there = np.isfinite(signals)
    with_beam = there.sum(axis=0) >= 0.5 * there.sum(axis=0).max()
    last = len(with_beam) - int(with_beam[::-1].argmax()) if with_beam.any() else 0
    if last < len(with_beam):
        warn(f"the beam is read for {last} turns of {len(with_beam)}: these are used")
    if last < MIN_TURNS:
        warn(f"{last} turns are too few for a tune; at least {MIN_TURNS} are needed")
        return None
    there, signals = there[:, :last], signals[:, :last]
    usable = (there.sum(axis=1) >= max(MIN_TURNS, last // 4)) & _moves(signals, there)
    if not usable.any():
        warn(f"no BPM has {MIN_TURNS} turns of a beam that moves")
        return None
    there = there[usable]
    data = np.where(there, signals[usable], 0.0)
    planes = np.tile([0, 1], len(signals) // 2)[usable]
    fit = betatron_lines(data, there, planes, near)
    usual = chi2.typical(np.where(there, fit.residual, np.nan), axis=1)
    off = np.abs(fit.residual) / usual[:, None]
    common = np.median(off, axis=0)  # of all monitors it is the beam, but in a few turns
    outlier = off > OUTLIER * np.clip(common, 1.0, max(OUTLIER * np.median(common), 1.0))
    if outlier.any() and outlier.mean() < 0.05:
        warn(f"readings more than {OUTLIER:g} times the noise from the fit are rejected")
        there = there & ~outlier
        fit = betatron_lines(data * there, there, planes, near)
    modes = which(fit, planes, near)
    apart = np.abs(np.diff(fit.frequency[:2]))
    if None not in modes and apart < RESOLUTION / last:
        warn(
            f"the tunes are closer than {RESOLUTION / last:.2g}: "
            f"{last} turns do not resolve their lines"
        )
        return fit, usable, (None, None)
    _doubts(fit, planes, modes, warn)
    return fit, usable, modes


def _moves(signals: Array, there: Flags) -> Flags:
    """Signals whose readings are not all the same."""
    high = np.where(there, signals, -np.inf).max(axis=1)
    low = np.where(there, signals, np.inf).min(axis=1)
    return np.asarray(high > low)


# --- reported doubts ------------------------------------------------------------------------------
def _doubts(fit: LineFit, planes: Indices, modes: Modes, warn: Callable[[str], None]) -> None:
    turns = fit.envelope.shape[1]
    there = [line for line in modes if line is not None]
    for plane in (0, 1):
        if not (planes == plane).any():
            warn(f"no BPM reads {'xy'[plane]}")
    if not there:
        warn("no betatron line exceeds the noise")
    if len(there) != 1:
        return
    own = share(fit, planes, there[0])
    missing = f"no line of the mode nearer to {'xy'[1 - modes.index(there[0])]} is found"
    if 0.2 < own < 0.8:
        warn(
            f"{missing}, and that of the other is in both planes: the tunes are closer than "
            f"{RESOLUTION / turns:.2g}, or one mode was not kicked"
        )
    else:
        warn(f"{missing}: it was not kicked, or is lost in the noise")


def _silent(turns: TurnByTurn, noise: Array) -> list[str]:
    """Return a warning of unused monitors."""
    flat = np.isnan(noise)
    read = np.isfinite(turns.readings).any(axis=(0, 1))
    names = [turns.monitors[i] for i in np.flatnonzero((flat & read).any(axis=1))]
    if not names:
        return []
    shown = first_of([f"'{name}'" for name in names])
    one = len(names) == 1
    return [
        f"{'monitor' if one else 'monitors'} {shown} {'stands' if one else 'stand'} still or "
        f"{'has' if one else 'have'} too few readings, and {'is' if one else 'are'} not used"
    ]


def _louder(turns: TurnByTurn, noise: Array) -> list[str]:
    """Return a warning if the stated noise differs from the residual."""
    if turns.noise is None:
        return []
    with np.errstate(invalid="ignore"):
        ratio = noise / turns.noise
    if not np.isfinite(ratio).any():
        return []
    typical = float(np.nanmedian(ratio))
    if 0.5 < typical < 2:
        return []
    return [f"the residual noise is {typical:.2g} times the stated noise at a typical BPM"]


SLOWEST = 0.02
"""Smallest frequency of a betatron line, if no tune is given: below is synchrotron motion."""
AROUND = 0.12
"""Distance from a given tune within which its line is sought."""
SHORTEST = 32
"""Fewest turns of a longer measurement in which a line is sought."""
MAX_OTHERS = 3
"""Largest number of other lines that are fitted."""


def betatron_lines(data: Array, there: Flags, planes: Indices, near: Near) -> LineFit:
    """Fit up to two betatron lines, the first two, and other significant lines.

    The strongest line is the first. The second is the strongest remaining line in the plane in
    which the first is weaker and cannot hide it.
    """
    noise = np.sqrt((data**2).sum(axis=1) / there.sum(axis=1))
    first, span = _strongest(data, there, [planes == 0, planes == 1], near)
    fit = fit_lines(data, there, [first], noise, broad=1, span=span, rounds=2)
    weak = planes == int(share(fit, planes, 0) > 0.5)
    first = float(fit.frequency[0])
    second, _ = _strongest(fit.residual, there, [weak], near, away_from=first)
    chosen = [first] if second == 0 else [first, second]
    fit = fit_lines(data, there, chosen, fit.noise, broad=len(chosen), span=span)
    others = _other_lines(fit, there, planes)
    if not others:
        return fit
    chosen = [*fit.frequency, *others]
    return fit_lines(data, there, chosen, fit.noise, broad=len(fit.frequency), span=span)


def _strongest(
    data: Array,
    there: Flags,
    groups: Sequence[Flags],
    near: Near,
    away_from: float | None = None,
) -> tuple[float, int]:
    """Frequency of the most significant line in any group of signals, 0 for none, and its turns.

    It is sought in all turns, in the first quarter of them, and so on: a beam that decoheres has
    its line in the first.
    """
    turns = data.shape[1]
    best, found, span = 0.0, 0.0, turns
    length = turns
    while length == turns or length >= SHORTEST:
        frequency, power = _power(data[:, :length], there[:, :length])
        allowed = _allowed(frequency, near)
        if away_from is not None:
            allowed &= np.abs(frequency - away_from) >= 2 / turns
        for group in groups:
            seen = np.where(allowed, _typical(power[group]), 0.0)
            if seen.max() > 1.5 * best:  # fewer turns only if the line is clearer
                best, found, span = float(seen.max()), float(frequency[seen.argmax()]), length
        length //= 4
    return found, span


def _power(data: Array, there: Flags) -> tuple[Array, Array]:
    """Frequencies, and each signal's spectrum in units of its own floor, [signal, frequency].

    The floor is that of the lowest quarter of the spectrum, which has no lines.
    """
    turns = data.shape[1]
    mean = data.sum(axis=1, keepdims=True) / np.maximum(there.sum(axis=1, keepdims=True), 1)
    window = np.hanning(turns + 2)[1:-1]
    power = np.abs(np.fft.rfft((data - mean * there) * window)[:, 1:]) ** 2
    quarter = power.shape[1] // 4
    floor = np.partition(power, quarter, axis=1)[:, quarter, None] / -np.log(0.75)
    return np.arange(1, turns // 2 + 1) / turns, power / np.maximum(floor, TINY)


def _allowed(frequency: Array, near: Near) -> Flags:
    """Frequencies at which a betatron line may be."""
    if near is None:
        return (frequency > SLOWEST) & (frequency < 0.5)
    folded = np.abs(np.asarray(near) - np.round(near))
    close = np.abs(frequency - folded[:, None]).min(axis=0) < AROUND
    return np.asarray(close & (frequency < 0.5))


def _typical(power: Array) -> Array:
    """Upper median of the signals: one bad monitor makes no line."""
    if not len(power):
        return np.zeros(power.shape[1])
    middle = len(power) // 2
    return np.partition(np.ascontiguousarray(power.T), middle, axis=1)[:, middle]


def _seen(signals: int, trials: int) -> float:
    """Level that `_typical` of noise signals exceeds in some of the trials with probability
    DEFAULT.noise[1]."""
    above = signals - signals // 2
    return float(-np.log(betaincinv(above, signals - above + 1, DEFAULT.noise[1] / trials)))


def _other_lines(fit: LineFit, there: Flags, planes: Indices) -> list[float]:
    """Frequencies of up to three significant lines other than the betatron lines."""
    turns = there.shape[1]
    if turns < LONG:  # the floor between the lines is not resolved
        return []
    frequency, power = _power(fit.residual, there)
    seen = [power[planes == plane] for plane in (0, 1)]
    left = np.max([_typical(own) / _seen(*own.shape) for own in seen if len(own)], axis=0)
    width = max(2 * NARROW, 6 / turns)
    left[np.abs(frequency - fit.frequency[:, None]).min(axis=0) < width] = 0.0
    left[(frequency < 2 / turns) | (frequency > 0.5 - 2 / turns)] = 0.0
    found: list[float] = []
    while len(found) < MAX_OTHERS and left.max() > 1:
        found.append(float(frequency[left.argmax()]))
        left[np.abs(frequency - found[-1]) < width] = 0.0
    return found


def share(fit: LineFit, planes: Indices, line: int) -> float:
    """Share of a line's power, less the noise's, that is in x, 0 to 1."""
    power = np.abs(fit.amplitude[:, line]) ** 2 - 2 * fit.variance[:, line] * fit.noise**2
    x, y = (max(float(_typical(power[planes == p, None])[0]), 0.0) for p in (0, 1))
    return x / (x + y) if x + y > 0 else 0.5


def which(fit: LineFit, planes: Indices, near: Near) -> Modes:
    """Lines of the modes nearer to x and to y; None without a significant line.

    If one plane was measured the second line is none of these: the tune alone identifies the mode.
    """
    read = len(np.unique(planes))
    lines = min(len(fit.frequency), read)
    shares = [share(fit, planes, i) for i in range(lines)]
    folded = None if near is None else np.abs(np.asarray(near) - np.round(near))
    if lines == 2:
        first = 0 if shares[0] >= shares[1] else 1
        if folded is not None and abs(shares[0] - shares[1]) < 0.2:
            miss = [np.abs(fit.frequency[[i, 1 - i]] - folded).sum() for i in (0, 1)]
            first = int(np.argmin(miss))
        modes = [first, 1 - first]
    else:
        mode = 0 if shares[0] >= 0.5 else 1
        if folded is not None and (read == 1 or 0.2 < shares[0] < 0.8):
            mode = int(np.argmin(np.abs(fit.frequency[0] - folded)))
        modes = [0 if mode == 0 else -1, 0 if mode == 1 else -1]
    kept = [i if i >= 0 and _significant(fit, planes, i) else None for i in modes]
    return kept[0], kept[1]


def _significant(fit: LineFit, planes: Indices, line: int) -> bool:
    """Whether a line exceeds what an envelope makes of noise, in the plane where it is larger.

    Its envelope has picked the largest of as many directions of noise as it has cosines: the
    largest singular value of a random matrix.
    """
    turns = fit.envelope.shape[1]
    plane = 0 if share(fit, planes, line) >= 0.5 else 1
    own = planes == plane
    size = np.abs(fit.amplitude[own, line]) ** 2
    over = size / (2 * fit.variance[own, line] * fit.noise[own] ** 2 + TINY)
    picked = (1 + np.sqrt(2 * WIDEST * turns / own.sum())) ** 2
    return bool(_typical(over[:, None])[0] > picked * _seen(int(own.sum()), turns))
