"""First turns or orbits of a control room's file, its columns taken as they are.

Wide: a row a shot, and a column a monitor and plane (`SR:BPM_07:X [mm]`, `bpm_7_x`, `x_bpm7`).
Long: a row a monitor (and shot, and turn), with columns `monitor`, `x`, `y`, or a `value` with a
`plane`, or with the plane in the device's name (`SR:BPM_07:X 0.13`). What the file does not prove,
units above all, is reported. A sum signal (`SR:BPM_07:SUM`, `intensity`, `charge`) states which of
the BPMs had a beam.
"""

import re
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from tmlattice.arrays import Array, Flags
from tmlattice.errors import MeasurementError, plain, unknown_name
from tmlattice.importers.columns import Column
from tmlattice.importers.imported import (
    Imported,
    counted,
    device_names,
    first_turns_or_stored,
)
from tmlattice.importers.stated import Stated
from tmlattice.input_files import number
from tmlattice.lattice import Ring
from tmlattice.measurement import TurnByTurn
from tmlattice.measurement.arrays import METRES
from tmlattice.measurement.lost_beam import about_sums, no_beam
from tmlattice.measurement.monitors import LARGEST_READING

SIZES = ((0.02, "m"), (30.0, "mm"), (3e4, "um"), (np.inf, "nm"))
"""Readings below the first are in the second, where nothing states their unit: orbits of 20 mm and
more have no room in a beam pipe, and those of a micrometre are noise."""

SHOTS = ("shot", "shots", "shot_id", "cycle", "time", "timestamp", "date", "datetime")
TURNS = (
    "turn", "turns", "turn_number", "turn_no", "turn_n", "n_turn", "nturn", "turn_index", "turn_id",
)  # fmt: skip
MONITORS = ("monitor", "bpm", "device", "name", "element", "pv", "channel")
VALUES = ("value", "val", "reading", "position")
PLANES = ("plane", "axis")
_PLANE = re.compile(
    r"(?:pos|position|orbit)?(?P<p>x|y|h|v|hor|ver|horizontal|vertical)(?:pos|position|mean|avg|co)?",
    re.IGNORECASE,
)
SUM = 2
"""Stands for the sum signal, where 0 and 1 are planes."""
_SUM = re.compile(r"(?:bpm)?(?:sum|intensity|charge|Σ)(?:signal|adc|raw)?", re.IGNORECASE)
_MISSING = frozenset({
    "", "nan", "na", "n/a", "null", "none", "-", "--", "---", "*", "?", "invalid", "disconnected",
    "error", "bad", "off", "timeout",
})  # fmt: skip
FILLED = 3
"""Times that one number is read, at least, which is larger by as much than all that differ, from
which it stands for no reading."""
SUMMARIES = frozenset({"mean", "average", "avg", "median", "rms", "std", "stdev", "min", "max"})
_PREFIX = {"milli": "m", "micro": "u", "nano": "n"}
_TOKEN = re.compile(r"[A-Za-z0-9]+")


@dataclass(frozen=True)
class Place:
    """Where one number of the file belongs.

    Attributes:
        device: as the file has it, without the plane.
        plane: 0 for x, 1 for y, `SUM` for the sum signal.
    """

    device: str
    plane: int


