"""Fields of measurement.json of every kind: format, kind, lattice, energy and noise."""

import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from tmlattice.arrays import Array
from tmlattice.errors import plain
from tmlattice.measurement.monitors import Names, noise_table

FORMAT = "tmlattice-measurement"


def header(kind: str, source: Any) -> dict[str, Any]:
    """What a document begins with; `source` has lattice, energy and mostly monitors, noise."""
    from tmlattice import __version__

    monitors = getattr(source, "monitors", ())
    stated: dict[str, Any] = {
        "format": FORMAT,
        "version": 1,
        "package": __version__,
        "kind": kind,
        "lattice": source.lattice,
        "energy_gev": None if source.energy is None else float(source.energy),
        "noise": _write_noise(getattr(source, "noise", None), monitors),
        "devices": dict(getattr(source, "devices", {})) or None,
    }
    return {key: value for key, value in stated.items() if value is not None}


def number(value: Any, missing: float) -> float:
    """A number of the document; null is what is not finite."""
    return missing if value is None else float(value)


def finite(value: float) -> float | None:
    """A number for the document; None for what is not finite."""
    return value if np.isfinite(value) else None


def read_noise(noise: Any, read: Sequence[str], known: Sequence[str] | None) -> Array | None:
    """[monitor, 2] of a pair or a table by monitor. A monitor without rows is passed over."""
    if noise is None:
        return None
    if not any(isinstance(entry, dict) for entry in noise.values()):
        return noise_table(_pair(noise), read)
    table = Names("BPM", noise)
    if known is not None:
        every = Names("BPM", known)
        for name in table.names:
            every[name]  # an UnknownNameError where the ring has no such monitor
    names = Names("BPM", read)
    there = {name: _pair(entry) for name, entry in noise.items() if names.find(name) is not None}
    unread = [name for name in table.names if names.find(name) is None]
    if unread and known is None:
        warnings.warn(
            f"the noise names {len(unread)} BPMs of which nothing was read, such as "
            f"'{plain(unread[0], 60)}'; correct the name where it should be another",
            stacklevel=2,
        )
    return noise_table(there, read)


def _pair(entry: Mapping[str, Any] | None) -> tuple[float, float]:
    entry = entry or {}
    return number(entry.get("x"), np.nan), number(entry.get("y"), np.nan)


def _write_noise(noise: Array | None, monitors: Sequence[str]) -> dict[str, Any] | None:
    if noise is None:
        return None

    def pair(row: Array) -> dict[str, float | None]:
        return {plane: finite(v) for plane, v in zip("xy", row.tolist(), strict=True)}

    if np.array_equal(noise, np.tile(noise[0], (len(noise), 1)), equal_nan=True):
        return pair(noise[0])
    return {monitor: pair(row) for monitor, row in zip(monitors, noise, strict=True)}
