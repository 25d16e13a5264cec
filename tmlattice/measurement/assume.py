"""Measurements as they would be if something had been written down wrongly: `--assume NAME`.

>>> assume(measurement, ["x-reversed", "launches-in-mm"])

Each assumption is a wrong sign, unit, order or name that the data may have everywhere, and what
undoes it. The data checks try them all; a user goes on with those that he has confirmed.
"""

from collections.abc import Callable, Iterable, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from tmlattice.errors import MeasurementError, unknown_name
from tmlattice.measurement.monitors import Names
from tmlattice.measurement.orbit_response import OrbitResponse
from tmlattice.measurement.trajectory import Measurement

Array = NDArray[np.float64]
Order = NDArray[np.intp]
Data = TypeVar("Data", Measurement, OrbitResponse)


@dataclass(frozen=True)
class Assumption:
    """Something that was written down wrongly everywhere.

    Attributes:
        words: what is wrong, a clause.
        correction: what to do about it in the data, an order.
        trajectory, response: what undoes it in first turns, in an orbit response; None where it
            has no meaning there.
    """

    words: str
    correction: str
    trajectory: Callable[[Measurement], Measurement] | None = None
    response: Callable[[OrbitResponse], OrbitResponse] | None = None


def assume(data: Data, names: Iterable[str], ring_monitors: Sequence[str]) -> Data:
    """The data with what is assumed undone, one after another.

    Args:
        data: first turns or an orbit response.
        names: of `ASSUMPTIONS`.
        ring_monitors: names of the ring's monitors, in beam order.

    Raises:
        UnknownNameError: no such assumption, or a monitor that the ring does not have.
        MeasurementError: one without meaning for these data.
    """
    names = list(names)
    if names:
        data = in_beam_order(data, ring_monitors)
    for name in names:
        known = ASSUMPTIONS.get(name)
        if known is None:
            raise unknown_name("assumption", name, ASSUMPTIONS)
        own = known.trajectory if isinstance(data, Measurement) else known.response
        if own is None:
            kind = "first turns" if isinstance(data, Measurement) else "an orbit response"
            raise MeasurementError(f"the assumption '{name}' has no meaning for {kind}")
        data = own(data)  # type: ignore[arg-type]
    return data


def in_beam_order(data: Data, ring_monitors: Sequence[str]) -> Data:
    """The data with their monitors in the order in which the beam meets them.

    Raises:
        UnknownNameError: a monitor that the ring does not have.
    """
    if data.monitors == tuple(ring_monitors):
        return data
    names = Names("monitor", ring_monitors)
    at = [names[name] for name in data.monitors]
    if at == sorted(at):
        return data
    return data.select(monitors=[data.monitors[i] for i in np.argsort(at)])


# --- readings -------------------------------------------------------------------------------------
def _with(data: Data, **values: Any) -> Data:
    """`replace` without its checks, which cost more than a fit: these values can be, as the
    old ones could."""
    made = copy(data)
    for name, value in values.items():
        object.__setattr__(made, name, value)
    return made


SAME_UNIT = 1e-3
"""Noise of this share of the readings, or an rms of this share of the launches, is written in their
unit; a smaller one is in m already."""


def _of_unit(size: Array, of: Array, factor: Array | float) -> Array:
    """An rms that is scaled where it is written in the unit of what it belongs to."""
    typical = np.sqrt(np.nanmean(of**2)) if np.isfinite(of).any() else 0.0
    known = size[np.isfinite(size) & (size > 0)]
    same = bool(len(known)) and float(np.median(known)) >= SAME_UNIT * typical
    return size * factor if same else size


def _read(data: Data, change: Callable[[Array], Array]) -> Data:
    """With a change of everything that was read, [..., monitor, 2]."""
    if isinstance(data, Measurement):
        return _with(data, readings=change(data.readings))
    rf = data.rf
    if rf is not None and rf.orbit is not None:
        rf = replace(rf, orbit=change(rf.orbit))
    return _with(data, response=change(data.response), rf=rf)


def _values(data: Measurement | OrbitResponse) -> Array:
    return data.readings if isinstance(data, Measurement) else data.response


