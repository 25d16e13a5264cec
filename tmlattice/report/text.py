"""What a diagnosis says, in the words of a control room.

The same sentences and rows stand in the terminal (`plain.report_text`) and in the HTML page.
"""

import textwrap
from collections.abc import Iterable, Sequence

import numpy as np

from tmlattice.diagnosis.result import MUCH_MORE, Diagnosis, Finding
from tmlattice.effects import CATALOGUE, find
from tmlattice.inference.judge import Misfit
from tmlattice.report.amounts import amount_text, least_text, probability_text, words
from tmlattice.report.next_shot import next_text
from tmlattice.report.remedies import (
    consequence_text,
    mechanism_text,
    or_text,
    remedy_text,
    title,
)
from tmlattice.speaks import micrometres

__all__ = ["amount_text", "least_text", "probability_text", "title", "words"]  # of its page too


# --- words for parts ------------------------------------------------------------------------------
def place_text(finding: Finding) -> str:
    """Where a finding sits: metres, and the monitors on both sides."""
    if finding.s is None and finding.elements:
        return f"at {' and '.join(finding.elements)}"
    if finding.where is None:
        return "no place: the whole beam, or all elements of a kind"
    low, high = finding.where
    span = f"{low:.1f} m to {high:.1f} m"
    between = ""
    if finding.near:
        between = f" ({', '.join(finding.near)})"
        if len(finding.near) == 2 and finding.near[0] != finding.near[1]:
            between = f", between {finding.near[0]} and {finding.near[1]}"
    if finding.s is None:
        return f"s = {span}{between}"
    return f"s = {finding.s:.2f} m; from {span}{between}"


LARGER = 1.2
"""Times the chi-square after, from which that before is no noise alone."""

NOT_HELD_OUT = "Nothing was held out: nobody but the fit judges the gap"


def closed_text(diagnosis: Diagnosis) -> str:
    """How much of the gap is closed on held-out shots."""
    gap = diagnosis.heldout
    if gap is None:
        return NOT_HELD_OUT
    if diagnosis.by_steps and len(diagnosis.steps) < 2:
        return "Nothing was put into the model, so the gap stays"
    if diagnosis.findings and not diagnosis.causes:
        return (
            "What has no name cannot be put into the lattice, so the gap of the held-out shots "
            "stays"
        )
    if gap.closed is None and gap.lost:
        return (
            "The beam of held-out shots is lost in one of the models, so they do not judge the gap"
        )
    before, after = gap.misfits[gap.since], gap.misfits[-1]
    if gap.closed is None and before.chi2_per_dof > LARGER * after.chi2_per_dof:
        return (
            f"Held-out readings are left with {micrometres(before.rms)} before and "
            f"{micrometres(after.rms)} after: too little to say which share of the gap is closed"
        )
    if gap.closed is None:
        return "Held-out readings show no gap beyond the noise, so there is none to close"
    text = f"{100 * gap.closed:.1f} % of the gap beyond the noise is closed on held-out readings"
    if gap.interval is not None:
        low, high = gap.interval
        text += f" (95 % interval {100 * low:.1f} to {100 * high:.1f} %)"
    if diagnosis.priors and after.expected is not None:
        rms = [f"{1e6 * step.rms:.3g}" for step in gap.misfits]
        added = ["the design", "with small errors", "with what was found"][: len(rms)]
        text += ": " + ", ".join(f"{a} {b} µm" for a, b in zip(added, rms, strict=False))
        text += f"; {1e6 * after.expected:.3g} µm are to be expected of it"
    return text


HARDLY = 0.5
"""Relative error of a size of small errors from which on it is more a guess."""


def small_rows(diagnosis: Diagnosis) -> list[tuple[str, str]]:
    """Small errors everywhere: (effect, rms and how many times the usual one)."""
    rows = []
    for name, rms in diagnosis.priors.items():
        if name in CATALOGUE and not diagnosis.by_steps:
            usual = CATALOGUE[name].background
            times = f", {rms / usual:.2g} times the usual one" if usual else ""
            if diagnosis.prior_errors.get(name, 0.0) > HARDLY:
                times = "; taken, for these readings do not determine it"
            elif not diagnosis.explains:
                times = "; what this model does not explain is part of it"
            rows.append((words(name), f"{amount_text(name, rms)} rms{times}"))
    return rows


