"""What two diagnoses, two lattices or two orbit responses differ in.

>>> found = compare("monday", "friday")         # folders of `diagnose --out`, or the objects
>>> found.to_dataframe().query("abs(difference) > 5 * sigma")
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from tmlattice.arrays import rms
from tmlattice.beam.chain import Chain
from tmlattice.diagnosis.load import DOCUMENT, FORMAT, load
from tmlattice.diagnosis.result import Diagnosis
from tmlattice.effects import find
from tmlattice.errors import MeasurementError, UnstableRingError
from tmlattice.importers import read_measurement
from tmlattice.input_files import json_of
from tmlattice.lattice import Element, Ring, load_ring
from tmlattice.lattice.ring import Errors
from tmlattice.measurement import OrbitResponse, in_words
from tmlattice.measurement.header import FORMAT as MEASUREMENT
from tmlattice.optics import twiss
from tmlattice.report.text import WIDTH, columns, verdict_sentence, wrapped
from tmlattice.speaks import Speaks, listed

_UNITS = {
    "s": "m", "length": "m", "k1": "1/m2", "k2": "1/m3", "angle": "rad", "tilt": "rad",
    "dx": "m", "dy": "m", "ds": "m", "roll": "rad", "kick_x": "rad", "kick_y": "rad",
    "k1l": "1/m", "k1sl": "1/m", "entrance_k1l": "1/m", "loss": "relative",
}  # fmt: skip
"""Of an element's numbers."""
ROUNDING = 1e-9
"""Relative difference of two numbers of a lattice up to which they are the same: files round."""
ORBIT = "orbit, rms"
"""The quantity of a response whose difference is an rms, and its sigma what the noise makes."""
SHOWN = 30
"""Rows that a text has."""


@dataclass(frozen=True)
class Difference:
    """One quantity of both.

    Attributes:
        quantity: an effect, an attribute of an element, or what of the ring.
        element: its name; None: the ring or the beam.
        first, second: values; NaN where one has none.
        difference: second - first; of the orbits of a response the rms of their difference.
        sigma: standard error of the difference, both taken as independent; of the rms its expected
            value by the noise alone; NaN where none is known.
        unit: of them all.
    """

    quantity: str
    element: str | None
    first: float
    second: float
    difference: float
    sigma: float
    unit: str

    @property
    def pull(self) -> float:
        """The difference in units of its error; NaN where that is unknown."""
        return self.difference / self.sigma if self.sigma > 0 else math.nan


@dataclass(frozen=True, repr=False)
class Differences(Speaks):
    """All differences of two things of one kind.

    Attributes:
        kind: "diagnoses", "lattices" or "orbit responses".
        names: of the two.
        rows: those with the largest difference in units of its error first.
        notes: sentences about both.
    """

    kind: str
    names: tuple[str, str]
    rows: tuple[Difference, ...]
    notes: tuple[str, ...] = ()

    def _told(self) -> tuple[str, dict[str, str]]:
        return f"of two {self.kind}", {"rows": str(len(self.rows))}

    def to_dataframe(self) -> Any:
        """Return the rows as a pandas DataFrame, with `pull`, the difference over its sigma."""
        import pandas as pd

        return pd.DataFrame(
            [vars(row) | {"pull": row.pull} for row in self.rows],
            columns=[*(field.name for field in fields(Difference)), "pull"],
        )

    def as_json(self) -> dict[str, Any]:
        """The result in the format `tmlattice-comparison`, version 1."""
        from tmlattice import __version__

        return {
            "format": "tmlattice-comparison",
            "version": 1,
            "package": __version__,
            "kind": self.kind,
            "names": list(self.names),
            "notes": list(self.notes),
            "rows": [vars(row) | {"pull": row.pull} for row in self.rows],
        }

    def report(self, width: int = WIDTH, most: int | None = None) -> str:
        """The notes and the first rows as plain text of so many columns, and of at most so many
        lines where the notes leave room."""
        lines = [line for note in self.notes for line in wrapped(note, "", width)]
        if not self.rows:
            return "\n".join([*lines, f"The two {self.kind} do not differ."])
        table = [("quantity", "element", "first", "second", "difference", "unit", "sigmas")]
        for row in self.rows[:SHOWN]:
            error = f" ± {row.sigma:.2g}" if row.sigma > 0 else ""
            if row.quantity == ORBIT and error:
                error = f" (noise {row.sigma:.2g})"
            table.append((
                row.quantity, row.element or "", _text(row.first), _text(row.second),
                _text(row.difference) + error if math.isfinite(row.difference) else "",
                row.unit, f"{row.pull:.1f}" if math.isfinite(row.pull) else "",
            ))  # fmt: skip
        lines += [*wrapped(f"first: {self.names[0]}, second: {self.names[1]}", "", width), ""]
        shown = columns(table, width)
        while most is not None and len(table) > 2 and len(lines) + len(shown) >= most:
            shown = columns(table := table[:-1], width)
        lines += shown
        if left := len(self.rows) - len(table) + 1:
            lines.append(f"and {left} more rows (--json has all)")
        return "\n".join(lines)


