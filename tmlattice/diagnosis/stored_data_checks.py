"""The data checks of a stored beam: turns, closed orbits, dispersion and tunes, as a whole.

Distributed errors leave its lines, dispersion and orbit changes close to the design's. Swapped
planes, a wrong sign or unit, BPMs in another order, or another ring do not. The difference is a
share of the whole, so no noise has to be known.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tmlattice.diagnosis import signals
from tmlattice.diagnosis.signals import Check, fine, note, wrong
from tmlattice.effects import modelled
from tmlattice.errors import MeasurementError
from tmlattice.lattice import Ring
from tmlattice.measurement import ClosedOrbit, Dispersion, TuneReading, TurnByTurn
from tmlattice.observe.orbits import closed_orbits, dispersion
from tmlattice.observe.steady import NOTHING
from tmlattice.observe.stored import Stored
from tmlattice.observe.tune_readings import tune_readings
from tmlattice.observe.turn_by_turn import LINES, ManyTurns, many_turns

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Flags = NDArray[np.bool_]

OTHER = 0.3
"""Share of difference from which on the data do not match the ring as stated; strong distributed
errors (a beta beat of a half) leave 0.1."""
CORRECTED = 0.35
"""Share of that difference at most after a global error is corrected."""
TUNE = 0.1
"""Distance of tunes from which on one is another ring's, or of the other plane."""
SHIFTS = (-3, -2, -1, 1, 2, 3)
GLOBAL = "signs, units and order"

StoredData = TurnByTurn | ClosedOrbit | Dispersion | TuneReading
Change = Callable[[Any], Any]


@dataclass(frozen=True)
class GlobalError:
    """A possible global error: its words, its correction, and its inverse for data [..., monitor,
    plane, ...]."""

    words: str
    correction: str
    undo: Change


SWAPPED = GlobalError(
    "the planes are swapped everywhere", "swap x and y", lambda data: data[..., ::-1]
)


def _of_lines() -> list[GlobalError]:
    """Global errors of lines [shot, mode, monitor, plane]."""
    turned = GlobalError(
        "the turns are numbered backwards", "number them from the kick on", np.conj
    )
    reverse = GlobalError(
        "the monitors are in reverse order", "reverse the order of the monitors' names",
        lambda data: data[..., ::-1, :],
    )  # fmt: skip
    shifted = [
        GlobalError(
            f"the monitors are shifted by {by:+d}",
            f"give each the readings of the {abs(by)}. monitor {'behind' if by > 0 else 'before'}",
            lambda data, by=by: np.roll(data, -by, axis=-2),  # type: ignore[misc]
        )
        for by in SHIFTS
    ]
    return [turned, reverse, *shifted]


SIGN = GlobalError(
    "the sign is wrong everywhere", "change the sign of the readings, or of the step",
    lambda data: -data,
)  # fmt: skip
SIGNS = [
    SIGN,
    GlobalError(
        "the sign of x is wrong", "change the sign of x", lambda d: d * np.array([-1.0, 1.0])
    ),
    GlobalError(
        "the sign of y is wrong", "change the sign of y", lambda d: d * np.array([1.0, -1.0])
    ),
]
UNITS = [
    GlobalError(
        f"the unit is wrong: readings are {name}", f"multiply them by {factor:g}",
        lambda data, factor=factor: data * factor,  # type: ignore[misc]
    )
    for name, factor in (
        ("1000 times too large", 1e-3), ("a million times too large", 1e-6),
        ("1000 times too small", 1e3), ("a million times too small", 1e6),
    )
]  # fmt: skip
WHOLE = [*SIGNS, *UNITS, SWAPPED]
"""Global errors of an orbit's change."""


def raise_if_wrong(ring: Ring, data: StoredData, problem: Stored) -> None:
    """Raise an error if a global error can be corrected.

    Raises:
        MeasurementError: the error, and its correction.
    """
    turns = problem if isinstance(problem, ManyTurns) else None
    for check in stored_checks(ring, data, turns):
        if check.name == GLOBAL and check.status == "wrong":
            raise MeasurementError(check.sentence)