def bring_readings(
    path: str,
    columns: Sequence[Column],
    ring: Ring | None,
    stated: Stated | None = None,
    monitors: Sequence[str] | None = None,
) -> Imported:
    """The measurement of a table with unknown columns.

    Args:
        path: what messages call it, see `columns.label`.
        ring: the lattice, whose monitors are looked for; None: names are as the file has them.
        monitors: names to look for, instead of the lattice's.

    Raises:
        MeasurementError: no table, no monitor of the ring, a field that is no number, or most
            readings above 0.2 m.
        UnknownNameError: `stated` names a monitor that the ring does not have.
    """
    stated = stated or Stated()
    columns, summaries = _without_summaries(columns)
    found = _long(path, columns, stated) or _wide(path, columns, stated)
    shots, turns, places, values, units = found
    position = np.array([place.plane != SUM for place in places])
    devices = list(dict.fromkeys(place.device for place in places if place.plane != SUM))
    if not devices:
        raise MeasurementError(f"{path}: sum signals without x and y; give the positions too")
    names = list(monitors or devices if ring is None else [e.name for e in ring.monitors])
    finder = _Finder(names, stated, [] if ring is None else [e.name for e in ring.elements])
    monitor = finder.all(path, devices)
    for place in places:
        monitor.setdefault(place.device, finder.find(place.device))
    besides = _besides(places, monitor)
    monitor |= dict.fromkeys(besides)
    scale = np.ones(len(values))
    fill = _fill(values[position])
    scale[position], of_unit, guessed = _scale(
        np.where(np.abs(values) == fill, np.nan, values)[position],
        [u for u, p in zip(units, position, strict=True) if p], stated,
    )  # fmt: skip
    both = np.full((len(set(shots)), max(turns) + 1, len(names), 3), np.nan)
    order = {shot: i for i, shot in enumerate(dict.fromkeys(shots))}
    taken, filled = np.zeros((2, *both.shape), dtype=bool)
    for shot, turn, place, value, factor in zip(shots, turns, places, values, scale, strict=True):
        at = monitor.get(place.device)
        if at is None:
            continue
        where = order[shot], turn, at, place.plane
        if taken[where]:
            raise MeasurementError(
                f"{path}: BPM '{names[at]}' stands twice in one shot, again as "
                f"'{place.device}'; leave one out, or separate them by a column 'shot' or 'turn'"
            )
        taken[where] = True
        both[where] = value * factor
        filled[where] = abs(value) == fill
    readings, silent = both[..., :SUM], no_beam(both[..., SUM])
    if fill is not None and 2 * (values == fill).sum() < (np.abs(values) == fill).sum():
        fill = -fill
    missing = _taken_out(readings, filled[..., :SUM], fill)
    before = np.isfinite(readings).any(axis=3)
    readings[silent] = np.nan
    said_of_large = _without_large(path, readings, names)
    left = [d for d in devices if monitor.get(d) is None and d not in besides]
    read = np.flatnonzero(taken[..., :SUM].any(axis=(0, 1, 3)))
    noise = None if stated.noise is None else np.full((len(read), 2), stated.noise)
    devices_of = device_names(
        (names[at], device) for device in devices if (at := monitor.get(device)) in read.tolist()
    )
    data = first_turns_or_stored(
        readings[:, :, read],
        [names[i] for i in read],
        noise=noise,
        lattice=None if ring is None else ring.name,
        energy=None if ring is None else ring.energy,
        devices=devices_of,
    )
    of_noise = (
        "no noise is given: a diagnosis estimates it from the readings"
        if stated.noise is None
        else f"the noise is {1e6 * stated.noise:g} µm, as stated"
    )
    beam = "the launch of the beam is unknown"
    if isinstance(data, TurnByTurn):
        beam = f"{readings.shape[1]} turns are those of a stored beam that was kicked before"
    sums = about_sums(both[..., SUM], silent, before, names)
    said = [
        of_unit, beam, of_noise, *finder.said, *sums, *missing, *said_of_large,
        *_unused(columns, stated), *summaries,
        *([f"names with more words than a BPM's own, left out: {counted(besides)}"]
          if besides else []),
    ]  # fmt: skip
    doubts = (f"not BPMs of the lattice, left out: {counted(left)}",) if left else ()
    return Imported(data, ring, tuple(said), doubts, guessed)


def _without_summaries(columns: Sequence[Column]) -> tuple[Sequence[Column], list[str]]:
    """The columns without rows of a mean or an rms, and a sentence about those."""
    words = {(row, v) for c in columns for row, v in enumerate(c.values) if v.lower() in SUMMARIES}
    if not words:
        return columns, []
    rows = {row for row, _ in words}
    kept = [replace(c, values=[v for k, v in enumerate(c.values) if k not in rows])
            for c in columns]  # fmt: skip
    return kept, [f"rows that sum up others, left out: {counted(sorted({v for _, v in words}))}"]


def _besides(places: Sequence[Place], monitor: dict[str, int | None]) -> list[str]:
    """Devices that add words to the name of one that is read: `bpm_7_error` next to `bpm_7`."""
    of: dict[tuple[int | None, int], list[str]] = {}
    for place in dict.fromkeys(places):
        of.setdefault((monitor[place.device], place.plane), []).append(place.device)
    found = []
    for (at, _), devices in of.items():
        words = {device: set(_TOKEN.findall(device)) for device in devices}
        own = min(devices, key=lambda device: len(words[device]))
        more = [device for device in devices if device != own]
        if at is not None and all(words[own] < words[device] for device in more):
            found += more
    return list(dict.fromkeys(found))


def _without_large(path: str, readings: Array, names: Sequence[str]) -> list[str]:
    """Make readings that no pipe is wide enough for NaN, and return a sentence about them."""
    large = np.abs(readings) > LARGEST_READING
    count = int(large.sum())
    if not count:
        return []
    if 2 * count >= np.isfinite(readings).sum():
        raise MeasurementError(
            f"{path}: most readings are above {LARGEST_READING} m; state the unit of the file "
            "(`unit` in [data] of tmlattice.toml)"
        )
    readings[large] = np.nan
    of = counted([names[i] for i in np.unique(np.argwhere(large)[:, 2])])
    return [f"rejected readings, above {LARGEST_READING} m: {count}, of {of}"]


