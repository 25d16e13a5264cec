"""What an importer makes of files: a measurement, the lattice where they hold one, and words."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeGuard

import numpy as np

from tmlattice.arrays import Array
from tmlattice.errors import MeasurementError
from tmlattice.files import output_folder
from tmlattice.lattice import Ring, save_ring
from tmlattice.measurement import (
    AnyMeasurement,
    Measurement,
    OrbitResponse,
    TurnByTurn,
    in_words,
    write_measurement,
)
from tmlattice.measurement.shots import FEWEST, MOST
from tmlattice.measurement.trajectory import UNKNOWN_LAUNCH
from tmlattice.measurement.write import check_free


@dataclass(frozen=True)
class Imported:
    """A measurement as the package has it.

    Attributes:
        measurement: an orbit response, first turns, or turns of a stored beam; of a frame any.
        ring: the model that the files hold or that the caller named; None: neither.
        assumed: what the files do not prove: units, signs, steps; a sentence each.
        doubts: what the data contradict; a sentence each.
        unit: of readings, where it is taken from their size.
    """

    measurement: AnyMeasurement
    ring: Ring | None = None
    assumed: tuple[str, ...] = ()
    doubts: tuple[str, ...] = ()
    unit: str | None = None

    def saying(self, *sentences: str) -> "Imported":
        """The same with more that was assumed."""
        return replace(self, assumed=(*self.assumed, *sentences))


def numbers(value: Any, what: str, shape: Sequence[int] | None = None) -> Array:
    """Something of a file as an array of numbers, of a shape (None: any); `what` names it.

    Raises:
        MeasurementError: it holds no numbers, complex ones, or has another shape (dimensions of one
            do not count: files leave them out).
    """
    try:
        array = np.asarray(value)
        if array.dtype.kind == "c":
            raise MeasurementError(f"{what} holds complex numbers; correct it in the file")
        array = array.astype(float)
    except (TypeError, ValueError):
        raise MeasurementError(f"{what} holds no numbers; correct it in the file") from None
    if shape is not None:
        if [n for n in array.shape if n != 1] != [n for n in shape if n != 1]:
            raise MeasurementError(
                f"{what} has the shape {list(array.shape)}; it should be {list(shape)}"
            )
        array = array.reshape(tuple(shape))
    return array


def check_fields(content: Any, shape: Mapping[str, Any], place: str) -> None:
    """Whether the fields of a structure that are there have their types, by name `str`, `float`
    (numbers of any shape) or another shape; MeasurementError: another type, by the field's name in
    `place`."""
    if not isinstance(content, Mapping):
        raise MeasurementError(f"{place} should be a structure with {', '.join(shape)}")
    for name, kind in shape.items():
        value = content.get(name)
        if value is None:
            continue
        if isinstance(kind, Mapping):
            check_fields(value, kind, f"{place}.{name}")
        elif kind is float:
            numbers(value, f"{place}.{name}")
        elif not isinstance(value, str):
            raise MeasurementError(f"{place}.{name} should be a text")


def is_number(value: Any) -> TypeGuard[int | float]:
    """Whether something of a file is one finite number."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    return abs(value) < 1e300


def is_positive(value: Any) -> bool:
    """Whether something of a file is one finite number above zero."""
    return is_number(value) and value > 0


def gev(energy: float) -> float:
    """An energy of a file, GeV: AT has it in eV."""
    return float(energy) * (1e-9 if energy > 1e5 else 1.0)


def first_turns_or_stored(readings: Array, monitors: Sequence[str], **more: Any) -> AnyMeasurement:
    """Readings [shot, turn, monitor, 2] without launches: sixteen turns and more are those of a
    stored beam that was kicked, fewer are first turns. `more` are attributes of both."""
    if readings.shape[1] >= FEWEST:
        return TurnByTurn(readings[:, :MOST], tuple(monitors), **more)
    shots = len(readings)
    return Measurement(
        launches=np.zeros((shots, 5)),
        readings=readings,
        monitors=tuple(monitors),
        launch_sigma=np.tile(UNKNOWN_LAUNCH, (shots, 1)),
        **more,
    )


def counted(names: Sequence[str], most: int = 8) -> str:
    """Names in a sentence, the first few of many."""
    shown = ", ".join(f"'{name}'" for name in names[:most])
    return shown if len(names) <= most else f"{shown} and {len(names) - most} more"


def device_names(pairs: Iterable[tuple[str, str]]) -> dict[str, str]:
    """Names of the control system by names of the lattice, of pairs (lattice, control system);
    those that are the same are left out, several of one element are joined."""
    found: dict[str, list[str]] = {}
    for name, device in pairs:
        own = found.setdefault(name, [])
        if device and device.casefold() != name.casefold() and device not in own:
            own.append(device)
    return {name: ", ".join(own) for name, own in found.items() if own}


def described(brought: Imported) -> str:
    """What was brought in, in a line."""
    data = brought.measurement
    if isinstance(data, OrbitResponse):
        planes = [data.planes.count(plane) for plane in "xy"]
        read = np.isfinite(data.response).any(axis=0).sum(axis=0)
        noise = "" if data.noise is None or not np.isfinite(data.noise).any() else (
            f", noise {1e6 * np.nanmedian(data.noise):.3g} µm"
        )  # fmt: skip
        step = "no RF step" if data.rf is None or data.rf.orbit is None else (
            f"an RF step of {data.rf.step:+g} Hz"
        )  # fmt: skip
        return (
            f"orbit response: BPMs {read[0]} x, {read[1]} y; correctors {planes[0]} x, "
            f"{planes[1]} y; {step}{noise}"
        )
    if not isinstance(data, Measurement | TurnByTurn):
        return in_words(data)
    shots, turns, monitors, _ = data.readings.shape
    what = "turn by turn" if isinstance(data, TurnByTurn) else "first turns"
    return f"{what}: {shots} shots, {turns} turns, {monitors} BPMs"


def write_imported(brought: Imported, folder: Path, force: bool = False) -> None:
    """Write the measurement folder, with `lattice.json` where there is a ring, as a whole.

    Args:
        folder: made where it is not there.
        force: a measurement or lattice that is there already is replaced.

    Raises:
        OutputError: it cannot be written.
        MeasurementError: readings that no reader would take, or old data without force.
    """
    check_free(folder, force)
    if brought.ring is not None and not force and (folder / "lattice.json").exists():
        raise MeasurementError(
            f"'{folder}' holds a lattice.json already; name another folder, or replace it with "
            "--force (in Python: force=True)"
        )
    with output_folder(folder) as temporary:
        write_measurement(temporary, brought.measurement)
        if brought.ring is not None:
            save_ring(brought.ring, temporary / "lattice.json")
