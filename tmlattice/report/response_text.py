"""What the diagnosis of an orbit response says, in words.

>>> print(response_text(result))
"""

import textwrap
from collections.abc import Iterable

import numpy as np

from tmlattice.diagnosis.response_result import ResponseDiagnosis, Step
from tmlattice.report.text import amount_text, words

WIDTH = 100
SHOWN = 8
"""Largest errors of each effect that are listed."""


def verdict_sentence(result: ResponseDiagnosis) -> str:
    """What was found, in a sentence."""
    if result.verdict == "nothing":
        return "No error is seen: the design explains the readings within their noise."
    first, last = result.steps[0], result.steps[-1]
    return (
        "Many small errors all along the ring: with them the gap on held-out correctors falls from "
        f"{1e6 * first.heldout_rms_in_plane:.1f} to {1e6 * last.heldout_rms_in_plane:.1f} µm, in "
        f"the other plane from {1e6 * first.heldout_rms_coupling:.1f} to "
        f"{1e6 * last.heldout_rms_coupling:.1f} µm, and that of the RF's response from "
        f"{1e6 * first.dispersion_rms:.0f} to {1e6 * last.dispersion_rms:.0f} µm."
    )


def step_rows(steps: Iterable[Step]) -> list[tuple[str, ...]]:
    """Effect, parameters, and the held-out figures in µm."""
    return [
        (
            step.effect,
            str(step.parameters),
            f"{1e6 * step.heldout_rms_in_plane:.3g}",
            f"{1e6 * step.heldout_rms_position:.3g}",
            f"{1e6 * step.heldout_rms_coupling:.3g}",
            f"{1e6 * step.heldout_rms_roll:.3g}" if np.isfinite(step.heldout_rms_roll) else "",
            f"{1e6 * step.dispersion_rms:.3g}",
            f"{step.heldout_chi2_per_dof:.3g}",
        )
        for step in steps
    ]


HEAD = ("step", "parameters", "in-plane", "with jump", "coupling", "with roll", "RF", "chi2")


HYPOTHESIS = (
    "hypothesis", "amounts", "amount", "unit", "sensible", "in-plane", "jump", "on top", "so",
)  # fmt: skip


def hypothesis_rows(result: ResponseDiagnosis) -> list[tuple[str, ...]]:
    """Each hypothesis: amount and its error (of several: rms, typical error), held-out figures."""
    return [
        (
            row.effect,
            str(row.parameters),
            f"{row.amount:.2g} ± {row.amount_sigma:.1g}" if row.parameters else "",
            row.unit,
            row.expected,
            f"{1e6 * row.heldout_rms_in_plane:.3g}",
            f"{1e6 * row.heldout_rms_position:.3g}",
            f"{1e6 * row.on_top_in_plane:.3g}",
            row.judgement,
        )
        for row in result.hypotheses or ()
    ]


def largest(result: ResponseDiagnosis, effect: str) -> list[str]:
    """The errors of an effect that are furthest from zero, with their posterior rms."""
    rows = [(c, s) for c, s in zip(result.causes, result.errors, strict=True) if c.effect == effect]
    rows.sort(key=lambda row: -abs(row[0].amount))
    return [
        f"{c.element or 'the beam'} {amount_text(c.effect, c.amount, s)}" for c, s in rows[:SHOWN]
    ]


def left_sentence(result: ResponseDiagnosis) -> str:
    """What stays: noise, or patterns."""
    left = result.left
    x, y = left.low_rank
    return (
        f"Of the fitted readings {np.sqrt(left.chi2_per_dof):.1f} times the noise is left; eight "
        f"patterns hold {100 * x:.0f} % of it in x and {100 * y:.0f} % in y."
    )


def response_text(result: ResponseDiagnosis, width: int = WIDTH) -> str:
    """The whole report as plain text."""
    lines = _wrapped(f"{result.verdict.upper()}. {verdict_sentence(result)}", width)
    lines += ["", "Held-out correctors, rms in µm (chi2 per reading):", *_columns(
        [HEAD, *step_rows(result.steps)]
    )]  # fmt: skip
    if result.refused:
        lines += ["", "Refused, for they did not help or spoilt the RF's response:"]
        lines += _columns([HEAD, *step_rows(result.refused)])
    bad = ", ".join(result.bad_monitors) or "none"
    lines += ["", *_wrapped(f"Bad monitors, left out: {bad}", width)]
    for effect in dict.fromkeys(c.effect for c in result.causes):
        amounts = [c.amount for c in result.causes if c.effect == effect]
        rms = amount_text(effect, float(np.sqrt(np.mean(np.square(amounts)))))
        lines += ["", *_wrapped(f"{words(effect)}: {len(amounts)}, rms {rms}; largest:", width)]
        lines += _wrapped("; ".join(largest(result, effect)), width, "   ")
    lines += ["", *_wrapped(left_sentence(result), width)]
    if result.hypotheses:
        lines += [
            "",
            "What may be missing: held-out rms in µm, each alone, and on top of those that help:",
        ]
        lines += _columns([HYPOTHESIS, *hypothesis_rows(result)])
    for said in result.degenerate:
        lines += _wrapped(f"Not settled by the data: {said}.", width)
    for warning in result.warnings:
        lines += ["", *_wrapped(f"Note: {warning}", width)]
    return "\n".join(lines)


def _columns(rows: list[tuple[str, ...]]) -> list[str]:
    sizes = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    return [
        "   ".join(
            cell.ljust(size) if i == 0 else cell.rjust(size)
            for i, (cell, size) in enumerate(zip(row, sizes, strict=True))
        )
        for row in rows
    ]


def _wrapped(text: str, width: int, indent: str = "") -> list[str]:
    return textwrap.wrap(
        text, width, initial_indent=indent, subsequent_indent=indent, break_on_hyphens=False
    )