def _fill(values: Array) -> float | None:
    """A number that is read again and again and is far above all others, without its sign."""
    own, counts = np.unique(np.abs(values[np.isfinite(values)]), return_counts=True)
    single = own[counts < FILLED]
    often = len(single) > 0 and counts[-1] >= FILLED and own[-1] > FILLED * single[-1]
    return float(own[-1]) if often else None


def _taken_out(readings: Array, filled: Flags, fill: float | None) -> list[str]:
    """Take that number for no reading where no beam can be, or where others follow it in its shot;
    else the beam was lost there, as `check` states. A sentence about it."""
    own = filled.any(axis=3).reshape(len(filled), -1)
    other = np.isfinite(readings).any(axis=3).reshape(len(filled), -1) & ~own
    behind = [o.any() and t[o.argmax() :].any() for o, t in zip(own, other, strict=True)]
    if not any(behind) and not (np.abs(readings[filled]) > LARGEST_READING).any():
        return []
    readings[filled] = np.nan
    return [f"{filled.sum()} readings are {fill:g}, far above all others: taken as missing"]


def _unused(columns: Sequence[Column], stated: Stated) -> list[str]:
    """A sentence about columns that are not read."""
    stated_names = map(str.casefold, stated.columns.values())
    known = {*SHOTS, *TURNS, *MONITORS, *VALUES, *PLANES, *stated_names}
    names = [
        c.name for c in columns
        if c.name and _word(c.name) not in known
        and _plane(c.name) is None and place_of(c.name, stated) is None
    ]  # fmt: skip
    return [f"columns that are not read: {counted(names)}"] if names else []


Found = tuple[list[str], list[int], list[Place], Array, list[str]]
"""Of every number: its shot, turn, place, value, and unit."""


def _long(path: str, columns: Sequence[Column], stated: Stated) -> Found | None:
    """A row a monitor; None where no column holds names."""
    names = _called(columns, "monitor", MONITORS, stated)
    if names is None or all(_is_number(text) for text in names.values):
        return None
    value = _called(columns, "value", VALUES, stated)
    plane = _called(columns, "plane", PLANES, stated)
    of_shot = _called(columns, "shot", SHOTS, stated)
    shots = ["0"] * len(names.values) if of_shot is None else of_shot.values
    turns = _turns(path, columns, stated) or [0] * len(names.values)
    if len(set(shots)) == len(shots) > 1 and len(set(names.values)) > 1:
        raise MeasurementError(
            f"{path}: each row is a shot of its own, as '{plain(shots[0], 40)}'; give a column "
            "'shot' that is the same for readings of one shot"
        )
    parts: list[tuple[list[Place | None], Column]] = []
    if value is not None and plane is not None:
        planes = [_plane(text) for text in plane.values]
        parts.append(([None if p is None else Place(n, p) for n, p in
                       zip(names.values, planes, strict=True)], value))  # fmt: skip
    elif value is not None:
        parts.append(([place_of(text) for text in names.values], value))
    else:
        for column in columns:
            own = _plane(column.name)
            if own is not None and _holds(own, column):
                parts.append(([Place(name, own) for name in names.values], column))
    if not parts:
        raise MeasurementError(
            f"{path}: BPMs' names without readings; give columns x and y, or a value with "
            "the plane in its name"
        )
    return _joined(path, [(shots, turns, places, column) for places, column in parts])


def _wide(path: str, columns: Sequence[Column], stated: Stated) -> Found:
    """A row a shot, a column a monitor and plane."""
    rows = len(columns[0].values)
    turns = _turns(path, columns, stated)
    of_shot = _called(columns, "shot", SHOTS, stated)
    numbered = [str(i) for i in range(rows)] if turns is None else ["0"] * rows
    shots = numbered if of_shot is None else of_shot.values
    used = [
        column for column in columns
        if (place := place_of(column.name, stated)) is not None and _holds(place.plane, column)
    ]  # fmt: skip
    if not used:
        alone = [column.name for column in columns if _plane(column.name) is not None]
        if alone:
            raise MeasurementError(
                f"{path}: no column 'monitor' next to '{alone[0]}'; add it, with the name of the "
                "BPM of each row, or name each column as 'bpm_1 x'"
            )
        raise MeasurementError(
            f"{path}: no column holds readings that are known; name columns such as "
            "'bpm_1 x [mm]', a BPM and a plane (`tmlattice import --example` writes some)"
        )
    turns = turns or [0] * rows
    return _joined(
        path,
        [(shots, turns, [place_of(column.name, stated)] * rows, column) for column in used],
    )