def stored_checks(ring: Ring, data: StoredData, turns: ManyTurns | None = None) -> list[Check]:
    """Return the checks of a measurement of a stored beam.

    Args:
        ring: the design.
        data: measured.
        turns: its lines, where they are known already.

    Raises:
        UnknownNameError: a monitor that the ring does not have.
    """
    places = dict.fromkeys(modelled(turns=True), 1.0)
    if isinstance(data, TuneReading):
        return _tunes(tune_readings(ring, data, places).values[:, :2], data, ring)
    names = [monitor.name for monitor in ring.monitors]
    whole = data.in_order_of(names)
    values = _values(whole)
    checks = signals.monitors(ring, names, values, isinstance(data, TurnByTurn))
    if any(check.status == "wrong" for check in checks):
        return checks
    try:
        if isinstance(data, TurnByTurn):
            own_turns = turns or many_turns(ring, data, places)
            return [*checks, *_of_turns(ring, data, own_turns)]
        if isinstance(data, Dispersion):
            own: Stored = dispersion(ring, data, places)
            return [*checks, *_of_orbits(ring, own, own.values, "dispersion", WHOLE)]
        own = closed_orbits(ring, data, places)
    except MeasurementError as error:
        return [*checks, wrong("data", str(error))]
    if not any(data.settings) or len(own.values) < 2:
        text = (
            "one orbit is the sum of all errors: it determines neither signs nor the order of BPMs"
        )
        return [*checks, fine(GLOBAL, text)]
    changes = own.values - own.values.mean(axis=0)
    return [*checks, *_of_orbits(ring, own, changes, "orbit change", WHOLE)]


def _values(data: TurnByTurn | ClosedOrbit | Dispersion) -> Array:
    """Readings of an orbit's change, [reading, monitor, 2], m."""
    if isinstance(data, TurnByTurn):
        return data.readings.reshape(-1, *data.readings.shape[2:])
    return data.orbit if isinstance(data, ClosedOrbit) else data.orbits


# --- orbits ---------------------------------------------------------------------------------------
def _of_orbits(
    ring: Ring, problem: Stored, data: Array, what: str, corrections: list[GlobalError]
) -> list[Check]:
    """Check data [state, monitor, 2] against the design's."""
    design = problem.read(problem.view(()), NOTHING)
    if what != "dispersion":
        design = design - design.mean(axis=0)
    data = np.where(problem.used, data, np.nan)
    noise = 2 * float(np.sum(problem.sigma[problem.used] ** 2))

    def share(own: Array) -> float:
        """The shares of the readings and of the design beyond the noise."""
        there = np.isfinite(own)
        left = np.sum(np.where(there, own - design, 0.0) ** 2)
        size = np.sum(np.where(there, own, 0.0) ** 2) + np.sum(np.where(there, design, 0.0) ** 2)
        return float(max(left - noise, 0.0) / max(size, 1e-300))

    return _judged(ring, what, share, data, corrections)


# --- turns ----------------------------------------------------------------------------------------
def _of_turns(ring: Ring, data: TurnByTurn, problem: ManyTurns) -> list[Check]:
    modes = np.stack([np.moveaxis(b.shown.modes, -1, 0) for b in problem.view(()).beams])

    def share(own: ComplexArray) -> float:
        """The share of the lines, up to one complex factor a mode, that differs from the
        model's."""
        seen = np.isfinite(own)
        read, model = (np.where(seen, one, 0.0) for one in (own, modes))
        inner = np.abs(np.sum(read.conj() * model, axis=(2, 3))) ** 2
        sizes = np.sum(np.abs(read) ** 2, axis=(2, 3)) * np.sum(np.abs(model) ** 2, axis=(2, 3))
        left = 1 - inner / np.maximum(sizes, 1e-300)
        return float(np.median(left[sizes > 0])) if (sizes > 0).any() else 1.0

    def swaps(_: ComplexArray) -> ComplexArray:
        """The lines, searched for near the tune of each plane."""
        try:
            other = replace(data, readings=data.readings[..., ::-1], noise=None)
            return _lines(many_turns(ring, other, problem.places))
        except MeasurementError:
            return np.full(modes.shape, complex(np.nan, np.nan))

    corrections = [replace(SWAPPED, undo=swaps), *_of_lines()]
    text = [note("lines", one) for one in problem.warnings]
    tunes = _near(ring, problem.values[:, -2:], problem.used[:, -2:])
    return [*text, tunes, *_judged(ring, "line", share, _lines(problem), corrections)]


