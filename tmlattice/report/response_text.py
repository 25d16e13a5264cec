"""Sections that only a hierarchical fit reports: held-out residuals, errors, missing effects."""

from collections.abc import Iterable

import numpy as np

from tmlattice.arrays import rms
from tmlattice.diagnosis.response.common_factors import Reason
from tmlattice.diagnosis.response.validation import Step
from tmlattice.diagnosis.result import Diagnosis
from tmlattice.diagnosis.suspects import numbers
from tmlattice.effects import with_labels
from tmlattice.report.amounts import all_of, amount_text, degenerate_text, labelled, words
from tmlattice.report.text import columns, wrapped
from tmlattice.speaks import listed

SHOWN = 8
"""Largest errors of each effect that are listed."""
PULLS = 4
"""Inconsistent gradients that are listed."""


def step_rows(steps: Iterable[Step], model: str = "") -> list[tuple[str, ...]]:
    """Head and rows of the table of steps: what is fitted (first the model alone), parameters,
    held-out rms in µm."""
    rows = [(model if model and s.effect == "design" else with_labels(s.effect), *_scores(s))
            for s in steps]  # fmt: skip
    return [("fitted", *SCORES), *rows]


SCORES = ("amounts", "in-plane", "jump", "coupling", "roll", "RF", "chi²")


def _scores(step: Step) -> tuple[str, ...]:
    lengths = (
        step.heldout_rms_in_plane, step.heldout_rms_position, step.heldout_rms_coupling,
        step.heldout_rms_roll, step.dispersion_rms,
    )  # fmt: skip
    in_micrometres = (known(1e6 * length) for length in lengths)
    return str(step.parameters), *in_micrometres, known(step.heldout_chi2_per_dof)


def family_rows(families: Iterable[Step]) -> list[tuple[str, ...]]:
    """Head and rows of the table of families, with the decision on each reversed: log evidence for
    it, parameters, held-out rms in µm."""
    rows = [(f.reversed_decision, known(f.log_evidence), *_scores(f)) for f in families]
    return [("reversed decision", "log evidence", *SCORES), *rows]


def known(value: float) -> str:
    """A number with three digits; empty where it is NaN."""
    return f"{value:.3g}" if np.isfinite(value) else ""


OUT = "excluded"
"""Of a hypothesis without evidence."""
HYPOTHESIS = (
    "hypothesis", "amounts", "amount", "unit", "sensible", "in-plane", "evidence", "on top", "so",
)  # fmt: skip


def hypothesis_rows(result: Diagnosis) -> list[tuple[str, ...]]:
    """Head and rows of the table of hypotheses: amount and error (of several: rms, typical error),
    held-out rms, log evidence."""
    rows: list[tuple[str, ...]] = [
        (
            row.effect,
            str(row.parameters),
            f"{row.amount:.2g} ± {row.amount_sigma:.1g}" if row.parameters else "",
            row.unit,
            row.expected,
            f"{1e6 * row.heldout_rms_in_plane:.3g}",
            *(f"{round(own, 1) + 0.0:.1f}" for own in (row.evidence, row.evidence_on_top)),
            row.judgement,
        )
        for row in result.hypotheses or ()
    ]
    return [HYPOTHESIS, *rows]


def error_rows(result: Diagnosis) -> list[tuple[str, str]]:
    """By effect: the number of amounts, the rms and the largest of those that the data determine,
    with the share that comes from the data, and those that are not determined, with what they are
    degenerate with."""
    rows = []
    for effect in dict.fromkeys(cause.effect for cause in result.causes):
        own = [row for row in result.supported if row[0].effect == effect]
        supports = {cause.element: support for cause, _, support in own}
        known: list[tuple[float, str]] = []
        unknown: dict[str, list[str]] = {}
        found = numbers((cause, sigma) for cause, sigma, _ in own)
        for places, sigma in found:
            amount, support = places[0].amount, supports[places[0].element]
            name = all_of([place.element for place in places], result.devices)
            if support.determined:
                share = f"{100 * support.share_from_data:.0f} %"
                known.append((amount, f"{name} {amount_text(effect, amount, sigma)} ({share})"))
            else:
                unknown.setdefault(degenerate_text(effect, support), []).append(name)
        said, parts = f"{words(effect)}: {len(found)}", []
        if known:
            typical = amount_text(effect, rms([amount for amount, _ in known]))
            said += f", {len(known)} determined by the data, rms {typical}; "
            said += "largest (share from the data):"
            known.sort(key=lambda row: -abs(row[0]))
            parts.append("; ".join(text for _, text in known[:SHOWN]))
        if unknown:
            texts = [f"{listed(names, SHOWN)} ({why})" for why, names in unknown.items()]
            parts.append(f"not determined by the data: {listed(texts, SHOWN, '; ')}")
        rows.append((said, ". ".join(parts)))
    return rows


SURE = 0.95
"""Probability of a common factor from which on its probability is not printed."""
REASON = ("common factor or magnet", "gradients", "magnets", "chi²", "possible cause")


def common_factor_rows(result: Diagnosis) -> list[tuple[str, ...]]:
    """Rows of the table of common factors: name, amount in %, magnets, chi-square, possible
    cause."""
    found = () if result.common_factors is None else result.common_factors.common_factors
    return [
        (
            own.name + _doubted(own),
            f"{100 * own.amount:+.2f} ± {100 * own.amount_sigma:.2f} %",
            str(len(own.members)),
            f"{own.statistic:.3g}",
            own.makes,
        )
        for own in found
    ]


def _doubted(own: Reason) -> str:
    """The alternative to a common factor, or else its probability."""
    if own.rivals:
        name, probability = own.rivals[0]
        return f" (or {name}, {100 * probability:.0f} %)"
    return "" if own.probability > SURE else f" (probability {100 * own.probability:.0f} %)"