def _joined(
    path: str, parts: Iterable[tuple[list[str], list[int], list[Place | None], Column]]
) -> Found:
    shots: list[str] = []
    turns: list[int] = []
    places: list[Place] = []
    values: list[float] = []
    units: list[str] = []
    for of_shot, of_turn, of_place, column in parts:
        rows = [row for row, place in enumerate(of_place) if place is not None]
        shots += [of_shot[row] for row in rows]
        turns += [of_turn[row] for row in rows]
        places += [place for place in of_place if place is not None]
        values += [_number(path, row, column.name, column.values[row]) for row in rows]
        units += [column.unit] * len(rows)
    return shots, turns, places, np.array(values), units


def _holds(plane: int, column: Column) -> bool:
    """Whether a column holds what its name states: of other meanings of a sum nothing is read."""
    return plane != SUM or all(map(_is_number, column.values))


def numbers_of(path: str, column: Column) -> list[float]:
    """The numbers of a column; NaN where nothing was read."""
    return [_number(path, row, column.name, text) for row, text in enumerate(column.values)]


def _number(path: str, row: int, name: str, text: str) -> float:
    if text.casefold() in _MISSING:
        return float("nan")
    try:
        return number(text)
    except ValueError:
        raise MeasurementError(
            f"{path}, row {row + 1} below the header: '{text}' of '{name}' is no number"
        ) from None


def _is_number(text: str) -> bool:
    try:
        number(text)
    except ValueError:
        return not text
    return True


def _word(name: str) -> str:
    """A column's name without what stands between its words: `Turn #` is `turn`."""
    return "_".join(re.findall(r"[^\W_]+", name.casefold()))


def _called(
    columns: Sequence[Column], key: str, usual: Sequence[str], stated: Stated
) -> Column | None:
    """The column of this meaning, by its stated name or its usual names."""
    wanted = [stated.columns[key].casefold()] if key in stated.columns else usual
    for name in wanted:
        for column in columns:
            if _word(column.name) == _word(name):
                return column
    if key in stated.columns:
        raise unknown_name("column", stated.columns[key], [column.name for column in columns])
    return None


def _turns(path: str, columns: Sequence[Column], stated: Stated) -> list[int] | None:
    column = _called(columns, "turn", TURNS, stated)
    if column is None:
        return None
    numbers = numbers_of(path, column)
    if not all(number == int(number) and 0 <= number < 1e6 for number in numbers):
        raise MeasurementError(f"{path}: turns are whole numbers from 0 in column '{column.name}'")
    first = int(min(numbers))  # counted from 1, or from a trigger
    return [int(number) - first for number in numbers]


def _plane(text: str) -> int | None:
    text = re.sub(r"[\W_]", "", text)
    if _SUM.fullmatch(text):
        return SUM
    match = _PLANE.fullmatch(text)
    return None if match is None else int(match["p"][0].casefold() in "yv")


def place_of(name: str, stated: Stated | None = None) -> Place | None:
    """Device and plane of a column's or channel's name; None where it names no plane.

    >>> place_of("SR:C01-BPM:1:X-I"), place_of("x_bpm7"), place_of("temperature")
    (Place(device='SR:C01-BPM:1:I', plane=0), Place(device='bpm7', plane=0), None)
    """
    if stated is not None and name in stated.names:  # the whole column: 'bpm_1 x'
        device, _, last = stated.names[name].rpartition(" ")
        plane = _plane(last)
        if device and plane is not None:
            return Place(device, plane)
    tokens = list(_TOKEN.finditer(name))
    for token in reversed(tokens):
        plane = _plane(token[0])
        if plane is None or len(tokens) < 2:
            continue
        before, after = name[: token.start()].rstrip("_:.-/ "), name[token.end() :]
        rest = before + after if before else after.lstrip("_:.-/ ")
        return Place(rest.strip(), plane)
    return None


def _norm(text: str) -> str:
    return "".join(_TOKEN.findall(text)).casefold()


