"""Response files of the MATLAB Middle Layer: `Rmat`, with dispersion and noise from other files.

`Rmat` is [plane read][plane kicked] of structures: `Data`, orbit per step; `ActuatorDelta`; the
orbits `Monitor1` and `Monitor2`; devices by their lists. `BPMxDisp`, `BPMyDisp` hold the
dispersion, `BPMxData`, `BPMyData` the scatter (`Sigma`) of one orbit.

Devices are no elements. The LOCO file of the machine is the dictionary: it has both, and the
kick, mrad, of its own step in the hardware's unit.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from tmlattice.arrays import Array
from tmlattice.errors import MeasurementError
from tmlattice.importers.imported import Imported, check_fields, numbers
from tmlattice.importers.loco import Iteration, bring_loco, conventions
from tmlattice.measurement import OrbitResponse
from tmlattice.measurement.arrays import METRES
from tmlattice.measurement.orbit_response import RfStep

Fields = Mapping[str, Any]
Device = tuple[int, ...]

RADIANS = {"rad": 1.0, "radian": 1.0, "radians": 1.0, "mrad": 1e-3, "urad": 1e-6}
FIELDS = {
    "Data": float, "ActuatorDelta": float, "Sigma": float, "dp": float, "DeviceList": float,
    "UnitsString": str, "Monitor": {"DeviceList": float},
    "Actuator": {"DeviceList": float, "UnitsString": str},
}  # fmt: skip
"""Types of what is read of a structure."""


def bring_middle_layer(
    response: Fields,
    with_dispersion: Sequence[Fields],
    loco: Fields,
    path: Path,
    iteration: Iteration = "first",
    keep_bad: bool = False,
    energy: float | None = None,
) -> Imported:
    """The measurement of the Middle Layer's files; the model is that of the LOCO file.

    Args:
        response, with_dispersion: variables with `Rmat`; with the dispersion or the noise.
        loco, path: variables of the machine's LOCO file, the dictionary.
        iteration, keep_bad, energy: see `bring_loco`.

    Raises:
        MeasurementError: a field is missing, a device that LOCO's file does not have, or a unit
            that is unknown.
    """
    known = bring_loco(loco, path, iteration, keep_bad, energy)
    model, good = bring_loco(loco, path, iteration, True, energy).measurement, known.measurement
    assert isinstance(model, OrbitResponse)
    assert isinstance(good, OrbitResponse)
    data = loco["LocoMeasData"]
    blocks = _blocks(response)
    reads = [_monitors(data, model, k) for k in range(2)]
    names, planes, kicks, changes = [], [], [], []
    for p, plane in enumerate("xy"):
        own = blocks[p][p]
        devices = _devices(own.get("Actuator"), "Actuator")
        columns = [i for i, q in enumerate(model.planes) if q == plane]
        table = dict(zip(_devices(data.get(f"{'HV'[p]}CM"), "CM"), columns, strict=False))
        found = [_look_up(table, device, f"corrector of {plane}") for device in devices]
        steps = _each(own.get("ActuatorDelta"), "ActuatorDelta", len(devices))
        radians = _kicks(own, steps, data, model, columns, found, "HV"[p])
        change = np.full((len(devices), len(model.monitors), 2), np.nan)
        for r in range(2):
            block = blocks[r][p]
            at = _places(reads, r, block.get("Monitor"), "Monitor")
            length = str(block.get("UnitsString", "mm/")).split("/")[0]
            orbits = numbers(block["Data"], "Rmat.Data", (len(at), len(steps)))
            change[:, at, r] = (_unit(length, "orbits") * steps * orbits).T
        names += [model.correctors[i] for i in found]
        planes += [plane] * len(found)
        kicks += radians.tolist()
        changes.append(change)
    measured = OrbitResponse(
        correctors=tuple(names),
        planes=tuple(planes),
        kicks=np.array(kicks),
        monitors=model.monitors,
        response=np.concatenate(changes),
        noise=_noise(with_dispersion, reads, len(model.monitors)),
        rf=_rf(with_dispersion, reads, model),
        lattice=model.lattice,
        energy=model.energy,
        devices=model.devices,
    )
    said = [
        f"devices are those of '{path.name}', and kicks go by its step in the hardware's unit",
        "orbit changes are Data times ActuatorDelta, from one side of the step to the other",
        "the RF frequency stood still while correctors were stepped",
        "Sigma is the rms of one orbit; an orbit change is the difference of two"
        if measured.noise is not None else "no noise is given (BPMxData)",
    ]  # fmt: skip
    return Imported(
        _without_bad(measured, model, good), known.ring, (*said, *_of_model(known)), known.doubts
    )


def _of_model(known: Imported) -> list[str]:
    """Statements of LOCO's file about its lattice and good lists: not how its data were taken."""
    response = known.measurement
    assert isinstance(response, OrbitResponse)
    own = {sentence for flags in ({}, {"a": ""}) for sentence in conventions(flags, response)}
    return [sentence for sentence in known.assumed if sentence not in own]


