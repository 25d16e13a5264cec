"""Sentences and rows of a report, for the terminal (`plain.report_text`) and the HTML page."""

import re
import textwrap
from collections.abc import Iterable, Sequence
from itertools import zip_longest

import numpy as np

from tmlattice.diagnosis.assessment import chance_text
from tmlattice.diagnosis.result import Diagnosis, Finding
from tmlattice.diagnosis.suspects import Suspect
from tmlattice.effects import CATALOGUE, find
from tmlattice.inference.validation import Misfit
from tmlattice.report.action_texts import (
    action_text,
    consequence_text,
    mechanism_text,
    next_text,
    or_text,
    title,
)
from tmlattice.report.amounts import (
    all_of,
    amount_text,
    labelled,
    least_text,
    probability_text,
    words,
)
from tmlattice.speaks import micrometres

__all__ = ["amount_text", "least_text", "probability_text", "title", "words"]  # of its page too


# --- words for parts ------------------------------------------------------------------------------
def place_text(finding: Finding) -> str:
    """The place of a finding: metres, and the BPMs on both sides."""
    devices = finding.devices
    if finding.s is None and finding.elements:
        return f"at {' and '.join(labelled(name, devices) for name in finding.elements)}"
    if finding.where is None:
        return "no place: the whole beam, or all elements of a kind"
    low, high = finding.where
    span = f"{low:.1f} m to {high:.1f} m"
    between = ""
    if finding.near:
        near = [labelled(name, devices) for name in finding.near]
        between = f" ({', '.join(near)})"
        if len(near) == 2 and near[0] != near[1]:
            between = f", between {near[0]} and {near[1]}"
    if finding.s is None:
        return f"s = {span}{between}"
    return f"s = {finding.s:.2f} m; from {span}{between}"


HARDLY = 0.5
"""Relative error of an rms above which the readings do not determine it."""


def small_rows(diagnosis: Diagnosis) -> list[tuple[str, str]]:
    """Distributed errors: (effect, rms; where the readings determine it, its ratio to the usual
    one)."""
    rows = []
    for name, rms in diagnosis.priors.items():
        if name in CATALOGUE and not diagnosis.by_families:
            times = times_usual(diagnosis, name)
            ratio = ", not determined by these readings"
            if name not in diagnosis.prior_errors:
                ratio = ", given, not estimated"
            elif times is not None:
                ratio = f", {times:.2g} times the usual one"
            rows.append((words(name), f"{amount_text(name, rms)}{ratio}"))
    return rows


def times_usual(diagnosis: Diagnosis, name: str) -> float | None:
    """The rms of distributed errors of an effect over the usual one; None where it is not
    determined, by a large relative error or because an effect is missing from the model."""
    usual = CATALOGUE[name].background if name in CATALOGUE else None
    error = diagnosis.prior_errors.get(name, np.inf)
    if not usual or error > HARDLY or diagnosis.assessment.remainder == "effect_missing":
        return None
    return diagnosis.priors[name] / usual


# --- the sentences --------------------------------------------------------------------------------
def verdict_sentence(diagnosis: Diagnosis) -> str:
    """The verdict, as a sentence."""
    text = diagnosis.assessment.sentence("verdict") or _verdict_sentence(diagnosis)
    if not diagnosis.since_reference or diagnosis.verdict == "none":
        return text
    return f"Since the reference: {text}"


def _verdict_sentence(diagnosis: Diagnosis) -> str:
    found = diagnosis.findings
    if diagnosis.verdict == "identified":
        many = f"{len(found)} faults: " if len(found) > 1 else ""
        return many + "; ".join(_short(finding) for finding in found) + "."
    if diagnosis.verdict == "ambiguous":
        return "; ".join(_open(finding) for finding in found) + "."
    if diagnosis.verdict == "localised":
        return _located_sentence(diagnosis)
    return steps_sentence(diagnosis)


def _located_sentence(diagnosis: Diagnosis) -> str:
    found = diagnosis.findings
    unknown = [f.where for f in found if f.effect is None and f.where and not f.words]
    where = "; ".join(f"{low:.1f} m to {high:.1f} m" for low, high in unknown)
    acts = f"Unexplained kick at s = {where}: no effect of the catalogue fits."
    stated = [f"{f.words[0].upper()}{f.words[1:]}." for f in found if f.words]
    named = [_short(f) for f in found if f.effect is not None]
    also = [f"Together with: {'; '.join(named)}."] if named else []
    also += [steps_sentence(diagnosis)] if _errors_in_steps(diagnosis) else []
    return " ".join([*([acts] if unknown else []), *stated, *also])


