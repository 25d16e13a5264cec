"""What a diagnosis says, in the words of a control room.

The same sentences and rows stand in the terminal (`plain.report_text`) and in the HTML page.
"""

import textwrap
from collections.abc import Iterable, Sequence

import numpy as np

from tmlattice.diagnosis.result import Diagnosis, Finding, Member
from tmlattice.effects import CATALOGUE, find

_SCALES = {
    "relative": ((0.0, 100.0, "%"),),
    "m": ((0.0, 1e6, "µm"), (1e-3, 1e3, "mm")),
    "rad": ((0.0, 1e6, "µrad"), (1e-3, 1e3, "mrad")),
    "1/m": ((0.0, 1.0, "1/m"),),
    "scale": ((0.0, 1.0, "x expected"),),
}
"""By unit of the catalogue: from which modulus on, factor, readable unit."""


# --- words for parts ------------------------------------------------------------------------------
def words(effect: str) -> str:
    """An effect of the catalogue in plain words."""
    return CATALOGUE[effect].words if effect in CATALOGUE else effect.replace("_", " ")


def _scale(effect: str, amount: float) -> tuple[float, str]:
    unit = find(effect).unit
    steps = _SCALES.get(unit, ((0.0, 1.0, unit),))
    _, factor, name = [step for step in steps if abs(amount) >= step[0] or step[0] == 0][-1]
    return factor, name


def amount_text(effect: str, amount: float, sigma: float | None = None) -> str:
    """An amount in a readable unit, with its error to two digits where it has one.

    Args:
        effect: of the catalogue.
        amount, sigma: in the effect's unit.
    """
    if find(effect).discrete:
        return find(effect).forms.get(amount, "")
    factor, unit = _scale(effect, amount)
    value = factor * amount
    if sigma is None or not 0 < sigma < np.inf:
        return f"{value:.3g} {unit}"
    error = factor * sigma
    digits = int(np.clip(1 - np.floor(np.log10(error)), 0, 8))
    return f"{value:+.{digits}f} ± {error:.{digits}f} {unit}"


def least_text(effect: str, amount: float) -> str:
    """The least amount that would be seen; a fault's largest where that is less."""
    kind = find(effect)
    if not amount <= kind.largest:
        return f"not even the largest fault, {amount_text(effect, kind.largest)}"
    return amount_text(effect, amount)


def member_text(member: Member) -> str:
    """One explanation of a credible set."""
    place = "" if member.element is None else f" at {member.element}"
    s = "" if member.s is None else f" (s = {member.s:.1f} m)"
    amount = amount_text(member.effect, member.amount)
    return f"{words(member.effect)}{place}{s}" + (f", {amount}" if amount else "")


def place_text(finding: Finding) -> str:
    """Where a finding sits: metres, and the monitors on both sides."""
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


def title(finding: Finding) -> str:
    """A finding in one line."""
    if finding.effect is None:
        return "something that no effect of the catalogue explains"
    name = words(finding.effect)
    return name if finding.element is None else f"{name}: {finding.element}"


def probability_text(probability: float) -> str:
    """In per cent; never more certain than the numbers allow."""
    if probability > 0.9995:
        return "> 99.9 %"
    return f"{100 * probability:.1f} %" if probability > 0.001 else "< 0.1 %"


def closed_text(diagnosis: Diagnosis) -> str:
    """How much of the gap is closed on held-out shots."""
    gap = diagnosis.heldout
    if gap is None:
        return "No shot was held out: nobody but the fit judges the gap"
    if diagnosis.kind != "trajectory" and len(diagnosis.steps) < 2:
        return "Nothing was put into the model, so the gap stays"
    if diagnosis.findings and not diagnosis.causes:
        return (
            "What has no name cannot be put into the lattice, so the gap of the held-out shots "
            "stays"
        )
    if gap.closed is None:
        return "Held-out readings show no gap beyond the noise, so there is none to close"
    text = f"{100 * gap.closed:.1f} % of the gap beyond the noise is closed on held-out readings"
    if gap.interval is not None:
        low, high = gap.interval
        text += f" (95 % interval {100 * low:.1f} to {100 * high:.1f} %)"
    after = gap.misfits[-1]
    if diagnosis.priors and after.expected is not None:
        rms = [f"{1e6 * step.rms:.3g}" for step in gap.misfits]
        added = ["the design", "with small errors", "with what was found"][: len(rms)]
        text += ": " + ", ".join(f"{a} {b} µm" for a, b in zip(added, rms, strict=False))
        text += f"; {1e6 * after.expected:.3g} µm are to be expected of it"
    return text