def _sign(data: Data, x: float, y: float) -> Data:
    return _read(data, lambda values: values * np.array([x, y]))


def _unit(data: Data, factor: float) -> Data:
    scaled = _read(data, lambda values: values * factor)
    if data.noise is None:
        return scaled
    return _with(scaled, noise=_of_unit(data.noise, _values(data), factor))


def _exchanged(data: Data) -> Data:
    noise = None if data.noise is None else data.noise[:, ::-1]
    return _with(_read(data, lambda values: values[..., ::-1]), noise=noise)


def _reordered(data: Data, order: Callable[[Sequence[str]], Order]) -> Data:
    """The readings of the monitor i are those that stand at order[i]."""
    at = order(data.monitors)
    noise = None if data.noise is None else data.noise[at]
    return _with(_read(data, lambda values: values[..., at, :]), noise=noise)


def _shift(monitors: Sequence[str], by: int) -> Order:
    return np.roll(np.arange(len(monitors)), -by)


def _reverse(monitors: Sequence[str]) -> Order:
    return np.arange(len(monitors))[::-1]


def _alphabet(monitors: Sequence[str]) -> Order:
    """The readings stand in the order of the sorted names."""
    ranks = np.empty(len(monitors), dtype=np.intp)
    ranks[np.argsort(np.array([name.casefold() for name in monitors]), kind="stable")] = np.arange(
        len(monitors)
    )
    return ranks


def _no_noise(data: Measurement) -> Measurement:
    return _with(data, noise=None)


# --- launches, settings, turns --------------------------------------------------------------------
def _launches(data: Measurement, *factor: float) -> Measurement:
    """x, px, y, py, and delta where it is named, in another unit or of another sign."""
    scale = np.array([*factor, 1.0])[:5]
    sigma = data.launch_sigma
    if sigma is not None:
        sigma = sigma.copy()
        for i in np.flatnonzero(np.abs(scale) != 1):
            sigma[:, i] = _of_unit(sigma[:, i], data.launches[:, i], abs(scale[i]))
    return _with(data, launches=data.launches * scale, launch_sigma=sigma)


def _launches_exchanged(data: Measurement) -> Measurement:
    order = [2, 3, 0, 1, 4]
    sigma = None if data.launch_sigma is None else data.launch_sigma[:, order]
    return _with(data, launches=data.launches[:, order], launch_sigma=sigma)


def _no_launches(data: Measurement) -> Measurement:
    sigma = np.full(data.launches.shape, np.inf)
    sigma[:, 4] = 0.0 if data.launch_sigma is None else data.launch_sigma[:, 4]
    return _with(data, launch_sigma=sigma)


def _kicks_set(data: Measurement, factor: float) -> Measurement:
    """All kicks that were set in the shots."""
    changed = tuple(
        {
            name: {key: value * (factor if key == "kick" else 1) for key, value in own.items()}
            for name, own in shot.items()
        }
        for shot in data.settings
    )
    return _with(data, settings=changed)


def _earlier(data: Measurement) -> Measurement:
    """Turns one earlier; nothing was read on turn 0."""
    if data.readings.shape[1] < 2 or np.isfinite(data.readings[:, 0]).any():
        raise MeasurementError(
            "turns are stated to count from 1, but there are readings of turn 0, or of no other; "
            "leave 'turns-from-1' out"
        )
    return _with(data, readings=data.readings[:, 1:])


def _backwards(data: Measurement) -> Measurement:
    """The last turn first, and the launch free: what was the launch is where the beam ends."""
    free = _no_launches(_with(data, launches=data.launches * [0, 0, 0, 0, 1]))
    return _with(free, readings=data.readings[:, ::-1])


# --- an orbit response ----------------------------------------------------------------------------
def _kicks(data: OrbitResponse, x: float, y: float) -> OrbitResponse:
    factor = np.array([x if plane == "x" else y for plane in data.planes])
    return _with(data, kicks=data.kicks * factor)


def _columns_shifted(data: OrbitResponse, by: int) -> OrbitResponse:
    """The columns of each plane, in their order, belong to the corrector `by` places on."""
    order = np.arange(len(data.planes))
    for plane in ("x", "y"):
        own = np.flatnonzero(np.array(data.planes) == plane)
        order[own] = np.roll(own, -by)
    return _with(data, response=data.response[order])


