"""Names of monitors and correctors, and the noise of the readings, monitor by monitor.

Matching ignores case, and `name::0` stands for a name that stands once.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tmlattice.errors import MeasurementError, unknown_name

Array = NDArray[np.float64]

LARGEST_NOISE, SMALLEST_NOISE = 1.0, 1e-15
"""m; what is beyond is no noise of a reading in metres."""
HIGHEST_ENERGY = 1e6
"""GeV; above every ring's: an energy in eV is one."""


class Names:
    """Places by name.

    Args:
        kind: what they are names of, for the errors.
        names: each once.

    Raises:
        MeasurementError: an empty name, one with a line break, or the same name twice.
    """

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


def merge_spellings(spellings: Sequence[str]) -> tuple[tuple[str, ...], NDArray[np.int64]]:
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
        monitors: their names.

    Returns:
        [monitor, 2], m, NaN where unknown; None where nothing is.

    Raises:
        MeasurementError: not positive, or of another shape.
        UnknownNameError: a monitor of the mapping that is not among the names.
    """
    if noise is None:
        return None
    table = np.full((len(monitors), 2), np.nan)
    names = Names("monitor", monitors)
    try:
        if isinstance(noise, Mapping):
            for name, pair in noise.items():
                table[names[name]] = pair
        else:
            table[:] = np.asarray(noise, dtype=float)
    except (TypeError, ValueError):
        raise MeasurementError(
            "the noise is neither a pair (x, y) in m nor one such pair a monitor"
        ) from None
    if (table > LARGEST_NOISE).any() or ((table > 0) & (table < SMALLEST_NOISE)).any():
        low, high = np.nanmin(table), np.nanmax(table)
        raise MeasurementError(
            f"the noise is stated as {low:g} to {high:g} m, which no monitor has; it is the rms of "
            "one reading in metres"
        )
    wrong = ~(np.isnan(table) | ((table > 0) & np.isfinite(table)))
    if wrong.any():
        place, plane = (int(i) for i in np.argwhere(wrong)[0])
        raise MeasurementError(
            f"the noise of monitor '{monitors[place]}' in {'xy'[plane]} is "
            f"{table[place, plane]:g} m; it is an rms: above zero, or absent where unknown"
        )
    return None if np.isnan(table).all() else table
