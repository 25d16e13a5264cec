"""Names of monitors and correctors, noise by monitor, and the checks that records share.

Matching ignores case, and `name::0` stands for a name that stands once.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from tmlattice.arrays import Array, Indices
from tmlattice.errors import MeasurementError, first_of, unknown_name
from tmlattice.measurement.arrays import METRES

Settings = Mapping[str, Mapping[str, float]]

SETTINGS = ("kick", "k1_relative", "k2_relative", "frequency_relative")
"""What may be changed on purpose: rad, relative strengths, and the RF's relative frequency."""

LARGEST_READING = 0.2
"""m: more than any beam pipe has, less than any reading in mm that is worth a fit. Readers reject
more; a record of Python holds it in any unit, for the data checks to name that."""
IN_ANY_UNIT = LARGEST_READING / min(METRES.values())
LARGEST_NOISE, SMALLEST_NOISE = 1.0, 1e-15
"""m; what is beyond is no noise of a reading in metres."""
HIGHEST_ENERGY = 1e6
"""GeV; above every ring's: an energy in eV is one."""


class Names:
    """Places by name; MeasurementError: an empty name, one with a line break, or the same name
    twice."""

    def __init__(self, kind: str, names: Iterable[str]) -> None:
        self.kind = kind
        self.names = tuple(names)
        self._place: dict[str, int] = {}
        for i, name in enumerate(self.names):
            if not name or name != name.strip() or not name.isprintable():
                raise MeasurementError(
                    f"{name!r} is no name of a {kind}; it has characters that print, and no "
                    "space at its ends"
                )
            if self._place.setdefault(name.casefold(), i) != i:
                raise MeasurementError(f"{kind} '{name}' stands twice; name each {kind} once")
        for i, name in enumerate(self.names):
            other = self._place.setdefault(f"{name.casefold()}::0", i)
            if other != i:
                raise MeasurementError(
                    f"{kind} '{name}' stands twice, once as '{self.names[other]}'; "
                    f"name each {kind} once"
                )

    def find(self, name: str) -> int | None:
        """The place of a name, or None."""
        return self._place.get(name.strip().casefold())

    def __getitem__(self, name: str) -> int:
        place = self.find(name)
        if place is None:
            raise unknown_name(self.kind, name, self.names)
        return place


def merge_spellings(spellings: Sequence[str]) -> tuple[tuple[str, ...], Indices]:
    """Names that differ in case alone, or in `::0` after the bare name, become one.

    Returns:
        The names, in order of first appearance and in their first spelling, and for each
        spelling the place of its name.
    """
    keys = [name.strip().casefold() for name in spellings]
    bare = set(keys)
    keys = [k[:-3] if k.endswith("::0") and k[:-3] in bare else k for k in keys]
    first: dict[str, str] = {}
    for key, spelling in zip(keys, spellings, strict=True):
        first.setdefault(key, spelling.strip())
    place = {key: i for i, key in enumerate(first)}
    return tuple(first.values()), np.array([place[k] for k in keys], dtype=np.int64)


def noise_table(noise: Any, monitors: Sequence[str]) -> Array | None:
    """The rms of one reading, for each monitor and plane.

    Args:
        noise: a pair (x, y) for all monitors, an array [monitor, 2], a mapping of pairs by
            monitor, or None; m, NaN where unknown.

    Returns:
        [monitor, 2], m, NaN where unknown; None where nothing is.

    Raises:
        MeasurementError: not positive, or of another shape.
        UnknownNameError: a monitor of the mapping that is not among the names.
    """
    if noise is None:
        return None
    table = np.full((len(monitors), 2), np.nan)
    names = Names("BPM", monitors)
    try:
        if isinstance(noise, Mapping):
            for name, pair in noise.items():
                table[names[name]] = pair
        else:
            table[:] = np.asarray(noise, dtype=float)
    except (TypeError, ValueError):
        raise MeasurementError(
            "the noise is neither a pair (x, y) in m nor one such pair a BPM"
        ) from None
    if (table > LARGEST_NOISE).any() or ((table > 0) & (table < SMALLEST_NOISE)).any():
        low, high = np.nanmin(table), np.nanmax(table)
        raise MeasurementError(
            f"the noise is stated as {low:g} to {high:g} m, which no BPM has; it is the rms of "
            "one reading in metres"
        )
    wrong = ~(np.isnan(table) | ((table > 0) & np.isfinite(table)))
    if wrong.any():
        place, plane = (int(i) for i in np.argwhere(wrong)[0])
        raise MeasurementError(
            f"the noise of BPM '{monitors[place]}' in {'xy'[plane]} is "
            f"{table[place, plane]:g} m; it is an rms: above zero, or absent where unknown"
        )
    return None if np.isnan(table).all() else table