def _text(value: float) -> str:
    return f"{value:.6g}" if math.isfinite(value) else "-"


def compare(first: Any, second: Any) -> Differences:
    """Return what two things of one kind differ in.

    Args:
        first, second: two `Diagnosis`, two `Ring` or two `OrbitResponse`; or folders and files of
            them: a folder of `diagnose --out` or a diagnosis.json; a built-in name or a lattice
            file; a measurement folder.

    Raises:
        MeasurementError: two of different kinds, or of a kind that is not compared.
        LatticeError: a lattice that cannot be read.
    """
    one, other = _opened(first), _opened(second)
    names = tuple(_name(given, own) for given, own in ((first, one), (second, other)))
    kinds = [_kind(name, own) for name, own in zip(names, (one, other), strict=True)]
    if kinds[0] != kinds[1]:
        raise MeasurementError(
            f"'{names[0]}' is {_KINDS[kinds[0]][1]} and '{names[1]}' is {_KINDS[kinds[1]][1]}: "
            "compare two of one kind"
        )
    rows, notes = _KINDS[kinds[0]][2](one, other)
    order = sorted(rows, key=lambda row: -abs(row.pull) if math.isfinite(row.pull) else 1.0)
    return Differences(kinds[0], (names[0], names[1]), tuple(order), tuple(notes))


def _opened(given: Any) -> Any:
    if not isinstance(given, str | PathLike):
        return given
    place = Path(given)
    if place.is_dir():
        if (place / DOCUMENT).is_file():
            return load(Diagnosis, place)
        return read_measurement(place)
    if place.suffix.lower() == ".json" and place.is_file():
        content = json_of(place, MeasurementError, finite=False)
        stated = content.get("format") if isinstance(content, dict) else None
        if stated in (FORMAT, MEASUREMENT):
            return load(Diagnosis, place) if stated == FORMAT else read_measurement(place)
    return load_ring(str(given))


def _name(given: Any, own: Any) -> str:
    if isinstance(given, str | PathLike):
        return str(given)
    return str(getattr(own, "name", type(own).__name__))


def _kind(name: str, own: Any) -> str:
    for kind, (cls, _, _) in _KINDS.items():
        if isinstance(own, cls):
            return kind
    raise MeasurementError(
        f"'{name}' is {in_words(own)}: two diagnoses, two lattices or two orbit responses are "
        "compared"
    )


def _row(
    quantity: str, element: str | None, first: float, second: float, unit: str, sigma: float
) -> Difference:
    return Difference(quantity, element, first, second, second - first, sigma, unit)


Found = tuple[list[Difference], list[str]]


# --- diagnoses ------------------------------------------------------------------------------------
def _diagnoses(one: Diagnosis, other: Diagnosis) -> Found:
    amounts = [
        {(c.effect, c.element): (c.amount, s) for c, s in zip(d.causes, d.errors, strict=True)}
        for d in (one, other)
    ]
    nothing = (math.nan, math.nan)
    rows = []
    for effect, element in dict.fromkeys([*amounts[0], *amounts[1]]):
        (a, s), (b, t) = (own.get((effect, element), nothing) for own in amounts)
        rows.append(_row(effect, element, a, b, find(effect).unit, math.hypot(s, t)))
    before, after = (d.tunes["after"] or [math.nan, math.nan] for d in (one, other))
    rows += [
        _row(f"tune {plane}", None, a, b, "", math.nan)
        for plane, a, b in zip("xy", before, after, strict=True)
    ]
    notes = [
        f"{place}: {d.verdict.upper()}: {verdict_sentence(d)}"
        for place, d in (("first", one), ("second", other))
    ]
    return rows, notes


# --- lattices -------------------------------------------------------------------------------------
def _lattices(one: Ring, other: Ring) -> Found:
    here, there = ({element.name: element for element in ring.elements} for ring in (one, other))
    rows: list[Difference] = []
    for name in [name for name in here if name in there]:
        rows += _of_element(here[name], there[name])
    rows += _of_rings(one, other)
    notes = []
    for which, own, against in (("first", here, there), ("second", there, here)):
        alone = [name for name in own if name not in against and own[name].kind != "drift"]
        if alone:
            notes.append(f"only in the {which}: {listed(alone, 8)}")
    return rows, notes


