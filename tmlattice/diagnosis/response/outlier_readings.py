"""Outlier readings of an orbit response: rejected, or with reduced weights, and reported.

A sound BPM may read the step of one corrector wrongly, by fifty times its noise. Such readings are
few, but make up most of chi-square. In the last fit their noise is increased until each residual is
five times its noise; gross outliers are rejected.
"""

import warnings
from collections import Counter
from dataclasses import replace
from itertools import product

import numpy as np

from tmlattice.arrays import Array, Flags
from tmlattice.diagnosis.response.state import State
from tmlattice.diagnosis.response.weights import DISPERSION, pulls, without_jitter
from tmlattice.diagnosis.support import SHOWN
from tmlattice.errors import first_of
from tmlattice.inference import chi2
from tmlattice.inference.judgement import FEW, GROSS, OUTLIERS, SIGNIFICANT
from tmlattice.measurement import OrbitResponse
from tmlattice.observe.orbit_response import Errors, Predicted
from tmlattice.observe.response_data import ResponseData

OFTEN = 2
"""Outliers of one BPM or corrector from which on it is named."""


def without_gross(measured: OrbitResponse, data: ResponseData) -> tuple[OrbitResponse, list[str]]:
    """Return the measurement without gross outliers relative to the design, and messages.

    They are rejected in held-out correctors too, where a few would dominate the validation scores.

    Args:
        measured: the response.
        data: the same response on the ring.
    """
    wrong = gross(data, Predicted(data, Errors.none(data)).read)
    if not wrong.any():
        return measured, []
    response = data.measured.response.copy()
    response[wrong[:-1]] = np.nan
    return replace(data.measured, response=response), told_gross(data, wrong, "the design")


def gross(data: ResponseData, read: Array) -> Flags:
    """Return the gross outliers among the correctors' readings, [column, monitor, 2]; none of steps
    with many of them, which are outliers themselves.

    Args:
        data: the response.
        read: by the model, m, [column, monitor, 2]. Each column has a kick of its own, because
            held-out ones are not fitted. It minimises the absolute deviations, which is robust
            against outliers.
    """
    model, orbits, wrong = data.pick(read), data.pick(data.orbits), np.zeros(read.shape, dtype=bool)
    gap = np.abs(data.orbits)
    for c, (u, d) in enumerate(zip(model, orbits, strict=True)):
        use = np.isfinite(d) & (u != 0)
        ratio, size = d[use] / u[use], np.abs(u[use])
        order = np.argsort(ratio)
        half = np.searchsorted(np.cumsum(size[order]), size.sum() / 2)
        gap[c] = np.abs(data.orbits[c] - (ratio[order][half] if use.any() else 1.0) * read[c])
    for kicked, plane in product((0, 1), (0, 1)):
        rows = np.flatnonzero(data.plane[:-1] == kicked)
        own = gap[rows, :, plane]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # no readings
            column, monitor = (np.nanmedian(own, axis=k, keepdims=True) for k in (1, 0))
        usual = np.fmax(np.fmax(column, monitor), data.noise[:, plane])
        wrong[rows, :, plane] = np.nan_to_num(own) > GROSS * chi2.MAD * usual
    count = np.isfinite(data.orbits).sum(axis=(1, 2))
    wrong[wrong.sum(axis=(1, 2)) > np.maximum(OUTLIERS * count, 1)] = False
    return wrong


def told_gross(data: ResponseData, wrong: Flags, what: str) -> list[str]:
    """Return a message about gross outliers; none without any.

    Args:
        data: the response.
        wrong: the outliers, [column, monitor, 2].
        what: reference of the residuals: the design or the fit.
    """
    if not wrong.any():
        return []
    columns, monitors, _ = np.nonzero(wrong)
    names = data.measured
    most = _most(Counter(names.monitors[i] for i in monitors.tolist()),
                 Counter(names.correctors[i] for i in columns.tolist()))  # fmt: skip
    return [
        f"outlier readings, which differ from {what} by more than {GROSS:g} times the typical "
        f"residual of their corrector and of their BPM, rejected: {len(columns)}{most}"
    ]


def _most(*tables: Counter[str]) -> str:
    """The BPMs and correctors with most outliers."""
    most = [
        f"{name} ({own})"
        for table in tables
        for name, own in table.most_common(SHOWN)
        if own >= OFTEN
    ]
    return f"; most at {', '.join(most)}" if most else ""


def outlier_readings(state: State) -> list[str]:
    """Return messages about the outliers of a fit, given its jitter: of the RF's orbit, at fitted
    and at other BPMs, and of the correctors' readings; none without any."""
    if not state.robust:
        return []
    measured, monitors, correctors = state.data.measured, Counter[str](), Counter[str]()
    of_rf, total = np.zeros_like(state.good), 0
    for block in (0, 1):
        left = without_jitter(state, block, state.data.pick(state.at.left, block))[0]
        left = np.where(state.good, left, np.nan)
        out = np.nan_to_num(np.abs(pulls(state, block, left))) > SIGNIFICANT
        if state.has_fitted(DISPERSION) and np.isfinite(left[-1]).sum() >= FEW:
            of_rf |= out[-1]
        rows, at = np.nonzero(out & state.fitted[:, None])
        total += int(np.isfinite(left[state.fitted]).sum())
        monitors.update(measured.monitors[i] for i in at)
        correctors.update(measured.correctors[i] for i in rows)
    messages = []
    if of_rf.any():
        names = first_of([measured.monitors[i] for i in np.flatnonzero(of_rf)])
        messages.append(
            f"outlier readings of the RF's orbit, by more than {SIGNIFICANT:g} times its typical "
            f"residual, with reduced weights where they are fitted: {names}."
        )
    if monitors:
        messages.append(
            f"{monitors.total()} of {total} readings are outliers, by more than {SIGNIFICANT:g} "
            "times the typical residual of their corrector, and have reduced "
            f"weights{_most(monitors, correctors)}."
        )
    return messages
