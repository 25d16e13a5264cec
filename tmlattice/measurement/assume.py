"""Measurements as they would be if something had been written down wrongly: `--assume NAME`.

>>> assume(measurement, ["x-reversed", "launches-in-mm"])

Each assumption is a wrong sign, unit, order or name that the data may have everywhere, and its
correction for the kinds of measurement where it has a meaning. The data checks try them all; a user
goes on with those that he has confirmed.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from tmlattice.arrays import Array
from tmlattice.errors import MeasurementError, unknown_name
from tmlattice.measurement.dispersion import Dispersion
from tmlattice.measurement.monitors import Names
from tmlattice.measurement.orbit_response import OrbitResponse
from tmlattice.measurement.shots import ClosedOrbit, TurnByTurn
from tmlattice.measurement.trajectory import Measurement
from tmlattice.measurement.tune_reading import TuneReading

Order = NDArray[np.intp]
Data = TypeVar("Data")
WORDS: Mapping[type, str] = {
    Measurement: "first turns",
    OrbitResponse: "an orbit response",
    TurnByTurn: "a turn-by-turn measurement",
    ClosedOrbit: "a closed orbit",
    Dispersion: "a dispersion measurement",
    TuneReading: "a tune measurement",
}
"""What each kind of measurement is, for a sentence."""


@dataclass(frozen=True)
class Assumption:
    """Something that was written down wrongly everywhere.

    Attributes:
        words: what is wrong, a clause.
        correction: what to do about it in the data, an order.
        kinds: of measurements where it has a meaning.
        change: corrects it in one of these.
    """

    words: str
    correction: str
    kinds: tuple[type, ...]
    change: Callable[[Any], Any]


def assume(data: Data, names: Iterable[str], ring_monitors: Sequence[str]) -> Data:
    """The data with what is assumed undone, one after another.

    Args:
        ring_monitors: names of the ring's monitors, in beam order.

    Raises:
        UnknownNameError: no such assumption, or a monitor that the ring does not have.
        MeasurementError: one without meaning for these data, or one that is named twice.
    """
    names = list(names)
    if twice := [name for name in names if names.count(name) > 1]:
        raise MeasurementError(f"the assumption '{twice[0]}' is named twice; name it once")
    if names:
        data = in_beam_order(data, ring_monitors)
    for name in names:
        known = ASSUMPTIONS.get(name)
        if known is None:
            raise unknown_name("assumption", name, ASSUMPTIONS)
        if not isinstance(data, known.kinds):
            raise MeasurementError(
                f"the assumption '{name}' has no meaning for {WORDS[type(data)]}"
            )
        data = known.change(data)
    return data


def in_beam_order(data: Data, ring_monitors: Sequence[str]) -> Data:
    """The data with their monitors in the order in which the beam meets them.

    Raises:
        UnknownNameError: a monitor that the ring does not have.
    """
    own: Any = data
    if isinstance(data, TuneReading) or own.monitors == tuple(ring_monitors):
        return data
    names = Names("BPM", ring_monitors)
    at = [names[name] for name in own.monitors]
    if at == sorted(at):
        return data
    return own.select(monitors=[own.monitors[i] for i in np.argsort(at)])  # type: ignore[no-any-return]


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


def is_unit(name: str) -> bool:
    """Whether an assumption is about a unit."""
    return "-in-" in name


def read_of(data: Any) -> Array:
    """What the monitors read, m, [..., monitor, 2]: readings, orbits, or orbit changes."""
    if isinstance(data, OrbitResponse):
        return data.response
    return data.orbits if isinstance(data, Dispersion) else np.asarray(getattr(data, data.READ))


def with_read(data: Any, change: Callable[[Array], Array]) -> Any:
    """Return the data with a change of everything that was read, [..., monitor, 2]."""
    return _with(data, **data.read_with(change))


def _sign(data: Any, x: float, y: float) -> Any:
    return with_read(data, lambda values: values * np.array([x, y]))


def _unit(data: Any, factor: float) -> Any:
    scaled = with_read(data, lambda values: values * factor)
    if data.noise is None:
        return scaled
    return _with(scaled, noise=_of_unit(data.noise, read_of(data), factor))


def _exchanged(data: Any) -> Any:
    if isinstance(data, TuneReading):
        return _with(data, **{
            name: None if values is None else values[:, ::-1]
            for name, values in vars(data).items() if name.startswith(("tune", "chromaticity"))
        })  # fmt: skip
    noise = None if data.noise is None else data.noise[:, ::-1]
    return _with(with_read(data, lambda values: values[..., ::-1]), noise=noise)


def _reordered(
    data: Any, order: Callable[[Sequence[str]], Order], planes: tuple[bool, bool] = (True, True)
) -> Any:
    """The readings of the monitor i in these planes are those that stand at order[i]."""
    at = order(data.monitors)

    def change(values: Array) -> Array:
        return np.where(planes, values[..., at, :], values)

    noise = None if data.noise is None else change(data.noise)
    return _with(with_read(data, change), noise=noise)


def _shift(monitors: Sequence[str], by: int) -> Order:
    return np.roll(np.arange(len(monitors)), -by)


def _reverse(monitors: Sequence[str]) -> Order:
    return np.arange(len(monitors))[::-1]


def _alphabet(monitors: Sequence[str]) -> Order:
    """The readings stand in the order of the sorted names."""
    names = np.array([name.casefold() for name in monitors])
    return np.argsort(np.argsort(names, kind="stable"))


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


def _kicks_set(data: Any, factor: float) -> Any:
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


def _rf(data: Any, factor: float) -> Any:
    if isinstance(data, Dispersion):
        return _with(data, steps=tuple(replace(s, step=s.step * factor) for s in data.steps))
    if data.rf is None:
        raise MeasurementError("there is no RF step of which anything could be assumed")
    return _with(data, rf=replace(data.rf, step=data.rf.step * factor))


def _rf_orbit(data: OrbitResponse, factor: float) -> OrbitResponse:
    if data.rf is None or data.rf.orbit is None:
        raise MeasurementError("there is no RF orbit of which anything could be assumed")
    return _with(data, rf=replace(data.rf, orbit=data.rf.orbit * factor))


# --- turns and tunes of a stored beam ------------------------------------------------------------
def _last_first(data: TurnByTurn) -> TurnByTurn:
    return _with(data, readings=data.readings[:, ::-1])


def _folded(data: TuneReading, x: bool, y: bool) -> TuneReading:
    return _with(data, tune=np.where([x, y], (1 - data.tune) % 1, data.tune))


# --- the list -------------------------------------------------------------------------------------
_FIRST, _RESPONSE = (Measurement,), (OrbitResponse,)
_CHANGES = (OrbitResponse, ClosedOrbit, Dispersion)
"""Compared with the design's as orbits: sign and size are known."""
_ORBITS = (*_FIRST, *_CHANGES)
_READ = (*_ORBITS, TurnByTurn)