def _of_element(one: Element, other: Element) -> Iterator[Difference]:
    for name, unit in _UNITS.items():
        source = (one.errors, other.errors) if name in Errors.__dataclass_fields__ else (one, other)
        a, b = (float(getattr(own, name)) for own in source)
        if abs(b - a) > ROUNDING * max(abs(a), abs(b), 1e-3):
            yield _row(name, one.name, a, b, unit, math.nan)


def _of_rings(one: Ring, other: Ring) -> Iterator[Difference]:
    values: list[dict[str, tuple[float, str]]] = []
    betas = []
    for ring in (one, other):
        own = {"energy": (ring.energy, "GeV"), "length": (ring.length, "m")}
        try:
            functions = twiss(Chain.from_ring(ring))
            for plane, tune in zip("xy", functions.total_tunes.tolist(), strict=True):
                own[f"tune {plane}"] = (tune, "")
            betas.append(functions.beta)
        except UnstableRingError:
            pass
        values.append(own)
    for name, (a, unit) in values[0].items():
        b, _ = values[1].get(name, (math.nan, ""))
        if abs(b - a) > ROUNDING * abs(a) or not math.isfinite(b):
            yield _row(name, None, a, b, unit, math.nan)
    if len(betas) == 2 and betas[0].shape == betas[1].shape:
        beat = np.sqrt(np.mean((betas[1] / betas[0] - 1) ** 2, axis=0))
        for plane, size in zip("xy", beat.tolist(), strict=True):
            if size > ROUNDING:
                yield _row(f"beta beating {plane}, rms", None, 0.0, size, "relative", math.nan)


# --- orbit responses ------------------------------------------------------------------------------
def _responses(one: OrbitResponse, other: OrbitResponse) -> Found:
    """Each corrector's orbits per kick, and the RF's per step, at the first one's."""
    monitors = [name for name in one.monitors if name in set(other.monitors)]
    if not monitors:
        raise MeasurementError("the two orbit responses have no BPM in common; check the names")
    here, there = (_columns(own.select(monitors=monitors)) for own in (one, other))
    rows = [
        row for name in here if name in there for row in _of_orbits(name, here[name], there[name])
    ]
    notes = []
    for which, own, other_names in (
        ("first", one.correctors, set(other.correctors)),
        ("second", other.correctors, set(one.correctors)),
    ):
        alone = [name for name in own if name not in other_names]
        if alone:
            notes.append(f"{len(alone)} correctors only in the {which}, such as {alone[0]}")
    return rows, notes


Column = tuple[np.ndarray, np.ndarray, float]
"""Orbit and variance of its readings, [monitor, 2], and kick, or step of the RF."""


def _columns(own: OrbitResponse) -> dict[str, Column]:
    """The columns of a response by the corrector; `rf`: that of the RF."""
    variance = np.full(own.response.shape[1:], np.nan) if own.noise is None else own.noise**2
    columns = zip(own.correctors, own.response, own.kicks.tolist(), strict=True)
    found: dict[str, Column] = {name: (orbit, variance, kick) for name, orbit, kick in columns}
    if own.rf is not None and own.rf.orbit is not None:
        found["rf"] = (own.rf.orbit, variance, own.rf.step)
    return found


def _of_orbits(name: str, first: Column, second: Column) -> Iterator[Difference]:
    (a, own, kick), (b, more, other_kick) = first, second
    b = b * kick / other_kick
    read = np.isfinite(a) & np.isfinite(b)
    if not read.any():
        return
    a, b, own = a[read], b[read], own[read]
    variance = own + more[read] * (kick / other_kick) ** 2
    expected = float(np.sqrt(np.mean(variance)))
    yield Difference(ORBIT, name, rms(a), rms(b), rms(b - a), expected, "m")
    square = float(a @ a) - float(np.nansum(own))  # without what the noise adds to it
    if square > 0:
        scale = float(a @ b) / square
        sigma = float(np.sqrt((a**2) @ variance)) / square
        yield _row("response per kick, relative", name, 1.0, scale, "relative", sigma)


_KINDS: dict[str, tuple[type, str, Callable[[Any, Any], Found]]] = {
    "diagnoses": (Diagnosis, "a diagnosis", _diagnoses),
    "lattices": (Ring, "a lattice", _lattices),
    "orbit responses": (OrbitResponse, "an orbit response", _responses),
}
"""Class, words and comparison of what can be compared."""
