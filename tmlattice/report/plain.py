"""The whole report as plain text.

>>> print(report_text(diagnosis))
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

from tmlattice.diagnosis.result import Diagnosis
from tmlattice.effects import CATALOGUE
from tmlattice.report.action_texts import next_text
from tmlattice.report.response_text import steps_text
from tmlattice.report.tables import LARGE_TITLE, large_text, number_rows, optics_rows
from tmlattice.report.text import (
    CORRELATED,
    SUSPECTS,
    WIDTH,
    advice,
    columns,
    correlation_rows,
    finding_rows,
    gap_rows,
    noise_text,
    sensitivity_rows,
    small_rows,
    suspect_rows,
    title,
    tune_row,
    verdict_sentence,
    wrapped,
)

MOST = 8
"""Tunes that are listed; the page has all."""


def report_text(diagnosis: Diagnosis, width: int = WIDTH, most: int | None = None) -> str:
    """Return the report as plain text (most: lines at most, as on a terminal: the least important
    parts are left out, and the last line names them. None: the whole report)."""
    parts = [part for part in _parts(diagnosis, width) if part.lines]
    kept, left = set(range(len(parts))), []
    if most is not None:
        room = most - 3  # the line on what is left out, wrapped
        all_findings = True
        for i in sorted(kept, key=lambda i: (parts[i].rank, i)):
            finding, need = parts[i].name.startswith("finding"), len(parts[i].lines) + 1
            if parts[i].rank and (need > room or (finding and not all_findings)):
                kept.discard(i)
                all_findings &= not finding  # none without those before it
            else:
                room -= need
        left = list(dict.fromkeys(p.name for i, p in enumerate(parts) if i not in kept))
    lines = [line for i in sorted(kept) for line in ("", *parts[i].lines)][1:]
    if left:
        lines += ["", *wrapped(f"More in report.txt of --out DIR: {', '.join(left)}.", "", width)]
    return "\n".join(lines)


class _Part(NamedTuple):
    """A paragraph; parts of a higher rank are left out first, those of rank 0 never."""

    rank: int
    name: str
    lines: Sequence[str]


def _parts(diagnosis: Diagnosis, width: int) -> Iterator[_Part]:
    """Yield the paragraphs of a report in their order."""
    sentence = f"{diagnosis.verdict.upper()}: {verdict_sentence(diagnosis)}"
    yield _Part(0, "verdict", wrapped(sentence, "", width))
    for number, finding in enumerate(diagnosis.findings, 1):
        lines = [*wrapped(title(finding), f"{number}. ", width)]
        for name, text in finding_rows(finding):
            for i, part in enumerate(text.split("\n")):
                label = f"   {name if i == 0 else '':<13}"
                lines += wrapped(part, label, width)
        yield _Part(1 + number, f"finding {number}", lines)
    if diagnosis.suspects:
        lines = [*wrapped(SUSPECTS, "", width)]
        for kind, place, what in suspect_rows(diagnosis):
            lines += wrapped(f"{place}: {what}", f"   {kind:<13}", width)
        yield _Part(4, "suspects", lines)
    if diagnosis.correlations:
        lines = [*wrapped(CORRELATED, "", width)]
        for one, other, correlation in correlation_rows(diagnosis)[1:]:
            lines += wrapped(f"{one}; {other}: {correlation}", "   ", width)
        yield _Part(9, "correlations", lines)
    if more := next_text(diagnosis) or advice(diagnosis):
        yield _Part(1, "next", wrapped(more, "Next: ", width))
    lines = _gap_table(diagnosis, width)
    for topic in ("gap", "remainder"):
        lines += wrapped(diagnosis.assessment.sentence(topic), "", width)
    yield _Part(1, "validation", lines)
    if small := small_rows(diagnosis):
        lines = ["Distributed errors:", *columns([("effect", "rms"), *small], width)]
        yield _Part(6, "distributed errors", lines)
    if diagnosis.steps:
        if optics := optics_rows(diagnosis):
            yield _Part(5, "optics", columns(optics, width))
        paragraph: list[str] = []
        for line in [*steps_text(diagnosis, width), ""]:
            if line:
                paragraph.append(line)
                continue
            yield _Part(7, "errors of the fit", paragraph)
            paragraph = []
    if diagnosis.verdict == "none":
        rows = sensitivity_rows(diagnosis, [n for n, e in CATALOGUE.items() if e.headline])
        if rows:
            head = ("effect", "detection limit, at half of its places")
            yield _Part(2, "sensitivity", columns([head, *rows], width))
    if large := large_text(diagnosis):
        yield _Part(3, "notes", wrapped(f"{LARGE_TITLE}: {large}", "Note: ", width))
    for warning in diagnosis.warnings:
        yield _Part(8, "notes", wrapped(warning, "Note: ", width))


def _gap_table(diagnosis: Diagnosis, width: int) -> list[str]:
    rows = [*gap_rows(diagnosis), tune_row(diagnosis)]
    noise = noise_text(diagnosis)
    lines = columns([*rows, ("noise of a reading", noise, "")] if noise else rows, width)
    numbers = number_rows(diagnosis)
    if numbers:
        lines += ["", *columns(numbers[: MOST + 1], width)]
        lines += [f"and {len(numbers) - MOST - 1} more"] if len(numbers) > MOST + 1 else []
    return lines