class _Finder:
    """The lattice's monitor of a device."""

    def __init__(self, names: Sequence[str], stated: Stated, elements: Sequence[str] = ()) -> None:
        self._names = list(names)
        self._exact = {name.casefold(): i for i, name in enumerate(self._names)}
        norms = [_norm(name) for name in self._names]
        counts = Counter(norms)
        self._plain = {norm: i for i, norm in enumerate(norms) if counts[norm] == 1}
        self._told: dict[str, int] = {}
        self._in_order = stated.in_order
        others = {name.casefold() for name in elements}
        self.said: list[str] = []
        for device, name in stated.names.items():
            plain = name if name.casefold() in self._exact else name.rpartition(" ")[0]
            if plain.casefold() not in self._exact and name.casefold() in others:
                continue  # a corrector's
            if plain.casefold() not in self._exact:
                raise unknown_name("BPM", name, self._names)
            self._told[_norm(device)] = self._exact[plain.casefold()]

    def all(self, path: str, devices: Sequence[str]) -> dict[str, int | None]:
        """Place among the ring's monitors of each device; None: not found.

        Raises:
            UnknownNameError: none is.
        """
        if self._in_order:
            if len(devices) != len(self._names):
                raise MeasurementError(
                    f"{path}: {len(devices)} devices, and the lattice has {len(self._names)} "
                    "BPMs; name them in [channels], they are not the same in order"
                )
            self.said.append("devices are the lattice's BPMs in beam order, as stated")
            found: dict[str, int | None] = {device: i for i, device in enumerate(devices)}
        else:
            found = {device: self.find(device) for device in devices}
        if all(at is None for at in found.values()):
            error = unknown_name("BPM", devices[0], self._names)
            raise MeasurementError(
                f"{path}: {error}; assign the names in [channels] of "
                "tmlattice.toml (`tmlattice import --example` writes one)"
            ) from error
        loose = [
            d for d, at in found.items()
            if at is not None and _norm(d) not in (_norm(self._names[at]), *self._told)
        ]  # fmt: skip
        if loose and not self._in_order:
            at = found[loose[0]]
            assert at is not None
            self.said.append(
                f"names are matched: '{loose[0]}' is '{self._names[at]}'"
                + (f", and so on for {len(loose)}" if len(loose) > 1 else "")
            )
        return found

    def find(self, device: str) -> int | None:
        """Its place among the ring's monitors; None: it is none of them."""
        plain = _norm(device)
        for table, key in ((self._told, plain), (self._exact, device.casefold()),
                           (self._plain, plain)):  # fmt: skip
            if key in table:
                return table[key]
        tokens = [token.casefold() for token in _TOKEN.findall(device)]
        longest = max(map(len, (*self._told, *self._plain)), default=0)
        for count in range(min(len(tokens), longest), 0, -1):  # the longest run that is a name
            runs = ["".join(tokens[i : i + count]) for i in range(len(tokens) - count + 1)]
            hits = {
                table[run] for run in runs for table in (self._told, self._plain) if run in table
            }
            if len(hits) == 1:
                return hits.pop()
        return None


def _scale(values: Array, units: Sequence[str], stated: Stated) -> tuple[Array, str, str | None]:
    """Metres per unit of each number, a sentence about it, and a unit that is a guess."""
    known = {"µm": "um", "μm": "um", "micron": "um", "metre": "m", "meter": "m"}
    words = [re.sub("metre|meter$", "m", unit.strip().casefold().rstrip("s")) for unit in units]
    words = [re.sub("^(?:milli|micro|nano)(?=m)", lambda k: _PREFIX[k[0]], w) for w in words]
    plain = [known.get(word, word) for word in words]
    strange = [unit for unit in plain if unit and unit not in METRES]
    if strange:
        raise MeasurementError(
            f"no unit '{strange[0]}' of a reading; there are {', '.join(METRES)}: give them in one"
        )
    silent = np.array([not unit for unit in plain])
    scale = np.array([METRES[unit] if unit else 1.0 for unit in plain])
    in_file = sorted(set(plain) - {""})
    if not silent.any():
        return scale, f"readings are in {' and '.join(in_file)}, as the file states", None
    if stated.unit is not None:
        scale[silent] = METRES[stated.unit]
        return scale, f"readings are in {stated.unit}, as stated", None
    own = np.abs(values[silent])
    own = own[np.isfinite(own)]
    size = float(np.percentile(own, 95)) if len(own) else 0.0
    unit = next(unit for below, unit in SIZES if size < below)
    scale[silent] = METRES[unit]
    return (
        scale,
        f"no unit is given: readings are taken in {unit}, for most are below {size:.3g} "
        "(`unit` in [data] of tmlattice.toml changes it)",
        unit,
    )


def with_unit(stated: Stated | None, unit: str | None, noise: float | None) -> Stated:
    """What the user stated, together with the options of the command."""
    stated = stated or Stated()
    return replace(
        stated,
        unit=stated.unit if unit is None else unit,
        noise=stated.noise if noise is None else noise,
    )
