"""Outliers of an orbit response: single readings, steps and BPMs.

Outliers have a small weight in the fit, by its noise model. They would still bias the validation,
because held-out readings have outliers, too. Here they are detected by one statistic: the residual
of a fit over the median of the same plane.

>>> found = outliers(state)
>>> state = without(state, found.unread)
"""

import warnings
from collections import Counter
from collections.abc import Collection
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tmlattice.diagnosis.response.inconsistent_steps import inconsistent
from tmlattice.diagnosis.response.state import State
from tmlattice.diagnosis.response.weights import FREEDOM, used
from tmlattice.measurement import OrbitResponse
from tmlattice.observe.orbit_response import Errors, Predicted
from tmlattice.observe.response_data import ResponseData

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

GROSS = 20.0
"""Ratio to the usual residual of its corrector and of its BPM above which a single reading is an
outlier."""
MANY = 0.1
"""Share of a step's outliers from which on the step is the outlier."""
STEP = 6.0
"""Ratio to the residual of the typical step, absolute and relative to its orbit, above which a step
is an outlier. Swapped correctors have some hundred."""
NOISE = 2.0
"""Least ratio of its residual to the noise."""
BAD = 5.0
"""Ratio of a BPM's rms misfit to the typical reading's above which it is bad."""
SPARED = 0.1
"""Share of its readings that do not count: single outliers make no BPM bad."""
ROUNDED = 1e-6
"""Relative difference below which two responses are equal."""
COUPLING = "skew_gradient"
"""The family of the readings in the other plane."""
BLIND = 0.2
"""Gain below which a BPM does not read the beam."""
MOST = 0.25
"""Largest share of outlier steps of a plane: more of them are a model discrepancy."""
COLUMNS, READINGS = 5, 6
"""Least numbers of steps of a plane, and of readings of a step."""
OUT = 5.0
"""Standard deviations from which on a reading is reported as an outlier of the fit."""
NAMED, OFTEN = 3, 2
"""BPMs and correctors that are named, and the least number of outliers of each."""
STEPS = 10
"""Iterations of reweighted least squares for a step's own amounts."""
_MAD = 1.4826  # of a Gaussian


@dataclass(frozen=True)
class Outliers:
    """Outliers of a response.

    Attributes:
        unread: readings that are not used, [column, monitor, plane that is read].
        messages: which they are.
    """

    unread: Flags
    messages: tuple[str, ...] = ()


def outliers(state: State, explained: Collection[str] = ()) -> Outliers:
    """Return the outlier readings and steps.

    Args:
        state: a fit, with gains.
        explained: correctors that are something else, such as swapped ones: their steps stay.
    """
    data = state.data
    left = given_own(state)
    single = gross(data, left)
    read = np.isfinite(data.orbits).sum(axis=(1, 2))
    single[single.sum(axis=(1, 2)) > np.maximum(MANY * read, 1)] = False
    left[single] = np.nan
    broken = inconsistent(without(state, single))
    ratio = misfits(state, left)
    names = data.measured.correctors
    found_outliers = broken | (ratio > STEP)
    steps = [c for c in np.flatnonzero(found_outliers).tolist() if names[c] not in explained]
    unread = single.copy()
    unread[steps] = True
    gone = unread.all(axis=(1, 2)) if steps else np.zeros(len(data.plane), dtype=bool)
    split = state.split
    if not all((own & ~gone).any() for own in (split.held, split.inner, state.fitted)):
        return Outliers(single, tuple(gross_message(data, single, "the fit")))
    single[steps] = False
    messages = gross_message(data, single, "the fit")
    if steps:
        named = ", ".join(f"{names[c]} ({ratio[c]:.2g} times)" for c in steps)
        messages.append(
            "steps whose readings contradict one another or the fit to all others, with their "
            f"residual over that of a typical step, rejected: {named}; measure them again: wait "
            "until the beam has settled, and check for a spurious kick or a supply that jumps"
        )
    return Outliers(unread, tuple(messages))