# --- the sentences --------------------------------------------------------------------------------
def verdict_sentence(diagnosis: Diagnosis) -> str:
    """What was found, in a sentence."""
    if not diagnosis.since_reference:
        return _verdict_sentence(diagnosis)
    if diagnosis.verdict == "nothing":
        return (
            "Nothing changed since the reference but what monitors, correctors and magnets drift "
            "by anyway."
        )
    return f"Since the reference: {_verdict_sentence(diagnosis)}"


def _verdict_sentence(diagnosis: Diagnosis) -> str:
    found = diagnosis.findings
    if diagnosis.verdict == "named":
        many = f"{len(found)} faults: " if len(found) > 1 else ""
        return many + "; ".join(_short(finding) for finding in found) + "."
    if diagnosis.verdict == "equivalent":
        return "; ".join(_open(finding) for finding in found) + "."
    if diagnosis.verdict == "located":
        return _located_sentence(diagnosis)
    if diagnosis.verdict == "distributed" and diagnosis.steps:
        return steps_sentence(diagnosis)
    if diagnosis.verdict == "distributed" and diagnosis.priors:
        much = "the readings" if diagnosis.explains else "much, not all"
        everywhere = f"Small errors all along the ring explain {much}"
        return f"{everywhere}; no single fault stands out among them."
    if diagnosis.verdict == "distributed":
        return (
            "The data differ from the model all along the ring; no single place, and no few "
            "places, explain it."
        )
    return "No error is seen: the design explains the readings within their noise."


def _located_sentence(diagnosis: Diagnosis) -> str:
    found = diagnosis.findings
    unknown = [f.where for f in found if f.effect is None and f.where and not f.words]
    where = "; ".join(f"{low:.1f} m to {high:.1f} m" for low, high in unknown)
    acts = f"Something acts at s = {where}, and no effect of the catalogue explains it."
    told = [f"{f.words[0].upper()}{f.words[1:]}." for f in found if f.words]
    named = [_short(f) for f in found if f.effect is not None]
    also = [f"Besides: {'; '.join(named)}."] if named else []
    also += [steps_sentence(diagnosis)] if _errors_in_steps(diagnosis) else []
    return " ".join([*([acts] if unknown else []), *told, *also])


def _errors_in_steps(diagnosis: Diagnosis) -> bool:
    """Whether steps were kept that are errors of the ring, and no drifts since a reference."""
    return len(diagnosis.steps) > 1 and not diagnosis.since_reference


def steps_sentence(diagnosis: Diagnosis) -> str:
    """How far the steps go."""
    first, last = diagnosis.steps[0], diagnosis.steps[-1]
    return (
        "Small errors all along the ring, or of correctors: with them the gap of fitted correctors "
        f"falls from {micrometres(diagnosis.fit_before.rms)} to "
        f"{micrometres(diagnosis.fit_after.rms)}, that of held-out ones from "
        f"{micrometres(first.heldout_rms_in_plane)} to {micrometres(last.heldout_rms_in_plane)}"
        + (
            f", in the other plane from {micrometres(first.heldout_rms_coupling)} to "
            f"{micrometres(last.heldout_rms_coupling)}"
            if np.isfinite(last.heldout_rms_coupling)
            else ""
        )
        + (
            ", and that of the RF's response from "
            f"{micrometres(first.dispersion_rms)} to {micrometres(last.dispersion_rms)}."
            if np.isfinite(last.dispersion_rms)
            else "."
        )
    )


def _short(finding: Finding) -> str:
    if finding.remedy is None:
        if finding.words:
            return finding.words
        low, high = finding.where or (float("nan"), float("nan"))
        return f"something unnamed at {low:.1f} m to {high:.1f} m"
    return remedy_text(finding.remedy)


SAID = 2
"""Other remedies that a sentence names."""


def _open(finding: Finding) -> str:
    """A finding, and what else it may be."""
    text, others = _short(finding), finding.remedies[1:]
    if not others:
        return text
    more = len(others) - SAID
    also = [remedy_text(remedy) for remedy in others[:SAID]]
    also += [f"{more} more"] if more > 0 else []
    chance = probability_text(finding.probability)
    return f"likeliest ({chance}) {text}; the data do not exclude " + ", or ".join(also)


