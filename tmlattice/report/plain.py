"""The whole report as plain text.

>>> print(report_text(diagnosis))
"""

from tmlattice.diagnosis.result import Diagnosis
from tmlattice.effects import CATALOGUE
from tmlattice.report.next_shot import next_text
from tmlattice.report.response_text import steps_text
from tmlattice.report.tables import (
    LARGE_TITLE,
    large_text,
    number_head,
    number_rows,
    optics_head,
    optics_rows,
)
from tmlattice.report.text import (
    CORRELATED,
    SUSPECTS,
    advice,
    columns,
    correlation_rows,
    finding_rows,
    gap_head,
    gap_rows,
    noise_text,
    sensitivity_rows,
    small_rows,
    suspect_rows,
    title,
    tune_texts,
    verdict_sentence,
    wrapped,
)

WIDTH = 100

MOST = 8
"""Tunes that are listed; the page has all."""


def report_text(diagnosis: Diagnosis, width: int = WIDTH) -> str:
    """The whole report as plain text.

    Args:
        diagnosis: of `diagnose`.
        width: columns.
    """
    lines = [*wrapped(f"{diagnosis.verdict.upper()}: {verdict_sentence(diagnosis)}", "", width)]
    for number, finding in enumerate(diagnosis.findings, 1):
        lines += ["", *wrapped(title(finding), f"{number}. ", width)]
        for name, text in finding_rows(finding):
            for i, part in enumerate(text.split("\n")):
                label = f"   {name if i == 0 else '':<13}"
                lines += wrapped(part, label, width)
    if diagnosis.suspects:
        lines += ["", *wrapped(SUSPECTS, "", width)]
        for kind, place, what in suspect_rows(diagnosis):
            lines += wrapped(f"{place}: {what}", f"   {kind:<13}", width)
    if diagnosis.correlations:
        lines += ["", *wrapped(CORRELATED, "", width)]
        for one, other, correlation in correlation_rows(diagnosis):
            lines += wrapped(f"{one}; {other}: {correlation}", "   ", width)
    more = next_text(diagnosis) or advice(diagnosis)
    if more:
        lines += ["", *wrapped(more, "Next: ", width)]
    lines += ["", *_gap_table(diagnosis)]
    for topic in ("gap", "remainder"):
        lines += wrapped(diagnosis.assessment.sentence(topic), "", width)
    small = small_rows(diagnosis)
    if small:
        lines += ["", "Small errors everywhere:"]
        size = max(len(name) for name, _ in small)
        for name, text in small:
            lines += wrapped(text, f"   {name:<{size}}   ", width)
    if diagnosis.steps:
        if optics := optics_rows(diagnosis):
            lines += ["", *columns([optics_head(diagnosis), *optics])]
        lines += ["", *steps_text(diagnosis, width)]
    if diagnosis.verdict == "none":
        rows = sensitivity_rows(diagnosis, [n for n, e in CATALOGUE.items() if e.headline])
        if rows:
            lines += ["", "Would have been seen, at half of the places where it can sit, from:"]
            lines += columns(rows, "   ")
    if large := large_text(diagnosis):
        lines += ["", *wrapped(f"{LARGE_TITLE}: {large}", "Note: ", width)]
    for warning in diagnosis.warnings:
        lines += ["", *wrapped(warning, "Note: ", width)]
    return "\n".join(lines)


def _gap_table(diagnosis: Diagnosis) -> list[str]:
    before, after = tune_texts(diagnosis)
    rows = [
        gap_head(diagnosis),
        *gap_rows(diagnosis),
        ("fractional tunes Qx, Qy", before, after),
    ]
    noise = noise_text(diagnosis)
    lines = columns([*rows, ("noise of a reading", noise, "")] if noise else rows)
    numbers = number_rows(diagnosis)
    if numbers:
        lines += ["", *columns([number_head(diagnosis), *numbers[:MOST]])]
        lines += [f"and {len(numbers) - MOST} more"] if len(numbers) > MOST else []
    return lines