def given_own(state: State) -> Array:
    """Residuals of each step after its own amounts (kick, place, roll) by least absolute
    deviations, m, [column, monitor, 2]."""
    data, at = state.data, state.at
    beam, jumps, across = at.seen(at.kicked), at.seen(at.jumps), at.seen(at.across)
    left = at.left.copy()
    left[:, ~state.good] = np.nan
    for c, plane in enumerate(data.plane[:-1].tolist()):
        own = np.stack([beam[c, :, plane], jumps[c, :, plane]], axis=1)
        left[c, :, plane] -= own @ (amounts := _robust(own, left[c, :, plane]))
        other = 1 - plane
        left[c, :, other] -= amounts[0] * beam[c, :, other]
        rolled = across[c, :, [other]].T
        left[c, :, other] -= rolled @ _robust(rolled, left[c, :, other])
    return left


def _robust(patterns: Array, read: Array) -> Array:
    """Amounts by least absolute deviations, [pattern]."""
    seen = np.isfinite(read)
    size = np.abs(patterns[seen]).max(axis=0, initial=0.0)
    amounts = np.zeros(patterns.shape[1])
    some = size > 0
    if seen.sum() <= some.sum() or not some.any():
        return amounts
    rows, right = patterns[seen][:, some] / size[some], read[seen]
    least = 1e-3 * float(np.median(np.abs(right))) + 1e-300
    weight = np.ones(len(right))
    for _ in range(STEPS):
        found = np.linalg.lstsq(rows * weight[:, None], right * weight, rcond=None)[0]
        weight = np.maximum(np.abs(right - rows @ found), least) ** -0.5
        weight /= weight.max()
    amounts[some] = found / size[some]
    return amounts


def misfits(state: State, left: Array) -> Array:
    """Ratio of each step's residual to the typical one of its plane, in metres, relative to its
    orbit and to its readings, in the plane with the larger ratio, [column].

    Args:
        state: of the fit.
        left: m, NaN where nothing counts, [column, monitor, 2].
    """
    data = state.data
    out = np.zeros(len(data.plane))
    noise = np.median(data.noise, axis=0)
    orbits, sizes = (
        np.stack([_typical(own[:-1, state.good, read]) for read in (0, 1)], axis=1)
        for own in (data.orbits, left)
    )
    columns = np.arange(len(orbits))
    straight = data.plane[:-1]
    usual = np.nanmedian(sizes[columns, straight] / np.fmax(orbits, noise)[columns, straight])
    for kicked in (0, 1):
        rows = np.flatnonzero(straight == kicked)
        for read in (0, 1):
            size, orbit = sizes[rows, read], orbits[rows, kicked]
            known = np.isfinite(size) & np.isfinite(orbit)
            if known.sum() < COLUMNS:
                continue
            share = size / np.maximum(orbit, float(np.median(data.noise)))
            # residuals of unfitted readings are larger
            least = np.maximum(
                _medians(size, known, state.fitted[rows]), NOISE * noise[read] / STEP
            )
            typical = np.maximum(_medians(share, known, state.fitted[rows]), 1e-300)
            ratio = np.minimum(size / least, share / typical)
            # a corrector that is rolled makes an orbit in the other plane, which the fit leaves as
            # large a share of as of others
            across = usual * np.fmax(orbits[rows, read], noise[read])
            ratio = np.where(known, np.fmin(ratio, size / np.maximum(across, 1e-300)), 0.0)
            if (ratio > STEP).sum() <= MOST * known.sum():
                out[rows] = np.maximum(out[rows], ratio)
    return out


def _medians(own: Array, known: Flags, fitted: Flags) -> Array:
    """The median of all, of the fitted, or of the unfitted entries of each row; the larger one."""
    out = np.full(len(own), np.median(own[known]))
    for alike in (fitted, ~fitted):
        if (known & alike).any():
            out[alike] = np.maximum(out[alike], np.median(own[known & alike]))
    return out