def _rf(data: OrbitResponse, factor: float) -> OrbitResponse:
    if data.rf is None:
        raise MeasurementError("there is no RF step of which anything could be assumed")
    return _with(data, rf=replace(data.rf, step=data.rf.step * factor))


# --- the list -------------------------------------------------------------------------------------
def _both(words: str, correction: str, change: Callable[..., Any], *values: Any) -> Assumption:
    """Of readings, whatever they are."""
    return Assumption(words, correction, *[lambda data: change(data, *values)] * 2)


def _first(
    words: str, correction: str, change: Callable[..., Measurement], *values: float
) -> Assumption:
    return Assumption(words, correction, lambda data: change(data, *values))


def _columns(
    words: str, correction: str, change: Callable[..., OrbitResponse], *values: float
) -> Assumption:
    return Assumption(words, correction, None, lambda data: change(data, *values))


def _shifts() -> dict[str, Assumption]:
    found = {}
    for by in (1, -1, 2, -2, 3, -3):
        count = f"{abs(by)} place{'s' * (abs(by) > 1)} {'down' if by > 0 else 'up'}stream"
        found[f"monitors-shifted={by}"] = _both(
            f"the names of the monitors are shifted: what was read stands {count} of its monitor",
            "give each reading its own monitor's name",
            _reordered, partial(_shift, by=by),
        )  # fmt: skip
    return found


SIGN = "change the sign of {}"
UNIT = "give {} in {}"