SIGN = "change the sign of {}"
UNIT = "give {} in {}"
NAMES = "give each reading its own BPM's name"
STEP = "give the step that the orbit change belongs to"

_Row = tuple[Any, ...]


def _shifts() -> Iterator[_Row]:
    for by in (1, -1, 2, -2, 3, -3):
        count = f"{abs(by)} place{'s' * (abs(by) > 1)} {'down' if by > 0 else 'up'}stream"
        words = f"the names of the BPMs are shifted: what was read stands {count} of its BPM"
        yield f"monitors-shifted={by}", _READ, words, NAMES, _reordered, partial(_shift, by=by)
        for plane, of in (("x", (True, False)), ("y", (False, True))):
            if abs(by) == 1:
                yield (f"{plane}-shifted={by}", _READ, f"in {plane} {words}", NAMES, _reordered,
                       partial(_shift, by=by), of)  # fmt: skip


def _folds() -> Iterator[_Row]:
    for name, words, what, x, y in (
        ("-x", "Qx is 1 - Qx", "1 - Qx", True, False),
        ("-y", "Qy is 1 - Qy", "1 - Qy", False, True),
        ("s", "both tunes are 1 - Q", "1 - Q", True, True),
    ):
        correction = f"give {what}: a spectrum does not separate Q from 1 - Q"
        yield f"tune{name}-folded", (TuneReading,), words, correction, _folded, x, y