def _typical(read: Array) -> Array:
    """The rms of each row, by the median, m; NaN of too few."""
    out = np.full(len(read), np.nan)
    for i, own in enumerate(read):
        seen = own[np.isfinite(own)]
        if len(seen) >= READINGS:
            out[i] = _MAD * np.median(np.abs(seen))
    return out


def good_monitors(state: State) -> Flags:
    """Return the BPMs with a usual misfit after their own gains, [monitor].

    In the other plane they are checked after skew gradients are fitted.

    Args:
        state: a fit, with gains.
    """
    good = state.good & _usual(state, 0)
    return good & _usual(state, 1) if state.allows(COUPLING) else good


def _usual(state: State, block: int) -> Flags:
    """BPMs whose rms misfit in a block is below the limit, also without the worst tenth of their
    readings."""
    data = state.data
    read, orbits = data.pick(state.at.read, block), data.pick(data.orbits, block)
    good = np.ones(data.shape[1], dtype=bool)
    for kicked in (0, 1):
        rows = state.fitted & (data.plane == kicked)
        if rows.sum() < COLUMNS:
            continue
        bad = np.ones(data.shape[1], dtype=bool)
        rounded = ROUNDED * float(np.sqrt(np.mean(np.nan_to_num(orbits[rows]) ** 2)))
        for spared in (0.0, SPARED):
            rms, gain, count = _given_own_gain(read[rows], orbits[rows], spared)
            known = (count > 0) & state.good
            usual = max(float(np.median(rms[known])), rounded) if known.any() else np.inf
            blind = (gain < BLIND) & (block == 0)
            bad &= (count > 0) & ((rms > BAD * usual) | blind)
        good &= ~bad
    return good


def _given_own_gain(read: Array, orbits: Array, spared: float = 0.0) -> tuple[Array, Array, Array]:
    """Residual of each BPM with its own gain, rms, m; the gain, relative to its present one; and
    the number of readings, [monitor].

    Args:
        read, orbits: by the model and measured, m, [column, monitor].
        spared: share of a monitor's readings, its worst ones, that do not count.
    """
    seen = np.isfinite(orbits)
    if spared:
        left = np.abs(orbits - read * _gain(read, orbits, seen))
        worst_last = np.argsort(np.argsort(np.where(seen, left, np.inf), axis=0), axis=0)
        seen &= worst_last < np.ceil((1 - spared) * seen.sum(axis=0))
    gain = _gain(read, orbits, seen)
    count = seen.sum(axis=0)
    left = np.where(seen, orbits - gain * read, 0.0)
    return np.sqrt((left**2).sum(axis=0) / np.maximum(count, 1)), gain, count


def _gain(read: Array, orbits: Array, seen: Flags) -> Array:
    u, d = np.where(seen, read, 0), np.where(seen, orbits, 0)
    return np.asarray((u * d).sum(axis=0) / np.maximum((u * u).sum(axis=0), 1e-30))


def without(state: State, flags: Flags) -> State:
    """The state without these readings, [column, monitor, 2]: empty columns are not fitted,
    validate nothing, and have no numbers."""
    if not flags.any():
        return state
    data = state.data
    orbits = np.where(flags, np.nan, data.orbits)
    measured = replace(data.measured, response=orbits[:-1].copy())
    data = replace(data, orbits=orbits, measured=measured)
    gone = flags.all(axis=(1, 2))
    split = replace(state.split, held=state.split.held & ~gone, inner=state.split.inner & ~gone)
    values = dict(state.values)
    for family in state.families:
        if family.per == "column":
            values[family.variable] = np.where(gone, 0.0, values[family.variable])
    return replace(state, data=data, split=split).moved(values)


# --- single readings ------------------------------------------------------------------------------
def without_gross(measured: OrbitResponse, data: ResponseData) -> tuple[OrbitResponse, list[str]]:
    """The measurement without single outliers, and a message about them.

    Held-out correctors have outliers, too, and they would dominate a validation score.

    Args:
        measured: the response.
        data: the same, as the ring has it.
    """
    wrong = gross(data, data.orbits - Predicted(data, Errors.none(data)).read)
    if not wrong.any():
        return measured, []
    response = data.measured.response.copy()
    response[wrong[:-1]] = np.nan
    return replace(data.measured, response=response), gross_message(data, wrong, "the design")