def common_factors_sentence(result: Diagnosis) -> str:
    """The share that common factors explain, and the scatter of single magnets; empty without
    gradients."""
    own = result.common_factors
    if own is None:
        return ""
    families = (
        f" Families differ by {100 * own.between:.2g} % (rms), each by its calibration; "
        "the table lists those above five standard deviations."
        if own.between
        else ""
    )
    if not any(len(one.members) > 1 for one in own.common_factors):
        return (
            "No common factor of several magnets was detected; the gradients scatter by "
            f"{100 * own.scatter:.2g} % (rms).{families}"
        )
    return (
        f"Common factors of several magnets explain {100 * own.share:.0f} % of the gradients' "
        f"mean square; single magnets scatter about them by {100 * own.scatter:.2g} % "
        f"(rms).{families}"
    )


INSTEAD = "Alternative common factors of the same gradients:"
MISSING = (
    "Missing effects: held-out rms in µm and log evidence (natural) of each alone, and evidence on "
    "top of those that help:"
)
FAMILIES = (
    "The same with the decision on one family of errors reversed, after one further round of the "
    "fit (empty: it diverges). A family is rejected if its log evidence (natural) is below 5, if "
    "its amount is implausible, or beyond --max-effects:"
)


def instead_texts(result: Diagnosis) -> list[str]:
    """Alternative sets of common factors: what differs in each of them."""
    found = result.common_factors
    if found is None:
        return []
    first = {own.name: own.amount for own in found.common_factors}
    said = []
    for one in found.instead:
        other = [
            f"{name} {100 * amount:+.2f} ± {100 * sigma:.2f} %"
            for name, amount, sigma in one.amounts
            if name not in first or abs(first[name] - amount) > sigma
        ]
        gone = [name for name in first if name not in {name for name, _, _ in one.amounts}]
        if not other and not gone:
            continue
        parts = [", ".join(other)] * bool(other) + ["without " + ", ".join(gone)] * bool(gone)
        said.append(f"{'; '.join(parts)} ({100 * one.probability:.0f} %)")
    return said


def inconsistency_texts(result: Diagnosis) -> list[str]:
    """The inconsistency of the RF's orbit with the correctors, and the gradients that it
    concerns."""
    found = result.inconsistencies
    if found is None:
        return []
    first = (
        "The RF's orbit and the correctors' responses are inconsistent: with the gradients of the "
        f"latter, the residual of the former is {1e6 * found.missed:.2g} µm; gradients fitted to "
        f"it would leave {1e6 * found.known:.2g} µm "
        f"({found.chi2 / found.readings:.1f} of chi² per reading)."
    )
    return [
        first,
        *(
            f"{own.name} {100 * own.correctors:+.2f} ± {100 * own.correctors_sigma:.2f} % from the "
            f"correctors, {100 * own.with_rf:+.2f} ± {100 * own.with_rf_sigma:.2f} % when the "
            f"RF's orbit is fitted ({abs(own.pull):.0f} standard deviations of the difference)"
            for own in found.pulls[:PULLS]
        ),
    ]


def left_sentence(result: Diagnosis) -> str:
    """The share of the remaining residual in its eight strongest singular vectors."""
    x, y = result.unexplained["patterns"]["low_rank"]
    return (
        "The eight strongest orbit patterns (singular vectors) make up "
        f"{100 * x:.0f} % of the remaining mean square residual in x and {100 * y:.0f} % in y."
    )


def bad_monitors_text(result: Diagnosis) -> str:
    """The rejected BPMs in a sentence."""
    names = [labelled(name, result.devices) for name in result.bad_monitors]
    return f"Rejected BPMs: {', '.join(names) or 'none'}"


def steps_text(result: Diagnosis, width: int) -> list[str]:
    """The section of the plain text, as lines."""
    lines = wrapped("Held-out correctors, rms in µm (chi² per reading):", "", width)
    lines += columns(step_rows(result.steps, result.starting_model), width, right=True)
    if result.families:
        lines += ["", *wrapped(FAMILIES, "", width)]
        lines += columns(family_rows(result.families), width, right=True)
    lines += ["", *wrapped(bad_monitors_text(result), "", width)]
    if result.common_factors is not None:
        lines += ["", "Common factors of the gradients:"]
        for name, amount, count, square, makes in common_factor_rows(result):
            of = "" if count == "1" else f"{count} magnets, "
            factor = f"{name}: {amount}, {of}chi² {square}; {makes}"
            lines += wrapped(factor, "   ", width)
        lines += wrapped(common_factors_sentence(result), "", width)
        instead = instead_texts(result)
        if instead:
            lines += ["", *wrapped(INSTEAD, "", width)]
            for text in instead:
                lines += wrapped(text, "   ", width)
        for i, text in enumerate(inconsistency_texts(result)):
            lines += wrapped(text, "   ", width) if i else ["", *wrapped(text, "", width)]
    for family, amounts in error_rows(result):
        lines += ["", *wrapped(family, "", width), *wrapped(amounts, "   ", width)]
    lines += ["", *wrapped(left_sentence(result), "", width)]
    if result.hypotheses:
        lines += ["", *wrapped(MISSING, "", width)]
        rows = hypothesis_rows(result)
        lines += columns([row for row in rows if row[-1] != OUT], width, right=True)
        out = "; ".join(row[0] for row in rows if row[-1] == OUT)
        lines += wrapped(f"{OUT.capitalize()}: {out}." if out else "", "", width)
    for said in result.degenerate:
        lines += wrapped(f"Not determined by the data: {said}.", "", width)
    return lines