def advice(diagnosis: Diagnosis) -> str:
    """What to do next, where the result leaves something open and no shot was proposed."""
    everywhere = (
        "Look at what stands out of its kind, set the gradients that --repaired-out writes, and "
        "measure again."
    )
    if diagnosis.verdict == "distributed" and diagnosis.steps:
        return everywhere
    if diagnosis.verdict == "distributed" and diagnosis.has_reference:
        return "More shots, with other launches, show a fault that small errors hide."
    if diagnosis.verdict == "distributed" and diagnosis.priors:
        return (
            "A measurement of this machine from before the fault (--reference) shows a fault that "
            "small errors hide."
        )
    if diagnosis.verdict == "distributed":
        return (
            "Small errors everywhere look like this: state them (--background all), or give a "
            "measurement of this machine from before the fault (--reference)."
        )
    checks = dict.fromkeys(f.to_check for f in diagnosis.findings if f.to_check)
    if diagnosis.verdict == "located" and checks:
        return " ".join([*checks, *([everywhere] if _errors_in_steps(diagnosis) else [])])
    if diagnosis.verdict == "located":
        return (
            "Look at what stands there: hardware, apertures, cables of the monitors. More launches "
            "tell whether it is constant, linear or not, or changes from shot to shot."
        )
    return ""


def headline(diagnosis: Diagnosis) -> str:
    """What was found, short where the findings are listed below."""
    found = diagnosis.findings
    if len(found) < 2:
        return verdict_sentence(diagnosis)
    several = [str(n) for n, finding in enumerate(found, 1) if finding.verdict == "equivalent"]
    unnamed = [str(n) for n, f in enumerate(found, 1) if f.verdict == "located" and not f.words]
    since = "Since the reference: " if diagnosis.since_reference else ""
    text = f"{since}{len(found)} findings."
    if several:
        text += f" More than one explanation fits: {', '.join(several)}."
    if unnamed:
        text += f" No effect of the catalogue explains {', '.join(unnamed)}."
    return text


def to_do(diagnosis: Diagnosis) -> list[str]:
    """What to do next, the first first: repairs, then what would tell more."""
    remedies = [finding.remedy for finding in diagnosis.findings if finding.remedy is not None]
    done = [f"{remedy.action[0].upper()}{remedy.action[1:]}." for remedy in remedies]
    if len(diagnosis.findings) == 1 and remedies:
        done = [f"{done[0]} First: {find(remedies[0].effect).to_check}"]
    more = next_text(diagnosis) or advice(diagnosis)
    return [*done, more] if more else done


def gap_sentence(diagnosis: Diagnosis) -> str:
    """How far the gap falls, on the readings that judge."""
    rows = gap_rows(diagnosis)
    judges = rows if diagnosis.heldout is None else rows[-1:]
    return "; ".join(f"{name}: from {before} to {after}" for name, before, after in judges)


def left_text(diagnosis: Diagnosis) -> str:
    """What is left when all that was found is in the model."""
    p_value = diagnosis.unexplained["p_value"]
    places = diagnosis.unexplained["places"]
    how = "noise" if p_value >= 0.01 else "slightly more than the noise"
    how = how if p_value >= MUCH_MORE else "more than the noise"
    text = f"What is left is {how} ({_chance(p_value)})"
    if diagnosis.noise_estimated:
        text += "; the noise was taken from the same data, which weakens this check"
    if places:
        spans = "; ".join(f"{p['s_from']:.1f} m to {p['s_to']:.1f} m" for p in places)
        text += f". It sits at s = {spans}"
    return text + "."


# --- the rows -------------------------------------------------------------------------------------
def finding_rows(finding: Finding) -> list[tuple[str, str]]:
    """What is known of a finding: (name, text)."""
    rows = []
    remedy = finding.remedy
    if remedy is not None:
        rows += [("remedy", remedy.action), ("check", find(remedy.effect).to_check)]
    elif finding.to_check:
        rows.append(("check", finding.to_check))
    rows.append(("place", place_text(finding)))
    consequence = consequence_text(finding)
    if consequence:
        rows.append(("stored beam", consequence))
    if remedy is not None:
        rows.append(("probability", probability_text(finding.probability)))
    rows.append(("seen", _seen_text(finding)))
    if finding.seen_by is not None and len(finding.seen_by) > 1:
        by = sorted(finding.seen_by.items(), key=lambda pair: -pair[1])
        told = ", ".join(f"{100 * share:.0f} % {name}" for name, share in by if share > 0.005)
        rows.append(("seen by", told))
    if remedy is not None:
        rows.append(("mechanism", mechanism_text(remedy)))
    if len(finding.remedies) > 1:
        rows.append(("or else", or_text(finding, MOST)))
    return rows


def _seen_text(finding: Finding) -> str:
    found = finding.detection
    if not np.isfinite(found.statistic):
        return "in the readings themselves, before any fit"
    text = f"statistic {found.statistic:.4g}, threshold {found.threshold:.3g}"
    return f"{text}, {_chance(found.p_value)} for the whole scan"