def gross(data: ResponseData, left: Array) -> Flags:
    """Outliers of the correctors' readings, [column, monitor, 2].

    Args:
        data: the response.
        left: m, NaN where nothing was read, [column, monitor, 2].
    """
    gap, plane = np.abs(left[:-1]), data.plane[:-1]
    wrong = np.zeros(left.shape, dtype=bool)
    for kicked, read in ((0, 0), (0, 1), (1, 0), (1, 1)):
        rows = np.flatnonzero(plane == kicked)
        own = gap[rows, :, read]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # what was not read at all
            column, monitor = (np.nanmedian(own, axis=k, keepdims=True) for k in (1, 0))
        usual = np.fmax(np.fmax(column, monitor), data.noise[:, read])
        wrong[rows, :, read] = np.nan_to_num(own) > GROSS * _MAD * usual
    return wrong


def gross_message(data: ResponseData, wrong: Flags, what: str) -> list[str]:
    """A message about outliers, if there are any.

    Args:
        data: the response.
        wrong: which, [column, monitor, 2].
        what: they differ from.
    """
    if not wrong.any():
        return []
    columns, monitors, _ = np.nonzero(wrong)
    names = data.measured
    most = _most(Counter(names.monitors[i] for i in monitors.tolist()),
                 Counter(names.correctors[i] for i in columns.tolist()))  # fmt: skip
    return [
        f"single readings that differ from {what} by {GROSS:g} times the usual residual of their "
        f"corrector and of their BPM, rejected: {len(columns)}{most}"
    ]


def _most(*tables: Counter[str]) -> str:
    """The elements with most outliers."""
    most = [
        f"{name} ({own})"
        for table in tables
        for name, own in table.most_common(NAMED)
        if own >= OFTEN
    ]
    return f"; most at {', '.join(most)}" if most else ""


def messages(state: State) -> list[str]:
    """Messages about outliers of a fit, and about common-mode noise of the steps."""
    measured = state.data.measured
    limit = (FREEDOM + 1) / (FREEDOM + OUT**2)
    monitors, correctors = Counter[str](), Counter[str]()
    count = total = 0
    out = []
    for block in (0, 1):
        use = used(state, block)
        found_outliers = use & (state.noise.share[block] < limit)
        rf = np.flatnonzero(found_outliers[-1])
        if len(rf):
            names = ", ".join(measured.monitors[i] for i in rf)
            out.append(
                f"readings of the RF's orbit in {'xy'[block]} that deviate by more than {OUT:g} "
                "standard "
                f"deviations, and have a low weight: {names}"
            )
        count, total = count + int(found_outliers[:-1].sum()), total + int(use[:-1].sum())
        monitors.update(measured.monitors[i] for i in np.nonzero(found_outliers[:-1])[1])
        correctors.update(measured.correctors[i] for i in np.nonzero(found_outliers[:-1])[0])
    if count:
        out.append(
            f"{count} of {total} readings deviate by more than {OUT:g} standard deviations, and "
            "have a "
            f"low weight{_most(monitors, correctors)}"
        )
    return out + common_modes(state)


def common_modes(state: State) -> list[str]:
    """A message about the common mode of all readings of a step, if it exceeds their noise."""
    noise, data = state.noise, state.data
    moved = []
    for plane in (0, 1) if "waves" in noise.kinds else ():
        rms = float(noise.scale[1, plane, 0]) * np.sqrt(noise.waves.shape[1])
        if rms > float(np.median(data.noise[:, plane])):
            moved.append(f"{1e6 * rms:.2g} µm rms in {'xy'[plane]}")
    if not moved:
        return []
    return [
        "beam jitter between the readings of a step, common to all BPMs: "
        f"{' and '.join(moved)}; its amounts are fitted in each step"
    ]