def _without_bad(
    measured: OrbitResponse, every: OrbitResponse, good: OrbitResponse
) -> OrbitResponse:
    """Without what LOCO's good lists leave out."""
    bad = np.isnan(good.response).all(axis=0) & ~np.isnan(every.response).all(axis=0)
    left = set(every.correctors) - set(good.correctors)
    kept = [name for name in measured.correctors if name not in left]
    measured = replace(measured, response=np.where(bad, np.nan, measured.response))
    if measured.rf is not None and measured.rf.orbit is not None:
        orbit = np.where(bad, np.nan, measured.rf.orbit)
        measured = replace(measured, rf=replace(measured.rf, orbit=orbit))
    return measured.select(correctors=kept)


def _blocks(content: Fields) -> list[list[Fields]]:
    Rmat = content.get("Rmat")
    square = (
        isinstance(Rmat, list) and len(Rmat) == 2
        and all(isinstance(row, list) and len(row) == 2 for row in Rmat)
        and all(isinstance(b, Mapping) and "Data" in b for row in Rmat for b in row)
    )  # fmt: skip
    if not square:
        raise MeasurementError("Rmat is no 2 x 2 of planes with Data; give measrespmat's file")
    assert isinstance(Rmat, list)
    for block in (block for row in Rmat for block in row):
        check_fields(block, FIELDS, "Rmat")
    return Rmat


def _devices(structure: Any, what: str) -> list[Device]:
    if not isinstance(structure, Mapping) or "DeviceList" not in structure:
        raise MeasurementError(f"{what} has no DeviceList; give the Middle Layer's whole file")
    rows = np.atleast_2d(numbers(structure["DeviceList"], "DeviceList"))
    if not (np.abs(rows) < 1e6).all():
        raise MeasurementError(f"the DeviceList of {what} holds numbers that are of no device")
    return [tuple(row) for row in rows.astype(int).tolist()]


def _monitors(data: Fields, model: OrbitResponse, plane: int) -> dict[Device, int]:
    """Places among the monitors by device; LOCO's lists are in the order of its own."""
    for name in (f"{'HV'[plane]}BPM", f"BPM{'xy'[plane]}"):
        if isinstance(data.get(name), Mapping):
            devices = _devices(data[name], name)
            read = np.flatnonzero(np.isfinite(model.response[..., plane]).any(axis=0))
            if len(read) != len(devices):
                raise MeasurementError(f"{name} has {len(devices)} devices, not {len(read)}")
            return dict(zip(devices, read.tolist(), strict=True))
    raise MeasurementError("LocoMeasData has no devices of the BPMs (HBPM, BPMx)")


def _look_up(table: Mapping[Device, int], device: Device, what: str) -> int:
    if device not in table:
        raise MeasurementError(
            f"LOCO's file has no {what} with the device {list(device)}; give this machine's own"
        )
    return table[device]


