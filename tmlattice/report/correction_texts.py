"""Sentences and tables of a correction, for the terminal and the page."""

from math import inf, isfinite

from tmlattice.correction.result import Correction
from tmlattice.correction.targets import TARGETS
from tmlattice.report.text import WIDTH, columns, wrapped

MOST = 20
"""Devices that are listed; the table has all."""
FEWEST = 8
"""Devices, below which other tables are shortened or left out."""
ROUNDING = 1e-6
"""Share of a tolerance below which an error is shown as 0: rounding of the optics."""


def setting_rows(correction: Correction, most: int = MOST) -> list[list[str]]:
    """Head and rows of the table of the first settings."""
    rows = [["device", "present", "new", "change", "unit", "limits", "gain"]]
    for setting in correction.settings[:most]:
        knob = setting.knob
        ends = [f"{end:.6g}" if isfinite(end) else "" for end in (knob.low, knob.high)]
        limits = " to ".join(ends) if any(ends) else "-"
        rows.append([
            knob.name, f"{knob.present:.6g}", f"{setting.new:.6g}",
            f"{setting.new - knob.present:+.3g}", knob.unit,
            limits + (" (at its limit)" if setting.at_limit else ""),
            f"{100 * setting.gain:.1f} %",
        ])  # fmt: skip
    return rows


def expected_rows(correction: Correction, short: bool = False) -> list[list[str]]:
    """Head and rows of the table of errors; short: of the targets alone, without what limits
    them."""
    rows = [["rms", "", "now", "expected", "68 %", "not reachable", "not determined"]]
    for name in correction.targets if short else correction.before:
        target = TARGETS[name]
        for plane in (0, 1):
            now, *_ = correction.before[name][plane]
            then, low, high = correction.after[name][plane]
            reach, data = (values[plane] for values in correction.stays[name])
            shown = [amount(name, value) for value in (now, then, low, high, reach, data)]
            words = target.words + ("" if name in correction.targets else " (no target)")
            rows.append([words, target.planes[plane], shown[0], shown[1],
                         f"{shown[2].split(' ')[0]} to {shown[3]}", *shown[4:]])  # fmt: skip
    return [row[:5] for row in rows] if short else rows


def amount(name: str, value: float) -> str:
    """An error of a target with its unit; 0 for what is rounding of its tolerance."""
    unit = TARGETS[name].unit
    value = 0.0 if value < ROUNDING * TARGETS[name].tolerance else value
    if unit == "relative":
        return f"{100 * value:.3g} %"
    if unit == "m":
        return f"{1e3 * value:.3g} mm"
    return f"{value:.2g}"


def gain_rows(correction: Correction) -> list[list[str]]:
    """Head and rows of gains: number of devices, expected rms of each target in the worse plane."""
    return [
        ["devices", *(TARGETS[name].words for name in correction.targets)],
        *(
            [str(n), *(amount(name, max(rms[name])) for name in correction.targets)]
            for n, rms in correction.gains
        ),
    ]


def correction_text(correction: Correction, width: int = WIDTH, most: int | None = None) -> str:
    """The whole report as plain text of so many columns; with fewer settings, and the targets
    alone, where only so many lines are wanted."""
    room = inf if most is None else most
    lines = wrapped(correction.words, "", width)
    notes = [line for text in sentences(correction) for line in ("", *wrapped(text, "", width))]
    room -= len(lines) + len(notes) + 2  # the blank line before the settings, and how many more
    more = ["", *columns(expected_rows(correction), width)]
    if len(more) + FEWEST > room:  # of the rest the page has more
        more = ["", *columns(expected_rows(correction, short=True), width)]
    room -= len(more)
    gains = ["", "Expected rms with the first devices:", *columns(gain_rows(correction), width)]
    if correction.gains and room - len(gains) >= FEWEST:
        more += gains
        room -= len(gains)
    if correction.settings:
        count = min(MOST, len(correction.settings))
        while len(table := columns(setting_rows(correction, count), width)) > room and count > 1:
            count -= 1
        lines += ["", *table]
        if len(correction.settings) > count:
            lines += [f"and {len(correction.settings) - count} more (settings.csv)"]
    more += notes
    return "\n".join([*lines, *more])


def sentences(correction: Correction) -> list[str]:
    """Sentences on the gain, its error, iterations and warnings."""
    share, error = 100 * correction.gain, 100 * correction.gain_error
    found = [] if correction.refused else [
        f"Expected gain: {share:.3g} ± {error:.1g} % of the squared errors in units of their "
        "tolerances. Measurements and corrections that are expected to be needed: "
        f"{correction.iterations}."
    ]  # fmt: skip
    return found + [f"Note: {text}." for text in correction.warnings]
