"""Tables of the page: every error with its standard error, and the notes.

>>> [table.title for table in error_tables(diagnosis)]
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from tmlattice.arrays import rms
from tmlattice.diagnosis.consequences import Beam, beam_with
from tmlattice.diagnosis.result import Diagnosis
from tmlattice.diagnosis.support import FREE, Support
from tmlattice.effects import Cause, RingEffect, find
from tmlattice.measurement.assume import ASSUMPTIONS
from tmlattice.report.action_texts import SETTLED
from tmlattice.report.amounts import degenerate_text, digits_of, labelled, scaled, words
from tmlattice.report.text import times_usual
from tmlattice.speaks import listed

TITLES = {"monitors": "BPMs", "correctors": "Correctors"}
"""Titles by the group of an effect; all other elements are magnets."""

Supported = tuple[Cause, float, Support]
"""A cause, its standard error, and its support by the data."""


@dataclass(frozen=True)
class Table:
    """Elements with all amounts that were fitted to them.

    Attributes:
        title: of what.
        head: of the columns: the name, then numbers.
        rows: one an element, those furthest from zero in units of their errors first.
    """

    title: str
    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


def error_tables(diagnosis: Diagnosis) -> list[Table]:
    """Tables of magnets, BPMs, correctors and the beam of a hierarchical fit, value and error of
    each."""
    grouped: dict[str, list[Supported]] = {}
    for row in diagnosis.supported:
        title = TITLES.get(find(row[0].effect).group, "Magnets")
        title = "Beam" if row[0].element is None else title
        grouped.setdefault(title, []).append(row)
    return [
        _table(diagnosis, title, grouped[title])
        for title in ("Magnets", *TITLES.values(), "Beam")
        if title in grouped
    ]


def _table(diagnosis: Diagnosis, title: str, supported: Sequence[Supported]) -> Table:
    effects = list(dict.fromkeys(cause.effect for cause, *_ in supported))
    places = {element.name: element.s for element in diagnosis.ring.elements}
    known = {(c.element or "", c.effect): (c.amount, sigma, own) for c, sigma, own in supported}
    units = {}
    for effect in effects:
        typical = rms([c.amount for c, *_ in supported if c.effect == effect])
        units[effect] = scaled(effect, typical)
    names = list(dict.fromkeys(cause.element or "" for cause, *_ in supported))

    def clearest(name: str) -> float:
        own = (known.get((name, effect), (0.0, 1.0, FREE)) for effect in effects)
        return max(abs(amount) / sigma if sigma > 0 else 0.0 for amount, sigma, _ in own)

    names.sort(key=clearest, reverse=True)
    known_devices = any(name in diagnosis.devices for name in names)
    rows = []
    for name in names:
        cells = [name or "the beam", _number(places.get(name, np.nan), 2)]
        cells += [diagnosis.devices.get(name, "")] if known_devices else []
        open_ = []
        for effect in effects:
            if (name, effect) not in known:
                cells += ["", "", ""]
                continue
            factor, _ = units[effect]
            amount, sigma, support = known[name, effect]
            digits = 4 if not 0 < factor * sigma < np.inf else digits_of(factor * sigma)
            if not support.determined:
                amount = np.nan
                open_.append(f"{find(effect).label}: {degenerate_text(effect, support)}")
            cells += [_number(factor * value, digits) for value in (amount, sigma)]
            cells.append(f"{100 * support.share_from_data:.0f}")
        rows.append((*cells, "; ".join(open_)))
    head = ["name", "s [m]", *(["device"] if known_devices else [])]
    for effect in effects:
        head += [f"{find(effect).label} [{units[effect][1]}]", "error", "from the data [%]"]
    return Table(title, (*head, "not determined by the data"), tuple(rows))


def _number(value: float, digits: int) -> str:
    return f"{value:.{digits}f}" if np.isfinite(value) else ""


MOST = 8
"""Outliers that a note names."""


def optics_rows(diagnosis: Diagnosis) -> list[tuple[str, str, str]]:
    """Head and rows of the stored beam on energy: (quantity, design, estimated). The closed orbit
    is listed where it was measured or a finding changes it: distributed errors do not determine it.
    Empty without errors of the ring."""
    effects = (find(cause.effect) for cause in diagnosis.causes)
    if not any(isinstance(own, RingEffect) and not own.acts_on_settings for own in effects):
        return []
    beams = beam_with(diagnosis.ring, [c for c in diagnosis.causes if c.element is not None])
    named = [own.consequences.found for own in diagnosis.findings if own.consequences]
    moved = any(beam and max(beam.orbit_rms) > SETTLED.orbit_rms[0] for beam in named)
    orbit = moved or "closed_orbit" in diagnosis.assessment.measured

    def pair(values: Sequence[float] | None, factor: float, digits: int) -> str:
        if values is None:
            return "unstable"
        return " / ".join(f"{factor * value:.{digits}f}" for value in values)

    def row(name: str, field: str, factor: float, digits: int) -> tuple[str, str, str]:
        found: Beam | None = beams.found
        return name, "", pair(None if found is None else getattr(found, field), factor, digits)

    tunes = pair(beams.design, 1, 5), pair(None if beams.found is None else beams.found.tunes, 1, 5)
    return [
        ("stored beam on energy", diagnosis.starting_model, "estimated"),
        ("fractional tunes, x / y", *tunes),
        row("beta beating, rms [%]", "beta_beat_rms", 100, 2),
        row("beta beating, largest [%]", "beta_beat_max", 100, 2),
        row("change of the dispersion, rms [mm]", "dispersion_rms", 1e3, 1),
        *([row("closed orbit, rms [µm]", "orbit_rms", 1e6, 1)] if orbit else []),
    ]


def number_rows(diagnosis: Diagnosis) -> list[tuple[str, ...]]:
    """Head and rows of tunes and chromaticities: (name, measured with its error, of the design, of
    the estimated ring), with the measurement and the shot where there are several. Empty where none
    was read."""
    rows: list[tuple[str, ...]] = []
    with_numbers = [part for part in diagnosis.parts if part.numbers]
    for part in with_numbers:
        several = len({number.shot for number in part.numbers}) > 1
        for number in part.numbers:
            kind, _, plane = number.quantity.partition("_")
            name = f"Q{plane}" if kind == "tune" else f"chromaticity {plane}"
            name += f", shot {number.shot + 1}" if several else ""
            name = f"{part.label}: {name}" if len(with_numbers) > 1 else name
            digits = digits_of(number.error)
            read, *models, error = (
                f"{value:.{digits}f}"
                for value in (number.read, number.before, number.after, number.error)
            )
            rows.append((name, f"{read} ± {error}", *models))
    return [("tunes", "read", diagnosis.starting_model, "estimated"), *rows] if rows else []


LARGE = 3.0
"""Ratio to the usual size from which on distributed errors can hide faults."""


def large_text(diagnosis: Diagnosis) -> str:
    """A sentence about distributed errors that are large enough to hide single faults."""
    if diagnosis.by_families:
        return ""
    large = []
    for name in diagnosis.priors:
        times = times_usual(diagnosis, name)
        if times is not None and times > LARGE:
            large.append(f"{words(name)} ({times:.2g} times)")
    if not large:
        return ""
    text = f"{', '.join(large)}: they can hide faults"
    if diagnosis.assessment.reference:
        return text
    return f"{text}, which an earlier measurement of this machine (--reference) would show"


LARGE_TITLE = "large distributed errors"


def notes(diagnosis: Diagnosis, provenance: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Notes on what limits the diagnosis: (title, text)."""
    for warning in diagnosis.warnings:
        yield "warning", warning
    if large := large_text(diagnosis):
        yield LARGE_TITLE, large
    if diagnosis.bad_monitors:
        names = (labelled(name, diagnosis.devices) for name in diagnosis.bad_monitors)
        yield "rejected BPMs", ", ".join(names)
    if diagnosis.outliers:
        places = [
            f"{labelled(row['monitor'], diagnosis.devices)} {row['plane']}"
            + ("" if row.get("shot") is None else f" (shot {row['shot']}, turn {row['turn']})")
            for row in diagnosis.outliers
        ]
        yield "outliers", listed(places, MOST)
    for name in diagnosis.provenance["options"].get("assume", ()):
        yield "assumed of the data", f"{name}: {ASSUMPTIONS[name].words}"
    for said in provenance.get("assumed_of_files", ()):
        yield "assumed of the files", said
    for said in diagnosis.degenerate:
        yield "not determined by the data", said