# --- what records have in common ------------------------------------------------------------------
def check_values(values: Array, one: str) -> None:
    """All are of a beam in some unit, one at least is there; MeasurementError: "a reading is
    infinite", where `one` is "reading"."""
    large = np.abs(values) > IN_ANY_UNIT
    if large.any():
        article = "an" if one[0] in "aeiou" else "a"
        size = "infinite" if np.isinf(values).any() else f"{values[large][0]:g} m"
        raise MeasurementError(f"{article} {one} is {size}; a missing one is NaN")
    if not np.isfinite(values).any():
        raise MeasurementError(f"every {one} is missing; nothing can be fitted")


def check_size(readings: Array, monitors: Sequence[str]) -> None:
    """Readings [..., monitor, 2] are such that a reader takes them; MeasurementError: one above 0.2
    m."""
    large = np.abs(readings) > LARGEST_READING  # false for NaN
    if large.any():
        *_, monitor, plane = np.argwhere(large)[0]
        raise MeasurementError(
            f"BPM '{monitors[monitor]}' reads {readings[large][0]:g} m in {'xy'[plane]}, above "
            f"{LARGEST_READING} m, which no reader takes; readings are in metres"
        )


def check_energy(energy: float | None) -> None:
    """Raises a MeasurementError for an energy that is not above zero, GeV."""
    if energy is not None and not 0 < energy < HIGHEST_ENERGY:
        raise MeasurementError(
            f"an energy of {energy:g} GeV cannot be; it is above zero, and in GeV"
        )


def check_settings(shot: int, settings: Settings) -> None:
    """Settings of a shot are known, finite, and each element's own.

    Raises:
        MeasurementError: states which is not.
        UnknownNameError: a setting that no element has.
    """
    Names("element", settings)
    for element, changed in settings.items():
        for name, amount in changed.items():
            if name not in SETTINGS:
                raise unknown_name("setting", name, SETTINGS)
            if (name == "frequency_relative") != (element.casefold() == "rf"):
                raise MeasurementError(
                    f"shot {shot} sets '{name}' of '{element}'; frequency_relative belongs to "
                    "the name 'rf', and nothing else does"
                )
            if not abs(amount) < np.inf:
                raise MeasurementError(
                    f"shot {shot} sets '{name}' of '{element}' to {amount}; give a finite number"
                )


def checked_shots(
    shots: Sequence[int], settings: Sequence[Settings], number: int, what: str
) -> tuple[tuple[int, ...], tuple[Settings, ...]]:
    """Ids and settings of `number` shots of readings: 0, 1, ... where there are none; () for none.

    Raises:
        MeasurementError: not as many, an id twice, or settings that cannot be.
        UnknownNameError: a setting that no element has.
    """
    ids = tuple(int(i) for i in shots) or tuple(range(number))
    if len(ids) != number or len(set(ids)) != number:
        raise MeasurementError(f"{what} of {number} shots need {number} shot ids, each once")
    settings = tuple(settings)
    if settings and len(settings) != number:
        raise MeasurementError(f"{len(settings)} settings for {number} shots; one a shot")
    for shot, changed in zip(ids, settings, strict=False):
        check_settings(shot, changed)
    return ids, settings if any(settings) else ()


def shot_places(shots: Sequence[int], wanted: Sequence[int]) -> list[int]:
    """Where the wanted ids stand; MeasurementError: one that is not there."""
    index = {shot: i for i, shot in enumerate(shots)}
    missing = [shot for shot in wanted if shot not in index]
    if missing:
        raise MeasurementError(f"no shot {missing[0]}; there are {first_of(shots)}")
    return [index[shot] for shot in wanted]


def places_of(kind: str, known: Sequence[str], wanted: Sequence[str]) -> list[int]:
    """Where the wanted monitors, or correctors, stand among the known ones."""
    names = Names(kind, known)
    return [names[name] for name in wanted]