def small_rows(diagnosis: Diagnosis) -> list[tuple[str, str]]:
    """Small errors everywhere: (effect, rms and how many times the usual one)."""
    rows = []
    for name, rms in diagnosis.priors.items():
        if name in CATALOGUE and diagnosis.kind == "trajectory":
            usual = CATALOGUE[name].background
            times = f" ({rms / usual:.2g} times the usual one)" if usual else ""
            rows.append((words(name), f"{amount_text(name, rms)} rms{times}"))
    return rows


# --- the sentences --------------------------------------------------------------------------------
def verdict_sentence(diagnosis: Diagnosis) -> str:
    """What was found, in a sentence."""
    found = diagnosis.findings
    count = len(found)
    many = f"{count} causes" if count > 1 else "One cause"
    if diagnosis.verdict == "named":
        what = "; ".join(_short(finding) for finding in found)
        return f"{many} explain{'' if count > 1 else 's'} the gap: {what}."
    if diagnosis.verdict == "equivalent":
        what = "; ".join(_short(finding) for finding in found)
        several = [finding for finding in found if finding.verdict == "equivalent"]
        if count > 1:
            open_ = f"for {len(several)} of them the data allow other explanations too"
        else:
            others = len(found[0].credible_set) - 1
            open_ = "but these readings do not exclude " + (
                "another explanation" if others == 1 else f"{others} other explanations"
            )
        return f"Likeliest: {what}; {open_}."
    if diagnosis.verdict == "located":
        places = [f for f in found if f.effect is None and f.where is not None]
        where = "; ".join(f"{f.where[0]:.1f} m to {f.where[1]:.1f} m" for f in places if f.where)
        named = [f for f in found if f.effect is not None]
        also = f" Besides: {'; '.join(_short(f) for f in named)}." if named else ""
        return f"Something acts at s = {where}, and no effect of the catalogue explains it.{also}"
    if diagnosis.verdict == "distributed" and diagnosis.steps:
        return steps_sentence(diagnosis)
    if diagnosis.verdict == "distributed" and diagnosis.priors:
        return (
            "Small errors all along the ring explain the readings; no single fault stands out "
            "among them."
        )
    if diagnosis.verdict == "distributed":
        return (
            "The data differ from the model all along the ring; no single place, and no few "
            "places, explain it."
        )
    return "No error is seen: the design explains the readings within their noise."


def steps_sentence(diagnosis: Diagnosis) -> str:
    """How far the steps go."""
    first, last = diagnosis.steps[0], diagnosis.steps[-1]
    return (
        "Small errors all along the ring, or of correctors: with them the gap of fitted correctors "
        f"falls from {1e6 * diagnosis.fit_before.rms:.1f} to {1e6 * diagnosis.fit_after.rms:.1f} "
        "µm, that of held-out ones from "
        f"{1e6 * first.heldout_rms_in_plane:.1f} to {1e6 * last.heldout_rms_in_plane:.1f} µm, in "
        f"the other plane from {1e6 * first.heldout_rms_coupling:.1f} to "
        f"{1e6 * last.heldout_rms_coupling:.1f} µm, and that of the RF's response from "
        f"{1e6 * first.dispersion_rms:.0f} to {1e6 * last.dispersion_rms:.0f} µm."
    )


def _short(finding: Finding) -> str:
    if finding.effect is None:
        low, high = finding.where or (float("nan"), float("nan"))
        return f"something unnamed at {low:.1f} m to {high:.1f} m"
    amount = ""
    if finding.amount is not None:
        amount = amount_text(finding.effect, finding.amount, finding.amount_sigma)
    return title(finding) + (f", {amount}" if amount else "")


def advice(diagnosis: Diagnosis) -> str:
    """What to do next, where the result leaves something open and no shot was proposed."""
    if diagnosis.verdict == "distributed" and not diagnosis.steps:
        return (
            "Small errors everywhere look like this: state them (--background all), or give a "
            "measurement of this machine from before the fault (--reference)."
        )
    if diagnosis.verdict == "located":
        return (
            "Look at what stands there: hardware, apertures, cables of the monitors. More launches "
            "tell whether it is constant, linear or not, or changes from shot to shot."
        )
    return ""


