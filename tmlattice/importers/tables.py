"""CSV tables of an orbit response, and turn-by-turn files.

Long: `corrector,monitor,x [mm],y [mm],kick [mrad]`, a row for each corrector and monitor; rows of
the corrector `rf` hold the orbit change for a step of `kick`, Hz. Wide: `monitor,plane` and a
column `name [mm/mrad]` for each corrector, whose steps are unknown then. Units stand in the
header, in brackets; without one they are m, rad and m/rad. Names are the lattice's.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from tmlattice.arrays import Array
from tmlattice.errors import MeasurementError, OtherFormatError
from tmlattice.importers.columns import SDDS, Column
from tmlattice.importers.imported import (
    Imported,
    counted,
    device_names,
    first_turns_or_stored,
)
from tmlattice.importers.middle_layer import RADIANS
from tmlattice.importers.stated import Stated
from tmlattice.input_files import number
from tmlattice.lattice import Ring
from tmlattice.lattice.ring import LIGHT
from tmlattice.measurement import Measurement, OrbitResponse, read_turn_by_turn
from tmlattice.measurement.arrays import METRES, Unit
from tmlattice.measurement.monitors import Names
from tmlattice.measurement.orbit_response import RfStep
from tmlattice.measurement.shots import FEWEST, MOST
from tmlattice.measurement.tables import KINDS

KICK = 1e-4
"""rad; the step that a wide table is taken to have been made with."""
_PLANES = {"hcorrector": "x", "vcorrector": "y"}


def is_response_table(columns: Sequence[Column]) -> bool:
    """Whether a table is an orbit response, by its header: correctors in a column, or a row for
    each monitor and plane."""
    names = [column.name.lower() for column in columns]
    return "corrector" in names or (names[:2] == ["monitor", "plane"] and "value" not in names)


def bring_table(
    path: str, columns: Sequence[Column], ring: Ring | None, stated: Stated | None = None
) -> Imported:
    """An orbit response of a table.

    Args:
        path: what messages call it, see `columns.label`.
        ring: the lattice, which knows the correctors' planes.

    Raises:
        MeasurementError: an unknown header, or a field that is no number: with its line.
        UnknownNameError: a name that the lattice does not have.
    """
    header = [(column.name, column.unit) for column in columns]
    rows = list(zip(*(column.values for column in columns), strict=True))
    names = [name.lower() for name, _ in header]
    if ring is None:
        raise MeasurementError(
            f"'{path}' is an orbit response: name its lattice with --lattice (in Python: ring=), "
            "which knows the planes of its correctors"
        )
    read = _long if "corrector" in names else _wide
    return read(path, header, rows, ring, stated or Stated())


_FILES = (
    "give a MATLAB LOCO file (.mat), HDF5 files of a response with lattice and names, or a table "
    "(.csv, .tsv, .txt, .h5, .sdds); "
)


def bring_turns(
    path: Path,
    ring: Ring | None,
    kind: str | None = None,
    unit: Unit | None = None,
    stated: Stated | None = None,
) -> Imported:
    """Turns of the beam, of a file that the package `turn_by_turn` reads.

    Sixteen and more are those of a stored beam that was kicked, fewer are first turns.

    Args:
        ring: the lattice, whose names the monitors then have; None: names as they are.
        kind: see `read_turn_by_turn`; None: lhc, then sps.
        unit: of the file; None: mm.

    Raises:
        OtherFormatError: it cannot be read.
        MeasurementError: its readings cannot be of that unit.
    """
    why: OtherFormatError | None = None
    for one in [kind] if kind else ["lhc", "sps"]:
        try:
            data = read_turn_by_turn(path, one, unit=unit or "mm")
        except OtherFormatError as error:
            if kind:
                raise
            why = why or error
            continue
        doubts: tuple[str, ...] = ()
        if ring is not None:
            data, doubts = _of_ring(data, ring, stated or Stated())
        read = np.atleast_2d(np.isfinite(data.readings).any(axis=(0, 1)))
        single = int((read.sum(axis=1) == 1).sum())
        said = [
            f"read as '{one}' of turn_by_turn; readings are in {unit or 'mm'}",
            f"BPMs: {int(read[:, 0].sum())} in x, {int(read[:, 1].sum())} in y"
            + (f", {single} of one plane" if single else ""),
        ]
        turns = data.readings.shape[1]
        if turns < FEWEST:
            said.append("turn 0 is the first in the file; the launch of the beam is unknown")
        else:
            said.append(f"{turns} turns are those of a stored beam, kicked before the first")
        if turns > MOST:
            said.append(f"the first {MOST} turns are taken")
        measured = first_turns_or_stored(
            data.readings,
            data.monitors,
            shots=data.shots,
            lattice=None if ring is None else "lattice.json",
            energy=None if ring is None else ring.energy,
        )
        return Imported(measured, ring, tuple(said), doubts)
    table = (
        "for its columns name the lattice with --lattice; " if path.suffix.lower() in SDDS else ""
    )
    raise OtherFormatError(
        f"'{path}' is no file that is known: {table or _FILES}of turns name the kind with --turns "
        f"({KINDS})"
    ) from why


def _of_ring(data: Measurement, ring: Ring, stated: Stated) -> tuple[Measurement, tuple[str, ...]]:
    """The monitors that the ring has, under its names and in its order, and what it has not."""
    ours = Names("BPM", [element.name for element in ring.monitors])
    place = {name: ours.find(stated.name_of(name)) for name in data.monitors}
    there = sorted((at, name) for name, at in place.items() if at is not None)
    missing = [name for name, at in place.items() if at is None]
    if not there:
        ours[missing[0]]  # an UnknownNameError with the nearest names
    data = replace(
        data.select(monitors=[name for _, name in there]),
        monitors=tuple(ours.names[at] for at, _ in there),
    )
    what = f"BPMs that the lattice does not have, left out: {counted(missing)}"
    return data, (what,) if missing else ()


# --- an orbit response ----------------------------------------------------------------------------
Header = list[tuple[str, str]]
"""Name and unit of each column."""
Step = tuple[float, dict[str, tuple[float, float]]]
"""A kick, rad (or Hz), and the orbit change for it by monitor, (x, y), m."""


def _number(path: str, line: int, text: str) -> float:
    try:
        return number(text) if text.strip() else np.nan
    except ValueError:
        raise MeasurementError(f"{path}, row {line}: '{text}' is no number") from None


def _factor(path: str, name: str, unit: str, of: dict[str, float]) -> float:
    if not unit:
        return 1.0
    if unit.strip().lower() not in of:
        raise MeasurementError(f"{path}: '{name}' is in [{unit}]; known are {', '.join(of)}")
    return of[unit.strip().lower()]


def _long(
    path: str, header: Header, rows: Sequence[Sequence[str]], ring: Ring, stated: Stated
) -> Imported:
    place = {name.lower(): i for i, (name, _) in enumerate(header)}
    for name in ("corrector", "monitor", "x", "y", "kick"):
        if name not in place:
            raise MeasurementError(
                f"{path}: no column '{name}'; an orbit response has corrector, monitor, x, y, kick"
            )
    scale = {n: _factor(path, n, header[place[n]][1], METRES) for n in "xy"}
    angle = _factor(path, "kick", header[place["kick"]][1], RADIANS)
    columns: dict[str, dict[str, tuple[float, float]]] = {}
    kicks: dict[str, float] = {}
    for line, row in enumerate(rows, 2):
        corrector, monitor = (row[place[n]].strip() for n in ("corrector", "monitor"))
        x, y = (scale[n] * _number(path, line, row[place[n]]) for n in "xy")
        kick = _number(path, line, row[place["kick"]])
        if kicks.setdefault(corrector, kick) != kick:
            raise MeasurementError(
                f"{path}, row {line}: '{corrector}' has the steps {kicks[corrector]:g} and "
                f"{kick:g}; it has one"
            )
        own = columns.setdefault(corrector, {})
        if monitor in own:
            raise MeasurementError(f"{path}, row {line}: '{corrector}', '{monitor}' stand twice")
        own[monitor] = x, y
    of_rf = next((name for name in columns if name.lower() == "rf"), None)
    rf = None if of_rf is None else (kicks[of_rf], columns.pop(of_rf))
    said = [f"x in {header[place['x']][1] or 'm'}, kicks in {header[place['kick']][1] or 'rad'}"]
    steps = {n: (angle * kicks[n], own) for n, own in columns.items()}
    return _response(ring, steps, rf, said, stated)


def _wide(
    path: str, header: Header, rows: Sequence[Sequence[str]], ring: Ring, stated: Stated
) -> Imported:
    place = {name.lower(): i for i, (name, _) in enumerate(header)}
    for name in ("monitor", "plane"):
        if name not in place:
            raise MeasurementError(f"{path}: no column '{name}'; a wide table has monitor, plane")
    per = {f"{m}/{r}": METRES[m] / RADIANS[r] for m in METRES for r in RADIANS}
    columns: dict[str, Step] = {}
    for i, (name, unit) in enumerate(header):
        if i in (place["monitor"], place["plane"]):
            continue
        factor = KICK * _factor(path, name, unit, per)
        own: dict[str, tuple[float, float]] = {}
        for line, row in enumerate(rows, 2):
            monitor, plane = row[place["monitor"]].strip(), row[place["plane"]].strip().lower()
            if plane not in ("x", "y"):
                raise MeasurementError(f"{path}, row {line}: plane '{plane}'; it is x or y")
            x, y = own.get(monitor, (np.nan, np.nan))
            value = factor * _number(path, line, row[i])
            own[monitor] = (value, y) if plane == "x" else (x, value)
        columns[name] = KICK, own
    said = [
        f"the table is orbit per kick, in {header[-1][1] or 'm/rad'}: the steps are "
        f"unknown, and {KICK:g} rad is taken"
    ]
    return _response(ring, columns, None, said, stated)


def _response(
    ring: Ring, columns: dict[str, Step], rf: Step | None, said: Sequence[str], stated: Stated
) -> Imported:
    every = dict.fromkeys(m for _, own in columns.values() for m in own)
    of = {device: ring[stated.name_of(device)].name for device in (*columns, *every)}
    monitors = list(dict.fromkeys(of[m] for m in every))
    index = {name: i for i, name in enumerate(monitors)}

    def orbit(own: dict[str, tuple[float, float]]) -> Array:
        spread = np.full((len(monitors), 2), np.nan)
        for name, xy in own.items():
            spread[index[of[name]]] = xy
        return spread

    planes = []
    for name in columns:
        kind = ring[of[name]].kind
        if kind not in _PLANES:
            raise MeasurementError(f"'{of[name]}' is a {kind} of the lattice, no corrector")
        planes.append(_PLANES[kind])
    more = [
        "each step is from one side to the other",
        "the RF frequency stood still while correctors were stepped",
        "no noise is given",
    ]
    return Imported(
        OrbitResponse(
            correctors=tuple(of[name] for name in columns),
            planes=tuple(planes),
            kicks=np.array([kick for kick, _ in columns.values()]),
            monitors=tuple(monitors),
            response=np.stack([orbit(own) for _, own in columns.values()]),
            rf=None if rf is None else _step(ring, rf[0], orbit(rf[1])),
            lattice="lattice.json",
            energy=ring.energy,
            devices=device_names((own, device) for device, own in of.items()),
        ),
        ring,
        (*said, *more, *(["no response to the RF's step is given"] if rf is None else [])),
    )


def _step(ring: Ring, step: float, orbit: Array) -> RfStep:
    """The RF's step; frequency and harmonic are a cavity's, of the ring's own turn."""
    cavities = [e for e in ring.elements if e.kind == "cavity" and e.source.freq > 0]
    if not cavities:
        raise MeasurementError(
            f"an RF step, and '{ring.name}' has no cavity with a frequency; leave the rows of 'rf' "
            "out, or name a lattice with its cavity"
        )
    turn = LIGHT / ring.length
    harmonic = round(min(e.source.freq for e in cavities) / turn)
    return RfStep(harmonic * turn, harmonic, step, orbit)