_TABLE: tuple[_Row, ...] = (
    ("x-reversed", _ORBITS, "x has the wrong sign at every BPM", SIGN.format("x"), _sign, -1, 1),
    ("y-reversed", _ORBITS, "y has the wrong sign at every BPM", SIGN.format("y"), _sign, 1, -1),
    ("readings-reversed", _ORBITS, "x and y have the wrong sign at every BPM",
     SIGN.format("x and y"), _sign, -1, -1),
    ("planes-swapped", (*_READ, TuneReading), "x and y are swapped everywhere",
     "swap x and y", _exchanged),
    *((f"readings-in-{unit}", kinds, f"the readings are {words}", UNIT.format("them", "m"), _unit,
       factor) for unit, kinds, words, factor in (
        ("mm", _ORBITS, "in mm", 1e-3), ("um", _ORBITS, "in µm", 1e-6),
        ("nm", _ORBITS, "in nm", 1e-9), ("cm", _ORBITS, "in cm", 1e-2),
        ("inches", _ORBITS, "in inches", 0.0254),
        ("km", _ORBITS, "a thousand times too small", 1e3),
        ("Mm", _CHANGES, "a million times too small", 1e6),
    )),
    ("readings-doubled", (*_FIRST, *_RESPONSE), "the readings are twice what they should be",
     "halve them", _unit, 0.5),
    ("readings-halved", (*_FIRST, *_RESPONSE), "the readings are half of what they should be",
     "double them", _unit, 2.0),
    *_shifts(),
    ("monitors-backwards", _READ, "the BPMs stand in the reverse order",
     NAMES, _reordered, _reverse),
    ("monitors-alphabetical", _READ, "the readings stand in the order of the sorted names",
     NAMES, _reordered, _alphabet),
    ("beam-backwards", _FIRST, "the beam runs against the lattice, from its end to its start",
     "reverse the lattice, or start it where the beam is launched", _backwards),
    ("turns-from-1", _FIRST, "turns are counted from 1", "count them from 0: turn 0 is the first",
     _earlier),
    ("launches-reversed", _FIRST, "the launches have the wrong sign",
     SIGN.format("x, px, y and py of every launch"), _launches, -1, -1, -1, -1),
    ("launches-x-reversed", _FIRST, "the launches have the wrong sign in x and px",
     SIGN.format("x and px of every launch"), _launches, -1, -1, 1, 1),
    ("launches-y-reversed", _FIRST, "the launches have the wrong sign in y and py",
     SIGN.format("y and py of every launch"), _launches, 1, 1, -1, -1),
    ("slopes-reversed", _FIRST, "px and py of the launches have the wrong sign",
     SIGN.format("px and py of every launch"), _launches, 1, -1, 1, -1),
    ("slopes-x-reversed", _FIRST, "px of the launches has the wrong sign",
     SIGN.format("px of every launch"), _launches, 1, -1, 1, 1),
    ("slopes-y-reversed", _FIRST, "py of the launches has the wrong sign",
     SIGN.format("py of every launch"), _launches, 1, 1, 1, -1),
    ("launches-swapped", _FIRST, "x, px and y, py of the launches are swapped", "swap them",
     _launches_exchanged),
    ("launches-in-mm", _FIRST, "the launches are in mm and mrad", UNIT.format("them", "m and rad"),
     _launches, 1e-3, 1e-3, 1e-3, 1e-3),
    ("launches-in-um", _FIRST, "the launches are in µm and µrad", UNIT.format("them", "m and rad"),
     _launches, 1e-6, 1e-6, 1e-6, 1e-6),
    ("positions-in-mm", _FIRST, "x and y of the launches are in mm", UNIT.format("them", "m"),
     _launches, 1e-3, 1, 1e-3, 1),
    ("slopes-in-mrad", _FIRST, "px and py of the launches are in mrad", UNIT.format("them", "rad"),
     _launches, 1, 1e-3, 1, 1e-3),
    ("energies-reversed", _FIRST, "delta of the launches has the wrong sign",
     SIGN.format("delta of every launch"), _launches, 1, 1, 1, 1, -1),
    ("energies-in-percent", _FIRST, "delta of the launches is in per cent", "divide it by 100",
     _launches, 1, 1, 1, 1, 0.01),
    ("launches-unknown", _FIRST, "the launches are not what is stated",
     "correct them, or their launch_sigma", _no_launches),
    ("settings-reversed", (Measurement, ClosedOrbit),
     "the kicks in the shots' settings have the wrong sign", SIGN.format("all of them"), _kicks_set,
     -1),
    ("settings-in-mrad", (Measurement, ClosedOrbit), "the kicks in the shots' settings are in mrad",
     UNIT.format("them", "rad"), _kicks_set, 1e-3),
    ("settings-doubled", _FIRST,
     "the kicks in the shots' settings are half of those that were made", "double them",
     _kicks_set, 2),
    ("settings-halved", _FIRST, "the kicks in the shots' settings are twice those that were made",
     "halve them", _kicks_set, 0.5),
    ("settings-not-there", _FIRST, "the kicks in the shots' settings were not there",
     "take them out", _kicks_set, 0),
    ("noise-from-data", _FIRST, "the stated noise is not that of the readings", "leave it out",
     partial(_with, noise=None)),
    ("kicks-reversed", _RESPONSE, "the kicks have the wrong sign", SIGN.format("all of them"),
     _kicks, -1, -1),
    ("kicks-x-reversed", _RESPONSE, "the horizontal kicks have the wrong sign", SIGN.format("them"),
     _kicks, -1, 1),
    ("kicks-y-reversed", _RESPONSE, "the vertical kicks have the wrong sign", SIGN.format("them"),
     _kicks, 1, -1),
    ("kicks-in-mrad", _RESPONSE, "the kicks are in mrad", UNIT.format("them", "rad"), _kicks, 1e-3,
     1e-3),
    ("kicks-in-urad", _RESPONSE, "the kicks are in µrad", UNIT.format("them", "rad"), _kicks, 1e-6,
     1e-6),
    ("kicks-in-krad", _RESPONSE, "the kicks are a thousand times too small",
     UNIT.format("them", "rad"), _kicks, 1e3, 1e3),
    ("kicks-doubled", _RESPONSE, "the kicks are half of those that were made",
     "give the whole step, from one side to the other", _kicks, 2, 2),
    ("kicks-halved", _RESPONSE, "the kicks are twice those that were made",
     STEP, _kicks, 0.5, 0.5),
    ("correctors-shifted=1", _RESPONSE, "the columns of each plane stand one corrector too late",
     "give each its own corrector's name", _columns_shifted, 1),
    ("correctors-shifted=-1", _RESPONSE, "the columns of each plane stand one corrector too early",
     "give each its own corrector's name", _columns_shifted, -1),
    ("rf-reversed", (OrbitResponse, Dispersion), "the RF's step has the wrong sign",
     SIGN.format("step_hz"), _rf, -1),
    ("rf-doubled", (OrbitResponse, Dispersion), "the RF's step is half of the one that was made",
     "give the whole step", _rf, 2),
    ("rf-halved", (OrbitResponse, Dispersion), "the RF's step is twice the one that was made",
     STEP, _rf, 0.5),
    ("rf-in-mm", _RESPONSE, "the RF's orbit is in mm", UNIT.format("it", "m"), _rf_orbit, 1e-3),
    ("rf-in-km", _RESPONSE, "the RF's orbit is a thousand times too small", UNIT.format("it", "m"),
     _rf_orbit, 1e3),
    ("turns-backwards", (TurnByTurn,), "the turns are numbered backwards",
     "number them from the kick on", _last_first),
    *_folds(),
)  # fmt: skip
"""Name, kinds, words, correction, the change and its values."""


def _of(
    kinds: tuple[type, ...], words: str, correction: str, change: Callable[..., Any], *values: Any
) -> Assumption:
    return Assumption(words, correction, kinds, lambda data: change(data, *values))


ASSUMPTIONS = {name: _of(*row) for name, *row in _TABLE}
"""What may be assumed, by name."""
