"""Search for the betatron lines of a stored beam in the spectra of all monitors."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.special import betaincinv

from tmlattice.observe.line_fit import NARROW, WIDEST, LineFit, fit_lines

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Planes = NDArray[np.int64]
Near = Sequence[float] | Array | None
Modes = tuple[int | None, int | None]
"""Lines of the modes nearer to x and to y; None without a line."""

SLOWEST = 0.02
"""Smallest frequency of a betatron line, if no tune is given: below is synchrotron motion."""
AROUND = 0.12
"""Distance from a given tune within which its line is sought."""
SHORTEST = 32
"""Fewest turns of a longer measurement in which a line is sought."""
MAX_OTHERS = 3
"""Largest number of other lines that are fitted."""
CHANCE = 1e-6
"""Probability that noise alone makes a line somewhere in the spectrum."""


def betatron_lines(data: Array, there: Mask, planes: Planes, near: Near) -> LineFit:
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
    there: Mask,
    groups: Sequence[Mask],
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


def _power(data: Array, there: Mask) -> tuple[Array, Array]:
    """Frequencies, and each signal's spectrum in units of its own floor, [signal, frequency].

    The floor is that of the lowest quarter of the spectrum, which has no lines.
    """
    turns = data.shape[1]
    mean = data.sum(axis=1, keepdims=True) / np.maximum(there.sum(axis=1, keepdims=True), 1)
    window = np.hanning(turns + 2)[1:-1]
    power = np.abs(np.fft.rfft((data - mean * there) * window)[:, 1:]) ** 2
    quarter = power.shape[1] // 4
    floor = np.partition(power, quarter, axis=1)[:, quarter, None] / -np.log(0.75)
    return np.arange(1, turns // 2 + 1) / turns, power / np.maximum(floor, 1e-300)


def _allowed(frequency: Array, near: Near) -> Mask:
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
    CHANCE."""
    above = signals - signals // 2
    return float(-np.log(betaincinv(above, signals - above + 1, CHANCE / trials)))


def _other_lines(fit: LineFit, there: Mask, planes: Planes) -> list[float]:
    """Frequencies of up to three significant lines other than the betatron lines."""
    turns = there.shape[1]
    if turns < 64:  # the floor between the lines is not resolved
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


def share(fit: LineFit, planes: Planes, line: int) -> float:
    """Share of a line's power, less the noise's, that is in x, 0 to 1."""
    power = np.abs(fit.amplitude[:, line]) ** 2 - 2 * fit.variance[:, line] * fit.noise**2
    x, y = (max(float(_typical(power[planes == p, None])[0]), 0.0) for p in (0, 1))
    return x / (x + y) if x + y > 0 else 0.5


def which(fit: LineFit, planes: Planes, near: Near) -> Modes:
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


def _significant(fit: LineFit, planes: Planes, line: int) -> bool:
    """Whether a line exceeds what an envelope makes of noise, in the plane where it is larger.

    Its envelope has picked the largest of as many directions of noise as it has cosines: the
    largest singular value of a random matrix.
    """
    turns = fit.envelope.shape[1]
    plane = 0 if share(fit, planes, line) >= 0.5 else 1
    own = planes == plane
    size = np.abs(fit.amplitude[own, line]) ** 2
    over = size / (2 * fit.variance[own, line] * fit.noise[own] ** 2 + 1e-300)
    picked = (1 + np.sqrt(2 * WIDEST * turns / own.sum())) ** 2
    return bool(_typical(over[:, None])[0] > picked * _seen(int(own.sum()), turns))