def _places(reads: Sequence[Mapping[Device, int]], p: int, structure: Any, what: str) -> list[int]:
    """Places of the BPMs of a structure, of the plane p."""
    return [_look_up(reads[p], d, f"BPM of {'xy'[p]}") for d in _devices(structure, what)]


def _unit(text: Any, what: str) -> float:
    """m."""
    unit = str(text).strip().lower()
    if unit not in METRES:
        raise MeasurementError(f"{what} in '{text}': known units are {', '.join(METRES)}")
    return METRES[unit]


def _each(value: Any, what: str, count: int) -> Array:
    """A number for each of so many, or one for all."""
    found = numbers(value, what).ravel()
    return np.repeat(found, count) if found.size == 1 else numbers(found, what, (count,))


def _kicks(
    block: Fields,
    steps: Array,
    data: Fields,
    model: OrbitResponse,
    columns: Sequence[int],
    found: Sequence[int],
    letter: str,
) -> Array:
    """Steps in rad: stated in them, or by LOCO's kick for its own hardware step."""
    per = str(block.get("UnitsString", "")).partition("/")[2].strip().lower()
    if per in RADIANS:
        return RADIANS[per] * steps
    hardware = data.get(f"Delta{letter}CMHardware")
    if hardware is None and "DeltaAmps" in data:
        amps = numbers(data["DeltaAmps"], "DeltaAmps")
        hardware = amps[: len(columns)] if letter == "H" else amps[-len(columns) :]
    if hardware is None:
        raise MeasurementError(
            f"kicks in '{per}', and LOCO's file has no step in it (Delta{letter}CMHardware); save "
            "the response in physics units"
        )
    own = _each(hardware, f"Delta{letter}CMHardware", len(columns))
    place = {column: i for i, column in enumerate(columns)}
    return np.array(
        [model.kicks[c] * step / own[place[c]] for c, step in zip(found, steps, strict=True)]
    )


def _part(with_dispersion: Sequence[Fields], name: str) -> Fields | None:
    part = next((content[name] for content in with_dispersion if name in content), None)
    if part is not None:
        check_fields(part, FIELDS, name)
    return part


def _noise(
    with_dispersion: Sequence[Fields], reads: Sequence[Mapping[Device, int]], monitors: int
) -> Array | None:
    noise = np.full((monitors, 2), np.nan)
    for p, plane in enumerate("xy"):
        part = _part(with_dispersion, f"BPM{plane}Data")
        if part is None or "Sigma" not in part:
            return None
        at = _places(reads, p, part, "BPMxData")
        unit = _unit(part.get("UnitsString", "mm"), "noise")
        noise[at, p] = np.sqrt(2) * unit * numbers(part["Sigma"], "Sigma", (len(at),))
    return np.where(noise > 0, noise, np.nan)


def _rf(
    with_dispersion: Sequence[Fields], reads: Sequence[Mapping[Device, int]], model: OrbitResponse
) -> RfStep | None:
    """The dispersion, for its own step; in physics units it is m for a whole of dp/p."""
    if model.rf is None:
        return None
    orbit = np.full((len(model.monitors), 2), np.nan)
    step = 0.0
    for p, plane in enumerate("xy"):
        part = _part(with_dispersion, f"BPM{plane}Disp")
        if part is None:
            return None
        at = _places(reads, p, part.get("Monitor"), "BPMxDisp.Monitor")
        length, _, per = str(part.get("UnitsString", "")).partition("/")
        unit = _unit(length, "dispersion")
        step = float(_each(part.get("ActuatorDelta"), "ActuatorDelta", 1)[0])
        dp = numbers(part.get("dp", np.nan), "dp", (1,))[0]
        times = (dp if "dp" in per else step) or np.nan
        orbit[at, p] = unit * times * numbers(part["Data"], "Data", (len(at),))
        hertz = str((part.get("Actuator") or {}).get("UnitsString", "Hz")).lower()
        step *= {"mhz": 1e6, "khz": 1e3}.get(hertz, 1.0)
    return replace(model.rf, step=step, orbit=orbit)