def _lines(problem: ManyTurns) -> ComplexArray:
    """Complex amplitudes [shot, mode, monitor, plane]; NaN where unknown."""
    used = problem.used[:, :LINES]
    both = np.where(used, problem.values[:, :LINES], np.nan)
    both = both.reshape(len(both), -1, 2, 2, 2)  # [shot, monitor, plane, mode, re and im]
    return np.moveaxis(both[..., 0] + 1j * both[..., 1], -1, 1)


def _near(ring: Ring, tunes: Array, used: Flags) -> Check:
    measured = ", ".join(
        f"Q{'xy'[mode]} = {np.mean(tunes[used[:, mode], mode]) % 1:.4f}"
        for mode in (0, 1) if used[:, mode].any()
    )  # fmt: skip
    return fine("tunes", f"{measured}, near to those of '{ring.name}'")


# --- tunes ----------------------------------------------------------------------------------------
def _tunes(near: Array, data: TuneReading, ring: Ring) -> list[Check]:
    """Check tunes [shot, 2] against those of the design."""
    from tmlattice.optics import ring_tunes

    design = ring_tunes(ring)
    if design is None:
        return [wrong("tunes", f"'{ring.name}' has no tune: its design is unstable")]
    read = np.nanmedian(data.tune % 1, axis=0)

    def off(own: Array) -> float:
        apart = np.abs((own - np.array(design) + 0.5) % 1 - 0.5)
        return float(np.nanmax(apart)) if np.isfinite(apart).any() else 0.0

    x, y = read
    others = {
        "the tunes are swapped": ((y, x), "swap Qx and Qy"),
        "Qx is 1 - Qx": ((1 - x, y), "give 1 - Qx: a spectrum does not separate Q from 1 - Q"),
        "Qy is 1 - Qy": ((x, 1 - y), "give 1 - Qy: a spectrum does not separate Q from 1 - Q"),
        "both are 1 - Q": ((1 - x, 1 - y), "give 1 - Q: a spectrum does not separate Q from 1 - Q"),
    }  # fmt: skip
    stated = off(read)
    measured = f"Qx = {x:.4f}, Qy = {y:.4f}; '{ring.name}' has {design[0]:.4f} and {design[1]:.4f}"
    if stated < TUNE:
        return [fine("tunes", measured)]
    words = min(others, key=lambda name: off(np.array(others[name][0])))
    if off(np.array(others[words][0])) < CORRECTED * stated:
        return [wrong(GLOBAL, f"{words}: {measured}; {others[words][1]}")]
    return [
        wrong("tunes", f"the tunes are not the ring's: {measured}; name the lattice as it is set")
    ]


# --- messages ---------------------------------------------------------------------------------
def _judged(
    ring: Ring, what: str, share: Callable[[Any], float], data: Any, corrections: list[GlobalError]
) -> list[Check]:
    """The check of the difference as stated, and with each global error corrected."""
    stated = share(data)
    text = f"the typical {what} is the design's to {100 * np.sqrt(stated):.0f} % of its size"
    if stated < OTHER:
        return [
            fine(GLOBAL, "no global error would improve the agreement"), fine("lattice", text)
        ]  # fmt: skip
    left = [share(one.undo(data)) for one in corrections]
    best = int(np.argmin(left))
    if left[best] < CORRECTED * stated:
        one = corrections[best]
        after = 100 * np.sqrt(left[best])
        return [
            wrong(
                GLOBAL,
                f"{one.words}: the typical {what} differs from the design's by "
                f"{100 * np.sqrt(stated):.0f} % of its size as stated, by {after:.0f} % with that "
                f"corrected; {one.correction}",
            )
        ]
    return [
        wrong(
            "lattice",
            f"the data are not those of '{ring.name}': the typical {what} differs from the "
            f"design's by {100 * np.sqrt(stated):.0f} % of its size; name the lattice of this "
            "machine, and check the names and the order of the BPMs",
        )
    ]