def _errors_in_steps(diagnosis: Diagnosis) -> bool:
    """Whether accepted families are errors of the ring, not drifts since a reference."""
    return len(diagnosis.steps) > 1 and not diagnosis.since_reference


def steps_sentence(diagnosis: Diagnosis) -> str:
    """The residuals before and after all steps."""
    first, last = diagnosis.steps[0], diagnosis.steps[-1]
    falls = [
        f", {what} from {micrometres(getattr(first, name))} to {micrometres(getattr(last, name))}"
        for what, name in (
            ("that of held-out ones", "heldout_rms_in_plane"),
            ("in the other plane", "heldout_rms_coupling"),
            ("of the RF's response", "dispersion_rms"),
        )
        if name == "heldout_rms_in_plane" or np.isfinite(getattr(last, name))
    ]
    return (
        "Distributed errors of the ring or of correctors: the rms residual of fitted correctors "
        f"falls from {micrometres(diagnosis.fit_before.rms)} to "
        f"{micrometres(diagnosis.fit_after.rms)}{''.join(falls)}."
    )


def _short(finding: Finding) -> str:
    if finding.recommended_action is None:
        if finding.words:
            return finding.words
        low, high = finding.where or (float("nan"), float("nan"))
        return f"an unexplained kick at {low:.1f} m to {high:.1f} m"
    return action_text(finding.recommended_action)


SAID = 2
"""Other recommended actions that a sentence names."""


def _open(finding: Finding) -> str:
    """A finding with its alternatives."""
    text, others = _short(finding), finding.recommended_actions[1:]
    if not others:
        return text
    more = len(others) - SAID
    also = [action_text(other) for other in others[:SAID]]
    also += [f"{more} more"] if more > 0 else []
    chance = probability_text(finding.probability)
    return f"most probable ({chance}) {text}; alternatives: " + ", or ".join(also)


def _after_families(diagnosis: Diagnosis) -> str:
    """The next step after a hierarchical fit: suspects, missing effect, gradients."""
    missing = diagnosis.assessment.remainder == "effect_missing" and diagnosis.hypotheses is None
    steps = ["inspect the suspects"] if diagnosis.suspects else []
    if missing and not diagnosis.since_reference:
        steps.append("compare missing effects (--missing)")
    if any(cause.effect == "quadrupole_gradient" for cause in diagnosis.causes):
        steps.append("set the gradients that --corrected-out writes")
    if not steps:
        return ""
    text = ", ".join(steps)
    return f"{text[0].upper()}{text[1:]}, and measure again."


def advice(diagnosis: Diagnosis) -> str:
    """What to do next if the result is open and no shot was proposed."""
    everywhere = _after_families(diagnosis)
    if diagnosis.verdict == "distributed" and diagnosis.by_families:
        return everywhere
    if text := diagnosis.assessment.sentence("reference"):
        return text
    checks = dict.fromkeys(f.to_check for f in diagnosis.findings if f.to_check)
    if diagnosis.verdict == "localised" and checks:
        more = everywhere if _errors_in_steps(diagnosis) else ""
        return " ".join([*checks, *([more] if more else [])])
    if diagnosis.verdict == "localised":
        return (
            "Inspect this section: hardware, apertures, cables of the BPMs. More launches show "
            "whether the kick is constant, linear or nonlinear, or changes from shot to shot."
        )
    return ""


def headline(diagnosis: Diagnosis) -> str:
    """The verdict; short where the findings are listed below."""
    found = diagnosis.findings
    if len(found) < 2:
        return verdict_sentence(diagnosis)
    several = [str(n) for n, finding in enumerate(found, 1) if finding.verdict == "ambiguous"]
    unnamed = [str(n) for n, f in enumerate(found, 1) if f.verdict == "localised" and not f.words]
    since = "Since the reference: " if diagnosis.since_reference else ""
    text = f"{since}{len(found)} findings."
    if several:
        text += f" More than one explanation fits: {', '.join(several)}."
    if unnamed:
        text += f" No effect of the catalogue explains {', '.join(unnamed)}."
    return text


def to_do(diagnosis: Diagnosis) -> list[str]:
    """What to do next, in order: corrections, then further measurements."""
    actions = [f.recommended_action for f in diagnosis.findings if f.recommended_action is not None]
    done = [f"{one.action[0].upper()}{one.action[1:]}." for one in actions]
    if len(diagnosis.findings) == 1 and actions:
        done = [f"{done[0]} First: {find(actions[0].effect).to_check}"]
    more = next_text(diagnosis) or advice(diagnosis)
    return [*done, more] if more else done


