"""What every measurement shows of itself."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import is_dataclass, replace
from typing import Any, Self

import numpy as np

from tmlattice.arrays import Array
from tmlattice.late import ClassMethod, Method
from tmlattice.measurement.monitors import places_of
from tmlattice.speaks import Speaks, counted, last_part


class Shown(Speaks):
    """A measurement's line, its table in a notebook, and its figure."""

    plot = Method(
        "tmlattice.plots.speaking",
        "plot_measurement",
        "Draw what was read: along `ring` where it is given (a Ring, a name or a path), else by "
        "the number of the BPM; a matplotlib Figure.",
    )

    to_dataframe = Method(
        "tmlattice.measurement.frames",
        "to_dataframe",
        "Return the table of the readings as a pandas DataFrame: a row a reading, in m.",
    )
    to_xarray = Method(
        "tmlattice.measurement.frames",
        "to_xarray",
        "Return the same as an xarray Dataset, with shots, turns, BPMs as its axes.",
    )
    from_dataframe = ClassMethod(
        "tmlattice.importers.frames",
        "from_frame",
        "Return the measurement of a pandas DataFrame, in long or wide form.",
    )
    from_xarray = ClassMethod(
        "tmlattice.importers.frames",
        "from_frame",
        "Return the measurement of an xarray Dataset or DataArray.",
    )

    def _keep(self, **values: Any) -> None:
        """Set fields of the frozen record, while it is being made."""
        for name, value in values.items():
            object.__setattr__(self, name, value)

    def __eq__(self, other: object) -> bool:
        """Whether both are of one kind and hold the same values; NaN equals NaN."""
        return type(self) is type(other) and same(vars(self), vars(other))

    def __hash__(self) -> int:
        names = (vars(self).get(name) for name in ("monitors", "shots", "correctors"))
        return hash((type(self).__name__, *names))

    def _told(self) -> tuple[str, dict[str, str]]:
        own: dict[str, Any] = vars(self)
        shots, monitors = own.get("shots"), own.get("monitors")
        rows = {"shots": "" if shots is None else str(len(shots))}
        if own.get("readings") is not None:
            rows["turns"] = str(own["readings"].shape[1])
        if own.get("correctors") is not None:
            rows["correctors"] = str(len(own["correctors"]))
        if own.get("steps") is not None:
            rows["steps"] = str(len(own["steps"]))
        rows["monitors"] = "" if monitors is None else str(len(monitors))
        values = next((own[n] for n in ("readings", "orbit", "response") if n in own), None)
        if values is not None:
            missing = int(np.isnan(values).sum())
            rows["rms"] = f"{1e6 * np.sqrt(np.nanmean(np.square(values))):.4g} µm"
            rows["missing"] = counted(missing, "number") if missing else ""
        if monitors is not None:
            rows["noise"] = _noise(own.get("noise"))
        if "launches" in own:
            sigma = own["launch_sigma"]
            known = sigma is not None and np.isfinite(sigma[:, :4]).all()
            rows["launches"] = "stated" if known else "unknown"
        if own.get("tune") is not None:
            pairs = (" ".join(f"{q:.5f}" for q in pair) for pair in own["tune"][:3])
            rows["tunes"] = "; ".join(pairs)
        rows["lattice"] = last_part(own.get("lattice") or "")
        return "", rows


class OfMonitors(Shown):
    """A measurement by monitors; `read_with` is its own."""

    def read_with(self, change: Callable[[Array], Array]) -> dict[str, Any]:
        """Return fields with a change of everything that was read, [..., monitor, 2]."""
        raise NotImplementedError

    def in_order_of(self, monitors: Sequence[str]) -> Self:
        """The same with other monitors, such as a ring's: NaN where one was not read.

        Raises:
            UnknownNameError: this measurement has a monitor that is not among them.
        """
        places = places_of("BPM", monitors, vars(self)["monitors"])

        def spread(values: Array) -> Array:
            full = np.full((*values.shape[:-2], len(monitors), 2), np.nan)
            full[..., places, :] = values
            return full

        return self._of(monitors, spread)

    def at_monitors(self, monitors: Sequence[str]) -> Self:
        """A part of the monitors, in the order asked for.

        Raises:
            UnknownNameError: one that is not there.
            MeasurementError: nothing is left.
        """
        known = vars(self)["monitors"]
        here = places_of("BPM", known, monitors)
        return self._of([known[i] for i in here], lambda values: values[..., here, :])

    def _of(self, monitors: Sequence[str], change: Callable[[Array], Array]) -> Self:
        own: Any = self
        noise = None if own.noise is None else change(own.noise)
        changed = {**self.read_with(change), "monitors": tuple(monitors), "noise": noise}
        return replace(own, **changed)  # type: ignore[no-any-return]


def same(one: Any, other: Any) -> bool:
    """Whether two values are equal, arrays and what holds them by their numbers."""
    if isinstance(one, np.ndarray) or isinstance(other, np.ndarray):
        return np.shape(one) == np.shape(other) and np.array_equal(one, other, equal_nan=True)
    if isinstance(one, Mapping) and isinstance(other, Mapping):
        return one.keys() == other.keys() and all(same(own, other[k]) for k, own in one.items())
    if isinstance(one, tuple | list) and isinstance(other, tuple | list):
        return len(one) == len(other) and all(map(same, one, other))
    if is_dataclass(one) and type(one) is type(other):
        return same(vars(one), vars(other))
    return bool(one == other)


def _noise(noise: Any) -> str:
    if noise is None or not np.isfinite(noise).any():
        return "unknown"
    x, y = (1e6 * np.sqrt(np.nanmean(np.square(plane))) for plane in np.asarray(noise).T)
    return f"{x:.3g} µm" if np.isclose(x, y) else f"{x:.3g} µm in x, {y:.3g} µm in y"