def next_text(diagnosis: Diagnosis) -> str:
    """The next measurement, in words; empty where none was proposed."""
    shot = diagnosis.next
    if shot is None:
        return ""
    changes = [
        _setting_text(element, name, value)
        for element, setting in shot.settings.items()
        for name, value in setting.items()
    ]
    launch = shot.launch
    where = (
        f"x = {1e3 * launch['x']:.2f} mm, px = {1e3 * launch['px']:.3f} mrad, "
        f"y = {1e3 * launch['y']:.2f} mm, py = {1e3 * launch['py']:.3f} mrad"
    )
    if launch["delta"]:
        where += f", energy {100 * launch['delta']:+.2f} %"
    first, second = shot.parts
    how = f"with {' and '.join(changes)}, " if changes else ""
    return (
        f"One more shot, {how}launched at {where}, would part '{first}' from '{second}' by "
        f"{shot.separation:.1f} standard deviations" + _enough(shot.separation)
    )


def _enough(separation: float) -> str:
    """How many such shots make 5 standard deviations."""
    if separation >= 5:
        return "."
    if separation < 1:
        return ": too few; no candidate does better."
    return f"; {int(np.ceil((5 / separation) ** 2))} such shots reach 5."


def _setting_text(element: str, name: str, value: float) -> str:
    match name:
        case "k1_relative":
            return f"the strength of {element} changed by {100 * value:+g} %"
        case "k2_relative":
            return f"{element} switched off" if value == -1 else f"{element} {100 * value:+g} %"
        case "kick":
            return f"{element} set to {1e6 * value:+g} µrad"
    return f"{element} {name} = {value:g}"


def left_text(diagnosis: Diagnosis) -> str:
    """What is left when all that was found is in the model."""
    p_value = diagnosis.unexplained["p_value"]
    places = diagnosis.unexplained["places"]
    how = "noise" if p_value >= 0.01 else "slightly more than the noise"
    how = how if p_value >= 1e-4 else "more than the noise"
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
    if finding.effect is not None:
        rows.append(("effect", f"{finding.effect}: {find(finding.effect).sign}"))
        if finding.element is not None:
            rows.append(("element", finding.element))
    rows.append(("place", place_text(finding)))
    if finding.effect is not None and finding.amount is not None:
        amount = amount_text(finding.effect, finding.amount, finding.amount_sigma)
        if amount:
            rows.append(("amount", amount))
    if finding.effect is not None:
        rows.append(("probability", probability_text(finding.probability)))
    rows.append(("seen", _seen_text(finding)))
    if len(finding.credible_set) > 1:
        rows.append(("or else", _others_text(finding.credible_set[1:])))
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
"""Other members of a credible set that a finding lists."""


def _others_text(members: Sequence[Member]) -> str:
    shown = [f"{probability_text(m.probability)} {member_text(m)}" for m in members[:MOST]]
    if len(members) > MOST:
        rest = sum(m.probability for m in members[MOST:])
        shown.append(f"{len(members) - MOST} more ({probability_text(rest)} together)")
    return "\n".join(shown)


def gap_rows(diagnosis: Diagnosis) -> list[tuple[str, str, str]]:
    """The gap: (which readings, before, after), rms in µm and chi-square per reading."""
    what = "shots" if diagnosis.kind == "trajectory" else "correctors"
    rows = [(f"{what} of the fit", diagnosis.fit_before, diagnosis.fit_after)]
    gap = diagnosis.heldout
    if gap is not None:
        rows.append(
            (f"held out ({heldout_text(diagnosis)})", gap.misfits[gap.since], gap.misfits[-1])
        )
    return [
        (name, *(f"{1e6 * m.rms:.1f} µm, chi² {_chi2(m.chi2_per_dof)}" for m in (before, after)))  # type: ignore[misc]
        for name, before, after in rows
    ]


def heldout_text(diagnosis: Diagnosis) -> str:
    """Who judges."""
    if diagnosis.kind == "trajectory":
        return f"shots {', '.join(map(str, diagnosis.heldout_shots))}"
    return f"{int(diagnosis.response.held.sum())} correctors"


def _chi2(value: float) -> str:
    return f"{value:.2f}" if value < 100 else f"{value:.3g}"


def noise_text(diagnosis: Diagnosis) -> str:
    """The noise of a reading."""
    x, y = (f"{1e6 * sigma:.1f} µm" if np.isfinite(sigma) else "no reading"
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