def gap_sentence(diagnosis: Diagnosis) -> str:
    """The rms residual before and after, on the validation set."""
    rows = gap_rows(diagnosis)
    shown = rows[1:] if diagnosis.heldout is None else rows[-1:]
    return "; ".join(f"{name}: from {before} to {after}" for name, before, after in shown)


# --- the rows -------------------------------------------------------------------------------------
def finding_rows(finding: Finding) -> list[tuple[str, str]]:
    """Rows of a finding: (name, text)."""
    rows = []
    action = finding.recommended_action
    if action is not None:
        rows += [("action", action.action), ("check", find(action.effect).to_check)]
    elif finding.to_check:
        rows.append(("check", finding.to_check))
    rows.append(("place", place_text(finding)))
    if consequence := consequence_text(finding):
        rows.append(("stored beam", consequence))
    if action is not None:
        rows.append(("probability", probability_text(finding.probability)))
    rows.append(("seen", _seen_text(finding)))
    if finding.seen_by is not None and len(finding.seen_by) > 1:
        by = sorted(finding.seen_by.items(), key=lambda pair: -pair[1])
        shares = ", ".join(f"{100 * share:.0f} % {name}" for name, share in by if share > 0.005)
        rows.append(("seen by", shares))
    if action is not None:
        rows.append(("mechanism", mechanism_text(action)))
    if len(finding.recommended_actions) > 1:
        rows.append(("alternatives", or_text(finding, MOST)))
    return rows


def _seen_text(finding: Finding) -> str:
    found = finding.detection
    if not np.isfinite(found.statistic):
        return "in the readings themselves, before any fit"
    text = f"statistic {found.statistic:.4g}, threshold {found.threshold:.3g}"
    return f"{text}, {chance_text(found.p_value)} for the whole scan"


MOST = 6
"""Other recommended actions that a finding lists."""


def gap_rows(diagnosis: Diagnosis) -> list[tuple[str, str, str]]:
    """Head and rows of the residuals of fitted and held-out readings, before and after: rms in µm
    and chi-square per reading."""
    model, gap = diagnosis.starting_model, diagnosis.heldout
    if gap is not None and gap.baseline and not diagnosis.since_reference:
        model = f"{model} with distributed errors" if diagnosis.priors else "before"
    what = "correctors" if diagnosis.by_families else "readings" if diagnosis.parts else "shots"
    rows = [(f"{what} of the fit", diagnosis.fit_before, diagnosis.fit_after)]
    if len(diagnosis.parts) > 1:
        rows = [(part.label, part.before, part.after) for part in diagnosis.parts]
    if gap is not None:
        rows.append(
            (f"held out ({heldout_text(diagnosis)})", gap.misfits[gap.baseline], gap.misfits[-1])
        )
    return [
        ("readings less model, rms", model, "with the findings"),
        *((name, _misfit_text(before), _misfit_text(after)) for name, before, after in rows),
    ]


def _misfit_text(misfit: Misfit) -> str:
    size = f"{micrometres(misfit.rms)}, " if np.isfinite(misfit.rms) else ""
    chi2 = misfit.chi2_per_dof
    return f"{size}chi² " + (f"{chi2:.2f}" if chi2 < 100 else f"{chi2:.3g}")


def heldout_text(diagnosis: Diagnosis) -> str:
    """The held-out readings."""
    if diagnosis.kind == "trajectory":
        return f"shots {', '.join(map(str, diagnosis.heldout_shots))}"
    if not diagnosis.by_families:
        return "at half of the BPMs"
    return f"{diagnosis.correctors_held_out} correctors"


def noise_text(diagnosis: Diagnosis) -> str:
    """The noise of a reading; empty without readings."""
    if not np.isfinite(diagnosis.noise).any():
        return ""
    x, y = (micrometres(sigma) if np.isfinite(sigma) else "no reading"
            for sigma in diagnosis.noise)  # fmt: skip
    return f"{x} in x, {y} in y" + (" (estimated)" if diagnosis.noise_estimated else "")


def tune_row(diagnosis: Diagnosis) -> tuple[str, str, str]:
    """Row of the fractions of Qx, Qy: (name, before, after)."""
    name = "tunes without orbit errors" if diagnosis.by_families else "fractional tunes Qx, Qy"
    before, after = (
        "unstable" if q is None else f"{q[0]:.4f}, {q[1]:.4f}"
        for q in (diagnosis.tunes["before"], diagnosis.tunes["after"])
    )
    return name, before, after


