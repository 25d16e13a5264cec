"""Orbit responses of the ESRF and of pyLOCO: HDF5 files, and a table of names.

- The response: `matrix` [monitors x then y, inputs], m/rad, `inputs_delta`, rad, from one side to
  the other, `input_names`; `raw_up` and `raw_down`, m, where the orbits themselves were kept.
- The dispersion: `measured_eta_x`, `measured_eta_y`, m, for `rf_full_step`, Hz.
- The noise: `Noise_BPMx`, `Noise_BPMy`, m, of one orbit.
- `name_mapping.json`: `"39/B1L": "srmag/hst-sf2/c04-a"`, an element's place in the lattice, from 0,
  the component of its field and the name of what drives it: B1L kicks in x, A1L in y.

Monitors stand in the order of the lattice.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tmlattice.arrays import Array
from tmlattice.errors import MeasurementError
from tmlattice.importers.imported import Imported, device_names, numbers
from tmlattice.importers.matlab_ring import Elements, planes_by, ring_of_elements
from tmlattice.input_files import MOST_DIGITS, json_of, short
from tmlattice.lattice.mat_file import read_apart
from tmlattice.measurement import OrbitResponse
from tmlattice.measurement.orbit_response import RfStep

Plane = {"B1L": "x", "A1L": "y"}
ARRAYS = (
    "matrix", "inputs_delta", "raw_up", "raw_down", "measured_eta_x", "measured_eta_y",
    "Noise_BPMx", "Noise_BPMy",
)  # fmt: skip
SCALARS = ("shots_per_orbit", "rf_full_step", "bipolar")
TEXTS = ("input_names",)
"""What is read of a file, and of which type; anything else in it may be of any."""
NOTHING = "python-None"
"""What pyLOCO writes in place of what it does not have."""
MOST_SHOTS = 1_000_000


def read_hdf5(path: Path) -> dict[str, Any]:
    """Arrays, texts and attributes of an HDF5 file, all groups in one table.

    Raises:
        MeasurementError: no HDF5 file, or one that holds its reader.
    """
    arrays, attributes = read_apart("hdf5", path, "HDF5", MeasurementError)
    names = [name.rsplit("/", 1)[-1] for name in arrays]
    if twice := [n for n in (*ARRAYS, *SCALARS, *TEXTS) if names.count(n) > 1]:
        raise MeasurementError(f"'{path}': '{twice[0]}' stands in two groups; keep one of the two")
    content = {**attributes[""], **dict(zip(names, arrays.values(), strict=True))}
    for name in [n for n, own in content.items() if isinstance(own, str) and own == NOTHING]:
        del content[name]
    for name, value in content.items():
        single = np.ndim(value) == 0 and isinstance(value, np.generic) and np.isfinite(value)
        if name in SCALARS and not single:
            raise MeasurementError(f"'{path}': {name} should be one finite number")
        if name in ARRAYS and not isinstance(value, np.ndarray):
            raise MeasurementError(f"'{path}': {name} should be an array of numbers")
        if name in TEXTS and not isinstance(value, list | str):
            raise MeasurementError(f"'{path}': {name} should be a list of texts")
    return content


def read_mapping(path: Path) -> dict[str, tuple[int, str]]:
    """Name of what drives a kick -> place in the lattice and plane.

    Raises:
        MeasurementError: no JSON table of names.
    """
    table = json_of(path, MeasurementError)
    found = {}
    for key, name in table.items() if isinstance(table, dict) else [("", table)]:
        place, _, component = key.partition("/")
        if not isinstance(name, str) or not place.isdecimal() or len(place) > MOST_DIGITS:
            raise MeasurementError(
                f'{path}: {short({key: name})} is no entry such as "39/B1L": "srmag/hst-sf2/c04-a"'
            )
        if component in Plane:
            found[name] = int(place), Plane[component]
    return found


def bring_hdf5(
    parts: Sequence[tuple[Path, Mapping[str, Any]]],
    mapping: Mapping[str, tuple[int, str]],
    lattice: Elements,
) -> Imported:
    """The measurement of HDF5 files that belong together.

    Args:
        parts: paths and contents, of `read_hdf5`: the response, and where there are the dispersion
            and the noise.

    Raises:
        MeasurementError: no response, a name that the mapping lacks, or shapes that do not fit.
        LatticeError: the lattice cannot be made.
    """
    data = _with(parts, "matrix")
    if data is None:
        raise MeasurementError(
            f"'{parts[0][0]}' holds no 'matrix'; give the file of the orbit response"
        )
    names = data.get("input_names")
    if names is None:
        raise MeasurementError("no 'input_names'; the columns are unknown")
    names = [names] if isinstance(names, str) else names
    unknown = [name for name in names if name not in mapping]
    if unknown:
        raise MeasurementError(
            f"'{unknown[0]}' stands in no table of names; give its name_mapping.json too"
        )
    monitors = tuple(
        i for i, own in enumerate(lattice.fields)
        if str(own.get("Class", "")).lower() == "monitor" or "GCR" in own
    )  # fmt: skip
    rows = 2 * len(monitors)
    kicks = planes_by(mapping[name] for name in names)
    own = {mapping[name]: name.lower() for name in names}
    placed = ring_of_elements(lattice.fields, lattice.name, lattice.energy, monitors, kicks, own)
    steps = numbers(data.get("inputs_delta"), "inputs_delta", (len(names),))
    change, of_orbits = _orbits(data, steps, rows)
    noise, of_noise = _noise(parts, data, len(monitors))
    rf, of_rf = _rf(parts, lattice, len(monitors))
    measured = OrbitResponse(
        correctors=tuple(placed.correctors[mapping[name]] for name in names),
        planes=tuple(mapping[name][1] for name in names),
        kicks=steps,
        monitors=placed.monitors,
        response=np.stack([change[: rows // 2].T, change[rows // 2 :].T], axis=2),
        noise=noise,
        rf=rf,
        lattice="lattice.json",
        energy=placed.ring.energy,
        devices=device_names((placed.correctors[mapping[name]], name) for name in names),
    )
    said = (
        "BPMs stand in the order of the lattice, x then y; inputs are found by the table of names",
        of_orbits,
        "the RF frequency stood still while correctors were stepped",
        of_noise,
        of_rf,
        *placed.messages,
    )
    return Imported(measured, placed.ring, said)


def _with(parts: Sequence[tuple[Path, Mapping[str, Any]]], name: str) -> Mapping[str, Any] | None:
    return next((content for _, content in parts if name in content), None)


def _by_plane(data: Mapping[str, Any], name: str, monitors: int) -> Array:
    """Two arrays of a file, of x and y, [monitor, 2]."""
    planes = [numbers(data.get(f"{name}{p}"), f"{name}{p}", (monitors,)) for p in "xy"]
    return np.stack(planes, axis=1)


def _orbits(data: Mapping[str, Any], steps: Array, rows: int) -> tuple[Array, str]:
    """Orbit changes, m, [row, column]."""
    shape = rows, len(steps)
    if "raw_up" in data or "raw_down" in data:
        up, down = (numbers(data.get(name), name, shape) for name in ("raw_up", "raw_down"))
        two = bool(data.get("bipolar", True))
        sides = "two-sided" if two else "one-sided; the diagnosis takes them as two-sided"
        return up - down, (
            f"orbit changes are raw_up - raw_down, m, for inputs_delta, rad; steps are {sides}"
        )
    matrix = numbers(data["matrix"], "matrix", shape)
    return matrix * steps, "matrix is in m/rad, inputs_delta in rad from one side to the other"


def _noise(
    parts: Sequence[tuple[Path, Mapping[str, Any]]], data: Mapping[str, Any], monitors: int
) -> tuple[Array | None, str]:
    found = _with(parts, "Noise_BPMx")
    if found is None:
        return None, "no noise is given (Noise_BPMx)"
    orbit = _by_plane(found, "Noise_BPM", monitors)
    shots = int(data.get("shots_per_orbit", 1))
    if not 1 <= shots <= MOST_SHOTS:
        raise MeasurementError(f"shots_per_orbit is {shots}; it should be from 1 to {MOST_SHOTS}")
    return np.where(orbit > 0, orbit, np.nan) * np.sqrt(2 / shots), (
        "Noise_BPMx is the rms of one orbit; an orbit change is the difference of two"
        + (f", each the mean of {shots}" if shots > 1 else "")
    )


def _rf(
    parts: Sequence[tuple[Path, Mapping[str, Any]]], lattice: Elements, monitors: int
) -> tuple[RfStep | None, str]:
    found = _with(parts, "measured_eta_x")
    step = None if found is None else found.get("rf_full_step")
    if found is None or step is None or lattice.harmonic is None or lattice.frequency is None:
        return None, "no response to the RF's step is given (measured_eta_x with rf_full_step)"
    orbit = _by_plane(found, "measured_eta_", monitors)
    return RfStep(lattice.frequency, lattice.harmonic, float(step), orbit), (
        "measured_eta is the orbit change, m, for rf_full_step, Hz, from one side to the other"
    )