ASSUMPTIONS: dict[str, Assumption] = {
    "x-reversed": _both("x has the wrong sign at every monitor", SIGN.format("x"), _sign, -1, 1),
    "y-reversed": _both("y has the wrong sign at every monitor", SIGN.format("y"), _sign, 1, -1),
    "readings-reversed": _both(
        "x and y have the wrong sign at every monitor", SIGN.format("x and y"), _sign, -1, -1
    ),
    "planes-exchanged": _both(
        "x and y are exchanged at every monitor", "exchange the columns x and y", _exchanged
    ),
    "readings-in-mm": _both("the readings are in mm", UNIT.format("them", "m"), _unit, 1e-3),
    "readings-in-um": _both("the readings are in µm", UNIT.format("them", "m"), _unit, 1e-6),
    "readings-in-km": _both(
        "the readings are a thousand times too small", UNIT.format("them", "m"), _unit, 1e3
    ),
    "readings-doubled": _both(
        "the readings are twice what they should be", "halve them", _unit, 0.5
    ),
    "readings-halved": _both(
        "the readings are half of what they should be", "double them", _unit, 2.0
    ),
    **_shifts(),
    "monitors-backwards": _both(
        "the monitors stand in the reverse order", "give each reading its own monitor's name",
        _reordered, _reverse,
    ),
    "monitors-alphabetical": _both(
        "the readings stand in the order of the sorted names", "give each reading its own "
        "monitor's name", _reordered, _alphabet,
    ),
    "beam-backwards": _first(
        "the beam runs against the lattice, from its end to its start",
        "reverse the lattice, or start it where the beam is launched", _backwards,
    ),
    "turns-from-1": _first(
        "turns are counted from 1", "count them from 0: turn 0 is the first", _earlier
    ),
    "launches-reversed": _first(
        "the launches have the wrong sign", SIGN.format("x, px, y and py of every launch"),
        _launches, -1, -1, -1, -1,
    ),
    "launches-x-reversed": _first(
        "the launches have the wrong sign in x and px", SIGN.format("x and px of every launch"),
        _launches, -1, -1, 1, 1,
    ),
    "launches-y-reversed": _first(
        "the launches have the wrong sign in y and py", SIGN.format("y and py of every launch"),
        _launches, 1, 1, -1, -1,
    ),
    "slopes-reversed": _first(
        "px and py of the launches have the wrong sign", SIGN.format("px and py of every launch"),
        _launches, 1, -1, 1, -1,
    ),
    "slopes-x-reversed": _first(
        "px of the launches has the wrong sign", SIGN.format("px of every launch"),
        _launches, 1, -1, 1, 1,
    ),
    "slopes-y-reversed": _first(
        "py of the launches has the wrong sign", SIGN.format("py of every launch"),
        _launches, 1, 1, 1, -1,
    ),
    "launches-exchanged": _first(
        "x, px and y, py of the launches are exchanged", "exchange them", _launches_exchanged
    ),
    "launches-in-mm": _first(
        "the launches are in mm and mrad", UNIT.format("them", "m and rad"),
        _launches, 1e-3, 1e-3, 1e-3, 1e-3,
    ),
    "launches-in-um": _first(
        "the launches are in µm and µrad", UNIT.format("them", "m and rad"),
        _launches, 1e-6, 1e-6, 1e-6, 1e-6,
    ),
    "positions-in-mm": _first(
        "x and y of the launches are in mm", UNIT.format("them", "m"), _launches, 1e-3, 1, 1e-3, 1
    ),
    "slopes-in-mrad": _first(
        "px and py of the launches are in mrad", UNIT.format("them", "rad"),
        _launches, 1, 1e-3, 1, 1e-3,
    ),
    "energies-reversed": _first(
        "delta of the launches has the wrong sign", SIGN.format("delta of every launch"),
        _launches, 1, 1, 1, 1, -1,
    ),
    "energies-in-percent": _first(
        "delta of the launches is in per cent", "divide it by 100", _launches, 1, 1, 1, 1, 0.01
    ),
    "launches-unknown": _first(
        "the launches are not what is stated", "correct them, or their launch_sigma", _no_launches
    ),
    "settings-reversed": _first(
        "the kicks in the shots' settings have the wrong sign", SIGN.format("all of them"),
        _kicks_set, -1,
    ),
    "settings-in-mrad": _first(
        "the kicks in the shots' settings are in mrad", UNIT.format("them", "rad"),
        _kicks_set, 1e-3,
    ),
    "settings-not-there": _first(
        "the kicks in the shots' settings were not there", "take them out", _kicks_set, 0
    ),
    "noise-from-data": _first(
        "the stated noise is not that of the readings", "leave it out", _no_noise
    ),
    "kicks-reversed": _columns(
        "the kicks have the wrong sign", SIGN.format("all of them"), _kicks, -1, -1
    ),
    "kicks-x-reversed": _columns(
        "the horizontal kicks have the wrong sign", SIGN.format("them"), _kicks, -1, 1
    ),
    "kicks-y-reversed": _columns(
        "the vertical kicks have the wrong sign", SIGN.format("them"), _kicks, 1, -1
    ),
    "kicks-in-mrad": _columns("the kicks are in mrad", UNIT.format("them", "rad"),
                              _kicks, 1e-3, 1e-3),
    "kicks-in-urad": _columns("the kicks are in µrad", UNIT.format("them", "rad"),
                              _kicks, 1e-6, 1e-6),
    "kicks-in-krad": _columns(
        "the kicks are a thousand times too small", UNIT.format("them", "rad"), _kicks, 1e3, 1e3
    ),
    "kicks-doubled": _columns(
        "the kicks are half of those that were made", "give the whole step, from one side to the "
        "other", _kicks, 2, 2,
    ),
    "kicks-halved": _columns(
        "the kicks are twice those that were made", "give the step that the orbit change belongs "
        "to", _kicks, 0.5, 0.5,
    ),
    "correctors-shifted=1": _columns(
        "the columns of each plane stand one corrector too late", "give each its own corrector's "
        "name", _columns_shifted, 1,
    ),
    "correctors-shifted=-1": _columns(
        "the columns of each plane stand one corrector too early", "give each its own corrector's "
        "name", _columns_shifted, -1,
    ),
    "rf-reversed": _columns(
        "the RF's step has the wrong sign", SIGN.format("step_hz"), _rf, -1
    ),
    "rf-doubled": _columns("the RF's step is half of the one that was made", "give the whole step",
                           _rf, 2),
    "rf-halved": _columns("the RF's step is twice the one that was made", "give the step that the "
                          "orbit change belongs to", _rf, 0.5),
}  # fmt: skip
"""What may be assumed, by name."""