def sensitivity_rows(
    diagnosis: Diagnosis, effects: Iterable[str] | None = None
) -> list[tuple[str, str]]:
    """Detection limits: by effect, the least amount detectable at half of its places."""
    known = diagnosis.sensitivity
    chosen = known if effects is None else effects
    return [(words(name), least_text(name, known[name])) for name in chosen if name in known]


SUSPECTS = "Suspects, no findings: the first places to inspect for an undetected fault."


def suspect_rows(diagnosis: Diagnosis) -> list[tuple[str, str, str]]:
    """Rows of the suspects: (kind, place, effect)."""
    return [(one.kind, _suspected(diagnosis, one), _suspicion(one)) for one in diagnosis.suspects]


def _suspected(diagnosis: Diagnosis, one: Suspect) -> str:
    if one.kind != "section":
        return all_of(one.elements or (one.element,), diagnosis.devices)
    low, high = one.where
    place = f"s = {low:.1f} m to {high:.1f} m"
    near = [labelled(name, diagnosis.devices) for name in dict.fromkeys(one.near)]
    return f"{place}, {' to '.join(near)}" if near else place


def _suspicion(one: Suspect) -> str:
    what = "no effect of the catalogue" if one.effect is None else words(one.effect)
    if one.measure == "scatter" and one.effect is not None and one.amount is not None:
        amount = amount_text(one.effect, one.amount, one.amount_sigma)
        far = f"{one.statistic:.0f} times the scatter of its family from the median"
        return f"{what} {amount}, {far}"
    if one.kind == "section" and one.effect is not None:
        what += f", {one.element}"
    return f"{what} (statistic {one.statistic:.4g}, threshold {one.threshold:.3g})"


CORRELATED = "Correlated amounts: the data determine a combination of the two better than each."


def correlation_rows(diagnosis: Diagnosis) -> list[tuple[str, str, str]]:
    """Head and rows of strongly correlated amounts: (one, other, correlation)."""

    def named(effect: str, element: str | None) -> str:
        return f"{words(effect)}, {labelled(element or 'the beam', diagnosis.devices)}"

    return [
        ("one amount", "other amount", "correlation"),
        *(
            (named(*pair.first), named(*pair.second), f"{pair.correlation:+.3f}")
            for pair in diagnosis.correlations
        ),
    ]


# --- lines of text --------------------------------------------------------------------------------
WIDTH = 100
"""Columns of a report that is not for a terminal."""
BOUND = re.compile(
    r"(?<=\d) (?=(?:±|%|[mµ]?m|to)(?: |$))|(?<=±) |(?<=[%m]) (?=to )|(?<= to) (?=\d)"
)
"""Blanks of a cell that break no line: of a number, its error and its unit, and of an interval."""


def columns(rows: Sequence[Sequence[str]], width: int, *, right: bool = False) -> list[str]:
    """Cells in aligned columns of this width together; all but the first aligned to the right, or
    all to the left. The widest columns are wrapped; where words leave no room for that, each row
    is a list of its cells, each after its head, which the first row holds."""
    rows = [[BOUND.sub("\u00a0", cell) for cell in row] for row in rows]
    sizes = [max(map(len, column)) for column in zip(*rows, strict=True)]
    least = [
        max(len(word) for cell in column for word in cell.split(" "))
        for column in zip(*rows, strict=True)
    ]
    gaps = len(sizes) - 1
    gap = next((gap for gap in (3, 2, 1) if sum(least) + gap * gaps <= width), 0)
    if not gap:
        head, *others = rows
        return [
            line
            for name, *cells in others
            for label, text in [("", name), *zip(head[1:], cells, strict=True)]
            if text
            for line in wrapped(f"{label}: {text}" if label else text, "  " * bool(label), width)
        ]
    while sum(sizes) + gap * gaps > width:
        spare = [size > low and size for size, low in zip(sizes, least, strict=True)]
        sizes[spare.index(max(spare))] -= 1
    lines = []
    for row in rows:
        cells = [wrapped(cell, "", max(size, 1)) for cell, size in zip(row, sizes, strict=True)]
        lines += [
            (" " * gap)
            .join(
                text.rjust(size) if right and i else text.ljust(size)
                for i, (text, size) in enumerate(zip(texts, sizes, strict=True))
            )
            .rstrip()
            for texts in zip_longest(*cells, fillvalue="")
        ]
    return [line.replace("\u00a0", " ") for line in lines]


def wrapped(text: str, label: str, width: int) -> list[str]:
    """Text wrapped to this width, with the label before the first line."""
    return textwrap.wrap(
        text,
        width,
        initial_indent=label,
        subsequent_indent=" " * len(label),
        break_on_hyphens=False,
        break_long_words=False,
    )
