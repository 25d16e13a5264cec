"""A correction: settings of knobs, their expected gain, and the remaining errors.

>>> correction = correct(diagnosis)
>>> print(correction.report())
>>> correction.save("settings")
"""

import csv
import io
import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

from tmlattice.arrays import TINY
from tmlattice.correction.knobs import Knob
from tmlattice.correction.snippets import snippet
from tmlattice.correction.targets import TARGETS
from tmlattice.diagnosis.records import decoded, encoded
from tmlattice.late import Method
from tmlattice.lattice import Ring
from tmlattice.measurement.documents import read_document
from tmlattice.speaks import Speaks, listed

Interval = tuple[float, float, float]
"""Median and the ends of the central 68 %."""
DOCUMENT, LATTICE = "correction.json", "correction.lattice.json"
CODES = {"madx": "settings.madx", "at": "settings.at.py", "elegant": "settings.ele"}
FILES = ("settings.csv", *CODES.values(), DOCUMENT, LATTICE, "correction.txt", "correction.png")
"""Files of a correction, apart from the page."""
FORMAT, VERSION = "tmlattice-correction", 2
HEAD = (
    "device", "present", "new", "change", "unit", "low", "high", "gain",
    "kind", "members", "step", "error", "curve",
)  # fmt: skip
"""Columns of settings.csv: those of a table of knobs, with the new setting, its change and gain."""


@dataclass(frozen=True)
class Setting:
    """Setting of one device.

    Attributes:
        knob: the device.
        amount: relative change of its strength, or the change (rad, 1/m) of one that adds.
        new: setting.
        gain: share of the whole gain by which this device lowers the expected square, after the
            devices before it.
    """

    knob: Knob
    amount: float
    new: float
    gain: float

    @property
    def at_limit(self) -> bool:
        """Whether a limit is reached."""
        near = max(self.knob.step, 1e-6 * abs(self.new - self.knob.present))
        return any(
            math.isfinite(end) and abs(self.new - end) <= near
            for end in (self.knob.low, self.knob.high)
        )

    def row(self) -> dict[str, str]:
        """Return the texts of the columns `HEAD`."""
        return self.knob.row() | {
            "device": self.knob.name, "new": f"{self.new:.9g}",
            "change": f"{self.new - self.knob.present:.9g}", "gain": f"{self.gain:.9g}",
        }  # fmt: skip


@dataclass(frozen=True, eq=False, repr=False)
class Correction(Speaks):
    """Settings and their expected effect.

    Attributes:
        settings: of the devices that change, the one that gains most first; none where refused.
        refused: why no setting is changed; empty if some are.
        before, after: expected rms of each target's errors, by target, (x, y).
        stays: rms of each target's errors after the correction in the estimated ring, which these
            knobs do not reach, and the median of what the data leave undetermined, (x, y) each.
        gains: of the first 1, 2, 5, 10, ... devices: their number, and the expected rms by target.
        gain, gain_error: share of the expected square, in units of the tolerances, that the
            correction removes, and its standard deviation.
        tunes: fractions, of the goal, now and expected.
        shown: the target that figures show: beta beating, or the trajectory.
        profile: its errors at the readings now and expected, each [reading, plane, 3] (`Interval`).
        s: of the readings, m.
        targets: the wanted ones, with their tolerances.
        iterations: of measurement and correction that are needed.
        warnings: for the reader.
        provenance: versions, options, seconds.
        ring: with the present settings.
    """

    settings: tuple[Setting, ...]
    refused: str
    before: Mapping[str, tuple[Interval, Interval]]
    after: Mapping[str, tuple[Interval, Interval]]
    stays: Mapping[str, tuple[tuple[float, float], tuple[float, float]]]
    gains: tuple[tuple[int, Mapping[str, tuple[float, float]]], ...]
    gain: float
    gain_error: float
    tunes: Mapping[str, tuple[float, float]]
    shown: str
    profile: tuple[Any, Any]
    s: tuple[float, ...]
    targets: Mapping[str, float]
    iterations: int
    warnings: tuple[str, ...]
    provenance: Mapping[str, Any]
    ring: Any = None

    def _told(self) -> tuple[str, dict[str, str]]:
        return "", {"devices": str(len(self.settings)), "expected": self.words}

    @property
    def words(self) -> str:
        """Summary in one sentence."""
        if self.refused:
            return self.refused
        count, names = len(self.settings), listed([own.knob.name for own in self.settings], 3)
        falls = []
        for name in self.targets:  # its larger plane
            plane = max((0, 1), key=lambda p: self.before[name][p][0])
            now, then = self.before[name][plane][0], self.after[name][plane][0]
            if then < now:
                falls.append((now / max(then, TINY), self._change(name, plane)))
        most = sorted(falls, key=lambda fall: -fall[0])[:3]
        devices = f"The device {names} takes" if count == 1 else f"The {count} devices {names} take"
        worse = self.worse
        rises = f" It raises {'; '.join(worse)}, since the others gain more." if worse else ""
        return f"{devices} {'; '.join(text for _, text in most)}.{rises}"

    @property
    def worse(self) -> list[str]:
        """Targets that the correction raises: their interval is above the present rms, and their
        rms above the tolerance."""
        return [
            self._change(name, plane)
            for name, tolerance in self.targets.items() for plane in (0, 1)
            if self.after[name][plane][1] > self.before[name][plane][0]
            and self.after[name][plane][0] > tolerance
        ]  # fmt: skip

    def _change(self, name: str, plane: int) -> str:
        target, now = TARGETS[name], self.before[name][plane][0]
        then, low, high = self.after[name][plane]
        factor, unit = {"relative": (100.0, "%"), "m": (1e3, "mm"), "": (1.0, "")}[target.unit]
        scale = (
            f"{factor * now:.3g} to {factor * then:.3g} ± {factor * (high - low) / 2:.2g} {unit}"
        )
        return f"the {target.words} in {target.planes[plane]} from {scale.rstrip()}"

    report = Method(
        "tmlattice.report.correction_texts", "correction_text", "The whole as plain text."
    )
    save = Method(
        "tmlattice.report.speaking",
        "save_correction",
        "Write settings.csv, correction.json and .txt, snippets and report.html into a folder.",
    )
    plot = Method(
        "tmlattice.plots.readings", "plot_correction", "Draw the beta beating now and expected."
    )

    def as_json(self) -> dict[str, Any]:
        """Return the result in the format `tmlattice-correction`; the ring is not part of it."""
        from tmlattice import __version__

        own = {f.name: encoded(getattr(self, f.name)) for f in fields(self) if f.name != "ring"}
        return {"format": FORMAT, "version": VERSION, "package": __version__, "words": self.words,
                **own}  # fmt: skip

    def table(self) -> str:
        """Return the settings as CSV."""
        text = io.StringIO()
        writer = csv.DictWriter(text, HEAD, extrasaction="ignore", lineterminator="\n")
        writer.writeheader()
        writer.writerows(setting.row() for setting in self.settings)
        return text.getvalue()

    def snippet(self, code: str) -> str:
        """Return the settings as statements of "madx", "at" (Python) or "elegant"."""
        return snippet(self.ring, [(s.knob, s.amount) for s in self.settings], code)


def read_correction(path: Path, ring: Ring) -> Correction:
    """Return the correction of a correction.json.

    Args:
        path: of the file.
        ring: with the present settings.

    Raises:
        MeasurementError: it cannot be read.
    """
    document = read_document(path, "correction", FORMAT, VERSION)
    found: Correction = replace(decoded(Correction, document), ring=ring)
    for setting in found.settings:
        for member in setting.knob.members:
            ring[member]
    return found