def _chance(p_value: float) -> str:
    return "p < 1e-12" if p_value < 1e-12 else f"p = {p_value:.2g}"


MOST = 6
"""Other remedies that a finding lists."""


def gap_rows(diagnosis: Diagnosis) -> list[tuple[str, str, str]]:
    """The gap: (which readings, before, after), rms in µm and chi-square per reading."""
    what = "correctors" if diagnosis.by_steps else "readings" if diagnosis.parts else "shots"
    rows = [(f"{what} of the fit", diagnosis.fit_before, diagnosis.fit_after)]
    if len(diagnosis.parts) > 1:
        rows = [(part.label, part.before, part.after) for part in diagnosis.parts]
    gap = diagnosis.heldout
    if gap is not None:
        rows.append(
            (f"held out ({heldout_text(diagnosis)})", gap.misfits[gap.since], gap.misfits[-1])
        )
    return [
        (name, *(_misfit_text(m) for m in (before, after)))  # type: ignore[misc]
        for name, before, after in rows
    ]


def _misfit_text(misfit: Misfit) -> str:
    size = f"{micrometres(misfit.rms)}, " if np.isfinite(misfit.rms) else ""
    return f"{size}chi² {_chi2(misfit.chi2_per_dof)}"


def heldout_text(diagnosis: Diagnosis) -> str:
    """Who judges."""
    if diagnosis.kind == "trajectory":
        return f"shots {', '.join(map(str, diagnosis.heldout_shots))}"
    if not diagnosis.by_steps:
        return "at half of the monitors"
    return f"{int(diagnosis.response.held.sum())} correctors"


def _chi2(value: float) -> str:
    return f"{value:.2f}" if value < 100 else f"{value:.3g}"


def noise_text(diagnosis: Diagnosis) -> str:
    """The noise of a reading; empty where no monitor reads."""
    if not np.isfinite(diagnosis.noise).any():
        return ""
    x, y = (micrometres(sigma) if np.isfinite(sigma) else "no reading"
            for sigma in diagnosis.noise)  # fmt: skip
    return f"{x} in x, {y} in y" + (" (estimated)" if diagnosis.noise_estimated else "")


def tune_texts(diagnosis: Diagnosis) -> tuple[str, str]:
    """Fractions of Qx, Qy before and after."""
    before, after = (
        "unstable" if q is None else f"{q[0]:.4f}, {q[1]:.4f}"
        for q in (diagnosis.tunes["before"], diagnosis.tunes["after"])
    )
    return before, after


def sensitivity_rows(
    diagnosis: Diagnosis, effects: Iterable[str] | None = None
) -> list[tuple[str, str]]:
    """By effect in words, the least amount that would have been seen at half of its places."""
    known = diagnosis.sensitivity
    chosen = known if effects is None else effects
    return [(words(name), least_text(name, known[name])) for name in chosen if name in known]


def suspect_rows(diagnosis: Diagnosis) -> list[tuple[str, str, str]]:
    """Where to look first where nothing explains the data: (kind, where, what would explain most).

    Suspects, not findings.
    """
    rows: list[tuple[str, str, str]] = []
    for one in diagnosis.suspects:
        low, high = one.where
        place = one.element
        if one.kind == "section":
            place = f"s = {low:.1f} m to {high:.1f} m"
            place += f", {' to '.join(dict.fromkeys(one.near))}" if one.near else ""
        what = "something without a name" if one.effect is None else words(one.effect)
        if one.kind == "section" and one.effect is not None:
            what += f", {one.element}"
        rows.append(
            (
                one.kind,
                place,
                f"{what} (statistic {one.statistic:.4g}, threshold {one.threshold:.3g})",
            )
        )
    return rows


# --- lines of text --------------------------------------------------------------------------------
def columns(rows: Sequence[Sequence[str]], indent: str = "", *, right: bool = False) -> list[str]:
    """Cells under one another; all but the first to the right, or to the left."""
    sizes = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    return [
        indent
        + "   ".join(
            cell.rjust(size) if right and i else cell.ljust(size)
            for i, (cell, size) in enumerate(zip(row, sizes, strict=True))
        ).rstrip()
        for row in rows
    ]


def wrapped(text: str, label: str, width: int) -> list[str]:
    """Lines of at most this width, the label before the first one."""
    return textwrap.wrap(
        text,
        width,
        initial_indent=label,
        subsequent_indent=" " * len(label),
        break_on_hyphens=False,
        break_long_words=False,
    )
